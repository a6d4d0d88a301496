"""Nights of a VIRTUAL fleet of two-joint arms by gaponet fleet: docs/results/know.md.

    python benchmarks/fleet_night.py WORK --robots 50 [--kill]

Each arm is identified, joint by joint, from eight motions of 15 s. Night 1: nothing changed. Night 2: one thing did in
every fifth arm (friction, zero, delay, in turn). --kill: the second night is killed after a while and started again.
Prints seconds of processor, bytes, and who was named.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import known as days
import numpy as np

from gaponet.data.sequence import Sequence
from gaponet.data.store import Dataset
from gaponet.progress import silent
from gaponet.robot import load_robot
from gaponet.robot_folder import save_robot
from gaponet.sim.axes import CLASSIC, Bounds
from gaponet.sim.free_runs import cut
from gaponet.sim.identify import Clock, Fit
from gaponet.sim.joint_runs import JointRuns
from gaponet_lab.known.evidence import known
from gaponet_robots.virtual.fleet import draw, load_fleet

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))
from arm import write_arm

FIRST_ARM, EVERY = 3001, 5  # the fleet's units: in no other benchmark
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
        train = each[0][k]
        bounds = Bounds(robot, train)
        fit = Fit(JointRuns(cut(train, 12), robot, nthread=1), robot, bounds)
        values = fit.search(CLASSIC, bounds.start, Clock(None, 0, silent), "")
        fit.uncertainty(values)
        save_robot(fit.robot(values), work / "robots" / name)
        mine = load_robot(work / "robots" / name)
        known(mine, train[:6], train[6:], fit.covariance, nthread=1).save(mine.folder)
        for night, logs in (("night1", each[1][k]), ("night2", each[2][k])):
            data = Dataset.create(work / night / name, robot)
            for s in logs:
                data.append(_turned(s) if night == "night2" and named[name] == "zero +5 mrad" else s)
    return named


def _turned(s: Sequence) -> Sequence:
    return replace(s, qpos=s.qpos + np.array([5e-3, 0], np.float32))


def _kept(work: Path) -> list[Path]:
    """Files of arms with both nights."""
    return [f for f in (work / "out").glob("arm-*.json") if len(json.loads(f.read_text())) == 2]


def main() -> None:
    """As above."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("work", type=Path)
    parser.add_argument("--robots", type=int, default=50)
    parser.add_argument("--kill", action="store_true")
    args = parser.parse_args()
    work, named = args.work, made(args.work, args.robots)
    for night in ("night1", "night2"):
        command = [sys.executable, "-m", "gaponet", "fleet", str(work / "robots"), str(work / night), "--out",
                   str(work / "out"), "--night", night, "--workers", "1", "--json"]  # fmt: skip
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
        took, calibrated = np.array([n["took"] for n in said.values()]), [n["calibrated"] for n in said.values()]
        moved = {r: n["moved"] for r, n in said.items() if n["verdict"] != "same"}
        right = [r for r in moved if night == "night2" and named[r]]
        size = sum(f.stat().st_size for f in (work / night).rglob("*") if f.is_file()) / len(named)
        again = sum(c is not None for c in calibrated)
        print(
            f"{night}: {len(said)} robots, {time.monotonic() - began:.0f} s, of processor {took.sum():.0f} s: "
            f"{np.median(took):.2f} each, {max(took):.1f} the longest; {again} calibrated; "
            f"{size / 1e6:.2f} MB of logs each; not the same {len(moved)}, changed indeed {len(right)}"
        )
        for robot in sorted({*moved, *(r for r, what in named.items() if what and night == "night2")}):
            what = named[robot] if night == "night2" else "nothing"
            print(f"  {robot}: {what} → {'; '.join(moved.get(robot, ['same']))}")


if __name__ == "__main__":
    main()
