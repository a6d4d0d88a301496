"""Draw bars of the numbers in tables of the pages: python benchmarks/page_charts.py

A chart takes its numbers from the table beside it, so it cannot say anything else;
tests/test_docs.py compares.
"""

from __future__ import annotations

import re
import sys
from dataclasses import dataclass
from pathlib import Path

from gaponet.evaluation.methods import colour

DOCS = Path(__file__).parents[1] / "docs"
LEFT, WIDTH, BAR_WIDTH = 262, 700, 370  # pixels: where bars begin, picture, longest bar
TOP, PITCH, THICK = 48, 32, 22  # pixels: first bar, from bar to bar, a bar
MIN_INSIDE = 130  # pixels of a bar that has its number inside
NUMBER = re.compile(r"\d+(?:\.\d+)?")


@dataclass(frozen=True)
class Chart:
    """Bars of one column of a table."""

    picture: str  # below docs/
    page: str  # below docs/
    title: str
    column: int  # of the table, counted from 0
    bars: tuple[tuple[str, str, str], ...]  # first cell of the row, label, method of its colour
    line: float | None = None  # value at which a dashed line stands

    def values(self) -> list[float]:
        """Return the number of each bar.

        Raises:
            LookupError: The page has no such row.
        """
        found = []
        text = (DOCS / self.page).read_text(encoding="utf-8")
        for row, _, _ in self.bars:
            line = re.search(rf"^\| {re.escape(row)} \|.*$", text, re.MULTILINE)
            if line is None:
                raise LookupError(f"{self.page}: no row {row}")
            cell = line[0].split("|")[1 + self.column]
            number = NUMBER.search(cell)
            if number is None:
                raise LookupError(f"{self.page}: no number in {line[0]}")
            found.append(float(number[0]))
        return found

    def svg(self) -> str:
        """Return the picture."""
        height = TOP + PITCH * len(self.bars) + 12
        values = self.values()
        longest = max([*values, self.line or 0.0])
        lines = [
            f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {WIDTH} {height}" '
            f'width="{WIDTH}" height="{height}" role="img" aria-labelledby="t" '
            "font-family=\"Helvetica, Arial, 'Liberation Sans', sans-serif\" "
            'font-size="14" fill="#111111">',
            f'<title id="t">{self.title}</title>',
            f'<rect x="0.5" y="0.5" width="{WIDTH - 1}" height="{height - 1}" rx="8" '
            'fill="#ffffff" stroke="#cccccc"/>',
            f'<text x="20" y="30" font-weight="bold">{self.title}</text>',
        ]
        for i, ((_, label, method), value) in enumerate(zip(self.bars, values, strict=True)):
            lines += _bar(TOP + PITCH * i, label, colour(method), value, value / longest)
        if self.line is not None:
            x = LEFT + BAR_WIDTH * self.line / longest
            lines.append(
                f'<path d="M{x:.1f} 44 V{height - 12}" stroke="#333333" '
                'stroke-dasharray="4 3" fill="none"/>'
            )
        return "\n".join([*lines, "</svg>"]) + "\n"


def _bar(y: int, label: str, fill: str, value: float, share: float) -> list[str]:
    width = BAR_WIDTH * share
    inside = width >= MIN_INSIDE
    x = LEFT + width + (-8 if inside else 8)
    look = ' text-anchor="end" fill="#ffffff" font-weight="bold"' if inside else ""
    shown = f"{value:.2f}" if value < 1 else f"{value:g}"
    return [
        f'<text x="{LEFT - 10}" y="{y + 16}" text-anchor="end">{label}</text>',
        f'<rect x="{LEFT}" y="{y}" width="{width:.1f}" height="{THICK}" fill="{fill}"/>',
        f'<text x="{x:.1f}" y="{y + 16}"{look}>{shown}</text>',
    ]


CHARTS = (
    Chart(
        "assets/policies.svg",
        "results/policies.md",
        "VIRTUAL SO-101: tracking error of the policy, mrad",
        2,
        (
            (
                "no policy: the motion is sent as the target",
                "no policy, motion as target",
                "target",
            ),
            ("nominal", "trained in nominal", "nominal"),
            (
                "sixteen exported units of it (`export --to randomization`)",
                "trained in exported units",
                "identified",
            ),
            ("**identified**", "trained in identified", "identified"),
        ),
    ),
    Chart(
        "assets/finetuned.svg",
        "results/policies.md",
        "Eight VIRTUAL H1-2 with 3 kg: tracking error of the policy, mrad",
        2,
        (
            ("no policy: the motion as it is", "no policy, motion as target", "target"),
            ("the nominal simulator", "trained further in nominal", "nominal"),
            ("the identified simulator", "trained further in identified", "identified"),
            (
                "**the aligned simulator, with GAPONet**",
                "trained further in aligned, GAPONet",
                "gaponet",
            ),
        ),
    ),
    Chart(
        "assets/simulators.svg",
        "simulators.md",
        "Error in twenty unseen simulators, over that of the uncorrected simulator (1 = no help)",
        2,
        (
            ("MLP, one simulator", "MLP, one simulator", "shared_mlp"),
            ("GAPONet, one simulator", "GAPONet, one simulator", "gaponet"),
            ("MLP, many simulators", "MLP, many simulators", "shared_mlp"),
            (
                "GAPONet, many simulators, answers as branch input",
                "GAPONet, many simulators, told",
                "gaponet",
            ),
            (
                "MLP, many simulators, told the answers",
                "MLP, many simulators, told",
                "shared_mlp",
            ),
            ("GAPONet, one simulator, exact transfer", "GAPONet, exact transfer", "transfer"),
            ("the identified robot, for comparison", "identified robot", "identified"),
        ),
        line=1.0,
    ),
)


def main() -> int:
    """Write all charts."""
    for chart in CHARTS:
        (DOCS / chart.picture).write_text(chart.svg(), encoding="utf-8")
        print(chart.picture)
    return 0


if __name__ == "__main__":
    sys.exit(main())
