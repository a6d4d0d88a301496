"""What a model is, as data: the fields shape the network, the docstrings under them are the command-line help."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from gaponet.errors import UsageError


@dataclass(frozen=True)
class ModelConfig:
    """Shape of a delta-action model; every dimension is derived from it and the number of operated joints n."""

    kind: Literal["gaponet", "mlp"] = "gaponet"
    """gaponet: the operator. mlp: a plain network on [observation, action], the ASAP form."""
    history: int = 4
    """H, past frames in the observation. A history shorter than the robot's lag cannot see it."""
    stride: int = 1
    """Control periods between past frames."""
    payload_input: bool = True
    """Whether the payload mass is observed."""
    payload_max: float = 3.0
    """Mass that counts as 1 at the input, kg."""
    delta_max: float = 0.3
    """Largest correction, rad."""
    num_probes: int = 20
    """m, how many targets the simulator is asked about."""
    probe_small: float = 0.05
    """Probe that reads gains and friction, rad."""
    probe_large: float = 0.4
    """Probe that reads inertia, payload and saturation, rad."""
    sensors: Literal["predicted", "off"] = "predicted"
    """predicted: the sensor predictor stands in for the simulator's probes. off: the branch sees o_t only."""
    branch_history: bool = True
    """Whether the branch also sees the observation. Probe responses depend on the state alone, so without it no delay
    can be corrected (docs/log.md)."""
    coupling: Literal["joint", "full"] = "joint"
    """joint: branch and trunk are shared by the joints and take one joint at a time; postures never recorded do not
    lead them astray (docs/log.md). full: the paper's, every joint sees every joint. The mlp is always full."""
    num_basis: int = 16
    """p, basis functions per joint."""
    branch_hidden: tuple[int, ...] = (128, 128)
    """Hidden layers of the branch net; the paper's full coupling has 256 256 256."""
    trunk_hidden: tuple[int, ...] = (64, 64)
    """Hidden layers of the trunk net; the paper's full coupling has 128 128 128."""
    sensor_hidden: tuple[int, ...] = (256, 256)
    """Hidden layers of the sensor predictor."""
    mlp_hidden: tuple[int, ...] = (512, 256, 128)
    """Hidden layers of the MLP baseline (ASAP's size)."""

    def __post_init__(self) -> None:
        for field in ("history", "stride", "num_probes", "num_basis", "delta_max", "payload_max"):
            if getattr(self, field) <= 0:
                raise UsageError(f"{field} is {getattr(self, field)}; it must be positive")

    @property
    def joint_wise(self) -> bool:
        """Whether one joint at a time passes through branch and trunk."""
        return self.kind == "gaponet" and self.coupling == "joint"

    def observation_dim(self, n: int) -> int:
        """2n + 3nH (+ 1 with payload)."""
        return 2 * n + 3 * n * self.history + int(self.payload_input)

    def sensor_dim(self, n: int) -> int:
        """m probes, each answered by n positions and n velocities."""
        return self.num_probes * 2 * n
