"""Free runs of many parameter vectors beside recordings, in one batch: errors and their Jacobian.

A servo's parameters act on its own joint first: what they do to the others is weaker by the ratio of the inertias. So
one simulation can move the same parameter of all joints, and each joint's error is put down to its own parameter: six
simulations for a Jacobian, however many joints.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy.linalg import block_diag

from gaponet.data.sequence import Sequence
from gaponet.robot import LAW, RobotSpec
from gaponet.sim.batch import BatchSim, Condition
from gaponet.sim.model import build_model
from gaponet.sim.replay import Corrector, idle_limbs

Array = np.ndarray

MAX_DELAY = 0.15  # s
SOFT = 0.01  # rad: errors beyond count linearly, so that one blocked joint does not decide
THIN, LATE = 0.01, 0.005  # s: between rows that count; a first delay
SETTLE = 0.1  # s: velocities at a window's start are measured ones
IMMOVABLE = 1e6  # kg·m²: the armature of a joint that stands
FAR = np.pi  # rad: an error beyond, of a simulation that flew away, counts as this
MASSES = (0.0, 0.5, 1.0, 2.0, 4.0, 8.0)  # kg: where the search for an unknown payload starts
MAX_MASS = 20.0  # kg
MASS_STEP = 0.1  # kg
TOGETHER = 0.05  # of the prior, where all joints leave their values by the same share: a cold day, a slow bus …
COMMON = ("damping", "frictionloss", "armature", "delay")  # … which does not turn zeros, nor soften gains

NO_LAW = {name: np.array(0.0) for name in LAW}
# Parameter → (lower, upper, finite-difference step), as a multiple of the scale in `_scales`. kp's in its logarithm.
BOUNDS = {
    "kp": (-4.0, 4.0, 0.02),
    "damping": (0.0, 200.0, 0.1),
    "frictionloss": (0.0, 200.0, 0.1),
    "armature": (0.0, 200.0, 0.1),
    "offset": (-10.0, 10.0, 0.1),
    "delay": (0.0, MAX_DELAY / 0.02, 0.1),
    "stribeck": (0.0, 200.0, 0.1),
    "stribeck_speed": (0.005, 1.0, 0.005),
    "friction_motor": (0.0, 0.8, 0.01),
    "friction_external": (0.0, 0.8, 0.01),
    "min_torque": (0.0, 200.0, 0.1),
    "effort_limit": (0.05, 5.0, 0.05),
}


@dataclass(frozen=True)
class Prior:
    """What leaving a robot's values costs.

    Attributes:
        robot: Whose values.
        price: Field → rad per scale, a number or one for each operated joint.
        together: Part of it that is to be paid where all joints leave by the same share, in fields of COMMON.
    """

    robot: RobotSpec
    price: dict[str, Array | float]
    together: float = TOGETHER


class FreeRuns:
    """Windows, parameter vector ↔ robot, errors of many parameter vectors in one batch.

    A parameter vector (P,) holds each field of all n operated joints, one field after the other, then the payload mass
    where it is unknown. Damping below zero is taken from the firmware's kd, where that may be wrong.
    """

    def __init__(
        self,
        parts: list[Sequence],
        robot: RobotSpec,
        nthread: int,
        fields: tuple[str, ...],
        corrector: Corrector | None = None,
        prior: Prior | None = None,
        unknown_payload: bool = False,
        believed: Array | bool = True,
        touch: Array | None = None,
    ) -> None:
        """
        Args:
            parts: Windows of recordings.
            robot: Where to start from; fields that are not fitted are its own.
            nthread: Threads, 0 for all cores.
            fields: Of BOUNDS.
            corrector: Corrects the targets on the way, as in replay.
            prior: What leaving a robot's values costs.
            unknown_payload: Fit one payload mass for all windows.
            believed: Whether a joint's kd is what its servo has, (n,) or one for all.
            touch: Rows in which something may be touched, (windows, rows): runs go on from the recording there.
        """
        self.parts, self.robot, self.nthread, self.fields = parts, robot, nthread, fields
        self.corrector, self.prior, self.unknown_payload = corrector, prior, unknown_payload
        self.locked = idle_limbs(parts, robot)
        self.op, self.n = robot.operated_index, len(robot.operated)
        self.size = len(fields) * self.n + unknown_payload
        free = [j for j in robot.joint_names if j not in self.locked]
        self.free, self.free_op = robot.index(free), np.array([free.index(j) for j in robot.operated])
        rows = max(map(len, parts))
        self.ctrl = np.stack([_held(s.ctrl[:, self.free], rows) for s in parts], axis=1).astype(float)
        self.real = np.stack([_held(s.qpos[:, self.op], rows) for s in parts], axis=1).astype(float)
        thin = [max(1, round(THIN / s.dt)) for s in parts]
        self.touch = np.zeros((rows, len(parts)), bool) if touch is None else touch.T[:rows]
        after = max(1, round(SETTLE / max(s.dt for s in parts)))
        near = np.array([self.touch[max(0, t - after) : t + 1].any(axis=0) for t in range(rows)])
        self.counted = ~near[1:] & np.array([
            [t >= SETTLE / s.dt and t < len(s) and t % k == 0 for s, k in zip(parts, thin, strict=True)]
            for t in range(1, rows)
        ])  # fmt: skip
        self.window = np.broadcast_to(np.arange(len(parts)), self.counted.shape)[self.counted]  # of each row, (rows,)
        # Joints of which a window holds nothing stand where it says, and count nowhere, (n, rows).
        self.recorded = np.array([[j not in p.meta.unrecorded for p in parts] for j in robot.operated])[:, self.window]
        self.standing = [(w, i) for w, p in enumerate(parts) for i, j in enumerate(free) if j in p.meta.unrecorded]
        self.rows = self.recorded.sum(axis=1)  # that count, of each joint, (n,)
        own, gain = _servos(robot), robot.kp[self.op]
        self.spare = np.where(believed, 0.0, robot.kd[self.op])
        self.scale = {
            "kp": gain,
            "damping": np.maximum(own["damping"], 0.01 * gain),  # a time constant of 10 ms
            **{f: np.maximum(own[f], 0.005 * gain) for f in ("frictionloss", "stribeck", "min_torque")},
            "armature": np.maximum(own["armature"], 1e-3),
            "offset": np.full(self.n, 0.02),
            "delay": np.full(self.n, 0.02),
        }
        self.first = own | {name: getattr(robot, name)[self.op] for name in ("zero", *LAW)}

    def start(self) -> Array:
        """The given robot, a little inside the bounds; a little late, since a delay of zero hides its gradient.

        An unknown payload starts at the mass of MASSES that fits best.
        """
        x = self._inside(self.first | {"delay": np.maximum(self.first["delay"], LATE)})
        if not self.unknown_payload:
            return x
        xs = np.repeat(x[None], len(MASSES), axis=0)
        xs[:, -1] = np.maximum(MASSES, 1e-3)
        return xs[np.square(self.errors(xs)).sum(axis=(1, 2)).argmin()]

    def own(self, robot: RobotSpec | None = None) -> Array:
        """The given robot, or another one, and the mean of the payloads said to be carried."""
        return self._inside(self.first if robot is None else _servos(robot))

    def _inside(self, values: dict[str, Array]) -> Array:
        low, high = self.bounds()
        found = []
        for f in self.fields:
            spare = self.spare if f == "damping" else 0.0
            x = (values[f] + spare) / self.scale.get(f, 1.0)
            found.append(np.log(np.maximum(x, 1e-9)) if f == "kp" else x)
        mass = [np.mean([s.meta.payload_mass for s in self.parts], keepdims=True)] * self.unknown_payload
        return np.clip(np.concatenate([*found, *mass]), low + 1e-3, high - 1e-3)

    def bounds(self) -> tuple[Array, Array]:
        """(P,) each."""
        low, high = (np.repeat([BOUNDS[f][k] for f in self.fields], self.n) for k in (0, 1))
        return (np.r_[low, 0.0], np.r_[high, MAX_MASS]) if self.unknown_payload else (low, high)

    def values(self, x: Array) -> dict[str, Array]:
        """(…, P) → field: (…, n) in SI; fields that are not fitted as they are."""
        x = np.asarray(x)[..., : len(self.fields) * self.n]
        parts = dict(zip(self.fields, np.split(x, len(self.fields), axis=-1), strict=True))
        fitted = {f: (np.exp(x) if f == "kp" else x) * self.scale.get(f, 1.0) for f, x in parts.items()}
        if "damping" in fitted:
            fitted["damping"] = fitted["damping"] - self.spare
        shape = (*x.shape[:-1], self.n)
        return {f: np.broadcast_to(own, shape) for f, own in self.first.items()} | fitted

    def robot_of(self, x: Array) -> RobotSpec:
        """The robot with these parameters; joints that are not operated keep theirs."""
        values = self.values(x)
        return self.robot.with_servos(
            {j: {f: float(f"{values[f][i]:.6g}") for f in self.fields} for i, j in enumerate(self.robot.operated)}
        )

    def errors(self, xs: Array) -> Array:
        """Free-run errors q_sim − q_real of counted rows, (k, n, rows) rad, of parameter vectors (k, P)."""
        return self.run(self.values(xs), [s for x in xs for s in self._carrying(x)])

    def run(self, values: dict[str, Array], parts: list[Sequence] | None = None) -> Array:
        """The same of values (k, n) each, as BatchSim.set_servos takes them; parts: the windows of each in turn."""
        k, m = len(values["kp"]), len(self.parts)
        late = np.array(self.robot.delay)
        late[self.op] = max(float(values["delay"].max()), self.robot.dt / self.robot.decimation)
        parts = self.parts * k if parts is None else parts
        law = any(values[f].any() for f in LAW if f in values)
        known: dict[str, Any] = {} if law else NO_LAW
        acting = replace(self.robot, delay=late, **known)
        sim = BatchSim(acting, [Condition.of(s, self.robot) for s in parts], self.nthread, self.locked, law=law)
        sim.set_servos(self.robot.operated, {f: np.repeat(x, m, axis=0) for f, x in values.items()})
        for w, i in self.standing:  # n joints of a robot that is not locked have as many degrees of freedom
            sim.batch.expand("dof_armature")[w::m, i] = IMMOVABLE
        tile = np.tile(self.ctrl, (1, k, 1))
        q0, v0 = (np.stack([getattr(s, f)[0, self.free] for s in parts]) for f in ("qpos", "qvel"))
        sim.reset(slice(None), q0, v0, past=tile[0][:, None])
        out = np.empty((len(tile) - 1, k, m, self.n), np.float32)
        if self.corrector is not None:
            self.corrector.reset(parts)
        for t in range(len(out)):
            sim.step(tile[t] if self.corrector is None else self._corrected(t, tile[t], sim))
            out[t] = sim.qpos[:, self.free_op].reshape(k, m, self.n) - self.real[t + 1][None]
            for w in np.flatnonzero(self.touch[t + 1]).tolist():
                sim.qpos[w::m] = self.parts[w].qpos[min(t + 1, len(self.parts[w]) - 1), self.free]
                sim.qvel[w::m] = self.parts[w].qvel[min(t + 1, len(self.parts[w]) - 1), self.free]
        errors = out.transpose(1, 3, 0, 2)[:, :, self.counted]
        return np.clip(np.nan_to_num(errors, nan=FAR), -FAR, FAR) * self.recorded

    def _carrying(self, x: Array) -> list[Sequence]:
        """The windows, with the payload of a parameter vector where theirs is not believed."""
        if not self.unknown_payload:
            return self.parts
        return [replace(s, meta=replace(s.meta, payload_mass=float(x[-1]))) for s in self.parts]

    def priced(self, x: Array) -> tuple[Array, Array]:
        """What the prior's errors of a parameter vector are, (m,) rad, and their Jacobian (m, P)."""
        if self.prior is None:
            return np.zeros(0), np.zeros((0, self.size))
        free = len(self.fields) * self.n
        common = np.full((self.n, self.n), (1 - self.prior.together) / self.n)
        blocks = []
        for f in self.fields:
            price = np.broadcast_to(self.prior.price.get(f, 0.0), self.n)
            blocks.append(price[:, None] * (np.eye(self.n) - (common if f in COMMON else 0.0)))
        jac = np.zeros((free, self.size))
        jac[:, :free] = block_diag(*blocks)
        return jac[:, :free] @ (x - self.own(self.prior.robot))[:free], jac

    def _corrected(self, t: int, target: Array, sim: BatchSim) -> Array:
        assert self.corrector is not None
        full = np.zeros((3, len(target), len(self.robot.joint_names)))
        full[:2] = self.robot.qpos_home
        for place, now in zip(full, (target, sim.qpos, sim.qvel), strict=True):
            place[:, self.free] = now
        return self.corrector.correct(t, *full)[:, self.free]

    def jacobian(self, x: Array, base: Array) -> Array:
        """Forward differences towards the inside of the bounds, (n, rows, fields + payload), from x whose errors are
        base: one simulation moves a field of all joints, and each joint answers for itself. A payload loads all."""
        count = len(self.fields) + self.unknown_payload
        steps = np.r_[np.repeat([BOUNDS[f][2] for f in self.fields], self.n), [MASS_STEP] * self.unknown_payload]
        steps = np.where(x + steps > self.bounds()[1], -steps, steps)
        field = np.r_[np.repeat(np.arange(len(self.fields)), self.n), [count - 1] * self.unknown_payload]
        change = self.errors(x + (field == np.arange(count)[:, None]) * steps) - base
        by = np.broadcast_to(steps[-1], (count, self.n)).copy()
        by[: len(self.fields)] = steps[: len(self.fields) * self.n].reshape(-1, self.n)
        return np.moveaxis(change / by[..., None], 0, -1)

    def normal(self, x: Array, errors: Array, jac: Array) -> tuple[Array, Array]:
        """Normal equations of weighted least squares with the prior: matrix (P, P), right-hand side (P,)."""
        weight, count = _weights(errors)[..., None], len(self.fields)
        blocks = np.swapaxes(jac, -1, -2) @ (weight * jac)
        sides = (np.swapaxes(jac, -1, -2) @ (weight * errors[..., None]))[..., 0]
        matrix, side = np.zeros((self.size, self.size)), np.zeros(self.size)
        at = np.arange(count) * self.n + np.arange(self.n)[:, None]  # (n, fields) → place in x
        matrix[at[:, :, None], at[:, None, :]] = blocks[:, :count, :count]
        side[at] = sides[:, :count]
        if self.unknown_payload:
            matrix[at, -1] = matrix[-1, at] = blocks[:, :count, -1]
            matrix[-1, -1], side[-1] = blocks[:, -1, -1].sum(), sides[:, -1].sum()
        far, slope = self.priced(x)
        heavy = _weights(far)[:, None] * slope
        return matrix + slope.T @ heavy, side + heavy.T @ far

    def cost(self, x: Array, errors: Array) -> float:
        """Soft squares of the errors and of the prior's."""
        return float(sum((np.sqrt(1 + (e / SOFT) ** 2) - 1).sum() for e in (errors, self.priced(x)[0])))


def _weights(errors: Array) -> Array:
    """Weights of the errors that give the soft_l1 loss."""
    return np.asarray(1 / np.sqrt(1 + (errors / SOFT) ** 2))


def rms(errors: Array) -> float:
    """Root mean square."""
    return float(np.sqrt(np.square(errors).mean()))


def _servos(robot: RobotSpec) -> dict[str, Array]:
    """Field → its values of the operated joints, those of the MJCF where nothing replaces them."""
    model, op = build_model(robot, bare=True), robot.operated_index
    dof = np.array([model.joint(j).dofadr[0] for j in robot.operated])
    passive = {f: np.array(getattr(model, f"dof_{f}")[dof]) for f in ("damping", "frictionloss", "armature")}
    return passive | {f: getattr(robot, f)[op] for f in BOUNDS if f not in passive}


def _held(x: Array, rows: int) -> Array:
    return np.concatenate([x, np.repeat(x[-1:], rows - len(x), axis=0)])
