"""The page of `gaponet app`: six steps from logs to an identified simulator, each by commands in
one folder.

The folder may come from somebody else. Markdown and HTML of the page hold its texts only escaped;
jobs.py validates what commands left there, inside.py keeps to files of the folder, and server.py
lets no other script run.
"""

from __future__ import annotations

import base64
import html
import re
import shlex
import shutil
import signal
import sys
import tempfile
from collections.abc import Callable, Iterable
from importlib.resources import files
from pathlib import Path
from typing import Any

import numpy as np

from gaponet.base.errors import GAPONetError, UsageError
from gaponet.base.files import write_text
from gaponet.base.text import escape_markdown
from gaponet.data.describe.guess import guess_logs
from gaponet.data.formats import look
from gaponet.data.store import Dataset
from gaponet.evaluation.methods import colour
from gaponet.evaluation.verdict import NetworkGain
from gaponet.report.view.inside import read_inside
from gaponet.report.view.jobs import OUT, PROGRESS_LINE, Job, Jobs
from gaponet.report.view.player import Player, draw_curves
from gaponet.report.view.run_job import BY_ITSELF, CANCELLED, WITH_SERVER
from gaponet.report.view.scene import Scene
from gaponet.report.view.server import open_server, run_until_interrupt
from gaponet.report.view.side_by_side import Clip, SideBySide, side_by_side, standing
from gaponet.report.view.uploads import PLACES, Uploads, connect_upload_button
from gaponet.robot.finding import Finding, errors_of
from gaponet.robot.spec import PACKAGE_FOLDER, RobotSpec, load_robot, packaged_robots
from gaponet.sim.dataset_robot import dataset_robot

MODEL_SUFFIXES = (".xml", ".mjcf", ".urdf")
POSITION_UNITS = ("as the logs state", "rad", "deg", "fraction", "ticks", "signed_percent")
TARGETS = ("mjcf", "urdf", "mjlab", "isaaclab", "newton", "json")
NETWORK_TARGETS = ("onnx", "torch")  # of a trained network
# Target → engine that applies parameter sets; others read a file.
ENGINES = {"mjcf": "mujoco", "mjlab": "mjlab", "isaaclab": "isaaclab"}
POLL_S = 0.5
PANEL_WIDTH = 560  # pixels
TEMPLATES = files("gaponet.report").joinpath("templates")


class App:
    """Controls, texts and pictures of the page. All pages of a server show the same."""

    def __init__(self, folder: Path, port: int, outside: tuple[Path, ...] = ()) -> None:
        """Serve the page of a folder, an absolute path, which holds logs, models, commands and
        their results.

        Args:
            outside: Other folders, absolute paths, that stored commands may use: a robot, a
                dataset.

        Raises:
            UsageError: A folder in it is a link.
        """
        _make_places(folder)
        self.folder = folder
        self.jobs = Jobs(folder, outside)
        self.polled = 0.0
        self.seen: tuple[int, str] | None = None  # number of jobs and name of the living one
        script = TEMPLATES.joinpath("app.js").read_text(encoding="utf-8")
        self.server, self.address = open_server("gaponet app", port, script)
        self.gui = self.server.gui
        self.texts: dict[str, tuple[Any, str, Any]] = {}  # step → text, hint, pictures
        self.player: Player | None = None
        self.gui.main_panel.set_width(PANEL_WIDTH)
        self.gui.add_html(TEMPLATES.joinpath("app.html").read_text(encoding="utf-8"))
        self.status = self.gui.add_markdown("")
        self.running = self.gui.add_markdown("")
        self.bar = self.gui.add_progress_bar(0.0)
        self.cancel = self._button("Cancel", lambda _: self.jobs.cancel())
        self.notices = self.gui.add_markdown("")
        self.uploads = Uploads(folder, self.jobs, self._show_notices)
        self.dismiss = self._button("Dismiss", lambda _: self.uploads.notices.dismiss())
        self.dismiss.visible = False
        self.unreadable = self.gui.add_markdown("")
        tabs = self.gui.add_tab_group()
        steps: dict[str, Callable[[], None]] = {
            "1 Robot": self._robot,
            "2 Logs": self._logs,
            "3 Check": self._check,
            "4 Gap": self._gap,
            "5 Identify": self._identify,
            "6 Use": self._use,
        }
        for title, add_controls in steps.items():
            with tabs.add_tab(title):
                add_controls()
        self._attempt(self.refresh)

    def tick(self, elapsed: float) -> None:
        """Play on, and look after the running command."""
        if self.player is not None:
            self._attempt(self.player.advance, elapsed)
        self.polled += elapsed
        if self.polled >= POLL_S:
            self.polled = 0.0
            self._attempt(self.uploads.place_waiting)
            self._attempt(self.refresh)

    # Steps: controls, and the command of each button.

    def _robot(self) -> None:
        self.model = self.gui.add_dropdown("robot", packaged_robots())
        self._upload("Upload a model: MJCF, URDF, or a .zip with its meshes", "model")
        hints = {
            "joints": "names; empty: all that are driven",
            "kp": "80 joint2=120, N·m/rad",
            "kd": "N·m·s/rad",
        }
        self.options = {
            name: self.gui.add_text(name, "", hint=hint) for name, hint in hints.items()
        }
        self._button("Use this robot", self._use_robot)
        self._text("robot", "Choose a robot of the package, or upload a model of yours.")

    def _use_robot(self, _: Any) -> None:
        options = []
        for name, box in self.options.items():
            words = box.value.split()
            if any(word.startswith("-") for word in words):
                raise UsageError("joints, kp and kd are names and numbers, without a dash in front")
            if words:
                options += [f"--{name}", *words]
        name = str(self.model.value)
        if name in packaged_robots():
            self.jobs.start("robot", "robot", "check", name)
        else:
            self.jobs.start("robot", "robot", "new", name, "--out", OUT, *options)

    def _logs(self) -> None:
        self._upload("Upload a log, or a .zip of logs", "logs")
        self.gui.add_markdown(f"Or copy them into {escape_markdown(str(self.folder / 'logs'))}.")
        self.unit = self.gui.add_text("unit", "lab")
        self.mass = self.gui.add_number("payload, kg", 0.0, min=0.0)
        self.position = self.gui.add_dropdown("positions in", POSITION_UNITS)
        self.cut = self.gui.add_number(
            "cut into pieces, s", 0.0, min=0.0, hint="0: not cut; 3 motions are needed"
        )
        self.described = self.gui.add_text(
            "logs.toml", "", multiline=True, hint="empty: the logs.toml of the folder"
        )
        self._button("Guess logs.toml from the logs", self._guess)
        self._button("Set these logs aside", self._set_aside)
        self._button("Read the logs", self._read)
        self._text("import", "Choose the robot first. Then upload logs, and read them.")
        self.recording = self.gui.add_dropdown("recording", ("–",))
        self.joint = self.gui.add_dropdown("joint", ("–",))
        nothing = np.zeros(2)
        lines = {
            "target": (nothing, colour("target")),
            "measured": (nothing, colour("gaponet")),
        }
        self.curves = draw_curves(self.gui, np.arange(2), lines, "rad")
        for choice in (self.recording, self.joint):
            choice.on_update(lambda _: self._draw_recording())

    def _set_aside(self, _: Any, place: str = "logs") -> None:
        number = 1
        while (self.folder / f"{place}_aside{number}").exists():
            number += 1
        aside = f"{place}_aside{number}"
        with self.jobs.idle():
            (self.folder / place).rename(self.folder / aside)
            (self.folder / place).mkdir()
        self.status.content = f"The logs are in {aside} now; {place} is empty."

    def _guess(self, _: Any) -> None:
        file = self.folder / "logs" / "logs.toml"
        if file.is_file() and self._stored_description() != self.described.value:
            raise UsageError(f"{file} is there, and a guess would replace it; move it away first")
        kind, facts, recordings = look(self.folder / "logs")
        self.described.value = guess_logs(recordings, self._chosen_robot(), kind, dict(facts))

    def _read(self, _: Any, step: str = "import", logs: str = "logs") -> None:
        robot = self._need("robot")
        self.jobs.require_idle()
        if self.described.value.strip():  # otherwise a file of the user's stays as it is
            write_text(self.folder / logs / "logs.toml", self.described.value)
        words = [f"--unit-id={self.unit.value}", f"--payload-mass={self.mass.value:g}"]
        words += ["--out", OUT]
        if self.position.value in POSITION_UNITS[1:]:
            words.append(f"--position-unit={self.position.value}")
        if self.cut.value > 0:
            words.append(f"--cut={self.cut.value:g}")
        self.jobs.start(step, "import", logs, f"--robot={robot.out}", *words)

    def _check(self) -> None:
        self._run(
            "Check the recordings",
            "doctor",
            lambda: ("doctor", self._need("import").out, "--figures", OUT),
        )
        self.proposal = self._button("Write a proposal for logs.toml into step Logs", self._propose)
        self._text("doctor", "Read the logs first. Then check them.")

    def _propose(self, _: Any) -> None:
        findings = _findings(self._need("doctor"))
        own = self.described.value or self._stored_description()
        self.described.value = f"{own}\n{Finding.proposal(findings)}".lstrip()

    def _stored_description(self) -> str:
        """Return the logs.toml of the folder; "" if there is none."""
        if not (self.folder / "logs" / "logs.toml").is_file():
            return ""
        return read_inside(self.folder, "logs/logs.toml").decode()

    def _gap(self) -> None:
        self._run("Measure the error", "gap", lambda: ("gap", self._need("import").out))
        self._button("Show the recording of step Logs beside its simulation", self._show)
        self.stage = self.gui.add_folder(None)
        self._text(
            "gap", "Read the logs first. Then measure how far the simulator is from the robot."
        )

    def _show(self, _: Any) -> None:
        data = self._dataset()
        identified = self.jobs.result("identify")
        if identified is None:
            robot = dataset_robot(data)
        else:
            robot = load_robot(self.folder / identified.out)
        entry = next(e for e in data.entries if e.id == self.recording.value)
        network = self._network()
        runs = [self.folder / network.out] if network else []
        self.play(side_by_side(data, entry, robot, runs))

    def _identify(self) -> None:
        self.limit = self.gui.add_text("time limit", "4m", hint="such as 60s or 4m; empty for none")
        self.table = self.gui.add_checkbox("look for a table under the robot", True)
        self.fit = self._run("Identify", "identify", self._fit)
        self._text(
            "identify",
            "Check the recordings first. Identification is locked while the check finds an error.",
        )
        self._text("causes", "")

    def _fit(self) -> list[str]:
        reason = self._locked()
        if reason:
            raise UsageError(reason)
        words = ["identify", self._need("import").out, "--out", OUT]
        limit = self.limit.value.strip()
        if limit:
            words.append(f"--budget={limit}")
        if not self.table.value:
            words.append("--no-table")
        return words

    def _locked(self) -> str:
        """Return why identification may not start; "" if it may."""
        job = self.jobs.result("doctor")
        if job is None:
            return self.texts["identify"][1]
        errors = errors_of(_findings(job))
        if not errors:
            return ""
        names = escape_markdown(", ".join(finding.check for finding in errors))
        return f"Locked: the check finds an error ({names}). Step Check says what to do."

    def _use(self) -> None:
        self.target = self.gui.add_dropdown("for", TARGETS)
        self._run("Export", "export", self._export)
        self._text("export", "Identify the robot first. Then export it for your simulator.")
        self._run("Parameter sets for training", "randomization", self._parameter_sets)
        self._text(
            "randomization",
            "A policy is then trained on robots that these logs cannot tell from yours.",
        )
        self._upload("Upload new logs, of another day or unit", "new_logs")
        self._button("Set these new logs aside", lambda _: self._set_aside(_, "new_logs"))
        self._button(
            "Read the new logs", lambda _: self._read(self._need("identify"), "new", "new_logs")
        )
        self._text(
            "new",
            "Identify the robot first. Unit, payload, positions and logs.toml are those of step "
            "Logs.",
        )
        self._run("Check whether the robot changed", "check", self._check_for_change)
        self._text(
            "check", "Read new logs first. Then check whether the identified robot still fits them."
        )
        self._run("Calibrate with the new logs", "adapt", self._adapt)
        self._text("adapt", "Read new logs first. The calibrated robot is then exported.")
        self.budget = self.gui.add_text("training time", "10m")
        self._run("Train a network", "train", self._train)
        self._text("train", "A network can be exported if validation says that it helps.")

    def _export(self) -> list[str]:
        target = str(self.target.value)
        exported = self._need("train").out if target in NETWORK_TARGETS else self._best_robot()
        return ["export", exported, "--to", target, "--out", OUT]

    def _parameter_sets(self) -> list[str]:
        engine = ENGINES.get(str(self.target.value), "json")
        words = ["export", self._best_robot(), "--to", "randomization", "--engine", engine]
        return [*words, "--out", OUT]

    def _check_for_change(self) -> list[str]:
        return ["check", self._need("identify").out, self._need("new").out]

    def _adapt(self) -> list[str]:
        return ["adapt", self._need("identify").out, self._need("new").out, "--out", OUT]

    def _train(self) -> list[str]:
        data = self._need("import").out
        robot = self._need("identify").out
        budget = self.budget.value
        return ["train", data, f"--robot={robot}", f"--budget={budget}", "--out", OUT]

    def _best_robot(self) -> str:
        """Return the folder of the robot that was calibrated last, or else identified."""
        return (self.jobs.result("adapt") or self._need("identify")).out

    def _network(self) -> Job | None:
        """Return the training if its network helps on validation motions."""
        job = self.jobs.result("train")
        if job is None or job.result is None:
            return None
        error = job.result.get("val_mpjae", {})
        gain = NetworkGain(
            "", error.get("added") or 0.0, error.get("error") or np.nan, error.get("start") or 0.0
        )
        return job if gain.helps else None

    # What the page shows: only what the files say.

    def refresh(self) -> None:
        """Show the running command; when one starts or ends, also the results and what may be done
        next.
        """
        with self.jobs.lock:  # a job that is being started is neither running nor ended
            running = self.jobs.running
            every = self.jobs.all
            elsewhere = self.jobs.running_elsewhere
        self._show_progress(running, elsewhere)
        self.model.options = [*packaged_robots(), *self._uploaded_models()]
        living = running or elsewhere
        state = (len(every), living.folder.name if living else "")
        if self.seen == state:
            return
        if living is not None:
            self.status.content = ""
        elif every:
            self.status.content = _ending(every[-1])
        else:
            self.status.content = "Six steps, from left to right."
        self._show_results()
        if self.jobs.result("import"):
            self._show_recordings()
        self._go_on(living, every)
        self.seen = state  # last: after an error all is shown again

    def _uploaded_models(self) -> list[str]:
        """Return the files of models in the page's folder, relative to it."""
        found = []
        for file in sorted((self.folder / "model").rglob("*")):
            if file.suffix.lower() in MODEL_SUFFIXES:
                found.append(file.relative_to(self.folder).as_posix())
        return found

    def _show_progress(self, running: Job | None, elsewhere: Job | None) -> None:
        """Show how far the running command is."""
        self.bar.visible = running is not None
        self.cancel.visible = running is not None
        text = ""
        if running is not None:
            self.bar.value, note = running.progress()
            command = escape_markdown(running.words[0])
            text = f"**gaponet {command}**, {self.bar.value:.0f} %. {escape_markdown(note)}"
        elif elsewhere is not None:
            command = escape_markdown(elsewhere.words[0])
            text = (
                f"**gaponet {command}** of an earlier page is still running. "
                "It ends soon, because the server of that page has ended."
            )
        self.running.content = text

    def _show_results(self) -> None:
        """Show the result of each step, and what may be done next."""
        for step, (text, hint, pictures) in self.texts.items():
            job = self.jobs.result(step)
            if job is not None:
                text.content = _report(job)
            elif step == "identify":
                text.content = self._locked() or hint
            else:
                text.content = hint
            pictures.content = self._pictures(step, job)
        reasons = [f"Left out: {escape_markdown(text)}" for text in self.jobs.unreadable()]
        self.unreadable.content = "\n\n".join(reasons)
        targets: tuple[str, ...] = TARGETS
        if self._network() is not None:
            targets = TARGETS + NETWORK_TARGETS
        self.target.options = targets
        self.fit.disabled = bool(self._locked())
        self.proposal.visible = self.jobs.result("doctor") is not None

    def _show_recordings(self) -> None:
        data = self._dataset()
        self.recording.options = [entry.id for entry in data.entries]
        self.joint.options = data.joint_names
        self._draw_recording()

    def _go_on(self, living: Job | None, every: list[Job]) -> None:
        """After an identification compare it with the nominal robot.

        Before the first recording show the robot.
        """
        last = self.jobs.result("identify")
        fitted = last is not None and last.number == every[-1].number and living is None
        if last is not None and fitted and self.jobs.started_here(last):
            self.jobs.start("causes", "gap", self._need("import").out, "--robot", last.out)
        elif self.player is None and self.jobs.result("robot"):
            self.play(standing(self._chosen_robot()))

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
        with self.stage:
            self.player = Player(self.server, scene, clip, magnify)

    def _draw_recording(self) -> None:
        """Draw target and measured position of the chosen joint in the chosen recording."""
        data = self._dataset()
        entry = next((e for e in data.entries if e.id == self.recording.value), None)
        if entry is None or self.joint.value not in data.joint_names:
            return  # the choices are being replaced
        real = data.read(entry)
        j = data.joint_names.index(self.joint.value)
        time = real.dt * np.arange(len(real))
        self.curves.data = (time, real.ctrl[:, j].astype(float), real.qpos[:, j].astype(float))

    def _pictures(self, step: str, job: Job | None) -> str:
        """Return the figures of a result as HTML, with links that save them."""
        if job is None or job.result is None:
            return ""
        names = job.result.get("figures", [])
        if step == "causes":
            folder = self._need("identify").out
            names = [f"{folder}/gap.svg", f"{folder}/gap.png"]
        shown = [_picture(self.folder, name) for name in names]
        return "".join(shown)

    def _text(self, step: str, hint: str) -> None:
        """Add the place of a step's result; `hint` stands there before."""
        self.texts[step] = self.gui.add_markdown(hint), hint, self.gui.add_html("")

    def _button(self, label: str, act: Callable[[Any], None]) -> Any:
        button = self.gui.add_button(label)
        button.on_click(lambda event: self._attempt(act, event))
        return button

    def _run(self, label: str, step: str, words: Callable[[], Iterable[str]]) -> Any:
        """Add a button that starts the command of a step."""
        return self._button(label, lambda _: self.jobs.start(step, *words()))

    def _upload(self, label: str, place: str) -> None:
        """Add a button that stores files in a folder of the page."""

        def receive(name: str, content: bytes) -> None:
            self._attempt(self.uploads.receive, name, content, place)

        connect_upload_button(self.gui.add_upload_button(label), receive)

    def _show_notices(self, text: str, dismissible: bool) -> None:
        self.notices.content = text
        self.dismiss.visible = dismissible

    def _attempt(self, act: Callable[..., None], *arguments: Any) -> None:
        """Call a function; an error is shown above the steps."""
        try:
            act(*arguments)
        except Exception as error:  # whatever it is, the page and the running command go on
            kind = ""
            if not isinstance(error, (GAPONetError, OSError)):
                kind = f"Unexpected {type(error).__name__}: "
            self.status.content = f"**Not done.** {kind}{escape_markdown(str(error))}"

    def _need(self, step: str) -> Job:
        job = self.jobs.result(step)
        if job is None:
            raise UsageError(f"{step}: there is no result yet. {self.texts[step][1]}")
        return job

    def _chosen_robot(self) -> RobotSpec:
        name = self._need("robot").out
        if name in packaged_robots():
            return load_robot(name)
        return load_robot(self.folder / name)

    def _dataset(self) -> Dataset:
        return Dataset(self.folder / self._need("import").out)


def _make_places(folder: Path) -> None:
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


def _findings(job: Job) -> list[Finding]:
    """Return the findings of a check."""
    return [] if job.result is None else job.result.get("findings", [])


def _picture(folder: Path, name: str) -> str:
    """Return a picture of the page's folder as HTML with a link that saves it, or why it is not
    shown.
    """
    try:
        data = base64.b64encode(read_inside(folder, name)).decode()
    except UsageError as error:
        return f"<p>Not shown: {html.escape(str(error))}</p>"
    kind = Path(name).suffix[1:]
    address = f"data:image/{kind.replace('svg', 'svg+xml')};base64,{data}"
    saved = html.escape(Path(name).name)
    text = f'<a download="{saved}" href="{address}">save {kind.upper()}</a> '
    if kind == "svg":
        text = f'<img alt="{saved}" style="width:100%;background:white" src="{address}">{text}'
    return text


def _ending(job: Job) -> str:
    """Return how a command ended, in Markdown."""
    command = f"**gaponet {escape_markdown(job.words[0])}**"
    if job.result is not None:
        return f"{command} has ended."
    return f"{command} gave no result: {escape_markdown(_reason(job))}"


def _reason(job: Job) -> str:
    """Return why a command gave no result."""
    unchanged = "what was there before is unchanged."
    ending = job.ending
    how = "" if ending is None else ending["how"]
    if how == CANCELLED:
        return f"it was cancelled; {unchanged}"
    if how == WITH_SERVER:
        return f"it ended with the server of the page; {unchanged}"
    said = [line for line in job.lines if line.strip() and not PROGRESS_LINE.match(line)]
    if said:
        return said[-1]
    if ending is not None and how == BY_ITSELF:
        return f"it ended with exit code {ending['code']} and said nothing."
    return f"it was killed, or the computer went off; {unchanged}"


def _report(job: Job) -> str:
    """Return what a command printed, in Markdown, and the command."""
    lines = list[str]()
    for line in job.lines:
        lines += _report_line(line)
    repeat = f"To repeat it in the folder of this page: {escape_markdown(job.command)}"
    return "\n".join([*lines, "", repeat])


def _report_line(line: str) -> list[str]:
    """Return a line that a command printed as lines of Markdown.

    A table of rich becomes one of Markdown.
    """
    text = re.sub("[┃│]", "|", escape_markdown(line.strip()))
    if line.startswith("┡"):
        return [f"| --- |{' ---: |' * line.count('╇')}"]
    if line.startswith(("┃", "│")):
        return [text]
    if not text or line.startswith(("┏", "└", "     ok ")) or PROGRESS_LINE.match(line):
        return []
    if text.startswith(("error ", "warning ")):
        return ["", f"**{text}**"]
    return ["", text]


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
    jobs.add("robot", "robot", "check", robot.name if packaged else str(robot), result="{}")
    jobs.add("import", "data", "card", str(dataset), result="{}")
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
