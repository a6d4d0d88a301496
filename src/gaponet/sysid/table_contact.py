"""Where a robot's tips touch a table: heights by forward kinematics, and the table that explains the recordings best.

A zero of every joint's encoder is fitted with it, near none: zeros, the tip's place and the table's height trade
against each other, so give a measured height ([table] in robot.toml) where there is one.
"""

from __future__ import annotations

from collections.abc import Callable
from collections.abc import Sequence as ListOf
from dataclasses import dataclass, replace

import numpy as np
from scipy.optimize import Bounds, OptimizeResult, differential_evolution

from gaponet.data.sequence import Sequence
from gaponet.robot.spec import RobotSpec, Table
from gaponet.sim.batch import BatchSim, Condition
from gaponet.sim.dynamics import tips_of
from gaponet.sim.metrics import standard_error
from gaponet.sim.replay import idle_limbs, rollout, whole_errors
from gaponet.sim.table import write_table
from gaponet.sysid.joint_rollouts import SETTLE, SOFT
from gaponet.sysid.least_squares import soft

Array = np.ndarray

CLEARANCE = 0.045  # m above the lowest tip, or the table, in which a joint's zero may hide a contact
WINDOW = 5.0  # s
WINDOWS, PER_MOTION = 14, 2
HEIGHTS, STEP = 10, 0.005  # tried first, from the lowest tip upwards, and m between them
CANDIDATES, GENERATIONS, AROUND = 16, 10, 1.5  # of the search, and how wide it begins, in large changes
EARLY = 3  # generations after which a start goes on only if no other one cost less by then
ZERO, PRICE = 0.02, 2e-3  # rad: an ordinary zero, and what it costs (soft square of one for a row)
# Table's friction and stiffness (N/m): lowest, highest, a large change, first guess; stiffness in its logarithm.
FRICTION = (0.0, 1.5, 0.15, 0.3)
STIFFNESS = (np.log(100.0), np.log(1e5), 0.7, np.log(2000.0))
STARTS = tuple(np.log((500.0, 8000.0)))  # stiffness from which the search begins, each by itself


@dataclass(frozen=True)
class Touch:
    """What was found about the table.

    Attributes:
        robot: The robot with the table and the zeros, where they explain the recordings better than none; else without.
        kept: Whether they do.
        before, after: Mean |error| without and with, rad, of the windows, (windows,).
        motions: Motions in which a tip comes near.
    """

    robot: RobotSpec
    kept: bool
    before: Array
    after: Array
    motions: tuple[str, ...]


def tip_heights(sequences: ListOf[Sequence], robot: RobotSpec) -> list[Array]:
    """Lowest point of any tip in every row, (rows,) m; none where robot.toml names no tip."""
    heights = tips_of(robot)
    return [heights(s.qpos) for s in sequences] if heights else []


def touching_below(robot: RobotSpec, heights: ListOf[Array]) -> float:
    """Height under which a tip may touch, m: of half of the rows at most, so that motions close to the table, or to
    nothing at all, leave rows to be fitted."""
    if not robot.tips or not heights:
        return -np.inf
    rows = np.concatenate(heights)
    return float(min((rows.min() if robot.table is None else robot.table.height) + CLEARANCE, np.median(rows)))


def low_windows(sequences: ListOf[Sequence], heights: ListOf[Array], below: float) -> list[Sequence]:
    """The windows in which a tip comes below a height, longest first."""
    found = []
    for s, height in zip(sequences, heights, strict=True):
        rows = min(round(WINDOW / s.dt), len(s))
        starts = range(0, len(s) - rows + 1, rows)
        found += [s.rows(slice(a, a + rows)) for a in starts if (height[a : a + rows] < below).any()]
    return sorted(found, key=lambda s: -len(s))


def _most_wrong(scene: _Scene, away: Array) -> list[Sequence]:
    """At most WINDOWS, PER_MOTION of a motion, whose free runs without a table (1, 3 + n) are worst."""
    order = np.argsort(-scene.mean(scene.errors(away))[0])
    taken: dict[str, list[int]] = {}
    for i in order.tolist():
        taken.setdefault(scene.parts[i].meta.motion, []).append(i)
    best = {i for mine in taken.values() for i in mine[:PER_MOTION]}
    return [scene.parts[i] for i in sorted([i for i in order.tolist() if i in best][:WINDOWS])]


def fit_table(
    parts: list[Sequence],
    robot: RobotSpec,
    lowest: float,
    nthread: int,
    progress: Callable[[float], None],
    validation: ListOf[Sequence] = (),
) -> Touch:
    """Fit height, friction and stiffness of the table, and the zeros, from several starts.

    Args:
        parts: Windows in which a tip is low; those that fit worst without a table are fitted.
        robot: Servos and all; with a table its height is taken as measured.
        lowest: Tip height in them, m.
        nthread: Threads, 0 for all cores.
        progress: Called in each iteration with the root mean square error, rad.
        validation: Recordings, whole, that say which start's table is taken; without them the windows do.
    """
    if not parts:
        return Touch(robot, False, np.zeros(0), np.zeros(0), ())
    n, measured = len(robot.operated), robot.table
    with_table = replace(robot, table=measured or Table(lowest, FRICTION[3], float(np.exp(STIFFNESS[3]))))
    away = np.array([[lowest - 10.0, FRICTION[3], STIFFNESS[3], *np.zeros(n)]])
    scene = _Scene(parts, with_table, nthread)
    scene = _Scene(_most_wrong(scene, away), with_table, nthread)
    motions = tuple(dict.fromkeys(s.meta.motion for s in scene.parts))
    before = scene.errors(away)
    heights = lowest + STEP * np.arange(-2, HEIGHTS - 2) if measured is None else np.array([measured.height])
    guesses = np.repeat(away, len(STARTS) * len(heights), axis=0)
    guesses[:, 0], guesses[:, 2] = np.tile(heights, len(STARTS)), np.repeat(STARTS, len(heights))
    costs = soft(scene.soft_errors(guesses)).reshape(len(STARTS), -1)
    starts = guesses.reshape(*costs.shape, -1)[np.arange(len(STARTS)), costs.argmin(axis=1)]
    pace, best_first = [np.inf], starts[costs.min(axis=1).argsort()]
    found = [_searched(scene, start, measured is not None, progress, pace) for start in best_first]
    tables = [_with_table(robot, x) for x, _ in found]
    errors = [whole_errors(validation, one, nthread).mean() for one in tables] if validation else [x[1] for x in found]
    best = int(np.argmin(errors))
    without, within = (scene.mean(e)[0] for e in (before, scene.errors(found[best][0][None])))
    kept = bool((without - within).mean() > np.nan_to_num(standard_error(without - within)))
    return Touch(tables[best] if kept else robot, kept, without, within, motions)


def _searched(
    scene: _Scene, start: Array, measured: bool, progress: Callable[[float], None], pace: list[float]
) -> tuple[Array, float]:
    """Table and zeros (3 + n,) near a start that fit best, and their cost; its height stays where it was measured, and
    it ends after EARLY generations where another start cost less by then (`pace`)."""
    n, rows = len(scene.op), scene.counted.sum() * len(scene.op)
    unit = np.array([0.004, FRICTION[2], STIFFNESS[2], *np.full(n, 0.5 * ZERO)])
    low = np.array([start[0] - 0.03 * (not measured), FRICTION[0], STIFFNESS[0], *np.full(n, -5 * ZERO)])
    high = np.array([start[0] + 0.03 * (not measured), FRICTION[1], STIFFNESS[1], *np.full(n, 5 * ZERO)])

    def cost(xs: Array) -> Array:
        """Costs of tables and zeros, one to a column."""
        return soft(scene.soft_errors(xs.T)) + PRICE * rows * np.square(xs[3:] / ZERO).sum(axis=0)

    def tell(intermediate_result: OptimizeResult) -> None:
        progress(SOFT * float(np.sqrt(2 * intermediate_result.fun / rows)))
        if intermediate_result.nit == EARLY:
            if intermediate_result.fun > min(pace):
                raise StopIteration
            pace.append(intermediate_result.fun)

    # Contacts come and go: the surface has no slopes to follow, and its valley of heights and zeros has walls.
    rng = np.random.default_rng(0)
    population = start + AROUND * unit * rng.standard_normal((CANDIDATES, len(unit)))
    population[0] = start
    found = differential_evolution(
        cost, Bounds(low, high), init=np.clip(population, low, high), maxiter=GENERATIONS, tol=0, polish=False,
        vectorized=True, updating="deferred", callback=tell, rng=rng,
    )  # fmt: skip
    return found.x, float(found.fun)


def _with_table(robot: RobotSpec, x: Array) -> RobotSpec:
    """The robot with a table and zeros (3 + n,)."""
    zeros = robot.zero[robot.operated_index] + x[3:]
    servos = {j: {"zero": float(f"{z:.4g}")} for j, z in zip(robot.operated, zeros, strict=True)}
    height, friction, stiffness = (float(f"{v:.4g}") for v in (x[0], x[1], np.exp(x[2])))
    return replace(robot.with_servos(servos), table=Table(height, friction, stiffness))


class _Scene:
    """Windows beside tables and zeros of many kinds: rows of [height m, friction, log stiffness, zeros rad]."""

    def __init__(self, parts: list[Sequence], robot: RobotSpec, nthread: int) -> None:
        self.parts, self.robot, self.nthread, self.op = parts, robot, nthread, robot.operated_index
        self.locked, lengths = idle_limbs(parts, robot), np.array([len(s) for s in parts])
        self.real = np.zeros((lengths.max(), len(parts), len(self.op)))  # zero where it does not count
        for i, s in enumerate(parts):
            self.real[: len(s), i] = s.qpos[:, self.op]
        time = np.arange(1, lengths.max())[:, None]
        self.counted = (time >= SETTLE / parts[0].dt) & (time < lengths)

    def errors(self, xs: Array) -> Array:
        """q_sim − q_real, (rows − 1, k, windows, n) rad, of tables and zeros (k, 3 + n)."""
        k, m = len(xs), len(self.parts)
        conditions = [Condition.of(s, self.robot) for s in self.parts] * k
        sim = BatchSim(self.robot, conditions, self.nthread, self.locked)
        rows = np.repeat(xs, m, axis=0)
        model = sim.models[conditions[0]]
        write_table(sim.batch, model, rows[:, 0], rows[:, 1], np.exp(rows[:, 2]))
        dof = np.array([model.joint(j).dofadr[0] for j in self.robot.operated])
        sim.batch.expand("qpos0")[:, dof] -= rows[:, 3:]
        qpos = rollout(sim, self.parts * k)[0, 1:][..., self.op]
        error = qpos.reshape(len(qpos), k, m, -1) - self.real[1:, None]
        return np.asarray(error * self.counted[:, None, :, None], np.float32)

    def soft_errors(self, xs: Array) -> Array:
        """The same in SOFT, (k, rows)."""
        return np.asarray(np.moveaxis(self.errors(xs), 1, 0).reshape(len(xs), -1) / np.float32(SOFT))

    def mean(self, errors: Array) -> Array:
        """Mean |error| by window, (k, windows) rad."""
        return np.asarray(np.abs(errors).mean(axis=3).sum(axis=0) / self.counted.sum(axis=0))
