"""Execution of joint targets on one VIRTUAL unit, raw or through a compensator, many motions side by side."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from collections.abc import Sequence as ListOf
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Protocol, TypeVar

import numpy as np

from gaponet.base.arrays import Array
from gaponet.base.errors import UsageError
from gaponet.deploy.compensator import Compensator, CompensatorConfig
from gaponet.experiments.cells import RESULT_FILE, read_record
from gaponet.nn.artifact import GapModel
from gaponet.report.candidate import corrected_robot
from gaponet.report.methods import IDENTIFIED, method, title
from gaponet.robot.spec import RobotSpec
from gaponet.sim.model import idle_joints
from gaponet.testing.physics import Physics
from gaponet.testing.virtual_robot import VirtualRobot

SAME_METHOD = ("mlp_match=on",)  # changed settings that leave the method's name as it is


@dataclass(frozen=True)
class TrainedModel:
    """A trained model and the run that it comes from."""

    method: (
        str  # kind of model, with identified+ in front where it corrects an identified simulator
    )
    seed: int
    run: Path
    model: GapModel
    robot: RobotSpec  # the simulator that it corrects


def load_trained(folders: ListOf[Path], robot: RobotSpec) -> list[TrainedModel]:
    """Load runs, ordered by method and seed; models on the nominal simulator come first.

    Args:
        folders: Run folders, or folders of them such as the cells of gaponet experiment compare. Of the latter, cells
            with changed settings are left out.

    Raises:
        UsageError: No run, or the same method and seed twice.
        ModelError: The model does not fit the robot.
    """
    runs: list[Path] = []
    for folder in folders:
        if (folder / "model" / "card.json").is_file():
            runs.append(folder)
            continue
        cards = [c for place in ("*", "cells/*") for c in folder.glob(f"{place}/model/card.json")]
        inside = sorted(card.parent.parent for card in cards)
        runs += [run for run in inside if not _has_changed_settings(run)]
    if not runs:
        names = ", ".join(map(str, folders))
        raise UsageError(
            f"--runs {names}: no run of gaponet train or cells of gaponet experiment compare there"
        )
    trained: dict[tuple[str, int], TrainedModel] = {}
    for run in runs:
        model = GapModel.load(run)
        corrected = corrected_robot(run, robot)
        model.require(corrected)
        key = method(model.config.kind, corrected), int(model.card["seed"])
        if key in trained:
            raise UsageError(
                f"{run}: {title(key[0])} seed {key[1]} is there already ({trained[key].run}); give one of them"
            )
        trained[key] = TrainedModel(*key, run, model, corrected)
    return [
        trained[key]
        for key in sorted(trained, key=lambda k: (k[0].startswith(IDENTIFIED), k[0] != "mlp", k))
    ]


def _has_changed_settings(run: Path) -> bool:
    file = run / RESULT_FILE
    return file.is_file() and bool(set(read_record(file)["changes"]) - set(SAME_METHOD))


PLANNED = CompensatorConfig(dynamics=True)  # targets of planned motions are smooth
START_WARMING_K = 12.0  # above ambient: a robot that has been working (testing/play.py)

Progress = Callable[
    [str, float], None
]  # called with the name of the step and the share of it that is done


class HasTargets(Protocol):
    """A motion with targets ctrl, (T, n) rad."""

    @property
    def ctrl(self) -> Array: ...


M = TypeVar("M", bound=HasTargets)


@dataclass(frozen=True)
class Trajectories:
    """States of N motions, (T, N, n) of all joints; row t is the state at t·dt.

    Attributes:
        qpos, qvel: Encoder readings, rad, rad/s.
        true: True joint positions, rad.
    """

    qpos: Array
    qvel: Array
    true: Array


def with_payloads(motions: ListOf[M], payloads: tuple[float, ...]) -> list[tuple[M, float]]:
    """Return each motion with each payload, kg, the longest motions first as `execute` needs them."""
    return [(m, p) for m in sorted(motions, key=lambda m: -len(m.ctrl)) for p in payloads]


def execute(
    robot: RobotSpec,
    unit: Physics,
    ctrl: ListOf[Array],
    mass: ListOf[float],
    trained: ListOf[TrainedModel],
    config: CompensatorConfig,
    progress: Progress = lambda step, share: None,
) -> Iterator[tuple[str, int | None, Trajectories]]:
    """Execute targets, (T, n) rad each, by every method: raw, feed-forward of robot models alone, each network.

    Args:
        ctrl: Targets of each motion, the longest first.
        mass: Payload of each motion, kg per hand; compensators know it.

    Yields:
        Method, seed and trajectories.
    """
    methods: list[tuple[str, int | None, RobotSpec | None, GapModel | None]] = [
        ("raw", None, None, None)
    ]
    methods.append(("feedforward", None, robot.before_identification, None))
    methods += [
        ("identified feedforward", None, t.robot, None)
        for t in trained
        if t.robot.nominal is not None
    ][:1]
    methods += [(t.method, t.seed, t.robot, t.model) for t in trained]
    for name, seed, simulator, model in methods:
        compensator = None if simulator is None else Compensator(
            simulator, model, config, num_envs=len(ctrl), nthread=1, extrapolate=True
        )  # fmt: skip
        report = partial(progress, name if seed is None else f"{name} {seed}")
        yield name, seed, _play(robot, unit, ctrl, np.array(mass), compensator, report)


def _play(
    robot: RobotSpec,
    unit: Physics,
    ctrl: ListOf[Array],
    mass: Array,
    compensator: Compensator | None,
    progress: Callable[[float], None],
) -> Trajectories:
    """Start at rest under the first target, then follow the targets; a motion that has ended stands still.

    Limbs without an operated joint stay at home: with a fixed base they share no dynamics with the others. The seed of
    a motion's noise and rest position is its number.
    """
    targets = np.stack(
        [np.concatenate([c, np.repeat(c[-1:], len(ctrl[0]) - len(c), axis=0)]) for c in ctrl],
        axis=1,
    )
    locked = idle_joints(robot, robot.operated)
    loads = [(float(m), "both") for m in mass]
    robots = VirtualRobot(robot, [unit] * len(mass), loads, robot.dt, locked=locked, nthread=1)
    robots.reset(targets[0], list(range(len(mass))), START_WARMING_K)
    if compensator is not None:
        compensator.reset(targets[0], mass)
    out = np.empty((3, *targets.shape), np.float32)
    running = (np.array([len(c) for c in ctrl]) > np.arange(len(targets))[:, None]).sum(1)
    done = running.cumsum() / running.sum()
    for t, target in enumerate(targets):
        reading = robots.read()
        sent = (
            target if compensator is None else compensator.step(target, reading.qpos, reading.qvel)
        )
        out[:, t] = reading.qpos, reading.qvel, robots.true_qpos()
        robots.step(sent, np.arange(running[t]))
        progress(float(done[t]))
    return Trajectories(*out)
