"""gaponet export."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import tyro

from gaponet.base.errors import UsageError
from gaponet.cli.options import Folder, Json
from gaponet.cli.out import Out
from gaponet.robot.folder import STORED_ROBOT, has_stored_robot
from gaponet.robot.spec import load_robot

if TYPE_CHECKING:
    from gaponet.export.folder import Exported
    from gaponet.export.ranges import Engine, Scope

NETWORKS = ("onnx", "torch", "actuator-net")
CHECKED_IN = {"mjcf": "MuJoCo", "actuator-net": "mjlab"}
Holder = Annotated[Folder, tyro.conf.arg(help="Robot folder, or run folder of gaponet train.", metavar="ROBOT|RUN")]


def export(
    robot: Holder,
    to: Literal[
        "onnx", "torch", "mjcf", "urdf", "mjlab", "isaaclab", "newton", "drake", "json", "randomization", "actuator-net"
    ] = "onnx",
    out: Path | None = None,
    data: str | None = None,
    into: Path | None = None,
    prefix: str = "",
    payload_mass: float = 0.0,
    engine: Literal["json", "mujoco", "mjlab", "isaaclab"] = "json",
    scope: Literal["today", "any-day", "any-robot"] = "today",
    units: tuple[Path, ...] = (),
    json: Json = False,
) -> None:
    """Write an identified robot or a network for another program.

    Args:
        to: For a robot or a run's simulator: mjcf (plain MuJoCo), mjlab, isaaclab, newton and drake, each with a
            check.py that needs no gaponet; urdf (or SDF: damping, friction, effort limits); json (the numbers). Of a
            run: onnx (model.onnx and card.json) and torch (delta.pt2 with simulator and action term for
            mjlab and Isaac Lab), actuator-net (of each joint a network, past of target − position and speed in, torque
            out: the form of mjlab, Newton and Isaac Lab). Of a robot, randomization: what to randomise in training.
        out: Folder; default one with that name in the robot or run, for onnx the run's model folder.
        data: Dataset on which a servo law's nearest plain servos are fitted, and every form is judged; default the one
            that the robot was identified from, and without any what the robot itself answers.
        into: For mjcf and urdf: a file of your own; a copy of it is edited in place of names (mjcf: default the
            robot's).
        prefix: What that file has before each joint's name.
        payload_mass: kg in each hand.
        engine: The engine in whose words the ranges are written, beside units drawn whole (randomization.json).
        scope: today: this robot as it was last fitted. any-day: as sessions on several days found it. any-robot: as
            robots of its type differ.
        units: For any-robot: robot folders of the type.
    """
    screen = Out(json)
    if to == "randomization":
        _randomization(screen, robot, out, engine, scope, units)
        return
    if to in NETWORKS and (robot / "robot.toml").is_file():
        raise UsageError(
            f"{robot}: is a robot, which has no network; --to mjcf, mjlab, isaaclab, newton, drake or json"
        )
    if to in NETWORKS and (into or prefix or (data and to != "actuator-net")):
        raise UsageError(f"--data, --into and --prefix are of robots; --to {to} writes a run's network")
    if to in ("onnx", "torch"):
        _network(screen, robot, to, out, payload_mass)
        return
    from gaponet.report.tables import mrad

    folder = out or robot / to
    made = _made(robot, to, folder, data, into, prefix, payload_mass)
    of = "VIRTUAL motions" if made.virtual else "validation motions"
    rows = [[what, mrad(error)] for what, error in made.left.items()]
    screen.table(f"What is left of {made.motions} {of}", ["form", "mrad"], rows)
    for line in made.notes:
        screen.say(f"  {line}", "warning", "yellow")
    check, name = folder / "check.py", load_robot(_simulator(robot)).name
    told = f"; next, in {CHECKED_IN.get(to, to)}: python {check}" if check.is_file() else ""
    screen.say(f"{made.file or folder}: {name} for {to}{told}")
    screen.result({"path": str(folder), "to": to, "robot": name, "left": made.left, "notes": made.notes})


def _made(
    robot: Path, to: str, folder: Path, data: str | None, into: Path | None, prefix: str, payload_mass: float
) -> Exported:
    from gaponet.base.progress import progress_bar
    from gaponet.export.folder import export_networks, export_robot
    from gaponet.export.forms import recordings_of
    from gaponet.nn.artifact import GapModel

    if to == "actuator-net":
        return export_networks(GapModel.load(robot), robot, folder, data, payload_mass)
    spec = load_robot(_simulator(robot))
    recordings = recordings_of(_simulator(robot), data, spec)
    with progress_bar("fitting without the law") as update:
        return export_robot(spec, to, folder, recordings, into, prefix, payload_mass, update)


def _randomization(
    screen: Out, robot: Path, out: Path | None, engine: Engine, scope: Scope, units: tuple[Path, ...]
) -> None:
    from gaponet.cli.identify import COLUMNS
    from gaponet.export.ranges import as_rows, ranges, write_ranges

    made = ranges(_simulator(robot), scope, units)
    file = write_ranges(made, engine, out or robot / "randomization")
    screen.table(f"{made.robot}, {scope}: 9 of 10 units lie within", *as_rows(made, COLUMNS))
    for note in made.notes:
        screen.say(f"  {note}", "note", "cyan")
    if made.unknown:
        told = "; ".join(made.unknown)
        screen.say(f"  no log determines these, drawn as wide as believed before: {told}", "warning", "yellow")
    screen.say(f"{file}: {len(next(iter(made.units.values())))} units in {file.parent / 'randomization.json'}")
    screen.result({"path": str(file), "scope": scope, "ranges": made.ranges, "unknown": made.unknown})


def _simulator(holder: Path) -> Path:
    """The robot folder of a run or an artifact, or the folder itself."""
    return holder / STORED_ROBOT if has_stored_robot(holder) else holder


def _network(screen: Out, run: Path, to: str, out: Path | None, payload_mass: float) -> None:
    from gaponet.nn.artifact import CARD, GapModel

    if to == "torch":
        from gaponet.export.folder import export_model

        path = out or run / to
        difference = export_model(GapModel.load(run), run, path, payload_mass)
    else:
        from gaponet.nn.onnx_export import drawn_states, trained_network
        from gaponet.nn.onnx_export import export as write
        from gaponet.robot.folder import load_stored_robot, save_robot

        path = out or run / "model"
        card, config = GapModel.read_card(run / "model" / CARD)
        net = trained_network(run, config, len(card["joint_names"]))
        difference = write(net, path, card, drawn_states(net))
        if path != run / "model" and has_stored_robot(run):
            save_robot(
                load_stored_robot(run, card["robot"]), path / STORED_ROBOT
            )  # so that commands can be transferred
    screen.say(f"{path}: differs by {difference:.1e} rad from what was trained")
    screen.result({"path": str(path), "to": to, "parity_rad": difference})
