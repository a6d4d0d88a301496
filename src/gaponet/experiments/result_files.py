"""Files of an experiment's result.

    NAME.md            for people            NAME.json   all numbers
    NAME[-TABLE].csv   one per table         NAME[-FIGURE].svg, .png
    report.html        one offline page over all results of the folder

The first table and the first figure are NAME.csv and NAME.svg; the others carry their own names.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

from markupsafe import Markup
from typing_extensions import TypedDict

from gaponet.base.errors import DatasetError
from gaponet.base.files import lock_folder, write_json, write_text
from gaponet.base.structure import Json, Name, read_json, validated
from gaponet.base.text import escape_markdown
from gaponet.experiments.result import Result, fact_rows
from gaponet.report.figures.style import save
from gaponet.report.page import inline_image, render

FORMAT = "gaponet experiment 1"
KIND = "experiments"


class TableRecord(TypedDict):
    """A table of a result's .json; texts are for people, rows are the exact numbers."""

    name: str
    caption: str
    columns: list[str]
    rows: list[list[Json]]
    texts: list[list[str]]


class Record(TypedDict):
    """A result's .json; figures: name → file without suffix."""

    format: str
    name: Name
    title: str
    virtual: str
    facts: dict[str, Json]
    sentences: list[str]
    tables: list[TableRecord]
    figures: dict[str, Name]


def write(result: Result, folder: Path) -> list[Path]:
    """Write NAME.md, .json, .csv, .svg and .png and renew report.html; each file whole or not at all.

    Returns:
        All files written, the report last.

    Raises:
        FolderError: The folder belongs to something else, or another process writes into it.
    """
    with lock_folder(folder, KIND):
        files: list[Path] = []
        for table, stem in zip(
            result.tables, _stems(result.name, [t.name for t in result.tables]), strict=True
        ):
            files.append(folder / f"{stem}.csv")
            write_text(files[-1], table.csv())
        stems = _stems(result.name, list(result.figures))
        for figure, stem in zip(result.figures.values(), stems, strict=True):
            files += save(figure, folder / f"{stem}.svg")
        files += [folder / f"{result.name}.md", folder / f"{result.name}.json"]
        write_text(files[-2], _markdown(result, stems))
        record = {
            "format": FORMAT, "name": result.name, "title": result.title, "virtual": result.virtual,
            "facts": dict(result.facts), "sentences": list(result.sentences),
            "tables": [t.record() for t in result.tables if t.shown],
            "figures": dict(zip(result.figures, stems, strict=True)),
        }  # fmt: skip
        write_json(files[-1], record)
        return [*files, write_report(folder)]


def _stems(name: str, parts: list[str]) -> list[str]:
    """Return file names without suffix: NAME, then NAME-PART."""
    return [name if i == 0 else f"{name}-{part}" for i, part in enumerate(parts)]


def _markdown(result: Result, stems: list[str]) -> str:
    parts = [f"# {escape_markdown(result.title)}", f"**{escape_markdown(result.virtual)}**"]
    if result.sentences:
        parts.append("\n".join(f"- {escape_markdown(s)}" for s in result.sentences))
    parts += [t.markdown() for t in result.tables if t.shown]
    parts += [f"![]({stem}.svg)" for stem in stems]
    parts.append(
        "\n".join(
            f"- {escape_markdown(key)}: {escape_markdown(value)}"
            for key, value in fact_rows(result.facts)
        )
    )
    return "\n\n".join(parts) + "\n"


def write_report(folder: Path) -> Path:
    """Write folder/report.html with a section for every result in the folder, by name.

    Raises:
        DatasetError: No result there, or a figure of one is missing.
    """
    records = read_results(folder)
    if not records:
        raise DatasetError(
            f"{folder}: no result of gaponet experiment here; run one with this folder as OUT"
        )
    images = {
        r["name"]: [_image(folder / f"{stem}.svg") for stem in r["figures"].values()]
        for r in records
    }
    facts = {r["name"]: fact_rows(r["facts"]) for r in records}
    path = folder / "report.html"
    title = "gaponet experiments"
    write_text(
        path,
        render("experiments.html.j2", title=title, records=records, images=images, facts=facts),
    )
    return path


def read_results(folder: Path) -> list[Record]:
    """Read the .json files of the results in a folder; other JSON files are skipped."""
    records, hint = [], "delete it and run its experiment again"
    for file in sorted(folder.glob("*.json")):
        record = read_json(Any, file, DatasetError, hint)
        if isinstance(record, dict) and record.get("format") == FORMAT:
            records.append(validated(Record, record, file, DatasetError, hint))
    return records


def _image(file: Path) -> Markup:
    if not file.is_file():
        raise DatasetError(f"{file}: is missing; run its experiment again, or delete its .json")
    return inline_image(file.read_bytes(), "image/svg+xml")
