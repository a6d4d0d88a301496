"""Commands of a batch of simulations, as servos take them: within the joints' ranges, ramped where
a servo limits their speed, and late where it has a delay; numpy or torch.
"""

from __future__ import annotations

from typing import Any

import mujoco
import numpy as np

from gaponet.base.arrays import Array, array_like, array_module
from gaponet.base.errors import UsageError

# of a ramp beyond its joint: fixed, and at the ramp's speed
MAX_RAMP_LEAD_RAD = 0.05
MAX_RAMP_LEAD_S = 0.1


def ramp_start(target: Any, qpos: Any, speed: Any) -> Any:
    """Return where a ramp towards `target` (…, n), rad, is when the joint is at qpos; numpy or
    torch.
    """
    lead = MAX_RAMP_LEAD_RAD + MAX_RAMP_LEAD_S * speed
    return array_module(target).clip(target, qpos - lead, qpos + lead)


def speed_limited(ctrl: Array, qpos: Array, speed: Array, dt: Array | float) -> Array:
    """Return targets (T, …), rad, limited to `speed` (…), rad/s, from qpos (…) on; dt in s, one or
    (…).
    """
    limited = np.empty_like(ctrl)
    at = ramp_start(ctrl[0], qpos, speed)
    for t, target in enumerate(ctrl):
        at = np.clip(target, at - speed * dt, at + speed * dt)
        limited[t] = at
    return limited


class ControlPeriods:
    """Control periods of simulations.

    Attributes:
        nstep: Physics steps in a period, (num_envs,).
        timestep: Length of a physics step, (num_envs,) s.
    """

    def __init__(self, nstep: Any, timestep: Any) -> None:
        self.nstep = nstep
        self.timestep = timestep
        self._numbers = sorted(set(nstep.tolist()))  # that occur in nstep

    @property
    def seconds(self) -> Any:
        """Length of a period, (num_envs,) s."""
        return self.nstep * self.timestep

    def by_nstep(self, ids: Array | None) -> list[tuple[int, Array | None]]:
        """Return each number of physics steps, and the simulations of `ids` that have it; None: all
        simulations.
        """
        if len(self._numbers) == 1:
            return [(self._numbers[0], ids)]
        moving = np.arange(len(self.nstep)) if ids is None else ids
        nstep = self.nstep[moving]
        parts: list[tuple[int, Array | None]] = []
        for n in self._numbers:
            rows = moving[nstep == n]
            if rows.size:
                parts.append((n, rows))
        return parts


class Commands:
    """Position targets of all simulations in a batch, on their way into the servos.

    Attributes:
        ctrl: MuJoCo's targets, (num_envs, n) rad; live.
        range: Joint ranges, to which targets are clipped, (n, 2) rad.
        periods: Control periods.
        history: Buffer of late targets; None where no servo has a delay.
        max_change: Largest change of targets per period, (num_envs, n) rad; None where no servo
            limits their speed.
    """

    def __init__(
        self,
        ctrl: Any,
        joint_range: Any,
        periods: ControlPeriods,
        history: CommandHistory | None = None,
    ) -> None:
        self.ctrl = ctrl
        self.range = joint_range
        self.periods = periods
        self.history = history
        self.max_change: Any = None
        self._low, self._high = joint_range.T

    def limit_speed(self, speed: Array) -> None:
        """Limit the targets' speed, (…, n) rad/s; 0: no limit."""
        most = np.where(speed > 0, speed, np.inf)
        self.max_change = np.asarray(self.periods.seconds[:, None] * most)

    def reset(self, ids: Any, qpos: Any, past: Any = None) -> None:
        """Begin again for simulations `ids`, whose joints are at qpos (k, n) rad.

        `past` are the targets of the control periods before, newest first, (k, depth, n) rad.

        Raises:
            UsageError: A servo has a delay, and there is no `past`.
        """
        if self.max_change is not None:
            speed = self.max_change[ids] / self.periods.seconds[ids, None]
            self.ctrl[ids] = qpos if past is None else ramp_start(past[:, 0], qpos, speed)
        if self.history is None:
            return
        if past is None:
            raise UsageError("these servos have a delay: give the targets before as `past`")
        self.history.fill(ids, past, self.periods.nstep[ids], self.periods.timestep[ids])

    def send(self, target: Any, ids: Array | None = None) -> None:
        """Hold targets, (num_envs, n) rad, in the coming period. Ramps of simulations other than
        `ids` stand still.
        """
        clip = array_module(self.ctrl).clip
        if self.max_change is not None:
            near = clip(target, self.ctrl - self.max_change, self.ctrl + self.max_change)
            target = near
            if ids is not None:
                moves = np.isin(np.arange(len(self.ctrl)), ids)
                target = np.where(moves[:, None], near, self.ctrl)
        clip(target, self._low, self._high, out=self.ctrl)

    def memory(self) -> dict[str, Any]:
        """Return live arrays by name: what a state has to hold of past targets."""
        arrays = {}
        if self.history is not None:
            arrays["history"] = self.history.buffer
            arrays["time"] = self.history.time
        if self.max_change is not None:
            arrays["ctrl"] = self.ctrl
        return arrays


class CommandHistory:
    """MuJoCo's buffer of past commands of all simulations in a batch; the same length for all
    actuators.

    Layout of an actuator's part: one user number, the cursor, the samples' times, the samples
    (mj_initCtrlHistory).
    """

    def __init__(self, buffer: Any, time: Any, model: mujoco.MjModel) -> None:
        """buffer: Of the batch, (nsim, nhistory), numpy or torch; time: (nsim,) s."""
        self.buffer = buffer
        self.time = time
        self.samples = int(model.actuator_history[0, 0])
        parts = buffer.reshape(len(buffer), model.nu, 2 + 2 * self.samples)  # a view
        self.cursor = parts[..., :2]
        self.times = parts[..., 2 : -self.samples]
        self.values = parts[..., -self.samples :]
        self.ago = array_like(time, np.arange(self.samples, 0, -1))  # oldest first
        self._newest = array_like(time, [0.0, self.samples - 1.0])
        self._each = array_like(time, np.arange(len(time))[:, None])

    def fill(self, ids: Any, past: Any, nstep: Any, timestep: Any) -> None:
        """Write past targets, newest first, each held for nstep (k,) physics steps of timestep
        (k,) s; time is 0.
        """
        self.time[ids] = 0.0
        self.cursor[ids] = self._newest
        self.times[ids] = (-self.ago * timestep[:, None])[:, None]
        frame = ((self.ago - 1) // nstep[:, None]).clip(max=past.shape[1] - 1)  # (k, samples)
        self.values[ids] = past[self._each[: len(past)], frame].swapaxes(1, 2)
