"""Proof that collecting survives being killed: ten kill -9 at random moments, then the datasets are compared.

    python benchmarks/kill_collect.py OUT [--kills 10] [--recipe small] [--seed 0]

Collects the recipe once undisturbed into OUT/whole, then into OUT/killed with a kill -9 of the collecting process after
a random time, again and again, and finishes it. Prints one JSON object; exits with 1 if anything differs.
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

import numpy as np

from gaponet.data.store import Dataset


def collect(recipe: str, out: Path) -> subprocess.Popen[bytes]:
    command = [sys.executable, "-m", "gaponet.cli.main", "collect", "--recipe", recipe, "--out", str(out), "--json"]
    with out.with_name("collect.log").open("a") as log:
        return subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=log)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("out", type=Path)
    parser.add_argument("--kills", type=int, default=10)
    parser.add_argument("--recipe", default="small", help="one of a dozen parts, or it is done too early")
    parser.add_argument("--seed", type=int, default=0, help="of the moments")
    args = parser.parse_args()
    args.out.mkdir(parents=True, exist_ok=False)
    start = time.monotonic()
    collect(args.recipe, args.out / "whole").wait()
    duration = time.monotonic() - start
    rng = np.random.default_rng(args.seed)
    journal, kills = args.out / "killed" / "sequences.jsonl", []
    while len(kills) < args.kills:
        child = collect(args.recipe, args.out / "killed")
        before = count(journal)
        time.sleep(rng.uniform(0.0, 1.5 * duration / args.kills))
        if rng.random() < 0.5:  # half of the kills fall while sequences are being written
            until, enough = time.monotonic() + duration, before + rng.integers(1, 40)
            while count(journal) < enough and child.poll() is None and time.monotonic() < until:
                time.sleep(0.001)
            time.sleep(rng.uniform(0.0, 0.03))
        if child.poll() is not None:  # it was done before its moment came, or it failed
            if child.returncode:
                print(f"collect ended with {child.returncode}; see {args.out / 'collect.log'}", file=sys.stderr)
                return 1
            break
        os.kill(child.pid, signal.SIGKILL)
        child.wait()
        kills.append(count(journal))
    collect(args.recipe, args.out / "killed").wait()
    whole, killed = ({e.id: e.hash for e in Dataset(args.out / name).entries} for name in ("whole", "killed"))
    files = list((args.out / "killed" / "sequences").iterdir())
    result = {
        "sequences": len(whole),
        "kills": len(kills),
        "listed_after_each_kill": kills,
        "same_order_and_hashes": list(whole.items()) == list(killed.items()),
        "stray_files": len(files) - len(killed),
    }
    print(json.dumps(result))
    sound = len(kills) == args.kills and result["same_order_and_hashes"] and not result["stray_files"]
    return 0 if sound else 1


def count(journal: Path) -> int:
    return journal.read_bytes().count(b"\n") if journal.is_file() else 0


if __name__ == "__main__":
    sys.exit(main())
