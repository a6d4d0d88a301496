"""Proof that a worker killed with kill -9 changes no result: collect, gap and a study, on each executor.

    python benchmarks/kill_workers.py WORK [--executors local ray] [--only collect gap study] [--seed 0]

Collects a small VIRTUAL SO-101 set, pairs it and trains two cells of a study, undisturbed on local processes, then on
each executor with kill -9 of a worker in the middle of its job. Compared are hashes of the recordings and twins, hashes
of the cells' weights, tables and lists of files. Prints one JSON object; exits with 1 where anything differs, nothing
was killed, or a process of the command listens on more than loopback. Linux.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from kills import LIMIT_S, entries, names, result

from gaponet.data.store import Dataset

TRIALS = 5  # of a gap until a worker was met in it
SIGN = "GAPONET_PROOF"  # in the environment of a command and of all that it starts
RECIPE = """
motions = ["steps-*", "tour-all-*"]
payloads = [0.0, 0.2]
units = ["virtual-1", "virtual-2"]
variants = 6
repetitions = 3
"""


def collected(out: Path) -> Any:
    """Order and hashes of recordings, and the content of their twins."""
    twins = {f.name: hashlib.sha256(f.read_bytes()).hexdigest() for f in out.rglob("twins/**/*.parquet")}
    return [entries(out), twins]


def studied(out: Path) -> Any:
    """Rows and weights of a study."""
    cells = sorted((out / "rehearsal" / "cells").glob("*/cell.json"))
    return [result(out), {c.parent.name: json.loads(c.read_text())["weights"] for c in cells}]


def busiest(sign: str, command: int) -> int | None:
    """The process of a command, other than itself, that has just computed most; None where none is at work. One of Ray
    is named after what it does."""
    calling = set()

    def times() -> dict[int, int]:
        found = {}
        for place in Path("/proc").glob("[0-9]*"):
            try:
                if int(place.name) != command and f"{SIGN}={sign}".encode() in (place / "environ").read_bytes():
                    line = (place / "cmdline").read_bytes()
                    if b"spawn_main" in line or line.startswith(b"ray::_call"):
                        calling.update({int(place.name)} if line.startswith(b"ray") else ())
                        found[int(place.name)] = int((place / "stat").read_text().rpartition(")")[2].split()[11])
            except OSError:
                continue
        return found

    before = times()
    if calling:
        return min(calling)
    time.sleep(0.3)
    spent = {pid: used - before[pid] for pid, used in times().items() if pid in before}
    best = max(spent, key=spent.__getitem__, default=None)
    return best if best is not None and spent[best] >= 5 else None  # hundredths of a second


def playing(out: Path, sign: str, command: int) -> int | None:
    """A worker that is recording, once something was recorded."""
    journal = out / "sequences.jsonl"
    return busiest(sign, command) if journal.is_file() and journal.read_text() else None


def pairing(out: Path, sign: str, command: int) -> int | None:
    """A worker of Ray that replays: its process is named after its task."""
    found = busiest(sign, command)
    says = found is not None and Path(f"/proc/{found}/cmdline").read_bytes().startswith(b"ray")
    return found if says else None


def training(out: Path, sign: str, command: int) -> int | None:
    """The worker that holds a cell which has been validated at least once and is not done."""
    for curve in sorted(out.glob("rehearsal/cells/*/progress.jsonl")):
        holder = (curve.parent / ".gaponet").read_text().split()[1:2]
        if curve.read_text() and holder and not (curve.parent / "model" / "card.json").is_file():
            return int(holder[0])
    return None


def listening(sign: str) -> list[str]:
    """Addresses beyond loopback on which a process of the command listens."""
    found = []
    for line in subprocess.run(["ss", "-ltnpH"], capture_output=True, text=True).stdout.splitlines():
        for word in line.split("pid=")[1:]:
            try:
                ours = f"{SIGN}={sign}".encode() in Path("/proc", word.split(",")[0], "environ").read_bytes()
            except OSError:
                continue
            if ours and not line.split()[3].startswith(("127.", "[::1]", "[::ffff:127.")):
                found.append(line.split()[3])
    return found


def disturbed(
    argv: list[str], out: Path, victim: Callable[[Path, str, int], int | None], wait: float
) -> dict[str, Any]:
    """Carry a command out and kill one worker on the way, after so many seconds of work."""
    sign = f"{out.parent.name}-{out.name}-{os.getpid()}"
    told: dict[str, Any] = {"killed": 0, "listens": []}
    with open(out.with_suffix(".txt"), "w") as log:
        child = subprocess.Popen(
            [sys.executable, "-m", "gaponet", *argv], env=os.environ | {SIGN: sign}, stdout=log, stderr=log
        )
        began = time.monotonic()
        while child.poll() is None and time.monotonic() - began < LIMIT_S:
            worker = None if told["killed"] else victim(out, sign, child.pid)
            if worker is not None:
                time.sleep(wait)
                told["listens"] = listening(sign)
                try:
                    name = Path(f"/proc/{worker}/cmdline").read_bytes().replace(b"\0", b" ").decode().strip()
                    os.kill(worker, signal.SIGKILL)
                    told |= {"killed": 1, "victim": name[-70:], "after_s": round(time.monotonic() - began, 1)}
                except (ProcessLookupError, FileNotFoundError):
                    continue
            time.sleep(0.05)
        if child.poll() is None:
            child.kill()
        told["exit"] = child.wait()
    return told | {"whole_s": round(time.monotonic() - began, 1)}


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("work", type=Path)
    parser.add_argument("--executors", nargs="+", default=["local", "ray"])
    parser.add_argument("--only", nargs="+", default=["collect", "gap", "study"])
    parser.add_argument("--seed", type=int, default=0, help="of the moments")
    args = parser.parse_args()
    work, rng, found, wrong = args.work.resolve(), np.random.default_rng(args.seed), {}, []
    work.mkdir(parents=True, exist_ok=True)
    (work / "recipe.toml").write_text(RECIPE)
    data = work / "whole" / "collect"

    def command(name: str, out: Path, executor: str) -> list[str]:
        return {
            "collect": ["collect", "--robot", "so101", "--recipe", str(work / "recipe.toml"), "--out", str(out),
                        "--nproc", "2", "--executor", executor],
            "gap": ["gap", str(out), "--executor", executor],
            "study": ["experiment", "data", str(data), "--out", str(out), "--quick", "--models", "mlp", "--seeds", "2",
                      "--shares", "1.0", "--workers", "2", "--executor", executor],
        }[name]  # fmt: skip

    cases = {"collect": (collected, playing, 0.3), "gap": (collected, pairing, 0.0), "study": (studied, training, 0.2)}
    for executor in ("whole", *args.executors):
        (work / executor).mkdir(exist_ok=True)
        for name, (content, victim, wait) in cases.items():
            out = work / executor / name
            ready = out.with_suffix(".done")
            if executor == "whole" and ready.exists():
                continue
            if executor != "whole" and (name not in args.only or (name, executor) == ("gap", "local")):
                continue  # the latter: threads of the command itself
            shutil.rmtree(out, ignore_errors=True)
            if name == "gap":
                shutil.copytree(data, out, ignore=shutil.ignore_patterns("twins"))
            if executor == "whole":
                done = subprocess.run([sys.executable, "-m", "gaponet", *command(name, out, "local")])
                if done.returncode:
                    return 1
                ready.touch()
                continue
            for _ in range(TRIALS if name == "gap" else 1):
                for twins in out.glob("twins"):  # of a trial that was over before a worker was met
                    shutil.rmtree(twins)
                told = disturbed(command(name, out, executor), out, victim, rng.uniform(0, wait))
                if told["killed"]:
                    break
            told["same"] = not told["exit"] and content(out) == content(work / "whole" / name)
            found[f"{executor} {name}"] = told
            if not told["same"] or not told["killed"] or told["listens"] or names(out) != names(work / "whole" / name):
                wrong.append(f"{executor} {name}")
            print(f"{executor} {name}: {told}", file=sys.stderr, flush=True)
    hours = sum(e.rows * e.dt for e in Dataset(data).entries) / 3600
    print(json.dumps({"recordings_h": round(hours, 3), **found, "wrong": wrong}, indent=1))
    return int(bool(wrong))


if __name__ == "__main__":
    sys.exit(main())
