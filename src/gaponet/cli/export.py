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
    to: Literal["onnx", "torchscript", "inverse"] = "onnx",
    out: Path | None = None,
    json: Json = False,
) -> None:
    """Write a run's model again: as ONNX with the weights for numpy, as TorchScript, or inverted.

    Args:
        run: Run folder of gaponet train; for torchscript an artifact folder will do.
        to: onnx: model.onnx, weights.npz and card.json. torchscript: delta.pt, with history and limits inside.
            inverse: a network fitted to the compensator's fixed point, beside the model; a minute or two.
        out: Folder for onnx, which gets the run's simulator too; file for torchscript. Default the run's model folder.
            Not for inverse.
    """
    from gaponet.model.artifact import CARD, GapModel, read_card
    from gaponet.model.export import drawn_states, trained_network
    from gaponet.model.export import export as write
    from gaponet.model.torchscript import FILE, export_torchscript
    from gaponet.robot_folder import KEPT, keeps_robot, kept_robot, save_robot

    screen = Out(json)
    if to == "inverse":
        if out is not None:
            raise UsageError("--out: a compensator looks for the inverse beside its model; leave --out away")
        _inverse(screen, run, GapModel.load(run))
        return
    if to == "torchscript":
        model = GapModel.load(run)
        path = out or model.path / FILE
        difference = export_torchscript(model, run, path)
    else:
        path = out or run / "model"
        card, config = read_card(run / "model" / CARD)
        net = trained_network(run, config, len(card["joint_names"]))
        difference = write(net, path, card, drawn_states(net))
        if path != run / "model" and keeps_robot(run):
            save_robot(kept_robot(run, card["robot"]), path / KEPT)  # so that commands can be transferred
    screen.say(f"{path}: differs by {difference:.1e} rad from what was trained")
    screen.result({"path": str(path), "to": to, "parity_rad": difference})


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
