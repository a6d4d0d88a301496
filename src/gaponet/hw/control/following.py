"""Check that joints follow their commands, on robots whose commands cannot be read back."""

from __future__ import annotations

import mujoco
import numpy as np

from gaponet.base.arrays import Array
from gaponet.hw.control.driver import Fault, State
from gaponet.hw.control.output import Context, Output
from gaponet.sim.dynamics import static_torque
from gaponet.sim.model import build_model

# Time constant of the reference servo with which joints are compared; slower than any real one.
REFERENCE_LAG_S = 0.15
STRIDE_RAD = 0.05  # way of the reference after which a joint must have moved along
# Span of the reference without that; friction was seen to hold a joint in a band of 0.14 rad.
MAX_UNFOLLOWED_RAD = 0.25
MIN_PUSH_SHARE = 0.5  # of its effort limit with which a joint counts as pushing …
MIN_LOAD_SHARE = 0.5  # … if gravity alone requires at least this share of MIN_PUSH_SHARE


class FollowingMonitor:
    """Compares each joint's way with that of a slow reference servo, stride by stride.

    Attributes:
        share: Share of a stride that a joint must go along; 0: nothing is checked.
        shown: Joints (n) that have followed at least once.
    """

    def __init__(self, context: Context) -> None:
        robot = context.robot.before_identification
        self.context = context
        self.share = 0.0 if context.driver.reads_back else context.safety.following
        self.shown = np.zeros(len(context.joints), bool)
        self._model: mujoco.MjModel | None = None
        if self.share:
            payload = context.payload_mass or 0.0
            self._model = build_model(robot, payload, context.payload_side)
        self._reference: Array | None = None
        none = np.zeros(len(self.shown))
        # Ends of the reference's current stride, and the joint's position at them, rad.
        self._low = none
        self._high = none
        self._qpos_low = none
        self._qpos_high = none
        # Span of the reference without a followed stride, rad.
        self._span_low = none
        self._span_high = none
        self._state_time = -np.inf

    def check(self, state: State, output: Output) -> Fault | None:
        """Take in one period; return a fault if a joint has not followed for long.

        A joint that pushes as hard as it can against a load that the payload explains obeys, though
        it does not move; a joint that is held does not.
        """
        if self._model is None or state.time <= self._state_time:
            return None
        self._state_time = state.time
        joints = self.context.joints
        limit = output.limits.effort / self.context.safety.torque_share
        command = output.expected()
        qpos = state.qpos[joints]
        reference = self._move_reference(command, qpos)
        self._extend_stride(reference, qpos)
        up = reference - self._low >= STRIDE_RAD
        down = self._high - reference >= STRIDE_RAD
        done = up | down  # joints whose reference has made a stride
        distance = np.where(up, qpos - self._qpos_low, self._qpos_high - qpos)
        side = np.sign(command - qpos)
        pushes = state.tau[joints] / limit * side >= MIN_PUSH_SHARE
        if (done & pushes).any():
            load = static_torque(self._model, state.qpos[None])[0, joints] / limit
            pushes &= load * side >= MIN_LOAD_SHARE * MIN_PUSH_SHARE
        follows = done & ((distance >= self.share * STRIDE_RAD) | pushes)
        self.shown |= follows & ~pushes
        self._span_low = np.where(follows, reference, np.minimum(self._span_low, reference))
        self._span_high = np.where(follows, reference, np.maximum(self._span_high, reference))
        self._begin_stride(done, reference, qpos)
        unresponsive = self._span_high - self._span_low >= MAX_UNFOLLOWED_RAD
        return self.fault(int(unresponsive.argmax())) if unresponsive.any() else None

    def _move_reference(self, command: Array, qpos: Array) -> Array:
        """Move the reference towards the command by a period; return it, rad.

        The first command is where the reference begins.
        """
        if self._reference is None:
            self._reference = command.copy()
            self._low = command.copy()
            self._high = command.copy()
            self._span_low = command.copy()
            self._span_high = command.copy()
            self._qpos_low = qpos.copy()
            self._qpos_high = qpos.copy()
        share = min(1.0, self.context.dt / REFERENCE_LAG_S)
        self._reference = self._reference + (command - self._reference) * share
        return self._reference

    def _extend_stride(self, reference: Array, qpos: Array) -> None:
        """Let the present stride reach to the reference, if it passes one of its ends."""
        lower = reference < self._low
        higher = reference > self._high
        self._low = np.where(lower, reference, self._low)
        self._qpos_low = np.where(lower, qpos, self._qpos_low)
        self._high = np.where(higher, reference, self._high)
        self._qpos_high = np.where(higher, qpos, self._qpos_high)

    def _begin_stride(self, joints: Array, reference: Array, qpos: Array) -> None:
        """Begin the next stride of these joints, (n) bool, at the reference."""
        self._low[joints] = reference[joints]
        self._high[joints] = reference[joints]
        self._qpos_low[joints] = qpos[joints]
        self._qpos_high[joints] = qpos[joints]

    def fault(self, joint: int) -> Fault:
        """Return the fault of a joint that does not follow."""
        name = self.context.driver.commanded[joint]
        causes = "in a mode that ignores commands, or to another joint's"
        return Fault(
            "obedience", f"{name} does not follow: blocked, limp or not listening ({causes})"
        )
