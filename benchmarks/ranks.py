"""Two processes of torchrun beside one: ranks killed, frozen or orphaned at random moments; validation and speed.

    python benchmarks/ranks.py WORK [--kills 6] [--seeds 3] [--only kills,seeds,speed] [--seed 0]

On the VIRTUAL SO-101 set of benchmarks/kills.py. `kills` starts again what was killed and compares its end with
a run that was not. A frozen rank is missed after 25 s (120 where it had not begun), and torchrun gives it 30 s more.
`seeds` trains with one process on two threads and with two processes on one each, in turns: the same options, so the
same total batch. `speed` does so with the default recipe, half of the steps PPO's, for a machine that is otherwise
idle. Prints one JSON object; exits with 1 where a run differs, a rank lives on, or a step budget is not met.
"""

from __future__ import annotations

import argparse
import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
from kills import prepare, trained

TINY = ["--model.history", "2", "--model.sensors", "off", "--warm-start.num-envs", "16", "--warm-start.steps", "40",
        "--warm-start.rounds", "3", "--warm-start.gradient-steps", "40", "--warm-start.batch-size", "128",
        "--ppo.num-envs", "16", "--ppo.num-steps", "16", "--validate-every", "2"]  # fmt: skip
SMALL = ["--model.history", "2", "--model.sensors", "off", "--warm-start.num-envs", "64", "--warm-start.steps", "50",
         "--warm-start.rounds", "2", "--warm-start.gradient-steps", "100", "--warm-start.batch-size", "256",
         "--ppo.num-envs", "64", "--ppo.num-steps", "16", "--ppo.epochs", "2", "--ppo.explained", "0.2"]  # fmt: skip
USUAL = ["--warm-start.rounds", "3", "--ppo.explained", "-1000000"]
TORCHRUN = [sys.executable, "-m", "torch.distributed.run", "--standalone", "--nproc-per-node", "2", "-m"]
MINUTE = 60.0
LIMITS = {"rank frozen": 160.0}  # s; before its first sign of life it is waited for two minutes
KINDS = ("rank killed", "rank frozen", "rank killed", "torchrun killed")


def command(data: Path, out: Path, steps: int, options: list[str], ranks: int) -> list[str]:
    resume = ["--resume"] if (out / "checkpoint.pt").is_file() else []
    words = ["gaponet", "train", str(data), "--out", str(out), "--budget", str(steps), *resume, *options]
    return [*(TORCHRUN if ranks > 1 else [sys.executable, "-m"]), *words]


def ranks_of(mark: str) -> list[int]:
    """Ranks that still run, of a torchrun that was started with TRIAL=mark; each is in a session of its own."""
    found = []
    for process in Path("/proc").glob("[0-9]*"):
        try:
            said = (process / "environ").read_bytes().split(b"\0")
            state = (process / "stat").read_text().rpartition(")")[2].split()[0]
        except OSError:  # it has ended meanwhile
            continue
        if f"TRIAL={mark}".encode() in said and any(x.startswith(b"RANK=") for x in said) and state != "Z":
            found.append(int(process.name))
    return sorted(found)


def adversity(data: Path, work: Path, wanted: int, rng: np.random.Generator) -> dict[str, Any]:
    """Kill a rank, freeze one, kill torchrun itself, in turns; go on each time, and compare in the end."""
    wrong, lasted = list[str](), dict[str, list[float]]()
    work.mkdir()
    log = (work / "log.txt").open("a")

    def start(out: Path, mark: str) -> subprocess.Popen[bytes]:
        environment = os.environ | {"TRIAL": mark}
        return subprocess.Popen(command(data, out, 4000, TINY, 2), stdout=log, stderr=log, env=environment)

    began, whole = time.monotonic(), work / "whole"
    if start(whole, f"{work}-whole").wait():
        raise SystemExit(f"the undisturbed training failed; see {log.name}")
    quickest, done, starts, ended, whole_again = time.monotonic() - began, 0, 0, 0, False
    while done < wanted or not whole_again:
        starts += 1
        out, mark = work / f"killed-{ended}", f"{work}-{starts}"
        process, begun = start(out, mark), time.monotonic()
        time.sleep(rng.uniform(0.2, 0.9) * quickest * (done < wanted))
        there = ranks_of(mark) if done < wanted else []
        if len(there) < 2:  # left alone, or too early, or too late
            if process.wait() or trained(out) != trained(whole):
                wrong.append(f"{out} is not what the undisturbed training leaves")
            ended, whole_again, quickest = ended + 1, True, min(quickest, time.monotonic() - begun)
            continue
        kind, begun = KINDS[done % len(KINDS)], time.monotonic()
        victim = process.pid if kind == "torchrun killed" else int(rng.choice(there))
        os.kill(victim, signal.SIGSTOP if kind == "rank frozen" else signal.SIGKILL)
        while ((left := ranks_of(mark)) or process.poll() is None) and time.monotonic() - begun < 3 * MINUTE:
            time.sleep(0.1)
        lasted.setdefault(kind, []).append(round(time.monotonic() - begun, 1))
        if lasted[kind][-1] > LIMITS.get(kind, MINUTE):
            wrong.append(f"{kind}: all ended after {lasted[kind][-1]} s, or {left} never did")
        for each in left:
            os.kill(each, signal.SIGKILL)
        process.wait()
        done, whole_again = done + 1, False
        print(kind, lasted[kind][-1], file=sys.stderr, flush=True)
    return {
        "quickest_s": round(quickest, 1),
        "started": starts,
        "compared": ended,
        "ended_after_s": lasted,
        "wrong": wrong,
    }


def compared(data: Path, work: Path, seeds: int, steps: int, recipe: list[str]) -> dict[str, Any]:
    """Validation error, wall time of training and CPU time of everything, by number of processes."""
    rows = []
    for seed in range(seeds):
        for ranks in (1, 2) if seed % 2 == 0 else (2, 1):
            out = work / f"{ranks}-{seed}"
            options = [*recipe, "--seed", str(seed), "--threads", str(3 - ranks)]
            with (work / f"{ranks}-{seed}.txt").open("w") as log:
                before = os.times()
                subprocess.run(command(data, out, steps, options, ranks), stdout=log, stderr=log, check=True)
                after = os.times()
            card = json.loads((out / "model" / "card.json").read_text())
            used = after.children_user + after.children_system - before.children_user - before.children_system
            rows.append({
                "processes": ranks, "seed": seed, "steps": card["steps"], "val_mrad": 1e3 * card["val_mpjae"]["model"],
                "nominal_mrad": 1e3 * card["val_mpjae"]["nominal"], "seconds": card["seconds"], "cpu_s": round(used, 1),
                "load": os.getloadavg()[0],
            })  # fmt: skip
            print(rows[-1], file=sys.stderr, flush=True)
    wrong = ["the step budget is not met"] if {row["steps"] for row in rows} != {steps} else []
    return {"rows": rows, "wrong": wrong}


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("work", type=Path)
    parser.add_argument("--kills", type=int, default=6)
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--steps", type=int, default=16640, help="of each training over seeds")
    parser.add_argument("--only", default="kills,seeds")
    parser.add_argument("--seed", type=int, default=0, help="of the moments")
    args = parser.parse_args()
    work, found = args.work.resolve(), {}
    if not (work / "input").is_dir():
        prepare(work / "input")
    data = work / "input" / "data"
    if "kills" in args.only:
        found["kills"] = adversity(data, work / "kills", args.kills, np.random.default_rng(args.seed))
    if "seeds" in args.only:
        (work / "seeds").mkdir()
        found["seeds"] = compared(data, work / "seeds", args.seeds, args.steps, SMALL)
    if "speed" in args.only:
        (work / "speed").mkdir()
        found["speed"] = compared(data, work / "speed", args.seeds, 462848, USUAL)
    print(json.dumps(found))
    return int(any(part["wrong"] for part in found.values()))


if __name__ == "__main__":
    sys.exit(main())
