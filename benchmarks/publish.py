"""What the benchmarks behind docs/results have in common: their progress, and where results go."""

from __future__ import annotations

import shutil
import sys
from dataclasses import replace
from pathlib import Path

from gaponet_lab.study.page import write
from gaponet_lab.study.pool import Running
from gaponet_lab.study.result import Result

DOCS = Path(__file__).parents[1] / "docs" / "results"


def say(running: Running, done: int) -> None:
    """A line of what is running now."""
    now = "; ".join(f"{name} {share:.0%} {note}" for name, (share, note) in running.items())
    print(f"\r{done} done; {now}"[:150].ljust(150), end="", file=sys.stderr, flush=True)


def publish(result: Result, work: Path, docs: Path = DOCS) -> None:
    """Write the result to work, copy all but the report to docs/results, and print it."""
    command = f"python benchmarks/{Path(sys.argv[0]).name} {' '.join(a for a in sys.argv[1:] if '/' not in a)}".strip()
    result = replace(result, facts=dict(result.facts) | {"command": command})
    docs.mkdir(parents=True, exist_ok=True)
    for file in write(result, work):
        if file.name != "report.html":
            shutil.copy(file, docs / file.name)
    print((work / f"{result.name}.md").read_text(encoding="utf-8"))
