"""Validation error of training runs against control steps, as one figure.

    python benchmarks/learning_curves.py RUN [RUN …] --out docs/assets/paper_ppo

Each run's progress.jsonl is drawn under the name of its folder. Writes OUT.svg and OUT.png.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path

from matplotlib.figure import Figure

from gaponet.nn.training.checkpoint import PROGRESS
from gaponet.report.figures.style import figure, legend, save, styled

COLOURS = ("#c8102e", "#d99000", "#8e1b3a", "#3b7dd8", "#2a9d6f", "#7a8fe0")
TICKS = (0.1, 0.3, 1, 3, 10)  # millions


@styled
def curves(runs: list[Path]) -> Figure:
    """Draw all curves into one pair of axes."""
    fig = figure(5.2, 3.2)
    ax = fig.subplots()
    nominal = 0.0
    for run, colour in zip(runs, COLOURS, strict=False):
        rows = [json.loads(line) for line in (run / PROGRESS).read_text(encoding="utf-8").splitlines()]
        rows = [row for row in rows if row["steps"] and "val_mpjae" in row]
        nominal = rows[0]["nominal_mpjae"] * 1e3
        x, y = [row["steps"] / 1e6 for row in rows], [row["val_mpjae"] * 1e3 for row in rows]
        ax.plot(x, y, color=colour, lw=1.2, label=run.name.replace("_", " "))
    ax.axhline(nominal, color="#8c8c8c", ls="--", lw=1, label="nominal simulator")
    ax.set_xscale("log")
    ax.minorticks_off()
    ax.set_xticks(TICKS, [f"{t:g}" for t in TICKS])
    ax.set_ylim(bottom=0)
    ax.set_xlabel("control steps, millions")
    ax.set_ylabel("validation error, mrad")
    legend(fig)
    return fig


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("runs", type=Path, nargs="+")
    parser.add_argument("--out", type=Path, required=True)
    given = parser.parse_args()
    save(curves(given.runs), given.out)
