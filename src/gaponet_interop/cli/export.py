"""gaponet export."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import tyro

from gaponet.cli.options import Folder, Json
from gaponet.cli.out import Out
from gaponet.errors import UsageError
from gaponet.robot import load_robot
from gaponet.robot_folder import KEPT, keeps_robot

if TYPE_CHECKING:
    from gaponet_interop.engine.ranges import Engine, Scope

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
            run: onnx (model.onnx, weights.npz and card.json) and torch (delta.pt2 with simulator and action term for
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
    if to == "actuator-net":
        _actuator_net(screen, robot, out or robot / to, data, payload_mass)
        return
    if to in ("onnx", "torch"):
        if data or into or prefix:
            raise UsageError(f"--data, --into and --prefix are of robots; --to {to} writes a run's network")
        _network(screen, robot, to, out, payload_mass)
        return
    from gaponet.eval.tables import mrad
    from gaponet.progress import bar
    from gaponet_interop.engine.folder import export_robot
    from gaponet_interop.engine.forms import recordings_of

    spec, folder = load_robot(_simulator(robot)), out or robot / to
    recordings = recordings_of(_simulator(robot), data, spec)
    with bar("fitting without the law") as update:
        made = export_robot(spec, to, folder, recordings, into, prefix, payload_mass, update)
    of = "of the robot's own answers, VIRTUAL" if made.virtual else "validation motions"
    rows = [[what, mrad(error)] for what, error in made.left.items()]
    screen.table(f"What is left of {made.motions} {of}", ["form", "mrad"], rows)
    for line in made.notes:
        screen.say(f"  {line}", "warning", "yellow")
    check = folder / "check.py"
    told = f"; next, in {'MuJoCo' if to == 'mjcf' else to}: python {check}" if check.is_file() else ""
    screen.say(f"{made.file or folder}: {spec.name} for {to}{told}")
    screen.result({"path": str(folder), "to": to, "robot": spec.name, "left": made.left, "notes": made.notes})


def _randomization(
    screen: Out, robot: Path, out: Path | None, engine: Engine, scope: Scope, units: tuple[Path, ...]
) -> None:
    from gaponet.cli.identify import COLUMNS
    from gaponet_interop.engine.ranges import as_rows, ranges, write_ranges

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


def _actuator_net(screen: Out, run: Path, folder: Path, data: str | None, payload_mass: float) -> None:
    from gaponet.eval.tables import mrad
    from gaponet.model.artifact import GapModel
    from gaponet_interop.engine.actuator_net import export_actuator_net

    made = export_actuator_net(GapModel.load(run), run, folder, data, payload_mass)
    rows = [[what, mrad(error)] for what, error in made.left.items()]
    screen.table(f"What is left of {made.motions} validation motions", ["form", "mrad"], rows)
    if not made.gain:
        screen.say("  what the run adds goes by posture or payload, which engines do not tell a joint's network: these "
                   "are the servos alone; --to torch has all of the run", "warning", "yellow")  # fmt: skip
    screen.say(f"{folder}: JOINT.onnx, .pt2 and .pt of every joint; next, in mjlab: python {folder / 'check.py'}")
    screen.result({"path": str(folder), "to": "actuator-net", "left": made.left, "gain": made.gain})


def _simulator(holder: Path) -> Path:
    """The robot folder of a run or an artifact, or the folder itself."""
    return holder / KEPT if keeps_robot(holder) else holder


def _network(screen: Out, run: Path, to: str, out: Path | None, payload_mass: float) -> None:
    from gaponet.model.artifact import CARD, GapModel

    if (run / "robot.toml").is_file():
        raise UsageError(f"{run}: is a robot, which has no network; --to mjcf, mjlab, isaaclab, newton, drake or json")
    if to == "torch":
        from gaponet_interop.engine.folder import export_model

        path = out or run / to
        difference = export_model(GapModel.load(run), run, path, payload_mass)
    else:
        from gaponet.model.export import drawn_states, trained_network
        from gaponet.model.export import export as write
        from gaponet.robot_folder import kept_robot, save_robot

        path = out or run / "model"
        card, config = GapModel.read_card(run / "model" / CARD)
        net = trained_network(run, config, len(card["joint_names"]))
        difference = write(net, path, card, drawn_states(net))
        if path != run / "model" and keeps_robot(run):
            save_robot(kept_robot(run, card["robot"]), path / KEPT)  # so that commands can be transferred
    screen.say(f"{path}: differs by {difference:.1e} rad from what was trained")
    screen.result({"path": str(path), "to": to, "parity_rad": difference})
