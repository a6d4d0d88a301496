"""The page of `gaponet app`: six steps from logs to an identified simulator, each by commands in one folder."""

from __future__ import annotations

import base64
import io
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from gaponet.base.errors import GAPONetError, UsageError
from gaponet.base.files import write_text
from gaponet.base.text import escape_markdown
from gaponet.data.describe.guess import guess_logs
from gaponet.data.formats import look
from gaponet.data.store import Dataset
from gaponet.report.methods import colour
from gaponet.report.view.jobs import OUT, PROGRESS_LINE, Job, Jobs
from gaponet.report.view.player import Player, draw_curves
from gaponet.report.view.scene import Scene
from gaponet.report.view.server import open_server
from gaponet.report.view.side_by_side import Clip, side_by_side, standing
from gaponet.report.view.uploads import store_upload
from gaponet.robot.finding import Finding
from gaponet.robot.spec import RobotSpec, load_robot, packaged_robots
from gaponet.sim.dataset_robot import dataset_robot

MODEL_SUFFIXES = (".xml", ".mjcf", ".urdf")
POSITION_UNITS = ("as the logs state", "rad", "deg", "fraction", "signed_percent")
TARGETS = ("mjcf", "urdf", "mjlab", "isaaclab", "newton", "drake", "json")
POLL_S = 0.5
PANEL_WIDTH = 560  # pixels
STYLE = "<style>.mantine-Slider-mark, .mantine-Slider-markLabel, .u-legend {font-size: 12px !important}</style>"


class App:
    """Controls, texts and pictures of the page. All pages of a server show the same."""

    def __init__(self, folder: Path, port: int) -> None:
        """Serve the page of a folder.

        Args:
            folder: Absolute path; holds logs, models, commands and their results.
            port: Port on this machine.
        """
        self.folder, self.jobs, self.polled, self.seen = folder, Jobs(folder), 0.0, (-1, True)
        self.server, self.address = open_server("gaponet app", port)
        self.gui = self.server.gui
        self.texts: dict[str, tuple[Any, str, Any]] = {}  # step → text, hint, folder of its pictures
        self.parts: dict[str, list[Any]] = {}  # step → pictures and their buttons
        self.player: Player | None = None
        for name in ("logs", "model"):
            (folder / name).mkdir(exist_ok=True)
        self.gui.main_panel.set_width(PANEL_WIDTH)
        self.gui.add_html(STYLE)
        self.status = self.gui.add_markdown("")
        self.bar, self.cancel = self.gui.add_progress_bar(0.0), self._button("Cancel", lambda _: self.jobs.cancel())
        tabs = self.gui.add_tab_group()
        for number, step in enumerate((self._robot, self._logs, self._check, self._gap, self._identify, self._use), 1):
            with tabs.add_tab(f"{number} {step.__name__.strip('_').capitalize()}"):
                step()
        self.refresh()

    def tick(self, elapsed: float) -> None:
        """Play on, and look after the running command."""
        if self.player is not None:
            self.player.advance(elapsed)
        self.polled += elapsed
        if self.polled >= POLL_S:
            self.polled = 0.0
            self._attempt(self.refresh)

    # Steps: controls, and the command of each button.

    def _robot(self) -> None:
        self.model = self.gui.add_dropdown("robot", packaged_robots())
        self._button("Upload a model: MJCF, URDF, or a .zip with its meshes", self._upload("model"), upload=True)
        fields = {"joints": "all that the model drives", "kp": "N·m/rad, or JOINT=NUMBER", "kd": "N·m·s/rad, likewise"}
        self.options = {name: self.gui.add_text(name, "", hint=hint) for name, hint in fields.items()}
        self._button("Use this robot", self._use_robot)
        self._text("robot", "Choose a robot of the package, or upload a model of yours.")

    def _use_robot(self, _: Any) -> None:
        name = str(self.model.value)
        if name in packaged_robots():
            self.jobs.start("robot", "robot", "check", name)
            return
        given = [x for k, box in self.options.items() if box.value.split() for x in (f"--{k}", *box.value.split())]
        if any(x.startswith("-") for k, box in self.options.items() for x in box.value.split()):
            raise UsageError("joints, kp and kd are names and numbers, without a dash in front")
        self.jobs.start("robot", "robot", "new", name, "--out", OUT, *given)

    def _logs(self) -> None:
        self._button("Upload a log, or a .zip of logs", self._upload("logs"), upload=True)
        self.gui.add_markdown(f"Or copy them into {escape_markdown(str(self.folder / 'logs'))}.")
        self.unit, self.mass = self.gui.add_text("unit", "lab"), self.gui.add_number("payload, kg", 0.0, min=0.0)
        self.position = self.gui.add_dropdown("positions in", POSITION_UNITS)
        self.described = self.gui.add_text("logs.toml", "", multiline=True)
        self._button("Guess logs.toml from the logs", self._guess)
        self._button("Read the logs", self._read)
        self._text("import", "Choose the robot first. Then upload logs, and read them.")
        self.recording = self.gui.add_dropdown("recording", ("–",))
        self.joint = self.gui.add_dropdown("joint", ("–",))
        self.curves = self.gui.add_folder(None)
        self.recording.on_update(lambda _: self._draw_recording())
        self.joint.on_update(lambda _: self._draw_recording())

    def _guess(self, _: Any) -> None:
        kind, facts, recordings = look(self.folder / "logs")
        self.described.value = guess_logs(recordings, self._spec(), kind, dict(facts))

    def _read(self, _: Any) -> None:
        robot, file = self._need("robot"), self.folder / "logs" / "logs.toml"
        if self.described.value.strip():
            write_text(file, self.described.value)
        else:
            file.unlink(missing_ok=True)
        words = [f"--unit-id={self.unit.value}", f"--payload-mass={self.mass.value:g}", "--out", OUT]
        words += [f"--position-unit={self.position.value}"] * (self.position.value in POSITION_UNITS[1:])
        self.jobs.start("import", "import", "logs", f"--robot={_robot_of(robot)}", *words)

    def _check(self) -> None:
        self._button("Check the recordings", self._doctor)
        self._text("doctor", "Read the logs first. Then check them.")
        self.proposal = self._button("Add the proposal to logs.toml", self._propose)

    def _doctor(self, _: Any) -> None:
        data = _out(self._need("import"))
        self.jobs.start("doctor", "doctor", data, "--figures", OUT)

    def _propose(self, _: Any) -> None:
        findings = [Finding(**f) for f in (self._need("doctor").result or {})["findings"]]
        self.described.value = f"{self.described.value}\n{Finding.proposal(findings)}".lstrip()
        raise UsageError("logs.toml in step Logs holds the proposal now; look it over, then read the logs again")

    def _gap(self) -> None:
        self._button("Measure the error", lambda _: self.jobs.start("gap", "gap", _out(self._need("import"))))
        self._button("Show the recording of step Logs beside its simulation", lambda _: self._show())
        self.stage = self.gui.add_folder(None)
        self._text("gap", "Read the logs first. Then measure how far the simulator is from the robot.")

    def _show(self) -> None:
        data, identified = self._dataset(), self.jobs.result("identify")
        robot = dataset_robot(data) if identified is None else load_robot(self.folder / _out(identified))
        entry = next(e for e in data.entries if e.id == self.recording.value)
        shown = side_by_side(data, entry, robot)
        self._play(Scene(shown), Clip.from_start(shown, 0.0, 3600.0))

    def _identify(self) -> None:
        self.limit = self.gui.add_text("time limit", "", hint="such as 60s or 4m; empty for none")
        self.table = self.gui.add_checkbox("look for a table under the robot", True)
        self.fit = self._button("Identify", self._fit)
        self._text("identify", "Check the recordings first. Identification is locked while the check finds an error.")
        self._text("causes", "")

    def _fit(self, _: Any) -> None:
        if self._locked():
            raise UsageError(self._locked())
        words = [f"--budget={self.limit.value.strip()}"] * bool(self.limit.value.strip())
        words += ["--no-table"] * (not self.table.value)
        self.jobs.start("identify", "identify", _out(self._need("import")), "--out", OUT, *words)

    def _use(self) -> None:
        self.target = self.gui.add_dropdown("for", TARGETS)
        self._button("Export", self._export)
        self._text("export", "Identify the robot first. Then export it for your simulator.")
        self._button("Download the export as .zip", self._download)

    def _export(self, _: Any) -> None:
        robot = _out(self._need("identify"))
        self.jobs.start("export", "export", robot, "--to", str(self.target.value), "--out", OUT)

    def _download(self, event: Any) -> None:
        folder, content = self.folder / _out(self._need("export")), io.BytesIO()
        with zipfile.ZipFile(content, "w", zipfile.ZIP_DEFLATED) as archive:
            for path in sorted(p for p in folder.rglob("*") if p.is_file() and not p.name.startswith(".")):
                archive.write(path, path.relative_to(folder.parent))
        event.client.send_file_download(f"{folder.name}.zip", content.getvalue())

    # What the page shows: only what the files say.

    def refresh(self) -> None:
        """Show the running command; when one starts or ends, also the results and what may be done next."""
        running, every = self.jobs.running, self.jobs.all
        self.bar.visible = self.cancel.visible = running is not None
        if running is not None:
            self.bar.value, note = running.progress
            self.status.content = f"**gaponet {running.words[0]}**, {self.bar.value:.0f} %. {escape_markdown(note)}"
        self.model.options = [*packaged_robots(), *self._models()]
        if self.seen == (state := (len(every), running is None)):
            return
        self.seen = state
        if running is None:
            self.status.content = _ending(every[-1]) if every else "Six steps, from left to right."
        for step, (text, hint, pictures) in self.texts.items():
            job = self.jobs.result(step)
            text.content = hint if job is None else _report(job)
            self._show_pictures(step, pictures, job)
        self.fit.disabled, self.proposal.visible = bool(self._locked()), self.jobs.result("doctor") is not None
        if self.jobs.result("import"):
            self.recording.options = [entry.id for entry in self._dataset().entries]
            self.joint.options = self._dataset().joint_names
            self._draw_recording()
        if running is None and every and every[-1].result and every[-1].step == "identify":
            self.jobs.start("causes", "gap", _out(self._need("import")), "--robot", f"./{_out(every[-1])}")
        elif self.player is None and self.jobs.result("robot"):
            shown = standing(self._spec())
            self._play(Scene(shown), Clip.from_start(shown, 0.0, 1.0)).playing.value = False
            self.stage.visible = False

    def _play(self, scene: Scene, clip: Clip) -> Player:
        if self.player is not None:
            self.player.remove()
        self.stage.visible = True
        with self.stage:
            self.player = Player(self.server, scene, clip)
        return self.player

    def _draw_recording(self) -> None:
        """Draw target and measured position of the chosen joint in the chosen recording."""
        data = self._dataset()
        entry = next((e for e in data.entries if e.id == self.recording.value), None)
        if entry is None or self.joint.value not in data.joint_names:
            return  # the choices are being replaced
        real, j = data.read(entry), data.joint_names.index(self.joint.value)
        self.curves.remove()
        with self.texts["import"][2]:
            self.curves = self.gui.add_folder(None)
        with self.curves:
            lines = {"target": (real.ctrl[:, j], colour("target")), "measured": (real.qpos[:, j], colour("gaponet"))}
            draw_curves(self.gui, real.dt * np.arange(len(real)), lines, "rad")

    def _show_pictures(self, step: str, folder: Any, job: Job | None) -> None:
        """Show the figures of a result, with buttons that save them."""
        for handle in self.parts.pop(step, ()):
            handle.remove()
        figures = [] if job is None else [self.folder / f for f in (job.result or {}).get("figures", ())]
        if job is not None and step == "causes":
            figures = [self.folder / _out(self._need("identify")) / "gap.svg"]
        for figure in (f for f in figures if f.suffix == ".svg" and f.is_file()):
            data = base64.b64encode(figure.read_bytes()).decode()
            with folder:
                shown = self.gui.add_html(f'<img alt="{step}" width="100%" src="data:image/svg+xml;base64,{data}">')
                save = self.gui.add_button_group(f"save {figure.stem}", ("PNG", "SVG"))
            save.on_click(lambda e, figure=figure: _send(e, figure.with_suffix(f".{e.target.value.lower()}")))
            self.parts.setdefault(step, []).extend((shown, save))

    def _text(self, step: str, hint: str) -> None:
        """Add the place of a step's result; `hint` stands there before."""
        self.texts[step] = self.gui.add_markdown(hint), hint, self.gui.add_folder(None)

    def _button(self, label: str, act: Callable[[Any], None], upload: bool = False) -> Any:
        """Add a button. An error of its action is shown above the steps."""
        button = (self.gui.add_upload_button if upload else self.gui.add_button)(label)

        (button.on_upload if upload else button.on_click)(lambda event: self._attempt(act, event))
        return button

    def _attempt(self, act: Callable[..., None], *arguments: Any) -> None:
        try:
            act(*arguments)
        except (GAPONetError, OSError) as error:
            self.status.content = f"**Not done.** {escape_markdown(str(error))}"

    def _upload(self, place: str) -> Callable[[Any], None]:
        def store(event: Any) -> None:
            files = store_upload(event.target.value.name, event.target.value.content, self.folder / place)
            self.status.content = f"{len(files)} file(s) stored in {place}."

        return store

    def _models(self) -> list[str]:
        files = sorted((self.folder / "model").rglob("*"))
        return [f.relative_to(self.folder).as_posix() for f in files if f.suffix.lower() in MODEL_SUFFIXES]

    def _need(self, step: str) -> Job:
        job = self.jobs.result(step)
        if job is None:
            raise UsageError(self.texts[step][1])
        return job

    def _locked(self) -> str:
        """Why identification may not start; "" if it may."""
        job = self.jobs.result("doctor")
        if job is None:
            return self.texts["identify"][1]
        errors = [f["check"] for f in (job.result or {})["findings"] if f["level"] == "error"]
        way = "Step Check says what to do; then read the logs again and check them."
        return f"Locked: the check finds {len(errors)} error(s): {', '.join(errors)}. {way}" if errors else ""

    def _spec(self) -> RobotSpec:
        name = _robot_of(self._need("robot"))
        return load_robot(name if name in packaged_robots() else self.folder / name)

    def _dataset(self) -> Dataset:
        return Dataset(self.folder / _out(self._need("import")))


def _out(job: Job) -> str:
    """Return the folder that a command wrote."""
    return next(b for a, b in zip(job.words, job.words[1:], strict=False) if a in ("--out", "--figures"))


def _robot_of(job: Job) -> str:
    """Return the value of --robot for the robot of the first step."""
    return job.words[2] if job.words[1] == "check" else f"./{_out(job)}"


def _send(event: Any, path: Path) -> None:
    event.client.send_file_download(path.name, path.read_bytes())


def _ending(job: Job) -> str:
    """Return how a command ended, in Markdown."""
    if job.result is not None:
        return f"**gaponet {job.words[0]}** has ended."
    last = [line for line in job.lines if line.strip() and not PROGRESS_LINE.match(line)][-1:]
    why = last[0] if last else "it was cancelled; what was there before is unchanged."
    return f"**gaponet {job.words[0]}** gave no result: {escape_markdown(why)}"


def _report(job: Job) -> str:
    """Return what a command printed, in Markdown, and the command."""
    lines, heading = list[str](), list[str]()
    for line in job.lines:
        cells = [escape_markdown(cell.strip()) for cell in line.strip("┃│").replace("┃", "│").split("│")]
        if line.startswith("┃"):
            heading = [f"{a} {b}".strip() for a, b in zip(heading, cells, strict=True)] if heading else cells
        elif line.startswith("┡"):
            lines += [f"| {' | '.join(heading)} |", f"| --- |{' ---: |' * (len(heading) - 1)}"]
            heading = []
        elif line.startswith("│"):
            lines.append(f"| {' | '.join(cells)} |")
        elif line[:1] not in ("┏", "└") and not PROGRESS_LINE.match(line) and not line.startswith("     ok "):
            lines += ["", *cells]
    return "\n".join([*lines, "", f"To repeat it in the folder of this page: {escape_markdown(job.command)}"])
