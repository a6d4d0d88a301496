"""A virtual two-joint arm with weak servos, and the operator that knows it, for tests of tracking and delivery."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np

from gaponet.experiments.result import Result
from gaponet.experiments.virtual.play import TrainedModel
from gaponet.nn.artifact import GapModel, make_card
from gaponet.nn.config import ModelConfig
from gaponet.robot.spec import RobotSpec
from gaponet.testing.physics import Physics, neutral

WEAK = 0.8  # of the gain: what such a servo does with u, the nominal one does with u + (0.8 − 1) (u − q)
CONFIG = ModelConfig(history=2, payload_max=0.4)


class Operator:
    """`share` of what the operator of that arm says, in the place of a network; 1 is exact."""

    def __init__(self, share: float) -> None:
        self.share = share

    def __call__(self, x: np.ndarray) -> np.ndarray:
        return (self.share * (WEAK - 1.0) * (x[:, -2:] - x[:, :2])).astype(np.float32)


def weak_unit() -> Physics:
    """Servos of 0.8 of their gain, nothing else."""
    return replace(neutral(2), kp_scale=np.full(2, WEAK))


def trained(robot: RobotSpec) -> list[TrainedModel]:
    """An operator that knows half (called mlp) and one that knows all."""
    make = lambda method, seed, share: TrainedModel(  # noqa: E731
        method,
        seed,
        Path("none"),
        GapModel(Path("exact"), make_card(CONFIG, robot, dt=[0.02]), CONFIG, Operator(share)),
        robot,
    )
    return [make("mlp", 0, 0.5), make("gaponet", 0, 1.0), make("gaponet", 1, 0.9)]


def session(robot: RobotSpec) -> Any:
    """In the place of a session: it hands back what it is given."""
    return SimpleNamespace(
        robot=robot, result=lambda name, heading, tables, figures, said, **told: Result(
            name, heading, "VIRTUAL arm.", told, tuple(tables), figures, tuple(said)
        ),
    )  # fmt: skip
