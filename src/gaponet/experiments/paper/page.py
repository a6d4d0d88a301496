"""The page of the experiment: figures and tables numbered as in the paper, with its numbers beside
ours.
"""

from __future__ import annotations

import sys
from dataclasses import dataclass, field
from datetime import date
from importlib.metadata import version
from importlib.resources import files
from pathlib import Path
from typing import TYPE_CHECKING, Any

from markupsafe import Markup

from gaponet.base.files import write_json, write_text
from gaponet.base.result_table import ResultTable
from gaponet.data.store import dataset_hash
from gaponet.evaluation.candidate import describe_provenance
from gaponet.experiments.paper.study import Study
from gaponet.report.figures.style import save
from gaponet.report.page import page_figure, render
from gaponet.sim.model import model_hash

if TYPE_CHECKING:
    from matplotlib.figure import Figure

VERSIONS = ("gaponet", "mujoco", "numpy", "torch")
QUICK_LABEL = "QUICK RUN: it shows that every part works, and its numbers mean nothing."

DESPITE_ERRORS = "Trained on recordings in which the doctor finds an error (--despite-errors)."


@dataclass(frozen=True)
class Section:
    """One figure or table of the paper.

    Attributes:
        number: "Figure 3", "Table 1"; empty for what the paper does not number.
        title: What it shows.
        text: Sentences under the title.
    """

    number: str
    title: str
    text: str = ""
    figures: dict[str, Figure] = field(default_factory=dict)
    tables: list[ResultTable] = field(default_factory=list)


def write_page(study: Study, sections: list[Section], failures: list[str]) -> Path:
    """Write paper.html, paper.json, and the folders figures and tables; return the page.

    Args:
        failures: A sentence for each training that failed, at the top of the page.
    """
    out = study.out
    for folder in ("figures", "tables"):
        (out / folder).mkdir(exist_ok=True)
    shown = []
    for section in sections:
        drawn = []
        for name, drawing in section.figures.items():
            save(drawing, out / "figures" / f"{name}.svg")
            drawn.append(page_figure(drawing, ""))
        for table in section.tables:
            write_text(out / "tables" / f"{table.name}.csv", table.csv())
        shown.append({"section": section, "figures": drawn})
    provenance = describe_provenance(study.data)
    if study.options.quick:
        provenance = f"{QUICK_LABEL} {provenance}"
    if study.options.despite_errors:
        provenance = f"{DESPITE_ERRORS} {provenance}"
    facts = _facts(study)
    tables: dict[str, Any] = {}
    for section in sections:
        tables |= {table.name: table.record() for table in section.tables}
    record: dict[str, Any] = {
        "provenance": provenance,
        "facts": facts,
        "failures": failures,
        "tables": tables,
    }
    write_json(out / "paper.json", record)
    diagram = files("gaponet.experiments.paper").joinpath("figure1.svg").read_text("utf-8")
    page = out / "paper.html"
    write_text(
        page,
        render(
            "paper.html.j2",
            title="SimLifter and GAPONet: the paper's experiment",
            virtual=study.virtual,
            provenance=provenance,
            failures=failures,
            diagram=Markup(diagram),
            sections=shown,
            facts=[[name.replace("_", " "), str(value)] for name, value in facts.items()],
        ),
    )
    return page


def _command() -> str:
    """Return the command of this process, without the folders of its paths."""
    words = ["gaponet"]
    for word in sys.argv[1:]:
        words.append(Path(word).name if "/" in word else word)
    return " ".join(words)


def _facts(study: Study) -> dict[str, Any]:
    """Return what is needed to repeat the experiment."""
    options = study.options
    hours = sum(entry.rows * entry.dt for entry in study.data.entries) / 3600
    facts: dict[str, Any] = {
        "command": _command(),
        "date": date.today().isoformat(),
        "dataset": f"{study.data.path.name} ({dataset_hash(study.data.entries)}), {hours:.2f} h",
        "training_units": ", ".join(study.training_units),
        "seeds": ", ".join(str(seed) for seed in range(options.seeds)),
        "control_steps_of_a_training": f"{options.steps:,}",
        "simulator": model_hash(study.robot),
        "versions": ", ".join(f"{name} {version(name)}" for name in VERSIONS),
    }
    if study.virtual:
        facts["unseen_unit"] = f"{study.unit_name} of the VIRTUAL fleet {Path(study.fleet).stem}"
        facts["motions"] = f"{options.motions}, in no recording"
    return facts
