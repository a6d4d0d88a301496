"""A network in a running simulation: inputs, inference, bounds."""

from __future__ import annotations

from collections.abc import Sequence as ListOf

import numpy as np

from gaponet.data.sequence import Sequence
from gaponet.errors import ModelError
from gaponet.model.config import ModelConfig
from gaponet.model.inputs import Infer, Inputs
from gaponet.robot import RobotSpec

Array = np.ndarray
Condition = tuple[float, str, float]  # payload_mass kg, payload_side, dt s


class DeltaCorrector:
    """Target → target + Δa for the operated joints, clipped to the joint range. Implements sim.replay.Corrector."""

    def __init__(self, infer: Infer, config: ModelConfig, robot: RobotSpec, points: Infer | None = None) -> None:
        """points: x → offsets of the probes, where config.sensors is learned."""
        self.infer, self.config, self.robot, self.points = infer, config, robot, points
        self.op = robot.operated_index
        self.range = robot.qpos_range[self.op]

    def reset(self, start: ListOf[Sequence]) -> None:
        """One simulation per sequence, at its first row: that frame repeated, with its command, is the history.

        A model that asks the simulator asks one in which idle limbs are clamped, and only while a sequence lasts.
        """
        locked: tuple[str, ...] = ()
        if self.config.asks_simulator:
            from gaponet.sim.replay import idle_limbs

            locked = idle_limbs(start, self.robot)
        self.begin(
            np.stack([s.qpos[0] for s in start]),
            np.stack([s.qvel[0] for s in start]),
            np.stack([s.ctrl[0] for s in start]),
            np.array([s.meta.payload_mass for s in start], np.float32),
            [(s.meta.payload_mass, s.meta.payload_side, s.dt) for s in start],
            locked,
        )
        self.last = np.array([len(s) - 1 for s in start])

    def begin(
        self,
        qpos: Array,
        qvel: Array,
        ctrl: Array,
        payload_mass: Array,
        simulated: list[Condition] | None = None,
        locked: tuple[str, ...] = (),
    ) -> None:
        """Start from a state, all joints: (k, n_all) each, payload (k,) kg.

        Args:
            qpos, qvel, ctrl: State and command.
            payload_mass: What the model is told.
            simulated: Payload, side and period of each, where these are simulations whose whole state is given.
            locked: Joints clamped in the simulator asked.

        Raises:
            ModelError: The model asks the simulator, and this is none.
        """
        op, self.payload = self.op, np.asarray(payload_mass, np.float32)
        oracle = None
        if self.config.asks_simulator:
            if simulated is None:
                raise ModelError(
                    f"this model's sensors are the simulator's own answers (sensors = {self.config.sensors}): "
                    "to compare with, of no use outside a simulator; train with --model.sensors predicted"
                )
            from gaponet.model.sensor import ProbeOracle

            oracle = ProbeOracle(self.robot, self.config, simulated, locked=locked, whole=True)
        self.last = np.full(len(qpos), np.iinfo(np.int64).max)  # row at which a simulation ends
        self.inputs = Inputs(self.config, len(qpos), op, oracle, self.points)
        frames = [np.repeat(x[:, None], self.inputs.history.depth, axis=1) for x in (qpos, qvel, ctrl)]
        self.inputs.reset(slice(None), *frames)
        self.periods = 0

    def correct(self, t: int, target: Array, qpos: Array, qvel: Array) -> Array:
        """Corrected targets, (k, n_all) rad."""
        op = self.op
        a = target[:, op]
        if self.periods % self.config.delta_hold == 0:
            self.inputs.rest(self.periods >= self.last)
            self.delta = self.infer(self.inputs.x(qpos, qvel, a, self.payload))
        self.periods += 1
        out = np.array(target, float)
        out[:, op] = np.clip(a + self.delta, self.range[:, 0], self.range[:, 1])
        self.inputs.push(qpos, qvel, out)
        return out
