"""Plan of the first recordings of a robot: motions, their duration, and a sheet to fill in."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import product
from pathlib import Path

import numpy as np

from gaponet.base.errors import UsageError
from gaponet.motion.library import Library, short
from gaponet.motion.motion import Motion
from gaponet.robot.spec import RobotSpec

# Of motions of one joint, the most informative first.
SIGNAL_ORDER = ("multisine", "steps", "holds", "chirp", "sweep", "trapezoids", "creep")
MAX_ROUNDS = 50  # of motions of many joints
RECOMMENDED_MINUTES = 41.0
MIN_TRAINING_MINUTES = 9.0


@dataclass(frozen=True)
class Plan:
    """Payload (kg) and motion, in the order in which they are played."""

    played: tuple[tuple[float, Motion], ...]

    @property
    def motions(self) -> tuple[Motion, ...]:
        """Return each motion once."""
        return tuple({motion.name: motion for _, motion in self.played}.values())

    @property
    def payloads(self) -> tuple[float, ...]:
        """Return each payload once, kg."""
        return tuple(dict.fromkeys(mass for mass, _ in self.played))

    @property
    def minutes(self) -> float:
        """Return the duration at all payloads together."""
        return sum(motion.duration for _, motion in self.played) / 60


def make_plan(robot: RobotSpec, minutes: float, payloads: tuple[float, ...], seed: int = 0) -> Plan:
    """Return motions for so many minutes: every joint alone, signal by signal, with motions of
    many joints between.

    Raises:
        UsageError: Too little time for one motion of each joint at each payload, or a payload that
            cannot be carried.
    """
    _require_payloads(payloads, robot)
    library = Library(robot, seed, max(payloads))
    first = [library.make(f"{SIGNAL_ORDER[0]}-{short(joint, robot)}") for joint in robot.operated]
    least = len(payloads) * sum(motion.duration for motion in first) / 60
    if least > minutes:
        raise UsageError(
            f"--minutes {minutes:g} is too short for {robot.name} at these payloads: give "
            f"{math.ceil(least)}"
        )
    chosen = list(first)
    for name in _names(robot, library):
        if sum(motion.duration for motion in chosen) >= 60 * minutes / len(payloads):
            break
        chosen.append(_standing(library, name))
    return Plan(tuple(product(payloads, chosen)))


def _require_payloads(payloads: tuple[float, ...], robot: RobotSpec) -> None:
    """Refuse payloads, kg, that the robot cannot carry."""
    no_mount = not robot.payload_mounts
    if not payloads or min(payloads) < 0 or (max(payloads) > 0 and no_mount):
        raise UsageError(
            f"--payloads {payloads}: give kg ≥ 0; {robot.name} has {len(robot.payload_mounts)} "
            "mounts"
        )


def _standing(library: Library, name: str) -> Motion:
    """Return the motion with joints that are not operated at home, so that a humanoid stays on its
    legs.
    """
    made = library.make(name)
    robot = library.robot
    if set(made.moved(robot)) <= set(robot.operated):
        return made
    ctrl = np.tile(robot.qpos_home, (len(made.ctrl), 1))
    ctrl[:, robot.operated_index] = made.ctrl[:, robot.operated_index]
    return library.limits.fit(replace(made, ctrl=ctrl, joints=robot.operated))


def _names(robot: RobotSpec, library: Library) -> Iterator[str]:
    """Yield names of motions of many joints, and after some of them another signal on every
    joint.
    """
    kinds = ["tour-all", "limber-all", *(f"wander-{side}" for side in library.kit.arms)]
    for number in range(MAX_ROUNDS):
        for kind in kinds:
            yield f"{kind}-{2 * number}"
            yield f"{kind}-{2 * number + 1}"
        following = number + 1  # the first signal is played before all
        if following < len(SIGNAL_ORDER):
            for joint in robot.operated:
                yield f"{SIGNAL_ORDER[following]}-{short(joint, robot)}"


def sheet(
    robot: RobotSpec, plan: Plan, files: dict[str, str], rate: float, known: Path | None = None
) -> str:
    """Return instructions, and a table to fill in, as Markdown.

    Args:
        files: Motion → file.
        rate: Of the commands, Hz.
        known: Folder of a robot of which there are logs already.
    """
    masses = ", ".join(f"{mass:g}" for mass in plan.payloads)
    minutes = f"{plan.minutes:.0f}"
    purpose = _size(plan)
    if known:
        minutes = f"{plan.minutes:.1f}"
        purpose = "Chosen for what they tell of this robot beside its logs."
    lines = [
        f"# Recording sheet: {robot.name}",
        "",
        f"{minutes} minutes of motion: {len(plan.motions)} motions at {masses} kg, commands at "
        f"{rate:g} Hz. {purpose}",
        "",
        "Robot: ____________  unit: ____________  date: ____________  by: ____________",
        "",
        "1. Warm up for ten minutes with any of these motions: cold joints rub more.",
        "2. Note kp and kd of the controller and leave them: one setting for all motions, or a "
        "folder for each.",
        f"   The simulator has (N·m/rad, N·m·s/rad): {_gains(robot)}.",
        "3. Log the command as it is sent, the measured position and, if there are, velocity and "
        "signed torque: with",
        "   one clock, at the commands' rate or above, with all digits, from before the motion to "
        "a second after it.",
        "4. Nothing may touch the robot. Play each motion slowly first, a hand on the stop. Play "
        "a motion again that",
        "   was stopped.",
        "5. Weigh payloads to 10 g and mount them where robot.toml says.",
        "",
        *_table(plan, files),
        "",
        "Then, for each payload:",
        "",
        *_commands(plan, known),
    ]
    return "\n".join([*lines, ""])


def _size(plan: Plan) -> str:
    """Say what so many minutes are good for."""
    size = (
        f"On virtual H1-2 robots {MIN_TRAINING_MINUTES:g} minutes left a third of the simulator's "
        f"error, {RECOMMENDED_MINUTES:g} came within a tenth of the best."
    )
    if plan.minutes < MIN_TRAINING_MINUTES:
        size += " Enough to identify gains, friction and delay; little to train on."
    return size


def _gains(robot: RobotSpec) -> str:
    """Return kp/kd of the operated joints."""
    gains = []
    for i, joint in enumerate(robot.joint_names):
        if joint in robot.operated:
            gains.append(f"{short(joint, robot)} {robot.servo.kp[i]:g}/{robot.servo.kd[i]:g}")
    return "; ".join(gains)


def _table(plan: Plan, files: dict[str, str]) -> list[str]:
    """Return a row to fill in for each motion that is played."""
    rows = [
        "| nr | file | kg | s | time | temperature | remarks |",
        "| ---: | --- | ---: | ---: | --- | --- | --- |",
    ]
    for number, (mass, motion) in enumerate(plan.played, 1):
        file = files[motion.name]
        rows.append(f"| {number} | {file} | {mass:g} | {motion.duration:.0f} | | | |")
    return rows


def _commands(plan: Plan, known: Path | None) -> list[str]:
    """Return what to type when all is recorded. known: as of sheet."""
    commands = []
    for mass in plan.payloads:
        commands.append(
            f"    gaponet import LOGS/{mass:g}kg --robot ROBOT --unit-id UNIT --payload-mass "
            f"{mass:g} --out data"
        )
    commands.append("    gaponet doctor data")
    if known:
        commands.append(f"    gaponet check {known} data")
        commands.append(f"    gaponet adapt {known} data --out ROBOT_2")
    return commands
