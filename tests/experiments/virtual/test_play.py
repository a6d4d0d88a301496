"""Which runs an experiment compares."""

import json

import pytest

from gaponet.base.errors import UsageError
from gaponet.experiments.virtual import play as module
from gaponet.experiments.virtual.play import load_trained


class Model:
    """As much of a model as is asked for its name."""

    def __init__(self, folder):
        card = json.loads((folder / "model" / "card.json").read_text())
        self.card, self.config = card, type("Config", (), {"kind": card["kind"]})

    def require(self, robot):
        pass


@pytest.fixture
def runs(arm, tmp_path, monkeypatch):
    """A writer of run folders whose models are read without their networks."""
    fitted = arm.with_servos({"elbow": {"kp": 18.0}})
    monkeypatch.setattr(module.GapModel, "load", Model)
    monkeypatch.setattr(
        module, "corrected_robot", lambda run, robot: fitted if "identified" in run.name else robot
    )

    def write(name, kind, seed, changes=None):
        folder = tmp_path / "cells" / name
        (folder / "model").mkdir(parents=True)
        (folder / "model" / "card.json").write_text(json.dumps({"kind": kind, "seed": seed}))
        if changes is not None:
            (folder / "cell.json").write_text(json.dumps({"changes": changes}))
        return folder

    return write


def test_methods_are_sorted_and_models_with_changed_settings_are_skipped(arm, runs, tmp_path):
    runs("a", "gaponet", 1, [])
    runs("b", "gaponet", 0, [])
    runs("c", "mlp", 0, ["mlp_match=on"])
    runs("d", "gaponet", 0, ["sensors=predicted"])
    runs("identified", "gaponet", 0, [])
    expected = [("mlp", 0), ("gaponet", 0), ("gaponet", 1), ("identified+gaponet", 0)]
    for folder in (tmp_path, tmp_path / "cells"):
        assert [(t.method, t.seed) for t in load_trained([folder], arm)] == expected


def test_duplicate_seeds_and_empty_folders_are_refused(arm, runs, tmp_path):
    first, second = runs("a", "mlp", 0), runs("b", "mlp", 0)
    with pytest.raises(UsageError, match="MLP, full coupling seed 0 is there already"):
        load_trained([first, second], arm)
    with pytest.raises(UsageError, match="no run of gaponet train"):
        load_trained([tmp_path / "nothing"], arm)
