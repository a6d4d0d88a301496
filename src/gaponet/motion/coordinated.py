"""Coordinated motions: arms and torso with a load in the hands, legs in the air, and tours of the
joint space.

Each function takes a Kit, the sides that act (motions of arms) and a seeded generator, and returns
targets (T, n) rad on the motion grid. World frame: x forward, y left, z up; the H1-2 shoulder is at
z = 1.45 m and a hand reaches 0.6 m from it. Sideways numbers are given for the left arm and
mirrored for the right one. The base is fixed.

An arm is found by joint names, `<side>_shoulder_pitch…`, `…shoulder_roll…`, `…shoulder_yaw…`,
`…elbow…` and `…wrist_roll…`, with a payload mount of the same side as its hand. Robots without such
names have no arm motions.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import mujoco
import numpy as np

from gaponet.base.arrays import Array
from gaponet.motion.feasible import Feasibility
from gaponet.motion.motion import GRID, fade, through
from gaponet.robot.spec import RobotSpec

Sides = tuple[str, ...]
MAX_IK_ITERATIONS = 80
MAX_IK_STEP_RAD = 0.3  # of a joint in one iteration
IK_TOLERANCE_M = 1e-4
IK_DAMPING = 1e-3  # m²
IK_PULL = 0.1  # of the way back to the start, in the null space of one iteration
DURATION_S = 8.0  # of most whole-body motions
BOX_SHARE = 0.3  # of a joint's range, half the width of a box of targets
MAX_BOX_RAD = 0.8  # the same
ENDLESS_RAD = 2.0  # that counts as the range of a joint without one
# Rows between postures that are computed on a path of the hands; a spline goes through them.
KNOT_ROWS = 10
ROLES = ("shoulder_pitch", "shoulder_roll", "shoulder_yaw", "elbow", "wrist_roll")


@dataclass(frozen=True)
class Arm:
    """One arm."""

    side: str  # left or right
    sign: float  # +1 left, −1 right: multiplies every sideways (y) quantity
    columns: Array  # positions of ROLES in robot.joint_names, (5,)
    hand: str  # MuJoCo body at the palm

    def column(self, role: str) -> int:
        """Return the position of a joint of ROLES in robot.joint_names."""
        return int(self.columns[ROLES.index(role)])

    def mirrored(self, point: Array | list[float]) -> Array:
        """Return points (…, 3) m of the left hand for this one."""
        return np.asarray(point) * [1.0, self.sign, 1.0]


def arms(robot: RobotSpec) -> dict[str, Arm]:
    """The robot's arms by side; empty for a robot that is not built like that."""
    by_side = {}
    for mount in robot.payload_mounts:
        joints = _joints_of_arm(robot, mount.side)
        if joints is not None:
            sign = -1.0 if mount.side == "right" else 1.0
            columns = robot.index(joints)
            by_side[mount.side] = Arm(mount.side, sign, columns, f"payload_{mount.side}")
    return by_side


def _joints_of_arm(robot: RobotSpec, side: str) -> list[str] | None:
    """Return the joints of an arm in the order of ROLES; None if one is missing or not unique."""
    joints = []
    for role in ROLES:
        named = [name for name in robot.joint_names if name.startswith(f"{side}_{role}")]
        if len(named) != 1:
            return None
        joints += named
    return joints


class HandIK:
    """Inverse kinematics of one arm by damped least squares.

    The null space is pulled towards the start.
    """

    def __init__(self, limits: Feasibility, arm: Arm) -> None:
        self.model = limits.models[0]
        self.data = mujoco.MjData(self.model)
        self.arm = arm
        self.body = self.model.body(arm.hand).id
        self.low = limits.low[arm.columns]
        self.high = limits.high[arm.columns]

    def position(self, qpos: Array) -> Array:
        """Palm centre in the world at a posture (n,), (3,) m."""
        self.data.qpos = qpos
        mujoco.mj_kinematics(self.model, self.data)
        result: Array = self.data.xpos[self.body].copy()
        return result

    def solve(self, qpos: Array, target: Array) -> Array:
        """Joint positions (n,) that bring the palm as near to target (3,) m as limits allow.

        Args:
            qpos: Posture from which the search starts, (n,) rad.
            target: Of the palm, (3,) m in the world.
        """
        q = np.array(qpos, float)
        columns = self.arm.columns
        rest = q[columns].copy()
        jacobian = np.zeros((3, self.model.nv))
        for _ in range(MAX_IK_ITERATIONS):
            error = target - self.position(q)
            if np.linalg.norm(error) < IK_TOLERANCE_M:
                break
            mujoco.mj_comPos(self.model, self.data)
            mujoco.mj_jacBody(self.model, self.data, jacobian, None, self.body)
            J = jacobian[:, columns]  # (3, ROLES)
            inverse = J.T @ np.linalg.inv(J @ J.T + IK_DAMPING * np.eye(3))
            null_space = np.eye(len(rest)) - inverse @ J
            pull = null_space @ (rest - q[columns])
            step = inverse @ error + IK_PULL * pull
            step = np.clip(step, -MAX_IK_STEP_RAD, MAX_IK_STEP_RAD)
            q[columns] = np.clip(q[columns] + step, self.low, self.high)
        return q

    def path(self, qpos: Array, targets: Array) -> Array:
        """One posture per target (k, 3), each from the one before: (k, n)."""
        postures = []
        for target in targets:
            qpos = self.solve(qpos, target)
            postures.append(qpos)
        return np.array(postures)


# Elbows bent, hands in front of the belly: the posture from which people start; (ROLES), rad, left
# arm.
READY = np.array([0.15, 0.25, 0.0, 0.35, 0.0])
MIRROR = np.array([1.0, -1.0, -1.0, 1.0, -1.0])  # roll, yaw and wrist roll change sign on the right


class Kit:
    """A robot's arms, their kinematics and the ready posture."""

    def __init__(self, limits: Feasibility) -> None:
        self.limits = limits
        self.robot = limits.robot
        self.arms = arms(limits.robot)
        self.ik = {side: HandIK(limits, arm) for side, arm in self.arms.items()}
        self.ready = limits.robot.qpos_home.copy()
        for arm in self.arms.values():
            self.ready[arm.columns] = mirrored(READY, arm)

    def posture(self, **values: Array | list[float]) -> Array:
        """The ready posture with some arms at left-arm angles (ROLES), mirrored where needed;
        (n,) rad.
        """
        q = self.ready.copy()
        for side, angles in values.items():
            arm = self.arms[side]
            q[arm.columns] = mirrored(np.asarray(angles), arm)
        result: Array = np.clip(q, self.limits.low, self.limits.high)
        return result

    def at(self, q: Array, sides: Sides, point: Array | list[float], roll: float = 0.0) -> Array:
        """Posture q with these hands at a point, and their wrists rolled.

        Args:
            q: (n,) rad.
            sides: Arms that move.
            point: Of the left hand, (3,) m; the right one mirrors it.
            roll: Of the left wrist, rad.
        """
        for side in sides:
            arm = self.arms[side]
            q = self.ik[side].solve(q, arm.mirrored(point))
            q[arm.column("wrist_roll")] = arm.sign * roll
        return q


def mirrored(angles: Array, arm: Arm) -> Array:
    """Return left-arm angles (ROLES) for an arm."""
    return angles * MIRROR if arm.sign < 0 else angles


def reach(kit: Kit, sides: Sides, rng: np.random.Generator) -> Array:
    """Hands to four random places in front, with a rest at each."""
    stops = [kit.ready]
    for _ in range(4):
        q = kit.ready
        for side in sides:
            point = rng.uniform([0.25, 0.08, 0.95], [0.5, 0.45, 1.45])
            roll = rng.uniform(-1.2, 1.2)
            q = kit.at(q, (side,), point, roll)
        stops.append(q)
    return _stops(stops, rng.uniform(0.8, 1.4), 0.4)


def pick_and_place(kit: Kit, sides: Sides, rng: np.random.Generator) -> Array:
    """Over a table: lower, lift, move across, lower, leave."""
    height = rng.uniform(0.92, 1.05)
    stops = [kit.ready]
    for _ in range(2):
        start = rng.uniform([0.3, 0.1], [0.45, 0.4])
        stop = rng.uniform([0.3, 0.1], [0.45, 0.4])
        roll = rng.uniform(-1.0, 1.0)
        way = (
            (start, 0.15),
            (start, 0.0),
            (start, 0.18),
            (stop, 0.18),
            (stop, 0.0),
            (stop, 0.15),
        )
        for xy, above_table in way:
            stops.append(kit.at(stops[-1], sides, [*xy, height + above_table], roll))
    return _stops(stops, 0.7, 0.15)


def lift(kit: Kit, sides: Sides, rng: np.random.Generator) -> Array:
    """Lift from the waist to the shoulder and down again, twice, to random heights."""
    stops = [kit.ready]
    x = rng.uniform(0.3, 0.4)
    y = rng.uniform(0.15, 0.3)
    for z in rng.uniform([0.9, 1.3, 0.9, 1.35], [1.0, 1.5, 1.05, 1.55]):
        stops.append(kit.at(stops[-1], sides, [x, y, z]))
    return _stops([*stops, kit.ready], 1.4, 0.5)


def punch(kit: Kit, sides: Sides, rng: np.random.Generator) -> Array:
    """Four quick stretches forward from a guard, sides in turn."""
    guard = kit.posture(**{side: [-0.5, 0.25, 0.1, -0.4, 0.0] for side in sides})
    stops = [kit.ready, guard]
    for i in range(4):
        side = sides[i % len(sides)]
        point = rng.uniform([0.48, 0.1, 1.25], [0.56, 0.25, 1.45])
        stops += [kit.at(guard, (side,), point), guard]
    return _stops(stops, 0.5, 0.25)


def wave(kit: Kit, sides: Sides, rng: np.random.Generator) -> Array:
    """Upper arm out and up, then forearm from side to side."""
    angles = {}
    for side in sides:
        pitch = rng.uniform(-0.6, -0.2)
        roll = rng.uniform(1.0, 1.4)
        angles[side] = [pitch, roll, 0.0, -0.5, 0.0]
    raised = kit.posture(**angles)
    ctrl = _stops([kit.ready, raised], 1.6, 0.4)
    steps = round(rng.uniform(4.0, 5.0) / GRID)
    phase = 2 * np.pi * rng.uniform(0.5, 0.9) * np.arange(steps) * GRID
    swing = np.repeat(raised[None], steps, axis=0)
    window = fade(steps, GRID, 1.0)
    for side in sides:
        arm = kit.arms[side]
        swing[:, arm.column("shoulder_yaw")] += 0.4 * np.sin(phase) * window
        swing[:, arm.column("elbow")] += 0.25 * np.sin(phase + 1.0) * window
    return np.concatenate([ctrl, swing, _stops([raised, kit.ready], 1.6, 0.4)])


def stir(kit: Kit, sides: Sides, rng: np.random.Generator) -> Array:
    """Circles over a table, growing and shrinking."""
    steps = round(6.5 / GRID)
    centre = rng.uniform([0.32, 0.15, 1.0], [0.4, 0.3, 1.15])
    phase = 2 * np.pi * rng.uniform(0.4, 0.7) * np.arange(steps) * GRID
    radius = rng.uniform(0.07, 0.11) * fade(steps, GRID, 1.5)
    around = np.stack([np.cos(phase), np.sin(phase), 0.2 * np.sin(phase / 2)], axis=1)
    circle = centre + radius[:, None] * around
    return _along(kit, dict.fromkeys(sides, circle))


def mirror(kit: Kit, sides: Sides, rng: np.random.Generator) -> Array:
    """Both hands on upright ovals, together or in turn."""
    steps = round(6.5 / GRID)
    centre = rng.uniform([0.33, 0.2, 1.15], [0.4, 0.3, 1.3])
    phase = 2 * np.pi * rng.uniform(0.3, 0.5) * np.arange(steps) * GRID
    size = rng.uniform(0.08, 0.14) * fade(steps, GRID, 1.5)
    lag = rng.choice([0.0, np.pi])
    paths = {}
    for i, side in enumerate(sides):
        of_side = phase + i * lag
        oval = np.stack([0.5 * np.cos(of_side), 0.6 * np.sin(of_side), np.cos(of_side)], axis=1)
        paths[side] = centre + size[:, None] * oval
    return _along(kit, paths)


def carry(kit: Kit, sides: Sides, rng: np.random.Generator) -> Array:
    """Load before the chest while the torso turns and the arms give a little at walking pace."""
    held = kit.ready
    for side in sides:
        held = kit.at(held, (side,), rng.uniform([0.33, 0.12, 1.1], [0.42, 0.22, 1.25]))
    steps = round(6.0 / GRID)
    time = np.arange(steps) * GRID
    window = fade(steps, GRID, 1.5)
    ctrl = np.repeat(held[None], steps, axis=0)
    _add(ctrl, kit, "torso", rng.uniform(0.2, 0.4) * np.sin(2 * np.pi * 0.25 * time) * window)
    bounce = 0.05 * np.sin(2 * np.pi * rng.uniform(0.8, 1.2) * time) * window
    for side in sides:
        arm = kit.arms[side]
        ctrl[:, arm.column("shoulder_pitch")] += bounce
        ctrl[:, arm.column("elbow")] -= 0.7 * bounce
    before = _stops([kit.ready, held], 1.2, 0.3)
    after = _stops([held, kit.ready], 1.2, 0.3)
    return np.concatenate([before, ctrl, after])


def wander(kit: Kit, sides: Sides, rng: np.random.Generator) -> Array:
    """Move all joints of the arms at once, on slow sines with random phases.

    These are states that no task passes through.
    """
    steps = round(8.0 / GRID)
    time = np.arange(steps) * GRID
    ctrl = np.repeat(kit.ready[None], steps, axis=0)
    size = np.array([0.5, 0.35, 0.6, 0.6, 0.9])
    for side in sides:
        for column, amplitude in zip(kit.arms[side].columns, size, strict=True):
            ctrl[:, column] += amplitude * _sines(time, 0.6, rng) * fade(steps, GRID, 2.0)
    return ctrl


BUILDERS: dict[str, Callable[[Kit, Sides, np.random.Generator], Array]] = {
    f.__name__: f for f in (reach, pick_and_place, lift, punch, wave, stir, mirror, carry, wander)
}


def _sines(time: Array, most: float, rng: np.random.Generator) -> Array:
    """Mean of three sines of random phases and frequencies from 0.1 to `most` Hz, (T,)."""
    frequency = rng.uniform(0.1, most, 3)
    phase = rng.uniform(0, 2 * np.pi, 3)
    waves = np.sin(2 * np.pi * np.outer(time, frequency) + phase)
    return np.asarray(waves.mean(axis=1))


def _stops(stops: list[Array], move: float, hold: float) -> Array:
    """Move all joints to each posture in turn: `move` s for the way, `hold` s of rest at each."""
    count = len(stops)
    return through(np.array(stops), np.full(count - 1, move), np.full(count, hold), GRID)


def _along(kit: Kit, paths: dict[str, Array]) -> Array:
    """Hands along left-arm paths (T, 3), between two moves from and to the ready posture."""
    from scipy.interpolate import CubicSpline

    rows = len(next(iter(paths.values())))
    knots = np.unique(np.append(np.arange(0, rows, KNOT_ROWS), rows - 1))
    q = np.repeat(kit.ready[None], len(knots), axis=0)
    for side, path in paths.items():
        arm = kit.arms[side]
        postures = kit.ik[side].path(kit.ready, arm.mirrored(path[knots]))
        q[:, arm.columns] = postures[:, arm.columns]
    before = _stops([kit.ready, q[0]], 1.2, 0.3)
    middle = CubicSpline(knots, q)(np.arange(rows))
    after = _stops([q[-1], kit.ready], 1.2, 0.3)
    return np.concatenate([before, middle, after])


def squat(kit: Kit, rng: np.random.Generator) -> Array:
    """Hips, knees and ankles together, twice, arms forward as a counterweight."""
    depth = rng.uniform(0.5, 0.9)
    down = kit.ready.copy()
    for side in ("left", "right"):
        _add(down, kit, f"{side}_hip_pitch", -depth)
        _add(down, kit, f"{side}_knee", 2 * depth)
        _add(down, kit, f"{side}_ankle_pitch", -depth * 0.9)
    for arm in kit.arms.values():
        down[arm.column("shoulder_pitch")] -= rng.uniform(0.3, 0.6)
    return _stops([kit.ready, down, kit.ready, down, kit.ready], rng.uniform(1.3, 1.7), 0.4)


def march(kit: Kit, rng: np.random.Generator) -> Array:
    """Legs in turn, arms against them, torso a little: the rhythm of a gait."""
    time, ctrl, window = _start(kit)
    phase = 2 * np.pi * rng.uniform(0.5, 0.8) * time
    size = rng.uniform(0.25, 0.4)
    for side, of_leg in (("left", phase), ("right", phase + np.pi)):
        swing = np.sin(of_leg) * window
        lift = np.maximum(np.sin(of_leg), 0.0) ** 2 * window
        _add(ctrl, kit, f"{side}_hip_pitch", -size * swing)
        _add(ctrl, kit, f"{side}_knee", 2.0 * size * lift)
        _add(ctrl, kit, f"{side}_ankle_pitch", -0.6 * size * lift)
        if side in kit.arms:
            arm = kit.arms[side]
            ctrl[:, arm.column("shoulder_pitch")] += 0.8 * size * swing
            ctrl[:, arm.column("elbow")] -= 0.4 * size * swing
    _add(ctrl, kit, "torso", 0.3 * size * np.sin(phase) * window)
    return ctrl


def sway(kit: Kit, rng: np.random.Generator) -> Array:
    """Sway from side to side with hip and ankle roll while the torso turns and the arms open."""
    time, ctrl, window = _start(kit)
    phase = 2 * np.pi * rng.uniform(0.25, 0.4) * time
    wave = np.sin(phase) * window
    opening = 0.5 * (1 - np.cos(2 * phase)) * window
    for side in ("left", "right"):
        _add(ctrl, kit, f"{side}_hip_roll", 0.15 * wave)
        _add(ctrl, kit, f"{side}_ankle_roll", -0.12 * wave)
        _add(ctrl, kit, f"{side}_hip_yaw", 0.15 * wave)
    _add(ctrl, kit, "torso", rng.uniform(0.2, 0.5) * wave)
    for arm in kit.arms.values():
        shoulder_roll = arm.column("shoulder_roll")
        ctrl[:, shoulder_roll] += arm.sign * rng.uniform(0.3, 0.6) * opening
    return ctrl


def tour(kit: Kit, rng: np.random.Generator) -> Array:
    """Move all joints at once from one random posture to the next, a third of the range around the
    ready posture.
    """
    low, high = _box(kit)
    stops = np.array([kit.ready, *rng.uniform(low, high, (4, len(low))), kit.ready])
    return through(stops, rng.uniform(1.0, 1.4, 5), np.full(6, 0.3), GRID)


def limber(kit: Kit, rng: np.random.Generator) -> Array:
    """Move all joints at once on slow sines with random phases."""
    time, ctrl, window = _start(kit)
    low, high = _box(kit)
    for j in range(ctrl.shape[1]):
        wave = _sines(time, 0.5, rng)
        away = (low[j] + high[j]) / 2 - kit.ready[j] + wave * (high[j] - low[j]) / 2
        ctrl[:, j] += away * window
    return ctrl


LEGGED = (squat, march, sway)
ANY = (tour, limber)
_LEG = ("hip_pitch", "hip_roll", "hip_yaw", "knee", "ankle_pitch", "ankle_roll")
WHOLE_BODY: dict[str, Callable[[Kit, np.random.Generator], Array]] = {
    f.__name__: f for f in LEGGED + ANY
}


def available(kit: Kit) -> list[str]:
    """Names of the whole-body motions that this robot can play."""
    names = [builder.__name__ for builder in ANY]
    if _has_legs(kit.robot):
        return [*(builder.__name__ for builder in LEGGED), *names]
    return names


def _has_legs(robot: RobotSpec) -> bool:
    for side in ("left", "right"):
        for joint in _LEG:
            if not any(name.startswith(f"{side}_{joint}") for name in robot.joint_names):
                return False
    return True


def _add(ctrl: Array, kit: Kit, start: str, values: Array | float) -> None:
    """Add values (T,) or one number to the joint whose name starts so.

    A robot without it is left as it is.
    """
    for i, name in enumerate(kit.robot.joint_names):
        if name.startswith(start):
            ctrl[..., i] += values


def _start(kit: Kit) -> tuple[Array, Array, Array]:
    """Return time (T,) s, the ready posture at each (T, n) rad, and a window (T,)."""
    steps = round(DURATION_S / GRID)
    time = np.arange(steps) * GRID
    ctrl = np.repeat(kit.ready[None], steps, axis=0)
    return time, ctrl, fade(steps, GRID, 1.5)


def _box(kit: Kit) -> tuple[Array, Array]:
    """Return the lowest and highest targets of every joint around the ready posture, (n) rad."""
    low = kit.limits.low
    high = kit.limits.high
    width = np.where(np.isfinite(high - low), high - low, ENDLESS_RAD)
    half = np.minimum(BOX_SHARE * width, MAX_BOX_RAD)
    return np.maximum(kit.ready - half, low), np.minimum(kit.ready + half, high)
