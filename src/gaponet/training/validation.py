"""How far a network is from the recordings while it is trained: whole motions, free run."""

from __future__ import annotations

from collections.abc import Sequence as ListOf

import numpy as np

from gaponet.data.sequence import Sequence
from gaponet.family.context import context
from gaponet.family.draw import Members
from gaponet.model.backends import FunctionNetwork
from gaponet.model.config import ModelConfig
from gaponet.model.corrector import DeltaCorrector
from gaponet.model.layers import DeltaNet
from gaponet.model.loop import DeltaLoop
from gaponet.robot import RobotSpec
from gaponet.sim.batch import BatchSim, Condition
from gaponet.sim.replay import idle_limbs, replay
from gaponet.training.sensor_fit import points_of, torch_infer

PAIRS, ROWS = 16, 500  # motions in members of a family, and how much of each


def mean_error(
    sequences: ListOf[Sequence], robot: RobotSpec, config: ModelConfig, net: DeltaNet | None, nthread: int
) -> float:
    """MPJAE over the motions, rad; None for the simulator as it is."""
    n, op = len(robot.operated), robot.operated_index
    corrector = None
    if net is not None:
        corrector = DeltaCorrector(
            FunctionNetwork(torch_infer(net), config.input_dim(n), n), config, robot, points_of(net)
        )
    twins = replay(sequences, robot, corrector, nthread, lock_idle=True)
    return float(np.mean([np.abs(t.qpos - s.qpos)[1:, op].mean() for s, t in zip(sequences, twins, strict=True)]))


def in_members(
    sequences: ListOf[Sequence], robot: RobotSpec, config: ModelConfig, net: DeltaNet | None, nthread: int,
    members: Members,
) -> float:  # fmt: skip
    """The same with each motion's first 10 s at 50 Hz in another simulator of a family, one for each member."""
    parts = [sequences[i % len(sequences)].rows(slice(ROWS)) for i in range(len(members))]
    told, locked, n = [Condition.of(s, robot) for s in parts], idle_limbs(parts, robot), len(robot.operated)
    sim = BatchSim(members.robot(robot), members.conditions(told), nthread, locked)
    members.put(sim, robot)
    free = robot.index(sim.joint_names)
    op = np.array([sim.joint_names.index(name) for name in robot.operated])
    rows = np.minimum(np.arange(max(map(len, parts)))[:, None], [len(s) - 1 for s in parts])
    ctrl, real = (np.stack([getattr(s, x)[r][:, free] for s, r in zip(parts, rows.T, strict=True)], axis=1)
                  for x in ("ctrl", "qpos"))  # fmt: skip
    speed = np.stack([s.qvel[0, free] for s in parts])
    sim.reset(slice(None), real[0], speed, past=ctrl[0][:, None])
    loop, payload = None, np.array([c.payload_mass for c in told])
    if net is not None:
        network = FunctionNetwork(torch_infer(net), config.input_dim(n), n)
        known = None
        if config.context != "none":
            known = context(config.context, robot.nominal or robot, robot, told, members, nthread)
        loop = DeltaLoop(config, sim.range[op], len(parts), network, context=known)
    total = np.zeros(len(parts))
    for t in range(len(ctrl) - 1):
        target = ctrl[t].copy()
        if loop is not None:
            loop.delta(sim.qpos[:, op], sim.qvel[:, op], target[:, op], payload)
            target[:, op] = loop.applied
        sim.step(target)
        total += np.abs(sim.qpos[:, op] - real[t + 1][:, op]).mean(axis=1) * (rows[t + 1] == t + 1)
    return float(np.mean(total / [len(s) - 1 for s in parts]))
