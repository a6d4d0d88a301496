"""A result as files, in every form that someone may want.

    NAME.md            for people            NAME.json   everything, exact
    NAME[-TABLE].csv   one per table         NAME[-FIGURE].svg, .png
    report.html        one offline page over all results of the folder

The first table and the first figure are NAME.csv and NAME.svg, the others carry their own names.
"""

from __future__ import annotations

import html
import json
from pathlib import Path
from typing import Any

from gaponet.data.json_file import write_json
from gaponet.errors import DatasetError
from gaponet.eval import page as html_page
from gaponet.files import write_text, writing
from gaponet.plot.style import save
from gaponet.study.result import Result, fact_rows

FORMAT = "gaponet experiment 1"
KIND = "experiments"


def write(result: Result, folder: Path) -> list[Path]:
    """Write NAME.md, .json, .csv, .svg and .png and renew report.html; each file whole or not at all.

    Returns:
        All files written, the report last.

    Raises:
        FolderError: folder is somebody else's, or another process writes into it.
    """
    with writing(folder, KIND):
        return _write(result, folder)


def _write(result: Result, folder: Path) -> list[Path]:
    files: list[Path] = []
    for table, stem in zip(result.tables, stems(result.name, [t.name for t in result.tables]), strict=True):
        files.append(folder / f"{stem}.csv")
        write_text(files[-1], table.csv())
    pictures = stems(result.name, list(result.figures))
    for figure, stem in zip(result.figures.values(), pictures, strict=True):
        files += save(figure, folder / f"{stem}.svg")
    files += [folder / f"{result.name}.md", folder / f"{result.name}.json"]
    write_text(files[-2], _markdown(result, pictures))
    figures = dict(zip(result.figures, pictures, strict=True))
    record = {
        "format": FORMAT, "name": result.name, "title": result.title, "virtual": result.virtual,
        "facts": dict(result.facts), "sentences": list(result.sentences),
        "tables": [t.record() for t in result.tables if t.shown], "figures": figures,
    }  # fmt: skip
    write_json(files[-1], record)
    return [*files, write_report(folder)]


def stems(name: str, parts: list[str]) -> list[str]:
    """File names without suffix: NAME, then NAME-PART."""
    return [name if i == 0 else f"{name}-{part}" for i, part in enumerate(parts)]


def _markdown(result: Result, pictures: list[str]) -> str:
    parts = [f"# {result.title}", f"**{result.virtual}**"]
    if result.sentences:
        parts.append("\n".join(f"- {s}" for s in result.sentences))
    parts += [t.markdown() for t in result.tables if t.shown]
    parts += [f"![]({stem}.svg)" for stem in pictures]
    parts.append("\n".join(f"- {key}: {value}" for key, value in fact_rows(result.facts)))
    return "\n\n".join(parts) + "\n"


def write_report(folder: Path) -> Path:
    """Write folder/report.html with a section for every result found in the folder, by name.

    Raises:
        DatasetError: No result there, or a figure of one is missing.
    """
    records = found(folder)
    if not records:
        raise DatasetError(f"{folder}: no result of gaponet experiment here; run one with this folder as OUT")
    contents = "".join(f'<li><a href="#{html.escape(r["name"])}">{html.escape(r["title"])}</a></li>' for r in records)
    body = f"<h1>Experiments</h1><ul>{contents}</ul>" if len(records) > 1 else ""
    path = folder / "report.html"
    write_text(path, html_page.page("gaponet experiments", body + "".join(_section(r, folder) for r in records)))
    return path


def found(folder: Path) -> list[dict[str, Any]]:
    """The results of a folder as their .json files hold them; other JSON files are passed over."""
    records = []
    for file in sorted(folder.glob("*.json")):
        try:
            record = json.loads(file.read_text(encoding="utf-8"))
        except json.JSONDecodeError as error:
            raise DatasetError(f"{file}: damaged ({error}); delete it and run its experiment again") from None
        if isinstance(record, dict) and record.get("format") == FORMAT:
            records.append(record)
    return records


def _section(record: dict[str, Any], folder: Path) -> str:
    virtual = "VIRTUAL" in record["virtual"]
    tag = f'<span class="tag {"virtual" if virtual else "real"}">{"VIRTUAL robot" if virtual else "real robot"}</span>'
    parts = [
        f'<h1 id="{html.escape(record["name"])}">{html.escape(record["title"])}</h1>',
        f"<p>{tag} {html.escape(record['virtual'])}</p>",
        "<ul>" + "".join(f"<li>{html.escape(s)}</li>" for s in record["sentences"]) + "</ul>",
        *(_figure(folder / f"{stem}.svg") for stem in record["figures"].values()),
    ]
    for t in record["tables"]:
        parts += [
            html_page.table(t["columns"], t["texts"]),
            f"<p>{html.escape(t['caption'])}</p>" if t["caption"] else "",
        ]
    return "".join([*parts, html_page.facts_table(fact_rows(record["facts"]))])


def _figure(file: Path) -> str:
    if not file.is_file():
        raise DatasetError(f"{file}: is missing; run its experiment again, or delete its .json")
    text = file.read_text(encoding="utf-8")
    return f"<figure>{text[text.index('<svg') :]}</figure>"
