"""Comparison of models: several seeds each, the same test motions, baselines beside them.

Every number is measured on the exported artifact in open-loop rollouts of whole motions. Units held out from training
form a group of their own.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import tyro

from gaponet.base.result_table import ResultTable, format_cell
from gaponet.data.split import split_entries
from gaponet.experiments.cells import Cell
from gaponet.experiments.outcomes import (
    BASELINES,
    Outcome,
    Show,
    StudyOutcomes,
    summarize,
    train_all,
)
from gaponet.experiments.result import Result
from gaponet.experiments.study import DEFAULT_MODELS, Study
from gaponet.report.candidate import select_entries
from gaponet.report.figures.style import bars, joint_label
from gaponet.report.methods import palette, title
from gaponet.robot.folder import save_robot
from gaponet.robot.spec import load_robot
from gaponet.sysid.identify import identify

if TYPE_CHECKING:
    from matplotlib.figure import Figure

MEASURES = ("mpjae", "rmse", "q_dis", "static", "dynamic", "large_0.05")
Runs = dict[
    str, list[Outcome]
]  # method → outcome of each seed; one outcome without a seed for a baseline


@dataclass(frozen=True)
class Compare:
    """Several models with several seeds in one table and one figure, baselines beside them.

    The same command continues an interrupted comparison; more seeds or models may be added to it.
    """

    models: tuple[str, ...] = DEFAULT_MODELS
    """Kinds, each with changed settings where wanted: mlp:mlp_hidden=256,128 or gaponet:sensors=predicted:history=8.
    gaponet:train_share=0.25 trains on a quarter of the motions. identified+KIND trains in the identified simulator
    (with --identify)."""
    holdout_units: tuple[str, ...] = ()
    """Units never trained on; shown as a group of their own."""
    identify: tyro.conf.FlagCreatePairsOff[bool] = False
    """Identify the simulator first, on the training motions, and show it too; stored in OUT/identified."""

    def cells(self, study: Study) -> list[Cell]:
        """Return a cell for every model and seed."""
        return study.cells(self.models)

    def run(self, study: Study, show: Show) -> Result:
        """Train the unfinished cells and return the result; it names the cells that failed."""
        cells = self.cells(study)
        failed = train_all(cells, study, show)
        result = self.result(study, StudyOutcomes.read(cells, study))
        return replace(result, sentences=(*result.sentences, *failed))

    def result(self, study: Study, outcomes: StudyOutcomes) -> Result:
        """Return totals, groups, and one row per method, seed and group in the CSV file."""
        word = next(iter(outcomes.runs))
        baselines = outcomes.baselines(word)
        runs: Runs = {name: [baselines[name]] for name in BASELINES if name in baselines}
        runs |= {
            word: list(outcomes.of_model(word)) for word in self.models if outcomes.of_model(word)
        }
        entries, unseen = select_entries([outcomes.cells[word][0].folder], study.data)
        seeds = max(map(len, runs.values()))
        heading = (
            f"Open-loop rollouts of {len(entries)} {'test ' if unseen else ''}recordings, whole motions; mean ± std "
            f"over {seeds} seed{'s' if seeds > 1 else ''}."
        )
        columns = ("method", "seed", "units", "group", "key", *MEASURES)
        tables = [
            ResultTable("all", columns, tuple(_long_rows(runs)), shown=False),
            _totals(runs),
            _groups(runs),
        ]
        return outcomes.result(
            study, "compare", "Comparison", tables, {"compare": _figure(runs, study.label)}, sentences=[heading],
            motions=sorted({e.meta.motion for e in entries}), unseen=unseen, sequences=len(entries),
        )  # fmt: skip


def with_identified(study: Study, progress: Callable[[float, float, str], None]) -> Study:
    """Return the study with the simulator identified on the training motions, stored once in OUT/identified."""
    folder = study.out / "identified"
    if not (folder / "robot.toml").is_file():
        parts = split_entries(study.data, study.holdout_units)
        train, val = (study.data.sequences(parts[part]) for part in ("train", "val"))
        save_robot(identify(train, study.robot, val, progress=progress).robot, folder)
    return replace(study, identified=load_robot(folder))


def _keys(runs: Runs, units: str, group: str) -> list[str]:
    """Return the payloads (in order of mass), units or joints of a group."""
    keys = list(runs["nominal"][0].get(units, {}).get(group, {}))
    return sorted(keys, key=float) if group == "by_payload" else keys


def _totals(runs: Runs) -> ResultTable:
    """One row per method."""
    payloads, new = _keys(runs, "known", "by_payload"), _keys(runs, "new", "by_unit")
    nominal = summarize(runs["nominal"], "known", "mpjae").mean
    columns = ["method", "weights", "MPJAE mrad", "of nominal", "Q_dis rad·s", *["worst payload"] * (len(payloads) > 1),
               *["new unit"] * bool(new), "min"]  # fmt: skip
    rows = []
    for method, outcomes in runs.items():
        error = summarize(outcomes, "known", "mpjae")
        row = [title(method), _count(outcomes[0].get("parameters")), error, error.mean / nominal if nominal else None,
               summarize(outcomes, "known", "q_dis", scale=1).mean]  # fmt: skip
        if len(payloads) > 1:
            by_payload = {
                p: summarize(outcomes, "known", "by_payload", p, "mpjae") for p in payloads
            }
            worst = max(by_payload, key=lambda p: by_payload[p].mean)
            row.append(f"{format_cell(by_payload[worst])} ({worst} kg)")
        if new:
            row.append(summarize(outcomes, "new", "mpjae"))
        rows.append((*row, format_cell(summarize(outcomes, "seconds", scale=1 / 60).mean, 1)))
    note = (
        f"Units never trained on: {', '.join(new)}; all other columns are of the units trained on."
        if new
        else ""
    )
    return ResultTable("totals", tuple(columns), tuple(rows), note)


def _groups(runs: Runs) -> ResultTable:
    """One row per payload, unit and joint; one column per method."""
    rows: list[tuple[Any, ...]] = []
    for units, group, label in (("known", "by_payload", "{} kg"), ("known", "by_unit", "{}"),
                                ("new", "by_unit", "{}, never trained on"), ("known", "by_joint", "{}")):  # fmt: skip
        keys = _keys(runs, units, group)
        if len(keys) > 1 or (units == "new" and keys):
            rows += [
                (label.format(k), *(summarize(o, units, group, k, "mpjae") for o in runs.values()))
                for k in keys
            ]
    return ResultTable("groups", ("MPJAE, mrad", *map(title, runs)), tuple(rows))


def _long_rows(runs: Runs) -> Iterator[tuple[Any, ...]]:
    """Yield a row per method, seed, group of units and payload, unit, joint, motion or all; rad and rad·s."""
    for method, outcomes in runs.items():
        for outcome in outcomes:
            for units in (u for u in ("known", "new") if u in outcome):
                groups = {"all": {"": outcome[units]}}
                groups |= {
                    g: outcome[units][f"by_{g}"] for g in ("payload", "unit", "joint", "motion")
                }
                for group, parts in groups.items():
                    for key, values in parts.items():
                        yield (
                            method,
                            outcome.get("seed"),
                            units,
                            group,
                            key,
                            *(values[m] for m in MEASURES),
                        )


def _figure(runs: Runs, label: str) -> Figure:
    """Draw bars by payload, or by joint with a single payload; units never trained on are at the right."""
    group = "by_payload" if len(_keys(runs, "known", "by_payload")) > 1 else "by_joint"
    places = {(f"{k} kg" if group == "by_payload" else joint_label(k)): ("known", group, k)
              for k in _keys(runs, "known", group)}  # fmt: skip
    places |= {
        f"{unit}\n(new unit)": ("new", "by_unit", unit) for unit in _keys(runs, "new", "by_unit")
    }
    colours = palette(runs)
    methods = {
        title(m): (colours[m], [summarize(outcomes, *path, "mpjae") for path in places.values()])
        for m, outcomes in runs.items()
    }
    return bars(
        list(places),
        methods,
        "MPJAE, mrad",
        f"Test motions, open-loop rollouts of whole motions, {label}",
    )


def _count(number: int | None) -> str:
    """Format a number of weights with three digits."""
    return (
        ""
        if number is None
        else f"{number / 1e6:.2f} M"
        if number >= 1e6
        else f"{number / 1e3:.3g} k"
    )
