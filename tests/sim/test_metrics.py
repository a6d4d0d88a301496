"""Metrics against numbers worked by hand."""

import numpy as np
import pytest
from arm import write_arm

from gaponet.data.sequence import Sequence, SequenceMeta
from gaponet.sim.metrics import mean_reduction, metrics, runs, summary


def sequence(robot, qpos, motion="m", payload=0.0):
    qpos = np.asarray(qpos, float)
    return Sequence(
        SequenceMeta("arm", "a", motion, payload),
        robot.joint_names,
        0.5,
        qpos,
        qpos,
        np.zeros_like(qpos),
    )


@pytest.fixture
def robot(tmp_path):
    return write_arm(tmp_path)


def test_metrics_by_hand(robot):
    real = sequence(robot, [[0, 0], [1, 0], [1, 0]])
    simulated = np.array([[0, 0], [1.1, 0.2], [0.9, -0.6]])
    m = metrics(runs([real], [simulated], robot))
    assert m["mpjae"] == pytest.approx((0.1 + 0.1 + 0.2 + 0.6) / 4)
    assert m["q_dis"] == pytest.approx(0.5 * ((0.1 + 0.1) + (0.2 + 0.6)) / 2)
    assert m["rmse"] == pytest.approx((0.1 + np.sqrt((0.04 + 0.36) / 2)) / 2)
    assert m["large_0.05"] == 1.0
    assert m["large_0.5"] == 0.25
    assert m["large_0.1"] == 0.75  # 0.9 − 1 is a little less
    assert m["range"] == pytest.approx((0.0 + 0.4) / 2)
    assert m["iqr"] == pytest.approx((0.0 + 0.2) / 2)
    assert m["static"] == pytest.approx((0.0 + 0.2) / 2)  # medians of (0.1, −0.1) and (0.2, −0.6)


def test_the_common_start_is_no_error(robot):
    real = sequence(robot, [[0, 0], [0, 0]])
    assert metrics(runs([real], [np.array([[5, 5], [0, 0]])], robot))["mpjae"] == 0.0


def test_a_motion_counts_once_whatever_its_length(robot):
    short, long = (
        sequence(robot, np.zeros((3, 2)), "short"),
        sequence(robot, np.zeros((30, 2)), "long", 1.0),
    )
    result = summary(runs([short, long], [np.ones((3, 2)), np.zeros((30, 2))], robot), robot)
    assert result["mpjae"] == pytest.approx(0.5)
    assert result["by_motion"]["short"]["mpjae"] == pytest.approx(1.0)
    assert result["by_payload"]["1"]["mpjae"] == 0.0
    assert list(result["by_joint"]) == ["shoulder", "elbow"]


def test_pieces_of_one_recording_are_one_motion():
    def meta(motion, **notes):
        return SequenceMeta("arm", "a", motion, 0.0, notes=notes)

    pieces = [meta(f"chirp@{start}", from_s=start) for start in (0.0, 3.0)]
    before, after = np.array([5.0, 5.0, 6.0]), np.array([4.0, 2.0, 1.0])
    mean, error = mean_reduction(pieces, before[:2], after[:2])
    assert mean == 2.0
    assert np.isnan(error)
    mean, error = mean_reduction([*pieces, meta("walk@3.0")], before, after)
    assert mean == 3.0  # over recordings
    assert error == pytest.approx(np.std([2, 5], ddof=1) / np.sqrt(2))  # over motions


def test_horizons_longer_than_the_motion_are_left_out(robot):
    result = summary(runs([sequence(robot, np.zeros((5, 2)))], [np.ones((5, 2))], robot), robot)
    assert "5" not in result["by_horizon"]
    assert result["by_horizon"]["whole"]["mpjae"] == pytest.approx(1.0)


def test_a_summary_of_an_iterator_is_that_of_a_list(robot):
    reals = [sequence(robot, np.eye(4, 2) * k, f"m{k % 2}", k % 2) for k in range(4)]
    part = runs(reals, [0.9 * s.qpos for s in reals], robot)
    found = summary(iter(part), robot)
    assert found == summary(part, robot)
    assert found["mpjae"] == metrics(part)["mpjae"]
    whole = {
        m: metrics([r for r in part if r.meta.motion == m]) for m in ("m0", "m1")
    }  # no joint here is a wrist
    assert found["by_motion"] == {m: w | {"mpjae_no_wrist": w["mpjae"]} for m, w in whole.items()}
    assert found["by_joint"] == {j: metrics(part, [i]) for i, j in enumerate(robot.operated)}
