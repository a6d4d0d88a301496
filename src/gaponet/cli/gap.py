"""gaponet gap, and how errors are shown."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from gaponet import api
from gaponet.cli.options import Data, Json, Motions, Robot, like
from gaponet.cli.out import Out
from gaponet.data.store import open_dataset
from gaponet.eval.tables import by_group, mrad, totals
from gaponet.plot.methods import title

UNITS = {"payload": ", kg", "horizon": ", s"}


@like(api.gap)
def gap(dataset: Data, run: Path | None = None, motions: Motions = (), robot: Robot = None, json: Json = False) -> None:
    """How far the simulator is from the robot, by joint, payload, …; with --run what each step up to its model removes.

    Sequences without a twin are replayed in the nominal simulator first, and the twins kept.
    """
    out = Out(json)
    data, spec = open_dataset(dataset, robot, run)
    found = api.gap(data, spec, motions, run)
    if run is None:
        show_methods(out, found)
    else:
        _show_steps(out, found)
        out.say(f"figure: {run / 'gap.png'}")
    out.result(found)


def show_methods(out: Out, result: dict[str, Any]) -> None:
    """The tables of gap and eval: totals by method, then by joint, payload, unit, horizon and motion."""
    methods, kind = result["methods"], "VIRTUAL robot" if result["virtual"] else "real robot"
    out.say(
        f", {kind}, {result['sequences']} sequences, whole-motion free run; simulator {result['simulator_hash']}",
        result["robot"],
    )
    out.show("Totals", totals(methods, simulators=result.get("simulators")))
    for group in ("joint", "payload", "unit", "horizon", "motion"):
        if group not in ("payload", "unit") or len(methods["nominal"][f"by_{group}"]) > 1:
            out.show(f"By {group}{UNITS.get(group, '')}", by_group(methods, group))


def _show_steps(out: Out, found: dict[str, Any]) -> None:
    """What is left after each step, and in brackets what the step removes."""
    steps = list(found["left"])
    who = "VIRTUAL robot" if found["virtual"] else "real robot"
    kind = "held-out recordings" if found["unseen"] else "recordings, some of them used in training"
    panels = {"all joints": found} | found["by_joint"]
    out.table(f"Mean |error| left after each step, mrad: {found['sequences']} {kind} of a {who}",
              ["", *map(title, steps), "floor", "unexplained"], [
        *([j, *(_left(v, s) for s in steps), mrad(v["floor"]["both"]), mrad(v["unexplained"])]
          for j, v in panels.items()),
        *([f"{p} kg", *(mrad(v[s]) for s in steps), "", ""] for p, v in found["by_payload"].items()),
    ])  # fmt: skip
    out.say("in brackets: what the step removes ± its standard error over motions")
    if found["floor"]["repeatability"] is None:
        rest = "unknown, encoders too" if found["floor"]["encoder"] is None else "encoder only"
        out.say(f"floor: {rest}; no motion was recorded twice or repeats itself: repeatability is unknown")


def _left(panel: dict[str, Any], step: str) -> str:
    if step not in panel["removed"]:
        return mrad(panel["left"][step])
    less, error = panel["removed"][step]
    return f"{mrad(panel['left'][step])} ({mrad(less)} ± {mrad(error)})"
