"""Simulations by mujoco_warp, on CUDA or else on Warp's CPU device, are MuJoCo's but for
rounding.
"""

from dataclasses import replace

import numpy as np
import pytest
from arm import write_arm

from gaponet.robot.servo_fields import SERVO_TERMS
from gaponet.robot.spec import load_robot, packaged_robots
from gaponet.sim.batch import BatchSim, Condition

pytest.importorskip("torch")
pytest.importorskip("mujoco_warp", reason="needs pip install 'gaponet[warp]'")

import torch

from gaponet.sim.warp import WarpSim

DEVICE = "cuda" if torch.cuda.is_available() else "warp-cpu"
PERIODS = 50
HOLD_S = 10.0
ROUNDING = 2e-6  # rad: a few times what a float32 resolves at 2 rad
# The band of accelerations in which a joint sticks (sim/model.py) is hardly wider than what a
# float32 resolves at 100 rad/s², so where a joint stops differs more, mostly by nothing.
STOPPED = {"fr3": 5e-3}  # rad
HELD = {"fr3": 2e-3}  # rad


def worlds(robot, friction=True, both_rates=True):
    """As shipped, with a payload, at another rate, of other gains, with friction × 10, with servos
    of their own.
    """
    shipped = Condition(0.0, "both", robot.dt)
    laden = shipped._replace(payload_mass=0.3 if robot.payload_mounts else 0.0)
    fast = shipped._replace(dt=robot.dt / 2 if both_rates and robot.decimation > 1 else robot.dt)
    soft = shipped._replace(kp=tuple(0.7 * robot.servo.kp), kd=tuple(1.3 * robot.servo.kd))
    sim = BatchSim(robot, [shipped, laden, fast, soft, laden, fast], nthread=1)
    rng = np.random.default_rng(0)
    factor = rng.uniform(0.5, 1.5, sim.n)
    sim.batch.expand("actuator_gainprm")[5, :, 0] *= factor
    sim.batch.expand("actuator_biasprm")[5, :, :2] *= factor[:, None]
    dry = sim.batch.expand("dof_frictionloss")
    dry[4] *= 10
    dry[5] *= rng.uniform(0, 3, sim.n)
    dry *= friction
    sim.batch.expand("dof_damping")[5] *= rng.uniform(0.5, 2, sim.n)
    return sim


class Both:
    """The same simulations in C and in Warp, and how far apart each joint's position has been,
    (num_envs, n) rad.
    """

    def __init__(self, robot, **how):
        self.ours = worlds(robot, **how)
        self.theirs = WarpSim(self.ours, DEVICE)
        self.apart = 0.0
        low, high = np.clip(self.ours.commands.range.T, -3, 3)
        home = robot.qpos_home[robot.index(self.ours.joint_names)]
        inside = 0.1 * (high - low)
        self.at = np.clip(home, low + inside, high - inside)
        self.at = self.at + np.random.default_rng(1).uniform(-0.05, 0.05, self.ours.qpos.shape)

    def put(self, ids, at):
        past = at[ids][:, None] + np.linspace(0.02, 0, 3)[:, None]
        for sim in (self.ours, self.theirs):
            sim.reset(ids, at[ids], np.zeros_like(at[ids]), past=past)

    def step(self, target, ids=None):
        for sim in (self.ours, self.theirs):
            sim.step(target, ids)
        error = np.abs(self.ours.qpos - self.theirs.qpos.cpu().numpy())
        self.apart = np.maximum(self.apart, error)


@pytest.mark.parametrize("friction", [False, True])
@pytest.mark.parametrize("name", packaged_robots())
def test_a_second_of_motion_agrees_with_mujoco(name, friction):
    robot = load_robot(name)
    if not friction:
        robot = robot.with_servo(delay=np.linspace(0.004, 0.015, len(robot.joint_names)))
    both = Both(robot, friction=friction)
    both.put(slice(None), both.at)
    phase = np.arange(both.ours.n)
    for t in range(PERIODS):
        if t == PERIODS // 2:
            both.put(np.array([0, 2, 4]), both.at + 0.1)
        both.step(both.at + 0.2 * (np.sin(np.pi * t * robot.dt + phase) - np.sin(phase)))
    assert np.median(both.apart) <= ROUNDING
    assert both.apart.max() <= (STOPPED.get(name, 5e-4) if friction else ROUNDING)
    assert np.ptp(both.ours.qpos, axis=0).max() > 1e-3  # the simulations are not one


@pytest.mark.parametrize("name", packaged_robots())
def test_holding_for_ten_seconds_agrees_with_mujoco(name):
    robot = load_robot(name)
    both = Both(robot, both_rates=False)
    both.put(slice(None), both.at)
    for _ in range(round(HOLD_S / robot.dt)):
        both.step(both.at + 0.03)
    assert both.apart.max() <= HELD.get(name, 1e-4)


@pytest.mark.parametrize("rates", [(0.02, 0.02, 0.02), (0.01, 0.02, 0.01)])
def test_some_simulations_step_alone_and_a_state_is_restored(tmp_path, rates):
    robot = write_arm(tmp_path).with_servo(delay=[0.03, 0.0], target_speed=[0.0, 0.8])
    sim = WarpSim(BatchSim(robot, [Condition(0.0, "both", dt) for dt in rates], 1), DEVICE)
    sim.reset(slice(None), np.zeros((3, 2)), np.zeros((3, 2)), past=np.zeros((3, 4, 2)))
    for _ in range(3):
        sim.step(np.ones((3, 2)), np.array([0, 2]))
    assert (sim.qpos[1] == 0).all()
    assert (sim.qpos[[0, 2]] != 0).all()
    state = sim.state()
    paths = []
    for _ in range(2):
        sim.set_state(state)
        sim.step(-np.ones((3, 2)))
        paths.append(sim.qpos.clone())
    assert (paths[0] == paths[1]).all()


LAW = {
    "stribeck": 0.05,
    "stribeck_speed": 0.2,
    "friction_motor": 0.1,
    "friction_external": 0.1,
    "no_load_speed": 1.0,
    "encoder_step": 1e-3,
    "min_torque": 0.02,
}
AT = np.full((3, 2), 0.3)  # rad


@pytest.fixture
def lawful(tmp_path, delay):
    """The arm with all terms of the servo model, the shoulder late."""
    robot = write_arm(tmp_path).with_servo(delay=[delay, 0.0], **LAW)
    return robot.with_identified({"elbow": {"offset": 0.1}})


def three(robot, rates):
    """Simulations with 1, 0.5 and 2 times the terms of the robot."""
    sim = BatchSim(robot, [Condition(0.0, "both", dt) for dt in rates], 1)
    for term in sim.servo_model.servos.terms.values():
        term *= np.array([[1.0], [0.5], [2.0]])
    return sim


def put(sim, ids):
    sim.reset(ids, AT[ids], np.zeros_like(AT[ids]), past=AT[ids][:, None])


@pytest.mark.parametrize("rates", [(0.02, 0.02, 0.02), (0.01, 0.02, 0.01)])
@pytest.mark.parametrize("delay", [0.0, 0.03])
def test_the_servo_model_agrees_with_mujoco(lawful, rates):
    ours = three(lawful, rates)
    theirs = WarpSim(ours, DEVICE)
    for sim in (ours, theirs):
        put(sim, slice(None))
    apart = 0.0
    for t in range(PERIODS):
        ids = np.array([0, 1]) if t < 5 else None
        for sim in (ours, theirs):
            if t == PERIODS // 2:
                put(sim, np.array([0, 2]))
            sim.step(AT + 0.2 * np.sin(0.1 * t), ids)
        apart = np.maximum(apart, np.abs(ours.qpos - theirs.qpos.cpu().numpy()))
    assert apart.max() <= 5e-4
    for name, x in ours.state().items():
        assert theirs.state()[name].shape == x.shape


@pytest.mark.parametrize("rates", [(0.02, 0.02, 0.02), (0.01, 0.02, 0.01)])
@pytest.mark.parametrize("delay", [0.0, 0.03])
def test_without_the_servo_model_the_arm_is_elsewhere(lawful, rates):
    sim = three(lawful, rates)
    plain = BatchSim(lawful.with_servo(**dict.fromkeys(LAW, 0.0)), [(0.0, "both", 0.02)])
    put(sim, slice(None))
    put(plain, slice(1))
    apart = 0.0
    for t in range(PERIODS):
        target = AT + 0.2 * np.sin(0.1 * t)
        sim.step(target)
        plain.step(target[:1])
        apart = max(apart, np.abs(plain.qpos[0] - sim.qpos[1]).max())
    assert apart > 5e-3


@pytest.mark.parametrize(
    "parts", [("stribeck", "stribeck_speed"), ("encoder_step",), ("no_load_speed",), SERVO_TERMS]
)
def test_the_servo_model_of_a_physics_step_agrees_with_mujoco_up_to_rounding(tmp_path, parts):
    law = dict(zip(SERVO_TERMS, (0.05, 0.2, 0.1, 0.2, 0.02, 1e-3, 1.0, 0.0), strict=True))
    robot = replace(write_arm(tmp_path), timestep=0.02)
    robot = robot.with_servo(**{name: law[name] for name in parts})
    robot = robot.with_identified({"elbow": {"offset": 0.1}})
    ours = BatchSim(robot, [Condition(0.0, "both", robot.dt)] * 3, 1)
    for x in ours.servo_model.servos.terms.values():
        x[:, 0] *= [0.0, 1.0, 2.0]
    ours.batch.expand("actuator_forcerange")[:] *= np.array([1.0, 0.5, 0.1])[:, None, None]
    ours.servo_model.servos.records["effort_limit"] *= np.array([[1.0], [0.5], [0.1]])
    theirs = WarpSim(ours, DEVICE)
    rng = np.random.default_rng(0)
    for ids in (np.arange(3), np.array([0, 2])):
        qpos = rng.normal(0, 0.3, (len(ids), 2))
        qvel = rng.normal(0, 0.3, (len(ids), 2))
        past = rng.normal(0, 0.3, (len(ids), 1, 2))
        target = np.clip(ours.qpos + rng.choice([1e-4, 0.1], (3, 2)), *ours.commands.range.T)
        for sim in (ours, theirs):
            sim.reset(ids, qpos, qvel, past=past)
        for name, x in ours.state().items():
            np.testing.assert_allclose(theirs.state()[name].cpu(), x, rtol=1e-5, atol=1e-6)
        ours.commands.ctrl[:] = target
        ours.servo_model.before()
        theirs.step(target)
        for name in ("actuator_biasprm", "dof_frictionloss", "actuator_forcerange"):
            np.testing.assert_allclose(
                theirs.model_field(name).cpu(), ours.batch.expanded(name), rtol=1e-5, atol=1e-5
            )
        ours.set_state({name: x.cpu().numpy() for name, x in theirs.state().items()})
