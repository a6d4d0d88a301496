"""Error against hours of training data: how much must somebody record?

The training motions are thinned in a fixed order, so that a smaller part lies in a larger; validation and test motions
stay the same, and so does the training budget.
"""

from __future__ import annotations

import json
from collections.abc import Sequence as ListOf

from gaponet.errors import UsageError
from gaponet.plot.charts import lines
from gaponet.study.compare import palette
from gaponet.study.pool import Cell
from gaponet.study.result import Result, label
from gaponet.study.study import Found, Show, Study, baselines, outcomes, spread, title, train_all
from gaponet.study.table import Cell as TableCell
from gaponet.study.table import Spread, Table

SHARES = (0.125, 0.25, 0.5, 1.0)
ENOUGH = 1.1  # of the error with all recordings


def cells(study: Study, words: ListOf[str], shares: ListOf[float] = SHARES) -> list[Cell]:
    """Each model on each share of the training motions.

    Raises:
        UsageError: A share is not above 0 and up to 1.
    """
    if not shares or min(shares) <= 0 or max(shares) > 1:
        raise UsageError(
            f"--shares {' '.join(f'{s:g}' for s in shares)}: give parts of the training motions, above 0, up to 1"
        )
    return study.cells([at(word, share) for word in words for share in sorted(set(shares))])


def at(word: str, share: float) -> str:
    """A model on a share of the training motions, as a word."""
    return word if share == 1 else f"{word}:train_share={share:g}"


def run(study: Study, words: ListOf[str], shares: ListOf[float], show: Show) -> Result:
    """Train what is missing and make table and figure."""
    trained = cells(study, words, shares)
    failed = train_all(trained, study, show)
    hours, motions, base = {}, {}, {}
    for share in sorted(set(shares)):
        cell = next((c for c in trained if c.done and c.variant.config.train_share == share), None)
        if cell is not None:
            card = json.loads((cell.folder / "model" / "card.json").read_text(encoding="utf-8"))
            hours[share], motions[share] = card["hours"], len(card["motions"]["train"])
            base[share] = baselines(cell, study)
    return result(study, words, hours, motions, outcomes(trained), base, failed)


def result(
    study: Study,
    words: ListOf[str],
    hours: dict[float, float],
    motions: dict[float, int],
    found: dict[str, list[Found]],
    base: dict[float, Found],
    failed: list[str],
) -> Result:
    """Table, figure and sentences.

    Args:
        study: What was run.
        words: Models.
        hours, motions: Of training, by share.
        found: Word with share → what each seed gave.
        base: Share → of evaluate_baselines.
        failed: What is to be said about cells that are not there.
    """
    error = {w: {s: spread(found.get(at(w, s), []), "known", "mpjae") for s in hours} for w in words}
    nominal = {s: spread([base[s]["nominal"]], "known", "mpjae") for s in hours}
    delayed = {s: spread([base[s]["delay_offset"]], "known", "mpjae") for s in hours}
    columns = (
        "training motions",
        "minutes",
        "nominal, mrad",
        "delay + offset, mrad",
        *(f"{title(w)}, mrad" for w in words),
    )
    rows: list[tuple[TableCell, ...]] = [
        (f"{motions[s]}", hours[s] * 60, nominal[s], delayed[s], *(error[w][s] for w in words)) for s in hours
    ]
    caption = (
        "MPJAE of the same held-out motions in whole-motion free run, mean ± std over seeds, all trained for the same "
        "budget; minutes of recordings trained on, all units and payloads together."
    )
    colours = palette({w: {"kind": study.variant(w).kind} for w in words} | {k: {"kind": k} for k in
                      ("nominal", "delay_offset")})  # fmt: skip
    x = [h * 60 for h in hours.values()]
    methods = {"nominal simulator": (colours["nominal"], x, list(nominal.values())),
               "delay + offset": (colours["delay_offset"], x, list(delayed.values()))}  # fmt: skip
    methods |= {title(w): (colours[w], x, list(error[w].values())) for w in words}
    panel = (f"Error against recordings trained on\n{study.who}", methods)
    figure = lines([panel], ("minutes trained on", "MPJAE, mrad"), [(v, f"{v:.3g}") for v in x], log=True)
    return Result(
        "data", f"How much must be recorded, {study.who}", label(study.data), study.facts(found),
        (Table("data", columns, tuple(rows), caption),), {"data": figure},
        (*(_sentence(title(w), error[w], nominal, hours) for w in words), *failed),
    )  # fmt: skip


def _sentence(name: str, error: dict[float, Spread], nominal: dict[float, Spread], hours: dict[float, float]) -> str:
    """How little is enough."""
    known = {s: e for s, e in error.items() if e.count}
    if not known:
        return f"{name}: nothing came out."
    whole = max(known)
    enough = min(s for s, e in known.items() if e.mean <= ENOUGH * known[whole].mean)
    least = min(known)
    left = {s: known[s].mean / nominal[s].mean for s in (least, whole)}
    text = f"{name}: {left[whole]:.2f} of the nominal error is left with {hours[whole] * 60:.3g} minutes of recordings"
    if least != whole:
        text += f" and {left[least]:.2f} with {hours[least] * 60:.3g}"
        text += (
            f"; {hours[enough] * 60:.3g} minutes come within {ENOUGH - 1:.0%} of the whole".replace("%", " %")
            if enough != whole
            else "; less than all of it costs more than a tenth, so more would help"
        )
    return text + "."
