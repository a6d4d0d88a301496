"""Sensor values: the simulator's answers to m probes, which are targets near the present position.

U_ξ(x) is the state of the simulator one control period after state ξ, with the target x. The probes
are x_k = q + e_k. `ProbeOracle` steps the simulator. The sensor predictor (nn/paper.py) learns its
answers.
"""

from __future__ import annotations

import numpy as np

from gaponet.base.arrays import Array
from gaponet.nn.config import ModelConfig
from gaponet.robot.spec import RobotSpec
from gaponet.sim.batch import BatchSim, Condition


class ProbeOracle:
    """Steps m copies of the simulator from each state.

    It is for training and rollouts, not for robots.
    """

    def __init__(
        self,
        robot: RobotSpec,
        config: ModelConfig,
        conditions: list[Condition],
        nthread: int = 0,
        locked: tuple[str, ...] = (),
    ) -> None:
        """conditions: Payload, rate and gains of each state.

        States have the joints that are not in `locked`.
        """
        self.offsets = self.probe_offsets(config, len(robot.operated))
        self.dt = np.array([condition.dt for condition in conditions])
        self.absolute = config.sensor_target == "absolute"
        # A delayed servo would not respond within the control period.
        no_delay = robot.with_servo(delay=np.zeros(len(robot.joint_names)))
        copies = []  # a simulation for each probe of each state
        for condition in conditions:
            copies += [condition] * len(self.offsets)
        self.sim = BatchSim(no_delay, copies, nthread, locked)
        self.operated = np.array([self.sim.joint_names.index(name) for name in robot.operated])
        self.target = np.zeros(self.sim.qpos.shape)

    @staticmethod
    def probe_offsets(config: ModelConfig, n: int) -> Array:
        """Return e_k, (m, n) rad: one joint per probe, with alternating signs and amplitudes."""
        offsets = np.zeros((config.num_probes, n))
        for k in range(config.num_probes):
            lap, joint = divmod(k, n)
            # In four laps, each joint has both signs with both amplitudes.
            sign = 1.0 if (lap + joint) % 2 == 0 else -1.0
            small = (lap // 2 + lap + joint) % 2 == 0
            offsets[k, joint] = sign * (config.probe_small if small else config.probe_large)
        return offsets

    def __call__(self, qpos: Array, qvel: Array, offsets: Array | None = None) -> Array:
        """Return sensor values.

        Args:
            qpos, qvel: States of the joints that are not locked, (k, n_free).
            offsets: e_k of each state, (k, m, n) rad; default: the fixed probes.

        Returns:
            (k, m, 2n): [q' − q, Δt·(q̇' − q̇)] of the operated joints, or [q', Δt·q̇'] with an
            absolute target.
        """
        k = len(qpos)
        m = len(self.offsets)
        op = self.operated
        sim = self.sim
        rows = np.arange(k * m)
        state = np.repeat(np.arange(k), m)
        q = qpos[state]
        v = qvel[state]
        target = q.astype(float)
        if offsets is None:
            target[:, op] += np.tile(self.offsets, (k, 1))
        else:
            target[:, op] += offsets.reshape(k * m, -1)
        sim.reset(rows, q, v, past=target[:, None])
        self.target[rows] = target
        sim.step(self.target, None if len(rows) == sim.num_envs else rows)
        start = 0.0 if self.absolute else 1.0
        positions = sim.qpos[rows][:, op] - start * q[:, op]
        velocities = (sim.qvel[rows][:, op] - start * v[:, op]) * self.dt[state][:, None]
        values = np.concatenate([positions, velocities], axis=1).astype(np.float32)
        return values.reshape(k, m, 2 * len(op))
