"""A network that is not told the payload reads it from its simulator's answers, in every form of
use alike.
"""

import mujoco
import numpy as np
import pytest
import torch
from arm import write_arm
from runs import random_run

import gaponet as gp
from gaponet.export.torch_program import delta_step
from gaponet.sim.model import build_model

PAYLOAD = 0.2  # kg
PERIODS = 8


@pytest.fixture
def model(tmp_path):
    """A run in a simulator whose answers to the probes depend on the payload in hand."""
    robot = write_arm(tmp_path / "arm")
    made = random_run(tmp_path / "run", robot, (0.0, PAYLOAD), context=True, payload_input=False)
    assert np.ptp([made.known_simulators.low, made.known_simulators.high], axis=0).max() > 1e-3
    return made


def targets(robot):
    return [robot.qpos_home + 0.2 * np.sin(0.5 * t + np.arange(2)) for t in range(PERIODS)]


@pytest.fixture
def simulated(model):
    """Targets that AlignedSim sends with the payload in hand, (PERIODS, n) rad."""
    robot = model.simulator()
    sim = gp.AlignedSim(robot, model, payload_mass=PAYLOAD)
    sent = []
    for target in targets(robot):
        sim.step(target)
        sent.append(sim.target.ravel().copy())
    return np.array(sent)


def test_the_payload_in_hand_changes_what_aligned_sim_sends(model, simulated):
    robot = model.simulator()
    empty = gp.AlignedSim(robot, model, payload_mass=0.0)
    empty.step(targets(robot)[0])
    assert np.abs(np.ravel(empty.target) - simulated[0]).max() > 1e-5


def test_a_mujoco_loop_sends_what_aligned_sim_sends(model, simulated):
    robot = model.simulator()
    scene = build_model(robot, PAYLOAD)
    align = gp.MujocoAligner(model, scene, dt=robot.dt, payload_mass=PAYLOAD)
    data = mujoco.MjData(scene)
    data.qpos[:] = robot.qpos_home
    mujoco.mj_forward(scene, data)
    sent = []
    for target in targets(robot):
        data.ctrl[:] = align(data, target)
        sent.append(data.ctrl.copy())
        mujoco.mj_step(scene, data, robot.decimation)
    np.testing.assert_allclose(sent, simulated, atol=2e-5)


def test_a_torch_program_sends_what_aligned_sim_sends(model, simulated):
    robot = model.simulator()
    step = delta_step(model, model.path.parent, PAYLOAD)
    q = torch.tensor(robot.qpos_home[None], dtype=torch.float)
    a = torch.tensor(targets(robot)[0][None], dtype=torch.float)
    frames = torch.zeros(1, step.depth, 3 * step.n)
    with torch.no_grad():
        delta, _ = step(q, 0 * q, a, torch.zeros(1), frames, torch.ones(1, dtype=torch.bool))
    np.testing.assert_allclose((a + delta)[0], simulated[0], atol=2e-5)


def test_a_compensator_knows_the_payload_that_it_carries(model):
    sent = {}
    for mass in (0.0, PAYLOAD):
        compensator = gp.Compensator(model.simulator(), model, payload_step=PAYLOAD)
        compensator.reset(model.simulator().qpos_home, mass)
        seen = compensator.inverse.loop.network_input
        contexts_seen = seen.x[:, seen.layout.context]
        sent[mass] = np.array(contexts_seen)
    assert np.abs(sent[0.0] - sent[PAYLOAD]).max() > 1e-3
