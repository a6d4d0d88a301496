"""Payloads that training never saw: between those it saw and beyond them, with and without being told the mass."""

from __future__ import annotations

from collections.abc import Sequence as ListOf
from dataclasses import dataclass

from gaponet.data.store import Dataset
from gaponet.errors import UsageError
from gaponet.plot.charts import lines
from gaponet.plot.methods import COLOURS
from gaponet.study.pool import Cell
from gaponet.study.result import Result, label
from gaponet.study.study import Found, Show, Study, baselines, outcomes, spread, train_all
from gaponet.study.table import Cell as TableCell
from gaponet.study.table import Spread, Table, compared

ALL, BLIND = "gaponet", ":payload_input=off"
WITHOUT, WITHOUT_BLIND = "#7d0a1d", "#e58a97"  # shades of the operator's colour


@dataclass(frozen=True)
class Question:
    """A payload left out of training."""

    name: str
    payload: float

    @property
    def words(self) -> tuple[str, str]:
        """Models that answer it: told the mass, and not told."""
        word = f"{ALL}:holdout_payloads={self.payload:g}"
        return word, word + BLIND


def questions(data: Dataset, between: float | None = None, beyond: float | None = None) -> tuple[Question, Question]:
    """The payload between others and the one beyond all others; by default the two heaviest.

    Raises:
        UsageError: Fewer than three payloads, or one that is not where it is said to be.
    """
    masses = sorted({e.meta.payload_mass for e in data.entries})
    known = ", ".join(f"{m:g}" for m in masses)
    if len(masses) < 3:
        raise UsageError(
            f"{data.path}: payloads {known} kg; leaving one out on the inside and one on the outside needs 3"
        )
    inner, outer = masses[-2] if between is None else between, masses[-1] if beyond is None else beyond
    if inner not in masses[1:-1]:
        raise UsageError(f"--between {inner:g}: lies not between payloads of {data.path}, {known} kg")
    if outer not in (masses[0], masses[-1]):
        raise UsageError(f"--beyond {outer:g}: is not the lightest or heaviest of {data.path}, {known} kg")
    return Question("between", inner), Question("beyond", outer)


def cells(study: Study, asked: tuple[Question, ...]) -> list[Cell]:
    """Trained on all payloads, and without each one asked about; each also without payload input."""
    return study.cells([ALL, ALL + BLIND, *(w for q in asked for w in q.words)])


def run(study: Study, asked: tuple[Question, ...], show: Show) -> Result:
    """Train what is missing and make table and figure."""
    trained = cells(study, asked)
    failed = train_all(trained, study, show)
    done = [c for c in trained if c.done]
    base = baselines(next((c for c in done if c.variant.name == ALL), done[0]), study)
    return result(study, asked, outcomes(trained), base, failed)


def result(
    study: Study, asked: tuple[Question, ...], found: dict[str, list[Found]], base: Found, failed: list[str]
) -> Result:
    """Table, figure and sentences; base as of evaluate_baselines."""
    by = sorted(base["nominal"]["known"]["by_payload"], key=float)
    titles = {ALL: "GAPONet trained on all payloads", ALL + BLIND: "GAPONet trained on all payloads, mass not told"}
    for q in asked:
        told, blind = q.words
        titles[told] = f"GAPONet trained without {q.payload:g} kg"
        titles[blind] = f"{titles[told]}, mass not told"
    rows: list[tuple[TableCell, ...]] = [
        ("nominal simulator", *(at([base["nominal"]], m) for m in by)),
        ("delay + offset", *(at([base["delay_offset"]], m) for m in by)),
    ]
    for word, title in titles.items():
        if word in found:
            rows.append((title, *(at(found[word], m) for m in by)))
    columns = ("MPJAE, mrad", *(f"{float(m):g} kg" for m in by))
    caption = (
        "Held-out motions, whole-motion free run, mean ± std over seeds; delay + offset is fitted on all payloads."
    )
    masses, panels = [float(m) for m in by], []
    for q in asked:
        methods = {"nominal simulator": (COLOURS["nominal"], masses, [at([base["nominal"]], m) for m in by])}
        named = ((ALL, "GAPONet trained on all", COLOURS["gaponet"]), (q.words[0], "trained without it", WITHOUT),
                 (q.words[1], "trained without it, mass not told", WITHOUT_BLIND))  # fmt: skip
        for word, title, colour in named:
            if word in found:
                methods[title] = (colour, masses, [at(found[word], m) for m in by])
        panels.append((f"{q.payload:g} kg left out, {q.name} the others\n{study.who}", methods))
    figure = lines(panels, ("payload per hand, kg", "MPJAE, mrad"), [(m, f"{m:g}") for m in masses],
                   marked=[q.payload for q in asked])  # fmt: skip
    return Result(
        "payload", f"Payloads never trained on, {study.who}", label(study.data), study.facts(found),
        (Table("payload", columns, tuple(rows), caption),), {"payload": figure},
        (*_sentences(asked, found, base), *failed),
    )  # fmt: skip


def at(runs: ListOf[Found], mass: str) -> Spread:
    """Error at a payload over seeds, mrad."""
    return spread(runs, "known", "by_payload", mass, "mpjae")


def _sentences(asked: tuple[Question, ...], found: dict[str, list[Found]], base: Found) -> list[str]:
    out = []
    for q in asked:
        mass = next(m for m in base["nominal"]["known"]["by_payload"] if float(m) == q.payload)
        error = {w: at(f, mass) for w, f in found.items()}
        nominal = base["nominal"]["known"]["by_payload"][mass]["mpjae"] * 1e3
        told, blind = q.words
        if told not in error:
            continue
        where = f"At {q.payload:g} kg, {q.name} the payloads trained on"
        text = f"{where}, {error[told].mean / nominal:.2f} of the nominal {nominal:.2f} mrad is left"
        if ALL in error:
            text += "; " + compared("with it in training", error[ALL], error[told], "that", " mrad")
        if blind in error:
            text += "; " + compared("mass not told", error[blind], error[told], "when told", " mrad")
        out.append(text + ".")
    return out
