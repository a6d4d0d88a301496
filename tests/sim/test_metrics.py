"""Metrics against numbers worked by hand."""

import numpy as np
import pytest
from arm import write_arm

from gaponet.data.sequence import Sequence, SequenceMeta
from gaponet.sim.metrics import mean_reduction, metrics, runs, summary


def sequence(robot, qpos, motion="m", payload=0.0):
    qpos = np.asarray(qpos, float)
    meta = SequenceMeta("arm", "a", motion, payload)
    return Sequence(meta, robot.joint_names, 0.5, qpos, qpos, np.zeros_like(qpos))


@pytest.fixture
def robot(tmp_path):
    return write_arm(tmp_path)


@pytest.fixture
def by_hand(robot):
    """Metrics of two moved rows whose errors are (0.1, 0.2) and (−0.1, −0.6) rad."""
    real = sequence(robot, [[0, 0], [1, 0], [1, 0]])
    simulated = np.array([[0, 0], [1.1, 0.2], [0.9, -0.6]])
    return metrics(runs([real], [simulated], robot))


def test_mean_errors_by_hand(by_hand):
    assert by_hand["mpjae"] == pytest.approx((0.1 + 0.1 + 0.2 + 0.6) / 4)
    assert by_hand["q_dis"] == pytest.approx(0.5 * ((0.1 + 0.1) + (0.2 + 0.6)) / 2)
    assert by_hand["rmse"] == pytest.approx((0.1 + np.sqrt((0.04 + 0.36) / 2)) / 2)


def test_shares_of_large_errors_by_hand(by_hand):
    assert by_hand["large_0.05"] == 1.0
    assert by_hand["large_0.5"] == 0.25
    assert by_hand["large_0.1"] == 0.75  # 0.9 − 1 is a little less


def test_spread_and_offset_by_hand(by_hand):
    assert by_hand["range"] == pytest.approx((0.0 + 0.4) / 2)
    assert by_hand["iqr"] == pytest.approx((0.0 + 0.2) / 2)
    # Medians of (0.1, −0.1) and (0.2, −0.6).
    assert by_hand["static"] == pytest.approx((0.0 + 0.2) / 2)


def test_the_common_start_is_no_error(robot):
    real = sequence(robot, [[0, 0], [0, 0]])
    assert metrics(runs([real], [np.array([[5, 5], [0, 0]])], robot))["mpjae"] == 0.0


def test_a_motion_counts_once_whatever_its_length(robot):
    short = sequence(robot, np.zeros((3, 2)), "short")
    long = sequence(robot, np.zeros((30, 2)), "long", 1.0)
    result = summary(runs([short, long], [np.ones((3, 2)), np.zeros((30, 2))], robot), robot)
    assert result["mpjae"] == pytest.approx(0.5)
    assert result["by_motion"]["short"]["mpjae"] == pytest.approx(1.0)
    assert result["by_payload"]["1"]["mpjae"] == 0.0
    assert list(result["by_joint"]) == ["shoulder", "elbow"]


def test_pieces_of_one_recording_are_one_motion():
    def meta(motion, **notes):
        return SequenceMeta("arm", "a", motion, 0.0, notes=notes)

    pieces = [meta(f"chirp@{start}", from_s=start) for start in (0.0, 3.0)]
    before = np.array([5.0, 5.0, 6.0])
    after = np.array([4.0, 2.0, 1.0])
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


@pytest.fixture
def four_runs(robot):
    """Two runs of each of the motions m0 and m1."""
    reals = [sequence(robot, np.eye(4, 2) * k, f"m{k % 2}", k % 2) for k in range(4)]
    return list(runs(reals, [0.9 * s.qpos for s in reals], robot))


def test_a_summary_of_an_iterator_is_that_of_a_list(robot, four_runs):
    assert summary(iter(four_runs), robot) == summary(four_runs, robot)


def test_a_summary_has_the_metrics_of_all_runs(robot, four_runs):
    assert summary(four_runs, robot)["mpjae"] == metrics(four_runs)["mpjae"]


@pytest.mark.parametrize("motion", ["m0", "m1"])
def test_a_summary_has_the_metrics_of_each_motion(robot, four_runs, motion):
    own = metrics([run for run in four_runs if run.meta.motion == motion])
    own["mpjae_no_wrist"] = own["mpjae"]  # no joint here is a wrist
    by_motion = summary(four_runs, robot)["by_motion"]
    assert by_motion.keys() == {"m0", "m1"}
    assert by_motion[motion] == own


def test_a_summary_has_the_metrics_of_each_joint(robot, four_runs):
    by_joint = summary(four_runs, robot)["by_joint"]
    shoulder = metrics(four_runs, [0])
    assert by_joint == {"shoulder": shoulder, "elbow": metrics(four_runs, [1])}
