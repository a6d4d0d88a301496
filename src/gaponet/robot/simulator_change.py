"""Simulators that differ from a robot's own: gains, damping, friction, rotors, delay, and place of
the payload.

One network is trained in many of them, so that it also corrects a simulator that it has never seen.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import numpy as np
from annotated_types import Ge, Gt

from gaponet.base.errors import UsageError

Factor = Annotated[float, Gt(0)]
Range = tuple[Factor, Factor]


@dataclass(frozen=True)
class SimulatorChange:
    """What differs from the robot's own simulator.

    Attributes:
        kp: Factor on the stiffness of each joint, (n).
        damping: Factor on the damping of each joint, of servo (kd) and joint, (n).
        armature: Factor on the inertia of all rotors.
        friction: Factor on the dry friction of all joints.
        delay: Added to the delay of all servos, s.
        mount: Added to the place of the payload in its body, m.
    """

    kp: tuple[float, ...]
    damping: tuple[float, ...]
    armature: float = 1.0
    friction: float = 1.0
    delay: float = 0.0
    mount: tuple[float, float, float] = (0.0, 0.0, 0.0)


@dataclass(frozen=True)
class SimulatorRanges:
    """Ranges from which simulators are drawn.

    The defaults cover published parameter sets of the SO-101, whose stiffness differs by a factor
    of 3.3, damping of 6, armature of 6, and friction from almost none to eight times.
    """

    kp: Range = (0.5, 3.0)
    """Smallest and largest factor on the stiffness of a joint."""
    damping: Range = (0.5, 6.0)
    """Smallest and largest factor on the damping of a joint."""
    armature: Range = (0.5, 4.5)
    """Smallest and largest factor on the inertia of the rotors."""
    friction: Range = (0.05, 8.0)
    """Smallest and largest factor on dry friction."""
    delay: Annotated[float, Ge(0)] = 0.02
    """Largest added delay, s."""
    mount: Annotated[float, Ge(0)] = 0.02
    """Largest shift of the payload in each direction, m."""

    def __post_init__(self) -> None:
        for name in ("kp", "damping", "armature", "friction"):
            low, high = getattr(self, name)
            if low > high:
                raise UsageError(
                    f"simulator ranges: {name} from {low:g} to {high:g}; give the smaller one first"
                )

    def draw(self, joints: int, count: int, seed: int) -> list[SimulatorChange]:
        """Return `count` simulators of a robot with this number of joints.

        Factors are uniform on a log scale.
        """
        rng = np.random.default_rng(seed)

        def factors(bounds: Range, size: int) -> tuple[float, ...]:
            low, high = np.log(bounds)
            return tuple(np.exp(rng.uniform(low, high, size)).tolist())

        changes = []
        for _ in range(count):
            change = SimulatorChange(
                kp=factors(self.kp, joints),
                damping=factors(self.damping, joints),
                armature=factors(self.armature, 1)[0],
                friction=factors(self.friction, 1)[0],
                delay=float(rng.uniform(0, self.delay)),
                mount=tuple(rng.uniform(-self.mount, self.mount, 3).tolist()),
            )
            changes.append(change)
        return changes
