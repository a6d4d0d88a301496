"""Many models, several seeds, the same held-out motions: one table, one figure, baselines beside them.

Every number is that of the shipped artifact in free run. Units held out from training form a group of their own.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import Any

import tyro

from gaponet.base.result_table import MeanStd, ResultTable, format_cell
from gaponet.data.split import split_entries
from gaponet.experiments.found import Found, spread
from gaponet.experiments.options import MODELS
from gaponet.experiments.pool import Cell
from gaponet.experiments.result import Result
from gaponet.experiments.study import Study
from gaponet.report.candidate import choose
from gaponet.report.figures.charts import bars
from gaponet.report.figures.colours import palette
from gaponet.report.figures.style import joint_label
from gaponet.report.methods import title
from gaponet.robot.folder import save_robot
from gaponet.robot.spec import load_robot
from gaponet.sysid.identify import identify

MEASURES = ("mpjae", "rmse", "q_dis", "static", "dynamic", "large_0.05")
BASELINES = ("nominal", "delay_offset", "identified")


@dataclass(frozen=True)
class Compare:
    """Several models with several seeds in one table and one figure, baselines beside them.

    The same command again goes on where it was; more seeds or models may be added to it.
    """

    models: tuple[str, ...] = MODELS
    """Kinds, each with changed fields where wanted: mlp:mlp_hidden=256,128 or gaponet:sensors=predicted:history=8.
    identified+KIND trains in the identified simulator (with --identify)."""
    holdout_units: tuple[str, ...] = ()
    """Units never trained on; shown as a group of their own."""
    identify: tyro.conf.FlagCreatePairsOff[bool] = False
    """Identify the simulator first, on the training motions, and show it beside; kept in OUT/identified."""

    def cells(self, study: Study) -> list[Cell]:
        return study.cells(self.models)

    def result(self, study: Study, found: Found) -> Result:
        """Totals, groups, and a line per method, seed and group."""
        key = next(iter(found.runs))
        known = {b: [found.baselines(key)[b]] for b in BASELINES if b in found.baselines(key)}
        runs: Runs = known | {w: list(found.of_word(w)) for w in self.models if found.of_word(w)}
        entries, unseen = choose([found.cells[key][0].folder], study.data)
        seeds = max(map(len, runs.values()))
        heading = (
            f"Whole-motion free run on {len(entries)} {'held-out ' if unseen else ''}sequences, mean ± std over "
            f"{seeds} seed{'s' if seeds > 1 else ''}."
        )
        columns = ("method", "seed", "units", "group", "key", *MEASURES)
        tables = [
            ResultTable("all", columns, tuple(_lines(runs)), shown=False),
            _totals(runs),
            _groups(runs),
            _horizons(runs),
        ]
        motions = sorted({e.meta.motion for e in entries})
        return found.result(study, "compare", "Comparison", tables, {"compare": _figure(runs, study.who)}, [heading],
                            motions=motions, unseen=unseen, sequences=len(entries))  # fmt: skip


def identified(study: Study, tell: Callable[[float, float, str], None]) -> Study:
    """The study with the simulator identified on the training motions, in OUT/identified; once."""
    folder = study.out / "identified"
    if not (folder / "robot.toml").is_file():
        parts = split_entries(study.data, study.holdout_units)
        train, held = (study.data.sequences(parts[part]) for part in ("train", "val"))
        save_robot(identify(train, study.robot, held, progress=tell).robot, folder)
    return replace(study, identified=load_robot(folder))


Runs = dict[str, list[dict[str, Any]]]  # method → what each seed gave; a baseline has none


def keys(runs: Runs, units: str, group: str) -> list[str]:
    """Payloads, units or joints that there are; payloads in order of mass."""
    found = list(runs["nominal"][0].get(units, {}).get(group, {}))
    return sorted(found, key=float) if group == "by_payload" else found


def _totals(runs: Runs) -> ResultTable:
    """A row per method."""
    payloads, new = keys(runs, "known", "by_payload"), keys(runs, "new", "by_unit")
    nominal = spread(runs["nominal"], "known", "mpjae").mean
    columns = ["method", "weights", "MPJAE mrad", "of nominal", "Q_dis rad·s", *["worst payload"] * (len(payloads) > 1),
               *["new unit"] * bool(new), "min"]  # fmt: skip
    rows = []
    for m, found in runs.items():
        error = spread(runs[m], "known", "mpjae")
        row = [title(m), _count(found[0].get("parameters")), error, error.mean / nominal if nominal else None,
               spread(runs[m], "known", "q_dis", scale=1).mean]  # fmt: skip
        if len(payloads) > 1:
            by = {p: spread(runs[m], "known", "by_payload", p, "mpjae") for p in payloads}
            worst = max(by, key=lambda p: by[p].mean)
            row.append(f"{format_cell(by[worst])} ({worst} kg)")
        if new:
            row.append(spread(runs[m], "new", "mpjae"))
        minutes = MeanStd.from_values([run["seconds"] for run in found if "seconds" in run], 1 / 60).mean
        rows.append((*row, format_cell(minutes, 1)))
    note = f"Units never trained on: {', '.join(new)}; all other columns are of the units trained on." if new else ""
    return ResultTable("totals", tuple(columns), tuple(rows), note)


def _groups(runs: Runs) -> ResultTable:
    """A row per payload, unit and joint, a column per method."""
    rows = []
    for units, group, name in (("known", "by_payload", "{} kg"), ("known", "by_unit", "{}"),
                                ("new", "by_unit", "{}, never trained on"), ("known", "by_joint", "{}")):  # fmt: skip
        found = keys(runs, units, group)
        if len(found) > 1 or (units == "new" and found):
            rows += [(name.format(k), *(spread(runs[m], units, group, k, "mpjae") for m in runs)) for k in found]
    return ResultTable("groups", ("MPJAE, mrad", *(title(m) for m in runs)), tuple(rows))


def _horizons(runs: Runs) -> ResultTable:
    """A row per time since the common start."""
    times = list(runs["nominal"][0]["known"].get("by_horizon", {}))
    name = lambda t: f"{t} s" if t != "whole" else "whole motion"  # noqa: E731
    rows = [(name(t), *(spread(f, "known", "by_horizon", t, "mpjae") for f in runs.values())) for t in times]
    note = "MPJAE in mrad by time since the common start, of the last half of that time."
    return ResultTable("horizons", ("after", *(title(m) for m in runs)), tuple(rows), note)


def _lines(runs: Runs) -> Iterator[tuple[Any, ...]]:
    """One line per method, seed, group of units and payload, unit, joint, motion or all; rad and rad·s."""
    for method, found in runs.items():
        for run in found:
            for units in (u for u in ("known", "new") if u in run):
                groups = {"all": {"": run[units]}}
                groups |= {g: run[units][f"by_{g}"] for g in ("payload", "unit", "joint", "motion")}
                for group, parts in groups.items():
                    for key, values in parts.items():
                        yield method, run.get("seed"), units, group, key, *(values[m] for m in MEASURES)


def _figure(runs: Runs, who: str) -> Any:
    """Bars by payload, or by joint where there is one payload; units never trained on at the right."""
    group = "by_payload" if len(keys(runs, "known", "by_payload")) > 1 else "by_joint"
    places = {(f"{k} kg" if group == "by_payload" else joint_label(k)): ("known", group, k)
              for k in keys(runs, "known", group)}  # fmt: skip
    places |= {f"{unit}\n(new unit)": ("new", "by_unit", unit) for unit in keys(runs, "new", "by_unit")}
    colours = palette(runs)
    methods = {title(m): (colours[m], [spread(runs[m], *path, "mpjae") for path in places.values()]) for m in runs}
    return bars(list(places), methods, "MPJAE, mrad", f"Held-out motions, whole-motion free run, {who}")


def _count(number: int | None) -> str:
    """Three digits are enough."""
    return "" if number is None else f"{number / 1e6:.2f} M" if number >= 1e6 else f"{number / 1e3:.3g} k"
