"""Arms of benchmarks that identify VIRTUAL robots: their folders, and what they answer to
commands.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from gaponet.robot.spec import RobotSpec, load_robot
from gaponet.virtual.virtual_robot import VirtualRobot

ARM_XML = """<mujoco><compiler angle="radian" autolimits="true"/><option integrator="implicitfast"/>
<default><joint axis="0 1 0" range="-2.5 2.5"/>\
<geom type="capsule" size="0.02" contype="0" conaffinity="0"/></default>
<worldbody>{}</worldbody></mujoco>"""


def arm_xml(lengths: np.ndarray, masses: np.ndarray, joint_attributes: list[str]) -> str:
    """Return the MJCF of a chain of rods, b0 … with hinges j0 …, without actuators.

    Args:
        lengths, masses: Of the rods, (n,) m and kg.
        joint_attributes: Further attributes of each hinge.
    """
    inner = ""
    for j in reversed(range(len(lengths))):
        at = lengths[j - 1] if j else 0
        inner = (
            f'<body name="b{j}" pos="{at} 0 0"><joint name="j{j}" {joint_attributes[j]}/>'
            f'<geom fromto="0 0 0 {lengths[j]} 0 0" mass="{masses[j]}"/>{inner}</body>'
        )
    return ARM_XML.format(inner)


def write_robot(
    folder: Path,
    xml: str,
    *,
    name: str,
    dt: float,
    timestep: float,
    joints: Iterable[dict[str, object]],
    more: str = "",
) -> RobotSpec:
    """Write a robot folder and load it.

    Args:
        folder: Made if it is missing.
        xml: The model.
        dt: Control period, s.
        timestep: Physics step, s.
        joints: Numbers of the joints j0 …, by field of robot.toml.
        more: Further text of robot.toml.
    """
    lines = [f'name = "{name}"', f"dt = {dt}", f"timestep = {timestep}"]
    for j, fields in enumerate(joints):
        lines += ["[[joint]]", f'name = "j{j}"']
        lines += [f"{field} = {value}" for field, value in fields.items()]
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "robot.xml").write_text(xml)
    (folder / "robot.toml").write_text("\n".join(lines) + "\n" + more)
    return load_robot(folder)


@dataclass(frozen=True)
class Answers:
    """What the sensors of virtual robots read, (motions, T, n) each: rad, rad/s, N·m, °C."""

    qpos: np.ndarray
    qvel: np.ndarray
    tau: np.ndarray
    temperature: np.ndarray


def play_virtual(virtual: VirtualRobot, ctrl: np.ndarray) -> Answers:
    """Send commands (motions, T, n) rad to virtual robots that were reset, one robot for each
    motion.
    """
    answers = Answers(*np.zeros((4, *ctrl.shape)))
    for t in range(ctrl.shape[1]):
        reading = virtual.read()
        answers.qpos[:, t] = reading.qpos
        answers.qvel[:, t] = reading.qvel
        answers.tau[:, t] = reading.tau
        answers.temperature[:, t] = reading.temperature
        virtual.step(ctrl[:, t])
    return answers
