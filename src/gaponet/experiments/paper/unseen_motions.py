"""The motions of Figure 3: made for the experiment, and checked against every recorded motion
before any training.
"""

from __future__ import annotations

from collections.abc import Sequence as ListOf
from dataclasses import dataclass

import numpy as np

from gaponet.base.arrays import Array
from gaponet.base.errors import UsageError
from gaponet.data.store import Dataset
from gaponet.motion.coordinated import BUILDERS, available
from gaponet.motion.library import Library
from gaponet.motion.motion import Motion, extended
from gaponet.robot.spec import RobotSpec
from gaponet.sim.model import idle_joints

VARIANT = 90  # recipes count variants from 0 and never get this far
MAX_VARIANTS = 10  # of each kind, for a robot without hands
LIBRARY_SEED = 2026  # recipes have others
MIN_RMS_DIFFERENCE_RAD = 0.01  # between the targets of two motions that count as different


@dataclass(frozen=True)
class UnseenMotion:
    """A motion at a control period.

    Attributes:
        ctrl: Targets, (T, n) rad; limbs without an operated joint stay at home.
    """

    name: str
    ctrl: Array


def make_unseen_motions(
    robot: RobotSpec, count: int, max_payload: float, dt: float
) -> list[UnseenMotion]:
    """Make coordinated motions of all kinds, both hands first; of all joints for a robot without
    hands.

    Args:
        count: Number of motions.
        dt: Control period, s.
        max_payload: Payload with which every motion must be feasible, kg in each hand.

    Raises:
        UsageError: The robot has fewer motions.
    """
    library = Library(robot, LIBRARY_SEED, max_payload)
    names = unseen_names(library)
    if count > len(names):
        raise UsageError(f"--motions {count}: {robot.name} has {len(names)} for this experiment")
    # With a fixed base, limbs without an operated joint share no dynamics with the others.
    idle = robot.index(idle_joints(robot, robot.operated))
    motions = []
    for name in names[:count]:
        ctrl = library.make(name).sample(dt)
        ctrl[:, idle] = robot.qpos_home[idle]
        motions.append(UnseenMotion(name, ctrl))
    return motions


def unseen_names(library: Library) -> list[str]:
    """Return names of motions that no recipe has: of the hands, both first; else of all joints
    together.
    """
    sides = list(library.kit.arms)
    if len(sides) == 2:
        sides = ["both", *sides]
    names = []
    for side in sides:
        names += [f"{kind}-{side}-{VARIANT}" for kind in BUILDERS]
    if not sides:
        for variant in range(VARIANT, VARIANT + MAX_VARIANTS):
            names += [f"{kind}-all-{variant}" for kind in available(library.kit)]
    return names


def require_unseen(
    motions: ListOf[UnseenMotion], dataset: Dataset, robot: RobotSpec, dt: float
) -> None:
    """Refuse motions that the dataset holds, by name or by their targets, at a control period of
    dt s.

    Motions are compared over the whole length of the longer one: punches that begin alike are
    different motions.

    Raises:
        UsageError: A motion is in the dataset.
    """
    recorded = {entry.meta.motion: entry for entry in reversed(dataset.entries)}
    operated = robot.operated_index
    targets = {}
    for name, entry in recorded.items():
        ctrl = dataset.channels(entry, ("ctrl",))["ctrl"]
        resampled = Motion(name, entry.meta.level, entry.dt, ctrl).sample(dt)
        targets[name] = resampled[:, operated]
    for motion in motions:
        for name, ctrl in targets.items():
            difference = rms_difference(motion.ctrl[:, operated], ctrl)
            if name == motion.name or difference < MIN_RMS_DIFFERENCE_RAD:
                raise UsageError(
                    f"motion '{motion.name}' of the experiment is '{name}' of the dataset "
                    f"({1e3 * difference:.1f} mrad RMS apart); the experiment needs motions that "
                    f"no network has seen: gaponet data remove {dataset.path} '{name}'"
                )


def rms_difference(first: Array, second: Array) -> float:
    """Return the RMS difference of two motions, (T, n) rad each; the shorter one stands at its end
    meanwhile.
    """
    rows = max(len(first), len(second))
    difference = extended(first, rows) - extended(second, rows)
    return float(np.sqrt(np.mean(difference**2)))
