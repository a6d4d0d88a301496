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
from gaponet.robot.servo_fields import SERVO_FIELDS, SERVO_TERMS
from gaponet.robot.spec import RobotSpec, load_robot
from gaponet.sim.links import LinkAxes
from gaponet.sysid.uncertainty import ParameterUncertainty, from_axes, prior_std, to_axes

Scope = Literal["today", "any-day", "any-robot"]
Engine = Literal["json", "mujoco", "mjlab", "isaaclab"]

FOLDER_KIND = "engine"
FILE = "randomization.json"
MUJOCO_FILE = "mujoco_randomization.py"  # in MuJoCo, it applies a unit of that file
SHIPPED = Path(__file__).parent / "shipped"
LEAST_INVERSE = 0.2  # of a drawn value on an inverse axis, over the mean
RANGE_SAMPLES = 4096
# of the prior's: logs with a larger standard deviation say nothing about a number
UNDETERMINED_STD = 0.8
MIN_ROBOTS = 3  # of a type
NO_PLAIN_UNITS = (
    "units for servos without the servo model are fitted to recordings, so the file has none: play "
    "these with mujoco_servos.py or the servos of --to mjlab, or identify with --terms and no word"
)


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
    mean, deviations, notes = _between_units(spec, uncertainty, scope, others)
    rng = np.random.default_rng(seed)
    count = max(RANGE_SAMPLES, samples)
    centers = _sample_centers(mean, deviations, count, rng)
    links = uncertainty.links if engine != "isaaclab" else None
    drawn_links: Array | None = None  # (count, Q)
    if links:
        link_rng = np.random.default_rng([seed, 1])
        drawn_links = link_rng.multivariate_normal(links.values, links.covariance, count)
    elif spec.links:
        notes.append(_why_links_stay(uncertainty))
    errors = _sample_errors(uncertainty, spec.operated, drawn_links, count, rng)
    fields = uncertainty.fields
    units = from_axes(fields, _bounded(fields, centers + errors, mean))
    kp_errors = errors[:, :, fields.index("kp")]
    units["effort_limit"] = spec.servo.effort_limit[spec.operated_index] * np.exp(kp_errors)
    if drawn_links is not None:
        units["links"] = drawn_links
    return Randomization(
        robot=spec.name,
        scope=scope,
        units={field: rows[:samples] for field, rows in units.items()},
        ranges=_ranges(units, _by_joint(spec.operated, from_axes(fields, mean))),
        unknown=_undetermined(uncertainty, spec.operated),
        notes=tuple(notes),
        links=None if drawn_links is None else LinkAxes(spec.before_identification),
    )


def _sample_centers(mean: Array, deviations: Array, count: int, rng: np.random.Generator) -> Array:
    """Sample the values of days or robots on the axes, (count, n, P)."""
    single = _uncorrelated_share(deviations)
    weights = rng.standard_normal((count, len(deviations)))
    together = np.einsum("sd,dnp->snp", weights, deviations)
    single_std = np.sqrt(single * np.square(deviations).sum(axis=0))
    centers = mean + np.sqrt(1 - single) * together
    return np.asarray(centers + single_std * rng.standard_normal(centers.shape))


def _sample_errors(
    uncertainty: ParameterUncertainty,
    joints: tuple[str, ...],
    links: Array | None,
    count: int,
    rng: np.random.Generator,
) -> Array:
    """Sample errors of this robot's values on the axes, (count, n, P).

    Args:
        links: Drawn links, (count, Q), with which the servos' values change; None if all units have
            the identified ones.
    """
    errors = np.empty((count, len(joints), len(uncertainty.fields)))
    no_error = np.zeros(len(uncertainty.fields))
    for i, joint in enumerate(joints):
        covariance = uncertainty.array(joint, "covariance")
        errors[:, i] = rng.multivariate_normal(no_error, covariance, count, method="eigh")
        if links is not None and uncertainty.links is not None:
            slopes = np.transpose(uncertainty.links.servo_slopes[joint])
            errors[:, i] += (links - uncertainty.links.values) @ slopes
    return errors


def _bounded(fields: tuple[str, ...], x: Array, mean: Array) -> Array:
    """Return values on the axes, (samples, n, P), within what a robot can have; mean (n, P)."""
    linear = [SERVO_FIELDS[f].axis != "log" and not SERVO_FIELDS[f].signed for f in fields]
    inverse = [SERVO_FIELDS[f].axis == "inverse" for f in fields]
    optional = np.isin(fields, ("backlash", "no_load_speed"))
    x = np.where(linear, np.maximum(x, 0.0), x)
    # zero is no limit, which no range states
    x = np.where(inverse, np.maximum(x, LEAST_INVERSE * mean), x)
    return np.where(optional & (mean == 0), 0.0, x)  # a joint without the effect gets none


def _undetermined(uncertainty: ParameterUncertainty, joints: tuple[str, ...]) -> tuple[str, ...]:
    """Return "joint: field" of the numbers that no log determines."""
    fields = uncertainty.fields
    values = np.stack([uncertainty.array(joint, "values") for joint in joints])
    covariance = np.stack([uncertainty.array(joint, "covariance") for joint in joints])
    std = np.sqrt(np.einsum("njj->nj", covariance))
    unknown = std > UNDETERMINED_STD * prior_std(fields, values)
    return tuple(f"{joints[i]}: {fields[k]}" for i, k in np.argwhere(unknown))


def _by_joint(joints: tuple[str, ...], values: Mapping[str, Array]) -> dict[str, dict[str, float]]:
    """Return joint → field → value, from field → (n)."""
    by_joint = {}
    for i, joint in enumerate(joints):
        by_joint[joint] = {field: float(each[i]) for field, each in values.items()}
    return by_joint


def _why_links_stay(uncertainty: ParameterUncertainty) -> str:
    why = "no others are stored"
    if uncertainty.links:
        why = "Isaac Lab may place or join bodies differently"
    return f"all units have the identified links: {why}"


def _ranges(
    units: Mapping[str, Array], values: Mapping[str, Mapping[str, float]]
) -> dict[str, dict[str, tuple[float, float, float]]]:
    """Return joint → field → low, value, high, with 9 of 10 units between.

    Args:
        units: Field → (samples, n).
        values: Joint → field → value in the middle.
    """
    ranges: dict[str, dict[str, tuple[float, float, float]]] = {}
    for i, (joint, by_field) in enumerate(values.items()):
        ranges[joint] = {}
        for field, value in by_field.items():
            low, high = np.percentile(units[field][:, i], RANGE_PERCENT)
            ranges[joint][field] = (float(low), value, float(high))
    return ranges


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
    if made.scope != "today":
        return _not_judged(made, robot, engine_terms, f"scope {made.scope}")
    train, validation = _comparable_motions(recordings, robot)
    if not train or not validation:
        why = "no recording with the robot's own gains"
        if recordings is None:
            why = "no recordings of the robot are there (--data says where they are)"
        return _not_judged(made, robot, engine_terms, why)
    judged = draw_robots(robot, made.units, (train, validation), progress=progress)
    plain = judged
    if robot.servo.has_terms:
        plain = draw_robots(robot, made.units, (train, validation), True, progress, engine_terms)
    units = {field: np.array(rows) for field, rows in judged.units.items()}
    values = {}
    for joint, by_field in made.ranges.items():
        values[joint] = {field: value for field, (_, value, _) in by_field.items()}
    return replace(made, units=units, ranges=_ranges(units, values), judged=judged, plain=plain)


def _not_judged(
    made: Randomization, robot: RobotSpec, engine_terms: tuple[str, ...], why: str
) -> Randomization:
    """Return units as drawn, with notes on what they lack."""
    notes = [*made.notes, f"{why}: the units were not compared with recordings"]
    missing = [name for name in SERVO_TERMS if name not in engine_terms]
    if robot.servo.has(missing):
        notes.append(NO_PLAIN_UNITS)
    return replace(made, notes=tuple(notes))


def _comparable_motions(
    recordings: tuple[ListOf[Sequence], ListOf[Sequence]] | None, robot: RobotSpec
) -> tuple[ListOf[Sequence], ListOf[Sequence]]:
    """Return training and validation motions with the first one's payload and the robot's gains."""
    if not recordings or not recordings[0]:
        return (), ()
    train, validation = recordings
    mass = train[0].meta.payload_mass
    return comparable(train, robot, mass), comparable(validation, robot, mass)


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
    days = {}
    for number, source in enumerate(uncertainty.sources):
        day = source["days"] or (f"session {number}",)
        days[day] = source  # replaces an earlier one of that day
    if len(days) < 2:
        raise UsageError(
            "any-day: this robot is known from one day; adapt it with logs of another one "
            "(gaponet adapt ROBOT LOGS --out ROBOT_2) and export that"
        )
    values = []
    for source in days.values():
        values.append([source["values"][joint] for joint in joints])
    return np.array(values)


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
    """Return the share of the variance of k days or robots, (k, n, P), that is sampled number by
    number.

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
    """Return by which factor the standard deviation of `count` values may be too small, 9 of 10
    times.
    """
    from scipy.stats import chi2

    return float(np.sqrt((count - 1) / chi2.ppf(0.1, count - 1)))


def write_randomization(made: Randomization, engine: Engine, folder: Path) -> Path:
    """Write units and ranges as `write_files` does, and return the engine's file.

    Raises:
        NoGainError: Units of the engine's form follow the recordings worse than ± 20 % on each
            number.
    """
    used = made.plain if engine in ("mujoco", "isaaclab") else made.judged
    if used is not None:
        used.require_better_than_by_hand()
    return write_files(made, engine, folder)


def write_files(made: Randomization, engine: Engine, folder: Path) -> Path:
    """Write units and ranges as JSON, and the file of an engine beside it, however near they are to
    the recordings.

    Return the engine's file.
    """
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
        shipped = MUJOCO_FILE if engine == "mujoco" else "unit_events.py"
        write_text(file, (SHIPPED / shipped).read_text(encoding="utf-8"))
    return file


def _written_ranges(ranges: dict[str, tuple[float, float, float]]) -> dict[str, Any]:
    """Return field → low, value and high by name."""
    written = {}
    for field, (low, value, high) in ranges.items():
        written[field] = {"low": low, "value": value, "high": high}
    return written


def _in_mrad(errors: dict[str, float]) -> dict[str, float]:
    return {name: 1e3 * error for name, error in errors.items()}


def _written(units: Mapping[str, Any], axes: LinkAxes | None) -> dict[str, Any]:
    """Return units with links as MuJoCo has them, (units, bodies, 11)."""
    written: dict[str, Any] = {}
    for field, values in units.items():
        if field != "links":
            written[field] = np.round(values, 9)
    if axes:
        written["links"] = [axes.inertials(np.array(row)) for row in units["links"]]
    return written


def table_rows(made: Randomization) -> tuple[list[str], list[list[str]]]:
    """Return headings and rows: joint, and low … high of numbers that are not all zero."""
    names = next(iter(made.ranges.values()))
    fields = []
    for name in names:
        highest = [by_field[name][2] for by_field in made.ranges.values()]
        if any(highest):
            fields.append(SERVO_FIELDS[name])
    rows = []
    for joint, by_field in made.ranges.items():
        row = [joint]
        for field in fields:
            low, _, high = by_field[field.name]
            row.append(f"{low * field.factor:.3g} … {high * field.factor:.3g}")
        rows.append(row)
    return ["joint", *(f.heading for f in fields)], rows
