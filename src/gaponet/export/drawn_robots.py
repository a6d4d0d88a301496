"""Units drawn from a robot's uncertainty, chosen and judged by rollouts of its recordings.

The uncertainty is Gaussian on its axes, and holds for small deviations. Rollouts of recorded
commands show which drawn units move like the robot, and the best quarter is retained. Engines
without the servo model need units of the robot as it was fitted without it: the deviation of a unit
is then added to those values, on the same axes.
"""

from __future__ import annotations

from collections.abc import Mapping
from collections.abc import Sequence as ListOf
from dataclasses import dataclass, replace
from itertools import chain

import numpy as np

from gaponet.base.arrays import Array
from gaponet.base.errors import NoGainError
from gaponet.base.progress import Progress, no_progress
from gaponet.data.sequence import Sequence
from gaponet.export.plain_servos import fit_plain_servos, rollout_error, stored_result
from gaponet.robot.servo_fields import SERVO_FIELDS, SERVO_TERMS
from gaponet.robot.spec import RobotSpec
from gaponet.sim.links import LinkAxes
from gaponet.sysid.uncertainty import ParameterUncertainty, from_axes, to_axes

RANGE_PERCENT = 5, 95
Units = dict[str, Array]  # field → (units, n) in SI units; a row is one unit

# in the robot folder: with the servo model, without it
CACHES = ("drawn_robots.json", "drawn_plain_robots.json")

# number of units, and the share that is retained
DRAWN = 128
KEPT_SHARE = 0.25
NEAR = 0.5  # every second unit deviates by this share of what was drawn
# rollouts that choose
WINDOWS = 8
WINDOW_S = 8.0
JUDGED = 20  # robots of each kind whose error on validation motions is stated
# the usual randomisation: ± 20 %
BY_HAND = 0.2
BY_HAND_FIELDS = ("kp", "damping", "frictionloss", "armature")


@dataclass(frozen=True)
class DrawnRobots:
    """Units of one form of a robot: with its servo model, or fitted without it.

    Attributes:
        units: Field → (retained units, n) in SI units, and coordinates of drawn links; a row is one
            unit.
        errors: "exported", "units", "one by one" (each number from the range of 9 of 10 units) and
            "by hand" → mean |error| on validation motions, rad.
    """

    units: dict[str, list[list[float]]]
    errors: dict[str, float]

    def why_refused(self) -> str:
        """Return why the robot with ± 20 % on each number is to be preferred to these units; ""
        if the units follow the recordings at least as well.
        """
        if self.errors["units"] <= self.errors["by hand"]:
            return ""
        return (
            f"on validation motions, drawn units are {1e3 * self.errors['units']:.2f} mrad from "
            "the recordings, and the robot with ± 20 % on kp, damping, friction and armature "
            f"{1e3 * self.errors['by hand']:.2f}. Randomise by ± 20 %, or record motions that "
            "determine more (gaponet excite --for ROBOT)"
        )

    def require_better_than_by_hand(self) -> None:
        """Refuse units that follow the recordings worse than the robot with ± 20 % on each number.

        Raises:
            NoGainError: They do.
        """
        why = self.why_refused()
        if why:
            raise NoGainError(f"nothing is written: {why}")


def draw_robots(
    robot: RobotSpec,
    drawn: Units,
    recordings: tuple[ListOf[Sequence], ListOf[Sequence]],
    plain: bool = False,
    progress: Progress = no_progress,
    engine_terms: tuple[str, ...] = (),
) -> DrawnRobots:
    """Choose units by training motions and judge them by validation motions.

    The result is stored in the robot folder, and read from there if nothing changed.

    Args:
        robot: Identified.
        drawn: Units of `randomization.sample_units`.
        recordings: Training and validation motions, with the robot's own gains.
        plain: Units of the robot as fitted without its servo model but for `engine_terms`, which
            the engine has.
        progress: Called with done, total and a note.
    """
    train, validation = recordings
    note = ""
    base = robot
    if plain:
        note = ", without the servo model"
        base = fit_plain_servos(robot, train, progress, engine_terms)
    first = {field: values[:DRAWN] for field, values in drawn.items()}

    def draw() -> DrawnRobots:
        return _draw(
            base,
            _moved(robot, base, first),
            train,
            validation,
            lambda i, n, what: progress(i, n, what + note),
        )

    inputs = *first.values(), np.array([len(train), len(validation), len(engine_terms)])
    return stored_result(
        robot.folder / CACHES[plain], DrawnRobots, draw, robot, [*train, *validation], *inputs
    )


def _draw(
    base: RobotSpec,
    drawn: Units,
    train: ListOf[Sequence],
    validation: ListOf[Sequence],
    progress: Progress,
) -> DrawnRobots:
    every = robots_of(base, drawn)
    costs = _rollout_errors(_windows(train), every, progress, "units on training motions")
    best = np.sort(np.argsort(costs)[: max(round(KEPT_SHARE * len(costs)), 1)])
    units = {field: values[best] for field, values in drawn.items()}
    rng = np.random.default_rng(0)
    robots = {
        "exported": [base],
        "units": robots_of(base, units)[:JUDGED],
        "one by one": _one_by_one(base, units, rng),
        "by hand": _by_hand(base, rng),
    }
    judged = list(chain(*robots.values()))
    each = _rollout_errors(validation, judged, progress, "robots on validation motions")
    errors = {}
    start = 0
    for kind, several in robots.items():
        end = start + len(several)
        errors[kind] = float(np.mean(each[start:end]))
        start = end
    return DrawnRobots({field: values.tolist() for field, values in units.items()}, errors)


def _rollout_errors(
    motions: ListOf[Sequence], robots: ListOf[RobotSpec], progress: Progress, what: str
) -> list[float]:
    """Return the mean |error| of each robot over rollouts of motions, rad."""
    errors = []
    for i, robot in enumerate(robots):
        errors.append(rollout_error(motions, robot))
        progress(i + 1, len(robots), what)
    return errors


def robots_of(base: RobotSpec, units: Mapping[str, Array]) -> list[RobotSpec]:
    """Return a robot for each row of units."""
    fields = [field for field in units if field != "links"]
    robots = []
    for k in range(len(units["kp"])):
        servos = {}
        for i, joint in enumerate(base.operated):
            servos[joint] = {field: float(units[field][k, i]) for field in fields}
        robots.append(base.with_identified(servos))
    if "links" not in units:
        return robots
    axes = LinkAxes(base.before_identification)
    rows = zip(robots, units["links"], strict=True)
    return [replace(robot, links=axes.links(row)) for robot, row in rows]


def _moved(robot: RobotSpec, base: RobotSpec, drawn: Units) -> Units:
    """Return units that deviate from `base` as the drawn ones deviate from `robot`.

    Every second one deviates half as far.
    """
    left_out = {"effort_limit", "links"}
    if base is not robot:
        for term in SERVO_TERMS:
            if not base.servo[term].any():
                left_out.add(term)
    fields = [field for field in drawn if field not in left_out]
    own = _on_axes(robot, fields)
    axes = np.stack([_on_axes(unit, fields) for unit in robots_of(robot, drawn)])
    share = np.where(np.arange(len(axes)) % 2, NEAR, 1.0)[:, None]  # (units, 1)
    x = _on_axes(base, fields) + share[:, :, None] * (axes - own)
    signed = [SERVO_FIELDS[field].axis == "log" or SERVO_FIELDS[field].signed for field in fields]
    units: Units = dict(from_axes(fields, np.where(signed, x, np.maximum(x, 0.0))))
    op = robot.operated_index
    units["effort_limit"] = base.servo.effort_limit[op] * units["kp"] / base.servo.kp[op]
    if "links" in drawn:
        links = ParameterUncertainty.require(robot).links
        assert links is not None
        fitted = np.array(links.values)
        units["links"] = fitted + share * (drawn["links"] - fitted)
    return units


def _on_axes(robot: RobotSpec, fields: ListOf[str]) -> Array:
    """Return fields of the operated joints on the axes of the uncertainty, (n, P)."""
    return np.stack(list(to_axes(robot, fields).values()))


def _one_by_one(
    base: RobotSpec, units: Mapping[str, Array], rng: np.random.Generator
) -> list[RobotSpec]:
    """Return robots with each number drawn by itself from the range that the units have."""
    servos = {field: values for field, values in units.items() if field != "links"}
    low = []
    high = []
    for values in servos.values():
        low.append(np.percentile(values, RANGE_PERCENT[0], axis=0))
        high.append(np.percentile(values, RANGE_PERCENT[1], axis=0))
    alone = rng.uniform(low, high, (JUDGED, *np.shape(low))).swapaxes(0, 1)
    return robots_of(base, dict(zip(servos, alone, strict=True)))


def _by_hand(base: RobotSpec, rng: np.random.Generator) -> list[RobotSpec]:
    """Return robots with a few fields drawn within ± BY_HAND of their values."""
    units = {}
    for field in BY_HAND_FIELDS:
        values = base.servo[field][base.operated_index]
        units[field] = values * rng.uniform(1 - BY_HAND, 1 + BY_HAND, (JUDGED, len(values)))
    return robots_of(base, units)


def _windows(sequences: ListOf[Sequence]) -> list[Sequence]:
    """Cut WINDOWS pieces of WINDOW_S, taken evenly from the recordings."""
    pieces = []
    for recording in sequences:
        rows = round(WINDOW_S / recording.dt)
        for start in range(0, max(len(recording) - rows // 2, 1), rows):
            pieces.append(recording.rows(slice(start, start + rows)))
    taken = np.unique(np.linspace(0, len(pieces) - 1, WINDOWS).round().astype(int))
    return [pieces[i] for i in taken]
