"""GAPONet on virtual H1-2 robots: an unseen unit at four payloads, payloads left out, calibration, another fleet.

    python benchmarks/virtual_h1_2.py WORK [--seeds 3] [--budget 230400] [--all-payloads-only]

Trains on virtual-1 to virtual-3 and measures on virtual-4, motions that no training saw, whole-motion free run:

1. nominal, delay + offset, pooled identification, an MLP with as many weights, GAPONet from the nominal and from the
   identified simulator;
2. after `gaponet calibrate` with 30 s of virtual-4 (motions that are not in the test);
3. GAPONet trained without 2 kg, with and without payload input, asked at 2 kg; trained without 3 kg, asked at 3 kg;
4. the same models on the `shifted` fleet, whose physics none of them was trained on.

Writes docs/results/virtual_h1_2.{md,json,csv,svg,png}. What is found in WORK is kept. Every number is from VIRTUAL
robots.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Mapping
from collections.abc import Sequence as ListOf
from dataclasses import dataclass, replace
from pathlib import Path

from publish import WIDE, publish, say

from gaponet.cli.main import main as gaponet
from gaponet.data.sequence import Sequence
from gaponet.data.store import Dataset
from gaponet.eval.evaluate import choose, corrected_robot
from gaponet.metrics import metrics, runs
from gaponet.model import calibration
from gaponet.model.artifact import GapModel
from gaponet.plot.charts import bars
from gaponet.plot.methods import palette, title
from gaponet.plot.table import Spread, Table, compared
from gaponet.robot import RobotSpec, load_robot
from gaponet.sim.replay import Corrector, replay
from gaponet.study.compare import Compare, identified
from gaponet.study.found import Found, answer
from gaponet.study.pool import Cell
from gaponet.study.result import Result
from gaponet.study.study import Study
from gaponet.training.config import TrainConfig, WarmStartConfig

RECIPE = Path(__file__).with_suffix(".toml")
UNIT, UNITS = "virtual-4", ("virtual-1", "virtual-2", "virtual-3", "virtual-4")
# Small rounds of the warm start: validation has stopped falling after five or six of them.
TRAINING = TrainConfig(WIDE, warm_start=WarmStartConfig(rounds=6, num_envs=128, steps=300, gradient_steps=200))
MLP, OURS, FURTHER = "mlp:mlp_match=on", "gaponet", "identified+gaponet"
WITHOUT_2, WITHOUT_3 = "gaponet:holdout_payloads=2", "gaponet:holdout_payloads=3"
BLIND = f"{WITHOUT_2}:payload_input=off"
CALIBRATED = ", calibrated"  # behind a word

By = dict[str, float]  # payload, or "all" → MPJAE, rad
Errors = Mapping[str, ListOf[By]]  # method → seed by seed


@dataclass(frozen=True)
class VirtualH12(Compare):
    """The comparison on the unit held out, after calibration, and on another fleet."""

    models: tuple[str, ...] = (MLP, OURS, FURTHER, WITHOUT_2, BLIND, WITHOUT_3)
    holdout_units: tuple[str, ...] = (UNIT,)

    def result(self, study: Study, found: Found) -> Result:
        """Its tables after the one that counts: the unit never trained on, by payload."""
        made = super().result(study, found)
        unit: dict[str, ListOf[By]] = {
            name: [_new(found.baselines((OURS, ""))[name])] for name in ("nominal", "delay_offset", "identified")
        }
        for word in self.models:
            unit[word] = [_new(run) for run in found.of_word(word)]
            if word in (OURS, FURTHER):
                unit[word + CALIBRATED] = [_after_calibration(c, study) for c in found.cells[word, ""]]
        shifted = _on_shifted(study, found, made.facts["motions"])
        told = f"MPJAE in mrad on {UNIT}, never trained on; calibrated: with 30 s of it playing other motions."
        fleet = "The fleet `shifted`: other effects and larger spread, all four units, zero-shot."
        tables = (made.tables[0], _by_payload("unit", unit, told), _by_payload("shifted", shifted, fleet))
        figures = {"unit": _figure(unit, f"VIRTUAL {UNIT}, never trained on"),
                   "shifted": _figure(shifted, "VIRTUAL fleet `shifted`, zero-shot")}  # fmt: skip
        said = made.sentences
        if unit.get(BLIND) and unit.get(WITHOUT_2):
            blind, seen = (Spread.of([by["2"] for by in unit[w]], 1e3) for w in (BLIND, WITHOUT_2))
            said += (
                f"At 2 kg, on which it was not trained, {compared('mass not told', blind, seen, 'told', ' mrad')}.",
            )
        return replace(made, name="virtual_h1_2", tables=(*tables, *made.tables[1:]), figures=figures, sentences=said)


def _new(run: Mapping[str, dict]) -> By:
    """Errors on the unit held out, by payload."""
    return {p: v["mpjae"] for p, v in run["new"]["by_payload"].items()} | {"all": run["new"]["mpjae"]}


def _mpjae(
    sequences: list[Sequence], nominal: RobotSpec, simulator: RobotSpec, corrector: Corrector | None = None
) -> By:
    """Free runs in a simulator, by payload and of all."""
    twins = replay(sequences, simulator, corrector, lock_idle=True)
    done = runs(sequences, [t.qpos for t in twins], nominal)
    payloads = sorted({s.meta.payload_mass for s in sequences})
    by = {f"{p:g}": metrics([r for r in done if r.real.meta.payload_mass == p])["mpjae"] for p in payloads}
    return by | {"all": metrics(done)["mpjae"]}


def _after_calibration(cell: Cell, study: Study) -> By:
    """With 30 s of the unit, on the same test sequences."""
    run = cell.folder
    model, simulator = GapModel.load(run), corrected_robot(run, study.robot)
    if UNIT not in calibration.load(run, model.weights_hash()):
        _run("calibrate", run, study.data.path, "--unit", UNIT)
    own = calibration.load(run, model.weights_hash())[UNIT]
    entries = [e for e in choose([run], study.data)[0] if e.meta.unit_id == UNIT]
    return _mpjae(study.data.sequences(entries), study.robot, own.robot(simulator), model.corrector(simulator))


def _on_shifted(study: Study, found: Found, motions: list[str]) -> Errors:
    """The same models and simulators on the other fleet, all its units."""
    recipe, nominal = study.out / "shifted.toml", study.robot
    recipe.write_text(
        f"motions = {json.dumps(motions)}\npayloads = [0.0, 1.0, 2.0, 3.0]\nunits = {json.dumps(UNITS)}\nvariants = 2\n"
    )
    sequences = collected(study.out / "shifted", recipe, "shifted").sequences()
    assert study.identified is not None
    out = {
        "nominal": [_mpjae(sequences, nominal, nominal)],
        "identified": [_mpjae(sequences, nominal, study.identified)],
    }
    for word in (MLP, OURS, FURTHER):
        models = [
            (GapModel.load(c.folder), corrected_robot(c.folder, nominal)) for c in found.cells.get((word, ""), [])
        ]
        out[word] = [_mpjae(sequences, nominal, robot, model.corrector(robot)) for model, robot in models]
    return {word: errors for word, errors in out.items() if errors}


def _name(word: str) -> str:
    return title(word.removesuffix(CALIBRATED)) + (CALIBRATED if word.endswith(CALIBRATED) else "")


def _by_payload(name: str, errors: Errors, caption: str) -> Table:
    """A row per method: mrad by payload, of nominal, and where it is worst."""
    payloads, nominal, rows = list(errors["nominal"][0]), errors["nominal"][0], []
    for word, found in errors.items():
        if found:
            values = {p: Spread.of([by[p] for by in found], 1e3) for p in payloads}
            left = {p: values[p].mean / nominal[p] / 1e3 for p in payloads}
            worst = max((p for p in payloads if p != "all"), key=lambda p: left[p])
            rows.append((_name(word), *values.values(), left["all"], f"{left[worst]:.2f} ({worst} kg)"))
    heads = (f"{p} kg" if p != "all" else "mean" for p in payloads)
    return Table(name, ("method", *heads, "of nominal", "worst"), tuple(rows), caption)


def _figure(errors: Errors, heading: str):
    """Error by payload with spread over seeds; models that were trained on all payloads."""
    shown = {w: found for w, found in errors.items() if found and "holdout" not in w}
    payloads = [p for p in shown["nominal"][0] if p != "all"]
    colours = palette(w.replace(CALIBRATED, ":calibrated") for w in shown)
    methods = {
        _name(w): (colour, [Spread.of([by[p] for by in found], 1e3) for p in payloads])
        for (w, found), colour in zip(shown.items(), colours.values(), strict=True)
    }
    return bars([f"{p} kg" for p in payloads], methods, "MPJAE, mrad", heading)


def collected(folder: Path, recipe: Path, fleet: str) -> Dataset:
    """A dataset of the fleet, unless it is there."""
    _run("collect", "--fleet", fleet, "--recipe", recipe, "--out", folder)
    return Dataset(folder)


def _run(*words: object) -> None:
    if gaponet([*map(str, words)]):
        raise SystemExit(2)


def main() -> None:
    """Measure, write, draw."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("work", type=Path)
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--budget", default="230400", help="of each run, as in gaponet train")
    parser.add_argument("--all-payloads-only", action="store_true", help="leave 3. out: half of the trainings")
    parser.add_argument("--recipe", type=Path, default=RECIPE)
    args = parser.parse_args()
    question = VirtualH12((MLP, OURS, FURTHER)) if args.all_payloads_only else VirtualH12()
    data = collected(args.work / "default", args.recipe, "default")
    out = args.work / "compare"
    study = Study(data, load_robot("h1_2"), out, TRAINING, args.budget, args.seeds, question.holdout_units)
    study = identified(study, lambda done, total, rms: None)
    publish(answer(question, study, say), args.work / "results")


if __name__ == "__main__":
    main()
