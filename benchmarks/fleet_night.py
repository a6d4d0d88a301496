"""Nights of a VIRTUAL fleet of two-joint arms by gaponet fleet: docs/results/know.md; and one from the raw logs on.

    python benchmarks/fleet_night.py WORK --robots 50 [--kill]
    python benchmarks/fleet_night.py WORK --robots 200 --day --executor ray [--kill]

Each arm is identified, joint by joint, from eight motions of 15 s. Night 1: nothing changed. Night 2: one thing did in
every fifth arm (friction, zero, delay, in turn). --kill: the second night is killed after a while and started again.
Prints seconds of processor, bytes, and who was named.

--day: the second night alone, from raw logs (two minutes, which stand for a day) over import, doctor and gap to check
and adaptation, a robot a job on the executor. The robots are copies of DRAWN arms, each with a day of its own. --kill:
a worker is killed with -9 once a third is done. Prints seconds of processor by step, docs/results/speed.md.
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import signal
import subprocess
import sys
import time
from dataclasses import replace
from functools import partial
from pathlib import Path

import known as days
import numpy as np
from kill_workers import SIGN, busiest

from gaponet.base.executor import open_pool
from gaponet.base.progress import no_progress
from gaponet.data.sequence import Sequence
from gaponet.data.store import Dataset
from gaponet.robot.folder import save_robot
from gaponet.robot.spec import RobotSpec, load_robot
from gaponet.sysid.axes import CLASSIC, Bounds
from gaponet.sysid.evidence import estimate_uncertainty
from gaponet.sysid.fit import Clock, Fit
from gaponet.sysid.joint_rollouts import JointRollouts
from gaponet.sysid.robot_rollouts import cut
from gaponet.testing.fleet import draw, load_fleet

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))
from arm import write_arm

FIRST_ARM, EVERY = 3001, 5  # the fleet's units: in no other benchmark
DRAWN, SELDOM = 10, 20  # arms of which --day has copies; every which robot changed, in one of CHANGES in turn
CHANGES = ("friction +20 %", "zero +5 mrad", "delay +5 ms")


def made(work: Path, robots: int) -> dict[str, str]:
    """Robot folders and both nights' logs; arm → what changed on the second."""
    robot = write_arm(work / "arm")
    fleet = load_fleet("hard", robot)
    units = [draw(robot, fleet.distributions, fleet.seed, FIRST_ARM + k) for k in range(robots)]
    units = [replace(u.only(days.RIGHT), friction_asymmetry=0 * u.friction) for u in units]
    changes = {k: CHANGES[k // EVERY % len(CHANGES)] for k in range(0, robots, EVERY)}
    later = [days.changed(u, changes.get(k, "")) for k, u in enumerate(units)]
    named = {f"arm-{k:03d}": changes.get(k, "") for k in range(robots)}
    if (work / "night2" / f"arm-{robots - 1:03d}" / "dataset.json").is_file():
        return named
    each = [days.play(robot, us, 0, day) for us, day in ((units, 0), (units, 1), (later, 2))]
    for k, name in enumerate(named):
        _identified(robot, each[0][k], work / "robots" / name)
        for night, logs in (("night1", each[1][k]), ("night2", each[2][k])):
            data = Dataset.create(work / night / name, robot)
            for s in logs:
                data.append(_turned(s) if night == "night2" and named[name] == "zero +5 mrad" else s)
    return named


def _identified(robot: RobotSpec, train: list[Sequence], folder: Path) -> None:
    bounds = Bounds(robot, train)
    fit = Fit(JointRollouts(cut(train, 12), robot, nthread=1), robot, bounds)
    values = fit.search(CLASSIC, bounds.start, Clock(None, 0, no_progress), "")
    fit.uncertainty(values)
    save_robot(fit.robot(values), folder)
    mine = load_robot(folder)
    estimate_uncertainty(mine, train[:6], train[6:], fit.covariance, nthread=1).save(folder)


def _turned(s: Sequence) -> Sequence:
    return replace(s, qpos=s.qpos + np.array([5e-3, 0], np.float32))


def _kept(work: Path) -> list[Path]:
    """Files of arms with both nights."""
    return [f for f in (work / "out").glob("arm-*.json") if len(json.loads(f.read_text())) == 2]


def day(work: Path, robots: int, executor: str, kill: bool) -> None:
    """Every robot's night, from its raw logs on."""
    robot, raw = write_arm(work / "arm"), work / "raw"
    fleet = load_fleet("hard", robot)
    units = [draw(robot, fleet.distributions, fleet.seed, FIRST_ARM + k) for k in range(DRAWN)]
    units = [replace(u.only(days.RIGHT), friction_asymmetry=0 * u.friction) for u in units]
    named = {f"arm-{k:03d}": "" if k % SELDOM else CHANGES[k // SELDOM % len(CHANGES)] for k in range(robots)}
    if not (raw / f"arm-{robots - 1:03d}").is_dir():
        for k, train in enumerate(days.play(robot, units, 0, 0)):
            _identified(robot, train, work / "drawn" / str(k))
        for first in range(0, robots, days.GROUP):
            part = list(named.items())[first : first + days.GROUP]
            later = [days.changed(units[(first + i) % DRAWN], what) for i, (_, what) in enumerate(part)]
            for (name, what), logs in zip(part, days.play(robot, later, first, 2), strict=True):
                shutil.copytree(work / "drawn" / str(int(name[4:]) % DRAWN), work / "robots" / name)
                _write(raw / name, [_turned(s) if what == "zero +5 mrad" else s for s in logs])
    shutil.rmtree(work / "data", ignore_errors=True)
    os.environ[SIGN] = sign = str(os.getpid())
    took, killed, began = dict[str, dict[str, float]](), 0, time.monotonic()
    with open_pool(executor, 0, 1) as pool:
        ready = time.monotonic()
        victim = lambda: busiest(sign, os.getpid()) if kill and not killed and len(took) > robots / 3 else None  # noqa: E731
        for outcome in pool.run(partial(_night, work), named):
            took[outcome.job] = outcome.result()
            (work / "day.json").write_text(json.dumps({"seconds": time.monotonic() - ready, "robots": took}, indent=1))
            if (worker := victim()) is not None:
                os.kill(worker, signal.SIGKILL)
                killed = worker
    wall, odd = time.monotonic() - ready, {r for r, t in took.items() if t["drifted"]}
    print(f"{len(took)} robots on {executor}: {wall:.0f} s after {ready - began:.0f} s of start; killed: {killed}")
    right, of = sum(bool(named[r]) for r in odd), sum(map(bool, named.values()))
    print(f"not the same {len(odd)}, changed indeed {right} of {of}")
    for step in ("import", "doctor", "gap", "check", "adapt"):
        each = np.array([t[step] for t in took.values() if step in t])
        print(f"{step}: {len(each)} robots, {np.median(each):.2f} s of processor each, {each.sum():.0f} in all")


def _write(folder: Path, logs: list[Sequence]) -> None:
    folder.mkdir(parents=True)
    arrays = ("ctrl", "qpos", "qvel")
    told = [*(f'{c} = "{c}"' for c in arrays), 'time_unit = "s"', 'position_unit = "rad"']
    (folder / "logs.toml").write_text("\n".join(told) + "\n")
    for s in logs:
        np.savez(
            folder / f"{s.meta.motion}.npz", time=np.arange(len(s)) * s.dt, joint_names=np.array(s.joint_names),
            **{c: getattr(s, c) for c in arrays},
        )  # fmt: skip


def _night(work: Path, name: str) -> dict[str, float]:
    """One robot's, in a worker: seconds of processor by step."""
    import gaponet as gp
    from gaponet.fleet import Job, ask

    took, data, spent = dict[str, float](), work / "data" / name, lambda: sum(os.times()[:4])  # with its own children
    shutil.rmtree(data, ignore_errors=True)  # of a worker that was killed
    job = Job(name, work / "robots" / name, data, "", "day", None, None)
    steps = {
        "import": lambda: gp.import_logs(work / "raw" / name, work / "arm", data, name, 0.0),
        "doctor": lambda: gp.doctor(data),
        "gap": lambda: gp.gap(data),
        "check": lambda: ask(job),
    }
    for step, do in steps.items():
        began = spent()
        found = do()
        took[step] = spent() - began
    took["drifted"] = float(found["verdict"] != "same")
    if found["verdict"] == "drifted":
        began = spent()
        gp.adapt_robot(job.robot, data, work / "adapted" / name)
        took["adapt"] = spent() - began
    return took


def main() -> None:
    """As above."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("work", type=Path)
    parser.add_argument("--robots", type=int, default=50)
    parser.add_argument("--kill", action="store_true")
    parser.add_argument("--day", action="store_true")
    parser.add_argument("--executor", default="local")
    args = parser.parse_args()
    if args.day:
        day(args.work, args.robots, args.executor, args.kill)
        return
    work, named = args.work, made(args.work, args.robots)
    for night in ("night1", "night2"):
        command = [sys.executable, "-m", "gaponet", "fleet", str(work / "robots"), str(work / night), "--out",
                   str(work / "out"), "--night", night, "--executor", args.executor, "--workers", "1",
                   "--json"]  # fmt: skip
        if night == "night2" and args.kill:
            begun = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
            while begun.poll() is None and len(_kept(work)) < len(named) // 3:
                time.sleep(0.1)
            begun.kill()
            begun.wait()
            print(f"killed: {len(_kept(work))} of {len(named)} were kept")
            kept = {f: f.stat().st_mtime_ns for f in _kept(work)}
        began = time.monotonic()
        done = subprocess.run(command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True, check=False)
        said = json.loads(done.stdout)["robots"]
        if night == "night2" and args.kill:
            print(f"asked again of those: {sum(f.stat().st_mtime_ns != then for f, then in kept.items())}")
        took, adapted = np.array([n["took"] for n in said.values()]), [n["adapted"] for n in said.values()]
        moved = {r: n["moved"] for r, n in said.items() if n["verdict"] != "same"}
        right = [r for r in moved if night == "night2" and named[r]]
        size = sum(f.stat().st_size for f in (work / night).rglob("*") if f.is_file()) / len(named)
        again = sum(c is not None for c in adapted)
        print(
            f"{night}: {len(said)} robots, {time.monotonic() - began:.0f} s, of processor {took.sum():.0f} s: "
            f"{np.median(took):.2f} each, {max(took):.1f} the longest; {again} adapted; "
            f"{size / 1e6:.2f} MB of logs each; not the same {len(moved)}, changed indeed {len(right)}"
        )
        for robot in sorted({*moved, *(r for r, what in named.items() if what and night == "night2")}):
            what = named[robot] if night == "night2" else "nothing"
            print(f"  {robot}: {what} → {'; '.join(moved.get(robot, ['same']))}")


if __name__ == "__main__":
    main()
