"""gaponet pair, gaponet gap."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import tyro

from gaponet.cli.inputs import names, open_dataset
from gaponet.cli.out import Out
from gaponet.cli.progress import bar
from gaponet.robot import RobotSpec


def pair(
    dataset: tyro.conf.Positional[Path], robot: str | None = None, json: tyro.conf.FlagCreatePairsOff[bool] = False
) -> None:
    """Replay every sequence in the nominal simulator and keep the twin beside it.

    Args:
        dataset: Dataset folder.
        robot: Robot name or folder, if not the one that the dataset keeps.
        json: One JSON object on stdout.
    """
    from gaponet.sim.model import model_hash
    from gaponet.sim.pairing import pair_dataset

    out = Out(json)
    data, spec = open_dataset(dataset, robot)
    with bar("replaying") as update:
        made = pair_dataset(data, spec, lambda done, total: update(done, total, "control steps"))
    out.say(f"{made} twins made, {len(data) - made} were there; simulator {model_hash(spec)} in {dataset}")
    out.result({"made": made, "sequences": len(data), "simulator_hash": model_hash(spec)})


def gap(
    dataset: tyro.conf.Positional[Path],
    robot: str | None = None,
    motions: str = "",
    json: tyro.conf.FlagCreatePairsOff[bool] = False,
) -> None:
    """How far the nominal simulator is from the robot, per joint, payload, unit, motion and horizon.

    Args:
        dataset: Dataset folder; sequences without a twin are replayed first.
        robot: Robot name or folder, if not the one that the dataset keeps.
        motions: Only these, separated by commas.
        json: One JSON object on stdout.
    """
    from gaponet.gap import runs, summary
    from gaponet.sim.model import model_hash
    from gaponet.sim.pairing import pair_dataset

    out = Out(json)
    data, spec = open_dataset(dataset, robot)
    data.require_robot(spec)
    entries = data.select(names(motions))
    with bar("replaying") as update:
        pair_dataset(data, spec, lambda done, total: update(done, total, "control steps"))
    pairs = [data.pair(e, model_hash(spec)) for e in entries]
    result = {
        "methods": {"nominal": summary(runs([p.real for p in pairs], [p.sim.qpos for p in pairs], spec), spec)},
        "dataset": data.path.name,
        "sequences": len(pairs),
        "hours": sum(e.rows * e.dt for e in entries) / 3600,
        "virtual": any(e.meta.virtual for e in entries),
        "robot": spec.name,
        "simulator_hash": model_hash(spec),
    }
    show_methods(out, result, spec)
    out.result(result)


def show_methods(out: Out, result: dict[str, Any], robot: RobotSpec) -> None:
    """The tables of gap and eval: totals by method, then by joint, payload, unit, horizon and motion."""
    methods = result["methods"]
    kind = "VIRTUAL robot" if result["virtual"] else "real robot"
    out.say(
        f", {kind}, {result['sequences']} sequences, whole-motion free run; simulator {result['simulator_hash']}",
        result["robot"],
    )
    base = methods["nominal"]["mpjae"]
    columns = ["method", "MPJAE, mrad", "of nominal", "RMSE, mrad", "Q_dis, rad·s", "static", "dynamic", "≥ 0.05 rad"]
    out.table("Totals", columns, [
        [name, mrad(m["mpjae"]), f"{m['mpjae'] / base:.2f}" if base else "–", mrad(m["rmse"]), f"{m['q_dis']:.3f}",
         mrad(m["static"]), mrad(m["dynamic"]), f"{m['large_0.05'] * 100:.1f} %"]
        for name, m in methods.items()
    ])  # fmt: skip
    for group, title in (("joint", "joint"), ("payload", "payload, kg"), ("unit", "unit"), ("horizon", "horizon, s"),
                         ("motion", "motion")):  # fmt: skip
        keys = list(methods["nominal"][f"by_{group}"])
        if group in ("payload", "unit") and len(keys) < 2:
            continue
        out.table(f"MPJAE, mrad by {group}", [title, *methods], [
            [key, *(mrad(m[f"by_{group}"][key]["mpjae"]) for m in methods.values())] for key in keys
        ])  # fmt: skip


def mrad(value: float) -> str:
    """rad → milliradian text."""
    return f"{value * 1e3:.2f}"
