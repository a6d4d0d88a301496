"""Half a minute that tells most, beside half a minute and a minute taken at random: docs/results/know.md.

    python benchmarks/next_motion.py virtual WORK --arms 40 [--form right|hard] [--joints loaded|free]   VIRTUAL arms
    python benchmarks/next_motion.py real ROBOT DATASET WORK --draws 16          windows of a real robot's recordings
    python benchmarks/next_motion.py table WORK

A robot is known from 24 s. Then it is recorded further: chosen by gaponet excite --for's rule, at random from the same
candidates, or by a plain rival, what is commanded farthest a second. All is fitted again from what was known. Errors to
the truth (VIRTUAL), to the values of many more recordings (real) and of test motions; standard errors as
uncertainty.json says them. A line of WORK/*.jsonl for each arm or draw; what is there is not done again.
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

from gaponet.base.progress import no_progress
from gaponet.data.sequence import Sequence, SequenceMeta
from gaponet.data.split import split_entries
from gaponet.data.store import Dataset
from gaponet.robot.folder import save_robot
from gaponet.robot.spec import RobotSpec, load_robot
from gaponet.sim.replay import replay
from gaponet.sysid.axes import CLASSIC, Axes, Bounds, first_values
from gaponet.sysid.evidence import estimate_uncertainty
from gaponet.sysid.fit import Clock, Fit
from gaponet.sysid.joint_rollouts import JointRollouts
from gaponet.sysid.motion.experiment_design import ExperimentDesign, candidates, expected, open_gains
from gaponet.sysid.motion.library import Library
from gaponet.sysid.motion.motion import Motion
from gaponet.sysid.robot_rollouts import RobotRollouts, cut
from gaponet.sysid.table_contact import tip_heights, touching_below
from gaponet.sysid.uncertainty import ParameterUncertainty, to_axes
from gaponet.testing.fleet import draw, load_fleet
from gaponet.testing.physics import Physics
from gaponet.testing.unit import VirtualRobot

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))
from arm import TOML, XML, write_arm

NORMAL_90 = 1.645
HELD, NOISE = 0.3, 4e-4  # kg of the known payload, rad of the encoder
FIRST_ARM = 2001  # of the fleet's units: of no other benchmark
Found = tuple[
    RobotSpec, ParameterUncertainty, ExperimentDesign, list[int]
]  # fitted, how sure, what the candidates were to tell, picked
BASE = "at random, 32 s"
TOGETHER = (3,)  # iterations of all joints
POOL, MANY, JUDGES = 90, 40, 40  # windows of a real arm: to pick among, that the values come from, that judge
SETS = {
    "nothing more": 0.0, "chosen, 32 s": 32.1, "farthest first, 32 s": 32.1, "at random, 32 s": 32.1,
    "at random, 64 s": 64.1,
}  # fmt: skip


def fitted(
    robot: RobotSpec, start: RobotSpec, logs: list[Sequence], below: float = -np.inf
) -> tuple[RobotSpec, ParameterUncertainty]:
    """As gaponet identify does without terms: every joint on its own, then together, of all windows; and how sure that
    is. Rows with a tip lower than `below` are passed over."""
    bounds, own, clock = Bounds(robot, logs), Bounds(start, logs), Clock(None, 0, no_progress)
    fit = Fit(JointRollouts(cut(logs, 10**6), robot, below, nthread=1), robot, bounds)
    begin = bounds.start if start is robot else {f: own.first[f] for f in CLASSIC}
    alone = fit.search(CLASSIC, begin, clock, "")
    fit.learn_lasting(alone)
    whole = Fit(fit.runs, robot, bounds, RobotRollouts(fit.runs.parts, robot, 1, touch=fit.runs.touch))
    whole.noise, whole.lasts = fit.noise, fit.lasts
    first = Axes(whole.bounds, CLASSIC, bounds.start).of(alone)[None]
    values = whole.descend(CLASSIC, bounds.start, first, TOGETHER, clock, "")
    whole.uncertainty(values)
    found = fit.robot(values)
    return found, estimate_uncertainty(found, logs, (), whole.covariance, nthread=1)


def errors(mine: ParameterUncertainty) -> list[list[float]]:
    """Standard errors on the axes, joints by numbers."""
    return [np.sqrt(np.diag(mine.array(j, "covariance"))).tolist() for j in mine.joints]


def in_turn(order: np.ndarray, seconds: np.ndarray, limit: float) -> list[int]:
    """In this order, each that still fits."""
    picks, left = list[int](), limit
    for i in order.tolist():
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
    below: float = -np.inf,
) -> tuple[dict[str, Found], ExperimentDesign, ParameterUncertainty]:  # fmt: skip
    """A robot fitted before and after each set of further recordings; record(picks) makes those."""
    first, mine = fitted(robot, robot, before, below)
    save_robot(first, place)
    first = load_robot(place)
    own = expected(first, expect, 0.0, 1) if isinstance(expect[0], Motion) else [
        replace(s, qpos=t.qpos, qvel=t.qvel) for s, t in zip(expect, replay(expect, first, nthread=1), strict=True)
    ]  # fmt: skip
    told = ExperimentDesign.from_recordings(first, mine, own, 1)
    found: dict[str, Found] = {"nothing more": (first, mine, told, [])}
    far = np.array([np.abs(np.diff(s.ctrl[:, robot.operated_index], axis=0)).sum() / s.duration for s in own])
    for name, limit in list(SETS.items())[1:]:
        order = np.argsort(-far) if name.startswith("farthest") else rng.permutation(len(far))
        picks = told.choose(limit) if name.startswith("chosen") else in_turn(order, told.seconds, limit)
        found[name] = (*fitted(robot, first, before + record(picks), below), told, picks)
    return found, told, mine


def judge(logs: list[Sequence], robot: RobotSpec, below: float = -np.inf) -> Callable[[RobotSpec], np.ndarray]:
    """The function that gives a robot's errors of recordings, windows of 8 s, (joints, rows) rad."""
    runs = JointRollouts(cut(logs, 10**6), robot, below, nthread=1)
    whole = RobotRollouts(runs.parts, robot, 1, touch=runs.touch)
    return lambda of: whole.run({f: v[None] for f, v in first_values(of).items() if f in CLASSIC})[0]


def judged(
    true: RobotSpec, best: np.ndarray, wrong: Callable[[RobotSpec], np.ndarray],
    after: RobotSpec, sure: ParameterUncertainty, told: ExperimentDesign, picks: list[int],
) -> dict[str, Any]:  # fmt: skip
    """What a fit leaves beside the true robot, whose own errors are `best`."""
    at, now, error = to_axes(true, CLASSIC), to_axes(after, CLASSIC), wrong(after)
    return {
        "errors": errors(sure), "off": [(now[j] - at[j]).tolist() for j in true.operated],
        "seconds": float(told.seconds[picks].sum()),
        "promised": np.sqrt(np.einsum("njj->nj", told.after(picks))).tolist(),
        "test": float(np.abs(error).mean()), "path": float(np.sqrt(np.square(error - best).mean())),
    }  # fmt: skip


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
    tests = candidates(Library(robot, 8, HELD))[::4]  # of other seeds
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
            own = ExperimentDesign.from_recordings(
                first, mine, expected(first, rest, 0.0, 1) + expected(first, rest, HELD, 1), 1
            )
            picks = own.choose(32.0)
            logs = [
                s for i in picks for s in played(robot, unit, [rest[i % len(rest)]], HELD * (i >= len(rest)), 7 * i)
            ]
            found[f"chosen, 32 s, at 0 and {HELD:g} kg"] = (*fitted(robot, first, before + logs), own, picks)
        true = unit if form == "right" else fitted(robot, first, played(robot, unit, pool[::2], 0.0, 3))[0]
        wrong = judge(played(robot, unit, tests, 0.0, 10_000 * k + 500), robot)
        line |= {name: judged(true, wrong(true), wrong, *of) for name, of in found.items()}
        with file.open("a") as out:
            out.write(json.dumps(line) + "\n")
        print(f"{k + 1} of {arms}, {time.process_time() - began:.0f} s of processor", flush=True)


def real(folder: Path, day: Path, work: Path, draws: int) -> None:
    """Lines of work/real.jsonl: windows of 8 s of the training motions; those of the test motions judge."""
    data, robot = Dataset(day), load_robot(str(folder))  # a name or a folder
    parts = split_entries(data, ())
    train, test = (data.sequences(parts[part]) for part in ("train", "test"))
    windows = [replace(w, meta=replace(w.meta, motion=f"{w.meta.motion} {k}")) for k, w in enumerate(cut(train, 10**6))]
    windows = [w for w in windows if w.duration > 7.9]
    below = touching_below(robot, tip_heights(train, robot))
    wrong = judge(cut(test, JUDGES), robot, below)
    file, kept = work / "real.jsonl", work / "all"
    if not (kept / "robot.toml").is_file():
        save_robot(fitted(robot, robot, windows[:: -(-len(windows) // MANY)], below)[0], kept)
    whole = load_robot(kept)
    best = wrong(whole)
    print(
        f"{len(windows)} windows; {MANY} of them: {1e3 * np.abs(best).mean():.2f} mrad of the test motions", flush=True
    )
    done = file.read_text().splitlines() if file.is_file() else []
    for k in range(len(done), draws):
        began, rng = time.process_time(), np.random.default_rng([k, 7])
        order = rng.permutation(len(windows))
        before, rest = [windows[i] for i in order[:3]], [windows[i] for i in order[3 : 3 + POOL]]
        record = lambda p: [rest[i] for i in p]  # noqa: E731, B023
        found, _, _ = compared(robot, before, rest, record, rng, work / "robot", below)
        line = {name: judged(whole, best, wrong, *of) for name, of in found.items()}
        with file.open("a") as out:
            out.write(json.dumps(line) + "\n")
        print(f"{k + 1} of {draws}, {time.process_time() - began:.0f} s of processor", flush=True)


def share(lines: ListOf[Any], name: str, what: str) -> str:
    """What a set leaves over what BASE leaves: root mean squares over draws, geometric mean over numbers; ± by leaving
    out one draw at a time."""
    mine, base = (np.array([np.ravel(x[n][what]) for x in lines]) ** 2 for n in (name, BASE))

    def of(rows: np.ndarray) -> float:
        a, b = mine[rows].mean(axis=0), base[rows].mean(axis=0)
        seen = (a > 0) & (b > 0)  # a delay at its bound is the same everywhere
        return float(np.exp(0.5 * np.log(a[seen] / b[seen]).mean()))

    left = np.array([of(np.arange(len(lines)) != i) for i in range(len(lines))])
    return f"{of(np.arange(len(lines))):.2f} ± {np.sqrt((len(left) - 1) * left.var()):.2f}"


def table(work: Path) -> None:
    """Shares of what random 32 s leave, ± standard error over arms or draws, paired."""
    for file in sorted(work.glob("*.jsonl")):
        lines = [json.loads(line) for line in file.read_text().splitlines()]
        names = [n for n in lines[0] if n != "said"]
        print(f"\n{file.stem}: {len(lines)}\n")
        print("| | s | standard errors | over promised | distance | kp off | paths | test, mrad |")
        print("| --- | ---: | ---: | ---: | ---: | ---: | ---: | ---: |")
        for n in names:
            cells = [f"{np.mean([x[n]['seconds'] for x in lines]):.0f}"]
            more = np.log([np.array(x[n]["errors"]) / x[n]["promised"] for x in lines]).mean()
            cells += [share(lines, n, "errors"), f"{np.exp(more):.1f}", share(lines, n, "off")]
            cells.append(f"{100 * np.sqrt(np.mean([np.square(np.array(x[n]['off'])[:, 0]) for x in lines])):.1f} %")
            cells.append(share(lines, n, "path"))
            test = [1e3 * (x[n]["test"] - x[BASE]["test"]) for x in lines]
            cells.append(f"{np.mean(test):+.2f} ± {np.std(test, ddof=1) / len(test) ** 0.5:.2f}")
            print(f"| {n} | {' | '.join(cells)} |")
        print(f"test, {BASE}: {1e3 * np.mean([x[BASE]['test'] for x in lines]):.2f} mrad")
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
