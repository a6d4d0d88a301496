"""What the steps of the page are made of: buttons whose errors are shown, uploads, and places for
results.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from gaponet.base.errors import GAPONetError, UsageError
from gaponet.base.text import escape_markdown
from gaponet.report.steps import TITLES, Step
from gaponet.report.view.job_text import picture, report
from gaponet.report.view.jobs import NEEDS, Job, Jobs
from gaponet.report.view.uploads import Uploads, connect_upload_button

# Step whose result another step uses → what to do if it is missing.
FIRST = {
    "robot": "Choose a robot in step 1 first.",
    "import": "Read the logs in step 2 first.",
    "doctor": "Check the recordings in step 3 first.",
    "identify": "Identify the robot in step 5 first.",
    "new": "Read the new logs first.",
    "train": "Train a network first.",
}


@dataclass
class Place:
    """Where a step's result stands.

    Attributes:
        hint: What stands there before, once the step may be done.
        text: Markdown of the page.
        pictures: HTML of the page.
    """

    hint: str
    text: Any
    pictures: Any


class Controls:
    """Adds controls to the page. An error of one is shown above the steps, and the page goes on.

    Attributes:
        gui: viser's controls.
        folder: The page's folder.
        jobs: Its commands.
        status: Markdown above the steps.
        places: Step → place of its result.
    """

    def __init__(self, gui: Any, folder: Path, jobs: Jobs) -> None:
        self.gui = gui
        self.folder = folder
        self.jobs = jobs
        self.status = gui.add_markdown("")
        self.places: dict[str, Place] = {}

    def say(self, text: str) -> None:
        """Show Markdown above the steps."""
        self.status.content = text

    def attempt(self, act: Callable[..., None], *arguments: Any) -> None:
        """Call a function; an error is shown above the steps."""
        try:
            act(*arguments)
        except Exception as error:  # whatever it is, the page and the running command go on
            kind = ""
            if not isinstance(error, (GAPONetError, OSError)):
                kind = f"Unexpected {type(error).__name__}: "
            self.say(f"**Not done.** {kind}{escape_markdown(str(error))}")

    def add_button(self, label: str, act: Callable[[], None]) -> Any:
        """Add a button that calls a function."""
        button = self.gui.add_button(label)
        button.on_click(lambda _: self.attempt(act))
        return button

    def add_step(self, name: str, make: Callable[[], Step]) -> Any:
        """Add the button of a step; `make` returns the step as the page's fields have it."""
        return self.add_button(TITLES[name], lambda: self.jobs.start(make()))

    def add_upload(self, label: str, uploads: Uploads, place: str) -> None:
        """Add a button that stores files in a folder of the page."""

        def receive(name: str, content: bytes) -> None:
            self.attempt(uploads.receive, name, content, place)

        connect_upload_button(self.gui.add_upload_button(label), receive)

    def add_place(self, step: str, hint: str) -> None:
        """Add the place of a step's result; `hint` stands there once the step may be done."""
        self.places[step] = Place(hint, self.gui.add_markdown(hint), self.gui.add_html(""))

    def first(self, step: str) -> str:
        """Return what to do first, so that a step has a result; "" if it has one."""
        needed = NEEDS.get(step)
        earlier = self.first(needed) if needed is not None else ""
        if earlier or self.jobs.result(step) is not None:
            return earlier
        return FIRST[step]

    def hint(self, step: str) -> str:
        """Return what to do for the result of a step."""
        needed = NEEDS.get(step)
        earlier = self.first(needed) if needed is not None else ""
        return earlier or self.places[step].hint

    def need(self, step: str) -> Job:
        """Return the result of a step.

        Raises:
            UsageError: There is none; it says what to do first.
        """
        job = self.jobs.result(step)
        if job is None:
            raise UsageError(self.first(step))
        return job

    def show(self, step: str, figures: Iterable[str] = ()) -> None:
        """Show the result of a step, or what to do for one.

        Args:
            step: Name of the step.
            figures: Pictures of the page's folder beside those that the result names.
        """
        place = self.places[step]
        job = self.jobs.result(step)
        if job is None or job.result is None:
            place.text.content = self.hint(step)
            place.pictures.content = ""
            return
        names = [*job.result.get("figures", []), *figures]
        place.text.content = report(job)
        place.pictures.content = "".join([picture(self.folder, name) for name in names])
