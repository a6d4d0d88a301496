"""One offline HTML page over all experiments of a folder, from their .json and .svg files."""

from __future__ import annotations

import html
import json
from pathlib import Path
from typing import Any

from gaponet.data.store import write_text
from gaponet.errors import DatasetError
from gaponet.eval.page import facts_table, page, table
from gaponet.experiment.result import FORMAT, fact_rows


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
    write_text(path, page("gaponet experiments", body + "".join(_section(r, folder) for r in records)))
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
        parts += [table(t["columns"], t["texts"]), f"<p>{html.escape(t['caption'])}</p>" if t["caption"] else ""]
    return "".join([*parts, facts_table(fact_rows(record["facts"]))])


def _figure(file: Path) -> str:
    if not file.is_file():
        raise DatasetError(f"{file}: is missing; run its experiment again, or delete its .json")
    text = file.read_text(encoding="utf-8")
    return f"<figure>{text[text.index('<svg') :]}</figure>"
