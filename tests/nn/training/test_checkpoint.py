"""A run that was stopped and resumed is the run that was not."""

import json
from contextlib import nullcontext
from dataclasses import replace

import numpy as np
import pytest
from arm import recordings, write_arm, write_dataset
from runs import TINY_TRAINING, differences, read_checkpoint

from gaponet.base.errors import ModelError, UsageError
from gaponet.nn.training.config import Budget
from gaponet.nn.training.trainer import Trainer

WARM = 8 * 30
UPDATE = 8 * 8
STEPS = Budget(steps=2 * WARM + 6 * UPDATE)


@pytest.fixture(scope="module", autouse=True)
def short_fits():
    """Sensor predictors are fitted in a few steps: how well does not matter."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("gaponet.nn.training.sensor_fit.FIT_STEPS", 30)
        yield


@pytest.fixture(scope="module")
def world(tmp_path_factory):
    place = tmp_path_factory.mktemp("world")
    robot = write_arm(place / "arm")
    data = write_dataset(place / "data", robot, recordings(robot, 8, rows=60, kp=0.5))
    late = robot.with_identified({j: {"delay": 0.03} for j in robot.operated})
    Trainer(data, late, place / "whole", TINY_TRAINING, STEPS).run()
    return data, late, read_checkpoint(place / "whole")


def stop(stage, at):
    """Ctrl-C the at-th time that this stage is shown."""
    seen = 0

    def show(status):
        nonlocal seen
        seen += status.stage == stage
        if status.stage == stage and seen == at:
            raise KeyboardInterrupt

    return show


@pytest.mark.parametrize(("stage", "at"), [("pretraining", 5), ("pretraining", 15)])
def test_a_run_resumed_equals_one_that_was_never_stopped(world, tmp_path, stage, at):
    data, robot, whole = world
    begun = not (stage == "pretraining" and at < 10)
    with nullcontext() if begun else pytest.raises(ModelError, match="before"):
        Trainer(data, robot, tmp_path / "run", TINY_TRAINING, STEPS, show=stop(stage, at)).run()
    assert read_checkpoint(tmp_path / "run")["steps"] < whole["steps"]
    Trainer(data, robot, tmp_path / "run", TINY_TRAINING, STEPS, resume=True).run()
    again = read_checkpoint(tmp_path / "run")
    assert differences(whole, again) == []
    assert [json.loads(line) for line in (tmp_path / "run" / "progress.jsonl").open()] == again[
        "progress"
    ]


def test_a_run_killed_before_its_first_checkpoint_is_begun_again(world, tmp_path):
    data, robot, whole = world
    Trainer(data, robot, tmp_path / "run", replace(TINY_TRAINING, seed=1), STEPS)
    assert (tmp_path / "run" / "config.json").is_file()
    Trainer(data, robot, tmp_path / "run", TINY_TRAINING, STEPS).run()
    assert differences(whole, read_checkpoint(tmp_path / "run")) == []


def test_a_run_is_not_resumed_on_other_recordings(world, tmp_path):
    data, robot, _ = world
    Trainer(data, robot, tmp_path / "run", TINY_TRAINING, Budget(steps=0)).run()
    other = write_dataset(tmp_path / "other", robot, recordings(robot, 8, rows=50, kp=0.5))
    with pytest.raises(
        UsageError,
        match="recordings",
    ):
        Trainer(other, robot, tmp_path / "run", TINY_TRAINING, STEPS, resume=True)


def test_a_resumed_run_continues_with_gain_1(world, tmp_path, monkeypatch):
    data, robot, _ = world

    def halve(net, error, full_error):
        net.bounded.gain.fill_(0.5)
        return 0.5

    monkeypatch.setattr("gaponet.nn.training.trainer.choose_gain", halve)
    monkeypatch.setattr("gaponet.nn.training.validation.Validator.errors", better_each_time())
    warm = replace(TINY_TRAINING, pretraining=replace(TINY_TRAINING.pretraining, rounds=4))
    card = Trainer(data, robot, tmp_path / "run", warm, Budget(steps=WARM)).run().card
    assert card["gain"] == 0.5
    gains = []

    def watch(status):
        if status.stage == "ppo":
            gains.append(trainer.net.bounded.gain.item())

    trainer = Trainer(
        data,
        robot,
        tmp_path / "run",
        warm,
        Budget(steps=4 * WARM + UPDATE),
        resume=True,
        show=watch,
    )
    assert trainer.net.bounded.gain == 1.0
    trainer.run()
    assert set(gains) == {1.0}


def better_each_time():
    error = iter(1.0 / k for k in range(1, 1000))
    return lambda self, net, robot=None: np.full(len(self.sequences), next(error))


@pytest.mark.parametrize("content", [b"", b"PK", b"\x80\x05cos\nsystem\n(S'true'\ntR."])
def test_a_damaged_checkpoint_is_refused_in_one_line(world, tmp_path, content):
    dataset, robot = world[:2]
    (tmp_path / "run").mkdir()
    (tmp_path / "run" / "split.json").write_text("{}")
    (tmp_path / "run" / "checkpoint.pt").write_bytes(content)
    with pytest.raises(ModelError, match=r"checkpoint\.pt"):
        Trainer(dataset, robot, tmp_path / "run", TINY_TRAINING, STEPS, resume=True)
