"""Leave one unit out: train on the others, ask about it. Each fold also tells how well its known units are served."""

from __future__ import annotations

from collections.abc import Sequence as ListOf
from dataclasses import dataclass, replace
from typing import ClassVar

from gaponet.base.errors import UsageError
from gaponet.base.result_table import MeanStd, ResultTable, format_cell
from gaponet.data.store import Dataset
from gaponet.experiments.found import Found, spread
from gaponet.experiments.options import MODELS
from gaponet.experiments.pool import Cell
from gaponet.experiments.result import Result
from gaponet.experiments.study import Study
from gaponet.report.figures.charts import bars
from gaponet.report.figures.colours import palette, shade
from gaponet.report.methods import title

BASELINES = ("nominal", "delay_offset")


@dataclass(frozen=True)
class Unit:
    """Leave one unit out, each in turn: how well is a unit served that training never saw?"""

    models: tuple[str, ...] = MODELS
    """Models, written as for compare."""
    holdout_units: ClassVar[tuple[str, ...]] = ()

    def cells(self, study: Study) -> list[Cell]:
        """The trainings of each fold, kept in OUT/without-UNIT/cells."""
        folds = (
            replace(study, holdout_units=(u,)).cells(self.models, into=f"without-{u}") for u in units_of(study.data)
        )
        return [cell for fold in folds for cell in fold]

    def result(self, study: Study, found: Found) -> Result:
        units = [u for u in units_of(study.data) if any(left_out == u for _, left_out in found.runs)]
        never = {w: [found.spread(w, "new", "mpjae", left_out=u) for u in units] for w in self.models}
        known = {w: [seen(found, u, w) for u in units] for w in self.models}
        base = {b: [found.base(b, "new", "mpjae", left_out=u) for u in units] for b in BASELINES}
        parts = [(f"{title(b).removesuffix(' simulator')}, mrad", values) for b, values in base.items()]
        for word in self.models:
            shares = [v.divided_by(n.mean) for v, n in zip(never[word], base["nominal"], strict=True)]
            parts += [(f"{title(word)}: never seen, mrad", never[word]), ("trained on, mrad", known[word]),
                      ("never seen, of nominal", shares)]  # fmt: skip
        rows = [(u, *(p[i] for _, p in parts)) for i, u in enumerate(units)]
        rows.append(("mean ± std over units", *(MeanStd.from_values([v.mean for v in p]) for _, p in parts)))
        caption = (
            "MPJAE of held-out motions in whole-motion free run, mean ± std over seeds. Never seen: trained on the "
            "other units; trained on: the same unit and motions in the folds that left another unit out."
        )
        colours = palette([*BASELINES, *self.models])
        methods = {title(b): (colours[b], values) for b, values in base.items()}
        for word in self.models:
            methods[f"{title(word)}, never seen"] = (colours[word], never[word])
            methods[f"{title(word)}, trained on"] = (shade(colours[word], 0.55), known[word])
        table = ResultTable("unit", ("unit left out", *(name for name, _ in parts)), tuple(rows), caption)
        figure = bars(units, methods, "MPJAE, mrad", f"Leave one unit out\n{study.who}")
        said = _sentences(self.models, never, known, base["nominal"])
        return found.result(study, "unit", "A unit never trained on", [table], {"unit": figure}, said)


def units_of(data: Dataset) -> list[str]:
    """All units, each to be left out once.

    Raises:
        UsageError: One unit only.
    """
    units = sorted({e.meta.unit_id for e in data.entries})
    if len(units) < 2:
        raise UsageError(f"{data.path}: one unit only ({units[0]}); leaving one out needs recordings of two or more")
    return units


def seen(found: Found, unit: str, word: str) -> MeanStd:
    """Error on a unit among those trained on, over the seeds and folds that left another one out, mrad."""
    runs = [f for (name, left_out), part in found.runs.items() if name == word and left_out != unit for f in part]
    return spread(runs, "known", "by_unit", unit, "mpjae")


def _sentences(
    words: ListOf[str], never: dict[str, list[MeanStd]], known: dict[str, list[MeanStd]], nominal: list[MeanStd]
) -> list[str]:
    out, before = [], MeanStd.from_values([n.mean for n in nominal])
    means = {w: MeanStd.from_values([v.mean for v in never[w]]) for w in words}
    for word in words:
        there = MeanStd.from_values([v.mean for v in known[word]])
        worse = sum(v.mean > n.mean for v, n in zip(never[word], nominal, strict=True))
        line = f"{title(word)} leaves {means[word].mean / before.mean:.2f} of the nominal error on a unit never seen"
        if there.count:
            line += f" and {there.mean / before.mean:.2f} on the same units when trained on"
        out.append(line + (f"; it is worse than nominal on {worse} of {len(nominal)}." if worse else "."))
    best = min(words, key=lambda w: means[w].mean)
    for word in words:
        if word != best:
            ratio = [a.mean / b.mean for a, b in zip(never[best], never[word], strict=True)]
            out.append(
                f"On a unit never seen, {title(best)} leaves {format_cell(MeanStd.from_values(ratio))} of the error "
                f"of {title(word)} (over units), less on {sum(r < 1 for r in ratio)} of {len(ratio)}."
            )
    return out
