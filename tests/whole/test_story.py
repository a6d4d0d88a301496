"""The commands as a user types them: pair, gap, train, eval, report."""

import json
import re
import shutil

import numpy as np
import pytest
from arm import recordings, write_arm

from gaponet.cli.main import main
from gaponet.data.store import Dataset

TRAIN = """--budget 3500 --pretraining.rounds 2 --pretraining.num-envs 16 --pretraining.steps 60
--pretraining.gradient-steps 60 --ppo.num-envs 16 --ppo.num-steps 16 --ppo.epochs 1""".split()  # noqa: SIM905


@pytest.fixture(scope="module")
def place(tmp_path_factory):
    """A user's robot folder, a dataset, and two trained runs."""
    folder = tmp_path_factory.mktemp("story")
    robot = write_arm(folder / "arm")
    dataset = Dataset.create(folder / "data", robot)
    for sequence in recordings(robot, 8, rows=120, kp=0.5, delay=2):
        dataset.append(sequence)
    for kind in ("gaponet", "mlp"):
        where = [str(folder / "data"), "--out", str(folder / kind), "--model", kind]
        assert main(["train", *where, *TRAIN]) == 0
    return folder


def run(place, capsys, *words):
    capsys.readouterr()
    code = main([*words, "--json"])
    captured = capsys.readouterr()
    assert code == 0, captured.err
    return json.loads(captured.out), captured.err


def test_gap_prints_one_object_with_every_grouping(place, capsys):
    result, err = run(place, capsys, "gap", str(place / "data"))
    nominal = result["methods"]["nominal"]
    assert list(result["methods"]) == ["nominal"]
    assert nominal["mpjae"] > 0.001
    for group in ("by_joint", "by_motion", "by_payload", "by_unit", "by_horizon"):
        assert nominal[group]
    assert "MPJAE" in err  # people read it on stderr


def test_eval_puts_all_methods_side_by_side(place, capsys):
    result, _ = run(place, capsys, "eval", str(place / "gaponet"), str(place / "data"), "--also", str(place / "mlp"))
    assert list(result["methods"]) == ["nominal", "delay_offset", "mlp", "gaponet"]
    assert result["unseen"] is True
    assert result["virtual"] is True


def test_eval_of_a_training_motion_says_that_it_is_one(place, capsys):
    split = json.loads((place / "gaponet" / "split.json").read_text())
    motion = next(iter(split["train"])).split("-")[0]
    result, err = run(place, capsys, "eval", str(place / "gaponet"), str(place / "data"), "--motions", motion)
    assert result["unseen"] is False
    assert "not held-out" in err


def test_identify_writes_a_robot_folder_that_other_commands_take(place, capsys, tmp_path):
    fitted = tmp_path / "fitted"
    result, err = run(place, capsys, "identify", str(place / "data"), "--out", str(fitted), "--windows", "4")
    assert result["joints"]["elbow"]["kp"] == pytest.approx(10.0, rel=0.1)
    assert result["val_mpjae"]["identified"] < 0.2 * result["val_mpjae"]["nominal"]
    assert "N·m/rad" in err
    assert main(["gap", str(place / "data"), "--robot", str(fitted), "--json"]) == 0
    gap = json.loads(capsys.readouterr().out)
    assert gap["methods"]["identified"]["mpjae"] < 0.002 < gap["methods"]["nominal"]["mpjae"]
    assert gap["unseen"] is True


def test_runs_lists_both_with_the_best_first(place, capsys):
    assert main(["report", "--list", str(place), "--json"]) == 0
    captured = capsys.readouterr()
    found = json.loads(captured.out)["runs"]
    assert {r["run"] for r in found} == {"gaponet V", "mlp V"}
    assert all(r["virtual"] and r["finished"] for r in found)
    assert found[0]["val_ratio"] <= found[1]["val_ratio"]
    assert "VIRTUAL" in captured.err
    assert main(["report", "--list", str(place / "data")]) == 2
    assert "no run here or below" in capsys.readouterr().err


def test_the_gap_with_a_run_says_what_each_step_removes(place, capsys):
    """The virtual arm is late and soft: delay and model remove error, and what is left is what eval finds."""
    found, err = run(place, capsys, "gap", str(place / "data"), "--run", str(place / "gaponet"))
    evaluated, _ = run(place, capsys, "eval", str(place / "gaponet"), str(place / "data"))
    assert list(found["left"]) == ["nominal", "delay", "offset", "gaponet"]
    assert found["left"]["delay"] < found["left"]["nominal"]
    for step, method in (("nominal", "nominal"), ("offset", "delay_offset"), ("gaponet", "gaponet")):
        assert found["left"][step] == pytest.approx(evaluated["methods"][method]["mpjae"])
    assert found["floor"]["both"] is None  # its readings are continuous, and no motion was recorded twice
    assert "–" in err
    assert "VIRTUAL" in err
    assert (place / "gaponet" / "gap.png").stat().st_size > 10_000


def test_a_adapted_unit_is_shown_without_and_with(place, capsys):
    shutil.copytree(place / "gaponet", place / "adapted")
    found, err = run(place, capsys, "adapt", str(place / "adapted"), str(place / "data"), "--seconds", "8")
    assert found["after"] <= found["before"]
    assert "N·m/rad" in err
    result, _ = run(place, capsys, "eval", str(place / "adapted"), str(place / "data"))
    assert list(result["methods"]) == ["nominal", "delay_offset", "gaponet", "adapted"]
    assert result["adapted_units"] == [found["unit_id"]]
    assert result["unseen"] is True


def test_a_run_uses_the_units_adaptation_and_refuses_a_payload_never_trained_on(place, capsys):
    shutil.copytree(place / "gaponet", place / "mine")
    found, _ = run(place, capsys, "adapt", str(place / "mine"), str(place / "data"), "--seconds", "8")
    motion = place / "sway.npz"
    np.savez(motion, joint_names=["shoulder", "elbow"], ctrl=np.linspace([0.0, 0.0], [0.2, 0.3], 40), dt=0.02)
    words = ["run", "--motion", str(motion), "--model", str(place / "mine"), "--fast", "--yes", "--blend", "0.2"]
    played, err = run(place, capsys, *words, "--payload-mass", "0")
    assert played["adapted"] is None
    assert f"adaptations of {found['unit_id']}, none of which is used: --unit-id says which" in err
    played, err = run(place, capsys, *words, "--payload-mass", "0", "--unit-id", found["unit_id"])
    assert played["adapted"] == found["unit_id"]
    assert main([*words, "--robot", str(place / "arm"), "--payload-mass", "0.3"]) == 2
    assert "0.3 kg is outside" in capsys.readouterr().err


def test_the_report_is_one_offline_page(place, capsys):
    result, _ = run(place, capsys, "report", str(place / "gaponet"), "--also", str(place / "mlp"))
    page = (place / "gaponet" / "report.html").read_text(encoding="utf-8")
    assert result["report"].endswith("report.html")
    assert "VIRTUAL robot" in page
    assert "Where the gap comes from" in page
    assert "these numbers say nothing about real hardware" in page
    assert not re.findall(r'(?:src|href)="(?!data:|#)[^"]*', page)
    assert "http" not in re.sub(r"http://www\.w3\.org|xmlns[^ >]*|http://purl\.org|https://matplotlib\.org", "", page)


@pytest.mark.parametrize(
    ("words", "complaint"),
    [
        (["gap", "{}/nowhere"], "not a dataset"),
        (["gap", "{}/data", "--motions", "dance"], "no motion 'dance'"),
        (["eval", "{}/data", "{}/data"], "give a run folder"),
        (["eval", "{}/gaponet", "{}/data", "--also", "{}/gaponet"], "a second run of GAPONet"),
        (["train", "{}/data", "--out", "{}/gaponet"], "--resume"),
        (["train", "{}/data", "--out", "{}/new", "--budget", "soon"], "--budget soon"),
        (["train", "{}/data", "--out", "{}/new", "--resume"], "nothing to resume"),
        (["report", "{}/data"], "give a run folder"),
        (["experiment", "compare", "{}/data", "--out", "{}/new", "--models", "lstm"], "no model 'lstm'; there are"),
        (["experiment", "compare", "{}/data", "--out", "{}/new", "--models", "identified+mlp"], "add --identify"),
        (["adapt", "{}/gaponet", "{}/data", "--unit", "nobody"], "holds units"),
        (["gap", "{}/data", "--robot", "h1_2"], "holds robot 'arm'"),
    ],
    ids=lambda value: value if isinstance(value, str) else value[0],
)  # fmt: skip
def test_mistakes_get_one_line_and_exit_code_2(place, capsys, words, complaint):
    words = [w.format(place) for w in words]
    if "--robot" not in words:
        words += ["--robot", str(place / "arm")]
    capsys.readouterr()
    assert main(words) == 2
    last = capsys.readouterr().err.strip().splitlines()[-1]
    assert complaint in last
    assert "Traceback" not in last
    assert not (place / "new").exists()
