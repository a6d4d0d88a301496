"""Many models, several seeds, the same held-out motions: one table, one figure.

Every number is that of the shipped artifact in free run. Units held out from training form a group of their own: what
is said of the units trained on is not mixed with what is said of a unit never seen.
"""

from __future__ import annotations

import csv
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure

from gaponet.data.json_file import write_json
from gaponet.data.sequence import Sequence
from gaponet.data.store import Dataset
from gaponet.eval.evaluate import choose
from gaponet.files import whole, write_text
from gaponet.gap import Run, runs, summary
from gaponet.model.artifact import GapModel
from gaponet.model.baselines.delay_offset import DelayOffset
from gaponet.plot.methods import COLOURS, NAMES
from gaponet.plot.style import figure, styled
from gaponet.robot import RobotSpec
from gaponet.sim.model import model_hash
from gaponet.sim.replay import Corrector, replay

Result = dict[str, Any]
BASELINES = ("nominal", "delay_offset", "identified")
CSV_COLUMNS = ("method", "seed", "units", "group", "key", "mpjae", "rmse", "q_dis", "static", "dynamic", "large_0.05")


def evaluate_model(run: Path, dataset: Dataset, robot: RobotSpec, holdout: tuple[str, ...], nthread: int = 0) -> Result:
    """Metrics of a run's artifact on the test motions, by group of units.

    Args:
        run: Run folder.
        dataset: The one trained on.
        robot: The simulator that the model corrects.
        holdout: Units never trained on.
        nthread: Threads of the simulator, 0 for all cores.
    """
    model = GapModel.load(run)
    sequences = dataset.sequences(choose([run], dataset)[0])
    for dt in sorted({s.dt for s in sequences}):
        model.require(robot, dt)
    return _grouped(sequences, robot, model.corrector(robot), holdout, nthread)


def evaluate_baselines(
    run: Path, dataset: Dataset, nominal: RobotSpec, identified: RobotSpec | None, holdout: tuple[str, ...]
) -> Result:
    """The same of the nominal simulator, of delay + offset as kept in a run, and of the identified simulator."""
    fitted = DelayOffset.read(run)
    sequences = dataset.sequences(choose([run], dataset)[0])
    out = {
        "nominal": _grouped(sequences, nominal, None, holdout),
        "delay_offset": _grouped(sequences, nominal, fitted.corrector(nominal), holdout),
    }
    return out if identified is None else out | {"identified": _grouped(sequences, identified, None, holdout)}


def _grouped(
    sequences: list[Sequence], robot: RobotSpec, corrector: Corrector | None, holdout: tuple[str, ...], nthread: int = 0
) -> Result:
    """{"known": summary, "new": summary of units held out, where there are any}."""
    twins = replay(sequences, robot, corrector, nthread, lock_idle=True)
    done = runs(sequences, [t.qpos for t in twins], robot)
    of: Callable[[bool], list[Run]] = lambda new: [r for r in done if (r.real.meta.unit_id in holdout) == new]  # noqa: E731
    return {name: summary(of(new), robot) for name, new in (("known", False), ("new", True)) if of(new)}


def comparison(
    dataset: Dataset,
    run: Path,
    nominal: RobotSpec,
    baselines: Result,
    cells: dict[str, list[Result]],
    facts: Result,
) -> Result:
    """Everything that was measured, as compare.json keeps it.

    Args:
        dataset: The one compared on.
        run: Any of the runs; all have the same split.
        nominal: The nominal simulator.
        baselines: Of evaluate_baselines.
        cells: Method → what each of its seeds gave, with kind, changes and start.
        facts: What else is to be said: budget, units held out.
    """
    entries, unseen = choose([run], dataset)
    methods: Result = {
        name: {"title": NAMES[name], "kind": name, "changes": [], "parameters": None, "seconds": None, "runs": [found]}
        for name, found in baselines.items()
    }
    for name, found in cells.items():
        first = found[0]
        methods[name] = {
            "title": _title(first),
            "kind": first["kind"],
            "changes": first["changes"],
            "start": first["start"],
            "parameters": first["parameters"],
            "seconds": float(np.mean([c["seconds"] for c in found])),
            "runs": found,
        }
    for method in methods.values():
        method["mpjae"] = _spread(method, "known", "mpjae")
    return {
        "dataset": dataset.path.name,
        "robot": nominal.name,
        "virtual": any(e.meta.virtual for e in entries),
        "unseen": unseen,
        "sequences": len(entries),
        "motions": sorted({e.meta.motion for e in entries}),
        "simulator_hash": model_hash(nominal),
        **facts,
        "methods": methods,
    }


def _title(cell: Result) -> str:
    name = NAMES.get(cell["kind"]) or str(cell["kind"])
    start = "identification + " if cell["start"] == "identified" else ""
    return start + name + (f" ({', '.join(c.replace('=', ' ') for c in cell['changes'])})" if cell["changes"] else "")


def _spread(method: Result, units: str, *path: str) -> tuple[float, float]:
    """Mean and standard deviation over seeds of one number; NaN where there is none, or no second seed."""
    values = []
    for value in (r.get(units) for r in method["runs"]):
        for key in path:
            value = value.get(key) if value else None
        if value is not None:
            values.append(value)
    mean = float(np.mean(values)) if values else float("nan")
    return mean, float(np.std(values, ddof=1)) if len(values) > 1 else float("nan")


def main_table(result: Result) -> tuple[list[str], list[list[str]]]:
    """Columns and rows: one row per method."""
    nominal = _spread(result["methods"]["nominal"], "known", "mpjae")[0]
    payloads, new = keys(result, "known", "by_payload"), keys(result, "new", "by_unit")
    columns = ["method", "weights", "MPJAE mrad", "of nominal", "Q_dis rad·s"]
    columns += ["worst payload"] if len(payloads) > 1 else []
    columns += ["new unit"] if new else []
    rows = []
    for m in result["methods"].values():
        mpjae = _spread(m, "known", "mpjae")
        row = [m["title"], _count(m["parameters"]), _mrad(mpjae)]
        row += [f"{mpjae[0] / nominal:.2f}" if nominal else "–", f"{_spread(m, 'known', 'q_dis')[0]:.2f}"]
        if len(payloads) > 1:
            by = {p: _spread(m, "known", "by_payload", p, "mpjae") for p in payloads}
            worst = max(by, key=lambda p: by[p][0])
            row.append(f"{_mrad(by[worst])} ({worst} kg)")
        if new:
            row.append(_mrad(_spread(m, "new", "mpjae")))
        rows.append([*row, f"{m['seconds'] / 60:.1f}" if m["seconds"] else ""])
    return [*columns, "min"], rows


def group_table(result: Result) -> tuple[list[str], list[list[str]]]:
    """MPJAE in mrad, a row per payload, unit and joint, a column per method."""
    methods = list(result["methods"].values())
    rows = []
    for units, group, title in (("known", "by_payload", "{} kg"), ("known", "by_unit", "{}"),
                                ("new", "by_unit", "{}, never trained on"), ("known", "by_joint", "{}")):  # fmt: skip
        found = keys(result, units, group)
        if len(found) > 1 or (units == "new" and found):
            rows += [[title.format(k), *(_mrad(_spread(m, units, group, k, "mpjae")) for m in methods)] for k in found]
    return ["MPJAE, mrad", *(m["title"] for m in methods)], rows


def keys(result: Result, units: str, group: str) -> list[str]:
    """Payloads, units or joints that there are; payloads in order of mass."""
    found = list(result["methods"]["nominal"]["runs"][0].get(units, {}).get(group, {}))
    return sorted(found, key=float) if group == "by_payload" else found


def _count(number: int | None) -> str:
    """Three digits are enough."""
    return "" if number is None else f"{number / 1e6:.2f} M" if number >= 1e6 else f"{number / 1e3:.3g} k"


def _mrad(spread: tuple[float, float]) -> str:
    mean, std = spread
    if mean != mean:
        return ""
    return f"{mean * 1e3:.2f}" + (f" ± {std * 1e3:.2f}" if std == std else "")


def heading(result: Result) -> str:
    """What was compared, in one sentence."""
    who = "VIRTUAL robot" if result["virtual"] else "real robot"
    seeds = max(len(m["runs"]) for m in result["methods"].values())
    return (
        f"{result['robot']}, {who}, whole-motion free run on {result['sequences']} "
        f"{'held-out ' if result['unseen'] else ''}sequences, mean ± std over {seeds} seed{'s' if seeds > 1 else ''}; "
        f"budget {result['budget']} per model; simulator {result['simulator_hash']}"
    )


def write(result: Result, out: Path) -> list[Path]:
    """compare.json, .csv, .md, .svg and .png; returns the files."""
    from gaponet.plot.style import save

    write_json(out / "compare.json", result)
    with whole(out / "compare.csv") as temporary, temporary.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow(CSV_COLUMNS)
        writer.writerows(_lines(result))
    new = keys(result, "new", "by_unit")
    text = f"# Comparison\n\n{heading(result)}.\n\n{_markdown(*main_table(result))}\n\n"
    if new:
        text += f"Units never trained on: {', '.join(new)}; all other columns are of the units trained on.\n\n"
    text += f"{_markdown(*group_table(result))}\n\n![](compare.svg)\n\nMotions: {', '.join(result['motions'])}.\n"
    write_text(out / "compare.md", text)
    return [*(out / f"compare.{suffix}" for suffix in ("json", "csv", "md")), *save(draw(result), out / "compare")]


def _markdown(columns: list[str], rows: list[list[str]]) -> str:
    lines = [columns, ["---", *["---:"] * (len(columns) - 1)], *rows]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines)


def _lines(result: Result) -> Iterator[list[Any]]:
    """One line per method, seed, group of units and payload, unit, joint, motion or all; rad and rad·s."""
    for name, method in result["methods"].items():
        for run in method["runs"]:
            for units in ("known", "new"):
                if units not in run:
                    continue
                groups = {"all": {"": run[units]}}
                groups |= {g: run[units][f"by_{g}"] for g in ("payload", "unit", "joint", "motion")}
                for group, parts in groups.items():
                    for key, metrics in parts.items():
                        values = [metrics[c] for c in CSV_COLUMNS[5:]]
                        yield [name, run.get("seed", ""), units, group, key, *values]


@styled
def draw(result: Result) -> Figure:
    """MPJAE by payload, or by joint where there is one payload; units never trained on at the right; std over seeds."""
    payloads = keys(result, "known", "by_payload")
    group = "by_payload" if len(payloads) > 1 else "by_joint"
    places = [("known", (group, k)) for k in keys(result, "known", group)]
    labels = [
        f"{k} kg" if group == "by_payload" else k.removesuffix("_joint").replace("_", "\n") for _, (_, k) in places
    ]
    for unit in keys(result, "new", "by_unit"):
        places.append(("new", ("by_unit", unit)))
        labels.append(f"{unit}\n(new unit)")
    methods = result["methods"]
    colours = palette(methods)
    width = 0.8 / len(methods)
    fig = figure(max(5.6, 0.16 * len(places) * len(methods) + 1.8), 3.4)
    ax = fig.subplots()
    for i, (name, m) in enumerate(methods.items()):
        x = np.arange(len(places)) + (i - (len(methods) - 1) / 2) * width
        found = [_spread(m, units, *path, "mpjae") for units, path in places]
        mean, std = 1e3 * np.array(found).T
        error = None if np.isnan(std).all() else std
        ax.bar(x, mean, width * 0.92, yerr=error, color=colours[name], error_kw={"lw": 0.8}, label=m["title"])
    ax.set_xticks(np.arange(len(places)), labels)
    ax.grid(axis="x", visible=False)
    ax.set_ylabel("MPJAE, mrad")
    ax.set_title("Held-out motions, whole-motion free run" + (", VIRTUAL robot" if result["virtual"] else ""))
    columns = max(1, min(len(methods), int(fig.get_figwidth() / 1.6)))
    fig.legend(loc="outside upper left", ncols=columns, columnspacing=1.1, handlelength=1.4)
    return fig


def palette(methods: Result) -> dict[str, Any]:
    """A colour per method: its kind's as in every figure, darker from the identified simulator, lighter per variant."""
    spare = iter(("#00838f", "#8d6e63", "#7cb342", "#ad1457", "#455a64", "#f4511e"))
    base = dict(COLOURS)
    seen: dict[tuple[str, bool], int] = {}
    out = {}
    for name, m in methods.items():
        kind, fitted = m["kind"], m.get("start") == "identified"
        if kind not in base:
            base[kind] = next(spare, "#777777")
        lighter = 1 - 0.62 ** seen.setdefault((kind, fitted), 0)
        seen[kind, fitted] += 1
        colour = np.array(to_rgb(base[kind])) * (0.6 if fitted else 1.0)
        out[name] = tuple(float(c) for c in colour + (1 - colour) * lighter)
    return out
