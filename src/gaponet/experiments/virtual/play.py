"""Execution of joint targets on one VIRTUAL unit, raw or through a compensator, many motions side by side."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from collections.abc import Sequence as ListOf
from dataclasses import dataclass
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
    """A trained model and the run that it comes from.

    Attributes:
        method: Kind of model, with identified+ in front where it corrects an identified simulator.
        robot: The simulator that it corrects.
    """

    method: str
    seed: int
    run: Path
    model: GapModel
    robot: RobotSpec


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
        raise UsageError(f"--runs {names}: no run of gaponet train or cells of gaponet experiment compare there")
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
    return [trained[key] for key in sorted(trained, key=lambda k: (k[0].startswith(IDENTIFIED), k[0] != "mlp", k))]


def _has_changed_settings(run: Path) -> bool:
    file = run / RESULT_FILE
    return file.is_file() and bool(set(read_record(file)["changes"]) - set(SAME_METHOD))


PLANNED = CompensatorConfig(dynamics=True)  # targets of planned motions are smooth
START_WARMING_K = 12.0  # above ambient: a robot that has been working (testing/play.py)

Progress = Callable[[str, float], None]  # called with the name of the step and the share of it that is done


class HasTargets(Protocol):
    """A motion with targets ctrl, (T, n) rad."""

    @property
    def ctrl(self) -> Array: ...


M = TypeVar("M", bound=HasTargets)


@dataclass(frozen=True)
class Compensation:
    """A compensator between targets and robot.

    Attributes:
        model: Network of the compensator; None for the feed-forward of the robot model alone.
        robot: Robot model of the compensator.
    """

    model: GapModel | None
    robot: RobotSpec
    config: CompensatorConfig


@dataclass(frozen=True)
class Trajectories:
    """States and commands of N motions, (T, N, n) of all joints; row t is the state at t·dt and the command after it.

    Attributes:
        qpos, qvel: Encoder readings, rad, rad/s.
        true: True joint positions, rad.
        sent: Commands, rad.
        tau: Motor torque by the current sensors, N·m.
        temperature: Winding temperature, °C.
    """

    qpos: Array
    qvel: Array
    true: Array
    sent: Array
    tau: Array
    temperature: Array


def compensations(
    robot: RobotSpec, trained: ListOf[TrainedModel], config: CompensatorConfig = PLANNED
) -> Iterable[tuple[str, int | None, Compensation | None]]:
    """Yield (method, seed, compensation): raw, feed-forward of the nominal and the identified model, each network."""
    yield "raw", None, None
    yield "feedforward", None, Compensation(None, robot.before_identification, config)
    for identified in [t.robot for t in trained if t.robot.nominal is not None][:1]:
        yield "identified feedforward", None, Compensation(None, identified, config)
    for t in trained:
        yield t.method, t.seed, Compensation(t.model, t.robot, config)


def step_name(method: str, seed: int | None) -> str:
    """Name of a method and seed in the progress bar."""
    return method if seed is None else f"{method} {seed}"


def with_payloads(motions: ListOf[M], payloads: tuple[float, ...]) -> list[tuple[M, float]]:
    """Return each motion with each payload, kg, the longest motions first as `play` needs them."""
    return [(m, p) for m in sorted(motions, key=lambda m: -len(m.ctrl)) for p in payloads]


def stack_targets(ctrl: ListOf[Array]) -> Array:
    """Stack targets of unequal length to (T, N, n); shorter ones hold their last row."""
    longest = max(len(c) for c in ctrl)
    return np.stack([np.concatenate([c, np.repeat(c[-1:], longest - len(c), axis=0)]) for c in ctrl], axis=1)


def play(
    robot: RobotSpec,
    unit: Physics,
    targets: Array,
    mass: Array,
    *,
    lengths: Array,
    compensation: Compensation | None = None,
    progress: Callable[[float], None] = lambda share: None,
) -> Trajectories:
    """Start at rest under the first target, then follow the targets.

    Limbs without an operated joint stay at home: with a fixed base they share no dynamics with the others. The seed of
    a motion's noise and rest position is its number.

    Args:
        targets: (T, N, n) rad at the robot's control period.
        mass: Payload in each hand, (N,) kg; the compensator knows it.
        lengths: Rows of each motion, (N,), in descending order; a motion that has ended stands still.
        compensation: None to send the targets as they are.
        progress: Called after each period with the share of all control steps that is done.
    """
    count = len(mass)
    locked = idle_joints(robot, robot.operated)
    robots = VirtualRobot(robot, [unit] * count, [(float(m), "both") for m in mass], robot.dt, locked=locked, nthread=1)
    robots.reset(targets[0], list(range(count)), START_WARMING_K)
    compensator = None
    if compensation is not None:
        compensator = Compensator(
            compensation.robot, compensation.model, compensation.config, num_envs=count, nthread=1, extrapolate=True
        )
        compensator.reset(targets[0], mass)
    out = np.empty((6, *targets.shape), np.float32)
    running = (lengths > np.arange(len(targets))[:, None]).sum(1)
    done = running.cumsum() / running.sum()
    for t, target in enumerate(targets):
        reading = robots.read()
        sent = target if compensator is None else compensator.step(target, reading.qpos, reading.qvel)
        out[:, t] = reading.qpos, reading.qvel, robots.true_qpos(), sent, reading.tau, reading.temperature
        robots.step(sent, np.arange(running[t]))
        progress(float(done[t]))
    return Trajectories(*out)
