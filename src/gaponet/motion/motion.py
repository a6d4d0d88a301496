"""Motion: commanded joint positions on a fine grid, to be played at any control rate."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from gaponet.base.arrays import Array
from gaponet.base.errors import UsageError
from gaponet.data.sequence import LEVELS
from gaponet.robot.finding import masked_names
from gaponet.robot.spec import RobotSpec

GRID = 0.01  # s: motions are made at 100 Hz; 50 Hz plays every second row


@dataclass(frozen=True)
class Motion:
    """Commands of one motion.

    Attributes:
        name: Unique in a recipe.
        level: joint, upper_body or whole_body.
        dt: Grid period of ctrl, s.
        ctrl: Targets of all joints in the robot's order, (T, n), rad.
        joints: Names of those that it is about; on a robot the others stay where they are found.
            None: all.
    """

    name: str
    level: str
    dt: float
    ctrl: Array
    joints: tuple[str, ...] | None = None

    def __post_init__(self) -> None:
        ctrl = np.ascontiguousarray(self.ctrl, float)
        if ctrl.ndim != 2 or len(ctrl) < 2 or not np.isfinite(ctrl).all():
            raise UsageError(
                f"motion '{self.name}': ctrl must be (T ≥ 2, n) finite numbers, got shape "
                f"{ctrl.shape}"
            )
        if self.level not in LEVELS:
            raise UsageError(
                f"motion '{self.name}': level '{self.level}' is not one of {', '.join(LEVELS)}"
            )
        ctrl.flags.writeable = False
        object.__setattr__(self, "ctrl", ctrl)

    @property
    def duration(self) -> float:
        """s."""
        return len(self.ctrl) * self.dt

    def sample(self, dt: float) -> Array:
        """Targets at a control period, (T', n): every k-th row where dt is k grid periods, else
        linear between rows.
        """
        stride = dt / self.dt
        if abs(stride - round(stride)) < 1e-9:
            return self.ctrl[:: round(stride)].copy()
        time = np.arange(len(self.ctrl)) * self.dt
        grid = np.arange(int(time[-1] / dt + 1e-9) + 1) * dt
        return np.stack([np.interp(grid, time, column) for column in self.ctrl.T], axis=1)

    def named(self, robot: RobotSpec) -> tuple[str, ...]:
        """Names of the joints that it is about."""
        return robot.joint_names if self.joints is None else self.joints

    def held_at(self, qpos: Array, robot: RobotSpec) -> Motion:
        """The same with the joints that it does not name where they are in a posture (n,) rad."""
        named = robot.index(self.named(robot))
        ctrl = np.repeat(qpos[None], len(self.ctrl), axis=0)
        ctrl[:, named] = self.ctrl[:, named]
        return replace(self, ctrl=ctrl)

    def moved(self, robot: RobotSpec) -> tuple[str, ...]:
        """Names of the joints that are asked to move."""
        span = np.ptp(self.ctrl, axis=0)
        return masked_names(robot, span > 1e-9)


PEAK_SPEED = 1.875  # of a minimum-jerk move, over its mean speed
PEAK_ACCELERATION = 10 / 3**0.5  # of one, times its duration squared, over its length


def blend(s: Array) -> Array:
    """0 → 1 with zero velocity and acceleration at both ends; s is clipped to [0, 1]."""
    s = np.clip(s, 0.0, 1.0)
    result: Array = s**3 * (10 - 15 * s + 6 * s**2)
    return result


def through(points: Array, moves: Array, holds: Array, dt: float) -> Array:
    """Stop at every via point.

    Args:
        points: (k, n), rad.
        moves: Duration of the move to each next point, (k − 1,), s.
        holds: Rest at each point, (k,), s.
        dt: s.

    Returns:
        (T, n), rad.
    """
    points = np.atleast_2d(np.asarray(points, float))
    rows = [np.repeat(points[:1], max(1, round(holds[0] / dt)), axis=0)]
    for start, stop, move, hold in zip(points[:-1], points[1:], moves, holds[1:], strict=True):
        steps = max(1, round(move / dt))
        share = blend(np.arange(1, steps + 1) / steps)  # of the way
        rows.append(start + (stop - start) * share[:, None])
        rows.append(np.repeat(stop[None], round(hold / dt), axis=0))
    return np.concatenate(rows)


def move_time(distance: Array, speed: float, least: float = 0.5) -> Array:
    """Duration of a minimum-jerk move whose peak speed is `speed` (rad/s), at least `least` s."""
    result: Array = np.maximum(PEAK_SPEED * np.abs(distance) / speed, least)
    return result


def extended(ctrl: Array, rows: int) -> Array:
    """Return targets (T, n) with their last row repeated, (rows, n)."""
    return np.concatenate([ctrl, np.repeat(ctrl[-1:], rows - len(ctrl), axis=0)])


def fade(steps: int, dt: float, ramp: float) -> Array:
    """A window (steps,) that rises from 0 to 1 within `ramp` s, stays, and falls back: oscillations
    start at rest.
    """
    time = np.arange(steps) * dt
    result: Array = blend(time / ramp) * blend((time[-1] - time) / ramp)
    return result
