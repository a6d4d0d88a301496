"""Where learning remains: by cause, what the operator takes of what identification and calibration leave.

    python benchmarks/remains.py WORK [--seeds 3]

WORK as left by ppo.py, arm virtual-identified: fleet `hard`, identified on virtual-1 to virtual-3, operators of 2 M
steps from the untrained one on. virtual-4 plays its test motions again with one effect switched off at a time: what a
method leaves of the whole unit, less what it leaves of the unit without the effect, is due to the effect.

Writes docs/results/remains.{md,json,csv}.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from publish import publish
from virtual_h1_2 import RECIPE, UNIT, Bench, by_motion

from gaponet.arrays import Array
from gaponet.data.sequence import Sequence
from gaponet.metrics import standard_error
from gaponet.model.artifact import GapModel
from gaponet.model.calibration import Calibration
from gaponet.robot import RobotSpec
from gaponet.sim.identify import DEFAULT_TERMS
from gaponet.sim.refit import refit
from gaponet.sim.replay import Corrector
from gaponet.spread import Table
from gaponet_lab.study.result import Result, facts
from gaponet_lab.whose import label
from gaponet_robots.motion.recipe import Take, load_recipe
from gaponet_robots.virtual.fleet import Fleet, load_fleet
from gaponet_robots.virtual.physics import Physics
from gaponet_robots.virtual.play import Job, play

CAUSES: dict[str, Callable[[Physics], Physics]] = {
    "friction at rest (Stribeck)": lambda u: u.without("stribeck"),
    "bristles (LuGre)": lambda u: u.without("presliding"),
    "more friction one way": lambda u: replace(u, friction_asymmetry=np.zeros_like(u.friction_asymmetry)),
    "gear losses by load": lambda u: u.without("load_friction"),
    "friction thins with warmth": lambda u: u.without("thinning"),
    "torque constant, its heat": lambda u: u.without("torque_constant", "thermal"),
    "compliance, backlash": lambda u: u.without("compliance", "backlash"),
    "current loop, torque by speed": lambda u: u.without("current_loop", "torque_speed"),
    "jitter, lost packets": lambda u: u.without("jitter"),
    "masses": lambda u: u.without("mass"),
    "cables, supply": lambda u: u.without("cable", "supply"),
    "encoder, zero": lambda u: u.without("encoder", "zero"),
}
IDENTIFIED, OPERATOR, CALIBRATED, BOTH = METHODS = (
    "identification", "with operator", "calibrated", "calibrated, with operator")  # fmt: skip
WARM = 25.0  # K above ambient: a recording of a warm robot; cold below half of it

Method = list[tuple[RobotSpec, Corrector | None]]  # seed by seed


@dataclass(frozen=True)
class Played:
    """Recordings, and what each method leaves of them, mrad, (motions,)."""

    sequences: list[Sequence]
    errors: dict[str, Array]

    @classmethod
    def of(cls, bench: Bench, sequences: list[Sequence], methods: Mapping[str, Method]) -> Played:
        """Whole-motion free runs, mean over seeds and what else differs within a motion."""
        own = replace(bench, test=sequences)
        return cls(
            sequences, {m: by_motion([own.errors(*s) for s in seeds], sequences) for m, seeds in methods.items()}
        )


def methods_of(bench: Bench, models: list[GapModel], given: list[Sequence]) -> dict[str, Method]:
    """Identification, and 30 s of the unit, each without and with the operators."""
    law = bench.identified(DEFAULT_TERMS)
    alone = refit(given, law).robot
    own = [Calibration.fit(m, law, given).robot(law) for m in models]
    return {
        IDENTIFIED: [(law, None)], OPERATOR: [(law, m.corrector(law)) for m in models], CALIBRATED: [(alone, None)],
        BOTH: [(robot, m.corrector(law)) for robot, m in zip(own, models, strict=True)],
    }  # fmt: skip


def untold(bench: Bench, models: list[GapModel], given: list[Sequence]) -> dict[str, Array]:
    """The heaviest payload, of which no method is told; 30 s with it estimate its mass too. Errors as Played's."""
    law, most = bench.identified(DEFAULT_TERMS), max(s.meta.payload_mass for s in given)
    heavy, given = ([s for s in part if s.meta.payload_mass == most] for part in (bench.test, given))
    alone = refit(given, law, unknown_payload=True)
    own = [Calibration.fit(m, law, given, unknown_payload=True) for m in models]

    def errors(mass: float | None, simulator: RobotSpec, model: GapModel | None = None) -> Array:
        told = [replace(s, meta=replace(s.meta, payload_mass=mass or 0.0)) for s in heavy]
        return replace(bench, test=told).errors(simulator, model and model.corrector(law))

    found = {
        IDENTIFIED: [errors(0.0, law)], OPERATOR: [errors(0.0, law, m) for m in models],
        CALIBRATED: [errors(alone.payload_mass, alone.robot)],
        BOTH: [errors(c.payload_mass, c.robot(law), m) for c, m in zip(own, models, strict=True)],
    }  # fmt: skip
    return {m: by_motion(e, heavy) for m, e in found.items()}


def played_without(bench: Bench, fleet: Fleet, change: Callable[[Physics], Physics]) -> list[Sequence]:
    """The unit's test motions once more, its physics changed; noise and warmth as they were."""
    takes = tuple(
        Take(s.meta.motion, UNIT, s.meta.payload_mass, float(round(1 / s.dt)), s.meta.repetition) for s in bench.test
    )
    other = replace(fleet, units={UNIT: change(fleet.unit(UNIT))})
    return play(Job(bench.nominal, other, load_recipe(RECIPE), (), 0, takes))


def cell(values: Array) -> str:
    """± standard error over motions."""
    return f"{values.mean():.2f} ± {standard_error(values):.2f}"


def causes(bench: Bench, whole: Played, methods: Mapping[str, Method]) -> Table:
    """A row per cause."""
    fleet, rows, op = load_fleet("hard", bench.nominal), [], bench.nominal.operated_index
    for name, change in CAUSES.items():
        sequences = played_without(bench, fleet, change)
        part = Played.of(bench, sequences, methods)
        moved = [np.abs(a.qpos - b.qpos)[:, op].mean() for a, b in zip(whole.sequences, sequences, strict=True)]
        due = {m: whole.errors[m] - part.errors[m] for m in METHODS}
        rows.append((name, cell(by_motion([np.array(moved)], sequences)), cell(due[IDENTIFIED]),
                     cell(due[IDENTIFIED] - due[OPERATOR]), cell(due[IDENTIFIED] - due[CALIBRATED]),
                     cell(due[CALIBRATED] - due[BOTH])))  # fmt: skip
        print(*rows[-1], sep=" | ", flush=True)
    heads = ("cause", "moves joints by", "identification leaves", "of it: the operator takes", "30 s take",
             "the operator after 30 s")  # fmt: skip
    told = (
        "mrad, ± standard error over motions (paired), mean over seeds. A negative number: identification has the "
        "cause in its parameters, and is wrong where it is switched off."
    )
    return Table("remains", heads, tuple(rows), told)


def conditions(bench: Bench, methods: Mapping[str, Method], models: list[GapModel], given: list[Sequence]) -> Table:
    """A row per condition that logs differ in."""
    warmth = [float(s.meta.notes.get("warmth_K", 0.0)) for s in bench.test]
    parts = {f"{p:g} kg": [s for s in bench.test if s.meta.payload_mass == p]
             for p in sorted({s.meta.payload_mass for s in bench.test})}  # fmt: skip
    parts |= {
        "cold": [s for s, w in zip(bench.test, warmth, strict=True) if w < WARM / 2],
        "warm": [s for s, w in zip(bench.test, warmth, strict=True) if w > WARM],
    }
    found = {f"{name} ({len(part)})": Played.of(bench, part, methods).errors for name, part in parts.items()}
    found |= {"the heaviest, not told": untold(bench, models, given)}
    rows = []
    for name, e in found.items():
        less = e[IDENTIFIED] - e[OPERATOR], e[CALIBRATED] - e[BOTH]
        rows.append((name, *(cell(e[m]) for m in METHODS), *map(cell, less)))
        print(*rows[-1], sep=" | ", flush=True)
    heads = ("recordings", *METHODS, "the operator takes", "after 30 s")
    return Table("conditions", heads, tuple(rows), "MPJAE in mrad on the unit never seen; ± as above.")


def main() -> None:
    """Play, measure, write."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("work", type=Path)
    parser.add_argument("--seeds", type=int, default=3)
    args = parser.parse_args()
    bench = Bench.of("hard", RECIPE, args.work)
    bench = replace(bench, test=[s for s in bench.test if s.meta.unit_id == UNIT])
    runs = sorted((args.work / "virtual" / "cells").glob("identified+*"))[: args.seeds]
    models = [GapModel.load(r) for r in runs]
    given = bench.data.sequences(Calibration.recordings(bench.data, models[0], UNIT, ()))
    methods = methods_of(bench, models, given)
    whole = Played.of(bench, bench.test, methods)
    said = [f"{m}: {cell(whole.errors[m])} mrad." for m in METHODS]
    less = whole.errors[IDENTIFIED] - whole.errors[OPERATOR], whole.errors[CALIBRATED] - whole.errors[BOTH]
    said.append(
        f"The operator takes {cell(less[0])} mrad after identification and {cell(less[1])} after 30 s of the unit."
    )
    print(*said, sep="\n", flush=True)
    tables = causes(bench, whole, methods), conditions(bench, methods, models, given)
    repeat = facts(bench.data, range(len(models)), unit=UNIT, recordings=len(bench.test))
    publish(
        Result("remains", "Where learning remains", label(bench.data), repeat, tables, {}, tuple(said)),
        args.work / "results",
    )


if __name__ == "__main__":
    main()
