"""GAPONet on virtual H1-2 robots: an unseen unit at four payloads, payloads left out, calibration, another fleet.

    python benchmarks/virtual_h1_2.py WORK [--seeds 3] [--budget 230400] [--all-payloads-only]

Trains on virtual-1 to virtual-3 and measures on virtual-4, motions that no training saw, whole-motion free run:

1. nominal, delay + offset, pooled identification, an MLP with as many weights, GAPONet from the nominal and from the
   identified simulator;
2. after `gaponet calibrate` with 30 s of virtual-4 (motions that are not in the test);
3. GAPONet trained without 2 kg, with and without payload input, asked at 2 kg; trained without 3 kg, asked at 3 kg;
4. the same models on the `shifted` fleet, whose physics none of them was trained on.

Calls the commands that a user would call. Writes docs/results/virtual_h1_2.{json,md,svg,png}. What is found in WORK is
kept. Every number is from VIRTUAL robots.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
from collections.abc import Iterable
from datetime import date
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np

from gaponet.data.sequence import Sequence
from gaponet.data.store import Dataset
from gaponet.eval.evaluate import choose, corrected_robot
from gaponet.gap import metrics, runs
from gaponet.model import calibration
from gaponet.model.artifact import GapModel
from gaponet.plot.methods import COLOURS, NAMES
from gaponet.plot.style import STYLE, figure
from gaponet.robot import RobotSpec, load_robot
from gaponet.sim.replay import Corrector, replay

DOCS = Path(__file__).parents[1] / "docs" / "results"
RECIPE = Path(__file__).with_suffix(".toml")
ENVIRONMENT = os.environ | {"OMP_WAIT_POLICY": "PASSIVE"}
UNIT, UNITS = "virtual-4", ("virtual-1", "virtual-2", "virtual-3", "virtual-4")

# Small rounds of the warm start: validation has stopped falling after five or six of them. Networks twice as wide as
# today's default.
TRAINING = ("--warm-start.num-envs", 128, "--warm-start.steps", 300, "--warm-start.gradient-steps", 200,
            "--warm-start.rounds", 6, "--model.branch-hidden", 128, 128, "--model.trunk-hidden", 64, 64,
            "--model.sensor-hidden", 256, 256)  # fmt: skip
MODELS = {  # name here → word of gaponet compare
    "mlp": "mlp:mlp_match=on",
    "gaponet": "gaponet",
    "identified_gaponet": "identified+gaponet",
    "without_2": "gaponet:holdout_payloads=2",
    "without_2_blind": "gaponet:holdout_payloads=2:payload_input=off",
    "without_3": "gaponet:holdout_payloads=3",
}
TITLES = NAMES | {
    "identified": "identification",
    "identified_gaponet": "identification + GAPONet",
    "calibrated": "GAPONet, calibrated",
    "identified_calibrated": "identification + GAPONet, calibrated",
    "without_2": "GAPONet trained without 2 kg",
    "without_2_blind": "the same without payload input",
    "without_3": "GAPONet trained without 3 kg",
}
FILL = COLOURS | {
    "identified_gaponet": "#7d0a1d", "calibrated": "#e58a97", "identified_calibrated": "#b9606c",
}  # fmt: skip
SHOWN = ("nominal", "delay_offset", "identified", "mlp", "gaponet", "calibrated", "identified_gaponet",
         "identified_calibrated")  # fmt: skip

By = dict[str, float]  # payload, or "all" → MPJAE, rad


def gaponet(*words: object) -> dict[str, Any]:
    """Run a command with --json and return its object."""
    print("gaponet", *words, flush=True)
    command = [sys.executable, "-m", "gaponet.cli.main", *map(str, words), "--json"]
    return json.loads(subprocess.run(command, check=True, stdout=subprocess.PIPE, text=True, env=ENVIRONMENT).stdout)


def collected(work: Path, name: str, recipe: Path, fleet: str) -> Dataset:
    """A dataset of the fleet, unless it is there."""
    gaponet("collect", "--fleet", fleet, "--recipe", recipe, "--out", work / name)
    return Dataset(work / name)


def mpjae(
    sequences: list[Sequence], nominal: RobotSpec, simulator: RobotSpec, corrector: Corrector | None = None
) -> By:
    """Free runs in a simulator, by payload and of all."""
    twins = replay(sequences, simulator, corrector, lock_idle=True)
    done = runs(sequences, [t.qpos for t in twins], nominal)
    payloads = sorted({s.meta.payload_mass for s in sequences})
    by = {f"{p:g}": metrics([r for r in done if r.real.meta.payload_mass == p])["mpjae"] for p in payloads}
    return by | {"all": metrics(done)["mpjae"]}


def cells(work: Path, word: str) -> list[Path]:
    """Run folders of a model, seed by seed."""
    found = {}
    for file in (work / "compare" / "cells").glob("*/cell.json"):
        cell = json.loads(file.read_text(encoding="utf-8"))
        start = "identified+" if cell["start"] == "identified" else ""
        if word == start + ":".join([cell["kind"], *cell["changes"]]):
            found[cell["seed"]] = file.parent
    return [found[seed] for seed in sorted(found)]


def unseen_unit(compared: dict[str, Any], models: dict[str, str]) -> dict[str, list[By]]:
    """Method → seed by seed, of the unit held out."""
    words = {name: name for name in ("nominal", "delay_offset", "identified")} | models
    return {
        name: [
            {p: v["mpjae"] for p, v in run["new"]["by_payload"].items()} | {"all": run["new"]["mpjae"]}
            for run in compared["methods"][word]["runs"]
        ]
        for name, word in words.items()
    }


def after_calibration(work: Path, word: str, data: Dataset, nominal: RobotSpec) -> list[By]:
    """Each seed with 30 s of the unit, on the same test sequences."""
    out = []
    for run in cells(work, word):
        model, simulator = GapModel.load(run), corrected_robot(run, nominal)
        if UNIT not in calibration.load(run, model.weights_hash()):
            gaponet("calibrate", run, work / "default", "--unit", UNIT)
        own = calibration.load(run, model.weights_hash())[UNIT]
        entries = [e for e in choose([run], data)[0] if e.meta.unit_id == UNIT]
        out.append(mpjae(data.sequences(entries), nominal, own.robot(simulator), model.corrector(simulator)))
    return out


def on_shifted(work: Path, motions: list[str], nominal: RobotSpec) -> dict[str, list[By]]:
    """The same models and simulators on the other fleet, all its units."""
    recipe = work / "shifted.toml"
    payloads = [0.0, 1.0, 2.0, 3.0]
    recipe.write_text(
        f"motions = {json.dumps(motions)}\npayloads = {payloads}\nunits = {json.dumps(UNITS)}\nvariants = 2\n"
    )
    sequences = collected(work, "shifted", recipe, "shifted").sequences()
    found = {"nominal": [mpjae(sequences, nominal, nominal)]}
    found["identified"] = [mpjae(sequences, nominal, load_robot(work / "compare" / "identified"))]
    for name in ("mlp", "gaponet", "identified_gaponet"):
        models = [(GapModel.load(run), corrected_robot(run, nominal)) for run in cells(work, MODELS[name])]
        found[name] = [mpjae(sequences, nominal, robot, model.corrector(robot)) for model, robot in models]
    return found


def measure(work: Path, seeds: int, budget: str, models: dict[str, str]) -> dict[str, Any]:
    """Everything on the page."""
    nominal = load_robot("h1_2")
    data = collected(work, "default", RECIPE, "default")
    compared = gaponet(
        "compare", work / "default", "--out", work / "compare", "--models", *models.values(), "--seeds", seeds,
        "--budget", budget, "--identify", "--holdout-units", UNIT, *TRAINING,
    )  # fmt: skip
    unit = unseen_unit(compared, models)
    for name, calibrated in (("gaponet", "calibrated"), ("identified_gaponet", "identified_calibrated")):
        unit[calibrated] = after_calibration(work, MODELS[name], data, nominal)
    methods = compared["methods"]
    return {
        "virtual": True,
        **{k: compared[k] for k in ("motions", "budget", "simulator_hash")},
        "seeds": seeds,
        "minutes": {name: methods[word]["seconds"] / 60 for name, word in models.items()},
        "weights": {name: methods[word]["parameters"] for name, word in models.items()},
        "hours": sum(e.rows * e.dt for e in data.entries) / 3600,
        "sequences": len(data.entries),
        "unit": unit,
        "shifted": on_shifted(work, compared["motions"], nominal),
    }


def spread(found: list[By], payload: str) -> tuple[float, float]:
    """Mean and standard deviation over seeds."""
    values = [by[payload] for by in found]
    return float(np.mean(values)), float(np.std(values, ddof=1)) if len(values) > 1 else 0.0


def table(found: dict[str, list[By]], names: Iterable[str]) -> str:
    """Markdown: MPJAE in mrad by payload, and of nominal."""
    payloads = list(found["nominal"][0])
    heads = [f"{p} kg" if p != "all" else "mean" for p in payloads]
    rows = ["| method | " + " | ".join(heads) + " | of nominal | worst |", "| --- |" + " ---: |" * (len(heads) + 2)]
    for name in names:
        cells_of = []
        for p in payloads:
            mean, std = spread(found[name], p)
            cells_of.append(f"{mean * 1e3:.2f} ± {std * 1e3:.2f}" if std else f"{mean * 1e3:.2f}")
        ratio = {p: spread(found[name], p)[0] / spread(found["nominal"], p)[0] for p in payloads}
        worst = max((p for p in payloads if p != "all"), key=lambda p: ratio[p])
        rows.append(
            f"| {TITLES[name]} | {' | '.join(cells_of)} | {ratio['all']:.2f} | {ratio[worst]:.2f} ({worst} kg) |"
        )
    return "\n".join(rows)


def payloads_left_out(unit: dict[str, list[By]]) -> str:
    """The section on interpolation and extrapolation, where that was measured."""
    if "without_2" not in unit:
        return ""
    at = lambda name, p: "{:.2f} ± {:.2f}".format(*(1e3 * x for x in spread(unit[name], p)))  # noqa: E731
    return f"""## Payloads left out of training, the same unit, mrad

| trained on | asked at | with payload input | without |
| --- | --- | ---: | ---: |
| 0, 1, 3 kg | 2 kg | {at("without_2", "2")} | {at("without_2_blind", "2")} |
| 0, 1, 2, 3 kg | 2 kg | {at("gaponet", "2")} | |
| 0, 1, 2 kg | 3 kg | {at("without_3", "3")} | |
| 0, 1, 2, 3 kg | 3 kg | {at("gaponet", "3")} | |

{verdict(unit)}

"""


def verdict(unit: dict[str, list[By]]) -> str:
    """Whether being told the payload helps at a payload between those trained on: by more than two standard errors."""
    (told, told_std), (blind, blind_std) = (spread(unit[name], "2") for name in ("without_2", "without_2_blind"))
    noise = 2 * np.hypot(told_std / len(unit["without_2"]) ** 0.5, blind_std / len(unit["without_2_blind"]) ** 0.5)
    if abs(told - blind) <= noise:
        return "The model that is told the payload does no better at 2 kg than the one that is not, and no worse."
    return f"The model that is told the payload does {'better' if told < blind else 'worse'} at 2 kg than the other."


def page(r: dict[str, Any]) -> str:
    """The results as Markdown."""
    unit = r["unit"]
    times = ", ".join(f"{TITLES[n]} {r['minutes'][n]:.0f}" for n in ("mlp", "gaponet", "identified_gaponet"))
    return f"""# GAPONet on virtual H1-2 robots

**Every number on this page is from VIRTUAL robots.** {date.today()}, 2 cores, no GPU, {r["seeds"]} seeds, mean ± std.
Regenerate: `python benchmarks/virtual_h1_2.py WORK`.

Dataset: {r["sequences"]} sequences, {r["hours"]:.1f} h, 50 Hz, 0 to 3 kg in each hand, fleet `default`.
Trained on virtual-1 to virtual-3; measured on **virtual-4** and {len(r["motions"])} motions of which none was in
training, whole-motion free run of the shipped ONNX. Budget {r["budget"]} control steps each; minutes of training on one
core: {times}. Weights: GAPONet {r["weights"]["gaponet"]:,}, MLP {r["weights"]["mlp"]:,}. Simulator
{r["simulator_hash"]}.

## The unit never trained on, MPJAE in mrad

{table(unit, SHOWN)}

"Calibrated": after `gaponet calibrate` with 30 s of virtual-4 playing other motions.

{payloads_left_out(unit)}## Another fleet: `shifted`, other effects and larger spread, all four units, zero-shot, mrad

{table(r["shifted"], r["shifted"])}

![](virtual_h1_2.svg)
"""


def draw(r: dict[str, Any]) -> None:
    """Error by payload with spread over seeds: the unseen unit, and the shifted fleet."""
    with mpl.rc_context(STYLE | {"font.size": 10}):  # type: ignore[arg-type]
        fig = figure(10.5, 3.8)
        axes = fig.subplots(1, 2, width_ratios=[1.5, 1])
        titles = ("VIRTUAL unit 4, never trained on", "VIRTUAL fleet `shifted`, zero-shot")
        for ax, title, found in zip(axes, titles, (r["unit"], r["shifted"]), strict=True):
            names = [n for n in SHOWN if n in found]
            payloads = [p for p in found["nominal"][0] if p != "all"]
            width = 0.84 / len(names)
            for i, name in enumerate(names):
                values = 1e3 * np.array([spread(found[name], p) for p in payloads])
                x = np.arange(len(payloads)) + (i - (len(names) - 1) / 2) * width
                error = values[:, 1] if values[:, 1].any() else None
                ax.bar(x, values[:, 0], width * 0.92, yerr=error, color=FILL[name], error_kw={"lw": 0.8},
                       label=TITLES[name])  # fmt: skip
            ax.set_xticks(np.arange(len(payloads)), [f"{p} kg" for p in payloads])
            ax.grid(axis="x", visible=False)
            ax.set_title(title)
            ax.set_ylabel("MPJAE, mrad")
        handles, labels = axes[0].get_legend_handles_labels()
        fig.legend(handles, labels, loc="outside upper center", ncols=4)
        for suffix in ("svg", "png"):
            fig.savefig(DOCS / f"virtual_h1_2.{suffix}", dpi=160)


def main() -> None:
    """Measure, write, draw."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("work", type=Path)
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--budget", default="230400", help="of each run, as in gaponet train")
    parser.add_argument("--all-payloads-only", action="store_true", help="leave 3. out: half of the trainings")
    args = parser.parse_args()
    models = {n: w for n, w in MODELS.items() if not (args.all_payloads_only and n.startswith("without"))}
    result = measure(args.work, args.seeds, args.budget, models)
    DOCS.mkdir(parents=True, exist_ok=True)
    (DOCS / "virtual_h1_2.json").write_text(json.dumps(result, indent=1) + "\n", encoding="utf-8")
    (DOCS / "virtual_h1_2.md").write_text(page(result), encoding="utf-8")
    draw(result)
    print(page(result))


if __name__ == "__main__":
    main()
