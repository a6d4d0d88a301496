"""Sensors: what the simulator answers to a fixed set of probing targets, from here.

U_ξ(x) is the simulator advanced one control period from state ξ with target x held. Probes x_k = q + e_k ask it at m
points; the oracle really steps the simulator, the predictor (model/deeponet.py) learns to answer in its place.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np

from gaponet.arrays import Array, library, like, single, zeros_like
from gaponet.family.draw import Members
from gaponet.model.config import ModelConfig
from gaponet.robot import RobotSpec
from gaponet.sim.batch import BatchSim, Condition


def probe_offsets(config: ModelConfig, n: int) -> Array:
    """e_k, (m, n) rad: one joint at a time, signs and amplitudes alternating so that each joint meets both."""
    offsets = np.zeros((config.num_probes, n))
    for k in range(config.num_probes):
        lap, joint = divmod(k, n)
        sign = 1.0 if (lap + joint) % 2 == 0 else -1.0
        small = (lap // 2 + lap + joint) % 2 == 0
        offsets[k, joint] = sign * (config.probe_small if small else config.probe_large)
    return offsets


class ProbeOracle:
    """Forks the simulator m times per state. For labels, tests and upper bounds; never used on a robot."""

    def __init__(
        self,
        robot: RobotSpec,
        config: ModelConfig,
        conditions: list[Condition],
        nthread: int = 0,
        locked: tuple[str, ...] = (),
        whole: bool = False,
        members: Members | None = None,
        place: Callable[[BatchSim], Any] = lambda sim: sim,
    ) -> None:
        """One state slot per entry of `conditions`, and of `members`, if any; states are of the joints that are not
        locked, or, where whole, of all. They and the answers are arrays of the simulator that place returns."""
        self.offsets = probe_offsets(config, len(robot.operated))
        self.dt = np.array([c[2] for c in conditions])
        m = len(self.offsets)
        prompt = replace(robot, delay=np.zeros(len(robot.joint_names)))  # a late servo would not answer within a period
        own = conditions if members is None else members.conditions(conditions)
        sim = BatchSim(prompt, [c for c in own for _ in range(m)], nthread, locked)
        if members is not None:
            members[np.repeat(np.arange(len(own)), m)].put(sim, prompt)
        self.free = robot.index(sim.joint_names) if whole else slice(None)
        self.absolute = config.sensor_target == "absolute"
        self.operated = np.array([sim.joint_names.index(name) for name in robot.operated])
        self.sim = place(sim)
        self.target = zeros_like(self.sim.qpos, *sim.qpos.shape)

    def __call__(self, qpos: Any, qvel: Any, offsets: Any = None, ids: Array | None = None) -> Any:
        """Sensor values.

        Args:
            qpos, qvel: States of the joints, (k, n_free) or (k, n_all), one per slot.
            offsets: Where to ask, relative to q, (k, m, n) rad; default the fixed probes.
            ids: Only these slots, (k,) sorted; default all.

        Returns:
            (k, m, 2n): [q' − q, Δt·(q̇' − q̇)] of the operated joints, or [q', Δt·q̇'] where sensor_target is absolute.
        """
        k, m, op, sim = len(qpos), len(self.offsets), self.operated, self.sim
        slots = np.arange(k) if ids is None else ids
        rows, each = (slots[:, None] * m + np.arange(m)).ravel(), np.repeat(np.arange(k), m)
        q, v = (sim.array(x)[:, self.free][each] for x in (qpos, qvel))
        target, asked = q + 0.0, sim.array(self.offsets[None] if offsets is None else offsets)
        target[:, op] += (asked + zeros_like(asked, k, 1, 1)).reshape(-1, len(op))
        sim.reset(rows, q, v, past=target[:, None])
        self.target[rows] = target
        sim.step(self.target, None if len(rows) == sim.num_envs else rows)
        moved, sped = sim.qpos[rows][:, op], sim.qvel[rows][:, op]
        if not self.absolute:
            moved, sped = moved - q[:, op], sped - v[:, op]
        sped = sped * like(sped, self.dt[slots][each])[:, None]
        return single(library(sped).concatenate([moved, sped], 1)).reshape(k, m, 2 * len(op))
