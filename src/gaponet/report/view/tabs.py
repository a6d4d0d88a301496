"""The six tabs of the page of `gaponet app`: the controls of each, and the steps they start."""

from __future__ import annotations

from collections.abc import Callable
from typing import Protocol, get_args

import numpy as np

from gaponet.base.errors import UsageError
from gaponet.base.files import write_text
from gaponet.base.text import escape_markdown
from gaponet.data.describe.guess import guess_logs
from gaponet.data.formats import PositionUnit, look
from gaponet.data.store import Dataset
from gaponet.evaluation.methods import colour
from gaponet.evaluation.verdict import NetworkGain
from gaponet.report import steps
from gaponet.report.steps import Option, Step, Target
from gaponet.report.view.controls import Controls
from gaponet.report.view.inside import read_inside
from gaponet.report.view.jobs import OUT, Job, Jobs
from gaponet.report.view.player import draw_curves
from gaponet.report.view.side_by_side import SideBySide, side_by_side, standing
from gaponet.report.view.uploads import Uploads
from gaponet.robot.finding import Finding, errors_of
from gaponet.robot.spec import RobotSpec, load_robot, packaged_robots
from gaponet.sim.dataset_robot import dataset_robot
from gaponet.sysid.options import IdentifyOptions

MODEL_SUFFIXES = (".xml", ".mjcf", ".urdf")
POSITION_UNITS = ("as the logs state", *get_args(PositionUnit))
TARGETS = get_args(Target)
URDF_TARGET = "urdf"  # for a robot that was made from one: the export is an edited copy
NETWORK_TARGETS = ("onnx", "torch")  # of a trained network
# Target → engine that applies parameter sets; others read a file.
ENGINES = {"mjcf": "mujoco", "mjlab": "mjlab", "isaaclab": "isaaclab"}
FEWEST_WINDOWS = 4  # of an identification
Play = Callable[[SideBySide], None]  # shows motions in the page


class Tab(Protocol):
    """A tab of the page."""

    def show(self) -> None:
        """Show the results, and what may be done next."""


class RobotTab:
    """Tab 1: a robot of the package, or a model of the user's."""

    def __init__(self, controls: Controls, uploads: Uploads, play: Play) -> None:
        self.controls = controls
        self.jobs = controls.jobs
        self.folder = controls.folder
        self.play = play
        self.drawn = 0  # number of the command whose robot stands in the page
        gui = controls.gui
        self.model = gui.add_dropdown("robot", packaged_robots())
        controls.add_upload(
            "Upload a model: MJCF, URDF, or a .zip with its meshes", uploads, "model"
        )
        hints = {
            "joints": "names; empty: all that are driven",
            "kp": "80 joint2=120, N·m/rad",
            "kd": "N·m·s/rad",
        }
        self.options = {name: gui.add_text(name, "", hint=hint) for name, hint in hints.items()}
        controls.add_step("robot", self.use)
        controls.add_place("robot", "Choose a robot of the package, or upload a model of yours.")

    def use(self) -> Step:
        """Return the step that checks a robot of the package, or makes one of a model."""
        options = dict[str, Option]()
        for name, box in self.options.items():
            words = box.value.split()
            if any(word.startswith("-") for word in words):
                raise UsageError("joints, kp and kd are names and numbers, without a dash in front")
            options[name] = tuple(words)
        name = str(self.model.value)
        if name in packaged_robots():
            return steps.use_robot(name)
        return steps.make_robot(name, OUT, **options)

    def chosen(self) -> RobotSpec:
        """Return the robot that was chosen.

        Raises:
            UsageError: None was.
        """
        name = self.controls.need("robot").out
        if name in packaged_robots():
            return load_robot(name)
        return load_robot(self.folder / name)

    def urdf(self) -> str:
        """Return the uploaded URDF of which the robot was made; "" for another robot."""
        job = self.jobs.result("robot")
        if job is None or job.words[:2] != ["robot", "new"]:
            return ""
        model = job.words[2]
        return model if model.lower().endswith(".urdf") else ""

    def list_models(self) -> None:
        """Offer the robots of the package and the uploaded models."""
        uploaded = []
        for file in sorted((self.folder / "model").rglob("*")):
            if file.suffix.lower() in MODEL_SUFFIXES:
                uploaded.append(file.relative_to(self.folder).as_posix())
        self.model.options = [*packaged_robots(), *uploaded]

    def show(self) -> None:
        """Show the result, and a robot that was just chosen."""
        self.controls.show("robot")
        job = self.jobs.result("robot")
        if job is not None and job.number != self.drawn:
            self.play(standing(self.chosen()))
            self.drawn = job.number


class LogsTab:
    """Tab 2: logs become recordings."""

    def __init__(self, controls: Controls, uploads: Uploads, robot: RobotTab) -> None:
        self.controls = controls
        self.jobs = controls.jobs
        self.folder = controls.folder
        self.robot = robot
        gui = controls.gui
        controls.add_upload("Upload a log, or a .zip of logs", uploads, "logs")
        gui.add_markdown(f"Or copy them into {escape_markdown(str(self.folder / 'logs'))}.")
        self.unit = gui.add_text("unit", "lab")
        self.mass = gui.add_number("payload, kg", 0.0, min=0.0)
        self.position = gui.add_dropdown("positions in", POSITION_UNITS)
        self.cut = gui.add_number(
            "cut into pieces, s", 0.0, min=0.0, hint="0: not cut; 3 motions are needed"
        )
        self.described = gui.add_text(
            "logs.toml", "", multiline=True, hint="empty: the logs.toml of the folder"
        )
        controls.add_button("Guess logs.toml from the logs", self.guess)
        controls.add_button("Set these logs aside", self.set_aside)
        controls.add_step("import", self.read)
        controls.add_place("import", "Upload logs, then read them.")
        self.recording = gui.add_dropdown("recording", ("–",))
        self.joint = gui.add_dropdown("joint", ("–",))
        nothing = np.zeros(2)
        lines = {
            "target": (nothing, colour("target")),
            "measured": (nothing, colour("gaponet")),
        }
        self.curves = draw_curves(gui, np.arange(2), lines, "rad")
        for choice in (self.recording, self.joint):
            choice.on_update(lambda _: self._draw_recording())

    def set_aside(self, place: str = "logs") -> None:
        """Rename the folder of logs, so that others can be uploaded."""
        number = 1
        while (self.folder / f"{place}_aside{number}").exists():
            number += 1
        aside = f"{place}_aside{number}"
        with self.jobs.idle():
            (self.folder / place).rename(self.folder / aside)
            (self.folder / place).mkdir()
        self.controls.say(f"The logs are in {aside} now; {place} is empty.")

    def guess(self) -> None:
        """Describe logs that no format fits, in the text field."""
        file = self.folder / "logs" / "logs.toml"
        if file.is_file() and self.stored_description() != self.described.value:
            raise UsageError(f"{file} is there, and a guess would replace it; move it away first")
        kind, facts, recordings = look(self.folder / "logs")
        self.described.value = guess_logs(recordings, self.robot.chosen(), kind, dict(facts))

    def read(self) -> Step:
        """Return the step that imports the logs for the chosen robot."""
        robot = self.controls.need("robot").out
        return steps.import_logs("logs", robot, OUT, **self.describe("logs"))

    def describe(self, logs: str) -> dict[str, Option]:
        """Write the logs.toml of a folder of logs; return the options of their import."""
        self.jobs.require_idle()
        if self.described.value.strip():  # otherwise a file of the user's stays as it is
            write_text(self.folder / logs / "logs.toml", self.described.value)
        is_stated = self.position.value in POSITION_UNITS[1:]
        return {
            "unit_id": self.unit.value,
            "payload_mass": f"{self.mass.value:g}",
            "position_unit": self.position.value if is_stated else None,
            "cut": f"{self.cut.value:g}" if self.cut.value > 0 else None,
        }

    def stored_description(self) -> str:
        """Return the logs.toml of the folder; "" if there is none."""
        if not (self.folder / "logs" / "logs.toml").is_file():
            return ""
        return read_inside(self.folder, "logs/logs.toml").decode()

    def dataset(self) -> Dataset:
        """Return the recordings.

        Raises:
            UsageError: There are none.
        """
        return Dataset(self.folder / self.controls.need("import").out)

    def show(self) -> None:
        """Show the result, and the curves of a recording."""
        self.controls.show("import")
        if self.jobs.result("import") is None:
            return
        data = self.dataset()
        self.recording.options = [entry.id for entry in data.entries]
        self.joint.options = data.joint_names
        self._draw_recording()

    def _draw_recording(self) -> None:
        """Draw target and measured position of the chosen joint in the chosen recording."""
        data = self.dataset()
        entry = next((e for e in data.entries if e.id == self.recording.value), None)
        if entry is None or self.joint.value not in data.joint_names:
            return  # the choices are being replaced
        real = data.read(entry)
        j = data.joint_names.index(self.joint.value)
        time = real.dt * np.arange(len(real))
        self.curves.data = (time, real.ctrl[:, j].astype(float), real.qpos[:, j].astype(float))


class CheckTab:
    """Tab 3: are the recordings sound?"""

    def __init__(self, controls: Controls, logs: LogsTab) -> None:
        self.controls = controls
        self.logs = logs
        controls.add_step("doctor", self._check)
        self.proposal = controls.add_button(
            "Write a proposal for logs.toml into step Logs", self.propose
        )
        controls.add_place("doctor", "Check the recordings.")

    def _check(self) -> Step:
        return steps.check_recordings(self.controls.need("import").out, figures=OUT)

    def propose(self) -> None:
        """Add the lines that mend the findings to the text of step Logs."""
        findings = findings_of(self.controls.need("doctor"))
        own = self.logs.described.value or self.logs.stored_description()
        self.logs.described.value = f"{own}\n{Finding.proposal(findings)}".lstrip()

    def show(self) -> None:
        """Show the findings."""
        self.controls.show("doctor")
        self.proposal.visible = self.controls.jobs.result("doctor") is not None


class GapTab:
    """Tab 4: how far the simulator is from the robot."""

    def __init__(self, controls: Controls, logs: LogsTab, play: Play) -> None:
        self.controls = controls
        self.logs = logs
        self.play = play
        controls.add_step("gap", self._measure)
        controls.add_button(
            "Show the recording of step Logs beside its simulation", self.show_recording
        )
        self.stage = controls.gui.add_folder(None)
        controls.add_place("gap", "Measure how far the simulator is from the robot.")

    def _measure(self) -> Step:
        return steps.measure_error(self.controls.need("import").out)

    def show_recording(self) -> None:
        """Show the chosen recording beside its simulations."""
        data = self.logs.dataset()
        folder = self.controls.folder
        identified = self.controls.jobs.result("identify")
        if identified is None:
            robot = dataset_robot(data)
        else:
            robot = load_robot(folder / identified.out)
        entry = next(e for e in data.entries if e.id == self.logs.recording.value)
        network = helping_network(self.controls.jobs)
        runs = [folder / network.out] if network else []
        self.play(side_by_side(data, entry, robot, runs))

    def show(self) -> None:
        """Show the error."""
        self.controls.show("gap")


class IdentifyTab:
    """Tab 5: the robot's servos from the recordings."""

    def __init__(self, controls: Controls) -> None:
        self.controls = controls
        gui = controls.gui
        # A number of rollouts: a limit of time would make the result depend on the machine.
        self.windows = gui.add_number(
            "rollouts",
            IdentifyOptions.windows,
            min=FEWEST_WINDOWS,
            step=1,
            hint="of 8 s, that are fitted; fewer are quicker and less exact",
        )
        self.table = gui.add_checkbox("look for a table under the robot", True)
        self.button = controls.add_step("identify", self.identify)
        controls.add_place("identify", "Identify the robot.")
        controls.add_place("causes", "")

    def identify(self) -> Step:
        """Return the step that identifies the robot.

        Raises:
            UsageError: Identification is locked.
        """
        reason = self.locked()
        if reason:
            raise UsageError(reason)
        data = self.controls.need("import").out
        windows = int(self.windows.value)
        return steps.identify(data, OUT, windows=windows, no_table=not self.table.value)

    def locked(self) -> str:
        """Return why identification may not start; "" if it may."""
        first = self.controls.first("doctor")
        if first:
            return first
        errors = errors_of(findings_of(self.controls.need("doctor")))
        if not errors:
            return ""
        names = escape_markdown(", ".join(finding.check for finding in errors))
        return f"Locked: the check finds an error ({names}). Step Check says what to do."

    def show(self) -> None:
        """Show the identified values, and the error by causes."""
        self.controls.show("identify")
        identified = self.controls.jobs.result("identify")
        if identified is None:
            self.controls.places["identify"].text.content = self.locked() or "Identify the robot."
            self.controls.places["causes"].text.content = ""
            self.controls.places["causes"].pictures.content = ""
        else:
            drawn = [f"{identified.out}/gap.svg", f"{identified.out}/gap.png"]
            self.controls.show("causes", drawn)
        self.button.disabled = bool(self.locked())

    def compare(self) -> None:
        """Measure the error of the identified robot beside the nominal one's, by causes."""
        data = self.controls.need("import").out
        identified = self.controls.need("identify").out
        self.controls.jobs.start(steps.measure_causes(data, identified))


class UseTab:
    """Tab 6: exports, parameter sets, another day or unit, and a network."""

    def __init__(self, controls: Controls, uploads: Uploads, logs: LogsTab) -> None:
        self.controls = controls
        self.logs = logs
        gui = controls.gui
        self.target = gui.add_dropdown("for", TARGETS)
        controls.add_step("export", self._export)
        controls.add_place("export", "Export the robot for your simulator.")
        controls.add_step("randomization", self._draw)
        controls.add_place(
            "randomization",
            "A policy is then trained on robots that these logs cannot tell from yours.",
        )
        controls.add_upload("Upload new logs, of another day or unit", uploads, "new_logs")
        controls.add_button("Set these new logs aside", lambda: logs.set_aside("new_logs"))
        controls.add_step("new", self._read_new_logs)
        controls.add_place("new", "Unit, payload, positions and logs.toml are those of step Logs.")
        controls.add_step("check", self._check)
        controls.add_place("check", "Check whether the identified robot still fits the new logs.")
        controls.add_step("adapt", self._adapt)
        controls.add_place("adapt", "The calibrated robot is then exported.")
        self.budget = gui.add_text("training time", "10m")
        controls.add_step("train", self._train)
        controls.add_place("train", "A network can be exported if validation says that it helps.")

    def _export(self) -> Step:
        target = str(self.target.value)
        if target in NETWORK_TARGETS:
            exported = self.controls.need("train").out
        else:
            exported = self._best_robot()
        into = self.logs.robot.urdf() if target == URDF_TARGET else None
        return steps.export(exported, target, out=OUT, into=into)

    def _draw(self) -> Step:
        engine = ENGINES.get(str(self.target.value), "json")
        return steps.draw_parameter_sets(self._best_robot(), engine, OUT)

    def _read_new_logs(self) -> Step:
        robot = self.controls.need("identify").out
        return steps.import_new_logs("new_logs", robot, OUT, **self.logs.describe("new_logs"))

    def _check(self) -> Step:
        return steps.check_robot(self.controls.need("identify").out, self.controls.need("new").out)

    def _adapt(self) -> Step:
        identified = self.controls.need("identify").out
        return steps.adapt(identified, self.controls.need("new").out, OUT)

    def _train(self) -> Step:
        data = self.controls.need("import").out
        robot = self.controls.need("identify").out
        return steps.train(data, robot, OUT, budget=str(self.budget.value))

    def _best_robot(self) -> str:
        """Return the calibrated robot if there is one, else the identified one."""
        adapted = self.controls.jobs.result("adapt")
        return adapted.out if adapted else self.controls.need("identify").out

    def show(self) -> None:
        """Show the results, and offer a network only if it helps."""
        for step in ("export", "randomization", "new", "check", "adapt", "train"):
            self.controls.show(step)
        targets: tuple[str, ...] = TARGETS
        if self.logs.robot.urdf():
            targets += (URDF_TARGET,)
        if helping_network(self.controls.jobs) is not None:
            targets += NETWORK_TARGETS
        self.target.options = targets


def findings_of(job: Job) -> list[Finding]:
    """Return the findings of a check."""
    return [] if job.result is None else job.result.get("findings", [])


def helping_network(jobs: Jobs) -> Job | None:
    """Return the training if its network helps on validation motions."""
    job = jobs.result("train")
    if job is None or job.result is None:
        return None
    error = job.result.get("val_mpjae", {})
    gain = NetworkGain(
        "", error.get("added") or 0.0, error.get("error") or np.nan, error.get("start") or 0.0
    )
    return job if gain.helps else None
