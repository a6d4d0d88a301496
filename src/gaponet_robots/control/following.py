"""Do the joints go where their commands go? Asked of robots that cannot be asked what they were told."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from gaponet.arrays import Array
from gaponet_robots.control.driver import Fault

LAG = 0.15  # s: time constant of a servo that is slower than any here; joints are compared with what it would do
STRIDE = 0.05  # rad of that slow servo's way on which a joint must have moved along
RANGE = 0.25  # rad that its way may span without that; friction was seen to hold a joint in a band of 0.14 rad
STRAINED = 0.5  # share of its effort limit from which on a joint pushes …
LADEN = 0.5  # … against its load, where gravity alone asks for that much of this


class Following:
    """Watches the joints of one robot, stride by stride; what is sent to it does not depend on what is found.

    Attributes:
        shown: Joints (n) that have followed at least once.
    """

    def __init__(self, names: tuple[str, ...], dt: float, share: float) -> None:
        """
        Args:
            names: The commanded joints', (n).
            dt: Control period, s.
            share: The share of a stride that a joint must go along; 0: nothing is watched.
        """
        self.names, self.dt, self.share = names, dt, share
        self.shown = np.zeros(len(names), bool)
        self._slow: Array | None = None

    def rest(self) -> None:
        """Nothing is commanded that joints could follow."""
        self._slow = None

    def check(self, command: Array, qpos: Array, effort: Array, load: Callable[[], Array]) -> Fault | None:
        """Take in one period; the joint that has not followed for long.

        Args:
            command: Where the robot is asked to be, (n) rad, as far as it was handed over. Not what was sent: that
                never goes further from a joint than its torque allows, and so goes with one that hangs.
            qpos: Measured, (n) rad.
            effort: Measured torque as a share of the effort limit, (n).
            load: Gravity's torque as a share of it, (n), asked where a joint pushes: one that pushes as hard as it can
                against a load that it was told of obeys, though it does not move; one that is held does not.
        """
        if self._slow is None:
            self._slow = command.copy()
            self._low, self._high, self._least, self._most = (command.copy() for _ in range(4))
            self._at_low, self._at_high = qpos.copy(), qpos.copy()
        slow = self._slow = self._slow + (command - self._slow) * min(1.0, self.dt / LAG)
        lower, higher = slow < self._low, slow > self._high
        self._low, self._at_low = np.where(lower, slow, self._low), np.where(lower, qpos, self._at_low)
        self._high, self._at_high = np.where(higher, slow, self._high), np.where(higher, qpos, self._at_high)
        up, down = slow - self._low >= STRIDE, self._high - slow >= STRIDE
        went = np.where(up, qpos - self._at_low, self._at_high - qpos)
        done = up | down
        side = np.sign(command - qpos)
        pushes = effort * side >= STRAINED
        if (done & pushes).any():
            pushes &= load() * side >= LADEN * STRAINED
        follows = done & ((went >= self.share * STRIDE) | pushes)
        self.shown |= follows & ~pushes
        self._least = np.where(follows, slow, np.minimum(self._least, slow))
        self._most = np.where(follows, slow, np.maximum(self._most, slow))
        for edge in (self._low, self._high):
            edge[done] = slow[done]
        for place in (self._at_low, self._at_high):
            place[done] = qpos[done]
        deaf = self._most - self._least >= RANGE
        return self.blame(int(deaf.argmax())) if deaf.any() else None

    def blame(self, joint: int) -> Fault:
        """The fault of a joint that does not follow."""
        return Fault(
            "obedience", f"{self.names[joint]} does not follow: blocked, limp or not listening (in a mode that ignores "
            "commands, or to another joint's)"
        )  # fmt: skip
