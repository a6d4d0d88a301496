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
CACHES = (
    "drawn_robots.json",
    "drawn_plain_robots.json",
)

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
            "by hand" → mean
            |error| on validation motions, rad.
    """

    units: dict[str, list[list[float]]]
    errors: dict[str, float]

    def require_better_than_by_hand(self) -> None:
        """Refuse units that follow the recordings worse than the robot with ± 20 % on each number.

        Raises:
            NoGainError: They do.
        """
        if self.errors["units"] > self.errors["by hand"]:
            raise NoGainError(
                f"nothing is written: on validation motions, drawn units are "
                f"{1e3 * self.errors['units']:.2f} mrad from the recordings, and the robot with ± "
                f"20 % on kp, damping, friction and armature {1e3 * self.errors['by hand']:.2f}. "
                "Randomise by ± 20 %, or record motions that determine more (gaponet excite --for "
                "ROBOT)"
            )


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
    note = ", without the servo model" * plain
    base = fit_plain_servos(robot, train, progress, engine_terms) if plain else robot
    first = {f: v[:DRAWN] for f, v in drawn.items()}

    def draw() -> DrawnRobots:
        return _draw(
            base,
            _moved(robot, base, first),
            train,
            validation,
            lambda i, n, s: progress(i, n, s + note),
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
    def errors_of(motions: ListOf[Sequence], robots: ListOf[RobotSpec], what: str) -> list[float]:
        errors = []
        for i, one in enumerate(robots):
            errors.append(rollout_error(motions, one))
            progress(i + 1, len(robots), what)
        return errors

    costs = errors_of(_windows(train), robots_of(base, drawn), "units on training motions")
    best = np.sort(np.argsort(costs)[: max(round(KEPT_SHARE * len(costs)), 1)])
    units = {field: values[best] for field, values in drawn.items()}
    rng = np.random.default_rng(0)
    servos = [values for field, values in units.items() if field != "links"]
    low, high = (
        np.array([np.percentile(v, side, axis=0) for v in servos]) for side in RANGE_PERCENT
    )
    alone = rng.uniform(low, high, (JUDGED, *low.shape)).swapaxes(0, 1)
    robots = {
        "exported": [base],
        "units": robots_of(base, units)[:JUDGED],
        "one by one": robots_of(base, dict(zip(units, alone, strict=False))),
        "by hand": _by_hand(base, rng),
    }
    judged = iter(
        errors_of(
            validation,
            [r for kind in robots.values() for r in kind],
            "robots on validation motions",
        )
    )
    errors = {
        kind: float(np.mean([next(judged) for _ in several])) for kind, several in robots.items()
    }
    return DrawnRobots({field: values.tolist() for field, values in units.items()}, errors)


def robots_of(base: RobotSpec, units: Mapping[str, Array]) -> list[RobotSpec]:
    """Return a robot for each row of units."""
    servos = {field: values for field, values in units.items() if field != "links"}
    robots = [
        base.with_servos(
            {j: {f: float(v[k, i]) for f, v in servos.items()} for i, j in enumerate(base.operated)}
        )
        for k in range(len(units["kp"]))
    ]
    if links := LinkAxes(base.before_identification).links if "links" in units else None:
        robots = [
            replace(one, links=links(row)) for one, row in zip(robots, units["links"], strict=True)
        ]
    return robots


def _moved(robot: RobotSpec, base: RobotSpec, drawn: Units) -> Units:
    """Return units that deviate from `base` as the drawn ones deviate from `robot`.

    Every second one deviates half as far.
    """
    lacking = [] if base is robot else [f for f in SERVO_TERMS if not getattr(base, f).any()]
    fields = [f for f in drawn if f not in ("effort_limit", "links", *lacking)]
    own, center = (np.stack(list(to_axes(r, fields).values())) for r in (robot, base))
    axes = np.stack(
        [np.stack(list(to_axes(one, fields).values())) for one in robots_of(robot, drawn)]
    )
    share = np.where(np.arange(len(axes)) % 2, NEAR, 1.0)[:, None, None]
    signed = [SERVO_FIELDS[f].axis == "log" or SERVO_FIELDS[f].signed for f in fields]
    x = center + share * (axes - own)
    units: Units = dict(from_axes(fields, np.where(signed, x, np.maximum(x, 0.0))))
    op = robot.operated_index
    units["effort_limit"] = base.effort_limit[op] * units["kp"] / base.kp[op]
    if links := ParameterUncertainty.require(robot).links if "links" in drawn else None:
        units["links"] = np.array(links.values) + share[:, :, 0] * (
            drawn["links"] - np.array(links.values)
        )
    return units


def _by_hand(base: RobotSpec, rng: np.random.Generator) -> list[RobotSpec]:
    values = {f: getattr(base, f)[base.operated_index] for f in BY_HAND_FIELDS}
    return robots_of(
        base,
        {f: v * rng.uniform(1 - BY_HAND, 1 + BY_HAND, (JUDGED, len(v))) for f, v in values.items()},
    )


def _windows(sequences: ListOf[Sequence]) -> list[Sequence]:
    """Cut WINDOWS pieces of WINDOW_S, taken evenly from the recordings."""
    pieces = []
    for s in sequences:
        rows = round(WINDOW_S / s.dt)
        pieces += [
            s.rows(slice(start, start + rows))
            for start in range(0, max(len(s) - rows // 2, 1), rows)
        ]
    return [
        pieces[i] for i in np.unique(np.linspace(0, len(pieces) - 1, WINDOWS).round().astype(int))
    ]
