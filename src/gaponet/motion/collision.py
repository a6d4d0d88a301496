"""Whether a robot would hit itself: distances between capsules along a command.

Shapes come from `collision.toml` in the robot's folder (capsules per body, and groups of bodies that are not compared).
A robot without that file is not checked.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass
from typing import Annotated

import mujoco
import numpy as np
from annotated_types import Interval, Len
from typing_extensions import TypedDict

from gaponet.arrays import Array
from gaponet.errors import RobotError
from gaponet.robot import RobotSpec
from gaponet.structure import read_toml

Metres = Annotated[float, Interval(ge=-100, le=100)]
Point = tuple[Metres, Metres, Metres]
CLEARANCE = 0.03  # m kept between shells: a loaded arm sags by centimetres below what it is told


Capsule = TypedDict("Capsule", {"body": str, "from": Point, "to": Point, "radius": Metres})


@dataclass(frozen=True)
class Box:
    """Half lengths along the axes of the body, for looking at only."""

    body: str
    pos: Point
    size: Point


@dataclass(frozen=True)
class Shapes:
    """collision.toml, or look.toml, which may hold boxes too."""

    capsule: Annotated[tuple[Capsule, ...], Len(0, 1000)] = ()
    same_limb: tuple[str, ...] = ()
    box: Annotated[tuple[Box, ...], Len(0, 1000)] = ()


class Collision:
    """Capsules of one robot and the pairs of them that may meet."""

    def __init__(self, robot: RobotSpec, model: mujoco.MjModel) -> None:
        self.model = model
        self.data = mujoco.MjData(model)
        capsules, groups = _read(robot, model)
        self.names = [c["body"] for c in capsules]
        self.body = np.array([model.body(name).id for name in self.names], int)
        self.ends = np.array([[c["from"], c["to"]] for c in capsules], float).reshape(-1, 2, 3)
        self.radius = np.array([c["radius"] for c in capsules], float)
        self.pairs = np.array(
            [
                (i, k)
                for i, k in itertools.combinations(range(len(capsules)), 2)
                if self.names[i] != self.names[k] and not _grouped(self.names[i], self.names[k], groups)
            ],
            int,
        ).reshape(-1, 2)

    def distance(self, qpos: Array) -> Array:
        """Free space between the two nearest shells at each posture, (T, n) rad → (T,) m; inf without shapes."""
        if not len(self.pairs):
            return np.full(len(qpos), np.inf)
        ends = np.empty((len(qpos), len(self.body), 2, 3))
        for t, q in enumerate(qpos):
            self.data.qpos = q
            mujoco.mj_kinematics(self.model, self.data)
            turn = self.data.xmat[self.body].reshape(-1, 3, 3)
            ends[t] = np.einsum("cij,cej->cei", turn, self.ends) + self.data.xpos[self.body][:, None]
        i, k = self.pairs.T
        between = segment_distance(ends[:, i, 0], ends[:, i, 1], ends[:, k, 0], ends[:, k, 1])
        return (between - self.radius[i] - self.radius[k]).min(axis=1)

    def nearest(self, qpos: Array) -> str:
        """The two bodies that come nearest in one posture (n,) rad, for messages."""
        best = min(range(len(self.pairs)), key=lambda p: self._only(p).distance(qpos[None])[0])
        return " and ".join(self.names[c] for c in self.pairs[best])

    def _only(self, pair: int) -> Collision:
        other = object.__new__(Collision)
        other.__dict__ = self.__dict__ | {"pairs": self.pairs[pair : pair + 1]}
        return other


def segment_distance(a0: Array, a1: Array, b0: Array, b1: Array) -> Array:
    """Distance between segments a0–a1 and b0–b1, (…, 3) each → (…).

    The nearest points of the two lines, clamped to the segments one after the other (Ericson, Real-Time Collision
    Detection, 5.1.9).
    """
    u, v, w = a1 - a0, b1 - b0, a0 - b0
    uu, vv, uv = (u * u).sum(-1), (v * v).sum(-1), (u * v).sum(-1)
    uw, vw = (u * w).sum(-1), (v * w).sum(-1)
    tiny = 1e-12
    s = np.clip((uv * vw - uw * vv) / np.maximum(uu * vv - uv * uv, tiny), 0.0, 1.0)
    t = np.clip((uv * s + vw) / np.maximum(vv, tiny), 0.0, 1.0)
    s = np.clip((uv * t - uw) / np.maximum(uu, tiny), 0.0, 1.0)
    gap = w + s[..., None] * u - t[..., None] * v
    return np.sqrt((gap * gap).sum(-1))


def _read(robot: RobotSpec, model: mujoco.MjModel) -> tuple[list[Capsule], list[list[str]]]:
    path = robot.folder / "collision.toml"
    if not path.is_file():
        return [], []
    table = read_toml(Shapes, path, RobotError, "docs/new-robot.md lists the fields")
    bodies = [model.body(b).name for b in range(model.nbody)]
    for capsule in table.capsule:
        if capsule["body"] not in bodies:
            raise RobotError(f"{path}: capsule names body '{capsule['body']}', the MJCF has: {', '.join(bodies)}")
    return list(table.capsule), [g.split() for g in table.same_limb]


def _grouped(a: str, b: str, groups: list[list[str]]) -> bool:
    """Whether both bodies begin with words of one group."""
    return any(a.startswith(tuple(group)) and b.startswith(tuple(group)) for group in groups)
