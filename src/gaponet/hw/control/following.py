"""Do the joints go where their commands go? Asked of robots that cannot be asked what they were told."""

from __future__ import annotations

import numpy as np

from gaponet.base.arrays import Array
from gaponet.hw.control.driver import Fault, State
from gaponet.hw.control.output import Context, Output
from gaponet.sim.dynamics import static_torque
from gaponet.sim.model import build_model

LAG = 0.15  # s: time constant of a servo that is slower than any here; joints are compared with what it would do
STRIDE = 0.05  # rad of that slow servo's way on which a joint must have moved along
RANGE = 0.25  # rad that its way may span without that; friction was seen to hold a joint in a band of 0.14 rad
STRAINED = 0.5  # share of its effort limit from which on a joint pushes …
LADEN = 0.5  # … against its load, where gravity alone asks for that much of this


class Following:
    """Watches the joints of one robot, stride by stride; what is sent to it does not depend on what is found.

    Attributes:
        share: The share of a stride that a joint must go along; 0: nothing is watched.
        shown: Joints (n) that have followed at least once.
    """

    def __init__(self, context: Context) -> None:
        robot, self.context = context.robot.before_identification, context
        self.share = 0.0 if context.driver.reads_back else context.safety.following
        self.shown = np.zeros(len(context.joints), bool)
        self._model = build_model(robot, context.payload_mass or 0.0) if self.share else None
        self._slow: Array | None = None
        self._low, self._high, self._least, self._most, self._at_low, self._at_high = np.zeros((6, len(self.shown)))
        self._state_time = -np.inf

    def check(self, state: State, output: Output) -> Fault | None:
        """Take in one period; the joint that has not followed for long.

        A joint that pushes as hard as it can against a load that the payload explains obeys, though it does not move;
        one that is held does not.
        """
        if self._model is None or state.time <= self._state_time:
            return None
        self._state_time, joints = state.time, self.context.joints
        limit = output.limits.effort / self.context.safety.torque_share
        command, qpos = output.expected(), state.qpos[joints]
        if self._slow is None:
            self._slow = command.copy()
            self._low, self._high, self._least, self._most = (command.copy() for _ in range(4))
            self._at_low, self._at_high = qpos.copy(), qpos.copy()
        slow = self._slow = self._slow + (command - self._slow) * min(1.0, self.context.dt / LAG)
        lower, higher = slow < self._low, slow > self._high
        self._low, self._at_low = np.where(lower, slow, self._low), np.where(lower, qpos, self._at_low)
        self._high, self._at_high = np.where(higher, slow, self._high), np.where(higher, qpos, self._at_high)
        up, down = slow - self._low >= STRIDE, self._high - slow >= STRIDE
        went = np.where(up, qpos - self._at_low, self._at_high - qpos)
        done = up | down
        side = np.sign(command - qpos)
        pushes = state.tau[joints] / limit * side >= STRAINED
        if (done & pushes).any():
            load = static_torque(self._model, state.qpos[None])[0, joints] / limit
            pushes &= load * side >= LADEN * STRAINED
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
        name, ways = self.context.driver.commanded[joint], "in a mode that ignores commands, or to another joint's"
        return Fault("obedience", f"{name} does not follow: blocked, limp or not listening ({ways})")
