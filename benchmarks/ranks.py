"""Training on two processes of torchrun, its ranks killed, frozen or orphaned at random: docs/results/speed.md.

    python benchmarks/ranks.py WORK [--kills 6] [--seed 0]

Uses the VIRTUAL SO-101 dataset of benchmarks/kills.py. Each interrupted training is resumed; its end must equal that of
an undisturbed training. A frozen rank is detected after 25 s (120 s before its first sign of life); torchrun then
gives it another 30 s. Prints one JSON object; exits with 1 if a training differs or a rank lives on.
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
from kills import TRAIN, prepare, trained

TORCHRUN = [
    sys.executable,
    "-m",
    "torch.distributed.run",
    "--standalone",
    "--nproc-per-node",
    "2",
    "-m",
]
MINUTE = 60.0
LIMITS = {"rank frozen": 160.0}  # s; before its first sign of life it is waited for two minutes
KINDS = ("rank killed", "rank frozen", "rank killed", "torchrun killed")


def command(data: Path, out: Path, steps: int, options: list[str], ranks: int) -> list[str]:
    resume = ["--resume"] if (out / "checkpoint.pt").is_file() else []
    words = [
        "gaponet",
        "train",
        str(data),
        "--out",
        str(out),
        "--budget",
        str(steps),
        *resume,
        *options,
    ]
    return [*(TORCHRUN if ranks > 1 else [sys.executable, "-m"]), *words]


def ranks_of(mark: str) -> list[int]:
    """Return the running ranks of the torchrun that was started with TRIAL=mark; each has a session of its own."""
    found = []
    for process in Path("/proc").glob("[0-9]*"):
        try:
            said = (process / "environ").read_bytes().split(b"\0")
            state = (process / "stat").read_text().rpartition(")")[2].split()[0]
        except OSError:  # it has ended meanwhile
            continue
        if (
            f"TRIAL={mark}".encode() in said
            and any(x.startswith(b"RANK=") for x in said)
            and state != "Z"
        ):
            found.append(int(process.name))
    return sorted(found)


def adversity(data: Path, work: Path, wanted: int, rng: np.random.Generator) -> dict[str, Any]:
    """Kill a rank, freeze one and kill torchrun in turns; resume each time and compare the end."""
    wrong, lasted = list[str](), dict[str, list[float]]()
    work.mkdir()
    log = (work / "log.txt").open("a")

    def start(out: Path, mark: str) -> subprocess.Popen[bytes]:
        environment = os.environ | {"TRIAL": mark}
        return subprocess.Popen(
            command(data, out, 4000, TRAIN, 2), stdout=log, stderr=log, env=environment
        )

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
        while (
            (left := ranks_of(mark)) or process.poll() is None
        ) and time.monotonic() - begun < 3 * MINUTE:
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


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("work", type=Path)
    parser.add_argument("--kills", type=int, default=6)
    parser.add_argument("--seed", type=int, default=0, help="of the moments")
    args = parser.parse_args()
    work = args.work.resolve()
    if not (work / "input").is_dir():
        prepare(work / "input")
    found = adversity(
        work / "input" / "data", work / "kills", args.kills, np.random.default_rng(args.seed)
    )
    print(json.dumps(found))
    return int(bool(found["wrong"]))


if __name__ == "__main__":
    sys.exit(main())
