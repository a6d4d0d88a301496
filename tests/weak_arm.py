"""A virtual two-joint arm with weak servos, and the operator that knows it."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from gaponet.nn.artifact import GapModel, make_card
from gaponet.nn.config import ModelConfig
from gaponet.robot.spec import RobotSpec
from gaponet.virtual.physics import Physics, neutral

# of the gain: what such a servo does with u, the nominal one does with u + (0.8 − 1) (u − q)
WEAK = 0.8
CONFIG = ModelConfig(history=2, payload_max=0.4)


class Operator:
    """`share` of what the operator of that arm says, in the place of a network; 1 is exact, 0 is
    untrained.
    """

    def __init__(self, share: float) -> None:
        self.share = share

    def __call__(self, x: np.ndarray) -> np.ndarray:
        return (self.share * (WEAK - 1.0) * (x[:, -2:] - x[:, :2])).astype(np.float32)


def weak_unit() -> Physics:
    """Servos of 0.8 of their gain, nothing else."""
    return replace(neutral(2), kp_scale=np.full(2, WEAK))


def model(robot: RobotSpec, share: float, dt: float = 0.02) -> GapModel:
    """An operator that knows a share of the truth, as a model of the nominal arm."""
    card = make_card(CONFIG, robot, dt=[dt])
    return GapModel(Path("exact"), card, CONFIG, Operator(share))
