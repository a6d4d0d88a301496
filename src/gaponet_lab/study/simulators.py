"""Other simulators than that of training: the model as it is, and transferred, with each simulator that may be its
reference.
"""

from __future__ import annotations

from collections.abc import Mapping
from collections.abc import Sequence as ListOf
from dataclasses import dataclass
from functools import cached_property, partial
from typing import ClassVar, Literal

import numpy as np

from gaponet.arrays import Array
from gaponet.data.sequence import Sequence
from gaponet.deploy.transfer import Inverse, Reference
from gaponet.errors import UsageError
from gaponet.eval.candidate import choose
from gaponet.methods import colour, shade, title
from gaponet.model.artifact import GapModel
from gaponet.sim.model import model_hash
from gaponet.spread import Spread, Table
from gaponet_lab.plot.charts import bars
from gaponet_lab.study.found import Found as Cells
from gaponet_lab.study.played.kept import KeptParts
from gaponet_lab.study.played.simulators import (
    CHANGES,
    Disturbance,
    Simulator,
    errors,
    free_run,
    microseconds,
    recorded,
    share,
    simulator_of,
    simulators_of,
)
from gaponet_lab.study.pool import Cell
from gaponet_lab.study.result import Result
from gaponet_lab.study.study import Study

NOMINAL, ALONE, BOTH = "gaponet", "identified", "identified+gaponet"  # references
How = Inverse | Literal["as it is"]
WAYS: dict[Inverse, str] = {"closed": "closed form", "probes": "by answers"}
CUT = 20.0  # s of each motion, on a plane and pushed
DISTURBED: tuple[Disturbance, ...] = ("plane", "push")
NEAR = 0.1  # of the reference's own error: as near as transfer has to come
Errors = dict[str, list[float]]  # way → error of each motion, mrad
Found = Mapping[str, Errors]  # simulator → those


@dataclass(frozen=True)
class Simulators:
    """Simulators that no model was trained in: the model as it is, transferred in closed form, and by answers."""

    holdout_units: tuple[str, ...] = ()
    """Units never trained on; where there are any, they alone are played."""
    seconds: float = 0.0
    """Of each motion, from its start; 0 for whole motions."""
    identify: ClassVar[bool] = True

    def cells(self, study: Study) -> list[Cell]:
        """The operator on the nominal simulator and on the identified one."""
        if study.robot.nominal is not None:
            raise UsageError(
                "gaponet experiment simulators identifies by itself; leave out --robot, or give a nominal one"
            )
        return study.cells([NOMINAL, BOTH])

    def result(self, study: Study, found: Cells) -> Result:
        """Shares of each simulator's own error, what transfer adds to its reference's, contact, cost."""
        runs = Runs(study, found, self.seconds)
        free, touching = runs.free(), runs.touching()
        axis, heading = "share of the simulator's own error", f"Transfer\n{study.who}"
        figure = bars([_label(name) for name in free], _bars(free), axis, heading)
        tables = [_shares(free), _added(free), _touching(touching), runs.cost()]
        said = _sentences(free, touching)
        return found.result(
            study, "simulators", "Simulators that no model was trained in",
            tables, {"simulators": figure}, said, motions=sorted({s.meta.motion for s in runs.sequences}),
            recordings=len(runs.sequences),
            simulators={s.name: model_hash(s.robot) for s in runs.simulators},
        )  # fmt: skip


class Runs:
    """Free runs of test motions in all simulators, kept one by one."""

    def __init__(self, study: Study, found: Cells, seconds: float) -> None:
        self.study, nominal = study, study.robot.nominal or study.robot
        trained = {word: found.cells.get((word, ""), []) for word in (NOMINAL, BOTH)}
        first = next(cells[0] for cells in trained.values() if cells)
        sequences = study.data.sequences(choose([first.folder], study.data)[0])
        units = study.holdout_units or {s.meta.unit_id for s in sequences}
        played = (s for s in sequences if s.dt == sequences[0].dt and s.meta.unit_id in units)
        whole = sorted(played, key=lambda s: -len(s))
        self.sequences = _started(whole, seconds) if seconds else whole
        laden = any(s.meta.payload_mass for s in self.sequences)
        self.simulators = list(simulators_of(nominal, laden, study.out / "euler"))
        models = {word: [GapModel.load(cell.folder) for cell in cells] for word, cells in trained.items()}
        known = study.identified or study.robot
        self.references: dict[str, ListOf[Reference]] = {NOMINAL: models[NOMINAL], ALONE: [known], BOTH: models[BOTH]}
        names = [m.weights_hash() for part in models.values() for m in part]
        self.kept = KeptParts(study.out / "parts", names, model_hash(known),
                              [(s.meta.motion, len(s)) for s in self.sequences])  # fmt: skip

    def free(self) -> dict[str, Errors]:
        """Errors beside the recordings, by simulator."""
        return {at.name: self._free(at) for at in self.simulators}

    def _free(self, at: Simulator) -> Errors:
        laden = at.payload == 0.0
        out = {"uncorrected": self._error(at, laden)}
        for word, references in self.references.items():
            seeds: dict[str, list[list[float]]] = {}
            for seed, reference in enumerate(references):
                own = Simulator("", simulator_of(reference))
                ways: list[tuple[str, Simulator, How]] = [("own", own, "as it is")]
                ways += [("as it is", at, "as it is")] if word == NOMINAL else []
                ways += [(how, at, how) for how in WAYS if how == "closed" or (word == BOTH and not seed)]
                for way, there, how in ways:
                    name = way if way == "as it is" else f"{way} {word}"
                    seeds.setdefault(name, []).append(self._error(there, laden, word, seed, how))
            out |= {way: np.mean(values, axis=0).tolist() for way, values in seeds.items()}
        return out

    def _error(self, at: Simulator, laden: bool, word: str = "", seed: int = 0, how: How = "closed") -> list[float]:
        def play() -> dict[str, list[float]]:
            part = [s for s in self.sequences if s.meta.payload_mass or not laden]
            run = free_run(part, at, self.references[word][seed] if word else None, how)
            return {"errors": errors(part, run, recorded(part, at.robot))}

        facts = ("free", model_hash(at.robot), at.times, at.payload, laden, word, seed, how)
        return list(self.kept(*facts, make=play)["errors"])

    def touching(self) -> dict[str, Errors]:
        """On a plane and pushed, in the simulators of CHANGES: how far from the reference under the same."""
        return {
            f"{at.name}, {what}": self.kept(what, CUT, model_hash(at.robot), make=partial(self._apart, at, what))
            for what in DISTURBED
            for at in self.simulators
            if at.name in CHANGES
        }

    def _apart(self, at: Simulator, what: Disturbance) -> Errors:
        reference, truth = self.references[BOTH][0], self._disturbed[what]
        play = partial(free_run, self._cut, at, disturbed=what)
        runs = {"uncorrected": play()} | {way: play(reference, way) for way in WAYS}
        return {way: errors(self._cut, run, truth) for way, run in runs.items()}

    @cached_property
    def _cut(self) -> list[Sequence]:
        return _started(self.sequences, CUT)

    @cached_property
    def _disturbed(self) -> dict[str, Array]:
        """What the identified simulator with its operator does on a plane and pushed."""
        reference = self.references[BOTH][0]
        own = Simulator("", simulator_of(reference))
        return {what: free_run(self._cut, own, reference, "as it is", what) for what in DISTURBED}

    def cost(self) -> Table:
        """µs per period."""
        known = {word: references[0] for word, references in self.references.items()}
        ways: list[tuple[Reference | None, Inverse]] = [(like, how) for like in known.values() for how in WAYS]
        alone, *took = microseconds(self.sequences[-1], self.simulators[0], [(None, "closed"), *ways])
        pairs = zip(known, np.reshape(took, (-1, len(WAYS))) - alone, strict=True)
        rows = [(_name(word), *pair.tolist()) for word, pair in pairs]
        columns = ("reference", *(f"{name}, µs" for name in WAYS.values()))
        note = "Per period of one robot on one thread, beyond the simulator's own step: operator, reference, inverse."
        return Table("cost", columns, tuple(rows), note, digits=0)


def _started(sequences: ListOf[Sequence], seconds: float) -> list[Sequence]:
    return [s.rows(slice(round(seconds / s.dt))) for s in sequences]


def _name(reference: str) -> str:
    return title(reference) if reference != NOMINAL else f"nominal + {title(reference)}"


def _way(way: str) -> str:
    how, reference = way.split(" ", 1)
    return f"{_name(reference)}, {WAYS['closed' if how == 'closed' else 'probes']}"


def _shares(free: Found) -> Table:
    """A row per simulator: its own error, and what each way leaves of it."""
    references = [way.removeprefix("own ") for way in next(iter(free.values())) if way.startswith("own ")]
    ways, heads = ["as it is"], [f"nominal + {title(NOMINAL)} as it is"]
    for word in references:
        found = [how for how in WAYS if f"{how} {word}" in next(iter(free.values()))]
        ways += [f"{how} {word}" for how in ("own", *found)]
        heads += [f"{_name(word)}: at home", *(WAYS[how] for how in found)]
    rows = [(name, _mean(e["uncorrected"]), *(share(e[w], e["uncorrected"]) for w in ways)) for name, e in free.items()]
    inside = [e for name, e in free.items() if name in CHANGES]
    joined = {w: np.mean([np.array(e[w]) for e in inside], axis=0).tolist() for w in ("uncorrected", *ways)}
    rows.insert(len(inside), ("mean of these", _mean(joined["uncorrected"]),
                              *(share(joined[w], joined["uncorrected"]) for w in ways)))  # fmt: skip
    note = (
        "Share of each simulator's own, uncorrected error in free run, ± standard error over motions. "
        "At home: the reference in its own simulator. Closed form over all seeds, answers with the first."
    )
    return Table("simulators", ("simulator", "uncorrected, mrad", *heads), tuple(rows), note)


def _added(free: Found) -> Table:
    """What transfer leaves, as a ratio to the reference at home."""
    ways = [way for way in next(iter(free.values())) if way.split()[0] in WAYS]
    heads = [_way(way) for way in ways]
    rows = [(name, *(share(e[w], e["own " + w.split(" ", 1)[1]]) for w in ways)) for name, e in free.items()]
    note = "Error as a ratio to that of the reference at home, paired over motions, ± standard error."
    return Table("added", ("simulator", *heads), tuple(rows), note, digits=3)


def _touching(touching: Found) -> Table:
    rows = [
        (name, _mean(e["uncorrected"]), *(share(e[w], e["uncorrected"]) for w in WAYS),
         " and ".join(f"{np.sum(np.array(e[w]) > e['uncorrected'])}" for w in WAYS) + f" of {len(e['uncorrected'])}")
        for name, e in touching.items()
    ]  # fmt: skip
    note = (
        "Distance from the identified simulator with its operator on the same plane, or under the same pushes, "
        f"{CUT:g} s of each motion. A plane "
        "hides the tips' way 30 % of the time; a push is the torque of 0.1 rad on every joint, 0.3 s long, every 2 s."
    )
    columns = ("simulator", "uncorrected, mrad", *WAYS.values(), "worse motions")
    return Table("contact", columns, tuple(rows), note)


def _mean(error: ListOf[float]) -> Spread:
    return Spread.of(error) if len(error) < 2 else Spread(Spread.of(error).mean, Spread.of(error).error, len(error))


def _bars(free: Found) -> dict[str, tuple[str, list[Spread]]]:
    ways = {"as it is": (f"nominal + {title(NOMINAL)} as it is", shade(colour(NOMINAL), 0.55))}
    ways |= {f"closed {w}": (f"transfer of {_name(w)}", colour(w)) for w in (NOMINAL, ALONE, BOTH)}
    return {label: (c, [share(e[w], e["uncorrected"]) for e in free.values()]) for w, (label, c) in ways.items()}


def _label(name: str) -> str:
    return name.replace(" ×", "\n×").replace(", ", ",\n").replace("payload ", "payload\n")


def _sentences(free: Found, touching: Found) -> list[str]:
    first = next(iter(free.values()))
    ways = [way for way in first if way.split()[0] in WAYS]
    own = {w.split(" ", 1)[1]: np.mean(first["own " + w.split(" ", 1)[1]]) for w in ways}
    best = min(own, key=lambda w: own[w])
    ratios = {(name, w): share(e[w], e["own " + w.split(" ", 1)[1]]).mean for name, e in free.items() for w in ways}
    naive = [share(e["as it is"], e["uncorrected"]).mean for e in free.values()]
    far = {k: v for k, v in ratios.items() if v > 1 + NEAR}
    worst = max(ratios, key=lambda k: ratios[k])
    out = [
        f"Use transfer in any simulator but that of training, with {_name(best)} as its reference "
        f"({own[best]:.2f} mrad); in closed form where the actuators are position actuators, by answers elsewhere.",
        f"The model as it is leaves {np.mean(naive):.2f} of the simulators' own error, at worst {max(naive):.2f}.",
        f"Transfer comes within {NEAR:.0%} of its reference's own error in {len(ratios) - len(far)} of {len(ratios)} "
        f"combinations of simulator, reference and inverse; the largest ratio is {ratios[worst]:.3f} ({worst[0]}; "
        f"{_way(worst[1])}).",
    ]
    worse = sum(share(e[w], e["uncorrected"]).mean > 1 for e in touching.values() for w in WAYS)
    highest = max(share(e[w], e["uncorrected"]).mean for e in touching.values() for w in WAYS)
    out.append(
        f"On a plane or pushed it is further from the reference under the same than without transfer in {worse} of "
        f"{2 * len(touching)} cases; it leaves {highest:.2f} at most."
    )
    return out
