"""Contacts of the robot: its tips against a level table. Without a table there is no contact."""

from __future__ import annotations

from typing import TYPE_CHECKING

import mujoco
import numpy as np

from gaponet.base.errors import RobotError
from gaponet.robot.spec import RobotSpec

if TYPE_CHECKING:
    from mujoco.batch import Batch

Array = np.ndarray

TABLE = "gaponet_table"
IMPEDANCE = 0.5  # of the contact: with a constant one its stiffness in N/m does not depend on the posture
SIZE = 2.0  # m, for looking at


def add_table(spec: mujoco.MjSpec, robot: RobotSpec) -> None:
    """A plane, a sphere per tip, and contacts between them alone, where the robot has a table."""
    if robot.table is None:
        return
    spec.option.disableflags &= ~int(mujoco.mjtDisableBit.mjDSBL_CONTACT)
    spec.option.cone = mujoco.mjtCone.mjCONE_ELLIPTIC  # a pyramid's stiffness depends on friction
    for geom in spec.geoms:
        geom.contype, geom.conaffinity = 0, 0
    for pair in list(spec.pairs):
        spec.delete(pair)
    # Marked as touching, though by nothing but the pairs below: what touches nothing is not compiled (bare).
    spec.worldbody.add_geom(
        name=TABLE, type=mujoco.mjtGeom.mjGEOM_PLANE, size=(SIZE, SIZE, 0.1), pos=(0, 0, robot.table.height),
        contype=2, conaffinity=0, rgba=(0.55, 0.5, 0.45, 1),
    )  # fmt: skip
    for i, tip in enumerate(robot.tips):
        body = spec.body(tip.body)
        if body is None:
            raise RobotError(f"{robot.mjcf}: a [[tip]] names body '{tip.body}', which is missing")
        name = f"{TABLE}_tip_{i}"
        body.add_geom(
            name=name, type=mujoco.mjtGeom.mjGEOM_SPHERE, size=(tip.radius, 0, 0), pos=tip.pos, mass=0.0,
            contype=0, conaffinity=4, rgba=(0.3, 0.3, 0.3, 1),
        )  # fmt: skip
        slide = robot.table.friction
        spec.add_pair(
            geomname1=name, geomname2=TABLE, condim=3, friction=(slide, slide, 0.005, 1e-4, 1e-4),
            solimp=(IMPEDANCE, IMPEDANCE, 0.001, 0.5, 2.0),
        )  # fmt: skip


def soften_table(model: mujoco.MjModel, robot: RobotSpec) -> None:
    """Give the contacts of a compiled model the table's stiffness, critically damped."""
    if robot.table is not None:
        model.pair_solref[:] = _solref(model, np.array(robot.table.stiffness))


def write_table(batch: Batch, model: mujoco.MjModel, height: Array, friction: Array, stiffness: Array) -> None:
    """Give every simulation of a batch a table of its own, (nsim,) m, 1 and N/m; their model has one."""
    batch.expand("geom_pos")[:, model.geom(TABLE).id, 2] = height
    batch.expand("pair_friction")[:, :, :2] = friction[:, None, None]
    batch.expand("pair_solref")[:] = _solref(model, stiffness)


def _solref(model: mujoco.MjModel, stiffness: Array) -> Array:
    """The pairs' direct solref for stiffnesses (…) in N/m, (…, npair, 2).

    A contact at rest pushes with d²k/((1 − d)·w) N per metre, w the mobility of the bodies that touch.
    """
    bodies = model.geom_bodyid[np.stack([model.pair_geom1, model.pair_geom2])]
    mobility = model.body_invweight0[bodies, 0].sum(axis=0)
    k = stiffness[..., None] * (1 - IMPEDANCE) * mobility / IMPEDANCE**2
    return np.stack([-k * IMPEDANCE**2, -2 * np.sqrt(k) * IMPEDANCE], axis=-1)
