"""Half a minute that tells most, beside half a minute and a minute taken at random: docs/results/know.md.

    python benchmarks/next_motion.py virtual WORK --arms 40 [--form right|hard] [--joints loaded|free]   VIRTUAL arms
    python benchmarks/next_motion.py real ROBOT DATASET WORK --draws 16          windows of a real robot's recordings
    python benchmarks/next_motion.py table WORK

A robot is known from 24 s. Then it is recorded further: chosen by gaponet excite --for's rule, or at random from the
same candidates. All is fitted again from what was known. Errors to the truth (VIRTUAL), to the values of all recordings
(real) and of test motions; standard errors as known.json says them. A line of WORK/*.jsonl for each arm or draw; what
is there is not done again.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections.abc import Callable
from collections.abc import Sequence as ListOf
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from gaponet.data.sequence import Sequence, SequenceMeta
from gaponet.data.split import split_entries
from gaponet.data.store import Dataset
from gaponet.eval.knowledge import Knowledge, seen
from gaponet.progress import silent
from gaponet.robot import RobotSpec, load_robot
from gaponet.robot_folder import save_robot
from gaponet.sim.axes import CLASSIC, Axes, Bounds
from gaponet.sim.free_runs import cut
from gaponet.sim.identify import TOGETHER, Clock, Fit
from gaponet.sim.joint_runs import JointRuns
from gaponet.sim.replay import replay, whole_errors
from gaponet_lab.known.evidence import known
from gaponet_robots.motion.library import Library
from gaponet_robots.motion.motion import Motion
from gaponet_robots.motion.telling import Telling, candidates, expected, open_gains
from gaponet_robots.virtual.fleet import draw, load_fleet
from gaponet_robots.virtual.physics import Physics
from gaponet_robots.virtual.unit import VirtualRobot

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))
from arm import TOML, XML, write_arm

NORMAL_90 = 1.645
HELD, NOISE = 0.3, 4e-4  # kg of the known payload, rad of the encoder
FIRST_ARM = 2001  # of the fleet's units: of no other benchmark
SETS = {"nothing more": 0.0, "chosen, 32 s": 32.0, "at random, 32 s": 32.0, "at random, 64 s": 64.0}


def fitted(robot: RobotSpec, start: RobotSpec, logs: list[Sequence]) -> tuple[RobotSpec, Knowledge]:
    """As gaponet identify does without terms: every joint on its own, then together; and how sure that is."""
    bounds, own, clock = Bounds(robot, logs), Bounds(start, logs), Clock(None, 0, silent)
    fit = Fit(JointRuns(cut(logs, 10**6), robot, nthread=1), robot, bounds)
    begin = bounds.start if start is robot else {f: own.first[f] for f in CLASSIC}
    alone, whole = fit.search(CLASSIC, begin, clock, ""), fit.whole(1)
    first = np.stack([Axes(whole.bounds, CLASSIC, bounds.start).of(v) for v in (alone, begin)])
    values = whole.descend(CLASSIC, bounds.start, first, TOGETHER, clock, "")
    whole.uncertainty(values)
    found = fit.robot(values)
    return found, known(found, logs, (), whole.covariance, nthread=1)


def errors(mine: Knowledge) -> list[list[float]]:
    """Standard errors on the axes, joints by numbers."""
    return [np.sqrt(np.diag(mine.array(j, "covariance"))).tolist() for j in mine.joints]


def at_random(seconds: np.ndarray, limit: float, rng: np.random.Generator) -> list[int]:
    """In any order, each that still fits."""
    picks, left = list[int](), limit
    for i in rng.permutation(len(seconds)).tolist():
        if seconds[i] <= left:
            picks, left = [*picks, i], left - seconds[i]
    return picks


def compared(
    robot: RobotSpec,
    before: list[Sequence],
    expect: ListOf[Any],
    record: Callable[..., list[Sequence]],
    rng: np.random.Generator,
    place: Path,
    sets: dict[str, float] = SETS,
) -> tuple[dict[str, tuple[RobotSpec, Knowledge, float]], Telling, Knowledge]:  # fmt: skip
    """A robot fitted before and after each set of further recordings; record(picks) makes those."""
    first, mine = fitted(robot, robot, before)
    save_robot(first, place)
    first = load_robot(place)
    own = expected(first, expect, 0.0, 1) if isinstance(expect[0], Motion) else [
        replace(s, qpos=t.qpos, qvel=t.qvel) for s, t in zip(expect, replay(expect, first, nthread=1), strict=True)
    ]  # fmt: skip
    told = Telling.of(first, mine, own, 1)
    found = {"nothing more": (first, mine, 0.0)}
    for name, limit in list(sets.items())[1:]:
        picks = told.choose(limit) if name.startswith("chosen") else at_random(told.seconds, limit, rng)
        logs = before + (record(picks))
        found[name] = (*fitted(robot, first, logs), float(told.seconds[picks].sum()))
    return found, told, mine


def played(
    robot: RobotSpec, unit: Physics | RobotSpec, motions: ListOf[Motion], mass: float, seed: int
) -> list[Sequence]:
    """What a VIRTUAL unit does; or, of another robot of the fit's own form, what that does, seen by an encoder."""
    if isinstance(unit, RobotSpec):
        rng, logs = np.random.default_rng(seed), expected(unit, motions, mass, 1)
        return [replace(s, qpos=s.qpos + NOISE * rng.standard_normal(s.qpos.shape).astype(np.float32)) for s in logs]
    ctrls = [m.sample(robot.dt) for m in motions]
    rows = max(map(len, ctrls))
    ctrl = np.stack([np.concatenate([c, np.repeat(c[-1:], rows - len(c), axis=0)]) for c in ctrls], axis=1)
    sim = VirtualRobot(robot, [unit] * len(ctrls), [(mass, "both")] * len(ctrls), robot.dt, nthread=1)
    sim.reset(ctrl[0], [seed + i for i in range(len(ctrls))], np.full(len(ctrls), float(unit.warmth[0])))
    out = np.empty((2, *ctrl.shape), np.float32)
    for t in range(rows):
        reading = sim.read()
        out[:, t] = reading.qpos, reading.qvel
        sim.step(ctrl[t])
    return [
        Sequence(SequenceMeta(robot.name, "v", f"{m.name} {mass:g} kg", mass, virtual=True), robot.joint_names,
                 robot.dt, c, out[0, : len(c), i], out[1, : len(c), i])
        for i, (m, c) in enumerate(zip(motions, ctrls, strict=True))
    ]  # fmt: skip


def true_of(robot: RobotSpec, unit: Physics) -> RobotSpec:
    """The unit's numbers in the form that is fitted."""
    return robot.with_servos({
        j: {"kp": float(robot.kp[i] * unit.kp_scale[i] * unit.kt_scale[i]), "damping": 0.5 + float(unit.damping[i]),
            "frictionloss": 0.05 + float(unit.friction[i]), "armature": 0.02, "offset": 0.01 * (-1) ** i,
            "delay": float(np.ravel(unit.delay)[0])} for i, j in enumerate(robot.operated)
    })  # fmt: skip


def virtual(work: Path, arms: int, form: str, joints: str) -> None:
    """Lines of work/FORM-JOINTS.jsonl."""
    xml = XML.replace('axis="0 1 0"', 'axis="0 0 1"') if joints == "free" else XML  # free: gravity turns nothing
    robot = write_arm(work / f"arm-{joints}", TOML, xml)
    fleet, pool = load_fleet("hard", robot), candidates(Library(robot, 7, HELD))
    file = work / f"{form}-{joints}.jsonl"
    for k in range(len(file.read_text().splitlines()) if file.is_file() else 0, arms):
        began, rng = time.process_time(), np.random.default_rng([k, 99])
        unit: Physics | RobotSpec = draw(robot, fleet.distributions, fleet.seed, FIRST_ARM + k)
        unit = true_of(robot, unit) if form == "right" else unit  # type: ignore[arg-type]
        ordinary = [m for m in pool if m.name.startswith(("tour", "limber"))]
        order = rng.permutation(len(ordinary))[:3].tolist()
        before = played(robot, unit, [ordinary[i] for i in order], 0.0, 10_000 * k)
        rest = [m for m in pool if m.name not in {ordinary[i].name for i in order}]
        record = lambda picks: played(robot, unit, [rest[i] for i in picks], 0.0, 10_000 * k + 100)  # noqa: E731, B023
        found, told, mine = compared(robot, before, rest, record, rng, work / "robot")
        first = load_robot(work / "robot")
        line = {"said": open_gains(first, mine, told, rest, (0.0,))}
        if joints == "free":  # the same motions with a known mass
            own = Telling.of(first, mine, expected(first, rest, 0.0, 1) + expected(first, rest, HELD, 1), 1)
            picks = own.choose(32.0)
            logs = [
                s for i in picks for s in played(robot, unit, [rest[i % len(rest)]], HELD * (i >= len(rest)), 7 * i)
            ]
            found[f"chosen, 32 s, at 0 and {HELD:g} kg"] = (
                *fitted(robot, first, before + logs),
                float(own.seconds[picks].sum()),
            )
        true = unit if form == "right" else fitted(robot, first, played(robot, unit, pool, 0.0, 3))[0]
        at = seen(true, CLASSIC)
        for name, (after, sure, seconds) in found.items():
            now = seen(after, CLASSIC)
            off = [(now[j] - at[j]).tolist() for j in robot.operated]
            line[name] = {"errors": errors(sure), "off": off, "seconds": seconds}
        with file.open("a") as out:
            out.write(json.dumps(line) + "\n")
        print(f"{k + 1} of {arms}, {time.process_time() - began:.0f} s of processor", flush=True)


def real(folder: Path, day: Path, work: Path, draws: int) -> None:
    """Lines of work/real.jsonl: windows of 8 s of the training motions; test motions judge."""
    data, robot = Dataset(day), load_robot(str(folder))  # a name or a folder
    parts = split_entries(data, ())
    train, test = (data.sequences(parts[part]) for part in ("train", "test"))
    windows = [replace(w, meta=replace(w.meta, motion=f"{w.meta.motion} {k}")) for k, w in enumerate(cut(train, 10**6))]
    windows = [w for w in windows if w.duration > 7.9]
    file = work / "real.jsonl"
    done = file.read_text().splitlines() if file.is_file() else []
    whole, _ = fitted(robot, robot, windows[:: max(1, len(windows) // 60)])
    at = seen(whole, CLASSIC)
    for k in range(len(done), draws):
        began, rng = time.process_time(), np.random.default_rng([k, 7])
        order = rng.permutation(len(windows))
        before, rest = [windows[i] for i in order[:3]], [windows[i] for i in order[3:]]
        found, _, _ = compared(robot, before, rest, lambda p: [rest[i] for i in p], rng, work / "robot")  # noqa: B023
        line = {}
        for name, (after, sure, seconds) in found.items():
            now = seen(after, CLASSIC)
            line[name] = {
                "errors": errors(sure), "off": [(now[j] - at[j]).tolist() for j in robot.operated], "seconds": seconds,
                "test": float(whole_errors(test, after, 1).mean()),
            }  # fmt: skip
        with file.open("a") as out:
            out.write(json.dumps(line) + "\n")
        print(f"{k + 1} of {draws}, {time.process_time() - began:.0f} s of processor", flush=True)


def table(work: Path) -> None:
    """Shares of what random 30 s leave: geometric means, ± standard error over arms or draws, paired."""
    for file in sorted(work.glob("*.jsonl")):
        lines = [json.loads(line) for line in file.read_text().splitlines()]
        names = [n for n in lines[0] if n != "said"]
        print(f"\n{file.stem}: {len(lines)}\n\n| | s | standard errors | distance | kp alone | test, mrad |")
        print("| --- | ---: | ---: | ---: | ---: | ---: |")

        def logs(n: str, what: str, lines: list[Any] = lines) -> np.ndarray:
            return np.array([np.log(np.abs(np.array(x[n][what])) + 1e-9) for x in lines])

        for n in names:
            cells = [f"{np.mean([x[n]['seconds'] for x in lines]):.0f}"]
            for what in ("errors", "off"):
                share = (logs(n, what) - logs("at random, 32 s", what)).mean(axis=(1, 2))
                cells.append(
                    f"{np.exp(share.mean()):.2f} ± {np.exp(share.mean()) * share.std(ddof=1) / len(share) ** 0.5:.2f}"
                )
            cells.append(f"{100 * np.sqrt(np.mean([np.square(np.array(x[n]['off'])[:, 0]) for x in lines])):.1f} %")
            test = [1e3 * (x[n]["test"] - x["at random, 32 s"]["test"]) for x in lines if "test" in x[n]]
            cells.append(f"{np.mean(test):+.2f} ± {np.std(test, ddof=1) / len(test) ** 0.5:.2f}" if test else "")
            print(f"| {n} | {' | '.join(cells)} |")
        if file.stem.startswith("right"):  # the truth is known, and of the form that is fitted
            z = np.array([np.array(x[n]["off"]) / np.array(x[n]["errors"]) for x in lines for n in names])
            held = (np.abs(z) < NORMAL_90).mean(axis=(0, 1))
            print(
                "within 1.645 standard errors: " + ", ".join(f"{f} {s:.0%}" for f, s in zip(CLASSIC, held, strict=True))
            )
        for said in sorted({f"{j}: {v}" for x in lines for j, v in x.get("said", {}).items()})[:4]:
            print(f"said: {said}")


def main() -> None:
    """As above."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=("virtual", "real", "table"))
    parser.add_argument("paths", nargs="+", type=Path)
    parser.add_argument("--arms", type=int, default=40)
    parser.add_argument("--draws", type=int, default=16)
    parser.add_argument("--form", choices=("right", "hard"), default="right")
    parser.add_argument("--joints", choices=("loaded", "free"), default="loaded")
    args = parser.parse_args()
    args.paths[-1].mkdir(parents=True, exist_ok=True)
    if args.what == "virtual":
        virtual(args.paths[0], args.arms, args.form, args.joints)
    elif args.what == "real":
        real(*args.paths, args.draws)
    else:
        table(args.paths[0])


if __name__ == "__main__":
    main()
