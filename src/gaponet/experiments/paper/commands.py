"""Commands on a VIRTUAL robot, many motions side by side: targets as they are, or through a
compensator.

Way            command for a target a
raw            a
delta          a − Δa: the robot moves like the nominal simulator, with its sag and its lag
feedforward    a + τ / kp, τ being the nominal simulator's torque for holding and moving
both           feed-forward, and a − Δa on top of it
integral       both, and the slow integral of the measured error

A network that corrects nothing leaves `delta` at raw and `both` at feed-forward. So the gain of a
network is measured against raw, feed-forward, and feed-forward with the integral.
"""

from __future__ import annotations

from collections.abc import Callable
from collections.abc import Sequence as ListOf
from dataclasses import dataclass, replace

import numpy as np

from gaponet.base.arrays import Array
from gaponet.deploy.compensator import Compensator, CompensatorConfig
from gaponet.motion.motion import extended
from gaponet.nn.artifact import GapModel
from gaponet.robot.spec import RobotSpec
from gaponet.sim.model import idle_joints
from gaponet.virtual.physics import Physics
from gaponet.virtual.virtual_robot import VirtualRobot

DELTA = CompensatorConfig(aim="simulator", feedback=0.0)
FEEDFORWARD = CompensatorConfig(dynamics=True, feedback=0.0)
INTEGRAL = CompensatorConfig(dynamics=True)

# Way → settings of the compensator, for a network and without one. None: targets are sent as they
# are.
NETWORK_WAYS = {"delta": DELTA, "both": FEEDFORWARD, "integral": INTEGRAL}
PLAIN_WAYS = {"raw": None, "feedforward": FEEDFORWARD, "integral": INTEGRAL}
# Way of a network → way without one that it is measured against.
REFERENCE_WAY = {"delta": "raw", "both": "feedforward", "integral": "integral"}
WAY_TITLES = {
    "raw": "targets as they are",
    "delta": "target − Δa",
    "feedforward": "feed-forward of the nominal model",
    "both": "feed-forward and − Δa",
    "integral": "feed-forward, − Δa and slow integral",
}
PLAIN_TITLES = {**WAY_TITLES, "integral": "feed-forward and slow integral"}

START_WARMING_K = 12.0  # above ambient: a robot that has been working

MIN_PAYLOAD_KG = 1e-3  # a compensator needs a largest payload above zero

ShareDone = Callable[[float], None]


@dataclass(frozen=True)
class Playback:
    """States of N motions, (T, N, n) of all joints; row t is the state at t·dt.

    Attributes:
        qpos, qvel: Encoder readings, rad and rad/s.
        true_qpos: Positions of the joints themselves, rad: encoders have zero errors.
    """

    qpos: Array
    qvel: Array
    true_qpos: Array


def play(
    robot: RobotSpec,
    unit: Physics,
    targets: ListOf[Array],
    payloads: ListOf[float],
    dt: float,
    compensator: Compensator | None = None,
    progress: ShareDone = lambda share: None,
) -> Playback:
    """Play motions on a VIRTUAL unit, each from rest under its first target; one that has ended
    stands still.

    The noise and the exact start of a motion depend on its place in the list alone, so all ways
    meet the same robot.

    Args:
        robot: The nominal robot; the unit's hidden physics acts on it.
        targets: Each (T, n) rad, the longest first.
        payloads: Payload of each motion, kg in each hand.
        dt: Control period, s.
        compensator: Turns targets into commands; None: they are sent as they are.
    """
    count = len(targets)
    lengths = np.array([len(target) for target in targets])
    padded = np.stack([extended(target, lengths[0]) for target in targets], axis=1)  # (T, N, n) rad
    # Limbs without an operated joint stay at home: with a fixed base they share no dynamics with
    # the others.
    robots = VirtualRobot(
        robot,
        [unit] * count,
        [(float(payload), "both") for payload in payloads],
        dt,
        locked=idle_joints(robot, robot.operated),
        nthread=1,
    )
    robots.reset(padded[0], list(range(count)), START_WARMING_K)
    if compensator is not None:
        compensator.reset(padded[0], np.array(payloads, float))
    states = np.empty((3, *padded.shape), np.float32)
    for row, target in enumerate(padded):
        reading = robots.read()
        states[0, row] = reading.qpos
        states[1, row] = reading.qvel
        states[2, row] = robots.true_qpos()
        command = target
        if compensator is not None:
            command = compensator.step(target, reading.qpos, reading.qvel)
        moving = np.count_nonzero(lengths > row)  # the first ones, as the longest come first
        robots.step(command, np.arange(moving))
        progress((row + 1) / len(padded))
    return Playback(*states)


def make_compensator(
    robot: RobotSpec,
    model: GapModel | None,
    config: CompensatorConfig,
    payloads: ListOf[float],
    dt: float,
) -> Compensator:
    """Return a compensator for one robot for each payload, which knows it.

    With and without a network, its simulators carry the same masses.
    """
    config = replace(config, payload_max=max(*payloads, MIN_PAYLOAD_KG))
    return Compensator(robot, model, config=config, num_envs=len(payloads), nthread=1, dt=dt)
