"""A recording and its simulated replay, row by row."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from gaponet.base.arrays import Array
from gaponet.base.errors import DatasetError
from gaponet.data.sequence import Sequence


@dataclass(frozen=True)
class SimulatedReplay:
    """Motion of a simulator under the recorded commands, from the recorded start state.

    Attributes:
        model_hash: Hash of the simulator (sim.model.model_hash).
        qpos, qvel, tau: (T, n) rad, rad/s, N·m; row t is the state at t·dt, tau the actuator torque
            at the end of [t-1, t).
        ctrl: (T, n) rad, targets applied over [t, t+1) if a corrector changed them; not stored.
    """

    model_hash: str
    qpos: Array
    qvel: Array
    tau: Array
    ctrl: Array | None = None


@dataclass(frozen=True)
class Pair:
    """A recording `real` and its replay `sim`, with equal commands, period and joints."""

    real: Sequence
    sim: SimulatedReplay

    def __post_init__(self) -> None:
        if self.sim.qpos.shape != self.real.qpos.shape:
            raise DatasetError(
                f"replay of '{self.real.meta.motion}' has shape {self.sim.qpos.shape}, recording "
                f"{self.real.qpos.shape}; run gaponet gap again"
            )

    @property
    def gap(self) -> Array:
        """real.qpos − sim.qpos, (T, n), rad."""
        return np.asarray(self.real.qpos - self.sim.qpos)
