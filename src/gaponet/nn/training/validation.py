"""How far a network is from the recordings while it is trained, in whole free runs; and how much of it to apply.

A correction learnt from an hour of one robot is partly noise. Where little is left to correct, as after identification,
half of it can be better than all of it. One number for all joints: chosen joint by joint it fits the few validation
motions rather than the robot.
"""

from __future__ import annotations

import copy
from collections.abc import Callable
from collections.abc import Sequence as ListOf

import numpy as np

from gaponet.base.arrays import Array
from gaponet.data.sequence import Sequence
from gaponet.nn.config import ModelConfig
from gaponet.nn.layers import DeltaNet
from gaponet.nn.loop import DeltaCorrector
from gaponet.nn.onnx_export import onnx_content
from gaponet.nn.onnx_network import OnnxNetwork
from gaponet.robot.spec import RobotSpec
from gaponet.sim.metrics import standard_error
from gaponet.sim.replay import replay

GAINS = (0.75, 0.5, 0.25)  # beside 1


def errors(
    sequences: ListOf[Sequence], robot: RobotSpec, config: ModelConfig, net: DeltaNet | None, nthread: int
) -> Array:
    """MPJAE of each recording, (k,) rad; None for the simulator as it is."""
    op, corrector = robot.operated_index, None
    if net is not None:  # as it ships: onnxruntime takes half of torch's time here
        corrector = DeltaCorrector(OnnxNetwork(onnx_content(copy.deepcopy(net).cpu().eval())), config, robot)
    twins = replay(sequences, robot, corrector, nthread, lock_idle=True)
    return np.array([np.abs(t.qpos - s.qpos)[1:, op].mean() for s, t in zip(sequences, twins, strict=True)], float)


def added(sequences: ListOf[Sequence], before: Array, after: Array) -> tuple[float, float]:
    """How much less the error is after than before, (k,) rad each: mean and standard error over motions (paired)."""
    motions = np.array([s.meta.motion for s in sequences])
    less = np.array([(before - after)[motions == m].mean() for m in sorted(set(motions.tolist()))])
    return float(less.mean()), standard_error(less)


def choose_gain(net: DeltaNet, error: Callable[[], float], whole: float) -> float:
    """Set the gain with the least error, and return it; less of a correction is tried as long as it does better.

    Args:
        net: Its gain is changed in place.
        error: That of the network as it is when called.
        whole: The error with gain 1.
    """
    best = 1.0
    for gain in GAINS:
        net.bounded.gain.fill_(gain)
        if (found := error()) >= whole:
            break
        best, whole = gain, found
    net.bounded.gain.fill_(best)
    return best
