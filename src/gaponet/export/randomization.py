"""Randomisation for training: units sampled from a robot's uncertainty, and ranges.

Scope "today" uses the errors of this robot's values, "any-day" also the differences between its
sessions on several days, "any-robot" the differences between several robots of its type. Days and
robots are sampled whole, so that numbers which change together (a cold day) stay together; numbers
sampled one by one give robots that do not exist. Motions show torques over kp: if kp of a unit is
wrong, its torque limit is wrong by the same factor.
"""

from __future__ import annotations

from collections.abc import Mapping
from collections.abc import Sequence as ListOf
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np

from gaponet.base.arrays import Array
from gaponet.base.errors import UsageError
from gaponet.base.files import lock_folder, write_json, write_text
from gaponet.base.progress import Progress, no_progress
from gaponet.data.sequence import Sequence
from gaponet.export.drawn_robots import RANGE_PERCENT, DrawnRobots, draw_robots
from gaponet.export.plain_servos import comparable
from gaponet.robot.servo_fields import SERVO_FIELDS
from gaponet.robot.spec import RobotSpec, load_robot
from gaponet.sim.links import LinkAxes
from gaponet.sysid.uncertainty import ParameterUncertainty, from_axes, prior_std, to_axes

Scope = Literal["today", "any-day", "any-robot"]
Engine = Literal["json", "mujoco", "mjlab", "isaaclab"]

FOLDER_KIND = "engine"
FILE = "randomization.json"
SHIPPED = Path(__file__).parent / "shipped"
LEAST_INVERSE = 0.2  # of a drawn value on an inverse axis, over the mean
RANGE_SAMPLES = 4096
# of the prior's: logs with a larger standard deviation say nothing about a number
UNDETERMINED_STD = 0.8
MIN_ROBOTS = 3  # of a type


@dataclass(frozen=True)
class Randomization:
    """Sampled units of a robot.

    Attributes:
        units: Field → (samples, n), SI units, and coordinates of drawn links, (samples, Q); a row
            is one unit.
        ranges: Joint → field → low, value, high; 9 of 10 units lie between.
        unknown: "joint: field" of the numbers that no log determines.
        links: Axes of drawn links.
        judged: The units with the servo model that recordings chose; None without recordings.
        plain: The same of the robot as fitted without its servo model.
    """

    robot: str
    scope: Scope
    units: dict[str, Array]
    ranges: dict[str, dict[str, tuple[float, float, float]]]
    unknown: tuple[str, ...]
    notes: tuple[str, ...]
    links: LinkAxes | None = None
    judged: DrawnRobots | None = None
    plain: DrawnRobots | None = None


def sample_units(
    robot: RobotSpec | Path,
    scope: Scope = "today",
    others: ListOf[Path] = (),
    samples: int = 256,
    seed: int = 0,
    engine: Engine = "json",
) -> Randomization:
    """Sample units of a robot.

    Args:
        robot: Robot folder that gaponet identify or gaponet adapt wrote.
        scope: "today": errors of the values of this robot. "any-day": also differences between its
            sessions on different days. "any-robot": differences between robots of its type.
        others: Robot folders of the type, each identified from its own logs.
        samples: Number of units.
        engine: Isaac Lab's units have the identified links.

    Raises:
        UsageError: Data for the scope are missing; the message says which.
    """
    spec = robot if isinstance(robot, RobotSpec) else load_robot(robot)
    uncertainty = ParameterUncertainty.require(spec)
    fields = uncertainty.fields
    joints = spec.operated
    now = np.stack([uncertainty.array(j, "values") for j in joints])
    covariance = np.stack([uncertainty.array(j, "covariance") for j in joints])
    mean, deviations, notes = _between_units(spec, uncertainty, scope, others)
    unknown = np.sqrt(np.einsum("njj->nj", covariance)) > UNDETERMINED_STD * prior_std(fields, now)
    rng = np.random.default_rng(seed)
    count = max(RANGE_SAMPLES, samples)
    single = _uncorrelated_share(deviations)
    weights = rng.standard_normal((count, len(deviations)))
    x = mean + np.sqrt(1 - single) * np.einsum("sd,dnp->snp", weights, deviations)
    x = x + np.sqrt(single * np.square(deviations).sum(axis=0)) * rng.standard_normal(x.shape)
    limit = np.repeat(spec.effort_limit[spec.operated_index][None], count, axis=0)
    links = uncertainty.links if engine != "isaaclab" else None
    drawn = dict[str, Array]()
    if links:
        drawn["links"] = np.random.default_rng([seed, 1]).multivariate_normal(
            links.values, links.covariance, count
        )
    elif spec.links:
        why = (
            "Isaac Lab may place or join bodies differently"
            if uncertainty.links
            else "no others are stored"
        )
        notes.append(f"all units have the identified links: {why}")
    for i, joint in enumerate(joints):
        error = rng.multivariate_normal(np.zeros(len(fields)), covariance[i], count, method="eigh")
        if links:
            error += (drawn["links"] - links.values) @ np.transpose(links.servo_slopes[joint])
        x[:, i] += error
        limit[:, i] *= np.exp(error[:, fields.index("kp")])
    bounded = [SERVO_FIELDS[f].axis != "log" and not SERVO_FIELDS[f].signed for f in fields]
    x = np.where(bounded, np.maximum(x, 0.0), x)
    inverse = [SERVO_FIELDS[f].axis == "inverse" for f in fields]
    optional = np.isin(fields, ("backlash", "no_load_speed"))
    # zero is no limit, which no range states
    x = np.where(inverse, np.maximum(x, LEAST_INVERSE * mean), x)
    x = np.where(optional & (mean == 0), 0.0, x)  # a joint without the effect gets none
    sampled = from_axes(fields, x)
    value = from_axes(fields, mean)
    ranges: dict[str, dict[str, tuple[float, float, float]]] = {j: {} for j in joints}
    for i, joint in enumerate(joints):
        for field in fields:
            low, high = np.percentile(sampled[field][:, i], RANGE_PERCENT)
            ranges[joint][field] = float(low), float(value[field][i]), float(high)
    names = tuple(
        f"{j}: {f}" for i, j in enumerate(joints) for k, f in enumerate(fields) if unknown[i, k]
    )
    axes = LinkAxes(spec.before_identification) if links else None
    units = {f: v[:samples] for f, v in (sampled | {"effort_limit": limit} | drawn).items()}
    return Randomization(spec.name, scope, units, ranges, names, tuple(notes), axes)


def judge_units(
    made: Randomization,
    robot: RobotSpec,
    recordings: tuple[ListOf[Sequence], ListOf[Sequence]] | None,
    progress: Progress = no_progress,
    engine_terms: tuple[str, ...] = (),
) -> Randomization:
    """Choose the units that follow the robot's recordings, and state their errors.

    How they are chosen is in export/drawn_robots.py.

    Units of other days and robots are left as they are: this robot's recordings cannot judge them.
    The engine has the `engine_terms` of the servo model.
    """
    mass = recordings[0][0].meta.payload_mass if recordings and recordings[0] else 0.0
    train, validation = (comparable(part, robot, mass) for part in recordings or ((), ()))
    if made.scope != "today" or not train or not validation:
        why = (
            "no recording with the robot's own gains"
            if made.scope == "today"
            else f"scope {made.scope}"
        )
        return replace(
            made, notes=(*made.notes, f"{why}: the units were not compared with recordings")
        )
    judged = plain = draw_robots(robot, made.units, (train, validation), progress=progress)
    if robot.has_servo_model:
        plain = draw_robots(robot, made.units, (train, validation), True, progress, engine_terms)
    units = {f: np.array(v) for f, v in judged.units.items()}
    ends = {f: np.percentile(v, RANGE_PERCENT, axis=0) for f, v in units.items() if f != "links"}
    ranges = {
        joint: {
            f: (float(ends[f][0, i]), value, float(ends[f][1, i]))
            for f, (_, value, _) in by_field.items()
        }
        for i, (joint, by_field) in enumerate(made.ranges.items())
    }
    return replace(made, units=units, ranges=ranges, judged=judged, plain=plain)


def _between_units(
    spec: RobotSpec, uncertainty: ParameterUncertainty, scope: Scope, others: ListOf[Path]
) -> tuple[Array, Array, list[str]]:
    """Return the mean of days or robots, (n, P), their deviations, (units, n, P), and notes."""
    if scope == "today":
        now = np.stack([uncertainty.array(j, "values") for j in spec.operated])
        return now, np.zeros((0, *now.shape)), []
    if scope == "any-day":
        what = "days"
        each = _days(uncertainty, spec.operated)
    else:
        what = "robots"
        each = _robots(spec, uncertainty.fields, others)
    mean = each.mean(axis=0)
    deviations = (each - mean) * np.sqrt((1 + 1 / len(each)) / (len(each) - 1))
    factor = _std_factor(len(each))
    note = f"from {len(each)} {what}: how far they differ is known to a factor of {factor:.1f}"
    return mean, deviations, [note]


def _days(uncertainty: ParameterUncertainty, joints: tuple[str, ...]) -> Array:
    """Return the values of each day's session, (days, n, P).

    Of several sessions on one day, the last.
    """
    units = {s["unit"] for s in uncertainty.sources}
    if len(units) > 1:
        raise UsageError(
            f"any-day: these sessions are of units {', '.join(sorted(units))}; days of one unit "
            "are needed, or --scope any-robot with --units"
        )
    days = {s["days"] or (f"session {i}",): s for i, s in enumerate(uncertainty.sources)}
    if len(days) < 2:
        raise UsageError(
            "any-day: this robot is known from one day; adapt it with logs of another one "
            "(gaponet adapt ROBOT LOGS --out ROBOT_2) and export that"
        )
    return np.array([[s["values"][j] for j in joints] for s in days.values()])


def _robots(spec: RobotSpec, fields: tuple[str, ...], others: ListOf[Path]) -> Array:
    """Return the values of this robot and of others, (robots, n, P)."""
    robots = [spec, *(load_robot(folder) for folder in others)]
    if len(robots) < MIN_ROBOTS:
        raise UsageError(
            f"any-robot: {len(robots)} robot(s) do not show how robots of this type differ; give "
            f"--units with at least {MIN_ROBOTS - 1} more robot folders, each identified from its "
            "own logs"
        )
    for robot in robots:
        if robot.operated != spec.operated:
            raise UsageError(
                f"{robot.folder}: operates {', '.join(robot.operated)}; this robot "
                f"{', '.join(spec.operated)}"
            )
    return np.stack([np.stack(list(to_axes(robot, fields).values())) for robot in robots])


def _uncorrelated_share(deviations: Array) -> float:
    """Return the share of the variance that is sampled number by number.

    The deviations are those of k days or robots, (k, n, P).

    In few days or robots, numbers change together by chance (shrinkage of correlations, Schäfer and
    Strimmer 2005).
    """
    if len(deviations) < MIN_ROBOTS:
        return 0.0
    flat = deviations.reshape(len(deviations), -1)
    flat = flat[:, np.square(flat).sum(axis=0) > 0]
    r = np.corrcoef(flat.T)[np.triu_indices(flat.shape[1], 1)]
    return float(min(1.0, ((1 - r**2) ** 2).sum() / (len(flat) - 1) / np.square(r).sum()))


def _std_factor(count: int) -> float:
    """Return by which factor a standard deviation may be too small, 9 of 10 times.

    It is that of `count` values.
    """
    from scipy.stats import chi2

    return float(np.sqrt((count - 1) / chi2.ppf(0.1, count - 1)))


def write_randomization(made: Randomization, engine: Engine, folder: Path) -> Path:
    """Write units and ranges as JSON, and the file of an engine beside it.

    Return the engine's file.

    Raises:
        NoGainError: Units of the engine's form follow the recordings worse than ± 20 % on each
            number.
    """
    if (runs := made.plain if engine in ("mujoco", "isaaclab") else made.judged) is not None:
        runs.require_better_than_by_hand()
    content: dict[str, Any] = {
        "robot": made.robot,
        "scope": made.scope,
        "joints": list(made.ranges),
        "ranges": {joint: _written_ranges(by_field) for joint, by_field in made.ranges.items()},
        "units": _written(made.units, made.links),
        "unknown": made.unknown,
        "notes": made.notes,
    }
    if made.links:
        content["bodies"] = made.links.bodies
    if made.judged is not None and made.plain is not None:
        content["plain_units"] = _written(made.plain.units, made.links)
        content["error_mrad"] = {
            "servo model": _in_mrad(made.judged.errors),
            "plain": _in_mrad(made.plain.errors),
        }
    with lock_folder(folder, FOLDER_KIND):
        write_json(folder / FILE, content)
        if engine == "json":
            return folder / FILE
        file = folder / f"{engine}_randomization.py"
        shipped = "mujoco_randomization.py" if engine == "mujoco" else "unit_events.py"
        write_text(file, (SHIPPED / shipped).read_text(encoding="utf-8"))
    return file


def _written_ranges(ranges: dict[str, tuple[float, float, float]]) -> dict[str, Any]:
    """Return field → low, value and high by name."""
    return {
        field: dict(zip(("low", "value", "high"), r, strict=True)) for field, r in ranges.items()
    }


def _in_mrad(errors: dict[str, float]) -> dict[str, float]:
    return {name: 1e3 * error for name, error in errors.items()}


def _written(units: Mapping[str, Any], axes: LinkAxes | None) -> dict[str, Any]:
    """Return units with links as MuJoCo has them, (units, bodies, 11)."""
    written = {f: np.round(v, 9) for f, v in units.items() if f != "links"}
    return written | (
        {"links": [axes.inertials(np.array(row)) for row in units["links"]]} if axes else {}
    )


def table_rows(made: Randomization) -> tuple[list[str], list[list[str]]]:
    """Return headings and rows: joint, and low … high of numbers that are not all zero."""
    fields = [
        SERVO_FIELDS[f]
        for f in next(iter(made.ranges.values()))
        if any(by[f][2] for by in made.ranges.values())
    ]
    rows: list[list[Any]] = [
        [j, *(f"{by[f.name][0] * f.factor:.3g} … {by[f.name][2] * f.factor:.3g}" for f in fields)]
        for j, by in made.ranges.items()
    ]
    return ["joint", *(f.heading for f in fields)], rows
