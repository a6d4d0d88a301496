"""A two-joint arm for tests: its robot folder, and recordings of a second arm that is not quite
like it.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import mujoco
import numpy as np

from gaponet.data.sequence import Sequence, SequenceMeta
from gaponet.data.store import Dataset
from gaponet.robot.spec import RobotSpec, load_robot
from gaponet.sim.model import build_model

XML = """
<mujoco model="arm">
  <compiler angle="radian" autolimits="true"/>
  <option integrator="implicitfast"/>
  <default><joint damping="0.5" armature="0.02" frictionloss="0.05"/></default>
  <worldbody>
    <body name="upper">
      <joint name="shoulder" axis="0 1 0" range="-1.5 1.5"/>
      <geom type="capsule" fromto="0 0 0 0.2 0 0" size="0.02" mass="0.3"
            contype="0" conaffinity="0"/>
      <body name="fore" pos="0.2 0 0">
        <joint name="elbow" axis="0 1 0" range="-1.5 1.5"/>
        <geom type="capsule" fromto="0 0 0 0.2 0 0" size="0.02" mass="0.2"
              contype="0" conaffinity="0"/>
      </body>
    </body>
  </worldbody>
</mujoco>
"""
TOML = """
name = "arm"
dt = 0.02
timestep = 0.005
[[joint]]
name = "shoulder"
kp = 20.0
effort_limit = 5.0
[[joint]]
name = "elbow"
kp = 20.0
effort_limit = 5.0
[[payload_mount]]
side = "hand"
body = "fore"
pos = [0.2, 0.0, 0.0]
"""

# Of both servos of the arm.
SERVO = {
    "kp": 20.0,
    "damping": 0.5,
    "frictionloss": 0.05,
    "armature": 0.02,
    "offset": 0.0,
    "delay": 0.0,
}


def write_arm(folder: Path, toml: str = TOML, xml: str = XML) -> RobotSpec:
    """The arm as a user's robot folder."""
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "robot.toml").write_text(toml)
    (folder / "robot.xml").write_text(xml)
    return load_robot(folder)


def commands(rows: int, seed: int, dt: float = 0.02) -> np.ndarray:
    """Smooth two-joint targets, (rows, 2) rad."""
    rng = np.random.default_rng(seed)
    t = np.arange(rows)[:, None] * dt
    return rng.uniform(-0.4, 0.4, 2) + rng.uniform(0.2, 0.5, 2) * np.sin(
        2 * np.pi * rng.uniform(0.1, 0.5, 2) * t + rng.uniform(0, 6, 2)
    )


def record(
    robot: RobotSpec,
    ctrl: np.ndarray,
    motion: str,
    payload: float = 0.0,
    kp: float = 1.0,
    delay: int = 0,
    unit: str = "a",
) -> Sequence:
    """What an arm with other gains and a delay does; kp 1 and delay 0 is the nominal simulator
    itself.
    """
    model = build_model(robot, payload)
    model.actuator_gainprm[:, 0] *= kp
    model.actuator_biasprm[:, 1] *= kp
    data = mujoco.MjData(model)
    data.qpos[:] = ctrl[0]
    qpos = []
    qvel = []
    for t in range(len(ctrl)):
        qpos.append(data.qpos.copy())
        qvel.append(data.qvel.copy())
        data.ctrl[:] = ctrl[max(t - delay, 0)]
        mujoco.mj_step(model, data, robot.decimation)
    meta = SequenceMeta(robot.name, unit, motion, payload, virtual=True)
    return Sequence(meta, robot.joint_names, robot.dt, ctrl, np.array(qpos), np.array(qvel))


def write_dataset(folder: Path, robot: RobotSpec, sequences: list[Sequence]) -> Dataset:
    """Return a dataset of these recordings."""
    data = Dataset.create(folder, robot)
    for sequence in sequences:
        data.append(sequence)
    return data


def recordings(robot: RobotSpec, count: int = 6, rows: int = 150, **how: Any) -> list[Sequence]:
    """Several motions, alternately empty-handed and with 0.2 kg."""
    found = []
    for seed in range(count):
        ctrl = commands(rows, seed)
        found.append(record(robot, ctrl, f"motion{seed}", payload=0.2 * (seed % 2), **how))
    return found
