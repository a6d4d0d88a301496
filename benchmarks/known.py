"""Is what is known of a robot honest? Intervals of parameters and of predicted motion, and what gaponet check says.

    python benchmarks/known.py virtual WORK --robots 100 --form right|wrong   VIRTUAL two-joint arms, a line each
    python benchmarks/known.py real ROBOT DAY OTHER_DAY WORK                  datasets of two days; ROBOT of the first
    python benchmarks/known.py halves ROBOT DAY OTHER_DAY WORK                a fit on half of a day asked on the other
    python benchmarks/known.py drawn ROBOT DAY                                how far units of today move the path
    python benchmarks/known.py table WORK                                     the tables of docs/results/known.md

A virtual arm is drawn from the hard fleet; with the right form only its gain, damping, dry friction, delay and encoder
noise are hidden. It is identified, every joint on its own, from eight motions of 15 s; three more judge. Then it plays
eight others on days on which nothing changed, or one thing did.
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

from gaponet.base.progress import no_progress
from gaponet.data.sequence import Sequence, SequenceMeta
from gaponet.data.split import split_entries
from gaponet.data.store import Dataset
from gaponet.export.ranges import ranges
from gaponet.robot.folder import save_robot
from gaponet.robot.spec import RobotSpec, load_robot
from gaponet.sim.replay import replay
from gaponet.sysid.axes import CLASSIC, Bounds, first_values
from gaponet.sysid.drift import drift
from gaponet.sysid.evidence import WINDOWS, estimate_uncertainty
from gaponet.sysid.fit import Clock, Fit
from gaponet.sysid.identify import identify
from gaponet.sysid.joint_rollouts import JointRollouts
from gaponet.sysid.robot_rollouts import cut
from gaponet.sysid.table_contact import tip_heights, touching_below
from gaponet.sysid.uncertainty import ParameterUncertainty
from gaponet.testing.fleet import draw, load_fleet
from gaponet.testing.physics import Physics
from gaponet.testing.unit import VirtualRobot

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))
from arm import write_arm

MOTIONS, ROWS, GROUP = 8, 750, 50
RIGHT = ("gain", "damping", "friction", "delay", "encoder")
DAYS = ("train", "val", "same", "friction +20 %", "zero +5 mrad", "delay +5 ms", "backlash 8 mrad", "30 K warmer")
ANOTHER = "another robot"
NORMAL_90 = 1.645


def commands(seed: int, dt: float) -> np.ndarray:
    """Two joints: slow and faster sines on ways from rest to rest, (ROWS, 2) rad."""
    rng, t = np.random.default_rng([seed, 77]), np.arange(ROWS)[:, None] * dt
    pace = np.exp(rng.uniform(np.log(0.1), np.log(1.5), (3, 2)))
    waves = sum(
        rng.uniform(0.05, 0.25, 2) / (1 + 2 * p) * np.sin(2 * np.pi * p * t + rng.uniform(0, 6, 2)) for p in pace
    )
    stops = np.cumsum(rng.uniform(0.8, 2.5, 12))
    places = rng.uniform(-0.5, 0.5, (13, 2))
    when = np.r_[0, np.repeat(stops, 2) + np.tile([0, 0.5], 12)]
    ways = np.stack([np.interp(t[:, 0], when, np.r_[p[0], np.repeat(p, 2)[1:25]]) for p in places.T], axis=1)
    return ways + waves


def changed(p: Physics, what: str) -> Physics:
    """The unit on that day; friction of the arm's file counts as its own."""
    if what == "friction +20 %":
        return replace(p, friction=1.2 * (p.friction + 0.05) - 0.05)
    if what == "delay +5 ms":
        return replace(p, delay=p.delay + 5e-3)
    if what == "backlash 8 mrad":
        return replace(p, backlash=p.backlash + np.array([0.0, 8e-3]))
    return replace(p, warmth=p.warmth + 30.0) if what == "30 K warmer" else p


def play(robot: RobotSpec, units: list[Physics], first: int, day: int) -> list[list[Sequence]]:
    """Motions of one day of every unit, side by side."""
    n = len(units)
    ctrl = np.stack(
        [commands(100_000 * day + 100 * (first + k) + m, robot.dt) for k in range(n) for m in range(MOTIONS)], 1
    )
    sim = VirtualRobot(robot, [u for u in units for _ in range(MOTIONS)], [(0.0, "both")] * ctrl.shape[1], robot.dt)
    rng = np.random.default_rng([first, day])
    warm = [
        max(0.0, float(u.warmth[0] + u.warmth_spread[0] * rng.standard_normal())) for u in units for _ in range(MOTIONS)
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
    """Draw, play, identify, ask: lines of work/FORM.jsonl; what is there is not done again."""
    robot = write_arm(work / "arm")
    fleet = load_fleet("hard", robot)
    file = work / f"{form}.jsonl"
    done = len(file.read_text().splitlines()) if file.is_file() else 0
    for first in range(done, robots, GROUP):
        last = min(first + GROUP, robots)
        units = [draw(robot, fleet.distributions, fleet.seed, 1 + k) for k in range(first, last)]
        if form == "right":
            units = [replace(u.only(RIGHT), friction_asymmetry=0 * u.friction) for u in units]
        days = [play(robot, [changed(u, what) for u in units], first, d) for d, what in enumerate(DAYS)]
        for k, unit in enumerate(units):
            line = _asked(robot, unit, [day[k] for day in days], days[2][(k + 1) % len(units)])
            with file.open("a") as out:
                out.write(json.dumps(line) + "\n")
        print(f"{last} of {robots}", flush=True)


def _asked(robot: RobotSpec, unit: Physics, days: list[list[Sequence]], another: list[Sequence]) -> dict[str, object]:
    """One arm identified and checked."""
    train, val, began = days[0], days[1][:3], time.monotonic()
    bounds = Bounds(robot, train)
    fit = Fit(JointRollouts(cut(train, 12), robot, nthread=1), robot, bounds)
    values = fit.search(CLASSIC, bounds.start, Clock(None, 0, no_progress), "")
    fit.uncertainty(values)
    right = fit.robot(values)
    mine = estimate_uncertainty(right, train, val, fit.covariance, nthread=1)
    op = robot.operated_index
    truth = {
        "kp": robot.kp[op] * unit.kp_scale * unit.kt_scale, "damping": 0.5 + unit.damping,
        "frictionloss": 0.05 + unit.friction, "delay": unit.delay + 0 * op, "armature": 0.02 + 0.0 * op,
    }  # fmt: skip
    z = {f: [] for f in truth}
    for i, joint in enumerate(robot.operated):
        at, cov = mine.si(joint)
        for f, v in truth.items():
            z[f].append((at[f] - float(v[i])) / float(np.sqrt(cov[mine.fields.index(f), mine.fields.index(f)])))
    fresh = days[1][3:]
    error = np.concatenate([np.abs(t.qpos - s.qpos)[1:, op] for s, t in zip(fresh, replay(fresh, right), strict=True)])
    inside = [float((error[:, i] <= k.residual_p90).mean()) for i, k in enumerate(mine.joints.values())]
    alone = [float((error[:, i] <= NORMAL_90 * k.parameter_rms).mean()) for i, k in enumerate(mine.joints.values())]
    said = {}
    for what, logs in [*zip(DAYS[2:], days[2:], strict=True), (ANOTHER, another)]:
        found = drift(right, mine, logs, 1)
        said[what] = {"verdict": found.verdict, "moved": [(m.joint, m.field, m.by, m.sigmas) for m in found.moved]}
    return {"z": z, "inside": inside, "alone": alone, "said": said, "seconds": time.monotonic() - began}


def real(folder: Path, day: Path, other: Path, work: Path) -> None:
    """Parts of two days of a real robot; the robot was identified from the training part of the first."""
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
    error = np.concatenate([np.abs(t.qpos - s.qpos)[1:, op] for s, t in zip(test, replay(test, robot), strict=True)])
    inside = {j: float((error[:, i] <= k.residual_p90).mean()) for i, (j, k) in enumerate(mine.joints.items())}
    few = [NORMAL_90 * k.parameter_rms for k in mine.joints.values()]
    alone = {j: float((error[:, i] <= few[i]).mean()) for i, j in enumerate(mine.joints)}
    all_of = {"every joint": float((error <= [k.residual_p90 for k in mine.joints.values()]).mean())}
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
        print(lines[-1], flush=True)
    facts = {"inside": inside | all_of, "alone": alone, "drift": lines,
             "joints": {j: (k.parameter_rms, k.residual_rms, k.residual_p90) for j, k in mine.joints.items()},
             }  # fmt: skip
    (work / "real.json").write_text(json.dumps(facts, indent=1))


def halves(folder: Path, day: Path, other: Path, work: Path) -> None:
    """Identified from each half of a day's motions and asked of the other, and of both days' logs under one name."""
    data, there = Dataset(day), Dataset(other)
    robot, logs = load_robot(str(folder)), data.sequences(data.entries)  # a name or a folder
    later, file = there.sequences(there.entries), work / "halves.json"
    lines = json.loads(file.read_text()) if file.is_file() else []
    for k in range(len(lines), 2):
        mine, rest = logs[k::2], logs[1 - k :: 2]
        fitted = identify(mine[::4] + mine[1::4] + mine[2::4], robot, mine[3::4], table=False, nthread=1)
        save_robot(fitted.robot, work / f"half{k}")
        half = load_robot(work / f"half{k}")
        sure = estimate_uncertainty(half, mine[::4] + mine[1::4] + mine[2::4], mine[3::4], fitted.covariance, nthread=1)
        sure.save(work / f"half{k}")
        op, twins = half.operated_index, replay(rest, half, nthread=1)
        error = np.concatenate([np.abs(t.qpos - s.qpos)[1:, op] for s, t in zip(rest, twins, strict=True)])
        asked = {"other half": rest, "half of it, half of another day": rest[::2] + later[1 - k :: 4]}
        asked |= {"three quarters, a quarter of another day": rest[: len(rest) * 3 // 4] + later[1 - k :: 8]}
        said = {}
        for what, of in asked.items():
            found = drift(half, sure, [replace(s, meta=replace(s.meta, motion=f"{s.meta.motion} {i}"))
                                       for i, s in enumerate(of)], 1)  # fmt: skip
            mine_too = {f"{s.meta.motion} {i}" for i, s in enumerate(of) if any(s is r for r in rest)}
            aside = {a.recording for a in found.against}
            moved = [(m.joint, m.field, m.by, m.sigmas) for m in found.moved]
            said[what] = {"verdict": found.verdict, "moved": moved, "of": len(of)}
            said[what] |= {"aside": len(aside), "aside, of the other day": len(aside - mine_too)}
        inside = (error <= [j.residual_p90 for j in sure.joints.values()]).mean(axis=0)
        alone = (error <= [NORMAL_90 * j.parameter_rms for j in sure.joints.values()]).mean(axis=0)
        lines.append({"inside": inside.tolist(), "alone": alone.tolist(), "said": said})
        file.write_text(json.dumps(lines, indent=1))
        print(lines[-1], flush=True)


def table(work: Path) -> None:
    """What was found, in Markdown."""
    for form in ("right", "wrong"):
        file = work / f"{form}.jsonl"
        if not file.is_file():
            continue
        lines = [json.loads(line) for line in file.read_text().splitlines()]
        print(f"\n{len(lines)} VIRTUAL arms, form {form}\n\n| number | in 90 % | median \\|z\\| |\n|---|---:|---:|")
        for f in lines[0]["z"]:
            z = np.abs([v for line in lines for v in line["z"][f]])
            print(f"| {f} | {100 * np.mean(z < NORMAL_90):.0f} % | {np.median(z):.2f} |")
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


def drawn(folder: Path, day: Path) -> None:
    """How far 100 units of today are from the robot's path in 40 windows of the training motions, RMS over each."""
    data, robot = Dataset(day), load_robot(folder)
    train, mine = data.sequences(split_entries(data, ())["train"]), ParameterUncertainty.load(robot)
    assert mine is not None
    below = touching_below(robot, tip_heights(train, robot))
    runs, own = JointRollouts(cut(train, WINDOWS), robot, below, 1), first_values(robot)
    units = ranges(robot, samples=100).units
    own = {f: np.repeat(own[f][None], 100, axis=0) for f in units}
    path = runs.errors({f: v[:1] for f, v in own.items()})
    print("| joint | the robot leaves, mrad | half of the units | 9 of 10 | all | 9 of 10, the limit stays |")
    print("| --- | ---: | ---: | ---: | ---: | ---: |")
    each = [1e3 * np.sqrt(np.square(runs.errors(v) - path).sum(axis=(2, 3)) / runs.rows)
            for v in (units, units | {"effort_limit": own["effort_limit"]})]  # fmt: skip
    for i, (joint, k) in enumerate(mine.joints.items()):
        shares = [*np.quantile(each[0][:, i], (0.5, 0.9, 1.0)), np.quantile(each[1][:, i], 0.9)]
        print(f"| {joint} | {1e3 * k.residual_rms:.1f} | {' | '.join(f'{x:.1f}' for x in shares)} |")


def main() -> None:
    """As above."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=("virtual", "real", "halves", "drawn", "table"))
    parser.add_argument("paths", nargs="+", type=Path)
    parser.add_argument("--robots", type=int, default=100)
    parser.add_argument("--form", choices=("right", "wrong"), default="wrong")
    args = parser.parse_args()
    if args.what == "drawn":
        drawn(*args.paths)
        return
    args.paths[-1].mkdir(parents=True, exist_ok=True)
    if args.what == "virtual":
        virtual(args.paths[0], args.robots, args.form)
    elif args.what in ("real", "halves"):
        {"real": real, "halves": halves}[args.what](*args.paths)
    else:
        table(args.paths[0])


if __name__ == "__main__":
    main()
