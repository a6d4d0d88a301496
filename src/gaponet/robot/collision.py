"""Collision check of commands: distances between capsules of the robot, and from capsules to the
floor or table.

`collision.toml` in the robot's folder holds capsules per body, groups of bodies that are not
compared, and the height of the floor or table. A robot without that file is not checked.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import mujoco
import numpy as np
from annotated_types import Interval, Len
from typing_extensions import TypedDict

from gaponet.base.arrays import Array
from gaponet.base.errors import RobotError
from gaponet.base.structure import read_toml
from gaponet.robot.spec import RobotSpec
from gaponet.robot.toml_file import Metres

Point = tuple[Metres, Metres, Metres]
CLEARANCE_M = 0.03  # between capsules: a loaded arm sags by centimetres below its command
# between checked postures: a hand at 0.7 m moves by less than the clearance
POSTURE_STEP_RAD = 0.03
Radius = Annotated[float, Interval(ge=0, le=100)]
Capsule = TypedDict("Capsule", {"body": str, "from": Point, "to": Point, "radius": Radius})


@dataclass(frozen=True)
class Box:
    """Box for display only; `size` holds half lengths along the axes of the body, m."""

    body: str
    pos: Point
    size: Point


@dataclass(frozen=True)
class Plane:
    """Level floor or table: its height in the MJCF's world, and prefixes of the bodies that stand
    on it.
    """

    height: Metres = 0.0
    stands: str = ""


@dataclass(frozen=True)
class Shapes:
    """Content of collision.toml, or of look.toml, which may also hold boxes."""

    capsule: Annotated[tuple[Capsule, ...], Len(0, 1000)] = ()
    same_limb: tuple[str, ...] = ()
    plane: Plane | None = None
    clearance: Annotated[float, Interval(ge=0, le=1)] = CLEARANCE_M
    box: Annotated[tuple[Box, ...], Len(0, 1000)] = ()


class Collision:
    """Collision model of a robot: capsules, the pairs that can collide, and the capsules that can
    hit the plane.

    Attributes:
        checked: True if the robot has shapes.
        clearance: Minimum distance of a command, m.
        height: Height of the plane in the MJCF's world, m; None without a plane.
    """

    def __init__(
        self,
        robot: RobotSpec,
        model: mujoco.MjModel,
        height: float | None = None,
        unchecked: bool = False,
    ) -> None:
        """
        Args:
            height: Height of the plane, m, instead of that of collision.toml.
            unchecked: Ignore collision.toml.
        """
        self.model = model
        self.data = mujoco.MjData(model)
        shapes = Shapes() if unchecked else read_shapes(robot.folder)
        _require_bodies(robot, model, shapes)
        self.checked = bool(shapes.capsule)
        self.clearance = shapes.clearance
        self.names = [capsule["body"] for capsule in shapes.capsule]
        self.body = np.array([model.body(name).id for name in self.names], int)
        ends = [[capsule["from"], capsule["to"]] for capsule in shapes.capsule]
        self.ends = np.array(ends, float).reshape(-1, 2, 3)
        self.radius = np.array([capsule["radius"] for capsule in shapes.capsule], float)
        self.pairs = self._pairs_that_can_collide(shapes)
        plane = shapes.plane
        self.height = plane.height if height is None and plane else height
        if not abs(self.height or 0.0) <= 10:
            raise RobotError(
                f"the plane is at {self.height:g} m; give its height in metres, up to 10 (--plane)"
            )
        self.above = self._capsules_that_can_hit_plane(plane)

    def _pairs_that_can_collide(self, shapes: Shapes) -> Array:
        """Return the capsules of different bodies that are not of one limb, (pairs, 2)."""
        groups = [group.split() for group in shapes.same_limb]
        pairs = []
        for i, k in itertools.combinations(range(len(self.names)), 2):
            one = self.names[i]
            other = self.names[k]
            if one != other and not _grouped(one, other, groups):
                pairs.append((i, k))
        return np.array(pairs, int).reshape(-1, 2)

    def _capsules_that_can_hit_plane(self, plane: Plane | None) -> Array:
        """Return the capsules of bodies that do not stand on the plane; none without a plane."""
        if self.height is None:
            return np.zeros(0, int)
        stands = tuple(plane.stands.split()) if plane else ()
        above = [i for i, name in enumerate(self.names) if not name.startswith(stands)]
        return np.array(above, int)

    def joints(self) -> Array:
        """Return the indices of the joints that move a capsule; the distances depend on them."""
        moving: set[int] = set()
        for body in self.body:
            while body:  # up to the world, which is body 0
                first = self.model.body_jntadr[body]
                moving.update(range(first, first + self.model.body_jntnum[body]))
                body = self.model.body_parentid[body]
        return np.array(sorted(moving), int)

    def distances(self, qpos: Array) -> Array:
        """Return distances of pairs, then of capsules to the plane, (T, n) rad → (T, pairs +
        capsules) m.
        """
        position = np.empty((len(qpos), len(self.body), 3))
        rotation = np.empty((len(qpos), len(self.body), 9))
        data = self.data
        body = self.body
        for t, q in enumerate(qpos):
            data.qpos = q
            mujoco.mj_kinematics(self.model, data)
            position[t] = data.xpos[body]
            rotation[t] = data.xmat[body]
        ends = (
            self.ends @ rotation.reshape(*rotation.shape[:2], 3, 3).swapaxes(-1, -2)
            + position[:, :, None]
        )
        i, k = self.pairs.T
        between = segment_distance(ends[:, i, 0], ends[:, i, 1], ends[:, k, 0], ends[:, k, 1])
        low = ends[:, self.above][..., 2].min(axis=-1) - (self.height or 0.0)
        return np.concatenate(
            [between - self.radius[i] - self.radius[k], low - self.radius[self.above]], axis=1
        )

    def distance(self, qpos: Array) -> Array:
        """Return the smallest distance at each posture, (T, n) rad → (T,) m; inf without shapes."""
        result: Array = self.distances(qpos).min(axis=1, initial=np.inf)
        return result

    def along(self, ctrl: Array) -> Array:
        """Return the smallest distance of each pair and capsule along a command, (T, n) rad →
        (pairs + capsules,) m.
        """
        result: Array = self.distances(thinned(ctrl)).min(axis=0, initial=np.inf)
        return result

    def nearest(self, free: Array) -> str:
        """Name the nearest pair for messages, from distances (pairs + capsules,) m."""
        at = int(np.argmin(free))
        if at < len(self.pairs):
            return " and ".join(self.names[c] for c in self.pairs[at])
        return f"{self.names[self.above[at - len(self.pairs)]]} and the plane at {self.height:g} m"


def thinned(ctrl: Array) -> Array:
    """Select rows of a command (T, n) rad, so that no joint moves more than POSTURE_STEP_RAD
    between them if possible.
    """
    travelled = np.concatenate([[0.0], np.abs(np.diff(ctrl, axis=0)).max(axis=1).cumsum()])
    marks = np.searchsorted(travelled, np.arange(0.0, travelled[-1], POSTURE_STEP_RAD))
    result: Array = ctrl[np.unique(np.append(marks, len(ctrl) - 1))]
    return result


def segment_distance(a0: Array, a1: Array, b0: Array, b1: Array) -> Array:
    """Return the distance between segments a0–a1 and b0–b1, (…, 3) each → (…).

    The nearest points of the two lines are clamped to the segments in turn (Ericson, Real-Time
    Collision Detection, 5.1.9).
    """
    u = a1 - a0
    v = b1 - b0
    w = a0 - b0
    uu = np.einsum("...i,...i", u, u)
    vv = np.einsum("...i,...i", v, v)
    uv = np.einsum("...i,...i", u, v)
    uw = np.einsum("...i,...i", u, w)
    vw = np.einsum("...i,...i", v, w)
    tiny = 1e-12
    s = np.clip((uv * vw - uw * vv) / np.maximum(uu * vv - uv * uv, tiny), 0.0, 1.0)
    t = np.clip((uv * s + vw) / np.maximum(vv, tiny), 0.0, 1.0)
    s = np.clip((uv * t - uw) / np.maximum(uu, tiny), 0.0, 1.0)
    gap = w + s[..., None] * u - t[..., None] * v
    result: Array = np.sqrt(np.einsum("...i,...i", gap, gap))
    return result


def read_shapes(folder: Path) -> Shapes:
    """Read collision.toml of a robot folder; without the file, return no shapes.

    Raises:
        RobotError: It names the file and the field.
    """
    path = folder / "collision.toml"
    if not path.is_file():
        return Shapes()
    return read_toml(Shapes, path, RobotError, "docs/new-robot.md lists the fields")


def _require_bodies(robot: RobotSpec, model: mujoco.MjModel, shapes: Shapes) -> None:
    bodies = [model.body(b).name for b in range(model.nbody)]
    for capsule in shapes.capsule:
        if capsule["body"] not in bodies:
            path = robot.folder / "collision.toml"
            there = ", ".join(bodies)
            raise RobotError(
                f"{path}: capsule names body '{capsule['body']}', the MJCF has: {there}"
            )


def _grouped(a: str, b: str, groups: list[list[str]]) -> bool:
    """Return True if one group has prefixes of both bodies."""
    return any(a.startswith(tuple(group)) and b.startswith(tuple(group)) for group in groups)
