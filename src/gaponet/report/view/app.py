"""The page of `gaponet app`: six steps from logs to an identified simulator, each by commands in one folder."""

from __future__ import annotations

import base64
import io
import os
import re
import shutil
import signal
import sys
import tempfile
import zipfile
import zlib
from collections.abc import Callable, Iterable
from importlib.resources import files
from pathlib import Path
from typing import Any

import numpy as np

from gaponet.base.errors import GAPONetError, UsageError
from gaponet.base.files import FOLDER_MARKER, write_text
from gaponet.base.text import escape_markdown
from gaponet.data.describe.guess import guess_logs
from gaponet.data.formats import look
from gaponet.data.store import Dataset
from gaponet.report.methods import colour
from gaponet.report.verdict import NetworkGain
from gaponet.report.view.jobs import OUT, PROGRESS_LINE, Job, Jobs
from gaponet.report.view.player import Player, draw_curves
from gaponet.report.view.scene import Scene
from gaponet.report.view.server import open_server, run_until_interrupt
from gaponet.report.view.side_by_side import Clip, SideBySide, side_by_side, standing
from gaponet.robot.finding import Finding, errors_of
from gaponet.robot.spec import RobotSpec, load_robot, packaged_robots
from gaponet.sim.dataset_robot import dataset_robot

MODEL_SUFFIXES = (".xml", ".mjcf", ".urdf")
POSITION_UNITS = ("as the logs state", "rad", "deg", "fraction", "signed_percent")
TARGETS = ("mjcf", "urdf", "mjlab", "isaaclab", "newton", "drake", "json")
NETWORK_TARGETS = ("onnx", "torch")  # of a trained network
POLL_S, MAX_UNPACKED_BYTES = 0.5, 2 << 30
PANEL_WIDTH = 560  # pixels
STYLE = files("gaponet.report").joinpath("templates", "app.html")


class App:
    """Controls, texts and pictures of the page. All pages of a server show the same."""

    def __init__(self, folder: Path, port: int) -> None:
        """Serve the page of a folder, an absolute path, which holds logs, models, commands and their results."""
        self.folder, self.jobs, self.polled, self.seen = folder, Jobs(folder), 0.0, (-1, True)
        self.server, self.address = open_server("gaponet app", port)
        self.gui = self.server.gui
        self.texts: dict[str, tuple[Any, str, Any]] = {}  # step → text, hint, pictures
        self.player: Player | None = None
        for name in ("logs", "model", "new_logs"):
            (folder / name).mkdir(exist_ok=True)
        self.gui.main_panel.set_width(PANEL_WIDTH)
        self.gui.add_html(STYLE.read_text(encoding="utf-8"))
        self.status, self.bar = self.gui.add_markdown(""), self.gui.add_progress_bar(0.0)
        self.cancel = self._button("Cancel", lambda _: self.jobs.cancel())
        tabs = self.gui.add_tab_group()
        for number, step in enumerate(
            (self._robot, self._logs, self._check, self._gap, self._identify, self._use), 1
        ):
            with tabs.add_tab(f"{number} {step.__name__.strip('_').capitalize()}"):
                step()
        self._attempt(self.refresh)

    def tick(self, elapsed: float) -> None:
        """Play on, and look after the running command."""
        if self.player is not None:
            self._attempt(self.player.advance, elapsed)
        self.polled += elapsed
        if self.polled >= POLL_S:
            self.polled = 0.0
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
        given = {
            f"--{name}": box.value.split()
            for name, box in self.options.items()
            if box.value.split()
        }
        if any(word.startswith("-") for words in given.values() for word in words):
            raise UsageError("joints, kp and kd are names and numbers, without a dash in front")
        if (name := str(self.model.value)) in packaged_robots():
            self.jobs.start("robot", "robot", "check", name)
        else:
            self.jobs.start(
                "robot",
                "robot",
                "new",
                name,
                "--out",
                OUT,
                *(w for k in given for w in (k, *given[k])),
            )

    def _logs(self) -> None:
        self._upload("Upload a log, or a .zip of logs", "logs")
        self.gui.add_markdown(f"Or copy them into {escape_markdown(str(self.folder / 'logs'))}.")
        self.unit, self.mass = (
            self.gui.add_text("unit", "lab"),
            self.gui.add_number("payload, kg", 0.0, min=0.0),
        )
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
        self.recording, self.joint = (
            self.gui.add_dropdown(name, ("–",)) for name in ("recording", "joint")
        )
        lines = {
            name: (np.zeros(2), colour(key))
            for name, key in (("target", "target"), ("measured", "gaponet"))
        }
        self.curves = draw_curves(self.gui, np.arange(2), lines, "rad")
        for choice in (self.recording, self.joint):
            choice.on_update(lambda _: self._draw_recording())

    def _set_aside(self, _: Any, place: str = "logs") -> None:
        self.jobs.require_idle()
        aside = next(
            name
            for n in range(1, 1 << 20)
            if not (self.folder / (name := f"{place}_aside{n}")).exists()
        )
        (self.folder / place).rename(self.folder / aside)
        (self.folder / place).mkdir()
        self.status.content = f"The logs are in {aside} now; {place} is empty."

    def _guess(self, _: Any) -> None:
        file = self.folder / "logs" / "logs.toml"
        if file.is_file() and file.read_text(encoding="utf-8") != self.described.value:
            raise UsageError(f"{file} is there, and a guess would replace it; move it away first")
        kind, facts, recordings = look(self.folder / "logs")
        self.described.value = guess_logs(recordings, self._chosen_robot(), kind, dict(facts))

    def _read(self, _: Any, step: str = "import", logs: str = "logs") -> None:
        robot = self._need("robot")
        self.jobs.require_idle()
        if self.described.value.strip():  # otherwise a file of the user's stays as it is
            write_text(self.folder / logs / "logs.toml", self.described.value)
        words = [
            f"--unit-id={self.unit.value}",
            f"--payload-mass={self.mass.value:g}",
            "--out",
            OUT,
        ]
        words += [f"--position-unit={self.position.value}"] * (
            self.position.value in POSITION_UNITS[1:]
        )
        words += [f"--cut={self.cut.value:g}"] * (self.cut.value > 0)
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
        findings = [Finding(**f) for f in (self._need("doctor").result or {})["findings"]]
        file = self.folder / "logs" / "logs.toml"
        own = self.described.value or (file.read_text(encoding="utf-8") if file.is_file() else "")
        self.described.value = f"{own}\n{Finding.proposal(findings)}".lstrip()

    def _gap(self) -> None:
        self._run("Measure the error", "gap", lambda: ("gap", self._need("import").out))
        self._button("Show the recording of step Logs beside its simulation", self._show)
        self.stage = self.gui.add_folder(None)
        self._text(
            "gap", "Read the logs first. Then measure how far the simulator is from the robot."
        )

    def _show(self, _: Any) -> None:
        data, identified = self._dataset(), self.jobs.result("identify")
        robot = (
            dataset_robot(data) if identified is None else load_robot(self.folder / identified.out)
        )
        entry = next(e for e in data.entries if e.id == self.recording.value)
        runs = [self.folder / network.out] if (network := self._network()) else []
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
        if reason := self._locked():
            raise UsageError(reason)
        words = [f"--budget={time}" for time in self.limit.value.split()[:1]] + ["--no-table"] * (
            not self.table.value
        )
        return ["identify", self._need("import").out, "--out", OUT, *words]

    def _locked(self) -> str:
        """Return why identification may not start; "" if it may."""
        job = self.jobs.result("doctor")
        if job is None:
            return self.texts["identify"][1]
        findings = [Finding(**f) for f in (job.result or {})["findings"]]
        errors = ", ".join(f.check for f in errors_of(findings))
        return (
            errors and f"Locked: the check finds an error ({errors}). Step Check says what to do."
        )

    def _use(self) -> None:
        out, self.target = lambda step: self._need(step).out, self.gui.add_dropdown("for", TARGETS)
        robot = lambda: (self.jobs.result("adapt") or self._need("identify")).out  # noqa: E731
        engines = {
            "mjcf": "mujoco",
            "mjlab": "mjlab",
            "isaaclab": "isaaclab",
        }  # that apply parameter sets
        network = lambda: str(self.target.value) in NETWORK_TARGETS  # noqa: E731
        self._run("Export", "export", lambda: (
            "export", out("train") if network() else robot(), "--to", str(self.target.value), "--out", OUT
        ))  # fmt: skip
        self._text("export", "Identify the robot first. Then export it for your simulator.")
        self._run("Parameter sets for training", "randomization", lambda: (
            "export", robot(), "--to", "randomization", "--engine", engines.get(str(self.target.value), "json"),
            "--out", OUT,
        ))  # fmt: skip
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
            "Identify the robot first. Unit, payload, positions and logs.toml are those of step Logs.",
        )
        self._run(
            "Check whether the robot changed",
            "check",
            lambda: ("check", out("identify"), out("new")),
        )
        self._text(
            "check", "Read new logs first. Then check whether the identified robot still fits them."
        )
        self._run(
            "Calibrate with the new logs",
            "adapt",
            lambda: ("adapt", out("identify"), out("new"), "--out", OUT),
        )
        self._text("adapt", "Read new logs first. The calibrated robot is then exported.")
        self.budget = self.gui.add_text("training time", "10m")
        self._run("Train a network", "train", lambda: (
            "train", out("import"), f"--robot={out('identify')}", f"--budget={self.budget.value}", "--out", OUT
        ))  # fmt: skip
        self._text("train", "A network can be exported if validation says that it helps.")

    def _network(self) -> Job | None:
        """Return the training if its network helps on validation motions."""
        job = self.jobs.result("train")
        error = (job.result or {})["val_mpjae"] if job is not None else {}
        gain = NetworkGain(
            "", error.get("added", 0.0), error.get("error") or np.nan, error.get("start", 0.0)
        )
        return job if gain.helps else None

    # What the page shows: only what the files say.

    def refresh(self) -> None:
        """Show the running command; when one starts or ends, also the results and what may be done next."""
        with self.jobs.lock:  # a job that is being started is neither running nor ended
            running, every = self.jobs.running, self.jobs.all
        self.bar.visible = self.cancel.visible = running is not None
        if running is not None:
            self.bar.value, note = running.progress()
            self.status.content = (
                f"**gaponet {running.words[0]}**, {self.bar.value:.0f} %. {escape_markdown(note)}"
            )
        models = [
            f
            for f in sorted((self.folder / "model").rglob("*"))
            if f.suffix.lower() in MODEL_SUFFIXES
        ]
        self.model.options = [
            *packaged_robots(),
            *(f.relative_to(self.folder).as_posix() for f in models),
        ]
        if self.seen == (state := (len(every), running is None)):
            return
        if running is None:
            self.status.content = _ending(every[-1]) if every else "Six steps, from left to right."
        for step, (text, hint, pictures) in self.texts.items():
            job = self.jobs.result(step)
            hint = (step == "identify" and self._locked()) or hint
            text.content, pictures.content = (
                _report(job) if job else hint,
                self._pictures(step, job),
            )
        self.target.options = TARGETS + NETWORK_TARGETS * (self._network() is not None)
        self.fit.disabled, self.proposal.visible = (
            bool(self._locked()),
            self.jobs.result("doctor") is not None,
        )
        if self.jobs.result("import"):
            data = self._dataset()
            self.recording.options, self.joint.options = (
                [e.id for e in data.entries],
                data.joint_names,
            )
            self._draw_recording()
        if (
            running is None
            and (last := self.jobs.result("identify"))
            and last.number == every[-1].number
        ):
            self.jobs.start("causes", "gap", self._need("import").out, "--robot", last.out)
        elif self.player is None and self.jobs.result("robot"):
            self.play(standing(self._chosen_robot()))
        self.seen = state  # last: after an error all is shown again

    def play(
        self, shown: Scene | SideBySide, clip: Clip | None = None, magnify: float = 1.0
    ) -> None:
        """Show a scene, or motions, in place of what was shown before."""
        scene = shown if isinstance(shown, Scene) else Scene(shown)
        clip = clip or Clip.from_start(scene.shown, 0.0, 3600.0)
        before, self.player = self.player, None  # `tick` advances it in another thread
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
        real, j = data.read(entry), data.joint_names.index(self.joint.value)
        self.curves.data = (
            real.dt * np.arange(len(real)),
            *(x[:, j].astype(float) for x in (real.ctrl, real.qpos)),
        )

    def _pictures(self, step: str, job: Job | None) -> str:
        """Return the figures of a result as HTML, with links that save them."""
        files = [] if job is None else (job.result or {}).get("figures", [])
        if job is not None and step == "causes":
            files = [f"{self._need('identify').out}/gap.{kind}" for kind in ("svg", "png")]
        sources = {
            p: base64.b64encode(p.read_bytes()).decode()
            for f in files
            if (p := self.folder / f).is_file()
        }
        html, saved = "", '<a download="{}" href="data:image/{};base64,{}">save {}</a> '
        for file, data in sources.items():
            if file.suffix == ".svg":
                html += f'<img alt="{step}" style="width:100%;background:white" src="data:image/svg+xml;base64,{data}">'
            html += saved.format(
                file.name, file.suffix[1:].replace("svg", "svg+xml"), data, file.suffix[1:].upper()
            )
        return html

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
        """Add a button that stores a file in a folder of the page."""

        def store(event: Any) -> None:
            self.jobs.require_idle()
            store_upload(event.target.value.name, event.target.value.content, self.folder / place)
            self.status.content = (
                f"{escape_markdown(event.target.value.name)} is stored in {place}."
            )

        self.gui.add_upload_button(label).on_upload(lambda event: self._attempt(store, event))

    def _attempt(self, act: Callable[..., None], *arguments: Any) -> None:
        """Call a function; an error is shown above the steps."""
        try:
            act(*arguments)
        except Exception as error:  # whatever it is, the page and the running command go on
            kind = (
                ""
                if isinstance(error, (GAPONetError, OSError))
                else f"Unexpected {type(error).__name__}: "
            )
            self.status.content = f"**Not done.** {kind}{escape_markdown(str(error))}"

    def _need(self, step: str) -> Job:
        job = self.jobs.result(step)
        if job is None:
            raise UsageError(f"{step}: there is no result yet. {self.texts[step][1]}")
        return job

    def _chosen_robot(self) -> RobotSpec:
        name = self._need("robot").out
        return load_robot(name if name in packaged_robots() else self.folder / name)

    def _dataset(self) -> Dataset:
        return Dataset(self.folder / self._need("import").out)


def store_upload(name: str, content: bytes, folder: Path) -> None:
    """Write an uploaded file, or what a .zip holds, below a folder: all or nothing, inside it, and over no file."""
    with tempfile.TemporaryDirectory(
        prefix=f"{FOLDER_MARKER}-{os.getpid()}-", dir=folder.parent
    ) as temporary:
        if name.lower().endswith(".zip"):
            try:
                with zipfile.ZipFile(io.BytesIO(content)) as archive:
                    if sum(item.file_size for item in archive.infolist()) > MAX_UNPACKED_BYTES:
                        raise UsageError(
                            f"{name}: holds more than {MAX_UNPACKED_BYTES >> 30} GiB; give it in parts"
                        )
                    archive.extractall(temporary)  # which drops .. and a leading / from names
            except (zipfile.BadZipFile, zlib.error, EOFError, RuntimeError, ValueError) as error:
                raise UsageError(
                    f"{name}: is not readable ({error}); pack it again, without a password"
                ) from None
        else:
            Path(temporary, re.split(r"[/\\:]", name)[-1].lstrip(".") or "file").write_bytes(
                content
            )
        places = {
            f: folder / f.relative_to(temporary) for f in Path(temporary).rglob("*") if f.is_file()
        }
        for place in places.values():
            if place.exists() or not place.resolve().is_relative_to(folder.resolve()):
                raise UsageError(
                    f"{place}: exists, or a link leads out of here; nothing is stored; move it away"
                )
        for file, place in places.items():
            place.parent.mkdir(parents=True, exist_ok=True)
            shutil.move(file, place)


def _ending(job: Job) -> str:
    """Return how a command ended, in Markdown."""
    if job.result is not None:
        return f"**gaponet {job.words[0]}** has ended."
    last = [line for line in job.lines if line.strip() and not PROGRESS_LINE.match(line)][-1:]
    why = last[0] if last else "it was cancelled; what was there before is unchanged."
    return f"**gaponet {job.words[0]}** gave no result: {escape_markdown(why)}"


def _report(job: Job) -> str:
    """Return what a command printed, in Markdown, and the command."""
    lines = list[str]()
    for line in job.lines:
        text = re.sub("[┃│]", "|", escape_markdown(line.strip()))
        if line.startswith("┡"):
            lines.append(f"| --- |{' ---: |' * line.count('╇')}")
        elif line.startswith(("┃", "│")):
            lines.append(text)
        elif text and not line.startswith(("┏", "└", "     ok ")) and not PROGRESS_LINE.match(line):
            bold = "**" * text.startswith(("error ", "warning "))
            lines += ["", f"{bold}{text}{bold}"]
    return "\n".join(
        [*lines, "", f"To repeat it in the folder of this page: {escape_markdown(job.command)}"]
    )


def serve(page: App, say: Callable[[str], None], step: str = "") -> None:
    """Serve a page until Ctrl-C; `step` is the number of the step that is shown first."""
    signal.signal(
        signal.SIGTERM, lambda *_: sys.exit(143)
    )  # otherwise the running command would stay
    say(f"open {page.address}{step and '?step=' + step} in a browser; Ctrl-C ends")
    try:
        run_until_interrupt(page.server, page.tick)
    finally:
        page.jobs.cancel()


def serve_dataset(
    data: Dataset, scene: Scene, clip: Clip, port: int, magnify: float, say: Callable[[str], None]
) -> None:
    """Serve a dataset and a scene of it at step Gap. The page's folder stays if a command has written into it."""
    folder = Path(tempfile.mkdtemp(prefix="gaponet_view_"))
    jobs = Jobs(folder)
    jobs.add("robot", "robot", "check", str(scene.shown.robot.folder.resolve()), result="{}")
    jobs.add("import", "data", "card", str(data.path.resolve()), result="{}")
    page = App(folder, port)
    page.play(scene, clip, magnify)
    try:
        serve(page, say, "4")
    finally:
        if len(jobs.all) > 2:
            say(f"results are in {folder}; to go on: gaponet app {folder}")
        else:
            shutil.rmtree(folder)
