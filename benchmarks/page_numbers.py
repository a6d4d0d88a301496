"""Put the numbers of the results' files into the pages: python benchmarks/page_numbers.py

page_numbers.toml lists sentences and rows of the pages, with a name in braces for each number, and
where this number is. `make results` runs this at its end. tests/test_docs.py compares, so that no
page keeps a number that was measured anew. The files are docs/results/real.json,
docs/results/paper_*.json, docs/results/unseen_*.json and benchmarks/steps.json.
"""

from __future__ import annotations

import json
import re
import sys
import tomllib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

ROOT = Path(__file__).parents[1]
RESULTS = ROOT / "docs" / "results"
STEPS = ROOT / "benchmarks" / "steps.json"
LIST = Path(__file__).with_suffix(".toml")
COMMIT = r"[0-9a-f]{8}(?!\w|\.\d)"
NUMBER = rf"{COMMIT}|[-+−]?\d+(?:[.,]\d+)*(?: ± \d+(?:\.\d+)?)?(?: of \d+)?(?: %)?"
PLACE = re.compile(r"\{(\w+)\}")


def sentences() -> list[dict[str, Any]]:
    """Return the entries of page_numbers.toml: pages, text, and the source of each name in
    braces.
    """
    found: list[dict[str, Any]] = tomllib.loads(LIST.read_text(encoding="utf-8"))["sentence"]
    return found


def value(source: str) -> str:
    """Return the number of a source as the pages write it.

    Args:
        source: one of the forms at the top of page_numbers.toml.

    Raises:
        LookupError: The file has no such number.
    """
    kind, *words = [word.strip() for word in source.split(";")]
    readers: dict[str, Callable[..., str]] = {
        "real": _real,
        "more": _more,
        "paper": _paper,
        "unseen": _unseen,
        "step": _step,
        "cell": _cell,
        "less": _less,
        "commit": _commit,
        "seconds": _seconds,
    }
    text = readers[kind](*words).replace("-", "−")
    if kind != "commit" and text.isdecimal():
        return f"{int(text):,}"
    return re.sub(r"^−(?=0\.0+\b)", "", text)  # no negative zero


def _real(question: str, method: str, field: str, form: str) -> str:
    return f"{_real_row(question, method)[field]:{form}}"


def _more(question: str, method: str) -> str:
    """Return the error beyond that of identification, mrad: mean over motions ± standard error."""
    errors = _real_row(question, method)["by_motion_mrad"]
    identified = _real_row(question, "identification")["by_motion_mrad"]
    more = np.array([errors[motion] - identified[motion] for motion in identified])
    return f"{more.mean():.1f} ± {more.std(ddof=1) / np.sqrt(len(more)):.1f}"


def _real_row(question: str, method: str) -> dict[str, Any]:
    result: dict[str, Any] = json.loads((RESULTS / "real.json").read_text(encoding="utf-8"))
    rows: list[dict[str, Any]] = result["rows"]
    for row in rows:
        if f"{row['set']}, {row['question']}" == question and row["method"] == method:
            return row
    raise LookupError(f"real.json: no row {question}, {method}")


def _paper(name: str, table: str, begin: str, column: str) -> str:
    found = json.loads((RESULTS / f"paper_{name}.json").read_text(encoding="utf-8"))["tables"][
        table
    ]
    for row in found["texts"]:
        if row[0].startswith(begin):
            return str(row[found["columns"].index(column)])
    raise LookupError(f"paper_{name}.json: {table} has no row {begin}")


def _unseen(name: str, method: str, column: str) -> str:
    """Return the mean over simulators, ± its standard error over simulators of the mean over
    seeds.
    """
    found = json.loads((RESULTS / f"unseen_{name}.json").read_text(encoding="utf-8"))
    by_simulator = np.array(found[method][column]).mean(axis=1)
    text = f"{by_simulator.mean():.2f}"
    if len(by_simulator) > 1:
        text += f" ± {by_simulator.std(ddof=1) / np.sqrt(len(by_simulator)):.2f}"
    return text


def _answer(step: str) -> dict[str, Any]:
    answers: dict[str, dict[str, Any]] = json.loads(STEPS.read_text(encoding="utf-8"))
    return answers[step]


def _commit(step: str) -> str:
    return str(_answer(step)["commit"])


def _seconds(step: str) -> str:
    return str(_answer(step)["seconds"])


def _step(name: str, pattern: str) -> str:
    printed = "\n".join(_answer(name)["output"])
    found = re.search(pattern, printed)
    if found is None:
        raise LookupError(f"steps.json: {name} printed nothing like {pattern}")
    return found[1]


def _cell(name: str, row: str, column: str, below: str = "") -> str:
    """Return a cell of a Markdown table that a step printed.

    Args:
        below: Beginnings of lines, one below the other, with " > " between them: the row is looked
            for below the last one.
    """
    columns: list[str] = []
    before: list[str] = []
    for line in _lines_below(name, below):
        cells = [cell.strip() for cell in line.strip("|").split("|")]
        if line.startswith("| ---"):
            columns = before  # the line above is the head of a table
        elif cells[0] == row and column in columns:
            return cells[columns.index(column)]
        before = cells
    raise LookupError(f"steps.json: {name} printed no row {row} with a column {column} {below}")


def _lines_below(name: str, below: str) -> list[str]:
    """Return what a step printed from the line `below` on; its head, if it is of a table, too."""
    lines: list[str] = _answer(name)["output"]
    for begin in below.split(" > "):
        while lines and not lines[0].startswith(begin):
            lines = lines[1:]
        if not lines:
            raise LookupError(f"steps.json: {name} printed no line that begins with {begin}")
    return lines


def _less(name: str, row: str, column: str) -> str:
    """Return a cell with a negative number for a sentence that says "less"."""
    return _cell(name, row, column).removeprefix("-")


def filled(page: str, sentence: dict[str, Any]) -> str:
    """Return the text of a page with the numbers of one sentence: wherever it is, or the first below
    `section` if it names one.

    Raises:
        LookupError: The page has no such sentence.
    """
    names = PLACE.findall(sentence["text"])
    parts = PLACE.split(sentence["text"])
    pattern = ""
    for i, part in enumerate(parts):
        is_name = i % 2 == 1
        pattern += f"({NUMBER})" if is_name else r"\s+".join(map(re.escape, part.split(" ")))
    numbers = [value(sentence[name]) for name in names]

    def with_numbers(found: re.Match[str]) -> str:
        text = found[0]
        for i in range(len(numbers), 0, -1):  # from the end: earlier places stay where they are
            begin, end = (place - found.start() for place in found.span(i))
            text = text[:begin] + numbers[i - 1] + text[end:]
        return text

    begin = page.index(sentence.get("section", ""))
    most = 1 if "section" in sentence else 0  # 0 is no limit
    new, count = re.subn(pattern, with_numbers, page[begin:], count=most)
    if count == 0:
        raise LookupError(f"no such sentence: {sentence['text']}")
    return page[:begin] + new


def main() -> int:
    """Write all pages."""
    for sentence in sentences():
        for name in sentence["pages"]:
            page = ROOT / name
            old = page.read_text(encoding="utf-8")
            new = filled(old, sentence)
            if new != old:
                page.write_text(new, encoding="utf-8")
                print(f"{name}: {sentence['text']}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
