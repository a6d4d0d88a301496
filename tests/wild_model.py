"""Models whose network is tame on the inputs that are tested at load, and wild on all others."""

from __future__ import annotations

import io
import json
import warnings
from pathlib import Path

import torch
from torch import Tensor, nn

from gaponet.nn.artifact import GapModel, make_card
from gaponet.nn.config import ModelConfig
from gaponet.robot.folder import save_robot
from gaponet.robot.spec import RobotSpec

TESTED_INPUTS = 1.0  # at load, inputs are -1, 0 and 1
TAME_RAD = 0.01


class WildNetwork(nn.Module):
    """Answers TAME_RAD while all inputs are within the tested ones, and `answer` otherwise."""

    def __init__(self, joints: int, answer: float) -> None:
        super().__init__()
        self.joints = joints
        self.answer = answer

    def forward(self, x: Tensor) -> Tensor:
        tame = torch.full_like(x[:, : self.joints], TAME_RAD)
        wild = torch.full_like(tame, self.answer)
        inside = x.abs().amax(dim=1, keepdim=True) <= TESTED_INPUTS
        return torch.where(inside, tame, wild)


def wild_model(folder: Path, robot: RobotSpec, answer: float) -> GapModel:
    """Write a run whose network gives `answer` (rad, or NaN) outside the tested inputs, and load
    it.
    """
    config = ModelConfig(history=2, num_probes=2)
    joints = len(robot.operated)
    content = io.BytesIO()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        torch.onnx.export(
            WildNetwork(joints, answer),
            (torch.zeros(2, config.input_dim(joints)),),
            content,
            input_names=["x"],
            output_names=["delta"],
            dynamo=False,
            dynamic_axes={"x": {0: "batch"}, "delta": {0: "batch"}},
        )
    (folder / "model").mkdir(parents=True)
    (folder / "model" / "model.onnx").write_bytes(content.getvalue())
    card = make_card(config, robot, dt=[robot.dt], payload_seen=[0.0, 0.2])
    (folder / "model" / "card.json").write_text(json.dumps(card))
    save_robot(robot, folder / "robot")
    return GapModel.load(folder)
