"""Choice of the network by validation, with trainings that only write their files."""

import json
from types import SimpleNamespace

import pytest

from gaponet.base.errors import UsageError
from gaponet.base.files import lock_folder
from gaponet.nn.artifact import GapModel
from gaponet.nn.training import selection
from gaponet.nn.training.selection import candidate_errors, train_best

ERRORS = {"gaponet": 3.0, "shared_mlp": 1.0, "mlp": 2.0}


@pytest.fixture(autouse=True)
def without_trees(monkeypatch):
    monkeypatch.setattr(selection, "trees_available", lambda: False)


@pytest.fixture
def run(tmp_path):
    """A run folder, locked as gaponet train locks it."""
    with lock_folder(tmp_path / "run", "run"):
        yield tmp_path / "run"


class Trainings:
    """Writes a run folder per call; ends early for one kind."""

    def __init__(self, interrupted="", later=None, **errors):
        """later: Error of a network after the rest of the budget."""
        self.calls = []
        self.interrupted = interrupted
        self.later = later
        self.errors = ERRORS | errors

    def __call__(self, kind, run, share, spent, resume):
        self.calls.append((kind, run.name, round(share, 6), round(spent, 6), resume))
        run.mkdir(parents=True, exist_ok=True)
        (run / "checkpoint.pt").write_text(kind)
        (run / "config.json").write_text(json.dumps({"model": {"kind": kind}}))
        error = self.later if resume and self.later is not None else self.errors[kind]
        card = {"interrupted": kind == self.interrupted, "val_mpjae": {"model": error}}
        return SimpleNamespace(card=card)


def test_the_best_kind_gets_the_rest_of_the_budget(run):
    train = Trainings()
    train_best(run, False, train)
    assert train.calls == [
        ("gaponet", "gaponet", 0.2, 0.0, False),
        ("shared_mlp", "shared_mlp", 0.2, 0.2, False),
        ("mlp", "mlp", 0.2, 0.4, False),
        ("shared_mlp", "run", 0.6, 0.4, True),
    ]
    assert candidate_errors(run) == ERRORS
    assert (run / "checkpoint.pt").read_text() == "shared_mlp"


def test_an_interrupted_choice_leaves_the_best_so_far_and_goes_on_where_it_was(run, monkeypatch):
    monkeypatch.setattr(GapModel, "load", classmethod(lambda cls, run: run))
    train = Trainings(interrupted="shared_mlp")
    train_best(run, False, train)
    assert [kind for kind, *_ in train.calls] == ["gaponet", "shared_mlp"]
    assert (run / "checkpoint.pt").read_text() == "gaponet"
    with pytest.raises(UsageError, match="already"):
        train_best(run, False, train)
    again = Trainings()
    train_best(run, True, again)
    assert again.calls == [
        ("shared_mlp", "shared_mlp", 0.2, 0.2, True),
        ("mlp", "mlp", 0.2, 0.4, False),
        ("shared_mlp", "run", 0.6, 0.4, True),
    ]
    assert (run / "checkpoint.pt").read_text() == "shared_mlp"


def test_a_candidate_that_was_interrupted_goes_on_from_the_end_of_its_own_training(
    run, monkeypatch
):
    monkeypatch.setattr(GapModel, "load", classmethod(lambda cls, run: run))
    train_best(run, False, Trainings(interrupted="gaponet"))
    (run / "checkpoint.pt").write_text("gaponet, interrupted")
    again = Trainings(gaponet=0.5)
    begins_with = []

    def train(kind, folder, *budget):
        if folder == run:
            begins_with.append((folder / "checkpoint.pt").read_text())
        return again(kind, folder, *budget)

    train_best(run, True, train)
    assert begins_with == ["gaponet"]


def test_a_run_that_went_on_with_the_best_candidate_is_not_replaced_by_it(run):
    train_best(run, False, Trainings())
    (run / "checkpoint.pt").write_text("shared_mlp, later")
    begins_with = []

    def train(kind, folder, *budget):
        begins_with.append((folder / "checkpoint.pt").read_text())
        return Trainings()(kind, folder, *budget)

    train_best(run, True, train)
    assert begins_with == ["shared_mlp, later"]


def test_a_run_of_one_kind_is_resumed_with_its_kind(tmp_path):
    with pytest.raises(UsageError, match="nothing"):
        train_best(tmp_path / "none", True, Trainings())
    first = Trainings()
    train = Trainings()
    first("mlp", tmp_path / "run", 1.0, 0.0, False)
    train_best(tmp_path / "run", True, train)
    assert train.calls == [("mlp", "run", 1.0, 0.0, True)]


@pytest.mark.parametrize(("later", "chosen"), [(0.6, "trees"), (0.4, "shared_mlp")])
def test_trees_win_if_the_best_network_does_not_pass_them_with_the_rest_of_the_budget(
    run, monkeypatch, later, chosen
):
    monkeypatch.setattr(selection, "trees_available", lambda: True)
    monkeypatch.setattr(GapModel, "load", classmethod(lambda cls, run: run))
    train = Trainings(trees=0.5, later=later)
    train_best(run, False, train)
    assert train.calls[3:] == [
        ("trees", "trees", 0.2, 0.6, False),
        ("shared_mlp", "shared_mlp", 0.4, 0.6, True),
    ]
    assert (run / "checkpoint.pt").read_text() == chosen


def test_a_copy_of_the_best_run_that_is_interrupted_is_made_again(run, monkeypatch):
    def fail(*paths):
        raise OSError(28, "No space left on device")

    with monkeypatch.context() as full:
        full.setattr("gaponet.base.files.os.replace", fail)
        full.setattr(selection, "write_json", write_errors)
        with pytest.raises(OSError, match="space"):
            train_best(run, False, Trainings())
    assert not (run / "checkpoint.pt").exists()
    again = Trainings()
    train_best(run, True, again)
    assert again.calls == [("shared_mlp", "run", 0.6, 0.4, True)]
    assert (run / "checkpoint.pt").read_text() == "shared_mlp"


def write_errors(path, errors):
    path.write_text(json.dumps(errors))
