"""Validation error of networks during training, and the choice of the correction gain.

A correction that was learned from an hour of recordings is partly noise. If the simulator is
already close to the robot, for example after identification, half of the correction can have a
smaller error than all of it. All joints share one gain: gains per joint would fit the few
validation motions rather than the robot.
"""

from __future__ import annotations

import copy
import hashlib
from collections.abc import Callable
from collections.abc import Sequence as ListOf

from gaponet.base.arrays import Array
from gaponet.data.sequence import Sequence
from gaponet.nn.config import ModelConfig
from gaponet.nn.layers import DeltaNet
from gaponet.nn.loop import DeltaCorrector
from gaponet.nn.onnx_export import onnx_content
from gaponet.nn.onnx_network import OnnxNetwork
from gaponet.robot.spec import RobotSpec
from gaponet.sim.metrics import mean_reduction
from gaponet.sim.replay import rollout_errors

GAINS = (0.75, 0.5, 0.25)  # candidates below 1


class Validator:
    """Rollout errors of networks on the validation recordings. Each network is simulated once."""

    def __init__(
        self, sequences: ListOf[Sequence], robot: RobotSpec, config: ModelConfig, nthread: int
    ) -> None:
        """robot: The simulator that the network corrects."""
        self.sequences = sequences
        self.robot = robot
        self.config = config
        self.nthread = nthread
        self._cache: dict[bytes, Array] = {}

    def errors(self, net: DeltaNet | None, robot: RobotSpec | None = None) -> Array:
        """Return the mean position error of a rollout of each recording over the joints that it
        holds, (k,) rad.

        Args:
            net: The network; None for the simulator without correction.
            robot: Simulator instead of the one that the network corrects.
        """
        key = self._key(net, robot)
        if key not in self._cache:
            self._cache[key] = self._rollout_errors(net, robot)
        return self._cache[key]

    def improvement(self, net: DeltaNet) -> tuple[float, float]:
        """Return the error reduction by a network, rad: mean and standard error over independent
        motions.
        """
        return mean_reduction((s.meta for s in self.sequences), self.errors(None), self.errors(net))

    @staticmethod
    def _key(net: DeltaNet | None, robot: RobotSpec | None = None) -> bytes:
        key = hashlib.sha256(repr(robot).encode())
        if net is not None:
            for weights in net.state_dict().values():
                key.update(weights.cpu().numpy().tobytes())
        return key.digest()

    def _rollout_errors(self, net: DeltaNet | None, robot: RobotSpec | None) -> Array:
        robot = robot or self.robot
        corrector = None
        if net is not None:  # on onnxruntime, as it ships; torch needs twice the time
            network = OnnxNetwork(onnx_content(copy.deepcopy(net).cpu().eval()))
            corrector = DeltaCorrector(network, self.config, robot)
        return rollout_errors(self.sequences, robot, self.nthread, corrector)


def choose_gain(net: DeltaNet, error: Callable[[], float], full_error: float) -> float:
    """Set the gain with the least validation error and return it.

    The search stops when a smaller gain is worse.

    Args:
        net: The network; its gain is changed in place.
        error: Returns the validation error of the network as it is now.
        full_error: Validation error with gain 1.
    """
    best_gain = 1.0
    best_error = full_error
    for gain in GAINS:
        net.bounded.gain.fill_(gain)
        candidate = error()
        if candidate >= best_error:
            break
        best_gain = gain
        best_error = candidate
    net.bounded.gain.fill_(best_gain)
    return best_gain
