"""gaponet pair, gaponet gap."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import tyro

from gaponet import api
from gaponet.cli.out import Out
from gaponet.plot.methods import title
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

    out = Out(json)
    data, spec = api.open_dataset(dataset, robot)
    made = api.pair(data, spec)
    out.say(f"{made} twins made, {len(data) - made} were there; simulator {model_hash(spec)} in {dataset}")
    out.result({"made": made, "sequences": len(data), "simulator_hash": model_hash(spec)})


def gap(
    dataset: tyro.conf.Positional[Path],
    robot: str | None = None,
    motions: tuple[str, ...] = (),
    json: tyro.conf.FlagCreatePairsOff[bool] = False,
) -> None:
    """How far the nominal simulator is from the robot, per joint, payload, unit, motion and horizon.

    Args:
        dataset: Dataset folder; sequences without a twin are replayed first.
        robot: Robot name or folder, if not the one that the dataset keeps.
        motions: Only these.
        json: One JSON object on stdout.
    """
    out = Out(json)
    data, spec = api.open_dataset(dataset, robot)
    result = api.gap(data, spec, motions)
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
        [title(name), mrad(m["mpjae"]), f"{m['mpjae'] / base:.2f}" if base else "–", mrad(m["rmse"]),
         f"{m['q_dis']:.3f}", mrad(m["static"]), mrad(m["dynamic"]), f"{m['large_0.05'] * 100:.1f} %"]
        for name, m in methods.items()
    ])  # fmt: skip
    for group, heading in (("joint", "joint"), ("payload", "payload, kg"), ("unit", "unit"), ("horizon", "horizon, s"),
                         ("motion", "motion")):  # fmt: skip
        keys = list(methods["nominal"][f"by_{group}"])
        if group in ("payload", "unit") and len(keys) < 2:
            continue
        out.table(f"MPJAE, mrad by {group}", [heading, *map(title, methods)], [
            [key, *(mrad(m[f"by_{group}"][key]["mpjae"]) for m in methods.values())] for key in keys
        ])  # fmt: skip


def mrad(value: float) -> str:
    """rad → milliradian text."""
    return f"{value * 1e3:.2f}"
