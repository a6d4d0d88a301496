"""Methods of the benchmark: functions from a question to a fitted simulator.

docs/benchmark.md adds one.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from importlib.util import find_spec
from pathlib import Path

import numpy as np

from gaponet.base.arrays import Array
from gaponet.base.errors import UsageError
from gaponet.base.files import write_text
from gaponet.data.sequence import Sequence
from gaponet.data.store import Dataset
from gaponet.evaluation.verdict import NetworkGain
from gaponet.nn.artifact import GapModel
from gaponet.nn.config import ModelConfig
from gaponet.nn.delay_offset import DelayOffset
from gaponet.nn.training.config import Budget, PretrainingConfig, TrainConfig
from gaponet.robot.folder import save_robot
from gaponet.robot.spec import RobotSpec, load_robot
from gaponet.sim.metrics import runs
from gaponet.sim.replay import Corrector, replay
from gaponet.sysid.adapt import adapt
from gaponet.sysid.identify import identify
from gaponet.sysid.robot_rollouts import WINDOW_S
from real_robots.questions import Question, recorded_joints, train_val

LEFT_OUT = "left out"  # starts the note of a network that validation rejected
ADAPTATION_S = 30.0  # of the test's session


@dataclass(frozen=True)
class FittedSim:
    """A fitted simulator."""

    robot: RobotSpec
    corrector: Corrector | None = None  # changes the targets (gaponet.sim.replay.Corrector)
    # returns an offset of a recording's simulated positions, (n,) rad
    shift: Callable[[Sequence], Array] | None = None
    note: str = ""  # remark for the reader of the table

    def positions(self, sequences: list[Sequence]) -> list[Array]:
        """Return open-loop rollouts, (T, n) rad each."""
        replays = replay(sequences, self.robot, self.corrector, lock_idle=True)
        if self.shift is None:
            return [simulated.qpos for simulated in replays]
        found = []
        for s, simulated in zip(sequences, replays, strict=True):
            found.append(simulated.qpos + self.shift(s))
        return found

    def errors(self, sequences: list[Sequence]) -> list[float]:
        """Return the mean |error| of each rollout over the recorded joints, rad."""
        return [run.mean_error() for run in runs(sequences, self.positions(sequences), self.robot)]


Method = Callable[[Question], FittedSim]


def nominal(question: Question) -> FittedSim:
    """The robot folder as it is."""
    return FittedSim(question.robot)


def delay_offset(question: Question) -> FittedSim:
    """A delay and an offset of each joint."""
    return FittedSim(question.robot, fit_delay_offset(question).corrector(question.robot))


def fit_delay_offset(question: Question) -> DelayOffset:
    """Fit delay and offset once for all methods that use them."""
    return question.once("delay + offset", lambda: DelayOffset.fit(question.fitted, question.robot))


def constant(question: Question) -> FittedSim:
    """The nominal simulator plus its mean error of each joint, payload and unit.

    This control needs no model of the robot. It is fitted to the recordings for adaptation too.
    """
    robot = question.robot
    n = len(robot.joint_names)
    seen = question.fitted + question.few
    biases: dict[tuple[object, ...], list[Array]] = {}
    for s, qpos in zip(seen, FittedSim(robot).positions(seen), strict=True):
        columns = recorded_joints(s, robot)
        bias = np.full(n, np.nan)
        bias[columns] = (s.qpos - qpos)[1:, columns].mean(axis=0)
        for key in _bias_keys(s):
            biases.setdefault(key, []).append(bias)

    def shift(s: Sequence) -> Array:
        offset = np.zeros(n)
        for key in _bias_keys(s):
            if key not in biases:
                continue
            rows = np.array(biases[key])
            estimated = np.isfinite(rows).any(axis=0)
            offset[estimated] = np.nanmean(rows[:, estimated], axis=0)
        return offset

    return FittedSim(robot, shift=shift)


def _bias_keys(s: Sequence) -> tuple[tuple[object, ...], ...]:
    """Return what a recording's mean error may depend on, the most special one last."""
    return (), (s.meta.payload_mass,), (s.meta.payload_mass, s.meta.unit_id)


def identified(question: Question) -> FittedSim:
    """gaponet identify."""
    return FittedSim(question.once("identified", lambda: _identify(question)))


def adapted(question: Question) -> FittedSim:
    """The robot identified on other data, adapted on a few recordings of the test's unit or
    session.
    """
    if not question.few:
        raise UsageError(f"{question.name}: has no recordings for adaptation")
    fitted = identified(question) if question.elsewhere is None else elsewhere(question)
    start = fitted.robot
    few = question.few
    seconds = ADAPTATION_S
    if few[0].duration < WINDOW_S:  # all of the short windows
        seconds = len(few) * WINDOW_S
    fit = adapt(few, start, seconds, judge=True)
    return FittedSim(fit.robot if fit.accepted else start)


def elsewhere(question: Question) -> FittedSim:
    """The robot as it was identified on other data."""
    if question.elsewhere is None:
        raise UsageError(f"{question.name}: there is no other data set of this robot")
    return FittedSim(question.once("elsewhere", question.elsewhere))


METHODS: dict[str, tuple[str, Method]] = {
    "nominal": ("nominal simulator", nominal),
    "constant": ("constant offset by joint, payload, unit", constant),
    "delay_offset": ("delay + offset", delay_offset),
    "elsewhere": ("identified elsewhere", elsewhere),
    "identified": ("identification", identified),
    "adapted": ("identified elsewhere, adapted", adapted),
}


def _identify(question: Question) -> RobotSpec:
    """Identify the robot, or load it from the question's folder."""
    folder = question.work and question.work / "identified"
    if folder and (folder / "robot.toml").is_file():
        return load_robot(folder)
    train, val = train_val(question)
    robot = identify(train, question.robot, val).robot
    if folder:
        save_robot(robot, folder)
    return robot


BASES = {"": nominal, "identification + ": identified}
TITLES = {"shared_mlp": "shared MLP", "gaponet": "GAPONet", "trees": "trees"}
FULL_RECIPE_STEPS = 600_000  # control steps from which the recipe is that of gaponet train
# Fewer steps are one round of supervised pre-training.
ONE_ROUND = PretrainingConfig(rounds=1, num_envs=256, gradient_steps=200, sensor_states=512)


def network_methods(steps: int) -> dict[str, tuple[str, Method]]:
    """Return methods that train a network for this number of control steps: name → title and
    method.
    """
    methods: dict[str, tuple[str, Method]] = {}
    for base in BASES:
        for kind, title in TITLES.items():
            if kind == "trees" and not find_spec("sklearn"):
                continue
            method = partial(_train, base=base, kind=kind, steps=steps)
            methods[f"{base}{title} {steps}"] = (f"{base}{title}", method)
    return methods


def _recipe(steps: int) -> TrainConfig:
    """Return the training settings for a number of control steps; a short training labels no more
    rows than that.
    """
    warm = PretrainingConfig()
    if steps < FULL_RECIPE_STEPS:
        warm = replace(ONE_ROUND, steps=max(steps // ONE_ROUND.num_envs, 1), rows=steps)
    return TrainConfig(pretraining=warm, mixed_gains=True)


def _train(question: Question, base: str, kind: str, steps: int) -> FittedSim:
    """Train a network on top of a simulator; leave it out if validation shows no gain over
    identification.
    """
    from gaponet.nn.training.trainer import Trainer  # loads torch

    if question.work is None:
        raise UsageError(f"{question.name}: networks need a folder to be trained in")
    start = BASES[base](question)
    run = question.work / f"{base.partition(' ')[0]}{kind}-{steps}"
    training = run / "training"
    if not (training / "model" / "card.json").is_file():
        dataset, split = store_parts(question, run)
        network = ModelConfig(kind)  # type: ignore[arg-type]
        config = replace(_recipe(steps), model=network, split=str(split))
        resume = (training / "checkpoint.pt").is_file()
        budget = Budget(steps=steps)
        trainer = Trainer(dataset, start.robot, training, config, budget, resume=resume)
        trainer.baseline = fit_delay_offset(question)
        trainer.run()
    model = GapModel.load(training)
    val = model.card["val_mpjae"]
    gain = NetworkGain(base, val["added"], val.get("error", np.nan), val["start"])
    note = f"{100 * gain.reduction / gain.base_error:.0f} % less on validation"
    if base and not gain.helps:
        return replace(start, note=f"{LEFT_OUT}: {note}")
    return replace(start, corrector=model.corrector(start.robot), note=note)


def store_parts(question: Question, run: Path) -> tuple[Dataset, Path]:
    """Write a question's recordings to fit as a dataset, and parts.json, which splits them."""
    dataset = Dataset.create(run / "recordings", question.robot)
    train, val = train_val(question)
    parts: dict[str, dict[str, str]] = {"test": {}}
    for part, sequences in (("train", train), ("val", val)):
        parts[part] = {}
        by_hash = {s.content_hash(): s for s in sequences}
        for digest, s in by_hash.items():
            entry = dataset.find(digest) or dataset.append(s, content_hash=digest)
            parts[part][entry.id] = entry.hash
    split = run / "parts.json"
    write_text(split, json.dumps({"parts": parts}))
    return dataset, split
