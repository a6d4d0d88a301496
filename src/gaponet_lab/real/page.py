"""The benchmark's table, figure and JSON."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from gaponet.files import write_text
from gaponet.spread import Spread
from gaponet_lab.plot.charts import dots
from gaponet_lab.plot.style import save

COLUMNS = (
    "set",
    "question",
    "method",
    "mrad",
    "of nominal",
    "less than nominal, mrad",
    "floor",
    "motions",
    "recordings",
)
NAME = "bench_real"


def table(rows: list[dict[str, Any]]) -> list[list[str]]:
    """Cells; ± is the standard error over independent motions, of differences paired."""
    return [
        [r["set"], r["question"], r["method"], _pm(r["mrad"], r["standard_error"]), f"{r['of_nominal']:.2f}",
         "" if i == 0 or not r["less_than_nominal"] else _pm(r["less_than_nominal"], r["less_standard_error"]),
         "–" if r["floor_mrad"] is None else f"{r['floor_mrad']:.1f}", str(r["motions"]), str(r["recordings"])]
        for i, r in enumerate(rows)
    ]  # fmt: skip


def _pm(value: float, error: float | None) -> str:
    return f"{value:.2f}" + (f" ± {error:.2f}" if error is not None else "")


def write_page(found: dict[str, Any], out: Path) -> list[Path]:
    """JSON, Markdown and figure in a folder."""
    out.mkdir(parents=True, exist_ok=True)
    rows = found["rows"]
    write_text(out / f"{NAME}.json", json.dumps(found, indent=1, ensure_ascii=False) + "\n")
    lines = ["| " + " | ".join(COLUMNS) + " |", "| --- | --- | --- | ---: | ---: | ---: | ---: | ---: | ---: |"]
    lines += ["| " + " | ".join(cells) + " |" for cells in table(rows)]
    write_text(out / f"{NAME}.md", "\n".join(lines) + "\n")
    shown = [
        (f"{r['set']}: {r['question']}", r["method"], Spread(r["of_nominal"], float("nan"), 1),
         r["method"].startswith("nominal"))
        for r in rows
    ]  # fmt: skip
    figures = save(dots(shown, "error, of the nominal simulator's", "Real robots"), out / NAME) if shown else []
    return [out / f"{NAME}.md", out / f"{NAME}.json", *figures]
