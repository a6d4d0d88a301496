"""The steps from a model and logs to a robot that is used, and how each is typed.

`gaponet start` and `gaponet demo --real` walk `steps_from_logs`. The page of `gaponet app` has a
button for each step.
"""

from __future__ import annotations

import shlex
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

from gaponet.robot.spec import robot_argument

Target = Literal["mjcf", "mjlab", "isaaclab", "newton", "json"]
Option = str | float | bool | tuple[str, ...] | None
# Name of a step → what a person reads of it.
TITLES = {
    "robot": "Use this robot",
    "import": "Read the logs",
    "doctor": "Check the recordings",
    "gap": "Measure the error",
    "identify": "Identify",
    "causes": "Measure what each cause removes",
    "export": "Export",
    "report": "Write the report",
    "randomization": "Parameter sets for training",
    "new": "Read the new logs",
    "check": "Check whether the robot changed",
    "adapt": "Calibrate with the new logs",
    "train": "Train a network",
}
REPEATED = ("map",)  # options that take one value each time


@dataclass(frozen=True)
class Step:
    """One command on the way from logs to a robot that is used.

    Attributes:
        name: One of TITLES.
        words: The command, without gaponet in front.
    """

    name: str
    words: tuple[str, ...]

    @property
    def title(self) -> str:
        """What it does."""
        return TITLES[self.name]

    @property
    def line(self) -> str:
        """The command as it is typed."""
        return shlex.join(["gaponet", *self.words])


def steps_from_logs(
    logs: Path,
    robot: str,
    import_options: Mapping[str, Option],
    out: Path,
    identify_options: Mapping[str, Option],
    to: Target,
) -> list[Step]:
    """Return the steps from logs of a robot that exists to a report.

    Args:
        robot: Value of --robot.
        import_options: Options of gaponet import.
        out: Folder for the dataset (OUT/data) and the identified robot (OUT/identified).
        identify_options: Options of gaponet identify.
        to: Engine to export to.
    """
    data = str(out / "data")
    identified = out / "identified"
    return [
        import_logs(str(logs), robot, data, **import_options),
        check_recordings(data),
        measure_error(data),
        identify(data, str(identified), **identify_options),
        measure_causes(data, robot_argument(identified)),
        export(str(identified), to),
        write_report(str(identified)),
    ]


# ---- each step; robots are as --robot takes them, others are paths; options by their names


def use_robot(robot: str) -> Step:
    """Return the step that checks a robot which exists."""
    return Step("robot", ("robot", "check", robot))


def make_robot(model: str, out: str, /, **options: Option) -> Step:
    """Return the step that makes a robot folder from a model file."""
    return Step("robot", ("robot", "new", model, "--out", out, *option_words(options)))


def import_logs(logs: str, robot: str, out: str, /, **options: Option) -> Step:
    """Return the step from logs to a dataset."""
    words = ("import", logs, "--robot", robot, *option_words(options), "--out", out)
    return Step("import", words)


def check_recordings(data: str, /, **options: Option) -> Step:
    """Return the step that looks for what is wrong with a dataset."""
    return Step("doctor", ("doctor", data, *option_words(options)))


def measure_error(data: str) -> Step:
    """Return the step that measures the error of the nominal simulator."""
    return Step("gap", ("gap", data))


def identify(data: str, out: str, /, **options: Option) -> Step:
    """Return the step from a dataset to an identified robot."""
    return Step("identify", ("identify", data, "--out", out, *option_words(options)))


def measure_causes(data: str, robot: str) -> Step:
    """Return the step that measures the error of an identified robot by its causes."""
    return Step("causes", ("gap", data, "--robot", robot))


def export(robot: str, to: str, /, **options: Option) -> Step:
    """Return the step that writes a robot or a network for another program."""
    return Step("export", ("export", robot, "--to", to, *option_words(options)))


def write_report(robot: str) -> Step:
    """Return the step that writes the report of an identified robot."""
    return Step("report", ("report", robot))


def draw_parameter_sets(robot: str, engine: str, out: str) -> Step:
    """Return the step that draws robots which the logs cannot tell from an identified one."""
    words = ("export", robot, "--to", "randomization", "--engine", engine, "--out", out)
    return Step("randomization", words)


def import_new_logs(logs: str, robot: str, out: str, /, **options: Option) -> Step:
    """Return the step from logs of another day or unit to a dataset."""
    return replace(import_logs(logs, robot, out, **options), name="new")


def check_robot(robot: str, data: str) -> Step:
    """Return the step that compares an identified robot with a new dataset."""
    return Step("check", ("check", robot, data))


def adapt(robot: str, data: str, out: str) -> Step:
    """Return the step that calibrates an identified robot with a new dataset."""
    return Step("adapt", ("adapt", robot, data, "--out", out))


def train(data: str, robot: str, out: str, /, **options: Option) -> Step:
    """Return the step that trains a network on top of an identified robot."""
    return Step("train", ("train", data, "--robot", robot, *option_words(options), "--out", out))


def option_words(options: Mapping[str, Option]) -> list[str]:
    """Return options as they are typed.

    Those that are None, False or () are left out. A text that begins with a dash stays a value.
    """
    words: list[str] = []
    for name, value in options.items():
        option = f"--{name.replace('_', '-')}"
        if value is None or value is False or value == ():
            continue
        if value is True:
            words.append(option)
        elif not isinstance(value, tuple):
            words += _option_with_value(option, str(value))
        elif name in REPEATED:
            for each in value:
                words += _option_with_value(option, each)
        else:
            words += [option, *value]
    return words


def _option_with_value(option: str, value: str) -> list[str]:
    if value.startswith("-"):  # in a word of its own, it would be read as another option
        return [f"{option}={value}"]
    return [option, value]
