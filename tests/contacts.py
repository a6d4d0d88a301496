"""Contacts of a posture as MuJoCo's own collision finds them: a judge written apart from what the
package checks with.

Every capsule of a robot's collision.toml becomes a geom, so do the shapes of robot.xml of bodies
that have none, and the floor or table becomes a plane. Left out are pairs of bodies of one group of
collision.toml, and of a body, the one that carries it and the one that carries that.
"""

from __future__ import annotations

import itertools
import tomllib
from typing import Any

import mujoco
import numpy as np

from gaponet.robot.spec import RobotSpec


def add_shapes(spec: mujoco.MjSpec, table: dict[str, Any]) -> None:
    """Capsules in place of the shapes of their bodies, and the plane."""
    shelled = {c["body"] for c in table["capsule"]}
    for body in spec.bodies:
        for geom in body.geoms:
            geom.contype = geom.conaffinity = int(body.name not in shelled)
    for c in table["capsule"]:
        spec.body(c["body"]).add_geom(
            type=mujoco.mjtGeom.mjGEOM_CAPSULE,
            fromto=[*c["from"], *c["to"]],
            size=[c["radius"], 0, 0],
            mass=0,
        )
    spec.worldbody.add_geom(
        name="plane",
        type=mujoco.mjtGeom.mjGEOM_PLANE,
        pos=[0, 0, table["plane"]["height"]],
        size=[5, 5, 1],
    )


def exclude_limbs(spec: mujoco.MjSpec, table: dict[str, Any]) -> None:
    """Leave out pairs of one group, and of bodies that carry each other."""
    groups = [tuple(group.split()) for group in table["same_limb"]]
    bodies = [body.name for body in spec.bodies if body.name != "world"]
    for a, b in itertools.combinations(bodies, 2):
        parent = spec.body(b).parent
        carried_by = [parent.name, getattr(parent.parent, "name", "")]
        if any(a.startswith(g) and b.startswith(g) for g in groups) or a in carried_by:
            spec.add_exclude(bodyname1=a, bodyname2=b)


def exclude_feet(spec: mujoco.MjSpec, table: dict[str, Any]) -> None:
    """Leave out what stands on the plane."""
    standing = tuple(table["plane"]["stands"].split())
    for body in spec.bodies:
        if body.name.startswith(standing) or "ankle" in body.name:
            spec.add_exclude(bodyname1="world", bodyname2=body.name)


class Contacts:
    """The judge of one robot.

    Attributes:
        model: MuJoCo model of shapes alone.
    """

    def __init__(self, robot: RobotSpec) -> None:
        table = tomllib.loads((robot.folder / "collision.toml").read_text())
        spec = mujoco.MjSpec.from_file(str(robot.mjcf))
        spec.option.disableflags &= ~int(mujoco.mjtDisableBit.mjDSBL_CONTACT)
        add_shapes(spec, table)
        exclude_limbs(spec, table)
        exclude_feet(spec, table)
        self.model = spec.compile()
        self.data = mujoco.MjData(self.model)
        self.model.geom_margin[:] = 0.0

    def deepest(self, qpos: np.ndarray) -> tuple[float, str]:
        """How deep the worst contact of a posture (n,) rad is, m, and between which bodies; 0 where
        nothing touches.
        """
        self.data.qpos = qpos
        mujoco.mj_kinematics(self.model, self.data)
        mujoco.mj_collision(self.model, self.data)
        found = [(-c.dist, c.geom) for c in self.data.contact if c.dist < 0]
        if not found:
            return 0.0, ""
        depth, geoms = max(found, key=lambda f: f[0])
        return float(depth), " and ".join(
            self.model.body(self.model.geom_bodyid[g]).name for g in geoms
        )

    def along(self, ctrl: np.ndarray, step: float = 0.01) -> tuple[float, str]:
        """The deepest along a command (T, n) rad, joint lines between its rows divided into at most
        `step` rad.
        """
        worst = (0.0, "")
        for a, b in itertools.pairwise(ctrl):
            for share in np.arange(0, 1, step / max(float(np.abs(b - a).max()), step)):
                worst = max(worst, self.deepest(a + share * (b - a)))
        return max(worst, self.deepest(ctrl[-1]))
