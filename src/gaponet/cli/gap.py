"""gaponet gap."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from gaponet import api
from gaponet.base.executor import LOCAL
from gaponet.base.progress import progress_bar
from gaponet.cli.options import Data, Json, Motions, Robot, like
from gaponet.cli.out import Out
from gaponet.cli.show import show_baselines, show_methods, show_verdict
from gaponet.evaluation.methods import title
from gaponet.evaluation.tables import mrad
from gaponet.nn.packaged_networks import named_folder
from gaponet.sim.dataset_robot import open_dataset


@like(api.gap)
def gap(
    dataset: Data, run: Path | None = None, motions: Motions = (), robot: Robot = None, executor: str = LOCAL,
    json: Json = False,
) -> None:  # fmt: skip
    """How far is the simulator from the robot, by joint and payload?

    Without --robot the nominal simulator is measured. With an identified robot the causes of the error are shown.
    """
    out = Out(json)
    run = None if run is None else named_folder(run)
    data, spec = open_dataset(dataset, robot, run)
    with progress_bar("gap") as update:
        result = api.gap(
            data, robot=spec, motions=motions, run=run, executor=executor, progress=update
        )
    folder = run or (spec.folder if robot is None else Path(robot))
    if not result.by_cause:
        show_methods(out, result.to_dict())
    else:
        show_steps(out, result.table)
        if (folder / "gap.png").is_file():
            out.say(f"figure: {folder / 'gap.png'}")
    baselines = result.table["baselines"]
    count = len(result.methods["nominal"]["by_independent_motion"])
    show_baselines(out, baselines, count)
    own = folder if result.by_cause else None
    show_verdict(out, result.methods, str(dataset), own, baselines)
    out.result(result.to_dict())


def show_steps(out: Out, result: Mapping[str, Any]) -> None:
    """Print the error after each step, in total, by joint and by payload, and its reduction in total."""
    who = "VIRTUAL robot" if result["virtual"] else "real robot"
    count = f"{result['sequences']} {'test ' * result['unseen']}recording{'s' * (result['sequences'] != 1)} of a {who}"
    fitted = "" if result["unseen"] else ", some of them used in training"
    joints, loads, ends = result["by_joint"], result["by_payload"], ("floor", "unexplained")
    loads = loads if len(loads) > 1 else {}
    rest = lambda part: (part["floor"]["both"], part["unexplained"])  # noqa: E731
    removed = {s: [*map(mrad, result["removed"].get(s, ()))] or ["", ""] for s in result["left"]}
    one = list(removed.values())[-1][1] == mrad(None)  # motion: no standard error
    columns = ["reduced by, mrad"] if one else ["reduced by, mrad", "± standard error"]
    rows = [
        [title(s), mrad(left), *removed[s][: len(columns)], *(mrad(p[s]) for p in loads.values())]
        for s, left in result["left"].items()
    ]
    known = [(end, mrad(of)) for end, of in zip(ends, rest(result), strict=True) if of is not None]
    rows += [[end, of, *[""] * (len(columns) + len(loads))] for end, of in known]
    out.table(
        f"Mean |error| after each step: {count}{fitted}{', one motion' * one}",
        ["step", "error, mrad", *columns, *(f"{p} kg" for p in loads)],
        rows,
    )
    steps = list(result["left"])
    out.table("Mean |error| by joint and step, mrad", ["joint", *map(title, steps), *(end for end, _ in known)], [
        [name, *(mrad(part["left"][s]) for s in steps), *map(mrad, rest(part)[: len(known)])]
        for name, part in joints.items()
    ])  # fmt: skip
    if result["floor"]["repeatability"] is None:
        floor = "unknown" if result["floor"]["encoder"] is None else "of the encoder alone"
        out.say(f"floor (what no model can explain): {floor}, since no motion was recorded twice")
