"""`gaponet collect`: play a recipe on a virtual fleet and record it."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import tyro

from gaponet import api
from gaponet.api.options import CollectOptions
from gaponet.base.progress import progress_bar
from gaponet.cli.options import Json, like
from gaponet.cli.out import Out


@like(api.collect)
def collect(
    out: Path,
    robot: str = "h1_2",
    options: Annotated[CollectOptions, tyro.conf.arg(name="")] = CollectOptions(),  # noqa: B008
    executor: str = "local",
    json: Json = False,
) -> None:
    """Record motions of VIRTUAL robots into a dataset.

    Run again after an interruption: recordings that exist stay, missing ones are recorded, and the
    result is the same.
    """
    screen = Out(json)
    with progress_bar("virtual recordings") as update:
        made = api.collect(
            out=out,
            robot=robot,
            options=options,
            executor=executor,
            progress=update,
        )
    screen.table(
        f"VIRTUAL recordings, fleet {options.fleet}",
        ["dataset", str(made.dataset)],
        [
            ["sequences written", str(made.written)],
            ["already there", str(made.present)],
            ["recorded time", f"{made.hours:.2f} h"],
            ["wall time", f"{made.seconds:.0f} s ({made.times_real_time:.0f} × real time)"],
        ],
    )
    screen.result(made.to_dict())
