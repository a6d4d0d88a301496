"""gaponet export."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

import tyro

from gaponet.cli.out import Out


def export(
    run: tyro.conf.Positional[Path],
    to: Literal["onnx", "torchscript"] = "onnx",
    out: Path | None = None,
    json: tyro.conf.FlagCreatePairsOff[bool] = False,
) -> None:
    """Write a run's model again (onnx, with the weights for numpy), or as TorchScript for simulators in torch.

    Args:
        run: Run folder of gaponet train; for torchscript an artifact folder will do.
        to: onnx: model.onnx, weights.npz and card.json. torchscript: delta.pt, with history and limits inside.
        out: Folder for onnx, file for torchscript; default the run's model folder.
        json: One JSON object on stdout.
    """
    from gaponet.model.artifact import GapModel
    from gaponet.model.export import drawn_states, trained_network
    from gaponet.model.export import export as write
    from gaponet.model.torchscript import FILE, export_torchscript

    screen, model = Out(json), GapModel.load(run)
    if to == "torchscript":
        path = out or model.path / FILE
        difference = export_torchscript(model, run, path)
    else:
        path = out or model.path
        net = trained_network(run, model.config, len(model.card["joint_names"]))
        difference = write(net, path, model.card, drawn_states(net))
    screen.say(f"{path}: differs by {difference:.1e} rad from what was trained")
    screen.result({"path": str(path), "to": to, "parity_rad": difference})
