"""`gaponet run`: play a motion, or live targets, on a robot, real or virtual, with or without a
model.
"""

from __future__ import annotations

import sys
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated

import tyro

from gaponet.api.run_options import Connection, ControlConfig, ControlOptions, RunOptions
from gaponet.api.run_report import Event, PlanText, event_text
from gaponet.api.run_robot import VIRTUAL, known_drivers, run_robot
from gaponet.cli.options import Json
from gaponet.cli.out import Out, holds_folder

if TYPE_CHECKING:
    from gaponet.api.results import RunResult

DRIVERS = known_drivers()
DriverName = Annotated[
    str,
    tyro.constructors.PrimitiveConstructorSpec(
        nargs=1,
        metavar=f"{{{','.join(DRIVERS)}}}",
        choices=DRIVERS,
        instance_from_str=lambda words: words[0],
        is_instance=lambda value: isinstance(value, str),
        str_from_instance=lambda name: [name],
    ),
]
SUMMARY_COLUMNS = ["what", "value"]
DRY_RUN_COLUMNS = ["joint", "from, rad", "to, rad", "fastest, rad/s", "torque asked, N·m"]


@dataclass(frozen=True)
class ControlArgs(ControlOptions):
    """Options about robot and control loop. The docstrings are the command-line help."""

    driver: DriverName = VIRTUAL
    """Connection to the robot: virtual (a simulated robot in this process), unitree (DDS: a real
    H1-2 or gaponet virtual serve), so101 (serial), or the driver of an installed extension. An
    option whose help begins with such a name is of that driver alone."""
    robot: str | None = None
    """Robot name or folder; it may be identified. Default: the robot of --model; without it, so101
    for driver so101, the robot of --limits-from for the driver of an extension, and h1_2 for the
    others."""
    connection: tyro.conf.OmitArgPrefixes[Connection] = Connection()  # noqa: RUF009
    """Connection to the robot."""
    control: tyro.conf.OmitArgPrefixes[ControlConfig] = ControlConfig()  # noqa: RUF009
    """Timing."""


@dataclass(frozen=True)
class RunArgs(ControlArgs, RunOptions):
    """Options of a run: those of ControlArgs, compensation and live targets."""

    compensate: bool = False
    """Correct the commands so that the robot follows the motion, with a feed-forward of the model
    in --robot, which should be identified. Velocity and acceleration of a motion are fed forward;
    those of live targets only with --compensation.dynamics."""


def run(
    motion: str | None = None,
    args: Annotated[RunArgs, tyro.conf.arg(name=""), tyro.conf.FlagCreatePairsOff] = RunArgs(),
    json: Json = False,
) -> None:
    """Play a motion or live targets on a robot; any key stops it.

    Ctrl-C, Ctrl-Z and SIGTERM also stop it, within one control period. A real robot moves only
    after you typed yes, unless --yes skips this question.

    Args:
        motion: Name of a motion of the library, or motion file (.txt, .csv, .npz). Needed unless
            --targets is given.
        args: Robot, control loop and model.
    """
    screen = Out(json)
    with holds_folder(args.out, "recordings"):
        result = run_robot(
            args.robot,
            motion=motion,
            driver=args.driver,
            compensate=args.compensate,
            options=args,
            report=ScreenReporter(screen),
        )
    show_result(screen, result)
    if result.file is not None:
        screen.say(f"written: {result.file.with_suffix('.*')}")
    screen.result(result.to_dict())
    if result.fault or (args.out and result.recording.rows.error):
        sys.exit(3)


class ScreenReporter:
    """Shows a run on the screen, with tables and colours."""

    def __init__(self, screen: Out) -> None:
        self.screen = screen

    def plan(self, text: PlanText) -> None:
        self.screen.table(text.title, list(text.columns), [list(row) for row in text.rows])
        for sentence in text.sentences:
            self.screen.say(f"  {sentence}")

    def note(self, text: str) -> None:
        self.screen.say(text)

    def event(self, event: Event) -> None:
        colour = "cyan" if event.kind in ("", "end") else "bold red"
        self.screen.say(f"  {event_text(event)}", f"{event.phase:>9}", colour)


def show_result(screen: Out, result: RunResult) -> None:
    """Print timing and tracking error, or the commands of a dry run."""
    if result.recording.meta.get("would_send") is not None:
        show_dry_run(screen, result)
    else:
        show_summary(screen, result)


def show_summary(screen: Out, result: RunResult) -> None:
    """Print timing and tracking error."""
    recording = result.recording
    facts = recording.summary()
    error = result.mean_tracking_error
    label = "VIRTUAL " if recording.virtual else ""
    title = f"{label}{recording.robot} at {facts['rate_hz']:g} Hz"
    rows = [
        ["periods, of which never started", f"{facts['periods']}, {recording.missed}"],
        ["late, ms: p50, p99, max", _quantiles(facts["late_ms"])],
        ["age of state, ms: p50, p99, max", _quantiles(facts["state_age_ms"])],
        ["tracking error, mrad", "–" if error is None else f"{1e3 * error:.2f}"],
    ]
    screen.table(title, SUMMARY_COLUMNS, rows)


def show_dry_run(screen: Out, result: RunResult) -> None:
    """Print what a dry run would have sent."""
    rows = []
    for joint, values in result.would_send.items():
        rows.append([joint, *(f"{value:.3f}" for value in values.values())])
    title = (
        "Dry run: nothing was sent. These commands would have been, to a robot that follows at once"
    )
    screen.table(title, DRY_RUN_COLUMNS, rows)


def _quantiles(values: dict[str, float]) -> str:
    """Return three quantiles of a time as text."""
    return ", ".join(f"{values[name]:.2f}" for name in ("p50", "p99", "max"))
