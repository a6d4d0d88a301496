"""gaponet view."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import tyro

from gaponet.api.pages import Comparison, ViewOptions, compare
from gaponet.base.progress import progress_bar
from gaponet.cli.options import Data, Json, Robot
from gaponet.cli.out import Out
from gaponet.evaluation.methods import title
from gaponet.evaluation.tables import mrad


def view(
    dataset: Data,
    options: Annotated[ViewOptions, tyro.conf.arg(name="")] = ViewOptions(),  # noqa: B008
    render: Path | None = None,
    port: int = 8080,
    robot: Robot = None,
    json: Json = False,
) -> None:
    """Watch a recording beside its simulations: browser, film.

    Args:
        options: Which recording is shown, beside what, and how.
        render: Write a .gif, .mp4 or .png, and open no browser (.png: the moment of the largest
            nominal error).
        port: Port of the browser's page, on this machine.
    """
    screen = Out(json)
    with progress_bar("replaying") as update:
        made = compare(dataset, robot=robot, options=options, render=render, progress=update)
    _introduce(screen, made)
    if render is None:
        made.serve(port, screen.say)
    else:
        with progress_bar("rendering") as update:
            pictures = made.render(render, update)
        plural = "s" if pictures > 1 else ""
        size = render.stat().st_size / 1e6
        screen.say(f"{render}: {pictures} picture{plural}, {size:.2f} MB")
    screen.result(made.to_dict() | {"render": None if render is None else str(render)})


def _introduce(screen: Out, made: Comparison) -> None:
    """Print which recording is shown, and the errors of its simulations."""
    meta = made.entry.meta
    errors = [f"{title(name)} {mrad(error)} mrad" for name, error in made.errors.items()]
    kind = "VIRTUAL " if meta.virtual else ""
    text = f", {kind}unit {meta.unit_id}, {meta.payload_mass:g} kg; {', '.join(errors)}"
    screen.say(text, meta.motion)
    if made.shown.seen:
        text = "a model was trained or chosen on this recording: its error is no test error"
        screen.say("", text, "yellow")
