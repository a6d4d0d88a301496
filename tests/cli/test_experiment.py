"""gaponet experiment as a user types it."""

import json
from types import SimpleNamespace

import pytest
from arm import recordings, write_arm

from gaponet.cli.main import main
from gaponet.data.store import Dataset

TRAIN = """--seeds 1 --budget 640 --pretraining.rounds 1 --pretraining.num-envs 16 --pretraining.steps 40
--pretraining.gradient-steps 20""".split()  # noqa: SIM905


@pytest.fixture(scope="module")
def place(tmp_path_factory):
    folder = tmp_path_factory.mktemp("experiment")
    robot = write_arm(folder / "arm")
    dataset = Dataset.create(folder / "data", robot)
    for sequence in recordings(robot, 8, rows=60, kp=0.5, delay=2):
        dataset.append(sequence)
    return folder


def test_an_experiment_trains_writes_everything_and_goes_on_where_it_was(
    place, capsys, monkeypatch
):
    def identify(train, robot, val, progress):
        return SimpleNamespace(
            robot=robot.with_servos({joint: {"kp": 10.0} for joint in robot.operated})
        )

    monkeypatch.setattr("gaponet.experiments.compare.identify", identify)
    words = ["experiment", "compare", str(place / "data"), "--out", str(place / "out"), "--robot", str(place / "arm"),
             "--models", "mlp", *TRAIN, "--identify", "--json"]  # fmt: skip
    assert main([*words, "--seeds", "0"]) == 2
    assert "--seeds is at least 1" in capsys.readouterr().err
    assert main(words) == 0
    captured = capsys.readouterr()
    found = json.loads(captured.out)
    assert "1 trainings (1 settings), 0 there already" in captured.err
    totals = {row[0]: row[2] for row in found["tables"]["totals"]["rows"]}
    assert list(totals) == [
        "nominal simulator",
        "delay + offset",
        "identification",
        "MLP, full coupling",
    ]
    assert totals["identification"]["mean"] < totals["nominal simulator"]["mean"]
    assert found["facts"]["unseen"] is True
    assert found["virtual"].startswith("VIRTUAL arm")
    assert str(place) not in found["facts"]["command"]
    for name in (
        "compare.md",
        "compare.csv",
        "compare.svg",
        "compare.png",
        "report.html",
        "cells/mlp-0/cell.json",
    ):
        assert (place / "out" / name).is_file(), name
    assert main(words) == 0
    captured = capsys.readouterr()
    assert "1 there already" in captured.err
    assert json.loads(captured.out)["tables"] == found["tables"]
    assert main([*words, "--budget", "641"]) == 2
    assert "another budget" in capsys.readouterr().err
