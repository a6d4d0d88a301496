"""Backlash: the servo model beside a MuJoCo model with a hinge of its own between motor and
link.
"""

import mujoco
import numpy as np
import pytest
from arm import write_arm

from gaponet.data.sequence import Sequence, SequenceMeta
from gaponet.export.shipped import mujoco_servos
from gaponet.export.simulator_facts import simulator_facts
from gaponet.sim.batch import BatchSim
from gaponet.sim.model import build_model
from gaponet.sim.replay import replay
from gaponet.sysid.joint_rollouts import JointRollouts

WIDTH = 0.03
KP = 3.0
DAMPING = 0.06
ARMATURE = 2e-3
SERVO = {
    "kp": KP,
    "damping": DAMPING,
    "frictionloss": 0.01,
    "armature": ARMATURE,
    "offset": 0.0,
    "delay": 0.0,
    "backlash": WIDTH,
}
TOML = """name = "pendulum"
dt = 0.01
timestep = 0.001
[[joint]]
name = "swing"
kp = 3.0
effort_limit = 50.0
"""
LINK = (
    '<geom type="capsule" fromto="0 0 0 0 0 -0.2" size="0.01" mass="0.15"'
    ' contype="0" conaffinity="0"/>'
)
MODEL = (
    '<mujoco><compiler angle="radian"/><option integrator="implicitfast" timestep="0.0005"/>'
    "<worldbody>{}</worldbody></mujoco>"
)
JOINT = (
    '<body><joint name="swing" axis="0 1 0" armature="0.002" damping="0.06" frictionloss="0.01"/>'
)
PLAY_HINGE = (
    f'{JOINT}<inertial pos="0 0 0" mass="1e-6" diaginertia="1e-9 1e-9 1e-9"/>'
    f'<body><joint name="play" axis="0 1 0" limited="true" range="{-WIDTH / 2} {WIDTH / 2}"'
    f' solreflimit="0.001 1"/>{LINK}</body></body>'
)


def command():
    t = np.arange(200)[:, None] * 0.01
    return 0.3 * np.sin(2 * np.pi * 0.6 * t) + 0.1 * np.sin(2 * np.pi * 2.3 * t)


def play_hinge(ctrl):
    """Angles of the link in plain MuJoCo, (T, 1) rad; the encoder is on the link."""
    model = mujoco.MjModel.from_xml_string(MODEL.format(PLAY_HINGE))
    model.dof_solref[:] = [0.00125, 1.0]
    data = mujoco.MjData(model)
    path = []
    for target in ctrl[:, 0]:
        path.append([data.qpos.sum()])
        for _ in range(20):
            data.qfrc_applied[0] = KP * (target - data.qpos.sum())
            mujoco.mj_step(model, data)
    return np.array(path)


@pytest.fixture
def pendulum(tmp_path):
    return write_arm(tmp_path / "pendulum", TOML, MODEL.format(f"{JOINT}{LINK}</body>"))


def test_joint_and_robot_move_as_a_play_hinge(pendulum):
    ctrl = command()
    real = play_hinge(ctrl)
    meta = SequenceMeta(pendulum.name, "a", "swing", 0.0, virtual=True)
    recorded = Sequence(
        meta, pendulum.joint_names, 0.01, ctrl, real, np.gradient(real, 0.01, axis=0)
    )
    rollouts = JointRollouts([recorded], pendulum)
    errors = []
    for width in (0.0, WIDTH):
        servo = SERVO | {"backlash": width}
        (whole,) = replay([recorded], pendulum.with_identified({"swing": servo}))
        values = {f: np.full((1, 1), v) for f, v in servo.items()}
        alone = rollouts.errors(values)[0, 0, 0]
        errors.append([np.abs(whole.qpos - real)[20:].mean(), np.abs(alone[20:]).mean()])
    assert min(errors[0]) > 4e-3  # rad: without the gap
    assert max(errors[1]) < 0.2 * min(errors[0])


def test_a_constant_load_hides_the_gap(arm):
    """The test arm holds its links up all the time: its motors press on one side."""
    target = np.full((1, 2), 0.1)
    paths = []
    for width in (0.0, 0.05):
        servos = {joint: {"backlash": width} for joint in arm.joint_names}
        sim = BatchSim(arm.with_identified(servos), [(0.0, "both", 0.02)], 1)
        sim.reset(slice(None), target, 0.0 * target)
        for _ in range(50):
            sim.step(target)
        paths.append(sim.qpos.copy())
    np.testing.assert_allclose(*paths, atol=1e-9)


def test_a_state_goes_on_with_its_gap(pendulum):
    sim = BatchSim(pendulum.with_identified({"swing": SERVO}), [(0.0, "both", 0.01)], 1)
    sim.reset(slice(None), np.zeros((1, 1)), np.zeros((1, 1)))
    ctrl = command()
    ends = []
    for target in ctrl[:37]:
        sim.step(target[None])
    state = sim.state()
    for _ in range(2):
        sim.set_state(state)
        for target in ctrl[37:80]:
            sim.step(target[None])
        ends.append(sim.qpos.copy())
    np.testing.assert_array_equal(*ends)


def test_exported_servos_move_as_the_simulator(pendulum):
    robot = pendulum.with_identified({"swing": SERVO})
    ctrl = command()[:100]
    meta = SequenceMeta(robot.name, "a", "swing", 0.0, virtual=True)
    (simulated,) = replay([Sequence(meta, robot.joint_names, 0.01, ctrl, ctrl, 0.0 * ctrl)], robot)
    motion = {"ctrl": ctrl, "qpos": ctrl, "qvel": 0.0 * ctrl, "dt": 0.01}
    played = mujoco_servos.play(build_model(robot), simulator_facts(robot, 0.01), motion)
    np.testing.assert_allclose(played, simulated.qpos, atol=1e-6)
