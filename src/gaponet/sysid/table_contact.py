"""Table under a robot's tips: heights by forward kinematics, and the table that explains the
recordings best.

A zero offset of every joint's encoder is fitted with it, near zero. Zeros, the tip's place and the
table's height trade against each other, so give a measured height ([table] in robot.toml) where
there is one.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from collections.abc import Sequence as ListOf
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from gaponet.base.arrays import Array
from gaponet.data.sequence import Sequence
from gaponet.robot.spec import RobotSpec, Table
from gaponet.sim.batch import BatchSim, Condition
from gaponet.sim.dynamics import tips_of
from gaponet.sim.metrics import Comparison, by_motion
from gaponet.sim.model import joint_addresses, write_table
from gaponet.sim.replay import rollout_errors
from gaponet.sysid.joint_rollouts import ERROR_SCALE_RAD
from gaponet.sysid.least_squares import Problems, descend, soft_l1
from gaponet.sysid.robot_rollouts import RobotRollouts

# Above the lowest tip, or above the table. Below this a joint's wrong zero may hide a contact.
CONTACT_CLEARANCE_M = 0.045
# Of a rollout: longer ones cost more and do not find a better table.
WINDOW_S = 2.5
MAX_WINDOWS = 14
MAX_WINDOWS_PER_MOTION = 2
START_HEIGHTS = 10  # that are tried, from below the lowest tip upwards
START_HEIGHT_STEP_M = 0.005
FAR_BELOW_M = 10.0  # the lowest tip: a table that nothing touches
ITERATIONS = 6  # of the search from one start
# After so many iterations a start goes on only if no other cost less by then.
COMPARED_AFTER_ITERATIONS = 2
HEIGHT_CHANGE_M = 0.004  # a large change
MAX_HEIGHT_CHANGE_M = 0.03  # from the start
ZERO_STD_RAD = 0.02  # of a usual zero
ZERO_CHANGE_RAD = 0.01  # a large change
MAX_ZERO_RAD = 0.1
ZERO_DECIMALS = 6  # of rad; a joint that turns no tip keeps a zero of exactly 0
ZERO_PRICE = 2e-3  # cost of a zero of ZERO_STD_RAD, per row
# Rows that share the price of the zeros, so that its soft L1 cost is nearly quadratic.
PRIOR_ROWS = 1000


class _Search(NamedTuple):
    """How a number of the table is searched."""

    low: float
    high: float
    large_change: float
    guess: float


FRICTION = _Search(0.0, 1.5, 0.15, 0.3)
# Logarithms of N/m: of the search, and of starts that are searched by themselves.
LOG_STIFFNESS = _Search(np.log(100.0), np.log(1e5), 0.7, np.log(2000.0))
START_LOG_STIFFNESS = tuple(np.log((500.0, 8000.0)))


@dataclass(frozen=True)
class TableFit:
    """Result of the fit of a table.

    Attributes:
        robot: The robot, with the table and the zeros if they are accepted.
        accepted: Whether they explain the windows' motions significantly better than no table
            (`Comparison`).
        before, after: Mean |error| of the windows without and with table, (windows,) rad.
        motions: Motions in which a tip comes near.
    """

    robot: RobotSpec
    accepted: bool
    before: Array
    after: Array
    motions: tuple[str, ...]


def tip_heights(sequences: ListOf[Sequence], robot: RobotSpec) -> list[Array]:
    """Return the height of the lowest tip in every row, (rows,) m each; nothing if robot.toml
    names no tip.
    """
    lowest_tip = tips_of(robot)
    if lowest_tip is None:
        return []
    return [lowest_tip(s.qpos) for s in sequences]


def contact_height(robot: RobotSpec, heights: ListOf[Array]) -> float:
    """Return the height under which a tip may touch something, m.

    At most half of the rows are lower, so that rows to fit remain for motions close to the table or
    to nothing.
    """
    if not robot.scene.tips or not heights:
        return -np.inf
    rows = np.concatenate(heights)
    surface = rows.min()
    if robot.scene.table is not None:
        surface = robot.scene.table.height
    return float(min(surface + CONTACT_CLEARANCE_M, np.median(rows)))


def low_windows(
    sequences: ListOf[Sequence],
    heights: ListOf[Array],
    below: float,
) -> list[Sequence]:
    """Return the windows in which a tip comes below a height, m, the longest first."""
    windows = []
    for s, height in zip(sequences, heights, strict=True):
        rows = min(round(WINDOW_S / s.dt), len(s))
        for start in range(0, len(s) - rows + 1, rows):
            window = slice(start, start + rows)
            if (height[window] < below).any():
                windows.append(s.rows(window))
    return sorted(windows, key=lambda s: -len(s))


def _most_wrong(scene: _TableRollouts, away: Array) -> list[Sequence]:
    """Return at most MAX_WINDOWS, MAX_WINDOWS_PER_MOTION of a motion, whose rollouts with a table
    `away` are worst.
    """
    worst_first = np.argsort(-scene.mean(away[0])).tolist()
    taken = Counter[str]()  # motion → windows
    picked: list[int] = []
    for number in worst_first:
        motion = scene.parts[number].meta.motion
        if taken[motion] < MAX_WINDOWS_PER_MOTION and len(picked) < MAX_WINDOWS:
            taken[motion] += 1
            picked.append(number)
    return [scene.parts[number] for number in sorted(picked)]


def fit_table(
    parts: list[Sequence],
    robot: RobotSpec,
    lowest: float,
    nthread: int,
    report: Callable[[float], object],
    validation: ListOf[Sequence] = (),
) -> TableFit:
    """Fit height, friction and stiffness of the table and the zeros, from several starts.

    Args:
        parts: Windows in which a tip is low; those with the largest errors without a table are
            fitted.
        robot: The robot with fitted servos; if it has a table, the height is taken as measured.
        lowest: Least height of a tip in the windows, m.
        report: Called in each iteration with the root mean square error, rad; a true answer ends
            the search.
        validation: Whole recordings that choose among the starts' results; without them the windows
            do.
    """
    if not parts:
        return TableFit(robot, False, np.zeros(0), np.zeros(0), ())
    measured = robot.scene.table
    zeros = np.zeros(len(robot.operated))
    away = np.array([[lowest - FAR_BELOW_M, FRICTION.guess, LOG_STIFFNESS.guess, *zeros]])
    scene = _most_wrong_windows(parts, robot, away, lowest, nthread)
    heights = lowest + START_HEIGHT_STEP_M * np.arange(-2, START_HEIGHTS - 2)
    if measured is not None:
        heights = np.array([measured.height])
    starts = _starts(scene, away, heights)
    results = _searched(scene, starts, report, is_measured=measured is not None)
    robots = [_with_table(robot, x) for x, _ in results]
    errors = [cost for _, cost in results]
    if validation:
        errors = [float(rollout_errors(validation, one, nthread).mean()) for one in robots]
    best = int(np.argmin(errors))
    best_x, _ = results[best]
    return _judged(scene, robot, robots[best], scene.mean(away[0]), scene.mean(best_x))


def _judged(
    scene: _TableRollouts,
    given: RobotSpec,
    fitted: RobotSpec,
    before: Array,
    after: Array,
) -> TableFit:
    """Return the fitted robot with a table if the windows' motions accept it, else the given one.

    Args:
        before, after: Mean |error| of the windows without and with table, (windows,) rad.
    """
    metas = [window.meta for window in scene.parts]
    motions = tuple(dict.fromkeys(meta.independent_motion for meta in metas))
    comparison = Comparison("table", by_motion(metas, before), by_motion(metas, after))
    robot = fitted if comparison.accepted else given
    return TableFit(robot, comparison.accepted, before, after, motions)


def _most_wrong_windows(
    parts: list[Sequence],
    robot: RobotSpec,
    away: Array,
    lowest: float,
    nthread: int,
) -> _TableRollouts:
    """Return rollouts of the windows that go most wrong with a table `away`, on a robot with a
    table: its own, or one at `lowest`, m.
    """
    guess = Table(lowest, FRICTION.guess, float(np.exp(LOG_STIFFNESS.guess)))
    with_table = robot.with_table(robot.scene.table or guess)
    every = _TableRollouts(parts, with_table, nthread)
    return _TableRollouts(_most_wrong(every, away), with_table, nthread)


def _starts(scene: _TableRollouts, away: Array, heights: Array) -> Array:
    """Return a start for each of START_LOG_STIFFNESS at its best height, the best first, (starts,
    3 + n).
    """
    stiffnesses = np.array(START_LOG_STIFFNESS)
    guesses = np.tile(away, (len(stiffnesses), len(heights), 1))  # (starts, heights, 3 + n)
    guesses[..., 0] = heights
    guesses[..., 2] = stiffnesses[:, None]
    candidates = guesses.reshape(-1, guesses.shape[-1])
    costs = soft_l1(scene.soft_errors(candidates)).reshape(guesses.shape[:2])
    starts = guesses[np.arange(len(guesses)), costs.argmin(axis=1)]
    best_first = costs.min(axis=1).argsort()
    return np.asarray(starts[best_first])


def _searched(
    scene: _TableRollouts,
    starts: Array,
    report: Callable[[float], object],
    *,
    is_measured: bool,
) -> list[tuple[Array, float]]:
    """Return the best table and zeros (3 + n,) near each start (k, 3 + n), and their cost, until
    `report` says that the time is over.

    A measured height stays.
    """
    progress = _TableProgress(report, len(scene.window) * scene.n)
    results = []
    for start in starts:
        if progress.is_over:
            break
        progress.begin_start()
        results.append(_search_near(scene, start, progress, is_measured=is_measured))
    return results


class _TableProgress:
    """Progress of searches from one start after another; which of them go on.

    Attributes:
        is_over: Whether the time is over.
    """

    def __init__(self, report: Callable[[float], object], rows: int) -> None:
        """Report to a function of the RMS error, rad, of so many rows of all joints."""
        self.is_over = False
        self._report = report
        self._rows = rows
        self._iterations = 0  # of the present start
        # Of the starts before, after COMPARED_AFTER_ITERATIONS iterations.
        self._least_cost = np.inf

    def begin_start(self) -> None:
        """Begin with the next start."""
        self._iterations = 0

    def ends(self, costs: Array) -> bool:
        """Report an iteration; return whether the search from this start ends: the time is over,
        or another start cost less after COMPARED_AFTER_ITERATIONS iterations.
        """
        self._iterations += 1
        cost = float(costs.sum())
        rms = ERROR_SCALE_RAD * float(np.sqrt(2 * cost / self._rows))
        self.is_over = bool(self._report(rms))
        if self._iterations != COMPARED_AFTER_ITERATIONS:
            return self.is_over
        if cost > self._least_cost:
            return True
        self._least_cost = cost
        return self.is_over


def _search_near(
    scene: _TableRollouts,
    start: Array,
    progress: _TableProgress,
    *,
    is_measured: bool,
) -> tuple[Array, float]:
    """Return the best table and zeros (3 + n,) near a start, and their cost."""
    rows = len(scene.window) * scene.n
    one = np.ones(scene.n)
    large_change = np.concatenate(
        [
            [HEIGHT_CHANGE_M, FRICTION.large_change, LOG_STIFFNESS.large_change],
            ZERO_CHANGE_RAD * one,
        ]
    )
    height_range = 0.0 if is_measured else MAX_HEIGHT_CHANGE_M
    lowest = start[0] - height_range
    highest = start[0] + height_range
    low = np.concatenate([[lowest, FRICTION.low, LOG_STIFFNESS.low], -MAX_ZERO_RAD * one])
    high = np.concatenate([[highest, FRICTION.high, LOG_STIFFNESS.high], MAX_ZERO_RAD * one])
    price_of_zero = np.sqrt(2 * ZERO_PRICE * rows / PRIOR_ROWS) / ZERO_STD_RAD

    def errors(changes: Array) -> Array:
        """Return errors and the price of the zeros, (k, 1, …), of changes (k, 1, 3 + n) in large
        changes.
        """
        xs = start + large_change * changes[:, 0]
        priced = np.repeat(price_of_zero * xs[:, 3:], PRIOR_ROWS, axis=1)
        both = np.concatenate([scene.soft_errors(xs), priced], axis=1)
        return both[:, None].astype(np.float32)

    lowest_change = (low - start) / large_change
    highest_change = (high - start) / large_change
    problems = Problems(errors, lowest_change[None], highest_change[None])
    no_change = np.zeros((1, 1, len(start)))
    changes, cost = descend(problems, no_change, ITERATIONS, progress.ends)
    return start + large_change * changes[0, 0], float(cost[0, 0])


def _with_table(robot: RobotSpec, x: Array) -> RobotSpec:
    """Return the robot with a table and zeros (3 + n,)."""
    zeros = robot.servo.zero[robot.operated_index] + x[3:]
    servos = {}
    for joint, zero in zip(robot.operated, zeros, strict=True):
        servos[joint] = {"zero": round(float(zero), ZERO_DECIMALS)}
    table = Table(_four_digits(x[0]), _four_digits(x[1]), _four_digits(np.exp(x[2])))
    return robot.with_identified(servos).with_table(table)


def _four_digits(value: float) -> float:
    return float(f"{value:.4g}")


class _TableRollouts(RobotRollouts):
    """Rollouts of windows with candidates of the table: rows of [height m, friction, log
    stiffness, zeros rad].
    """

    def errors(self, xs: Array) -> Array:
        """Return q_sim − q_real of candidates (k, 3 + n), (k, n, rows) rad."""
        conditions = [Condition.of(s, self.robot) for s in self.parts] * len(xs)
        sim = BatchSim(self.robot, conditions, self.nthread, self.locked)
        model = sim.models[conditions[0]]
        of_simulations = np.repeat(xs, len(self.parts), axis=0)  # (k · windows, 3 + n)
        height, friction, log_stiffness = of_simulations[:, :3].T
        write_table(sim.batch, model, height, friction, np.exp(log_stiffness))
        _, dof = joint_addresses(model, self.robot.operated)
        sim.batch.expand("qpos0")[:, dof] -= of_simulations[:, 3:]
        return self.simulated_errors(sim)

    def soft_errors(self, xs: Array) -> Array:
        """Return the errors of candidates in ERROR_SCALE_RAD, (k, n · rows)."""
        return self.errors(xs).reshape(len(xs), -1) / np.float32(ERROR_SCALE_RAD)

    def mean(self, x: Array) -> Array:
        """Return the mean |error| of a candidate (3 + n,) by window, (windows,) rad."""
        size = np.abs(self.errors(x[None])[0]).mean(axis=0)
        return np.bincount(self.window, size) / np.bincount(self.window)
