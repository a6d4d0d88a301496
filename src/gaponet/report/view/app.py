"""The page of `gaponet app`: six steps from logs to an identified simulator, each by commands in
one folder.

The folder may come from somebody else. Markdown and HTML of the page hold its texts only escaped;
jobs.py validates what commands left there, inside.py keeps to files of the folder, and server.py
lets no other script run.
"""

from __future__ import annotations

import shlex
import shutil
import signal
import sys
import tempfile
from collections.abc import Callable
from importlib.resources import files
from pathlib import Path

from gaponet.base.errors import UsageError
from gaponet.base.text import escape_markdown
from gaponet.data.store import Dataset
from gaponet.report.steps import Step, use_robot
from gaponet.report.view.controls import Controls
from gaponet.report.view.job_text import ending
from gaponet.report.view.jobs import Job, Jobs
from gaponet.report.view.player import Player
from gaponet.report.view.scene import Scene
from gaponet.report.view.server import open_server, run_until_interrupt
from gaponet.report.view.side_by_side import Clip, SideBySide
from gaponet.report.view.tabs import (
    CheckTab,
    GapTab,
    IdentifyTab,
    LogsTab,
    Play,
    RobotTab,
    Tab,
    UseTab,
)
from gaponet.report.view.uploads import PLACES, Uploads
from gaponet.robot.spec import PACKAGE_FOLDER

POLL_S = 0.5
PANEL_WIDTH = 560  # pixels
TEMPLATES = files("gaponet.report").joinpath("templates")
# Title of a tab → the step with which it is done.
TABS = {
    "1 Robot": "robot",
    "2 Logs": "import",
    "3 Check": "doctor",
    "4 Gap": "gap",
    "5 Identify": "identify",
    "6 Use": "",
}


class Tabs:
    """The six tabs.

    Attributes:
        robot, logs, check, gap, identify, use: What is in them.
        onwards: Step → button that opens the next tab.
    """

    def __init__(self, controls: Controls, uploads: Uploads, play: Play) -> None:
        """Add them; `play` shows motions."""
        self._jobs = controls.jobs
        self._unreadable = controls.gui.add_markdown("")
        group = controls.gui.add_tab_group()
        places = [group.add_tab(title) for title in TABS]
        with places[0]:
            self.robot = RobotTab(controls, uploads, play)
        with places[1]:
            self.logs = LogsTab(controls, uploads, self.robot)
        with places[2]:
            self.check = CheckTab(controls, self.logs)
        with places[3]:
            self.gap = GapTab(controls, self.logs, play)
        with places[4]:
            self.identify = IdentifyTab(controls)
        with places[5]:
            self.use = UseTab(controls, uploads, self.logs)
        # The script of the page opens the next tab.
        titles = list(TABS)
        self.onwards = {}
        for place, title, following in zip(places, titles, titles[1:], strict=False):
            with place:
                self.onwards[TABS[title]] = controls.gui.add_button(f"Next: {following}")

    def show(self) -> None:
        """Show the result of each step, and what may be done next.

        Raises:
            Exception: The first one of a tab, after all others have been shown.
        """
        failed: Exception | None = None
        tabs: tuple[Tab, ...] = (
            self.robot,
            self.logs,
            self.check,
            self.gap,
            self.identify,
            self.use,
        )
        for tab in tabs:
            try:
                tab.show()
            except Exception as error:  # the others have results too
                failed = failed or error
        for result, button in self.onwards.items():
            button.disabled = self._jobs.result(result) is None
        reasons = [f"Left out: {escape_markdown(text)}" for text in self._jobs.unreadable()]
        self._unreadable.content = "\n\n".join(reasons)
        if failed is not None:
            raise failed


class RunningCommand:
    """The running command and how far it is, above the steps."""

    def __init__(self, controls: Controls) -> None:
        self.text = controls.gui.add_markdown("")
        self._bar = controls.gui.add_progress_bar(0.0)
        self._cancel = controls.add_button("Cancel", controls.jobs.cancel)

    def show(self, running: Job | None, elsewhere: Job | None) -> None:
        """Show how far a command is that runs here, or that an earlier page started."""
        self._bar.visible = running is not None
        self._cancel.visible = running is not None
        text = ""
        if running is not None:
            self._bar.value, note = running.progress()
            command = escape_markdown(running.words[0])
            text = f"**gaponet {command}**, {self._bar.value:.0f} %. {escape_markdown(note)}"
        elif elsewhere is not None:
            command = escape_markdown(elsewhere.words[0])
            text = (
                f"**gaponet {command}** of an earlier page is still running. "
                "It ends soon, because the server of that page has ended."
            )
        self.text.content = text


class App:
    """The page: its steps, the running command above them, and the robots beside them.

    All pages of a server show the same.
    """

    def __init__(self, folder: Path, port: int, outside: tuple[Path, ...] = ()) -> None:
        """Serve the page of a folder, an absolute path, which holds logs, models, commands and
        their results.

        Args:
            folder: The page's folder.
            port: Of the address; another one is taken if it is in use.
            outside: Other folders, absolute paths, that stored commands may use: a robot, a
                dataset.

        Raises:
            UsageError: A folder in it is a link.
        """
        make_places(folder)
        self.jobs = Jobs(folder, outside)
        self.polled = 0.0  # s since the last look at the running command
        self.seen: tuple[int, str] | None = None  # number of jobs and name of the living one
        script = TEMPLATES.joinpath("app.js").read_text(encoding="utf-8")
        self.server, self.address = open_server("gaponet app", port, script)
        gui = self.server.gui
        self.player: Player | None = None
        gui.main_panel.set_width(PANEL_WIDTH)
        gui.add_html(TEMPLATES.joinpath("app.html").read_text(encoding="utf-8"))
        self.controls = Controls(gui, folder, self.jobs)
        self.running = RunningCommand(self.controls)
        self.notices = gui.add_markdown("")
        self.uploads = Uploads(folder, self.jobs, self._show_notices)
        self.dismiss = self.controls.add_button("Dismiss", self.uploads.notices.dismiss)
        self.dismiss.visible = False
        self.tabs = Tabs(self.controls, self.uploads, self.play)
        self.controls.attempt(self.refresh)

    def tick(self, elapsed: float) -> None:
        """Play on, and look after the running command; `elapsed` is the time since, s."""
        if self.player is not None:
            self.controls.attempt(self.player.advance, elapsed)
        self.polled += elapsed
        if self.polled >= POLL_S:
            self.polled = 0.0
            self.controls.attempt(self.uploads.place_waiting)
            self.controls.attempt(self.refresh)

    # What the page shows: only what the files say.

    def refresh(self) -> None:
        """Show the running command; when one starts or ends, also the results and what may be done
        next.
        """
        with self.jobs.lock:  # a job that is being started is neither running nor ended
            running = self.jobs.running
            every = self.jobs.all
            elsewhere = self.jobs.running_elsewhere
        living = running or elsewhere
        state = (len(every), living.folder.name if living else "")
        if living is not None and self.seen != state:
            self.controls.say("")  # how the command before ended is no news beside a running one
        self.running.show(running, elsewhere)
        self.tabs.robot.list_models()
        if self.seen == state:
            return
        self.tabs.show()
        if living is None and every:
            self.controls.say(ending(every[-1]))
            self._compare(every[-1])
        elif living is None:
            self.controls.say("Six steps, from left to right.")
        self.seen = state  # last: after an error all is shown again

    def _compare(self, last: Job) -> None:
        """Compare a robot with the nominal one when its identification has just ended here."""
        identified = self.jobs.result("identify")
        if identified is None or identified.number != last.number:
            return
        if self.jobs.started_here(last):
            self.tabs.identify.compare()

    def play(
        self, shown: Scene | SideBySide, clip: Clip | None = None, magnify: float = 1.0
    ) -> None:
        """Show a scene, or motions, in place of what was shown before."""
        scene = shown if isinstance(shown, Scene) else Scene(shown)
        clip = clip or Clip.from_start(scene.shown, 0.0, 3600.0)
        # `tick` advances it in another thread
        before = self.player
        self.player = None
        if before is not None:
            before.remove()
        with self.tabs.gap.stage:
            self.player = Player(self.server, scene, clip, magnify)

    def _show_notices(self, text: str, dismissible: bool) -> None:
        self.notices.content = text
        self.dismiss.visible = dismissible


def make_places(folder: Path) -> None:
    """Make the folders that the page writes into.

    A link, which could lead elsewhere, is refused.
    """
    for name in (*PLACES, "jobs", "incoming"):
        if (folder / name).is_symlink():
            raise UsageError(
                f"{folder / name}: is a link, and gaponet app writes only inside its folder; "
                "put a folder in its place"
            )
    for name in PLACES:
        (folder / name).mkdir(exist_ok=True)


def serve(page: App, say: Callable[[str], None], step: str = "") -> None:
    """Serve a page until Ctrl-C; `step` is the number of the step that is shown first.

    SIGTERM and SIGHUP (the terminal was closed) end it in the same way. The running command ends
    with it, also after `kill -9` (run_job.py).
    """
    _end_on_signals()
    query = f"?step={step}" if step else ""
    say(f"open {page.address}{query} in a browser; Ctrl-C ends")
    try:
        run_until_interrupt(page.server, page.tick)
    finally:
        page.jobs.close()


def _end_on_signals() -> None:
    """Let SIGTERM and SIGHUP leave through `finally`; one that is ignored (nohup) stays so."""

    def leave(number: int, _frame: object) -> None:
        sys.exit(128 + number)

    for name in ("SIGTERM", "SIGHUP"):
        number = getattr(signal, name, None)  # Windows has no SIGHUP
        if number is not None and signal.getsignal(number) != signal.SIG_IGN:
            signal.signal(number, leave)


def serve_dataset(
    data: Dataset, scene: Scene, clip: Clip, port: int, magnify: float, say: Callable[[str], None]
) -> None:
    """Serve a dataset and a scene of it at step Gap.

    The page's folder stays if a command has written into it.
    """
    folder = Path(tempfile.mkdtemp(prefix="gaponet_view_"))
    robot = scene.shown.robot.folder.resolve()
    dataset = data.path.resolve()
    packaged = robot.parent == PACKAGE_FOLDER.resolve()
    outside = (dataset,) if packaged else (robot, dataset)
    jobs = Jobs(folder, outside)
    jobs.add(use_robot(robot.name if packaged else str(robot)), result="{}")
    jobs.add(Step("import", ("data", "card", str(dataset))), result="{}")
    page = App(folder, port, outside)
    page.play(scene, clip, magnify)
    try:
        serve(page, say, "4")
    finally:
        if len(jobs.all) > 2:
            words = ["gaponet", "app", str(folder), "--outside", *map(str, outside)]
            say(f"results are in {folder}; to go on: {shlex.join(words)}")
        else:
            shutil.rmtree(folder)
