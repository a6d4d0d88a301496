"""A run that was stopped and resumed is the run that was not."""

import json
from contextlib import nullcontext
from dataclasses import replace

import numpy as np
import pytest
import torch
from arm import recordings, write_arm

from gaponet.base.errors import ModelError, UsageError
from gaponet.data.store import Dataset
from gaponet.nn.config import ModelConfig
from gaponet.nn.training.checkpoint import RENAMED
from gaponet.nn.training.config import Budget, PPOConfig, PretrainingConfig, TrainConfig
from gaponet.nn.training.trainer import Trainer

TINY = TrainConfig(
    model=ModelConfig(history=2, num_probes=4, branch_hidden=(16,), trunk_hidden=(16,), sensor_hidden=(16,)),
    pretraining=PretrainingConfig(rounds=2, num_envs=8, steps=30, gradient_steps=10, batch_size=64),
    ppo=PPOConfig(num_envs=8, num_steps=8, epochs=1, mini_batches=2, critic_warmup=1, explained=-1e9),
    episode_s=0.5,
    validate_every=2,
)
WARM, UPDATE = 8 * 30, 8 * 8
STEPS = Budget(steps=2 * WARM + 6 * UPDATE)


@pytest.fixture(scope="module")
def world(tmp_path_factory):
    place = tmp_path_factory.mktemp("world")
    robot = write_arm(place / "arm")
    data = Dataset.create(place / "data", robot)
    for sequence in recordings(robot, 8, rows=60, kp=0.5):
        data.append(sequence)
    late = robot.with_servos({j: {"delay": 0.03} for j in robot.operated})
    Trainer.prepare(data, late, place / "whole", TINY, STEPS).run()
    return data, late, memory(place / "whole")


def memory(run):
    return torch.load(run / "checkpoint.pt", weights_only=True)


def differences(a, b, where=""):
    """Paths at which two nested states differ."""
    if isinstance(a, dict):
        assert a.keys() == b.keys()
        return [d for k in a for d in differences(a[k], b[k], f"{where}/{k}")]
    if isinstance(a, (list, tuple)):
        return [d for i, (x, y) in enumerate(zip(a, b, strict=True)) for d in differences(x, y, f"{where}/{i}")]
    same = torch.equal(a, b) if isinstance(a, torch.Tensor) else a == b or (a != a and b != b)
    return [] if same or where.endswith("/seconds") else [where]


def stop(stage, at):
    """Ctrl-C the at-th time that this stage is shown."""
    seen = 0

    def show(status):
        nonlocal seen
        seen += status.stage == stage
        if status.stage == stage and seen == at:
            raise KeyboardInterrupt

    return show


@pytest.mark.parametrize(("stage", "at"), [("pretraining", 5), ("pretraining", 15), ("ppo", 1), ("ppo", 6)])
def test_a_run_resumed_equals_one_that_was_never_stopped(world, tmp_path, stage, at):
    data, robot, whole = world
    begun = not (stage == "pretraining" and at < 10)
    with nullcontext() if begun else pytest.raises(ModelError, match="before the first step of training"):
        Trainer.prepare(data, robot, tmp_path / "run", TINY, STEPS, show=stop(stage, at)).run()
    assert memory(tmp_path / "run")["steps"] < whole["steps"]
    Trainer.prepare(data, robot, tmp_path / "run", TINY, STEPS, resume=True).run()
    again = memory(tmp_path / "run")
    assert differences(whole, again) == []
    assert [json.loads(line) for line in (tmp_path / "run" / "progress.jsonl").open()] == again["progress"]


@pytest.fixture
def earlier_names():
    names = {today: earlier for earlier, today in RENAMED.items()}
    return lambda state: {names.get(name, name): value for name, value in state.items()}


def test_a_checkpoint_with_earlier_names_is_resumed(world, tmp_path, earlier_names):
    data, robot, whole = world
    Trainer.prepare(data, robot, tmp_path / "run", TINY, STEPS, show=stop("ppo", 6)).run()
    state = earlier_names(memory(tmp_path / "run"))
    state["net"]["bounded.unit"] = state["net"].pop("bounded.scale")
    torch.save(state, tmp_path / "run" / "checkpoint.pt")
    Trainer.prepare(data, robot, tmp_path / "run", TINY, STEPS, resume=True).run()
    assert differences(whole, memory(tmp_path / "run")) == []


def test_a_run_killed_before_its_first_checkpoint_is_begun_again(world, tmp_path):
    data, robot, whole = world
    Trainer.prepare(data, robot, tmp_path / "run", replace(TINY, seed=1), STEPS)
    assert (tmp_path / "run" / "config.json").is_file()
    Trainer.prepare(data, robot, tmp_path / "run", TINY, STEPS).run()
    assert differences(whole, memory(tmp_path / "run")) == []


def test_a_run_is_not_resumed_on_other_recordings(world, tmp_path):
    data, robot, _ = world
    Trainer.prepare(data, robot, tmp_path / "run", TINY, Budget(steps=0)).run()
    other = Dataset.create(tmp_path / "other", robot)
    for sequence in recordings(robot, 8, rows=50, kp=0.5):
        other.append(sequence)
    with pytest.raises(UsageError, match=r"run: was trained on other recordings than this dataset holds; train anew"):
        Trainer.prepare(other, robot, tmp_path / "run", TINY, STEPS, resume=True)


def test_a_shrunk_run_trains_on_with_all_of_its_correction(world, tmp_path, monkeypatch):
    data, robot, _ = world

    def halve(net, error, full_error):
        net.bounded.gain.fill_(0.5)
        return 0.5

    monkeypatch.setattr("gaponet.nn.training.trainer.choose_gain", halve)
    monkeypatch.setattr("gaponet.nn.training.validation.Validator.errors", better_each_time())
    warm = replace(TINY, pretraining=replace(TINY.pretraining, rounds=4))
    card = Trainer.prepare(data, robot, tmp_path / "run", warm, Budget(steps=WARM)).run().card
    assert card["gain"] == 0.5
    gains = []

    def watch(status):
        if status.stage == "ppo":
            gains.append(trainer.net.bounded.gain.item())

    trainer = Trainer.prepare(
        data, robot, tmp_path / "run", warm, Budget(steps=4 * WARM + UPDATE), resume=True, show=watch
    )
    assert trainer.net.bounded.gain == 1.0
    trainer.run()
    assert set(gains) == {1.0}


def better_each_time():
    error = iter(1.0 / k for k in range(1, 1000))
    return lambda self, net, robot=None: np.full(len(self.sequences), next(error))


@pytest.mark.parametrize("content", [b"", b"PK", b"\x80\x05cos\nsystem\n(S'true'\ntR."])
def test_a_checkpoint_that_is_none_is_refused_in_one_line(world, tmp_path, content):
    dataset, robot = world[:2]
    (tmp_path / "run").mkdir()
    (tmp_path / "run" / "split.json").write_text("{}")
    (tmp_path / "run" / "checkpoint.pt").write_bytes(content)
    with pytest.raises(ModelError, match=r"checkpoint\.pt: does not fit this model or is damaged"):
        Trainer.prepare(dataset, robot, tmp_path / "run", TINY, STEPS, resume=True)
