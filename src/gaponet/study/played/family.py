"""Models trained in a family of simulators, in simulators that they never met: what does knowing which one is bring?"""

from __future__ import annotations

from collections.abc import Mapping
from collections.abc import Sequence as ListOf
from dataclasses import replace
from typing import Any

import numpy as np

from gaponet.data.sequence import Sequence
from gaponet.model.artifact import GapModel
from gaponet.plot.table import Spread, Table, text
from gaponet.sim.model import model_hash
from gaponet.study.found import Found
from gaponet.study.played.kept import KeptParts
from gaponet.study.played.simulators import CHANGES, Simulator, errors, free_run, recorded, share
from gaponet.study.pool import Cell
from gaponet.study.study import Study
from gaponet.training.config import WarmStartConfig

MANY = WarmStartConfig(rounds=3, num_envs=768, steps=80, gradient_steps=400)
BUDGET = str(MANY.rounds * MANY.num_envs * MANY.steps)
KINDS = {  # kind and settings, with the family between them → name in tables
    "shared_mlp{}:sensors=off": "MLP",
    "gaponet{}:sensors=off": "GAPONet, no sensors",
    "gaponet{}": "GAPONet, predicted sensors",
    "gaponet{}:sensors=off:context=fingerprint": "told its fingerprint",
    "gaponet{}:sensors=off:context=parameters": "told its parameters",
}
Rivals = Mapping[
    str, Mapping[str, ListOf[float]]
]  # simulator → {"uncorrected": …, name: …} → error of each motion, mrad
Own = Mapping[str, Mapping[str, ListOf[ListOf[float]]]]  # simulator → word → seeds → error of each motion, mrad


def words(family: str) -> dict[str, str]:
    """Models trained in a family, word → name."""
    return {kind.format(f":family={family}"): name for kind, name in KINDS.items()}


def cells(study: Study, family: str) -> list[Cell]:
    """Their trainings: more simulators, and more steps, than where there is one."""
    if not study.rehearsal:
        study = replace(study, budget=BUDGET, config=replace(study.config, warm_start=MANY))
    return study.cells(list(words(family)))


def errors_of(
    study: Study, found: Found, family: str, sequences: ListOf[Sequence], simulators: ListOf[Simulator]
) -> Own:
    """Their errors in simulators, kept one by one."""
    out: dict[str, dict[str, list[list[float]]]] = {at.name: {} for at in simulators}
    for word in words(family):
        for cell in found.cells.get((word, ""), []):
            model = GapModel.load(cell.folder)
            kept = KeptParts(study.out / "parts", model.weights_hash(), [(s.meta.motion, len(s)) for s in sequences])
            for at in simulators:
                part = [s for s in sequences if s.meta.payload_mass or at.payload != 0.0]

                def play(at: Simulator = at, model: GapModel = model, part: Any = part) -> dict[str, list[float]]:
                    return {"errors": errors(part, free_run(part, at, model, "as it is"), recorded(part, at.robot))}

                facts = ("family", model_hash(at.robot), at.times, at.payload)
                out[at.name].setdefault(word, []).append(list(kept(*facts, make=play)["errors"]))
    return out


def told(own: Own, rivals: Rivals, family: str) -> tuple[Table, list[str]]:
    """A row per simulator, shares of its own error that are left, and what that says."""
    beside = [name for name in next(iter(rivals.values())) if name != "uncorrected"]
    models = {w: name for w, name in words(family).items() if all(w in e for e in own.values())}
    inside = [name for name in own if name in CHANGES]

    def row(name: str, at: ListOf[str]) -> tuple[Any, ...]:
        mean = lambda parts: np.mean(list(parts), axis=0)  # noqa: E731
        base = mean(rivals[a]["uncorrected"] for a in at).tolist()
        shares = [share(mean(rivals[a][k] for a in at).tolist(), base) for k in beside]
        shares += [share(mean(mean(own[a][w]) for a in at).tolist(), base) for w in models]
        return (name, *shares)

    each, mean = [row(name, [name]) for name in own], row("mean of these", inside)
    base = np.mean([np.mean(rivals[a]["uncorrected"]) for a in inside])
    seeds = [Spread.of(np.mean([own[a][w] for a in inside], axis=(0, 2)) / base) for w in models]
    over = ("the same, ± over seeds", *[None] * len(beside), *seeds)
    rows = [*each[: len(inside)], mean, over, *each[len(inside) :]]
    note = (
        "Share of each simulator's own, uncorrected error in free run, mean over seeds ± standard error over motions. "
        "No simulator of the table was drawn in training; those below the mean are outside the family, or differ in "
        "something that it does not vary."
    )
    shares = dict(zip((*beside, *models.values()), mean[1:], strict=True))
    best, theirs = (min(names, key=lambda name: shares[name].mean) for names in (beside, list(models.values())))
    ahead = sum(min(x.mean for x in r[1 + len(beside) :]) < min(x.mean for x in r[1 : 1 + len(beside)]) for r in each)
    verdict = (
        f"Trained in the family {family}, {theirs}: {text(shares[theirs])} of the simulators' own error is left; "
        f"without one, {best}: {text(shares[best])}. The best of the family is ahead in {ahead} of {len(own)}."
    )
    return Table("family", ("simulator", *beside, *models.values()), tuple(rows), note), [verdict]
