"""An identified robot folder is judged as a run is, and a network is told apart from what was
identified.
"""

import json

import pytest
from arm import recordings
from runs import untrained

import gaponet as gp
from gaponet.base.errors import DatasetError, RobotError, UsageError
from gaponet.cli.main import main
from gaponet.data.store import Dataset
from gaponet.evaluation.candidate import Candidate, select_entries
from gaponet.evaluation.verdict import network_gain, next_step, verdict
from gaponet.report.view.side_by_side import select_entry, side_by_side
from gaponet.robot.folder import PROVENANCE_FILE, save_robot


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


def test_an_identified_folder_is_accepted_like_a_run(fitted, data, arm, capsys):
    found = gp.evaluate(fitted, data).to_dict()
    assert (list(found["methods"]), found["motions"], found["unseen"]) == (
        ["nominal", "identified"],
        ["motion2"],
        True,
    )
    assert found["ratio_to_nominal"]["identified"] < 0.5
    by_cause = gp.gap(data, robot=fitted).to_dict()  # no training for the picture
    assert list(by_cause["left"]) == ["nominal", "gain", "friction", "creep"]
    assert by_cause["methods"]["identified"]["mpjae"] == pytest.approx(
        found["methods"]["identified"]["mpjae"]
    )
    assert (fitted / "gap.png").is_file()
    shown = side_by_side(data, select_entry(data, (fitted,)), gp.load_robot(fitted))
    assert [m.method for m in shown.motions] == ["target", "nominal", "identified", "recorded"]
    assert shown.seen is False
    assert main(["eval", str(fitted), str(data.path)]) == 0
    said = " ".join(capsys.readouterr().out.split())
    assert "After identification the error is" in said
    assert f"next: gaponet export {fitted}" in said


def test_an_evaluation_can_be_limited_to_one_unit(fitted, data):
    assert select_entries([fitted], data, units=("a",)) == select_entries([fitted], data)
    with pytest.raises(DatasetError, match="other"):
        select_entries([fitted], data, units=("other",))


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


def test_a_robot_that_is_not_identified_is_refused(arm, data, tmp_path):
    save_robot(arm, tmp_path / "plain")
    with pytest.raises(UsageError, match="identified"):
        Candidate.load(tmp_path / "plain", arm)


def scores(**errors):
    """Metrics of methods from their errors in two motions, mrad."""
    joint = lambda e: {"elbow": {"mpjae": e / 1e3}}  # noqa: E731
    return {
        name.replace("_", "+"): {
            "mpjae": sum(e) / 2e3,
            "by_joint": joint(sum(e) / 2),
            "by_independent_motion": {f"m{i}": {"mpjae": x / 1e3} for i, x in enumerate(e)},
        }
        for name, e in errors.items()
    }


def test_the_verdict_states_the_gain_of_a_network_even_if_it_is_zero(tmp_path):
    useless = scores(nominal=(20.0, 18.0), identified=(3.0, 3.2), identified_gaponet=(3.0, 3.2))
    said = verdict(useless)
    assert (
        said[1]
        == "After identification the error is 3.10 mrad, 84 % less, on 2 independent motions."
    )
    assert (
        "reduces the error of identification by 0.00 ± 0.00 mrad: leave the network out" in said[2]
    )
    assert next_step(useless, "data", tmp_path) == f"gaponet export {tmp_path / 'robot'} --to mjcf"
    useful = scores(nominal=(20.0, 18.0), identified=(3.0, 3.2), identified_gaponet=(2.0, 2.1))
    assert "reduces the error of identification by 1.05 ± 0.05 mrad, 34 %." in verdict(useful)[2]
    assert next_step(useful, "data", tmp_path) == f"gaponet report {tmp_path}"
    alone = scores(nominal=(20.0, 18.0), mlp=(9.0, 8.0))
    assert network_gain(alone, "mlp").base == "nominal"
    assert next_step(scores(nominal=(20.0, 18.0)), "data") == "gaponet identify data --out my_robot"
