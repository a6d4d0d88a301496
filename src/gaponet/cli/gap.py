"""gaponet gap."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from gaponet import api
from gaponet.api.opening import as_run
from gaponet.base.executor import LOCAL
from gaponet.base.progress import progress_bar
from gaponet.cli.options import Data, Json, Motions, Robot, like
from gaponet.cli.out import Out
from gaponet.cli.show import show_baselines, show_methods, show_verdict
from gaponet.evaluation.methods import title
from gaponet.evaluation.tables import mrad
from gaponet.robot.folder import STORED_ROBOT

NO_FLOOR = "floor (what no model can explain): {}, since no motion was recorded twice"


@like(api.gap)
def gap(
    dataset: Data,
    run: Path | None = None,
    motions: Motions = (),
    robot: Robot = None,
    executor: str = LOCAL,
    json: Json = False,
) -> None:
    """How far is the simulator from the robot, by joint and payload?

    Without --robot and --run the nominal simulator is measured. With an identified robot or a
    network the causes of the error are shown.
    """
    screen = Out(json)
    with progress_bar("gap") as update:
        result = api.gap(
            dataset, robot=robot, motions=motions, run=run, executor=executor, progress=update
        )
    candidate = _candidate(dataset, run, robot) if result.by_cause else None
    if candidate is None:
        show_methods(screen, result.to_dict())
    else:
        show_steps(screen, result.table)
        if (candidate / "gap.png").is_file():
            screen.say(f"figure: {candidate / 'gap.png'}")
    baselines = result.table["baselines"]
    count = len(result.methods["nominal"]["by_independent_motion"])
    show_baselines(screen, baselines, count)
    show_verdict(screen, result.methods, str(dataset), candidate, baselines)
    screen.result(result.to_dict())


def _candidate(dataset: Path, run: Path | None, robot: str | None) -> Path:
    """Return the folder of the identified robot or of the run whose causes are shown."""
    if run is not None:
        return as_run(run)
    if robot is not None:
        return Path(robot)
    return dataset / STORED_ROBOT


def show_steps(screen: Out, table: Mapping[str, Any]) -> None:
    """Print the error after each step, in total, by joint and by payload, and its reduction.

    Args:
        table: GapResult.table of an identified robot or a run.
    """
    _show_totals(screen, table)
    _show_joints(screen, table)
    if table["floor"]["repeatability"] is None:
        only = "unknown" if table["floor"]["encoder"] is None else "of the encoder alone"
        screen.say(NO_FLOOR.format(only))


def _show_totals(screen: Out, table: Mapping[str, Any]) -> None:
    """Print the error after each step, its reduction, and the same by payload."""
    steps = list(table["left"])
    # One motion has no standard error, which mrad shows as a dash.
    _, last_error = _removed(table, steps[-1])
    one_motion = last_error == mrad(None)
    payloads = table["by_payload"] if len(table["by_payload"]) > 1 else {}
    columns = ["step", "error, mrad", "reduced by, mrad"]
    if not one_motion:
        columns.append("± standard error")
    columns += [f"{payload} kg" for payload in payloads]
    rows = []
    for step in steps:
        reduction, error = _removed(table, step)
        row = [title(step), mrad(table["left"][step]), reduction]
        if not one_motion:
            row.append(error)
        rows.append([*row, *(mrad(errors[step]) for errors in payloads.values())])
    for name, value in _unexplained(table).items():
        row = [name, mrad(value)]
        rows.append(row + [""] * (len(columns) - len(row)))
    screen.table(f"Mean |error| after each step: {_measured_on(table, one_motion)}", columns, rows)


def _show_joints(screen: Out, table: Mapping[str, Any]) -> None:
    """Print the error of each joint after each step."""
    steps = list(table["left"])
    known = list(_unexplained(table))
    rows = []
    for joint, part in table["by_joint"].items():
        own = {"floor": part["floor"]["both"], "unexplained": part["unexplained"]}
        row = [joint, *(mrad(part["left"][step]) for step in steps)]
        rows.append([*row, *(mrad(own[name]) for name in known)])
    columns = ["joint", *map(title, steps), *known]
    screen.table("Mean |error| by joint and step, mrad", columns, rows)


def _measured_on(table: Mapping[str, Any], one_motion: bool) -> str:
    """Return on which recordings a gap was measured."""
    who = "VIRTUAL robot" if table["virtual"] else "real robot"
    test = "test " if table["unseen"] else ""
    plural = "" if table["sequences"] == 1 else "s"
    fitted = "" if table["unseen"] else ", some of them used in training"
    one = ", one motion" if one_motion else ""
    return f"{table['sequences']} {test}recording{plural} of a {who}{fitted}{one}"


def _removed(table: Mapping[str, Any], step: str) -> list[str]:
    """Return by how much a step reduces the error and the standard error, mrad; "" for the first
    step.
    """
    values = table["removed"].get(step, ())
    return [mrad(value) for value in values] or ["", ""]


def _unexplained(table: Mapping[str, Any]) -> dict[str, float]:
    """Return what no model can explain, and the rest above it, rad, as far as they are known."""
    values = {"floor": table["floor"]["both"], "unexplained": table["unexplained"]}
    return {name: value for name, value in values.items() if value is not None}
