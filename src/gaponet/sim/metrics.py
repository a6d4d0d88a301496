"""Metrics of a simulator's rollouts against recordings, by joint, motion, payload and horizon.

e = q_sim − q_real after each step, operated joints only. A motion counts as one whatever its
length; a group's number is the mean over its sequences.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable, Iterator
from collections.abc import Sequence as ListOf
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from gaponet.base.arrays import Array
from gaponet.data.sequence import Sequence, SequenceMeta
from gaponet.robot.spec import RobotSpec

THRESHOLDS = (0.05, 0.1, 0.5)  # rad, of the large-gap ratio
HORIZONS_S = (0.02, 0.2, 1.0, 5.0)  # 1, 10, 50, 250 steps at 50 Hz
HORIZON_NAMES = (*(f"{s:g}" for s in HORIZONS_S), "whole")
MIN_RELATIVE_GAIN = 0.01  # of the mean error, where several motions judge
MIN_RELATIVE_GAIN_ONE_MOTION = 0.1
CONFIDENCE = 0.84  # one-sided level of Student's t: one standard error where motions are many
_Row = dict[str, float]  # metrics of a sequence, or their means


def standard_error(values: Array | ListOf[float]) -> float:
    """Return the standard error of the mean of values by motion, or of paired differences; nan for
    a single one.
    """
    values = np.asarray(values)
    return float(values.std(ddof=1) / np.sqrt(len(values))) if len(values) > 1 else float("nan")


def by_motion(metas: Iterable[SequenceMeta], values: Array) -> Array:
    """Return the mean of values (recordings,) over the recordings of each independent motion,
    (motions,).
    """
    names = np.array([m.independent_motion for m in metas])
    return np.array([values[names == name].mean() for name in dict.fromkeys(names.tolist())])


def mean_reduction(
    metas: Iterable[SequenceMeta], before: Array, after: Array
) -> tuple[float, float]:
    """Return the mean of before − after, (recordings,) each, and its standard error over
    independent motions.
    """
    reduction = before - after
    return float(reduction.mean()), standard_error(by_motion(metas, reduction))


def confidence_factor(freedom: int) -> float:
    """Return the standard errors that a mean with so many degrees of freedom needs to be
    significant (Student's t).
    """
    from scipy.special import stdtrit

    return float(stdtrit(freedom, CONFIDENCE))


@dataclass(frozen=True)
class Comparison:
    """A candidate against another one by the errors of the motions that judge, (motions,) rad.

    Attributes:
        equally_complex: True if the candidate has no more parameters than the other one, so that a
            smaller mean error is enough.
    """

    name: str
    before: Array
    after: Array
    equally_complex: bool = field(default=False, kw_only=True)

    @property
    def gain(self) -> tuple[float, float]:
        """Decrease of the mean error, and its paired standard error over motions, rad."""
        gains = self.before - self.after
        return float(gains.mean()), standard_error(gains)

    @property
    def harmful(self) -> bool:
        """True if the mean error rises by more than its paired standard error and by 1 %; of fewer
        than three motions, by 10 %.
        """
        gain, error = self.gain
        least = MIN_RELATIVE_GAIN if len(self.before) > 2 else MIN_RELATIVE_GAIN_ONE_MOTION
        return bool(gain < -max(np.nan_to_num(error), least * self.before.mean()))

    @property
    def accepted(self) -> bool:
        """True if the mean error falls by more than 1 % and the paired relative gain exceeds one
        standard error (Student's t); of a single motion by more than 10 %.
        """
        if self.equally_complex:
            return self.gain[0] > 0
        freedom = len(self.before) - 1
        least = MIN_RELATIVE_GAIN
        if not freedom:
            least = MIN_RELATIVE_GAIN_ONE_MOTION
        relative = (self.before - self.after) / np.maximum(self.before + self.after, 1e-12)
        significant = not freedom or relative.mean() > confidence_factor(freedom) * standard_error(
            relative
        )
        return bool(significant and self.gain[0] > least * self.before.mean())


@dataclass(frozen=True)
class Run:
    """One simulated sequence beside its recording: real and sim positions of the operated joints,
    (T, n) rad.
    """

    meta: SequenceMeta
    dt: float
    qpos_real: Array
    qpos_sim: Array
    recorded: tuple[int, ...]  # columns that the recording holds

    @classmethod
    def of(cls, real: Sequence, simulated: Array, robot: RobotSpec) -> Run:
        """Pair a recording with simulated positions of all joints, (T, n_all) rad."""
        op = robot.operated_index
        held = tuple(i for i, j in enumerate(robot.operated) if j not in real.meta.unrecorded)
        return cls(real.meta, real.dt, real.qpos[:, op], np.asarray(simulated)[:, op], held)

    @property
    def error(self) -> Array:
        """e after each step, (T − 1, n) rad, without the common start."""
        result: Array = (self.qpos_sim - self.qpos_real)[1:]
        return result

    def holds(self, columns: list[int] | None) -> list[int]:
        """Return the columns, out of these (None: all), that the recording holds."""
        return [i for i in self.recorded if columns is None or i in columns]

    def mean_error(self, columns: list[int] | None = None) -> float:
        """Return the mean |e| over the columns, out of these (None: all), that the recording
        holds, rad.
        """
        return float(np.abs(self.error[:, self.holds(columns)].astype(float)).mean())


def runs(sequences: ListOf[Sequence], simulated: ListOf[Array], robot: RobotSpec) -> list[Run]:
    """Put recordings and simulated positions (T, n_all) together, operated joints only."""
    return [Run.of(s, q, robot) for s, q in zip(sequences, simulated, strict=True)]


def summary(part: Iterable[Run], robot: RobotSpec) -> dict[str, Any]:
    """All metrics of a method: totals, and by joint, motion, payload, unit and horizon; one run in
    memory at a time.

    Joints that no recording holds are left out of by_joint.
    """
    rows: dict[str, dict[str, list[_Row]]] = defaultdict(lambda: defaultdict(list))
    for run in part:
        for group, name, of_run in _grouped_rows(run, robot):
            rows[group][name] += of_run
    order = {
        "joint": [j for j in robot.operated if rows["joint"][j]],
        "motion": sorted(rows["motion"]),
        "independent_motion": sorted(rows["independent_motion"]),
        "payload": sorted(rows["payload"]),
        "unit": sorted(rows["unit"]),
        "horizon": [h for h in HORIZON_NAMES if h in rows["horizon"]],
    }
    result: dict[str, Any] = {"mpjae_no_wrist": float("nan")} | _mean(rows["all"][""])
    for group, names in order.items():
        result[f"by_{group}"] = {name: _mean(rows[group][name]) for name in names}
    return result


def _grouped_rows(run: Run, robot: RobotSpec) -> Iterator[tuple[str, str, list[_Row]]]:
    """Yield groups, a run's name in each, and its metrics there: one row, or none if it holds no
    such joint.
    """
    meta = run.meta
    whole = _row(run)
    # The paper's figure 3 is without wrists.
    no_wrist = [i for i, joint in enumerate(robot.operated) if "wrist" not in joint]
    for row, arm in zip(whole, _row(run, no_wrist), strict=False):
        row["mpjae_no_wrist"] = arm["mpjae"]
    yield "all", "", whole
    yield "motion", meta.motion, whole
    yield "independent_motion", meta.independent_motion, whole
    yield "payload", f"{meta.payload_mass:g}", whole
    yield "unit", meta.unit_id, whole
    for i, joint in enumerate(robot.operated):
        yield "joint", joint, _row(run, [i])
    for horizon, error in _horizons(run).items():
        yield "horizon", horizon, [{"mpjae": error}]


def metrics(part: ListOf[Run], columns: list[int] | None = None) -> dict[str, float]:
    """Metrics averaged over sequences, over all joints or over some columns.

    Returns:
        mpjae rad, rmse rad, q_dis rad·s (Δt Σ|e| per joint), static and dynamic rad (the median
        error; the rest), iqr and range of |e| rad, large_0.05 … shares of |e| beyond a threshold,
        correlation, cosine, mape % (those that SAGE and the paper report, tables show the first
        few).
    """
    rows = []
    for run in part:
        rows += _row(run, columns)
    return _mean(rows)


def _mean(rows: list[_Row]) -> _Row:
    """Return the mean of each metric over the rows that have it."""
    values: dict[str, list[float]] = {}
    for row in rows:
        for metric, value in row.items():
            values.setdefault(metric, []).append(value)
    return {metric: float(np.mean(each)) for metric, each in values.items()}


def _row(run: Run, columns: list[int] | None = None) -> list[_Row]:
    """Return a sequence's metrics over these columns; nothing if it holds none of them."""
    held = run.holds(columns)
    if not held:
        return []
    error = run.error[:, held].astype(float)
    size = np.abs(error)
    real = run.qpos_real[1:, held].astype(float)
    sim = run.qpos_sim[1:, held].astype(float)
    norms = np.linalg.norm(real, axis=0) * np.linalg.norm(sim, axis=0)
    low, high = np.percentile(size, [25, 75], axis=0)
    bias = np.median(error, axis=0)
    out = {
        "mpjae": run.mean_error(columns),
        "rmse": np.sqrt((error**2).mean(axis=0)).mean(),
        "q_dis": (size.sum(axis=0) * run.dt).mean(),
        "static": np.abs(bias).mean(),
        "dynamic": np.abs(error - bias).mean(),
        "iqr": (high - low).mean(),
        "range": np.ptp(size, axis=0).mean(),
        "correlation": _mean_correlation(real, sim),
        "cosine": ((real * sim).sum(0) / np.maximum(norms, 1e-12)).mean(),
        "mape": (size / np.maximum(np.abs(real), 0.01)).mean() * 100,
    }
    return [out | {f"large_{t:g}": (size >= t).mean() for t in THRESHOLDS}]


def _mean_correlation(real: Array, sim: Array) -> float:
    """Return Pearson's r, averaged over joints that moved; 1 if none did."""
    moved = (np.ptp(real, axis=0) > 0.01) & (np.ptp(sim, axis=0) > 1e-6)
    if not moved.any():
        return 1.0
    values = []
    for recorded, simulated in zip(real.T[moved], sim.T[moved], strict=True):
        values.append(np.corrcoef(recorded, simulated)[0, 1])
    return float(np.mean(values))


def _horizons(run: Run) -> _Row:
    """Return the mean |error| at horizons after the start, over the last half of each, and over
    the whole motion.
    """
    error = np.abs(run.error[:, list(run.recorded)])
    errors = {}
    for name, seconds in zip(HORIZON_NAMES, HORIZONS_S, strict=False):
        last = max(round(seconds / run.dt), 1)
        if last <= len(error):
            errors[name] = error[last // 2 : last].mean()
    return errors | {"whole": error.mean()}
