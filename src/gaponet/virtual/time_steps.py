"""Time steps of a virtual robot: control period, effect period and physics step."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from gaponet.virtual.physics import Physics

MAX_PHYSICS_STEP_S = 0.001
# Of the hidden effects. Bristles and current loops are evaluated at every physics step.
MAX_EFFECT_PERIOD_S = 0.002


@dataclass(frozen=True)
class TimeSteps:
    """Control period ≥ effect period ≥ physics step; each is a multiple of the next.

    Attributes:
        control: Control period, s.
        physics: Physics step, s.
        physics_per_effect: Physics steps in an effect period.
        effects_per_control: Effect periods in a control period.
    """

    control: float
    physics: float
    physics_per_effect: int
    effects_per_control: int

    @classmethod
    def choose(cls, physics: Physics, dt: float, timestep: float | None) -> TimeSteps:
        """Choose the steps for a control period dt, s.

        timestep: Physics step, s; None for the largest one up to 1 ms that divides dt.
        """
        if timestep is None:
            decimation = int(np.ceil(dt / MAX_PHYSICS_STEP_S - 1e-9))
        else:
            decimation = round(dt / timestep)
        step = dt / decimation
        stiff = (physics.presliding > 0).any() or (physics.current_time > 0).any()
        substeps = 1 if stiff else _physics_per_effect(decimation, step)
        return cls(dt, step, substeps, decimation // substeps)

    @property
    def effect(self) -> float:
        """Effect period, s."""
        return self.physics_per_effect * self.physics


def _physics_per_effect(decimation: int, step: float) -> int:
    """Return the most physics steps per effect period that divide a control period."""
    most = max(1, int(MAX_EFFECT_PERIOD_S / step + 1e-6))
    count = min(most, decimation)
    while decimation % count:
        count -= 1
    return count
