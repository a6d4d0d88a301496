"""The motions of a robot by name: made from a seed, fitted to its limits, the same every time."""

from __future__ import annotations

import hashlib
from dataclasses import replace

import numpy as np

from gaponet.base.arrays import Array
from gaponet.base.errors import UsageError
from gaponet.robot.spec import RobotSpec
from gaponet.sysid.motion.excite import SIGNALS
from gaponet.sysid.motion.feasible import MAX_PAYLOAD, Feasibility
from gaponet.sysid.motion.motion import GRID, Motion
from gaponet.sysid.motion.posture import Stage, find_stage
from gaponet.sysid.motion.upper_body import BUILDERS, Kit
from gaponet.sysid.motion.whole_body import WHOLE_BODY, available


class Library:
    """Makes motions of one robot by name, and remembers what is costly to find."""

    def __init__(
        self,
        robot: RobotSpec,
        seed: int = 0,
        max_payload: float = MAX_PAYLOAD,
        height: float | None = None,
        unchecked: bool = False,
    ) -> None:
        """
        Args:
            height: Where the floor or table is, m, instead of what collision.toml says.
            unchecked: Do without shapes.
        """
        self.robot = robot
        self.seed = seed
        self.limits = Feasibility(robot, max_payload, height, unchecked)
        self.kit = Kit(self.limits)
        self._stages: dict[str, Stage] = {}
        self._given: dict[str, Motion] = {}

    def add(self, motion: Motion) -> None:
        """Take in a motion from elsewhere (motion.files); it is fitted to the limits like all others.

        Raises:
            UsageError: It cannot be fitted.
        """
        self._given[motion.name] = self.limits.fit(motion)

    def names(self, variants: int = 1) -> list[str]:
        """All names: <signal>-<joint>, <kind>-<side>-<variant> and <kind>-all-<variant>, and what was added."""
        joint = [f"{signal}-{short(j)}" for j in self.robot.operated for signal in SIGNALS]
        sides = [*self.kit.arms, "both"] if len(self.kit.arms) == 2 else list(self.kit.arms)
        upper = [f"{b}-{side}-{v}" for v in range(variants) for b in BUILDERS for side in sides]
        whole = [f"{kind}-all-{v}" for v in range(variants) for kind in available(self.kit)]
        return joint + upper + whole + list(self._given)

    def make(self, name: str) -> Motion:
        """The motion of that name.

        Raises:
            UsageError: No such motion; the message lists the forms.
        """
        if name in self._given:
            return self._given[name]
        parts = name.split("-")
        rng = np.random.default_rng([self.seed, int(hashlib.sha256(name.encode()).hexdigest()[:8], 16)])
        if parts[0] in SIGNALS and len(parts) == 2:
            return self._joint(name, parts[0], parts[1], rng)
        if parts[0] in BUILDERS and len(parts) == 3 and (parts[1] in self.kit.arms or parts[1] == "both"):
            sides = tuple(self.kit.arms) if parts[1] == "both" else (parts[1],)
            return self._fitted(name, "upper_body", BUILDERS[parts[0]](self.kit, sides, rng))
        if parts[0] in available(self.kit) and len(parts) == 3 and parts[1] == "all":
            return self._fitted(name, "whole_body", WHOLE_BODY[parts[0]](self.kit, rng))
        raise UsageError(
            f"{self.robot.name} has no motion '{name}'; names are <signal>-<joint> with a signal of "
            f"{', '.join(SIGNALS)} and a joint of {', '.join(short(j) for j in self.robot.operated)}, or "
            f"<kind>-<side>-<variant> with a kind of {', '.join(BUILDERS)} and a side of "
            f"{', '.join([*self.kit.arms, 'both']) if self.kit.arms else 'none (this robot has no arms by name)'}, "
            f"or <kind>-all-<variant> with a kind of {', '.join(available(self.kit))}"
        )

    def stage(self, joint: str) -> Stage:
        """Posture and interval in which a joint is excited."""
        if joint not in self._stages:
            self._stages[joint] = find_stage(self.limits, joint, self.seed)
        return self._stages[joint]

    def _joint(self, name: str, signal: str, joint: str, rng: np.random.Generator) -> Motion:
        full = next((j for j in self.robot.operated if short(j) == joint), None)
        if full is None:
            raise UsageError(
                f"motion '{name}': {self.robot.name} has no operated joint '{joint}'; it has "
                f"{', '.join(short(j) for j in self.robot.operated)}"
            )
        stage = self.stage(full)
        column = SIGNALS[signal](stage.low, stage.high, rng, GRID)
        ctrl = np.repeat(stage.posture[None], len(column), axis=0)
        ctrl[:, self.robot.index([full])[0]] = column
        return self._fitted(name, "joint", ctrl)

    def _fitted(self, name: str, level: str, ctrl: Array) -> Motion:
        """Within the limits; about the operated joints and those that move."""
        fitted, robot = self.limits.fit(Motion(name, level, GRID, ctrl)), self.robot
        moved = fitted.moved(robot)
        return replace(fitted, joints=tuple(n for n in robot.joint_names if n in robot.operated or n in moved))


def short(joint: str) -> str:
    """A joint's name in motion names: without the suffix _joint."""
    return joint.removesuffix("_joint")
