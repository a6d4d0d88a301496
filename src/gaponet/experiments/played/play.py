"""Ask one VIRTUAL unit for targets, as they are or through a compensator, many motions and payloads side by side."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from collections.abc import Sequence as ListOf
from dataclasses import dataclass
from typing import Protocol, TypeVar

import numpy as np

from gaponet.base.arrays import Array
from gaponet.deploy.compensator import Compensator, CompensatorConfig
from gaponet.experiments.played.trained import Trained
from gaponet.nn.artifact import GapModel
from gaponet.robot.spec import RobotSpec
from gaponet.sim.model import idle_joints, model_hash
from gaponet.testing.physics import Physics
from gaponet.testing.unit import VirtualRobot

PLANNED = CompensatorConfig(dynamics=True)  # targets of planned motions are smooth
WARMTH = 12.0  # K above ambient at the start: a robot that has been working (testing/play.py)


class Commanded(Protocol):
    """Something with targets, (T, n) rad."""

    @property
    def ctrl(self) -> Array: ...


M = TypeVar("M", bound=Commanded)


@dataclass(frozen=True)
class Driven:
    """How targets reach the robot.

    Attributes:
        model: What the compensator asks; None for the feed-forward of the robot alone.
        robot: The robot as it is known.
        config: Settings of the compensator.
    """

    model: GapModel | None
    robot: RobotSpec
    config: CompensatorConfig

    def facts(self) -> tuple[object, ...]:
        """What decides how the robot is driven."""
        return self.model and self.model.weights_hash(), model_hash(self.robot), self.config


@dataclass(frozen=True)
class Played:
    """What happened; row t is the state at t·dt and the command of [t·dt, (t+1)·dt); (T, N, n), all joints.

    Attributes:
        qpos, qvel: What the encoders say, rad, rad/s.
        true: Where the joints are, rad: nobody's sensor says it.
        sent: Commands, rad.
        tau: Motor torque as the current sensors say, N·m.
        temperature: Windings, °C.
    """

    qpos: Array
    qvel: Array
    true: Array
    sent: Array
    tau: Array
    temperature: Array


def compensations(robot: RobotSpec, trained: ListOf[Trained]) -> Iterable[tuple[str, int | None, Driven | None]]:
    """Ways to drive the robot: raw; by what is known of it alone, nominal and identified; and through each model."""
    yield "raw", None, None
    yield "feedforward", None, Driven(None, robot.before_identification, PLANNED)
    for fitted in [t.robot for t in trained if t.robot.nominal is not None][:1]:
        yield "identified feedforward", None, Driven(None, fitted, PLANNED)
    for t in trained:
        yield t.method, t.seed, Driven(t.model, t.robot, PLANNED)


def of_seed(method: str, seed: int | None) -> str:
    """A method as progress names it."""
    return method if seed is None else f"{method} {seed}"


def with_payloads(motions: ListOf[M], payloads: tuple[float, ...]) -> list[tuple[M, float]]:
    """Each motion with each payload, kg, the longest motions first, as `play` wants them."""
    return [(m, p) for m in sorted(motions, key=lambda m: -len(m.ctrl)) for p in payloads]


def stacked(ctrl: ListOf[Array]) -> Array:
    """Targets of unequal length as one (T, N, n), each held at its end."""
    longest = max(len(c) for c in ctrl)
    return np.stack([np.concatenate([c, np.repeat(c[-1:], longest - len(c), axis=0)]) for c in ctrl], axis=1)


def play(
    robot: RobotSpec,
    unit: Physics,
    targets: Array,
    mass: Array,
    seeds: list[int],
    driven: Driven | None = None,
    lengths: Array | None = None,
    progress: Callable[[float], None] = lambda share: None,
) -> Played:
    """Start at rest under the first target, then follow.

    Limbs without an operated joint stay at home: with a fixed base they share no dynamics with the others.

    Args:
        targets: (T, N, n) rad at the robot's control period.
        mass: Payload in each hand, (N,) kg, told to the compensator.
        seeds: Seeds of each row's noise and rest position, (N,).
        driven: What makes commands of the targets; None for the targets as they are.
        lengths: Rows of each that count, (N,), falling; those that are through stand still.
        progress: Called after each period with the share of all control steps that is done.
    """
    count = len(mass)
    locked = idle_joints(robot, robot.operated)
    robots = VirtualRobot(robot, [unit] * count, [(float(m), "both") for m in mass], robot.dt, locked=locked, nthread=1)
    robots.reset(targets[0], seeds, WARMTH)
    compensator = None
    if driven is not None:
        compensator = Compensator(
            driven.robot, driven.model, driven.config, num_envs=count, nthread=1, extrapolate=True
        )
        compensator.reset(targets[0], mass)
    out = np.empty((6, *targets.shape), np.float32)
    running = np.full(len(targets), count) if lengths is None else (lengths > np.arange(len(targets))[:, None]).sum(1)
    done = running.cumsum() / running.sum()
    for t, target in enumerate(targets):
        reading = robots.read()
        sent = target if compensator is None else compensator.step(target, reading.qpos, reading.qvel)
        out[:, t] = reading.qpos, reading.qvel, robots.true_qpos(), sent, reading.tau, reading.temperature
        robots.step(sent, np.arange(running[t]))
        progress(float(done[t]))
    return Played(*out)
