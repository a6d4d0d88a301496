"""Error against hours of training data: how much must somebody record?

The training motions are thinned in a fixed order, so that a smaller part lies in a larger; validation and test motions
stay the same, and so does the training budget.
"""

from __future__ import annotations

from dataclasses import dataclass

from gaponet.base.errors import UsageError
from gaponet.base.result_table import MeanStd, ResultTable
from gaponet.experiments.found import Found
from gaponet.experiments.kept import read_kept
from gaponet.experiments.options import MODELS
from gaponet.experiments.pool import Cell
from gaponet.experiments.result import Result
from gaponet.experiments.study import Study
from gaponet.report.figures.charts import lines
from gaponet.report.figures.colours import palette
from gaponet.report.methods import title

ENOUGH = 1.1  # of the error with all recordings
BASELINES = ("nominal", "delay_offset")


@dataclass(frozen=True)
class Data:
    """Error against hours of training data: how much must be recorded?"""

    models: tuple[str, ...] = MODELS
    """Models, written as for compare."""
    shares: tuple[float, ...] = (0.125, 0.25, 0.5, 1.0)
    """Parts of the training motions."""
    holdout_units: tuple[str, ...] = ()
    """Units never trained on."""

    def cells(self, study: Study) -> list[Cell]:
        """Each model on each share of the training motions.

        Raises:
            UsageError: A share is not above 0 and up to 1.
        """
        if not self.shares or min(self.shares) <= 0 or max(self.shares) > 1:
            given = " ".join(f"{s:g}" for s in self.shares)
            raise UsageError(f"--shares {given}: give parts of the training motions, above 0, up to 1")
        return study.cells([at(word, share) for word in self.models for share in sorted(set(self.shares))])

    def result(self, study: Study, found: Found) -> Result:
        motions, minutes = _recorded(self, found)
        error = {w: {s: found.spread(at(w, s), "known", "mpjae") for s in minutes} for w in self.models}
        for name in BASELINES:
            error[name] = {s: found.base(name, "known", "mpjae", word=_word(self, found, s)) for s in minutes}
        order = [*BASELINES, *self.models]
        heads = (f"{title(m).removesuffix(' simulator')}, mrad" for m in order)
        rows = tuple((f"{motions[s]}", minutes[s], *(error[m][s] for m in order)) for s in minutes)
        caption = (
            "MPJAE of the same held-out motions in whole-motion free run, mean ± std over seeds, all trained for the "
            "same budget; minutes of recordings trained on, all units and payloads together."
        )
        x, colours = list(minutes.values()), palette(order)
        methods = {title(m): (colours[m], x, list(error[m].values())) for m in order}
        figure = lines([(f"Error against recordings trained on\n{study.who}", methods)],
                       ("minutes trained on", "MPJAE, mrad"), [(v, f"{v:.3g}") for v in x], log=True)  # fmt: skip
        table = ResultTable("data", ("training motions", "minutes", *heads), rows, caption)
        said = [_sentence(title(w), error[w], error["nominal"], minutes) for w in self.models]
        return found.result(study, "data", "How much must be recorded", [table], {"data": figure}, said)


def at(word: str, share: float) -> str:
    """A model on a share of the training motions, as a word."""
    return word if share == 1 else f"{word}:train_share={share:g}"


def _word(asked: Data, found: Found, share: float) -> str:
    """A model of which something came out with this share."""
    return next((at(w, share) for w in asked.models if found.of_word(at(w, share))), "")


def _recorded(asked: Data, found: Found) -> tuple[dict[float, int], dict[float, float]]:
    """Motions and minutes trained on, by share, as the models' cards say."""
    motions, minutes = {}, {}
    for share in sorted(set(asked.shares)):
        if word := _word(asked, found, share):
            card = found.cells[word, ""][0].folder / "model" / "card.json"
            told = read_kept(card)
            motions[share], minutes[share] = len(told["motions"]["train"]), told["hours"] * 60
    return motions, minutes


def _sentence(
    name: str, error: dict[float, MeanStd], nominal: dict[float, MeanStd], minutes: dict[float, float]
) -> str:
    """How little is enough."""
    known = {s: e for s, e in error.items() if e.count}
    if not known:
        return f"{name}: nothing came out."
    whole = max(known)
    enough = min(s for s, e in known.items() if e.mean <= ENOUGH * known[whole].mean)
    least = min(known)
    left = {s: known[s].mean / nominal[s].mean for s in (least, whole)}
    text = f"{name}: {left[whole]:.2f} of the nominal error is left with {minutes[whole]:.3g} minutes of recordings"
    if least != whole:
        text += f" and {left[least]:.2f} with {minutes[least]:.3g}; "
        text += (
            f"{minutes[enough]:.3g} minutes come within {100 * (ENOUGH - 1):.0f} % of the whole" if enough != whole
            else "less than all of it costs more than a tenth, so more would help"
        )  # fmt: skip
    return text + "."
