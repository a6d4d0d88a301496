"""Coverage of the standard errors and prediction bands, and verdicts of gaponet check: docs/results/know.md.

    python benchmarks/uncertainty.py virtual WORK --robots 100 --form FORM     VIRTUAL two-joint arms, a line each
    python benchmarks/uncertainty.py real ROBOT DAY OTHER_DAY WORK             datasets of two days
    python benchmarks/uncertainty.py table WORK                                tables of the virtual arms

A virtual arm is drawn from the fleet `hard`. With the form "right", only its gain, damping, dry friction, delay and
encoder noise are hidden; it has the physics step of its file, and delays of whole steps. With "step", its own steps are
1 ms long, those of the file 5 ms. With "wrong", all effects of the fleet are hidden. `gaponet identify` fits eight
motions of 15 s; three more are the validation set. Then the arm plays eight other motions per day: on some days nothing
changed, on the others one parameter did. ROBOT was identified from the training motions of DAY.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections import defaultdict
from dataclasses import replace
from pathlib import Path

import numpy as np
from by_seed import print_table

from gaponet.data.sequence import Sequence, SequenceMeta
from gaponet.data.split import split_entries
from gaponet.data.store import Dataset
from gaponet.robot.folder import save_robot
from gaponet.robot.spec import RobotSpec, load_robot
from gaponet.sim.replay import replay
from gaponet.sysid.evidence.drift import drift
from gaponet.sysid.evidence.evidence import estimate_uncertainty
from gaponet.sysid.identify import identify
from gaponet.sysid.options import IdentifyOptions
from gaponet.sysid.uncertainty import ParameterUncertainty
from gaponet.virtual.fleet import load_fleet, sample_unit
from gaponet.virtual.physics import Physics
from gaponet.virtual.virtual_robot import VirtualRobot

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))
from arm import write_arm

MOTIONS, ROWS, GROUP, WINDOWS = 8, 750, 50, 12
RIGHT = ("gain", "damping", "friction", "delay", "encoder")
DAYS = (
    "train",
    "val",
    "same",
    "friction +20 %",
    "zero +5 mrad",
    "delay +5 ms",
    "backlash 8 mrad",
    "30 K warmer",
)
ANOTHER = "another robot"
NORMAL_90 = 1.645
FORMS = ("right", "step", "wrong")
KINDS = (
    "printed",
    "stored",
)  # standard errors: of the table of identify, which knows the physics step; in uncertainty.json


def commands(seed: int, dt: float) -> np.ndarray:
    """Draw commands of two joints: slow and fast sines on moves between rests, (ROWS, 2) rad."""
    rng, t = np.random.default_rng([seed, 77]), np.arange(ROWS)[:, None] * dt
    pace = np.exp(rng.uniform(np.log(0.1), np.log(1.5), (3, 2)))
    waves = sum(
        rng.uniform(0.05, 0.25, 2) / (1 + 2 * p) * np.sin(2 * np.pi * p * t + rng.uniform(0, 6, 2))
        for p in pace
    )
    stops = np.cumsum(rng.uniform(0.8, 2.5, 12))
    places = rng.uniform(-0.5, 0.5, (13, 2))
    when = np.r_[0, np.repeat(stops, 2) + np.tile([0, 0.5], 12)]
    ways = np.stack(
        [np.interp(t[:, 0], when, np.r_[p[0], np.repeat(p, 2)[1:25]]) for p in places.T], axis=1
    )
    return ways + waves


def changed(p: Physics, what: str) -> Physics:
    """Return the unit on that day; the friction of the arm's file counts as the unit's own."""
    if what == "friction +20 %":
        return replace(p, friction=1.2 * (p.friction + 0.05) - 0.05)
    if what == "delay +5 ms":
        return replace(p, delay=p.delay + 5e-3)
    if what == "backlash 8 mrad":
        return replace(p, backlash=p.backlash + np.array([0.0, 8e-3]))
    return replace(p, warmth=p.warmth + 30.0) if what == "30 K warmer" else p


def play(
    robot: RobotSpec, units: list[Physics], first: int, day: int, timestep: float | None
) -> list[list[Sequence]]:
    """Simulate the motions of one day for every unit, at a physics step in s or at the virtual robots' own."""
    n = len(units)
    ctrl = np.stack(
        [
            commands(100_000 * day + 100 * (first + k) + m, robot.dt)
            for k in range(n)
            for m in range(MOTIONS)
        ],
        1,
    )
    rows, empty = [u for u in units for _ in range(MOTIONS)], [(0.0, "both")] * ctrl.shape[1]
    sim = VirtualRobot(robot, rows, empty, robot.dt, timestep)
    rng = np.random.default_rng([first, day])
    warm = [
        max(0.0, float(u.warmth[0] + u.warmth_spread[0] * rng.standard_normal()))
        for u in units
        for _ in range(MOTIONS)
    ]
    sim.reset(ctrl[0], [1000 * day + i for i in range(ctrl.shape[1])], np.array(warm))
    seen = np.empty((2, *ctrl.shape), np.float32)
    for t in range(ROWS):
        reading = sim.read()
        seen[:, t] = reading.qpos, reading.qvel
        sim.step(ctrl[t])
    if DAYS[day] == "zero +5 mrad":  # of the first joint, of an encoder that the servo does not use
        seen[0, :, :, 0] += 5e-3
    return [
        [
            Sequence(SequenceMeta("arm", f"v{first + k}", f"d{day}m{m}", 0.0, virtual=True), robot.joint_names,
                     robot.dt, ctrl[:, i], seen[0][:, i], seen[1][:, i])
            for m, i in enumerate(range(k * MOTIONS, (k + 1) * MOTIONS))
        ]
        for k in range(n)
    ]  # fmt: skip


def virtual(work: Path, robots: int, form: str) -> None:
    """Draw, simulate, identify and check arms; append one line each to work/FORM.jsonl. Resumes after an interrupt."""
    robot = write_arm(work / "arm")
    fleet = load_fleet("hard", robot)
    file = work / f"{form}.jsonl"
    done = len(file.read_text().splitlines()) if file.is_file() else 0
    for first in range(done, robots, GROUP):
        last = min(first + GROUP, robots)
        units = [
            sample_unit(robot, fleet.distributions, fleet.seed, 1 + k) for k in range(first, last)
        ]
        if form != "wrong":
            units = [replace(u.only(RIGHT), friction_asymmetry=0 * u.friction) for u in units]
        step = None
        if form == "right":
            step = robot.timestep
            units = [replace(u, delay=np.ceil(u.delay / step - 1e-9) * step) for u in units]
        days = [
            play(robot, [changed(u, what) for u in units], first, d, step)
            for d, what in enumerate(DAYS)
        ]
        for k, unit in enumerate(units):
            line = _evaluated(robot, unit, [day[k] for day in days], days[2][(k + 1) % len(units)])
            with file.open("a") as out:
                out.write(json.dumps(line) + "\n")
        print(f"{last} of {robots}", flush=True)


def _evaluated(
    robot: RobotSpec, unit: Physics, days: list[list[Sequence]], another: list[Sequence]
) -> dict[str, object]:
    """Identify one arm and check it on every day."""
    train, val, began = days[0], days[1][:3], time.monotonic()
    fit = identify(
        train, robot, val, options=IdentifyOptions(windows=WINDOWS, table=False, nthread=1)
    )
    right = fit.robot
    mine = estimate_uncertainty(right, train, val, fit.covariance, nthread=1)
    op = robot.operated_index
    truth = {
        "kp": robot.servo.kp[op] * unit.kp_scale * unit.kt_scale, "damping": 0.5 + unit.damping,
        "frictionloss": 0.05 + unit.friction, "delay": unit.delay + 0 * op, "armature": 0.02 + 0.0 * op,
        "offset": 0.0 * op,
    }  # fmt: skip
    z: dict[str, dict[str, list[float]]] = {kind: {f: [] for f in truth} for kind in KINDS}
    for i, joint in enumerate(robot.operated):
        at, cov = mine.si(joint)
        for f, v in truth.items():
            stored = float(np.sqrt(cov[mine.fields.index(f), mine.fields.index(f)]))
            for kind, std in zip(KINDS, (fit.std[joint][f], stored), strict=True):
                z[kind][f].append((at[f] - float(v[i])) / std)
    fresh = days[1][3:]
    error = np.concatenate(
        [np.abs(t.qpos - s.qpos)[1:, op] for s, t in zip(fresh, replay(fresh, right), strict=True)]
    )
    inside = [
        float((error[:, i] <= k.residual_p90).mean()) for i, k in enumerate(mine.joints.values())
    ]
    alone = [
        float((error[:, i] <= NORMAL_90 * k.parameter_rms).mean())
        for i, k in enumerate(mine.joints.values())
    ]
    said = {}
    for what, logs in [*zip(DAYS[2:], days[2:], strict=True), (ANOTHER, another)]:
        found = drift(right, mine, logs, 1)
        said[what] = {
            "verdict": found.verdict,
            "moved": [(m.joint, m.field, m.by, m.sigmas) for m in found.moved],
        }
    return {
        "z": z,
        "inside": inside,
        "alone": alone,
        "said": said,
        "seconds": time.monotonic() - began,
    }


def real(folder: Path, day: Path, other: Path, work: Path) -> None:
    """Evaluate bands and verdicts of a real robot, identified from the training set of the first day."""
    data, robot = Dataset(day), load_robot(folder)
    parts = split_entries(data, ())
    train, val, test = (data.sequences(parts[part]) for part in ("train", "val", "test"))
    mine = ParameterUncertainty.load(robot) if (folder / "uncertainty.json").is_file() else None
    if mine is None:
        save_robot(robot, work / "robot")
        robot = load_robot(work / "robot")
        mine = estimate_uncertainty(robot, train, val)
        mine.save(work / "robot")
    op, lines = robot.operated_index, []
    error = np.concatenate(
        [np.abs(t.qpos - s.qpos)[1:, op] for s, t in zip(test, replay(test, robot), strict=True)]
    )
    inside = {
        j: float((error[:, i] <= k.residual_p90).mean())
        for i, (j, k) in enumerate(mine.joints.items())
    }
    inside["every joint"] = float((error <= [k.residual_p90 for k in mine.joints.values()]).mean())
    shares = ", ".join(f"{j} {100 * share:.0f} %" for j, share in inside.items())
    print(f"test samples inside the 90 % bands: {shares}", flush=True)
    few = [NORMAL_90 * k.parameter_rms for k in mine.joints.values()]
    alone = {j: float((error[:, i] <= few[i]).mean()) for i, j in enumerate(mine.joints)}
    there = Dataset(other)
    later = there.sequences(there.entries)
    asked = {f"first day, never fitted, half {i + 1}": (val + test)[i::2] for i in range(2)}
    asked |= {f"first day, fitted, half {i + 1}": train[i::2] for i in range(2)}
    asked |= {f"other day, quarter {i + 1}": later[i::4] for i in range(4)}
    for name, logs in asked.items():
        began = time.monotonic()
        found = drift(robot, mine, logs)
        lines.append({
            "what": name, "recordings": len(logs), "seconds": found.seconds, "verdict": found.verdict,
            "moved": [(m.joint, m.field, m.by, m.sigmas) for m in found.moved],
            "aside": [a.recording for a in found.against], "took": time.monotonic() - began,
        })  # fmt: skip
        moved = "; ".join(
            f"{m.joint}: {m.field} {m.by:+.3g} ({m.sigmas:+.1f} standard errors)"
            for m in found.moved
        )
        print(f"{name}: {found.verdict}{'; ' * bool(moved)}{moved}", flush=True)
    facts = {"inside": inside, "alone": alone, "drift": lines,
             "joints": {j: (k.parameter_rms, k.residual_rms, k.residual_p90) for j, k in mine.joints.items()},
             }  # fmt: skip
    (work / "real.json").write_text(json.dumps(facts, indent=1))


def table(work: Path) -> None:
    """Print the tables of the virtual arms in Markdown."""
    for form in FORMS:
        file = work / f"{form}.jsonl"
        if not file.is_file():
            continue
        lines = [json.loads(line) for line in file.read_text().splitlines()]
        print(f"\n{len(lines)} VIRTUAL arms, form {form}")
        cells = []
        for f in lines[0]["z"]["printed"]:
            z = [np.abs([v for line in lines for v in line["z"][kind][f]]) for kind in KINDS]
            cells.append(
                (
                    f,
                    *(f"{100 * np.mean(x < NORMAL_90):.0f} %" for x in z),
                    *(f"{np.median(x):.2f}" for x in z),
                )
            )
        inside = [f"in 90 %, {kind}" for kind in KINDS]
        print_table(("number", *inside, *(f"median |z|, {kind}" for kind in KINDS)), cells)
        for name in ("inside", "alone"):
            print(f"\nsamples {name}: {100 * np.mean([line[name] for line in lines]):.1f} %")
        print(
            "\n| day | same | drifted | contradictory | the right number named |\n| --- | ---: | ---: | ---: | ---: |"
        )
        right = {"friction +20 %": "frictionloss", "zero +5 mrad": "offset", "delay +5 ms": "delay",
                 "backlash 8 mrad": "play"}  # fmt: skip
        for what in lines[0]["said"]:
            verdicts: dict[str, int] = defaultdict(int)
            named = 0
            for line in lines:
                verdicts[line["said"][what]["verdict"]] += 1
                named += any(m[1] == right.get(what) for m in line["said"][what]["moved"])
            count = " | ".join(str(verdicts[v]) for v in ("same", "drifted", "contradictory"))
            print(f"| {what} | {count} | {named if what in right else ''} |")


def main() -> None:
    """Run one part."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("what", choices=("virtual", "real", "table"))
    parser.add_argument("paths", nargs="+", type=Path)
    parser.add_argument("--robots", type=int, default=100)
    parser.add_argument("--form", choices=FORMS, default="wrong")
    args = parser.parse_args()
    args.paths[-1].mkdir(parents=True, exist_ok=True)
    if args.what == "virtual":
        virtual(args.paths[0], args.robots, args.form)
    elif args.what == "real":
        real(*args.paths)
    else:
        table(args.paths[0])


if __name__ == "__main__":
    main()
