"""gaponet export."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Literal

from gaponet.cli.options import Json, Run
from gaponet.cli.out import Out
from gaponet.errors import UsageError

if TYPE_CHECKING:
    from gaponet.model.artifact import GapModel

INVERSE_SEED = 7  # of the motions it is fitted on; recipes have 0


def export(
    run: Run,
    to: Literal["onnx", "torch", "torchscript", "mjcf", "inverse"] = "onnx",
    out: Path | None = None,
    payload_mass: float = 0.0,
    json: Json = False,
) -> None:
    """Write a run's model for another program: ONNX and numpy, torch with the simulator's facts, MJCF, or inverted.

    Args:
        run: Run folder of gaponet train; for torchscript an artifact folder will do, for mjcf a robot folder.
        to: onnx: model.onnx, weights.npz and card.json. torch: delta.pt2 (torch.export) with the simulator beside it,
            facts.json and robot.xml, and gaponet_action.py, the action term for mjlab and Isaac Lab. torchscript:
            delta.pt, with history and limits inside, for older torch. mjcf: the simulator alone. inverse: a network
            fitted to the compensator's fixed point, beside the model; a minute or two.
        out: Folder for onnx, which gets the run's simulator too, for torch and mjcf (default RUN/torch, RUN/mjcf); file
            for torchscript. Default the run's model folder. Not for inverse.
        payload_mass: kg in each hand of the simulator that torch and mjcf write.
    """
    from gaponet.engine.folder import export_model
    from gaponet.engine.torchscript import FILE, export_torchscript
    from gaponet.model.artifact import GapModel

    screen = Out(json)
    if to == "mjcf":
        _mjcf(screen, run, out or run / to, payload_mass)
        return
    if to == "onnx":
        path = out or run / "model"
        difference = _onnx(run, path)
    else:
        model = GapModel.load(run)
        if to == "inverse":
            if out is not None:
                raise UsageError("--out: a compensator looks for the inverse beside its model; leave --out away")
            _inverse(screen, run, model)
            return
        path = out or (run / to if to == "torch" else model.path / FILE)
        written = export_model(model, run, path, payload_mass) if to == "torch" else None
        difference = export_torchscript(model, run, path) if written is None else written
    screen.say(f"{path}: differs by {difference:.1e} rad from what was trained")
    screen.result({"path": str(path), "to": to, "parity_rad": difference})


def _onnx(run: Path, path: Path) -> float:
    from gaponet.model.artifact import CARD, read_card
    from gaponet.model.export import drawn_states, trained_network
    from gaponet.model.export import export as write
    from gaponet.robot_folder import KEPT, keeps_robot, kept_robot, save_robot

    card, config = read_card(run / "model" / CARD)
    net = trained_network(run, config, len(card["joint_names"]))
    difference = write(net, path, card, drawn_states(net))
    if path != run / "model" and keeps_robot(run):
        save_robot(kept_robot(run, card["robot"]), path / KEPT)  # so that commands can be transferred
    return difference


def _mjcf(screen: Out, holder: Path, folder: Path, payload_mass: float) -> None:
    """The simulator of a run or an artifact, or a robot folder's own."""
    from gaponet.engine.folder import export_simulator
    from gaponet.robot import load_robot
    from gaponet.robot_folder import KEPT, keeps_robot

    robot = load_robot(holder / KEPT if keeps_robot(holder) else holder)
    export_simulator(robot, folder, payload_mass=payload_mass)
    lost = "; what servos do beyond PD is in no MJCF, but in facts.json" if robot.has_law else ""
    screen.say(f"{folder}: robot.xml and facts.json of {robot.name}{lost}")
    screen.result({"path": str(folder), "to": "mjcf", "robot": robot.name, "law_lost": robot.has_law})


def _inverse(screen: Out, run: Path, model: GapModel) -> None:
    from gaponet.deploy.compensator import INVERSE
    from gaponet.motion.library import Library
    from gaponet.robot_folder import kept_robot
    from gaponet.training.learned_inverse import learn_inverse

    robot = kept_robot(run, model.card["robot"])
    library = Library(robot, INVERSE_SEED, model.config.payload_max)
    motions = [library.make(name).sample(robot.dt) for name in library.names()[::2]]
    facts = learn_inverse(robot, model, motions)
    screen.say(
        f"{model.path / INVERSE}: misses {1e3 * facts['rms_missed']:.2f} of {1e3 * facts['rms_offset']:.2f} mrad (rms) "
        f"on motions held out of {len(motions)}"
    )
    screen.result({"path": str(model.path / INVERSE), "to": "inverse"} | facts)
