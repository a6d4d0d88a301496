"""Sensors: what the simulator answers to a fixed set of probing targets, from here.

U_ξ(x) is the simulator advanced one control period from state ξ with target x held. Probes x_k = q + e_k ask it at m
points; the oracle really steps the simulator, the predictor (nn/networks.py) learns to answer in its place.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from gaponet.base.arrays import Array
from gaponet.nn.config import ModelConfig
from gaponet.robot.spec import RobotSpec
from gaponet.sim.batch import BatchSim, Condition


class ProbeOracle:
    """Forks the simulator m times per state. For labels and tests; never used on a robot."""

    def __init__(
        self,
        robot: RobotSpec,
        config: ModelConfig,
        conditions: list[Condition],
        nthread: int = 0,
        locked: tuple[str, ...] = (),
    ) -> None:
        """One state slot per entry of `conditions`; states are of the joints that are not locked."""
        self.offsets = self.offsets_of(config, len(robot.operated))
        self.dt, self.absolute = np.array([c[2] for c in conditions]), config.sensor_target == "absolute"
        m = len(self.offsets)
        prompt = replace(robot, delay=np.zeros(len(robot.joint_names)))  # a late servo would not answer within a period
        self.sim = sim = BatchSim(prompt, [c for c in conditions for _ in range(m)], nthread, locked)
        self.operated = np.array([sim.joint_names.index(name) for name in robot.operated])
        self.target = np.zeros(sim.qpos.shape)

    @staticmethod
    def offsets_of(config: ModelConfig, n: int) -> Array:
        """e_k, (m, n) rad: one joint at a time, signs and amplitudes alternating so that each joint meets both."""
        offsets = np.zeros((config.num_probes, n))
        for k in range(config.num_probes):
            lap, joint = divmod(k, n)
            sign = 1.0 if (lap + joint) % 2 == 0 else -1.0
            small = (lap // 2 + lap + joint) % 2 == 0
            offsets[k, joint] = sign * (config.probe_small if small else config.probe_large)
        return offsets

    def __call__(self, qpos: Array, qvel: Array, offsets: Array | None = None) -> Array:
        """Sensor values.

        Args:
            qpos, qvel: States of the joints, (k, n_free), one per slot.
            offsets: e_k of each state, (k, m, n) rad; default: the fixed probes.

        Returns:
            (k, m, 2n): [q' − q, Δt·(q̇' − q̇)] of the operated joints, or [q', Δt·q̇'] with an absolute target.
        """
        k, m, op, sim = len(qpos), len(self.offsets), self.operated, self.sim
        rows, each = np.arange(k * m), np.repeat(np.arange(k), m)
        q, v = qpos[each], qvel[each]
        target = q.astype(float)
        target[:, op] += np.tile(self.offsets, (k, 1)) if offsets is None else offsets.reshape(k * m, -1)
        sim.reset(rows, q, v, past=target[:, None])
        self.target[rows] = target
        sim.step(self.target, None if len(rows) == sim.num_envs else rows)
        start = 0.0 if self.absolute else 1.0
        moved = sim.qpos[rows][:, op] - start * q[:, op]
        sped = (sim.qvel[rows][:, op] - start * v[:, op]) * self.dt[each][:, None]
        return np.concatenate([moved, sped], axis=1).astype(np.float32).reshape(k, m, 2 * len(op))
