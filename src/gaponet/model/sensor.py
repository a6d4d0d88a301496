"""Sensors: what the simulator answers to a fixed set of probing targets, from here.

U_ξ(x) is the simulator advanced one control period from state ξ with target x held. Probes x_k = q + e_k ask it at m
points; the oracle really steps the simulator, the predictor (model/deeponet.py) learns to answer in its place.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from gaponet.model.config import ModelConfig
from gaponet.robot import RobotSpec
from gaponet.sim.batch import BatchSim, Condition

Array = np.ndarray


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
    """Forks the simulator m times per state. For labels, tests and the upper bound; never used on a robot."""

    def __init__(
        self,
        robot: RobotSpec,
        config: ModelConfig,
        conditions: list[Condition],
        nthread: int = 0,
        locked: tuple[str, ...] = (),
    ) -> None:
        """One state slot per entry of `conditions`; states are of the joints that are not locked."""
        self.offsets = probe_offsets(config, len(robot.operated))
        self.dt = np.array([c[2] for c in conditions])
        m = len(self.offsets)
        prompt = replace(robot, delay=np.zeros(len(robot.joint_names)))  # a late servo would not answer within a period
        self.sim = BatchSim(prompt, [c for c in conditions for _ in range(m)], nthread, locked)
        self.operated = np.array([self.sim.joint_names.index(name) for name in robot.operated])

    def __call__(self, qpos: Array, qvel: Array) -> Array:
        """Sensor values in delta form.

        Args:
            qpos, qvel: States of all the robot's joints, (k, n_all), one per slot.

        Returns:
            (k, m, 2n): [q' − q, Δt·(q̇' − q̇)] of the operated joints.
        """
        m, op = len(self.offsets), self.operated
        q, v = np.repeat(qpos, m, axis=0), np.repeat(qvel, m, axis=0)
        target = q.copy()
        target[:, op] += np.tile(self.offsets, (len(qpos), 1))
        self.sim.reset(slice(None), q, v, past=target[:, None])
        self.sim.step(target)
        moved = self.sim.qpos[:, op] - q[:, op]
        sped = (self.sim.qvel[:, op] - v[:, op]) * np.repeat(self.dt, m)[:, None]
        return np.concatenate([moved, sped], axis=1).reshape(len(qpos), m, 2 * len(op)).astype(np.float32)
