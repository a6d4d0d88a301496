"""make fuzz: mutants over all targets, their counts as JSON; exit code 1 where one failed.

python -m fuzzing [--mutants 100000] [--only sage,table] [--seed 0] [--workers 2] [--keep FOLDER]
python -m fuzzing --replay FOLDER/KIND-TARGET-NUMBER     # reads again what --keep stored there
"""

from __future__ import annotations

import argparse
import json
import shutil
import sys
import tempfile
import time
from collections import Counter
from dataclasses import asdict
from pathlib import Path
from typing import TextIO

from fuzzing import readers, structures
from fuzzing.harness import WHY, AbsurdError, Failure, run
from gaponet.base.errors import GAPONetError

GROUPS = {"readers": readers.TARGETS, "structures": structures.TARGETS}


class Counted:
    """Shows how many mutants were tried: on a terminal in place, in a pipe a line every ten
    seconds.
    """

    def __init__(self, stream: TextIO) -> None:
        self.stream = stream
        self.next_line = 0.0

    def show(self, done: int, failed: int) -> None:
        text = f"{done} done, {failed} failed"
        if self.stream.isatty():
            print(f"\r{text}", end="", file=self.stream, flush=True)
        elif time.monotonic() >= self.next_line:
            print(text, file=self.stream, flush=True)
            self.next_line = time.monotonic() + 10.0


def grouped(failures: list[Failure]) -> list[tuple[str, int, Failure]]:
    """(what, how often, the first of them), most frequent first."""

    def what(failure: Failure) -> str:
        lines = failure.text.strip().splitlines() or [""]
        return f"{failure.target} {failure.kind}: {lines[-1][:150]}"

    counts = Counter(map(what, failures))
    first = {what(f): f for f in reversed(failures)}
    return [(text, count, first[text]) for text, count in counts.most_common()]


def replay(case: Path) -> int:
    """Read the stored files of a mutant again; return 1 where they still fail.

    A traceback is raised as it is.
    """
    name = case.name.partition("-")[2].rpartition("-")[0]
    target = next(t for group in GROUPS.values() for t in group if t.name == name)
    with tempfile.TemporaryDirectory() as place:
        source = shutil.copytree(
            case, Path(place) / "in", symlinks=True, ignore=shutil.ignore_patterns(WHY)
        )
        try:
            target.use(source, Path(place) / "out")
        except GAPONetError as error:
            print(f"refused: {error}")
            return 0
        except AbsurdError as error:
            print(f"absurd: {error}")
            return 1
    print("taken")
    return 0


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--mutants", type=int, default=100_000)
    parser.add_argument("--only", help="targets or groups of them, with commas between")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--keep", type=Path, help="folder for the files of failed mutants")
    parser.add_argument("--replay", type=Path, help="a folder in that folder: read its files again")
    args = parser.parse_args()
    if args.replay:
        return replay(args.replay)
    known = {t.name: (t,) for group in GROUPS.values() for t in group} | GROUPS
    chosen = [t for name in (args.only or ",".join(GROUPS)).split(",") for t in known[name]]
    counter = Counted(sys.stderr)
    result = run(chosen, args.mutants, args.seed, args.workers, args.keep, counter.show)
    for text, count, failure in grouped(result.failures):
        print(
            f"{count:6d}  {text}\n        first: {failure.target} {failure.number}", file=sys.stderr
        )
    kinds = Counter(f.kind for f in result.failures)
    numbers = asdict(result) | {
        "failures": dict(kinds),
        "per_second": round(result.mutants / result.seconds, 1),
    }
    print(json.dumps(numbers | {"seed": args.seed}))
    return 1 if result.failures else 0


if __name__ == "__main__":
    sys.exit(main())
