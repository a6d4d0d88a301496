"""Feasibility of commands, and the nearest feasible one.

Four limits: joint range, joint speed, free space between limbs and above floor or table, and torque
by inverse dynamics of the nominal model at every payload. For a given motion the torque is an
affine function of the payload mass (up to the payload ball's own radius), so the lightest and the
heaviest payload bound all between.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import mujoco
import numpy as np

from gaponet.base.arrays import Array
from gaponet.base.errors import UsageError
from gaponet.motion.motion import GRID, Motion
from gaponet.robot.collision import Collision
from gaponet.robot.spec import RobotSpec
from gaponet.sim.dynamics import inverse_dynamics, static_torque
from gaponet.sim.model import build_model

MAX_PAYLOAD_KG = 3.0  # per hand: the heaviest of the SimLifter recipe, and the default
# Under half of the 9 of the slowest H1-2 arm joint (unitreerobotics/unitree_ros, h1_2.urdf).
MAX_SPEED_RAD_S = 4.0
MAX_CHANGES = 40  # of a motion until it fits
NEARER = 0.93  # of the distance to a posture that is fine, after one change
MIN_SLOWER = 1.03  # factor by which one change slows a motion down, at least
MAX_SLOWER = 1.5  # and at most
RANGE_MARGIN_RAD = 0.02  # kept from a hard stop
MAX_STATIC_SHARE = 0.95  # of the usable torque, to hold a posture: slower motion does not reduce it
TORQUE_SHARE = 0.85  # of the effort limit, for commands; the rest is for feedback, heavier links


@dataclass(frozen=True)
class Demand:
    """The worst that a command demands of any joint, and the free space that it leaves."""

    position: float  # distance from the middle of a joint's range, over half of it
    speed: float  # over MAX_SPEED_RAD_S
    torque: float  # over the usable torque
    gravity: float  # the same at rest
    worst_joint: str  # by torque
    clearance: float  # least free space, m; inf without shapes
    nearest: str  # bodies between which it is; "" without shapes
    clear: bool  # whether it is enough

    @property
    def met(self) -> bool:
        """True if the command is within all limits."""
        return max(self.position, self.speed, self.torque) <= 1.0 + 1e-9 and self.clear


class Feasibility:
    """Limits of one robot at payloads from zero to max_payload."""

    def __init__(
        self,
        robot: RobotSpec,
        max_payload: float = MAX_PAYLOAD_KG,
        height: float | None = None,
        unchecked: bool = False,
    ) -> None:
        """Take a robot's limits.

        Args:
            robot: Its ranges, effort limits and shapes count.
            max_payload: Heaviest payload in each hand, kg.
            height: Of the floor or table, m, instead of collision.toml's.
            unchecked: Ignore all shapes.
        """
        self.robot = robot
        self.low = robot.qpos_range[:, 0] + RANGE_MARGIN_RAD
        self.high = robot.qpos_range[:, 1] - RANGE_MARGIN_RAD
        self.max_payload = max_payload if robot.payload_mounts else 0.0
        self.models: list[mujoco.MjModel] = []
        for payload in sorted({0.0, self.max_payload}):
            self.models.append(build_model(robot, payload, dt=GRID))
        self.limit = TORQUE_SHARE * robot.servo.effort_limit
        self.collision = Collision(robot, self.models[0], height, unchecked)

    def reach(self) -> tuple[Array, Array]:
        """Return the lowest and highest angles that are worth a visit, (n) rad each.

        A joint that turns without end is moved by half a turn to both sides of its home.
        """
        home = self.robot.qpos_home
        low = np.where(np.isfinite(self.low), self.low, home - np.pi)
        high = np.where(np.isfinite(self.high), self.high, home + np.pi)
        return low, high

    def demand(
        self, ctrl: Array, dt: float, named: Array | slice = slice(None), need: Array | None = None
    ) -> Demand:
        """Return the demand of a command.

        Args:
            ctrl: Command, (T, n) rad.
            dt: Its period, s.
            named: Columns of joints that must be within their ranges; speed, torque and free space
                are those of all joints.
            need: Free space to keep, (pairs + capsules,) m as in Collision.along; default: the
                clearance.
        """
        qvel = np.gradient(ctrl, dt, axis=0)
        qacc = np.gradient(qvel, dt, axis=0)
        zero = np.zeros_like(ctrl)
        torque = self._torque_share(ctrl, qvel, qacc)  # (T, n)
        torque_at_rest = self._torque_share(ctrl, zero, zero)
        space = self.collision.along(ctrl)  # (pairs + capsules,) m, empty without shapes
        required = self.collision.clearance if need is None else need
        with np.errstate(invalid="ignore"):  # joints without a limit: inf − inf, inf / inf
            centre = (self.low + self.high) / 2
            half = (self.high - self.low) / 2
            position = np.nan_to_num(np.abs(ctrl - centre) / half, nan=0.0)  # (T, n)
        return Demand(
            position=float(position[:, named].max()),
            speed=float(np.abs(qvel).max() / MAX_SPEED_RAD_S),
            torque=float(torque.max()),
            gravity=float(torque_at_rest.max()),
            worst_joint=self.robot.joint_names[int(torque.max(axis=0).argmax())],
            clearance=float(space.min(initial=np.inf)),
            nearest=self.collision.nearest(space) if len(space) else "",
            clear=bool((space >= required).all()),
        )

    def _torque_share(self, qpos: Array, qvel: Array, qacc: Array) -> Array:
        """Return the largest |torque| over payloads as a share of the usable one, (T, n)."""
        torques = [np.abs(inverse_dynamics(model, qpos, qvel, qacc)) for model in self.models]
        share: Array = np.max(torques, axis=0) / self.limit
        return share

    def fit(self, motion: Motion, need: Array | None = None) -> Motion:
        """Slow the motion down, or bring it nearer to a posture that is fine, until it fits.

        It is slowed where speed or acceleration demand too much, and brought nearer where even
        standing still does or where limbs meet: to its own start if that is fine, else to the
        robot's home. Joints that it does not name stay.

        Raises:
            UsageError: It does not fit after MAX_CHANGES changes; the message says what exceeds a
                limit.
        """
        named = self.robot.index(motion.named(self.robot))
        low = np.full_like(self.low, -np.inf)
        low[named] = self.low[named]
        high = np.full_like(self.high, np.inf)
        high[named] = self.high[named]
        ctrl = np.clip(motion.ctrl, low, high)
        anchor = ctrl[0].copy()  # the posture that is fine, (n) rad
        if not self.can_hold(anchor, need):  # of all joints, those that are only held too
            anchor[named] = np.clip(self.robot.qpos_home, low, high)[named]
        for _ in range(MAX_CHANGES):
            demand = self.demand(ctrl, motion.dt, named, need)
            if demand.met:
                return replace(motion, ctrl=ctrl)
            if demand.gravity > MAX_STATIC_SHARE or not demand.clear:
                ctrl = anchor + NEARER * (ctrl - anchor)
            else:
                # torque of acceleration falls with the square of the duration
                slower = max(demand.speed, demand.torque**0.5, MIN_SLOWER)
                ctrl = stretch(ctrl, min(slower, MAX_SLOWER))
            ctrl = np.clip(ctrl, low, high)
        raise UsageError(
            f"motion '{motion.name}' does not fit {self.robot.name} after {MAX_CHANGES} changes: "
            f"{demand.worst_joint} needs {demand.torque:.2f} of its usable torque at "
            f"{self.max_payload:g} kg, speed is {demand.speed:.2f} of {MAX_SPEED_RAD_S:g} rad/s"
            f"{self._space_left(demand)}. Start it from a posture that is easier to hold, or "
            "collect with a lighter payload"
        )

    def _space_left(self, demand: Demand) -> str:
        """Say how near bodies come; nothing of a robot without shapes."""
        if not demand.nearest:
            return ""
        return (
            f", {demand.nearest} come as near as {demand.clearance * 100:.1f} cm (at least "
            f"{self.collision.clearance * 100:g})"
        )

    def can_hold(self, posture: Array, need: Array | None = None) -> bool:
        """Return True if a posture (n,) rad can be held at every payload, clear of the body.

        `need` is as in `demand`.
        """
        demand = self.demand(np.repeat(posture[None], 2, axis=0), GRID, need=need)
        return demand.gravity <= MAX_STATIC_SHARE and demand.clear


def stretch(ctrl: Array, factor: float) -> Array:
    """Return the same path (T, n), `factor` times slower, on the same grid."""
    from scipy.interpolate import CubicSpline

    rows = round((len(ctrl) - 1) * factor) + 1
    path = CubicSpline(np.arange(len(ctrl)), ctrl)
    result: Array = path(np.linspace(0, len(ctrl) - 1, rows))
    return result


GRID_POINTS = 41  # across the range
MAX_POSTURES = 400
# Of the joint's range; then the search ends. The margins to the stops take 1 or 2 %.
ENOUGH_RANGE_SHARE = 0.91
GRAVITY_SHARE = 0.9  # of the usable torque: leaves some to accelerate


@dataclass(frozen=True)
class ExcitationRange:
    """A posture (n,) rad and the interval of one joint that can be held from there at every
    payload.
    """

    posture: Array
    low: float
    high: float
    share: float  # of the joint's range


def find_excitation_range(limits: Feasibility, joint: str, seed: int = 0) -> ExcitationRange:
    """Return a posture near home from which `joint` reaches most of its range, clear of the body,
    at every payload.

    Home is tried first; then the other operated joints of the limb are varied at random, more and
    more.
    """
    robot = limits.robot
    j = robot.index([joint])[0]
    limb = _limb(limits.models[0], robot.operated, joint)
    columns = robot.index([name for name in limb if name != joint])
    rng = np.random.default_rng([seed, j])
    low, high = limits.reach()
    home = np.clip(robot.qpos_home, low, high)
    best = _span(limits, home, int(j))
    for i in range(MAX_POSTURES):
        if best.share >= ENOUGH_RANGE_SHARE:
            break
        posture = home.copy()
        furthest = min(1.0, 1.5 * i / MAX_POSTURES)  # share of the way; near home first
        share = furthest * rng.uniform(0, 1, len(columns))
        anywhere = rng.uniform(low[columns], high[columns])
        posture[columns] += share * (anywhere - home[columns])
        candidate = _span(limits, posture, int(j))
        if candidate.share > best.share:
            best = candidate
    return best


def _span(limits: Feasibility, posture: Array, j: int) -> ExcitationRange:
    """Return the longest feasible interval of the joint's range from a posture."""
    reach_low, reach_high = limits.reach()
    grid = np.linspace(reach_low[j], reach_high[j], GRID_POINTS)
    rows = np.repeat(posture[None], GRID_POINTS, axis=0)
    rows[:, j] = grid
    empty = ExcitationRange(posture, grid[0], grid[0], 0.0)
    fits = limits.collision.distance(rows) >= limits.collision.clearance  # (GRID_POINTS,)
    # torques take longer: only where at least half of the range is clear
    start, stop = _longest_run(fits)
    if stop - start < GRID_POINTS // 2:
        return empty
    torques = [np.abs(static_torque(model, rows)) for model in limits.models]
    share = np.max(torques, axis=0) / limits.limit
    fits &= (share <= GRAVITY_SHARE).all(axis=1)
    start, stop = _longest_run(fits)
    if stop == start:
        return empty
    low = float(grid[start])
    high = float(grid[stop - 1])
    full = float(reach_high[j] - reach_low[j]) + 2 * RANGE_MARGIN_RAD  # of the joint, rad
    return ExcitationRange(posture, low, high, (high - low) / full)


def _longest_run(mask: Array) -> tuple[int, int]:
    """Return start and stop of the longest run of True."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], mask, [False]]).astype(int)))
    if not len(edges):
        return 0, 0
    runs = edges.reshape(-1, 2)
    start, stop = runs[np.argmax(runs[:, 1] - runs[:, 0])]
    return int(start), int(stop)


def _limb(model: mujoco.MjModel, operated: tuple[str, ...], joint: str) -> list[str]:
    """Return the operated joints on the chain of `joint`: those that it carries and those that
    carry it.
    """
    body_of = {name: int(model.joint(name).bodyid[0]) for name in operated}
    body = body_of[joint]
    limb = []
    for name, other in body_of.items():
        if other in carriers(model, body) or body in carriers(model, other):
            limb.append(name)
    return limb


def carriers(model: mujoco.MjModel, body: int) -> set[int]:
    """Return a body and its parents, without the world."""
    chain = set()
    while body:
        chain.add(body)
        body = int(model.body_parentid[body])
    return chain
