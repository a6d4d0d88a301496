"""What is shown is what was asked, simulated and recorded."""

import numpy as np
import pytest
from arm import recordings
from runs import untrained

from gaponet.base.errors import DatasetError, UsageError
from gaponet.data.store import Dataset
from gaponet.report.view.side_by_side import Clip, select_entry, side_by_side
from gaponet.sim.metrics import metrics, runs
from gaponet.sim.replay import replay


@pytest.fixture
def dataset(arm, tmp_path):
    made = Dataset.create(tmp_path / "data", arm)
    for sequence in recordings(arm, 4, rows=120, kp=0.5):
        made.append(sequence)
    return made


def test_the_nominal_copy_is_the_replay_and_its_mean_error_the_mpjae(dataset, arm):
    shown = side_by_side(dataset, dataset.entries[1], arm)
    real = dataset.read(dataset.entries[1])
    simulated = replay([real], arm)[0]
    nominal = shown.motions[1]
    assert [m.method for m in shown.motions] == ["target", "nominal", "recorded"]
    assert shown.seen is None
    np.testing.assert_array_equal(nominal.qpos, simulated.qpos)
    assert nominal.mpjae == pytest.approx(metrics(runs([real], [simulated.qpos], arm))["mpjae"])
    assert shown.motions[-1].mpjae == 0.0


def test_the_target_copy_shows_the_previous_command(dataset, arm):
    """Row t's command is for t + 1."""
    shown = side_by_side(dataset, dataset.entries[0], arm)
    np.testing.assert_array_equal(shown.motions[0].qpos[1:], shown.real.ctrl[:-1])
    np.testing.assert_array_equal(shown.motions[0].qpos[0], shown.real.qpos[0])


def test_magnifying_moves_the_picture_and_not_the_numbers(dataset, arm):
    shown = side_by_side(dataset, dataset.entries[0], arm)
    grown = shown.magnified(3.0)
    for before, after in zip(shown.motions, grown.motions, strict=True):
        expected = 3 * (before.qpos - shown.real.qpos)
        np.testing.assert_allclose(after.qpos - shown.real.qpos, expected, atol=1e-6)
        np.testing.assert_array_equal(after.error, before.error)
    with pytest.raises(UsageError, match="positive"):
        shown.magnified(0.0)


def test_a_motion_that_is_not_there_is_named_with_those_that_are(dataset, arm):
    shown = side_by_side(dataset, dataset.entries[0], arm)
    assert [m.method for m in shown.only(("recorded", "nominal")).motions] == [
        "recorded",
        "nominal",
    ]
    with pytest.raises(UsageError, match="--show"):
        shown.only(("gaponet",))
    with pytest.raises(DatasetError, match="motion1"):
        select_entry(dataset, (), "motion1", payload_mass=1.0)


def test_a_recording_that_no_run_was_fitted_to_comes_first(dataset, arm, tmp_path):
    run = untrained(
        tmp_path / "run",
        arm,
        dataset,
        train=("motion0", "motion1"),
        val=("motion3",),
        test=("motion2",),
    )
    first = untrained(
        tmp_path / "first", arm, dataset, train=("motion1",), val=("motion3",), test=("motion0",)
    )
    assert select_entry(dataset, (first,)).meta.motion == "motion0"
    assert select_entry(dataset, (first, run)).meta.motion == "motion2"
    assert select_entry(dataset, (run,)).meta.motion == "motion2"
    assert select_entry(dataset, (run,), payload_mass=0.2).meta.motion == "motion1"  # seen
    assert select_entry(dataset, ()).meta.motion == "motion0"


def test_the_busiest_stretch_is_where_the_robot_moves(dataset, arm):
    shown = side_by_side(dataset, dataset.entries[0], arm)
    qpos = np.zeros((100, 2))
    qpos[60:80] = np.linspace(0, 1, 20)[:, None]
    qpos[80:] = 1.0
    still = type(shown.real)(shown.real.meta, arm.joint_names, 0.02, qpos, qpos, 0 * qpos)
    clip = Clip.from_start(type(shown)(still, arm, shown.motions, None), None, 0.4)
    assert 1.16 <= clip.start <= 1.2  # rows 58 to 60 begin a stretch of 20 rows with all the motion
