"""Against which baseline, and on what: the run's own simulator, and nothing that one of the runs
has seen.
"""

import json
import shutil
from dataclasses import replace

import numpy as np
import pytest
from arm import TOML, commands, record, write_arm
from runs import random_run, untrained

from gaponet.base.errors import DatasetError, ModelError
from gaponet.cli.main import main
from gaponet.data.store import Dataset
from gaponet.evaluation.candidate import Candidate, select_entries
from gaponet.evaluation.evaluate import evaluate
from gaponet.evaluation.gap import gap_by_step
from gaponet.report.view.side_by_side import side_by_side
from gaponet.robot.folder import load_stored_robot
from gaponet.robot.spec import load_robot
from gaponet.sim.dataset_robot import open_dataset
from gaponet.sim.model import model_hash

STIFF = TOML.replace("kp = 20.0", "kp = 90.0")


@pytest.fixture
def data(arm, tmp_path):
    made = Dataset.create(tmp_path / "data", arm)
    for i in range(4):
        made.append(record(arm, commands(80, i), f"m{i}", kp=0.5))
    return made


@pytest.fixture
def run(arm, data, tmp_path):
    return untrained(tmp_path / "run", arm, data, train=("m0", "m1"), val=("m2",), test=("m3",))


def without_robot(data):
    """As datasets were written before they kept their robot."""
    shutil.rmtree(data.path / "robot")
    return Dataset(data.path)


@pytest.mark.parametrize("old", [False, True])
def test_a_folder_named_like_the_robot_in_the_current_directory_changes_nothing(
    arm, data, run, tmp_path, monkeypatch, old
):
    write_arm(tmp_path / "elsewhere" / "arm", toml=STIFF)
    before = evaluate([run], data, arm).result["methods"]["nominal"]["mpjae"]
    monkeypatch.chdir(tmp_path / "elsewhere")
    if old:
        data = without_robot(data)
    dataset, robot = open_dataset(data.path, None, run)
    found = evaluate([run], dataset, robot).result
    assert found["methods"]["nominal"]["mpjae"] == before
    assert found["simulator_hash"] == model_hash(arm)
    left = gap_by_step(Candidate.load(run, robot), dataset)["left"]
    assert left["nominal"] == pytest.approx(before)


def test_a_folder_in_the_current_directory_is_not_the_robot_of_a_dataset_without_one(
    data, tmp_path, monkeypatch, capsys
):
    write_arm(tmp_path / "elsewhere" / "arm", toml=STIFF)
    monkeypatch.chdir(tmp_path / "elsewhere")
    assert main(["gap", str(without_robot(data).path)]) == 2  # no run here that keeps one
    message = "stores no robot, and the package has no 'arm'; say which robot it is"
    assert message in capsys.readouterr().err


def test_another_robots_simulator_is_refused_whatever_its_name(data, run, tmp_path):
    stranger = write_arm(tmp_path / "other" / "arm", toml=STIFF)
    for ask in (
        lambda: evaluate([run], data, stranger),
        lambda: gap_by_step(Candidate.load(run, stranger), data),
        lambda: side_by_side(data, data.entries[3], stranger, [run]),
    ):
        with pytest.raises(ModelError, match="simulator"):
            ask()


def test_an_identified_simulator_of_the_same_robot_is_another_start_and_the_same_baseline(
    arm, data, run, tmp_path
):
    fitted = arm.with_identified({"elbow": {"kp": 11.0}})
    second = untrained(
        tmp_path / "fitted", fitted, data, kind="mlp", train=("m0", "m1"), val=("m2",), test=("m3",)
    )
    found = evaluate([run, second], data, arm).result
    assert found["simulator_hash"] == model_hash(arm)
    errors = {name: m["mpjae"] for name, m in found["methods"].items()}
    assert errors["identified"] == pytest.approx(errors["identified+mlp"], rel=1e-6)


def test_the_dataset_keeps_its_robot(data, arm):
    assert model_hash(load_stored_robot(data.path, "arm")) == model_hash(arm)
    shutil.rmtree(arm.folder)
    assert open_dataset(data.path, None)[1].servo.kp.tolist() == [20.0, 20.0]


@pytest.mark.parametrize(
    "words",
    [
        ["import", "new.csv", "--unit-id", "a"],
        ["record", "--motion", "elbow-chirp-0", "--driver", "virtual"],
    ],
)
def test_the_dataset_takes_no_recordings_of_another_robot(
    data, tmp_path, monkeypatch, capsys, words
):
    stranger = write_arm(tmp_path / "other" / "arm", toml=STIFF)
    monkeypatch.chdir(tmp_path)
    (tmp_path / "new.csv").write_text("time,ctrl.elbow\n")
    where = ["--out", str(data.path), "--payload-mass", "0", "--robot", str(stranger.folder)]
    assert main([*words, *where]) == 2
    assert "its nominal simulator is" in " ".join(capsys.readouterr().err.split())
    assert not (data.path / "recordings").exists()
    assert load_stored_robot(data.path, "arm").servo.kp.tolist() == [20.0, 20.0]


def test_a_dataset_keeps_the_nominal_robot_where_an_identified_one_is_given(arm, tmp_path):
    made = Dataset.create(tmp_path / "d", arm.with_identified({"elbow": {"kp": 11.0}}))
    assert model_hash(load_robot(made.path / "robot")) == model_hash(arm)


def selected(runs, data):
    """The motions on which these runs are compared, and whether none of them has seen one."""
    entries, unseen = select_entries(runs, data)
    return [entry.meta.motion for entry in entries], unseen


@pytest.fixture
def other(arm, data, tmp_path):
    """A run that was trained on what the run is tested on."""
    return untrained(
        tmp_path / "other", arm, data, kind="mlp", train=("m2", "m3"), val=("m0",), test=("m1",)
    )


def test_a_run_is_evaluated_on_what_it_has_not_seen(data, run):
    assert selected([run], data) == (["m3"], True)
    assert select_entries([run], data, ("m3",))[1] is True


def test_recordings_that_any_run_was_fitted_to_are_not_unseen(arm, data, run, other):
    with pytest.raises(DatasetError, match="training"):
        select_entries([run, other], data)
    assert select_entries([run, other], data, ("m3",))[1] is False
    assert evaluate([run, other], data, arm, ("m3",)).result["unseen"] is False


def test_recordings_by_which_another_run_was_chosen_are_left_out(arm, data, run, tmp_path):
    less = untrained(
        tmp_path / "less", arm, data, kind="mlp", train=("m0",), val=("m1",), test=("m2", "m3")
    )
    assert selected([less], data)[0] == ["m2", "m3"]
    assert selected([less, run], data)[0] == ["m3"]


def test_a_motion_trained_on_is_not_unseen_when_another_unit_plays_it(arm, run, tmp_path):
    again = Dataset.create(tmp_path / "unit-b", arm)
    for i in (0, 3):
        again.append(record(arm, commands(80, i), f"m{i}", kp=0.7, unit="b"))
    assert selected([run], again) == (["m3"], True)
    assert select_entries([run], again, ("m0",))[1] is False


def test_the_rate_of_corrections_is_by_the_period_of_each_recording(arm, run, tmp_path):
    mixed = Dataset.create(tmp_path / "mixed", arm)
    mixed.append(record(replace(arm, dt=0.01), commands(80, 9, dt=0.01), "moving", kp=0.5))
    mixed.append(record(replace(arm, dt=0.02), np.zeros((80, 2)), "at rest", kp=0.5))
    random_run(run, arm, periods=(0.01, 0.02))
    found = evaluate([run], mixed, arm)
    rates = []
    for delta, rollout in zip(found.deltas["gaponet"], found.runs["gaponet"], strict=True):
        rates.append(np.abs(np.diff(delta, axis=0)).mean() / rollout.dt)
    assert found.result["delta"]["gaponet"]["rate"] == pytest.approx(np.mean(rates))


def test_a_dataset_of_nothing_but_trained_motions_is_not_unseen(arm, run, tmp_path):
    trained = Dataset.create(tmp_path / "unit-c", arm)
    trained.append(record(arm, commands(80, 0), "m0", kp=0.7, unit="c"))
    assert selected([run], trained) == (["m0"], False)


def test_a_split_by_unit_tests_motions_that_were_trained_on_with_other_units(arm, tmp_path):
    both = Dataset.create(tmp_path / "units", arm)
    for unit, kp in (("a", 0.5), ("b", 0.6)):
        for i in range(3):
            both.append(record(arm, commands(80, i), f"m{i}", kp=kp, unit=unit))
    run = untrained(tmp_path / "by-unit", arm, both, train=("m0", "m1"), val=("m2",))
    parts = {"train": {}, "val": {}, "test": {}}
    for entry in both.entries:
        part = "val" if entry.meta.motion == "m2" else "train"
        if entry.meta.unit_id == "b":
            part = "test"
        parts[part][entry.id] = entry.hash
    (run / "split.json").write_text(json.dumps(parts))
    entries, unseen = select_entries([run], both)
    assert {entry.hash for entry in entries} == set(parts["test"].values())
    assert unseen is True


def test_an_untrained_model_leaves_the_nominal_simulator_as_it_is(arm, data, run):
    methods = evaluate([run], data, arm).result["methods"]
    assert methods["gaponet"]["mpjae"] == pytest.approx(methods["nominal"]["mpjae"], rel=1e-3)


def test_a_simulator_that_transfer_was_not_measured_in_is_refused_before_anything_is_simulated(
    arm, data, run
):
    simulated = []
    with pytest.raises(ModelError, match="joint 'shoulder': kp, as a ratio"):
        evaluate(
            [run],
            data,
            arm,
            target=arm.with_servo(kp=100 * arm.servo.kp),
            progress=lambda done, total, note="": simulated.append(done),
        )
    assert not simulated
