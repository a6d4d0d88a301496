"""Payloads that training never saw: between those it saw and beyond them, with and without being told the mass."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, Literal

from gaponet.data.store import Dataset
from gaponet.errors import UsageError
from gaponet.methods import colour, shade, title
from gaponet.spread import Spread, Table, compared
from gaponet_lab.plot.charts import lines
from gaponet_lab.study.found import Found
from gaponet_lab.study.played.unladen import EMPTY, HELD, LADEN, LADEN_FULL, Beside, beside
from gaponet_lab.study.pool import Cell
from gaponet_lab.study.result import Result
from gaponet_lab.study.study import Study

ALL, BLIND = "gaponet", ":payload_input=off"
BASELINES = ("nominal", "delay_offset")


@dataclass(frozen=True)
class LeftOut:
    """A payload left out of training."""

    name: str
    payload: float

    @property
    def words(self) -> tuple[str, str]:
        """Models that answer it: told the mass, and not told."""
        word = f"{ALL}:holdout_payloads={self.payload:g}"
        return word, word + BLIND


@dataclass(frozen=True)
class Payload:
    """Payloads never trained on, one between those trained on and one beyond them, told the mass and not told."""

    between: float | None = None
    """kg left out on the inside; default the heaviest but one."""
    beyond: float | None = None
    """kg left out on the outside; default the heaviest."""
    holdout_units: tuple[str, ...] = ()
    """Units never trained on."""
    simulator_payload: Literal["told", "none"] = "told"
    """told: the simulator has the robot's payload. none: it does not, as where nobody wrote it into the MJCF; only the
    payload between the others is then left out, and more stands beside."""

    def left_out(self, data: Dataset) -> tuple[LeftOut, LeftOut]:
        """The payload between others and the one beyond all others.

        Raises:
            UsageError: Fewer than three payloads, or one that is not where it is said to be.
        """
        masses = sorted({e.meta.payload_mass for e in data.entries})
        known = ", ".join(f"{m:g}" for m in masses)
        if len(masses) < 3:
            raise UsageError(
                f"{data.path}: payloads {known} kg; leaving one out on the inside and one on the outside needs 3"
            )
        inner = masses[-2] if self.between is None else self.between
        outer = masses[-1] if self.beyond is None else self.beyond
        if inner not in masses[1:-1]:
            raise UsageError(f"--between {inner:g}: lies not between payloads of {data.path}, {known} kg")
        if outer not in (masses[0], masses[-1]):
            raise UsageError(f"--beyond {outer:g}: is not the lightest or heaviest of {data.path}, {known} kg")
        return LeftOut("between", inner), LeftOut("beyond", outer)

    def prepared(self, study: Study) -> Study:
        """The study in the simulator that is asked about."""
        if self.simulator_payload == "told":
            return study
        return replace(study, robot=replace(study.robot, carries_payload=False))

    def cells(self, study: Study) -> list[Cell]:
        """Trained on all payloads, and without each one asked about; each also without payload input."""
        return study.cells([ALL, ALL + BLIND, *(w for q in self._asked(study.data) for w in q.words)])

    def _asked(self, data: Dataset) -> tuple[LeftOut, ...]:
        return self.left_out(data)[: 2 if self.simulator_payload == "told" else 1]

    def result(self, study: Study, found: Found) -> Result:
        """Error by payload, a row per model."""
        asked = self._asked(study.data)
        masses = sorted({e.meta.payload_mass for e in study.data.entries})
        error = {name: [_at(found, name, m) for m in masses] for name in BASELINES}
        error |= {word: [_at(found, word, m) for m in masses] for word, _ in found.runs}
        titles = {name: title(name) for name in BASELINES}
        titles |= {
            ALL: "GAPONet trained on all payloads",
            ALL + BLIND: "GAPONet trained on all payloads, mass not told",
        }
        for q in asked:
            without = f"GAPONet trained without {q.payload:g} kg"
            titles |= dict(zip(q.words, (without, f"{without}, mass not told"), strict=True))
        table = Table(
            "payload", ("MPJAE, mrad", *(f"{m:g} kg" for m in masses)),
            tuple((titles[w], *error[w]) for w in titles if w in error),
            "Held-out motions, whole-motion free run, mean ± std over seeds; delay + offset is fitted on all payloads.",
        )  # fmt: skip
        panels, base = [], colour(ALL)
        for q in asked:
            looks = {"nominal": (titles["nominal"], colour("nominal")), ALL: ("GAPONet trained on all", base),
                     q.words[0]: ("trained without it", shade(base, -0.4)),
                     q.words[1]: ("… mass not told", shade(base, 0.5))}  # fmt: skip
            drawn = {name: (c, masses, error[w]) for w, (name, c) in looks.items() if w in error}
            panels.append((f"{q.payload:g} kg left out, {q.name} the others\n{study.who}", drawn))
        said, tables, name = [s for q in asked if (s := _sentence(q, found))], [table], "Payloads never trained on"
        if self.simulator_payload == "none":
            told = {w: titles[w] for w in (ALL, asked[0].words[0]) if w in error}
            also = beside(study, found, told, ALL + BLIND)
            more, moving = _unladen(also, masses)
            shown = {name: (c, masses, [by[m] for m in masses]) for (name, c), by in _looks(also)}
            panels.append((f"the simulator carries nothing\n{study.who}", panels[0][1] | shown))
            tables = [replace(table, rows=table.rows + more), moving]
            said, name = [_best(tables[0]), *said], "Payloads that the simulator does not have"
        marked: list[float | None] = [q.payload for q in asked]
        figure = lines(panels, ("payload per hand, kg", "MPJAE, mrad"), [(m, f"{m:g}") for m in masses], marked=marked)
        return found.result(study, "payload", name, tables, {"payload": figure}, said)


def _at(found: Found, method: str, mass: float) -> Spread:
    """Error of a model or a baseline at a payload, mrad."""
    path = "known", "by_payload", f"{mass:g}", "mpjae"
    return found.base(method, *path) if method in BASELINES else found.spread(method, *path)


def _unladen(found: Beside, masses: list[float]) -> tuple[tuple[tuple[Any, ...], ...], Table]:
    """More rows of the table of payloads, and a table of payloads that come and go."""
    rows = tuple((name, *(by[m] for m in masses)) for name, by in found.rows.items() if by)
    heading = f"{HELD:g} kg picked up and put down: MPJAE, mrad"
    moving = tuple((name, _over_motions(errors)) for name, errors in found.moving.items())
    note = (
        "VIRTUAL units play the test motions; hands are filled after a third and emptied after two, or reversed. Mean "
        "± standard error over motions and units, first seed. Told is the mass of the moment."
    )
    return rows, Table("moving", ("method", heading), moving, note)


def _looks(found: Beside) -> list[tuple[tuple[str, str], dict[float, Spread]]]:
    """Label and colour of the rows beside, as far as a figure shows them."""
    looks = {
        "GAPONet trained on all payloads, mass estimated": ("… mass estimated", shade(colour(ALL), 0.75)),
        EMPTY: ("identification", colour("identified")),
        LADEN: ("laden one transferred", shade(colour("transfer"), 0.5)),
        LADEN_FULL: ("… identified", colour("transfer")),
    }
    return [(looks[name], by) for name, by in found.rows.items() if name in looks and by]


def _best(table: Table) -> str:
    """What leaves least over all payloads, and the others."""
    means = {row[0]: sum(x.mean for x in row[1:]) / (len(row) - 1) for row in table.rows}
    first, *others = sorted(means, key=lambda name: means[name])
    rest = "; ".join(f"{name} {means[name]:.2f}" for name in others)
    return f"Over all payloads {first} leaves least, {means[first]:.2f} mrad; {rest}."


def _over_motions(errors: list[float]) -> Spread:
    found = Spread.of(errors)
    return Spread(found.mean, found.error, found.count)


def _sentence(asked: LeftOut, found: Found) -> str:
    error = {word: _at(found, word, asked.payload) for word, _ in found.runs}
    nominal = _at(found, "nominal", asked.payload).mean
    told, blind = asked.words
    if told not in error:
        return ""
    text = (
        f"At {asked.payload:g} kg, {asked.name} the payloads trained on, {error[told].mean / nominal:.2f} of the "
        f"nominal {nominal:.2f} mrad is left"
    )
    if ALL in error:
        text += "; " + compared("with it in training", error[ALL], error[told], "that", " mrad")
    if blind in error:
        text += "; " + compared("mass not told", error[blind], error[told], "when told", " mrad")
    return text + "."
