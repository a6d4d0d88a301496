"""Masses, centres of mass and inertias of a robot's links in log-Cholesky coordinates.

A link's pseudo-inertia P (4 × 4: second moments, first moment and mass) becomes U P Uᵀ with an
upper triangular U: it scales the link's mass, and stretches, shears and shifts where the mass is.
Its 10 log-Cholesky coordinates are zero for the robot's file and keep every link physical (Rucker
and Wensing 2022). They have a Gaussian prior around zero.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import mujoco
import numpy as np

from gaponet.base.arrays import Array
from gaponet.base.text import format_uncertainty
from gaponet.robot.spec import Link, RobotSpec
from gaponet.sim.model import build_model, principal_axes

COORDINATES = 10  # of a link: log of mass, of stretches (3), shears (3) and shifts (3)
# of the prior; shifts relative to the link's length
MASS_LOG_STD = np.log(1.3)
STRETCH_STD = 0.15
SHIFT_STD = 0.15
MIN_LENGTH_M = 0.02
MAX_STD_SHARE = 0.7  # of the prior's; a value with more is not determined


class LinkAxes:
    """Coordinates of links, in standard deviations of their prior, (…, L · COORDINATES); zero is
    the robot's file.

    A link is a body with a joint and those that are welded to it, without payloads. `names` are
    those of the bodies with joints, `bodies` those of all; `scale` are the standard deviations of
    the prior, (L, COORDINATES).
    """

    def __init__(self, robot: RobotSpec) -> None:
        self._robot = robot
        model = build_model(robot.with_table(None))
        data = mujoco.MjData(model)
        data.qpos[:] = model.qpos0
        mujoco.mj_kinematics(model, data)
        # of each link: body, its frame in the link's, P
        self._bodies: list[list[tuple[str, Array, Array]]] = []
        self.names = list[str]()
        scale = list[Array]()
        self._arms = list[Array]()
        bodies: list[str] = []
        for root in range(1, model.nbody):
            own = _bodies_of_link(model, root)
            if not own:
                continue
            members = _members(model, data, root, own)
            self.names.append(model.body(root).name)
            self._bodies.append(members)
            bodies += [name for name, _, _ in members]
            scale.append(_prior_std(model, data, root))
            arm = _centre(model, data, own) - data.xanchor[model.body_jntadr[root]]
            self._arms.append(data.xmat[root].reshape(3, 3).T @ arm)
        self.scale = np.array(scale).reshape(-1, COORDINATES)
        self.bodies = tuple(bodies)

    def links(self, x: Array) -> dict[str, Link]:
        """Return the bodies of links that x (L · COORDINATES,) changes, and those that the robot
        already has.
        """
        links = dict(self._robot.links)
        for own, bodies in zip(x.reshape(-1, COORDINATES) * self.scale, self._bodies, strict=True):
            if not own.any():
                continue
            upper = _upper(own)
            for name, frame, p in bodies:
                links[name] = _link(upper @ p @ upper.T, frame)
        return links

    def inertials(self, x: Array) -> Array:
        """Return mass, centre of mass, principal inertia and its quaternion as MuJoCo has them,
        (bodies, 11).
        """
        links = self.links(np.where(x == 0, 1e-12, x))  # of all bodies, those of the file too
        rows = []
        for name in self.bodies:
            link = links[name]
            rows.append([link.mass, *link.pos, *np.concatenate(principal_axes(link))])
        return np.array(rows)

    def moments(self, x: Array) -> Array:
        """Return mass, kg, centre of mass, m from the file's, and moment about the joint, kg·m,
        (L, 7); body's axes.
        """
        rows = []
        for own, bodies, arm in zip(
            x.reshape(-1, COORDINATES) * self.scale, self._bodies, self._arms, strict=True
        ):
            p = _upper(own) @ sum(p for _, _, p in bodies) @ _upper(own).T
            mass = p[3, 3]
            centre = p[:3, 3] / p[3, 3]
            rows.append([mass, *centre, *mass * (arm + centre)])
        return np.array(rows)


def _bodies_of_link(model: mujoco.MjModel, root: int) -> list[int]:
    """Return the bodies with mass that are welded to a moving body, without payloads.

    Empty if root does not move, or a body has no name or no inertia of its own.
    """
    if model.body_weldid[root] != root or not model.body_jntnum[root]:
        return []
    welded = np.flatnonzero((model.body_weldid == root) & (model.body_mass > 0)).tolist()
    own = [body for body in welded if not model.body(body).name.startswith("payload_")]
    for body in own:
        if not model.body(body).name or model.body_simple[body]:
            return []
    return own


def _centre(model: mujoco.MjModel, data: mujoco.MjData, own: list[int]) -> Array:
    return np.asarray(model.body_mass[own] @ data.xipos[own] / model.body_mass[own].sum())


def _members(
    model: mujoco.MjModel, data: mujoco.MjData, root: int, own: list[int]
) -> list[tuple[str, Array, Array]]:
    """Return name, frame (4, 4) and pseudo-inertia of bodies, about their common centre of mass in
    the axes of root.
    """
    centre = _centre(model, data, own)
    turn = data.xmat[root].reshape(3, 3)
    members = []
    for b in own:
        frame = np.eye(4)
        inertial = np.eye(4)
        frame[:3, :3] = turn.T @ data.xmat[b].reshape(3, 3)
        frame[:3, 3] = turn.T @ (data.xpos[b] - centre)
        inertial[:3, :3] = turn.T @ data.ximat[b].reshape(3, 3)
        inertial[:3, 3] = turn.T @ (data.xipos[b] - centre)
        moments = model.body_inertia[b]
        mass = model.body_mass[b]
        second = np.diag([*(moments.sum() / 2 - moments), mass])
        members.append((model.body(b).name, frame, inertial @ second @ inertial.T))
    return members


def _prior_std(model: mujoco.MjModel, data: mujoco.MjData, root: int) -> Array:
    """Return the standard deviations of a link's coordinates; its length is that to its centre or
    next joint.
    """
    own = model.body_weldid == root
    others = []
    for body in range(1, model.nbody):
        if own[model.body_parentid[body]] and not own[body]:
            others.append(data.xpos[body])
    ends = np.array([*data.xipos[own & (model.body_mass > 0)], *others]) - data.xpos[root]
    length = max(float(np.linalg.norm(ends, axis=1).max()), MIN_LENGTH_M)
    return np.array([MASS_LOG_STD / 2, *[STRETCH_STD] * 6, *[SHIFT_STD * length] * 3])


def _upper(x: Array) -> Array:
    """Return U (4, 4) of log-Cholesky coordinates (COORDINATES,)."""
    u = np.diag(np.exp([*x[1:4], 0.0]))
    u[0, 1], u[0, 2], u[1, 2] = x[4:7]
    u[:3, 3] = x[7:]
    return np.asarray(np.exp(x[0]) * u)


def _link(p: Array, frame: Array) -> Link:
    """Return mass, centre and inertia in a body's frame (4, 4) of a pseudo-inertia (4, 4)."""
    back = np.linalg.inv(frame)
    p = back @ p @ back.T
    centre = p[:3, 3] / p[3, 3]
    second = p[:3, :3] - p[3, 3] * np.outer(centre, centre)
    # a flat link stays physical when its numbers are rounded
    second += 1e-6 * np.trace(second) * np.eye(3)
    inertia = np.trace(second) * np.eye(3) - second
    exact = (p[3, 3], *centre, *np.diag(inertia), *inertia[[0, 0, 1], [1, 2, 2]])
    numbers = [float(f"{number:.9g}") for number in exact]
    return Link(numbers[0], (numbers[1], numbers[2], numbers[3]), tuple(numbers[4:]))


@dataclass(frozen=True)
class LinkResult:
    """Fitted coordinates x (L · COORDINATES,) of links, their covariance, and values (n,) of the
    servos beside them.
    """

    axes: LinkAxes
    x: Array
    covariance: Array
    values: dict[str, Array]
    # field → its change for one of x, (n, Q)
    servo_slopes: dict[str, Array] = field(default_factory=dict)

    def moments(self) -> tuple[Array, Array, Array, Array]:
        """Return `LinkAxes.moments` before and now, their standard errors now and by the prior
        alone, (L, 7) each.
        """
        step = 1e-4
        now = self.axes.moments(self.x)
        ahead = [self.axes.moments(self.x + step * row) for row in np.eye(len(self.x))]
        jac = (np.array(ahead) - now) / step  # (10 L, L, 7)
        std = np.sqrt(np.einsum("plk,pq,qlk->lk", jac, self.covariance, jac))
        return (
            self.axes.moments(np.zeros_like(self.x)),
            now,
            std,
            np.sqrt(np.square(jac).sum(axis=0)),
        )

    def sentences(self) -> list[str]:
        """Return what is known of each link that changed, ± standard errors, and what is not
        determined.
        """
        sentences = []
        for k, (name, before, now, std, prior) in enumerate(
            zip(self.axes.names, *self.moments(), strict=True)
        ):
            if not self.x.reshape(-1, COORDINATES)[k].any():
                continue
            known = std < MAX_STD_SHARE * prior
            moved = known & (abs(now - before) > std)
            parts = []
            if known[0]:
                parts.append(f"{before[0]:.3g} → {format_uncertainty(now[0], std[0])} kg")
            for i, axis in enumerate("xyz", 1):
                if moved[i]:
                    place = format_uncertainty(1e2 * now[i], 1e2 * std[i])
                    parts.append(f"centre of mass {place} cm along {axis}")
            for i, axis in enumerate("xyz", 4):
                if moved[i] and not known[[0, i - 3]].all():
                    moment = format_uncertainty(1e2 * now[i], 1e2 * std[i])
                    parts.append(
                        f"moment about the joint {1e2 * before[i]:.3g} → {moment} kg·cm along "
                        f"{axis}"
                    )
            named = zip(("mass", *"xyz"), known, strict=False)
            unknown = [what for what, is_known in named if not is_known]
            if unknown:
                parts.append(f"not determined by themselves: {', '.join(unknown)}")
            sentences.append(f"{name}: {', '.join(parts)}")
        return sentences
