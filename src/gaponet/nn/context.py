"""Context of a network: how the simulator at hand answers fixed probes. It says which simulator this is.

The robot rests at home. A null probe leaves the targets there. Another probe moves the target of one joint by
PROBE_RAD. Each joint has eight values: the answer to the null probe, and the difference that its own probe makes, each
as position (rad) and velocity times the control period (rad), after READ_AFTER_S.

This is the branch input of a DeepONet (Lu et al. 2021): the input function, here the response of the simulator, at
fixed sensors. It is measured once per simulator and is constant while the network runs.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from gaponet.base.arrays import Array
from gaponet.robot.spec import RobotSpec
from gaponet.sim.batch import BatchSim, Condition

PROBE_RAD = 0.2
READ_AFTER_S = (0.04, 0.2)  # the start of the motion, and most of it
MIN_WIDTH_RAD = 1e-4  # narrower ranges of training are taken to be this wide


def contexts(
    robot: RobotSpec, conditions: list[Condition], loaded: bool, nthread: int = 1
) -> Array:
    """Measure the answers of simulators.

    Args:
        robot: The simulator.
        conditions: Simulations; their payload counts only if `loaded`.
        loaded: The hands hold the payload while the simulator is probed. If the network is told the payload, they are
            empty.
        nthread: Threads, 0 for all cores.

    Returns:
        (conditions, 8n) float32, rad. The joint varies fastest.
    """
    if not loaded:
        conditions = [c._replace(payload_mass=0.0) for c in conditions]
    known: dict[Condition, Array] = vars(robot).setdefault("_contexts", {})
    unknown = [c for c in dict.fromkeys(conditions) if c not in known]
    for dt in dict.fromkeys(c.dt for c in unknown):
        same_rate = [c for c in unknown if c.dt == dt]
        known.update(zip(same_rate, _measure(robot, same_rate, nthread), strict=True))
    return np.stack([known[c] for c in conditions])


def _measure(robot: RobotSpec, conditions: list[Condition], nthread: int) -> Array:
    """Return the answers of simulations with one control period, (conditions, 8n) float32."""
    operated = robot.operated_index
    n = len(operated)
    probes = n + 1  # of each simulation; the first is the null probe
    sim = BatchSim(robot, [c for c in conditions for _ in range(probes)], nthread)
    home = np.tile(robot.qpos_home, (len(conditions) * probes, 1))
    towards = np.where(robot.qpos_home + PROBE_RAD <= sim.range[:, 1], 1.0, -1.0)[operated]  # (n,)
    target = home.copy()
    for j, joint in enumerate(operated):
        target[1 + j :: probes, joint] += PROBE_RAD * towards[j]

    sim.reset(slice(None), home, np.zeros_like(home), past=home[:, None])
    dt = conditions[0].dt
    read_at = [max(1, round(seconds / dt)) for seconds in READ_AFTER_S]
    values = []
    for period in range(1, read_at[-1] + 1):
        sim.step(target)
        if period not in read_at:
            continue
        for quantity in (sim.qpos - home, sim.qvel * dt):
            answers = quantity[:, operated].reshape(len(conditions), probes, n)
            null = answers[:, 0]
            own = np.diagonal(answers[:, 1:], axis1=1, axis2=2)  # joint j under probe j
            values += [null, (own - null) * towards]
    return np.stack(values, axis=1).reshape(len(conditions), -1).astype(np.float32)


@dataclass(frozen=True)
class KnownSimulators:
    """Answers of the simulators of a training.

    Attributes:
        nominal: Of the robot's own simulator, (8n) rad.
        low, high: Smallest and largest, (8n) rad.
    """

    nominal: Array
    low: Array
    high: Array

    @classmethod
    def of(cls, nominal: Array, trained: Array) -> KnownSimulators:
        """Return the range of answers (simulators, 8n)."""
        return cls(nominal, trained.min(axis=0), trained.max(axis=0))

    def distance(self, context: Array) -> float:
        """Return how far answers (…, 8n) lie outside those of training: 0 within, 1 a whole width of the range away."""
        beyond = np.maximum(self.low - context, context - self.high)
        width = np.maximum(self.high - self.low, MIN_WIDTH_RAD)
        return float(np.maximum(beyond / width, 0.0).max())

    def to_card(self) -> dict[str, list[float]]:
        """Return the entry of card.json."""
        return {name: np.round(values, 7).tolist() for name, values in vars(self).items()}

    @classmethod
    def from_card(cls, entry: dict[str, Any]) -> KnownSimulators:
        """Read the entry of card.json."""
        return cls(*(np.array(entry[name], np.float32) for name in ("nominal", "low", "high")))
