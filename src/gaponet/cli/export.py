"""gaponet export."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from shlex import quote
from typing import Annotated, Literal

import tyro

from gaponet import api
from gaponet.api.files import (
    LEROBOT_FPS,
    LEROBOT_TARGET,
    RANDOMIZATION_FILE,
    RANDOMIZATION_TARGET,
    NetworkTarget,
    RobotTarget,
    attach_correction,
    is_network_target,
    randomization_tables,
    require_network,
    require_out,
)
from gaponet.api.opening import as_run
from gaponet.api.results import ExportResult
from gaponet.base.errors import UsageError
from gaponet.base.progress import progress_bar
from gaponet.cli.options import Flag, Folder, Json
from gaponet.cli.out import Out
from gaponet.evaluation.tables import mrad

# Options, their fields, and whether a target uses them.
OPTIONS: tuple[tuple[str, tuple[str, ...], Callable[[str], bool]], ...] = (
    (
        "--engine, --scope, --units",
        ("engine", "scope", "units"),
        lambda to: to == RANDOMIZATION_TARGET,
    ),
    (
        "--payload-mass",
        ("payload_mass",),
        lambda to: to not in (RANDOMIZATION_TARGET, "onnx"),
    ),
    ("--out", ("out",), lambda to: to != LEROBOT_TARGET),
    (
        "--into and --prefix",
        ("into", "prefix"),
        lambda to: to in ("mjcf", "envhub", "urdf", LEROBOT_TARGET),
    ),
    ("--data", ("data",), lambda to: to not in ("onnx", "torch", LEROBOT_TARGET)),
    ("--dynamics, --remove, --fps", ("dynamics", "remove", "fps"), lambda to: to == LEROBOT_TARGET),
)
Holder = Annotated[
    Folder,
    tyro.conf.arg(
        help="Robot folder, run folder of gaponet train, or a name of the package (gaponet robot "
        "list, networks).",
        metavar="ROBOT|RUN|NAME",
    ),
]


@dataclass(frozen=True)
class ExportArgs:
    """What is exported and where to; each target uses some of the options."""

    to: RobotTarget | NetworkTarget | Literal["randomization", "lerobot"] = "onnx"
    """What is written. The simulator of a robot or a run: mjcf (plain MuJoCo), envhub (an
    environment of LeRobot's EnvHub in MuJoCo), mjlab, isaaclab or newton, each with a check.py that
    needs no gaponet; urdf (damping, friction, effort limits); json (the numbers). The network of
    a run: onnx (model.onnx and card.json), torch (delta.pt2 with simulator and action term for
    mjlab and Isaac Lab), actuator-net (one network per joint; its inputs are past target − position
    and speed, its output is the torque). randomization: sets of a robot's parameters, called units,
    for training. lerobot: add the correction to the LeRobot policy in --into; LeRobot finds it
    through the plug-in lerobot_robot_gaponet."""
    out: Path | None = None
    """Folder to write. Default: a folder in the robot or run that has the name of the target."""
    data: str | None = None
    """Dataset with which an export is measured, and to which plain servos are fitted if the engine
    cannot play the servo model. Default: the dataset of the identification, or else simulated
    motions of the robot."""
    into: Path | None = None
    """For mjcf, envhub and urdf: file of your own, of which an edited copy is written; urdf needs
    it, the others take the robot's file by default. For lerobot: folder of a policy
    (pretrained_model) that holds policy_postprocessor.json."""
    prefix: str = ""
    """Prefix that joint names have in the file of --into."""
    payload_mass: float = 0.0
    """Payload in each hand, kg."""
    engine: Literal["json", "mujoco", "mjlab", "isaaclab"] = "json"
    """For randomization: engine for which a file is written that applies units of
    randomization.json."""
    scope: Literal["today", "any-day", "any-robot"] = "today"
    """For randomization, what the units stand for. today: this robot as last fitted. any-day: this
    robot over days. any-robot: robots of its type."""
    units: tuple[Path, ...] = ()
    """For --scope any-robot: robot folders of several robots of the type."""
    dynamics: Flag = False
    """For lerobot: feed forward inertia and damping too; use it for smooth targets only."""
    remove: Flag = False
    """For lerobot: remove the correction."""
    fps: float = LEROBOT_FPS
    """For lerobot: control rate of the policy, Hz. The default is LeRobot's."""

    def require_used(self) -> None:
        """Refuse options that the target does not use.

        Raises:
            UsageError: One is given.
        """
        for words, names, uses in OPTIONS:
            given = any(getattr(self, name) != getattr(ExportArgs, name) for name in names)
            if given and not uses(self.to):
                raise UsageError(f"--to {self.to} does not use {words}; leave out what you gave")


def export(
    robot: Holder,
    args: Annotated[ExportArgs, tyro.conf.arg(name="")] = ExportArgs(),
    json: Json = False,
) -> None:
    """Write an identified robot or a network for another program.

    Args:
        args: What is exported and where to.
    """
    screen = Out(json)
    holder = as_run(robot)
    args.require_used()
    if args.to == RANDOMIZATION_TARGET:
        _export_ranges(screen, holder, args)
    elif args.to == LEROBOT_TARGET:
        _attach(screen, holder, args)
    elif is_network_target(args.to):
        require_network(holder)
        made = api.export_network(
            holder, to=args.to, out=args.out, data=args.data, payload_mass=args.payload_mass
        )
        _show(screen, made)
    else:
        with progress_bar("exporting") as update:
            made = api.export_robot(
                holder,
                to=args.to,
                out=args.out,
                data=args.data,
                into=args.into,
                prefix=args.prefix,
                payload_mass=args.payload_mass,
                progress=update,
            )
        _show(screen, made)


def _show(screen: Out, made: ExportResult) -> None:
    """Print what was written, its errors, and what it leaves out."""
    if made.parity is not None:
        screen.say(f"{made.path}: differs by {made.parity:.1e} rad from what was trained")
        screen.result(made.to_dict())
        return
    kind = "VIRTUAL" if made.virtual else "validation"
    plural = "" if made.motions == 1 else "s"
    rows = [[form, mrad(error)] for form, error in made.errors.items()]
    title = f"Mean |error| on {made.motions} {kind} motion{plural}"
    screen.table(title, ["form", "mrad"], rows)
    if made.own_motions:
        screen.say(
            "  These motions are simulated, over most of each joint's range; recorded ones may "
            "lose less. --data DATASET takes recorded ones."
        )
    for line in made.notes:
        screen.say(f"  {line}", "warning", "yellow")
    screen.say(f"{made.path}: {made.robot} for {made.to}")
    if made.check:
        screen.next(f"python {quote(str(made.check))}  # in {made.checked_in}")
    screen.result(made.to_dict())


def _export_ranges(screen: Out, robot: Path, args: ExportArgs) -> None:
    """Write and show sampled units and ranges of a robot's parameters."""
    require_out(robot, args.out)
    with progress_bar("drawing") as update:
        file, made = api.randomization(
            robot,
            out=args.out or robot / RANDOMIZATION_TARGET,
            engine=args.engine,
            scope=args.scope,
            units=args.units,
            data=args.data,
            progress=update,
        )
    for table in randomization_tables(made, args.scope):
        screen.show(table.name, table)
    for note in made.notes:
        screen.say(f"  {note}", "note", "cyan")
    if made.unknown:
        names = "; ".join(made.unknown)
        text = f"  no log determines these, drawn from the prior range: {names}"
        screen.say(text, "warning", "yellow")
    count = len(next(iter(made.units.values())))
    use = "" if args.engine == "json" else f"; {file.name} applies them in {args.engine}"
    screen.say(f"{file.parent / RANDOMIZATION_FILE}: {count} units{use}")
    ranges = {"ranges": made.ranges, "unknown": made.unknown}
    screen.result({"path": str(file), "scope": args.scope, **ranges})


def _attach(screen: Out, holder: Path, args: ExportArgs) -> None:
    """Put the correction of a robot or a run behind a LeRobot policy, or remove it."""
    if args.into is None:
        raise UsageError("--to lerobot: give the folder of a LeRobot policy with --into POLICY")
    made = attach_correction(
        args.into,
        None if args.remove else holder,
        payload_mass=args.payload_mass,
        dynamics=args.dynamics,
        fps=args.fps,
    )
    screen.say(f"{made.file}: {' → '.join(made.steps) or 'no steps'}")
    screen.result(made.to_dict())
