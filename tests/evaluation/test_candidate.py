"""An identified robot folder is judged as a run is, and a network is told apart from what was
identified.
"""

import json
import shutil
from dataclasses import replace

import pytest
from arm import commands, record, recordings, write_dataset
from runs import untrained

import gaponet as gp
from gaponet.base.errors import DatasetError, RobotError, UsageError
from gaponet.cli.main import main
from gaponet.data.store import Dataset
from gaponet.evaluation.candidate import Candidate, fitted_to, read_origin, select_entries
from gaponet.evaluation.verdict import network_gain, next_step, verdict
from gaponet.report.view.side_by_side import select_entry, side_by_side
from gaponet.robot.folder import PROVENANCE_FILE, STORED_ROBOT, save_robot

QUICK = gp.IdentifyOptions(windows=2, terms=(), table=False, threads=1)


@pytest.fixture
def data(arm, tmp_path):
    made = Dataset.create(tmp_path / "data", arm)
    for sequence in recordings(arm, 3, rows=60, kp=0.5):
        made.append(sequence)
    return made


@pytest.fixture
def fitted(arm, data, tmp_path):
    """Identified on motion0, judged on motion1."""
    robot = arm.with_identified(
        {"elbow": {"kp": 10.0}, "shoulder": {"kp": 10.0, "frictionloss": 0.06}}
    )
    save_robot(robot, tmp_path / "fitted")
    parts = {p: {e.id: e.hash} for p, e in zip(("train", "val", "test"), data.entries, strict=True)}
    motions = {part: [f"motion{i}"] for i, part in enumerate(parts)}
    origin = {"dataset": "../data", "parts": parts, "motions": motions, "val_mpjae": {}}
    (tmp_path / "fitted" / PROVENANCE_FILE).write_text(json.dumps(origin))
    return tmp_path / "fitted"


def test_an_identified_folder_is_evaluated_like_a_run(fitted, data):
    found = gp.evaluate(fitted, data).to_dict()
    assert list(found["methods"]) == ["nominal", "identified"]
    assert found["motions"] == ["motion2"]
    assert found["unseen"] is True
    assert found["ratio_to_nominal"]["identified"] < 0.5


def test_an_identified_folder_has_a_gap_and_its_picture_without_training(fitted, data):
    by_cause = gp.gap(data, robot=fitted).to_dict()
    assert list(by_cause["left"]) == ["nominal", "gain", "friction", "creep"]
    error = gp.evaluate(fitted, data).to_dict()["methods"]["identified"]["mpjae"]
    assert by_cause["methods"]["identified"]["mpjae"] == pytest.approx(error)
    assert (fitted / "gap.png").is_file()


def test_a_dataset_that_keeps_an_identified_robot_has_its_gap_by_cause(fitted, data, capsys):
    kept = data.path / STORED_ROBOT
    shutil.rmtree(kept)
    shutil.copytree(fitted, kept)
    assert main(["gap", str(data.path)]) == 0
    said = " ".join(capsys.readouterr().out.split())
    assert "Mean |error| after each step" in said
    assert f"next: gaponet export {kept}" in said


def test_an_identified_folder_is_seen_beside_its_recordings(fitted, data):
    shown = side_by_side(data, select_entry(data, (fitted,)), gp.load_robot(fitted))
    methods = [motion.method for motion in shown.motions]
    assert methods == ["target", "nominal", "identified", "recorded"]
    assert shown.seen is False


def test_eval_of_an_identified_folder_names_the_next_command(fitted, data, capsys):
    assert main(["eval", str(fitted), str(data.path)]) == 0
    said = " ".join(capsys.readouterr().out.split())
    assert "After identification the error is" in said
    assert f"next: gaponet export {fitted}" in said


def test_an_evaluation_can_be_limited_to_one_unit(fitted, data):
    assert select_entries([fitted], data, units=("a",)) == select_entries([fitted], data)
    with pytest.raises(DatasetError, match="other"):
        select_entries([fitted], data, units=("other",))


def test_recordings_of_an_adaptation_are_not_unseen(fitted, data, arm, tmp_path):
    other_day = write_dataset(
        tmp_path / "today", arm, recordings(arm, 4, rows=400, kp=0.6, unit="b")
    )
    gp.adapt_robot(fitted, other_day, out=tmp_path / "adapted")
    entries, unseen = select_entries([tmp_path / "adapted"], other_day)
    assert len(entries) == 4
    assert unseen is False
    assert select_entries([fitted], other_day)[1] is True
    assert select_entries([tmp_path / "adapted"], data)[1] is True


def test_a_motion_that_the_chosen_unit_did_not_play_is_refused(fitted, data, arm):
    data.append(record(arm, commands(60, 7), "of-b-alone", unit="b"))
    with pytest.raises(DatasetError):
        select_entries([fitted], data, ("motion2",), ("b",))


def test_a_robot_identified_from_an_identified_one_keeps_its_split_and_what_was_seen_before(
    fitted, data, tmp_path
):
    origin_file = fitted / PROVENANCE_FILE
    before = json.loads(origin_file.read_text())
    before["parts"]["train"]["elsewhere"] = "hash of elsewhere"
    before["motions"]["train"].append("elsewhere")
    origin_file.write_text(json.dumps(before))
    gp.identify(data, robot=fitted, out=tmp_path / "again", options=QUICK)
    origin = read_origin(tmp_path / "again")
    train, val = (set(origin["parts"][part].values()) for part in ("train", "val"))
    assert val
    assert not train & val
    assert train | val | {"hash of elsewhere"} <= set(fitted_to(origin)["hashes"])
    assert "elsewhere" in fitted_to(origin)["motions"]


def test_recordings_of_a_held_out_unit_are_neither_fitted_nor_do_they_validate(data, arm, tmp_path):
    for sequence in recordings(arm, 3, rows=60, kp=0.7, unit="b"):
        data.append(sequence)
    gp.identify(data, out=tmp_path / "of_a", options=replace(QUICK, holdout_units=("b",)))
    parts = read_origin(tmp_path / "of_a")["parts"]
    fitted = parts["train"].keys() | parts["val"].keys()
    assert fitted
    assert {entry.meta.unit_id for entry in data.entries if entry.id in fitted} == {"a"}


def test_a_folder_that_does_not_say_what_it_was_fitted_to_has_no_held_out_recordings(fitted, data):
    (fitted / PROVENANCE_FILE).unlink()
    assert select_entries([fitted], data) == (data.entries, False)
    (fitted / PROVENANCE_FILE).write_text('{"parts": 3}')
    with pytest.raises(RobotError, match=r"identified\.json"):
        select_entries([fitted], data)


def test_recordings_that_a_runs_robot_was_identified_from_are_not_unseen(fitted, data, tmp_path):
    run = untrained(
        tmp_path / "run", gp.load_robot(fitted), data, train=("motion2",), val=(), test=("motion0",)
    )
    assert select_entries([run], data, ("motion0",))[1] is False


def test_motions_that_a_runs_robot_was_identified_from_are_not_unseen(fitted, data, arm, tmp_path):
    run = untrained(tmp_path / "run", gp.load_robot(fitted), data, test=("motion2",))
    of_b = write_dataset(tmp_path / "b", arm, recordings(arm, 3, rows=60, unit="b"))
    entries, _ = select_entries([run], of_b)
    assert [entry.meta.motion for entry in entries] == ["motion2"]


def test_a_robot_that_is_not_identified_is_refused(arm, data, tmp_path):
    save_robot(arm, tmp_path / "plain")
    with pytest.raises(UsageError, match="identified"):
        Candidate.load(tmp_path / "plain", arm)


def scores(**errors):
    """Metrics of methods from their errors in two motions, mrad."""
    found = {}
    for name, (first, second) in errors.items():
        mean = {"mpjae": (first + second) / 2e3}
        motions = {"m0": {"mpjae": first / 1e3}, "m1": {"mpjae": second / 1e3}}
        metrics = {"by_joint": {"elbow": mean}, "by_independent_motion": motions}
        found[name.replace("identified_", "identified+")] = mean | metrics
    return found


NOMINAL = (20.0, 18.0)
IDENTIFIED = (3.0, 3.2)


def test_the_verdict_states_the_gain_of_a_network_even_if_it_is_zero(tmp_path):
    useless = scores(nominal=NOMINAL, identified=IDENTIFIED, identified_gaponet=IDENTIFIED)
    _, identification, network, *_ = verdict(useless)
    error = "After identification the error is 3.10 mrad, 84 % less, on 2 independent motions."
    assert identification == error
    gain = "reduces the error of identification by 0.00 ± 0.00 mrad: leave the network out"
    assert gain in network
    assert next_step(useless, "data", tmp_path) == f"gaponet export {tmp_path / 'robot'} --to mjcf"


def test_the_verdict_states_the_gain_of_a_useful_network(tmp_path):
    useful = scores(nominal=NOMINAL, identified=IDENTIFIED, identified_gaponet=(2.0, 2.1))
    assert "reduces the error of identification by 1.05 ± 0.05 mrad, 34 %." in verdict(useful)[2]
    assert next_step(useful, "data", tmp_path) == f"gaponet report {tmp_path}"


@pytest.mark.parametrize(
    "network",
    [
        (2.97, 3.168),  # 1 % less, of both motions
        (2.0, 3.6),  # 10 % less, 0.3 ± 0.7 mrad
    ],
)
def test_a_network_with_a_gain_of_1_percent_or_below_its_standard_error_is_left_out(network):
    found = scores(nominal=NOMINAL, identified=IDENTIFIED, identified_gaponet=network)
    assert "leave the network out" in verdict(found)[2]


def test_the_gain_of_a_network_on_its_own_is_over_the_nominal_simulator():
    alone = scores(nominal=NOMINAL, mlp=(9.0, 8.0))
    assert network_gain(alone, "mlp").base == "nominal"


def test_the_gain_of_a_network_is_over_delay_and_offset_where_these_are_nearer_to_the_robot():
    found = scores(nominal=NOMINAL, delay_offset=(10.0, 9.0), mlp=(9.0, 8.0))
    gain = network_gain(found, "mlp")
    assert gain.base == "delay_offset"
    assert gain.reduction == pytest.approx(1e-3)


def test_after_the_nominal_simulator_the_next_step_is_identification():
    assert next_step(scores(nominal=NOMINAL), "data") == "gaponet identify data --out my_robot"
