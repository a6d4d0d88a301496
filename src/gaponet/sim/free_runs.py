"""Free runs of many parameter vectors beside recordings, in one batch: errors and their Jacobian.

A servo's parameters act on its own joint first: what they do to the others is weaker by the ratio of the inertias. So
one simulation can move the same parameter of all joints, and each joint's error is put down to its own parameter: six
simulations for a Jacobian, however many joints.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.linalg import block_diag

from gaponet.data.sequence import Sequence
from gaponet.robot import LAW, RobotSpec
from gaponet.sim.batch import BatchSim, Condition
from gaponet.sim.model import build_model
from gaponet.sim.replay import Corrector, idle_limbs

Array = np.ndarray

MAX_DELAY = 0.15  # s
SETTLE = 0.1  # s: velocities at a window's start are measured ones
MASSES = (0.0, 0.5, 1.0, 2.0, 4.0, 8.0)  # kg: where the search for an unknown payload starts
MAX_MASS = 20.0  # kg
MASS_STEP = 0.1  # kg
TOGETHER = 0.05  # of the prior, where all joints leave their values by the same share: a cold day, a slow bus …
COMMON = ("damping", "frictionloss", "armature", "delay")  # … which does not turn zeros, nor soften gains

# Parameter → (lower, upper, finite-difference step), as a multiple of the scale in `_scales`.
BOUNDS = {
    "kp": (0.2, 8.0, 0.02),
    "damping": (0.0, 10.0, 0.02),
    "frictionloss": (0.0, 40.0, 0.05),
    "armature": (0.002, 10.0, 0.05),
    "offset": (-10.0, 10.0, 0.1),
    "delay": (0.0, MAX_DELAY / 0.02, 0.25),
}


class FreeRuns:
    """Windows, parameter vector ↔ robot, errors of many parameter vectors in one batch."""

    def __init__(
        self,
        parts: list[Sequence],
        robot: RobotSpec,
        nthread: int,
        fields: tuple[str, ...],
        corrector: Corrector | None,
        prior: float,
        unknown_payload: bool,
    ) -> None:
        self.parts, self.robot, self.nthread = parts, robot, nthread
        self.limits = {f: BOUNDS[f] for f in fields}
        self.corrector, self.prior, self.unknown_payload = corrector, prior, unknown_payload
        self.locked = idle_limbs(parts, robot)
        self.op, self.n = robot.operated_index, len(robot.operated)
        self.names = [(field, joint) for field in fields for joint in robot.operated]
        self.size = len(self.names) + unknown_payload
        free = [j for j in robot.joint_names if j not in self.locked]
        self.free, self.free_op = robot.index(free), np.array([free.index(j) for j in robot.operated])
        rows = max(map(len, parts))
        self.ctrl = np.stack([_held(s.ctrl[:, self.free], rows) for s in parts], axis=1).astype(float)
        self.real = np.stack([_held(s.qpos[:, self.op], rows) for s in parts], axis=1).astype(float)
        skip = np.array([[t >= SETTLE / s.dt and t < len(s) for s in parts] for t in range(rows)])
        self.counted = np.repeat(skip[1:, :, None], self.n, axis=2)
        self.rows = int(self.counted.sum())  # of the residual: simulated errors; those of the prior follow
        self.joint, self.window = (
            np.broadcast_to(i, self.counted.shape)[self.counted]
            for i in (np.arange(self.n), np.arange(len(parts))[:, None])
        )
        model = build_model(robot)
        dof = np.array([model.joint(j).dofadr[0] for j in robot.operated])
        gain = robot.kp[self.op]
        natural = gain * 0.05  # N·m·s/rad: a time constant of 50 ms
        self.scale = {
            "kp": gain,
            "damping": np.maximum(model.dof_damping[dof], 0.2 * natural),
            "frictionloss": np.maximum(model.dof_frictionloss[dof], 0.005 * gain),
            "armature": np.maximum(model.dof_armature[dof], 1e-3),
            "offset": np.full(self.n, 0.02),
            "delay": np.full(self.n, 0.02),
        }
        self.first = {
            "kp": gain, "damping": model.dof_damping[dof], "frictionloss": model.dof_frictionloss[dof],
            "armature": model.dof_armature[dof], "offset": robot.offset[self.op], "delay": robot.delay[self.op],
            **{name: getattr(robot, name)[self.op] for name in ("zero", *LAW)},
        }  # fmt: skip

    def start(self) -> Array:
        """The given robot, a little inside the bounds; a little late, since a delay of zero hides its gradient.

        An unknown payload starts at the mass of MASSES that fits best.
        """
        late = 0.005 if self.prior else 0.02  # s; with a prior the given robot is thought to be near
        x = self._inside(self.first | {"delay": np.maximum(self.first["delay"], late)})
        if not self.unknown_payload:
            return x
        xs = np.repeat(x[None], len(MASSES), axis=0)
        xs[:, -1] = np.maximum(MASSES, 1e-3)
        return xs[(self.errors(xs)[:, : self.rows] ** 2).sum(axis=1).argmin()]

    def own(self) -> Array:
        """The given robot, and the mean of the payloads said to be carried."""
        return self._inside(self.first)

    def _inside(self, values: dict[str, Array]) -> Array:
        low, high = self.bounds()
        mass = [np.mean([s.meta.payload_mass for s in self.parts], keepdims=True)] * self.unknown_payload
        return np.clip(
            np.concatenate([*(values[f] / self.scale[f] for f in self.limits), *mass]), low + 1e-3, high - 1e-3
        )

    def bounds(self) -> tuple[Array, Array]:
        """(P,) each."""
        low, high = (np.repeat([b[k] for b in self.limits.values()], self.n) for k in (0, 1))
        return (np.r_[low, 0.0], np.r_[high, MAX_MASS]) if self.unknown_payload else (low, high)

    def values(self, x: Array) -> dict[str, Array]:
        """(…, P) → field: (…, n) in SI; fields that are not fitted as they are."""
        x = np.asarray(x)[..., : len(self.names)]
        parts = np.split(x, len(self.limits), axis=-1)
        fitted = {f: part * self.scale[f] for f, part in zip(self.limits, parts, strict=True)}
        shape = (*x.shape[:-1], self.n)
        return {f: np.broadcast_to(own, shape) for f, own in self.first.items()} | fitted

    def robot_of(self, x: Array) -> RobotSpec:
        """The robot with these parameters; joints that are not operated keep theirs."""
        values = self.values(x)
        return self.robot.with_servos(
            {j: {f: float(f"{values[f][i]:.6g}") for f in self.limits} for i, j in enumerate(self.robot.operated)}
        )

    def rms(self, errors: Array) -> float:
        """Root mean square of the simulated errors, rad."""
        return float(np.sqrt((errors[: self.rows] ** 2).mean()))

    def errors(self, xs: Array) -> Array:
        """Free-run errors q_sim − q_real of counted rows, then the prior's, (k, m), of parameter vectors (k, P)."""
        k, m = len(xs), len(self.parts)
        late = np.array(self.robot.delay)
        late[self.op] = MAX_DELAY
        parts = [s for x in xs for s in self._carrying(x)]
        conditions = [Condition.of(s, self.robot) for s in parts]
        sim = BatchSim(replace(self.robot, delay=late), conditions, self.nthread, self.locked)
        sim.set_servos(self.robot.operated, self.values(np.repeat(xs, m, axis=0)))
        tile = np.tile(self.ctrl, (1, k, 1))
        q0, v0 = (np.stack([getattr(s, f)[0, self.free] for s in parts]) for f in ("qpos", "qvel"))
        sim.reset(slice(None), q0, v0, past=tile[0][:, None])
        out = np.empty((len(tile) - 1, k, m, self.n))
        if self.corrector is not None:
            self.corrector.reset(parts)
        for t in range(len(out)):
            sim.step(tile[t] if self.corrector is None else self._corrected(t, tile[t], sim))
            out[t] = sim.qpos[:, self.free_op].reshape(k, m, self.n) - self.real[t + 1]
        errors = out.transpose(1, 0, 2, 3)[:, self.counted]
        if not self.prior:
            return errors
        return np.concatenate([errors, (xs - self.own())[:, : len(self.names)] @ self._prices().T], axis=1)

    def _carrying(self, x: Array) -> list[Sequence]:
        """The windows, with the payload of a parameter vector where theirs is not believed."""
        if not self.unknown_payload:
            return self.parts
        return [replace(s, meta=replace(s.meta, payload_mass=float(x[-1]))) for s in self.parts]

    def _prices(self) -> Array:
        """Prior residual by parameter, payload apart, (P, P); what all joints do together is cheaper."""
        common = np.full((self.n, self.n), (1 - TOGETHER) / self.n)
        blocks = [np.eye(self.n) - (common if f in COMMON else 0.0) for f in self.limits]
        return self.prior * np.asarray(block_diag(*blocks))

    def _corrected(self, t: int, target: Array, sim: BatchSim) -> Array:
        assert self.corrector is not None
        full = np.zeros((3, len(target), len(self.robot.joint_names)))
        full[:2] = self.robot.qpos_home
        for place, now in zip(full, (target, sim.qpos, sim.qvel), strict=True):
            place[:, self.free] = now
        return self.corrector.correct(t, *full)[:, self.free]

    def jacobian(self, x: Array, base: Array) -> Array:
        """Forward differences towards the inside of the bounds, (m, P), from parameters (P,) whose errors are base.

        One simulation moves a field of all joints, and each joint answers for itself.
        """
        steps = np.r_[np.repeat([b[2] for b in self.limits.values()], self.n), [MASS_STEP] * self.unknown_payload]
        steps = np.where(x + steps > self.bounds()[1], -steps, steps)
        field = np.repeat(np.arange(len(self.limits)), self.n)  # of each parameter
        count = len(self.limits) + self.unknown_payload
        moved = np.r_[field, [count - 1] * self.unknown_payload] == np.arange(count)[:, None]
        change = (self.errors(x + moved * steps) - base)[:, : self.rows]
        jac = np.zeros((len(base), self.size))
        rows = np.arange(self.rows)
        for f in range(len(self.limits)):
            column = self.joint + self.n * f
            jac[rows, column] = change[f] / steps[column]
        if self.unknown_payload:  # a payload loads every joint
            jac[: self.rows, -1] = change[-1] / steps[-1]
        if self.prior:
            jac[self.rows :, : len(self.names)] = self._prices()
        return jac


def _held(x: Array, rows: int) -> Array:
    return np.concatenate([x, np.repeat(x[-1:], rows - len(x), axis=0)])
