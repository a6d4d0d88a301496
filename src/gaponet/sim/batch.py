"""Many simulations of one robot, one control period per step. The seam behind which another back-end may step."""

from __future__ import annotations

import mujoco
import numpy as np
from mujoco.batch import Batch

from gaponet.robot import RobotSpec
from gaponet.sim.model import build_model, qpos_range

Array = np.ndarray
Condition = tuple[float, str, float]  # payload_mass kg, payload_side, dt s


class BatchSim:
    """num_envs simulations of a robot; each may carry its own payload and control period.

    `qpos` and `qvel` are live (num_envs, n) views: a write is the state at the next step. Results are bit-identical to
    a loop of mj_step over one MjData each, at any number of threads.
    """

    def __init__(
        self, robot: RobotSpec, conditions: list[Condition], nthread: int = 0, locked: tuple[str, ...] = ()
    ) -> None:
        """One simulation per entry of `conditions`; nthread 0 uses all cores; n counts joints that are not locked."""
        self.robot = robot
        self.joint_names = tuple(name for name in robot.joint_names if name not in locked)
        self.models = {c: build_model(robot, c[0], c[1], c[2], locked) for c in dict.fromkeys(conditions)}
        first = self.models[conditions[0]]
        self.batch = Batch(first, nsim=len(conditions), nthread=nthread)
        if len(self.models) > 1:
            self.batch.set_models([self.models[c] for c in conditions])
        self.num_envs = len(conditions)
        self.n = len(self.joint_names)
        self.qpos: Array = self.batch.bind("qpos")
        self.qvel: Array = self.batch.bind("qvel")
        self.ctrl: Array = self.batch.bind("ctrl")
        self.torque: Array = self.batch.bind("actuator_force")
        self._warmstart: Array = self.batch.bind("qacc_warmstart")
        self.range = qpos_range(first)

    def reset(self, ids: Array | slice, qpos: Array, qvel: Array) -> None:
        """Put simulations `ids` into a state, (k, n) rad and rad/s."""
        self.qpos[ids] = qpos
        self.qvel[ids] = qvel
        self._warmstart[ids] = 0.0

    def step(self, ctrl: Array, ids: Array | None = None) -> None:
        """Hold position targets for one control period.

        Args:
            ctrl: Targets, (num_envs, n), rad; clipped to the joint range, as a servo would.
            ids: Only these simulations move, (k,) sorted; default all.
        """
        np.clip(ctrl, self.range[:, 0], self.range[:, 1], out=self.ctrl)
        self.batch.step(ids, nstep=self.robot.decimation)

    def data(self, env: int) -> mujoco.MjData:
        """One simulation as MjData, for rendering or forward kinematics."""
        return self.batch.get_data(env)
