"""Leave one unit out: train on the others, ask about it. Each fold also tells how well its known units are served."""

from __future__ import annotations

from collections.abc import Sequence as ListOf
from dataclasses import replace
from pathlib import Path

import numpy as np

from gaponet.data.store import Dataset
from gaponet.errors import UsageError
from gaponet.plot.charts import bars
from gaponet.study.compare import palette
from gaponet.study.pool import Cell
from gaponet.study.result import Result, label
from gaponet.study.study import Found, Show, Study, baselines, outcomes, spread, title, train_all
from gaponet.study.table import Cell as TableCell
from gaponet.study.table import Spread, Table, text

Folds = dict[str, dict[str, list[Found]]]  # unit left out → word → what each seed gave


def units_of(data: Dataset) -> list[str]:
    """All units, each to be left out once.

    Raises:
        UsageError: One unit only.
    """
    units = sorted({e.meta.unit_id for e in data.entries})
    if len(units) < 2:
        raise UsageError(f"{data.path}: one unit only ({units[0]}); leaving one out needs recordings of two or more")
    return units


def cells(study: Study, words: ListOf[str]) -> dict[str, list[Cell]]:
    """Of each fold, in OUT/without-UNIT/cells."""
    return {
        unit: replace(study, holdout_units=(unit,)).cells(words, into=str(Path(f"without-{unit}")))
        for unit in units_of(study.data)
    }


def run(study: Study, words: ListOf[str], show: Show) -> Result:
    """Train what is missing and make table and figure."""
    folds = cells(study, words)
    failed = train_all([c for fold in folds.values() for c in fold], study, show)
    found = {unit: outcomes(fold) for unit, fold in folds.items()}
    base = {
        u: baselines(next(c for c in fold if c.done), study) for u, fold in folds.items() if any(c.done for c in fold)
    }
    return result(study, words, found, base, failed)


def result(study: Study, words: ListOf[str], found: Folds, base: dict[str, Found], failed: list[str]) -> Result:
    """Table, figure and sentences; base: unit left out → of evaluate_baselines."""
    units = list(base)
    never = {w: [spread(found[u].get(w, []), "new", "mpjae") for u in units] for w in words}
    known = {w: [seen(found, u, w) for u in units] for w in words}
    nominal = [spread([base[u]["nominal"]], "new", "mpjae") for u in units]
    delayed = [spread([base[u]["delay_offset"]], "new", "mpjae") for u in units]
    columns = ["unit left out", "nominal, mrad", "delay + offset, mrad"]
    parts: list[list[Spread]] = [nominal, delayed]
    for word in words:
        columns += [f"{title(word)}: never seen, mrad", "trained on, mrad", "never seen, of nominal"]
        shares = [Spread(v.mean / n.mean, v.std / n.mean, v.count) for v, n in zip(never[word], nominal, strict=True)]
        parts += [never[word], known[word], shares]
    rows: list[tuple[TableCell, ...]] = [(u, *(p[i] for p in parts)) for i, u in enumerate(units)]
    rows.append(("mean ± std over units", *(Spread.of([v.mean for v in p]) for p in parts)))
    caption = (
        "MPJAE of held-out motions in whole-motion free run, mean ± std over seeds. Never seen: trained on the other "
        "units; trained on: the same unit and motions in the folds that left another unit out."
    )
    colours = palette({w: {"kind": study.variant(w).kind} for w in words} | {k: {"kind": k} for k in
                      ("nominal", "delay_offset")})  # fmt: skip
    methods = {"nominal simulator": (colours["nominal"], nominal), "delay + offset": (colours["delay_offset"], delayed)}
    for word in words:
        pale = tuple(1 - 0.45 * (1 - np.array(colours[word])))
        methods[f"{title(word)}, never seen"] = (colours[word], never[word])
        methods[f"{title(word)}, trained on"] = (pale, known[word])
    return Result(
        "unit", f"A unit never trained on, {study.who}", label(study.data),
        study.facts({u: [f for part in of.values() for f in part] for u, of in found.items()}),
        (Table("unit", tuple(columns), tuple(rows), caption),),
        {"unit": bars(units, methods, "MPJAE, mrad", f"Leave one unit out\n{study.who}")},
        (*_sentences(words, never, known, nominal), *failed),
    )  # fmt: skip


def seen(found: Folds, unit: str, word: str) -> Spread:
    """Error on a unit among those trained on, over the seeds and folds that left another one out."""
    runs = [f for other, of in found.items() if other != unit for f in of.get(word, [])]
    return spread(runs, "known", "by_unit", unit, "mpjae")


def _sentences(
    words: ListOf[str], never: dict[str, list[Spread]], known: dict[str, list[Spread]], nominal: list[Spread]
) -> list[str]:
    out, before = [], Spread.of([n.mean for n in nominal])
    means = {w: Spread.of([v.mean for v in never[w]]) for w in words}
    for word in words:
        there = Spread.of([v.mean for v in known[word]])
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
                f"On a unit never seen, {title(best)} leaves {text(Spread.of(ratio))} of the error of {title(word)} "
                f"(over units), less on {sum(r < 1 for r in ratio)} of {len(ratio)}."
            )
    return out
