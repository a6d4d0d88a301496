"""Commands on a trained run, as a user types them: train, gap, eval, adapt, run, and the list of
runs.
"""

import json

import numpy as np
import pytest
from arm import recordings, write_arm

from gaponet.cli.main import main
from gaponet.data.store import Dataset

TRAIN = """--model gaponet --budget 3500
--pretraining.rounds 2 --pretraining.num-envs 16 --pretraining.steps 60
--pretraining.gradient-steps 60
--ppo.num-envs 16 --ppo.num-steps 16 --ppo.epochs 1""".split()  # noqa: SIM905


@pytest.fixture(scope="module")
def place(tmp_path_factory):
    """A user's robot folder, a dataset, and a trained run."""
    folder = tmp_path_factory.mktemp("story")
    robot = write_arm(folder / "arm")
    dataset = Dataset.create(folder / "data", robot)
    for sequence in recordings(robot, 8, rows=120, kp=0.5, delay=2):
        dataset.append(sequence)
    assert main(["train", str(folder / "data"), "--out", str(folder / "gaponet"), *TRAIN]) == 0
    return folder


def run(place, capsys, *words):
    capsys.readouterr()
    code = main([*(word.format(place) for word in words), "--json"])
    captured = capsys.readouterr()
    assert code == 0, captured.err
    return json.loads(captured.out), captured.err


def test_gap_and_eval_print_one_object_and_show_people_the_tables(place, capsys):
    result, err = run(place, capsys, "gap", "{}/data")
    assert list(result["methods"]) == ["nominal"]
    assert "mean |error|, mrad" in err
    split = json.loads((place / "gaponet" / "split.json").read_text())
    motion = next(iter(split["train"])).split("-")[0]
    result, err = run(place, capsys, "eval", "{}/gaponet", "{}/data", "--motions", motion)
    assert list(result["methods"]) == ["nominal", "delay_offset", "gaponet"]
    assert result["unseen"] is False
    assert "no test errors" in err


def test_the_list_of_runs_says_which_are_of_virtual_robots(place, capsys):
    result, err = run(place, capsys, "report", "--list", "{}")
    (found,) = result["runs"]
    assert (found["run"], found["virtual"], found["finished"]) == ("gaponet V", True, True)
    assert "VIRTUAL" in err
    assert main(["report", "--list", str(place / "data")]) == 2
    assert "no run here or below" in capsys.readouterr().err


def test_an_adapted_unit_is_evaluated_with_and_without_and_run_by_its_name(place, capsys):
    adapted, err = run(place, capsys, "adapt", "{}/gaponet", "{}/data", "--seconds", "8")
    assert adapted["after"] <= adapted["before"]
    assert "N·m/rad" in err
    result, _ = run(place, capsys, "eval", "{}/gaponet", "{}/data")
    assert list(result["methods"]) == ["nominal", "delay_offset", "gaponet", "adapted"]
    assert (result["adapted_units"], result["unseen"]) == ([adapted["unit_id"]], True)
    motion = place / "sway.npz"
    np.savez(
        motion,
        joint_names=["shoulder", "elbow"],
        ctrl=np.linspace([0.0, 0.0], [0.2, 0.3], 40),
        dt=0.02,
    )
    words = [
        "run",
        "--motion",
        str(motion),
        "--model",
        "{}/gaponet",
        "--fast",
        "--yes",
        "--blend",
        "0.2",
    ]
    played, err = run(place, capsys, *words, "--payload-mass", "0")
    assert played["adapted"] is None
    assert (
        f"adaptations of {adapted['unit_id']}, none of which is used: --unit-id says which" in err
    )
    played, err = run(place, capsys, *words, "--payload-mass", "0", "--unit-id", adapted["unit_id"])
    assert played["adapted"] == adapted["unit_id"]
    words = [word.format(place) for word in words]
    assert main([*words, "--robot", str(place / "arm"), "--payload-mass", "0.3"]) == 2
    assert "0.3 kg is outside" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("words", "complaint"),
    [
        (["gap", "{}/data", "--motions", "dance"], "no motion 'dance'"),
        (["eval", "{}/data", "{}/data"], "give a run folder"),
        (["eval", "{}/gaponet", "{}/data", "--also", "{}/gaponet"], "a second run of GAPONet"),
        (["train", "{}/data", "--out", "{}/gaponet"], "--resume"),
        (["train", "{}/data", "--out", "{}/new", "--budget", "soon"], "--budget soon"),
        (["train", "{}/data", "--out", "{}/new", "--resume"], "nothing to resume"),
        (["report", "{}/data"], "give a run folder"),
        (["experiment", "paper", "{}/data", "--out", "{}/new", "--fleet", "nobody"], "nobody"),
        (["experiment", "paper", "{}/data", "--out", "{}/new", "--unit", "virtual-9"], "virtual-9"),
        (["adapt", "{}/gaponet", "{}/data", "--unit", "nobody"], "holds units"),
        (["gap", "{}/data", "--robot", "h1_2"], "holds robot 'arm'"),
    ],
    ids=lambda value: value if isinstance(value, str) else value[0],
)
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
