"""One unit's servo parameters near a robot's own, from half a minute of its log: identification with a prior.

What so little log does not determine stays with the robot's values; with a corrector the fit is made under it. Half a
minute says little of one joint and more of all of them, so what joints do together is cheaper than what one does alone.
"""

from __future__ import annotations

from collections.abc import Callable
from collections.abc import Sequence as ListOf
from dataclasses import dataclass, replace
from typing import Literal, get_args

import numpy as np

from gaponet.base.arrays import Array
from gaponet.base.errors import UsageError
from gaponet.data.sequence import Sequence
from gaponet.robot.spec import RobotSpec
from gaponet.sim.metrics import standard_error
from gaponet.sim.replay import Corrector, whole_errors
from gaponet.sysid.axes import MAX_DELAY, SLOW, WIDE_KP, ZERO, Bounds, Values
from gaponet.sysid.joint_rollouts import SOFT
from gaponet.sysid.least_squares import STEP, Errors, descend
from gaponet.sysid.robot_rollouts import WINDOW, RobotRollouts, cut

Field = Literal["kp", "damping", "frictionloss", "offset", "delay"]
FIELDS: tuple[Field, ...] = get_args(Field)
PRIOR = 0.3  # rad per scale of a joint alone, a twentieth of it for all together
TOGETHER = 0.05  # of it, where all joints leave their values by the same share: a cold day, a slow bus …
COMMON = ("damping", "frictionloss", "delay")  # … which does not turn zeros, nor soften gains
ITERATIONS, ENOUGH = 4, 1e-3  # at most, and the share of the cost by which it falls in one that is not the last
FOLDS = 4  # at most, of motions that judge
ONE_COMMAND = 4.0  # s: a window so short asks too little to tell about another one
KP = 0.2  # of a logarithm: a large change
LATE = 0.005  # s: a first delay, since a delay of zero hides what it does
MASSES = (0.0, 0.5, 1.0, 2.0, 4.0, 8.0)  # kg: where the search for an unknown payload starts
MAX_MASS = 20.0  # kg


@dataclass(frozen=True)
class _Refitted:
    """The fitted robot and what is known about the fit.

    Attributes:
        robot: The same robot with fitted parameters.
        before, after: RMS error of the windows, rad.
        payload_mass, payload_std: kg in each hand that is said to carry, where it was asked for.
        judged: Mean |error| of motions, as the robot was and fitted to the other ones, (motions,) rad.
        kept: Whether they are followed better then, by more than the standard error; never by one short motion a joint.
    """

    robot: RobotSpec
    before: float
    after: float
    payload_mass: float | None = None
    payload_std: float | None = None
    judged: tuple[Array, Array] = (np.zeros(0), np.zeros(0))
    kept: bool = True


def refit(
    sequences: ListOf[Sequence],
    robot: RobotSpec,
    seconds: float = 30.0,
    unknown_payload: bool = False,
    corrector: Corrector | None = None,
    progress: Callable[[int, int, float], None] = lambda done, total, rms: None,
    believed: bool = True,
    judge: bool = False,
) -> _Refitted:
    """Fit FIELDS of all operated joints at once.

    Args:
        sequences: Recordings of one unit; windows of 8 s are taken from them evenly.
        robot: Where to start from and what the prior is about; its payloads' masses are taken as true.
        seconds: How much of the recordings.
        unknown_payload: Do not believe the recordings' payload mass; fit one for all of them.
        corrector: Corrects the targets on the way, as in replay.
        progress: Called with iterations done, at most, and the present RMS error in rad.
        believed: Whether kd is what the servos have.
        judge: See how motions are followed that are not fitted; joints that were asked one short motion stay then.

    Raises:
        UsageError: An unknown payload, and recordings filed under several.
    """
    payloads = sorted({s.meta.payload_mass for s in sequences})
    if unknown_payload and len(payloads) > 1:
        raise UsageError(
            f"these recordings are filed under {', '.join(f'{p:g}' for p in payloads)} kg; an unknown payload must be "
            "one and the same: give recordings of one mass"
        )
    parts = cut(sequences, max(1, round(seconds / WINDOW)))
    judged = _judged(parts, robot, corrector, believed) if judge else (np.zeros(0), np.zeros(0))
    kept, less = not judge or parts[0].duration > ONE_COMMAND, judged[0] - judged[1]
    if len(less):
        kept = float(less.mean()) > np.nan_to_num(standard_error(less))
        parts = [parts[i] for turns in _turns(parts) for turn in turns for i in turn]
    runs = RobotRollouts(parts, robot, corrector=corrector)
    spare = np.zeros(runs.n) if believed else robot.kd[runs.op]
    problem = _Problem(runs, Bounds(robot, sequences).first, unknown_payload, spare)
    done = 0

    def tell(cost: Array) -> None:
        nonlocal done
        done += 1
        progress(done, ITERATIONS, SOFT * float(np.sqrt(2 * cost[0] / problem.size)))

    x, _ = descend(
        problem.start(payloads[0])[None, None], problem.low, problem.high, problem.errors, ITERATIONS, tell,
        flat=ENOUGH, derive=problem.slopes,
    )  # fmt: skip
    before, after = (problem.rms(p) for p in (problem.own(float(np.mean(payloads))), x[0, 0]))
    mass = {"payload_mass": float(x[0, 0, -1]), "payload_std": problem.jackknife(x)} if unknown_payload else {}
    return _Refitted(problem.robot_of(x[0, 0]), before, after, **mass, judged=judged, kept=kept)


def _turns(parts: list[Sequence]) -> list[list[list[int]]]:
    """The motions of each set of joints that is recorded together, as numbers of windows; a motion that is alone is
    taken apart into its windows where these are long, else left out, as nothing else can judge it."""
    groups: dict[tuple[str, ...], dict[str, list[int]]] = {}
    for i, p in enumerate(parts):
        groups.setdefault(p.meta.unrecorded, {}).setdefault(p.meta.motion, []).append(i)
    every = [list(motions.values()) for motions in groups.values()]
    every = [[[i] for i in m[0]] if len(m) == 1 and parts[m[0][0]].duration > ONE_COMMAND else m for m in every]
    return [turns for turns in every if len(turns) > 1]


def _judged(
    parts: list[Sequence], robot: RobotSpec, corrector: Corrector | None, believed: bool
) -> tuple[Array, Array]:
    """Mean |error| of motions, as the robot is and fitted to the others, (motions,) rad."""
    every, found = _turns(parts), list[tuple[float, ...]]()
    for k in range(min(FOLDS, max(map(len, every), default=0))):
        out = [turn for turns in every for turn in turns[k::FOLDS]]
        rest = [parts[i] for turns in every for turn in turns if turn not in out for i in turn]
        both = robot, refit(rest, robot, len(rest) * WINDOW, corrector=corrector, believed=believed).robot
        found += [tuple(whole_errors([parts[i] for i in turn], r).mean() for r in both) for turn in out]
    before, after = np.array(found).reshape(-1, 2).T
    return before, after


class _Problem:
    """All joints as one problem: x (P,) says how far each field of n joints is from the robot's own, joint by joint, in
    units of SCALE; then the payload mass in kg, if it is unknown.

    A servo's parameters act on its own joint first: what they do to the others is weaker by the ratio of the inertias.
    So one simulation moves a field of all joints, and each joint's error is put down to its own parameter: six
    simulations for all slopes, however many joints. A payload loads all of them.
    """

    def __init__(self, runs: RobotRollouts, first: Values, unknown_payload: bool, spare: Array) -> None:
        self.runs, self.unknown, self.first, self.n = runs, unknown_payload, first, runs.n
        self.size, kp, one = int(runs.rows.sum()), first["kp"], np.ones(runs.n)
        self.scale = {
            "kp": KP * one, "damping": np.maximum(first["damping"], 0.01 * kp),  # a time constant of 10 ms
            "frictionloss": np.maximum(first["frictionloss"], 0.005 * kp), "offset": 0.02 * one, "delay": 0.02 * one,
        }  # fmt: skip
        least = {"kp": -WIDE_KP * one, "damping": -first["damping"] - spare, "frictionloss": -first["frictionloss"],
                 "offset": -ZERO * one, "delay": -first["delay"]}  # fmt: skip
        most = {"kp": WIDE_KP * one, "damping": SLOW * kp, "frictionloss": kp, "offset": ZERO * one,
                "delay": MAX_DELAY - first["delay"]}  # fmt: skip
        self.low, self.high = (
            np.append(np.stack([ends[f] / self.scale[f] for f in FIELDS], axis=1), [mass] * unknown_payload)[None]
            for ends, mass in ((least, 0.0), (most, MAX_MASS))
        )
        alone, together = PRIOR / SOFT * np.eye(self.n), (1 - TOGETHER) / self.n
        self.prior = np.zeros((len(FIELDS) * self.n, self.low.size))  # errors of the prior over x
        for i, f in enumerate(FIELDS):
            here = np.arange(self.n) * len(FIELDS) + i
            price = KP if f == "kp" else 1.0
            self.prior[np.ix_(here, here)] = price * (alone - PRIOR / SOFT * together * (f in COMMON))

    def own(self, mass: float) -> Array:
        """The robot as it is."""
        return np.append(np.zeros(self.n * len(FIELDS)), [mass] * self.unknown)

    def start(self, mass: float) -> Array:
        """The robot, a little late; an unknown payload at the mass of MASSES that fits best."""
        x = self.own(mass)
        delay = FIELDS.index("delay")
        x[delay : self.n * len(FIELDS) : len(FIELDS)] = np.maximum(LATE - self.first["delay"], 0) / self.scale["delay"]
        if not self.unknown:
            return x
        xs = np.repeat(x[None], len(MASSES), axis=0)
        xs[:, -1] = MASSES
        return np.asarray(xs[np.square(self._runs(xs)).sum(axis=(1, 2)).argmin()])

    def values(self, x: Array) -> Values:
        """(k, P) → field: (k, n)."""
        parts = np.moveaxis(x[:, : self.n * len(FIELDS)].reshape(len(x), self.n, len(FIELDS)), -1, 0)
        moved = {f: part * self.scale[f] for f, part in zip(FIELDS, parts, strict=True)}
        found = {f: np.broadcast_to(v, (len(x), self.n)) for f, v in self.first.items()}
        return found | {f: self.first[f] * np.exp(v) if f == "kp" else self.first[f] + v for f, v in moved.items()}

    def robot_of(self, x: Array) -> RobotSpec:
        """The robot with these parameters; joints that are not operated keep theirs."""
        values = {f: v[0] for f, v in self.values(x[None]).items() if f in FIELDS}
        values |= {f: np.maximum(values[f], 0.0) for f in ("delay", "frictionloss")}  # a bound is met but for rounding
        joints = enumerate(self.runs.robot.operated)
        return self.runs.robot.with_servos({j: {f: float(f"{v[i]:.6g}") for f, v in values.items()} for i, j in joints})

    def rms(self, x: Array) -> float:
        """Root mean square error of the windows, rad."""
        return SOFT * float(np.sqrt(np.square(self._runs(x[None])).mean()))

    def errors(self, xs: Array) -> Array:
        """(k, 1, P) → (k, 1, rows) in SOFT: of every joint's free runs, then the prior's."""
        own = self._runs(xs[:, 0]).reshape(len(xs), -1)
        return np.concatenate([own, xs[:, 0] @ self.prior.T], axis=1)[:, None]

    def slopes(self, x: Array, high: Array, errors: Errors) -> tuple[Array, Array]:
        """The same as least_squares.slopes, for one start."""
        here, count = x[0, 0], len(FIELDS) + self.unknown
        field = np.append(np.tile(np.arange(len(FIELDS)), self.n), [count - 1] * self.unknown).astype(int)
        step = np.where(here + STEP > high[0], -STEP, STEP)
        tried = here + np.concatenate([np.zeros((1, len(here))), (field == np.arange(count)[:, None]) * step])
        found = self._runs(tried)  # (1 + count, n, rows)
        rows = found.shape[2]
        jac = np.zeros((self.n, rows, len(here)), np.float32)
        for i in range(len(here)):
            mine = slice(None) if self.unknown and i == len(here) - 1 else i // len(FIELDS)
            jac[mine, :, i] = (found[1 + field[i], mine] - found[0, mine]) / step[i]
        base = np.concatenate([found[0].ravel(), self.prior @ here])
        return base[None, None], np.concatenate([jac.reshape(-1, len(here)), self.prior])[None, None]

    def jackknife(self, x: Array) -> float:
        """Standard error of the payload mass, kg: by how much it moves when a window is left out (one step of Gauss).

        The model's own errors last as long as a motion, so that rows of a window say little about each other.
        """
        here, jac = (y[0, 0] for y in self.slopes(x, self.high, self.errors))
        window = np.append(np.tile(self.runs.window, self.n), np.full(len(here) - self.n * len(self.runs.window), -1))
        weight, moved = 1 / np.sqrt(1 + here**2), []
        for left_out in range(len(self.runs.parts)):
            w = weight * (window != left_out)
            moved.append(np.linalg.lstsq(jac.T @ (w[:, None] * jac), -jac.T @ (w * here))[0][-1])
        m = len(moved)
        return float(np.sqrt((m - 1) / m * np.square(moved - np.mean(moved)).sum())) if m > 1 else float("nan")

    def _runs(self, xs: Array) -> Array:
        """Errors of free runs, (k, n, rows) in SOFT."""
        parts = self.runs.parts
        if self.unknown:
            parts = [replace(s, meta=replace(s.meta, payload_mass=float(x[-1]))) for x in xs for s in parts]
        return self.runs.run(self.values(xs), parts if self.unknown else None) / np.float32(SOFT)
