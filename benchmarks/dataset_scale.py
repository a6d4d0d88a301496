"""Is a dataset of the paper's size still quick? 11,198 synthetic sequences, 28.46 h of 27 joints, seven channels.

    python benchmarks/dataset_scale.py WORK [--sequences 11198] [--hours 28.46]

Writes the dataset into WORK/data once (about 6 GB; samples are noise around sines, of no other use), then measures each
number in a fresh process: opening, reading a sequence at random, peak resident memory. Prints one JSON
object. Delete WORK afterwards.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np

from gaponet.data.sequence import ARRAYS, Sequence, SequenceMeta
from gaponet.data.store import Dataset
from gaponet.robot import load_robot


def generate(path: Path, sequences: int, hours: float) -> None:
    """Motions × 4 payloads × 3 units × 2 rates, of about equal length."""
    robot = load_robot("h1_2")
    dataset, n = Dataset.create(path, robot), len(robot.joint_names)
    rng, seconds, start = np.random.default_rng(0), hours * 3600 / sequences, time.monotonic()
    for i in range(len(dataset), sequences):
        dt = 0.02 if i % 2 else 0.01
        rows = round(seconds / dt)
        t = np.arange(rows)[:, None] * dt
        ctrl = 0.4 * np.sin(2 * np.pi * rng.uniform(0.1, 1, n) * t + rng.uniform(0, 6, n))
        arrays = {name: ctrl + 0.01 * rng.standard_normal((rows, n), np.float32) for name in ARRAYS}
        meta = SequenceMeta(
            robot.name, f"synthetic-{i // 8 % 3}", f"motion{i // 24}", float(i // 2 % 4), virtual=True,
            notes={"rate_hz": 1 / dt, "seed": i},
        )  # fmt: skip
        dataset.append(Sequence(meta, robot.joint_names, dt, **arrays))
        if i % 500 == 0:
            print(f"{i} of {sequences}, {time.monotonic() - start:.0f} s", file=sys.stderr, flush=True)


def opening(path: Path) -> dict[str, Any]:
    """Seconds to open, at best of three (files in the system's cache)."""
    taken = []
    for _ in range(3):
        start = time.perf_counter()
        dataset = Dataset(path)
        taken.append(time.perf_counter() - start)
    return {
        "open_s": min(taken), "sequences": len(dataset), "hours": dataset.hours(),
        "frames": sum(e.rows for e in dataset.entries),
    }  # fmt: skip


def reading(path: Path) -> dict[str, Any]:
    """Milliseconds to read all channels of a sequence drawn at random."""
    dataset, rng, taken = Dataset(path), np.random.default_rng(1), []
    for i in rng.integers(len(dataset), size=400):
        start = time.perf_counter()
        dataset.read(dataset.entries[i])
        taken.append((time.perf_counter() - start) * 1e3)
    return {"sequence_ms": float(np.median(taken)), "sequence_p95_ms": float(np.percentile(taken, 95))}


def memory() -> dict[str, float]:
    """Peak of this process, GiB, and its parts at the end: file pages, shared with the system's cache, and its own."""
    lines = dict(line.split(":", 1) for line in Path("/proc/self/status").read_text().splitlines())
    names = {"peak_rss_gib": "VmHWM", "rss_file_gib": "RssFile", "rss_anon_gib": "RssAnon"}
    return {ours: int(lines[theirs].split()[0]) / 2**20 for ours, theirs in names.items()}


MEASUREMENTS = {"opening": opening, "reading": reading}


def measure(work: Path) -> dict[str, Any]:
    """Every measurement in a process of its own."""
    out = {}
    for name in MEASUREMENTS:
        command = [sys.executable, __file__, str(work), "--only", name]
        out[name] = json.loads(subprocess.run(command, check=True, stdout=subprocess.PIPE, text=True).stdout)
        print(name, out[name], file=sys.stderr, flush=True)
    return out


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("work", type=Path)
    parser.add_argument("--sequences", type=int, default=11198)
    parser.add_argument("--hours", type=float, default=28.46)
    parser.add_argument("--only", choices=tuple(MEASUREMENTS), help="one measurement, in this process")
    args = parser.parse_args()
    if args.only:
        print(json.dumps(MEASUREMENTS[args.only](args.work / "data") | memory()))
    else:
        generate(args.work / "data", args.sequences, args.hours)
        print(json.dumps(measure(args.work), indent=1))
