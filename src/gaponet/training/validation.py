"""How far a network is from the recordings while it is trained: whole motions, free run."""

from __future__ import annotations

from collections.abc import Sequence as ListOf

import numpy as np

from gaponet.data.sequence import Sequence
from gaponet.model.backends import FunctionNetwork
from gaponet.model.config import ModelConfig
from gaponet.model.corrector import DeltaCorrector
from gaponet.model.layers import DeltaNet
from gaponet.robot import RobotSpec
from gaponet.sim.replay import replay
from gaponet.training.sensor_fit import torch_infer


def mean_error(
    sequences: ListOf[Sequence], robot: RobotSpec, config: ModelConfig, net: DeltaNet | None, nthread: int
) -> float:
    """MPJAE over the motions, rad; None for the simulator as it is."""
    n, op = len(robot.operated), robot.operated_index
    corrector = None
    if net is not None:
        corrector = DeltaCorrector(FunctionNetwork(torch_infer(net), config.input_dim(n), n), config, robot)
    twins = replay(sequences, robot, corrector, nthread, lock_idle=True)
    return float(np.mean([np.abs(t.qpos - s.qpos)[1:, op].mean() for s, t in zip(sequences, twins, strict=True)]))
