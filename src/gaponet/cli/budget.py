"""gaponet budget."""

from __future__ import annotations

import json as js
from pathlib import Path
from typing import Any

import tyro

from gaponet.cli.gap import mrad
from gaponet.cli.out import Out
from gaponet.data.store import open_dataset
from gaponet.progress import bar


def budget(
    run: tyro.conf.Positional[Path],
    dataset: tyro.conf.Positional[Path],
    motions: tuple[str, ...] = (),
    robot: str | None = None,
    json: tyro.conf.FlagCreatePairsOff[bool] = False,
) -> None:
    """Show where the gap comes from: what delay, offset, identification and the model each remove, and the floor.

    Writes RUN/budget.json, budget.svg and budget.png; the report shows them.

    Args:
        run: Run folder of gaponet train; one trained with --robot of an identified simulator has that step too.
        dataset: The dataset trained on (its test motions are used) or another.
        motions: Only these.
        robot: Robot name or folder, if not the one that the dataset keeps.
        json: One JSON object on stdout.
    """
    from gaponet.eval.budget import gap_budget
    from gaponet.eval.budget_figure import waterfall
    from gaponet.files import write_text, writing
    from gaponet.plot.style import save

    out = Out(json)
    data, spec = open_dataset(dataset, robot, run)
    with bar("budget") as update:
        found = gap_budget(run, data, spec, motions, lambda step, done, total: update(done, total, step))
    with writing(run, "run"):
        write_text(run / "budget.json", js.dumps(found, indent=1) + "\n")
        save(waterfall(found), run / "budget")
    steps = list(found["left"])
    who = "VIRTUAL robot" if found["virtual"] else "real robot"
    kind = "held-out recordings" if found["unseen"] else "recordings, some of them used in training"
    out.table(
        f"Mean |error| left after each step, mrad: {found['sequences']} {kind} of a {who}",
        ["", *steps, "floor"],
        [
            *(
                [j, *(_left(v, s) for s in steps), _floor(v)]
                for j, v in ({"all joints": found} | found["by_joint"]).items()
            ),
            *([f"{p} kg", *(mrad(v[s]) for s in steps), ""] for p, v in found["by_payload"].items()),
        ],
    )
    out.say("in brackets: what the step removes ± its standard error over motions")
    if found["floor"]["repeatability"] is None:
        rest = "unknown, encoders too" if found["floor"]["encoder"] is None else "encoder only"
        out.say(f"floor: {rest}; no motion was recorded twice, so repeatability is unknown")
    out.say(f"figure: {run / 'budget.png'}")
    out.result(found)


def _floor(panel: dict[str, Any]) -> str:
    value = panel["floor"]["both"]
    return "–" if value is None else mrad(value)


def _left(panel: dict[str, Any], step: str) -> str:
    if step not in panel["removed"]:
        return mrad(panel["left"][step])
    less, error = panel["removed"][step]
    return f"{mrad(panel['left'][step])} ({mrad(less)} ± {mrad(error)})"
