"""The aligned simulator is the replay with the model's corrector, whichever way it is stepped."""

import mujoco
import numpy as np
import pytest
from arm import TOML, commands, recordings, write_arm
from runs import small_model

from gaponet.base.errors import ModelError, UsageError
from gaponet.deploy.aligned_sim import AlignedSim, AlignedSimOptions
from gaponet.deploy.compensator import Compensator
from gaponet.deploy.mujoco_loop import MujocoAligner
from gaponet.robot.folder import save_robot
from gaponet.sim.model import build_model
from gaponet.sim.replay import replay


@pytest.fixture(scope="module")
def robot(tmp_path_factory):
    return write_arm(tmp_path_factory.mktemp("arm"))


@pytest.fixture(scope="module")
def model(robot, tmp_path_factory):
    run = tmp_path_factory.mktemp("run")
    save_robot(robot, run / "robot")
    return small_model(robot, run / "model")


def stacked(sequences, name, t):
    """A field of all sequences at one time, (sequences, joints)."""
    return np.stack([getattr(s, name)[t] for s in sequences])


def test_it_is_the_replay_with_the_corrector(robot, model):
    sequences = recordings(robot, 3, rows=40, kp=0.7)
    replays = replay(sequences, robot, model.corrector(robot))
    payloads = np.array([s.meta.payload_mass for s in sequences])
    sim = AlignedSim(robot, model, payloads, num_envs=3)
    sim.reset(stacked(sequences, "qpos", 0), stacked(sequences, "qvel", 0))
    for t in range(39):
        target = stacked(sequences, "ctrl", t)
        sim.step(target)
        corrected = stacked(replays, "ctrl", t)
        np.testing.assert_allclose(sim.delta, corrected - target, atol=1e-6)
        np.testing.assert_allclose(sim.qpos, stacked(replays, "qpos", t + 1), atol=1e-6)
    assert np.abs(sim.delta).max() > 1e-3


def test_without_a_model_it_is_the_nominal_simulator(robot):
    sequence = recordings(robot, 1, rows=30)[0]
    sim = AlignedSim(robot, None)
    sim.reset(sequence.qpos[0], sequence.qvel[0])
    for t in range(29):
        sim.step(sequence.ctrl[t])
        np.testing.assert_allclose(sim.qpos, sequence.qpos[t + 1], atol=1e-9)
        np.testing.assert_array_equal(sim.delta, 0.0)


def test_one_simulation_takes_flat_arrays(robot, model):
    one = AlignedSim(robot, model, 0.2)
    two = AlignedSim(robot, model, 0.2, num_envs=2)
    for target in commands(20, 0):
        one.step(target)
        two.step(np.stack([target, target]))
    assert one.qpos.shape == one.qvel.shape == one.delta.shape == (2,)
    np.testing.assert_allclose(two.qpos, np.stack([one.qpos, one.qpos]), atol=1e-6)


def test_the_home_position_has_the_joints_of_the_simulation(tmp_path):
    shoulder = 'name = "shoulder"\noperated = false\nhome = 0.3'
    elbow = 'name = "elbow"\nhome = 0.2'
    toml = TOML.replace('name = "shoulder"', shoulder).replace('name = "elbow"', elbow)
    robot = write_arm(tmp_path, toml)
    sim = AlignedSim(robot, options=AlignedSimOptions(locked=("shoulder",)))
    np.testing.assert_array_equal(sim.qpos_home, [0.2])


def test_one_of_several_simulations_can_be_reset(robot, model):
    sim = AlignedSim(robot, model, num_envs=2)
    fresh = AlignedSim(robot, model)
    for target in commands(15, 0):
        sim.step(target)
    before = sim.delta
    sim.reset(np.array([[0.1, -0.1]]), ids=np.array([1]))
    np.testing.assert_array_equal(sim.delta, [before[0], [0.0, 0.0]])
    fresh.reset(np.array([0.1, -0.1]))
    for target in commands(15, 1):
        sim.step(target)
        fresh.step(target)
    np.testing.assert_allclose(sim.qpos[1], fresh.qpos, atol=1e-6)


def test_late_servos_follow_the_target_in_force_at_the_start(robot, tmp_path):
    late = robot.with_servo(delay=[0.05, 0.0])
    model = small_model(late, tmp_path)
    sequences = recordings(robot, 1, rows=20)
    simulated = replay(sequences, late, model.corrector(late))[0]
    sim = AlignedSim(late, model)
    sim.reset(sequences[0].qpos[0], sequences[0].qvel[0], sequences[0].ctrl[0])
    for t in range(19):
        sim.step(sequences[0].ctrl[t])
    np.testing.assert_allclose(sim.qpos, simulated.qpos[-1], atol=1e-6)


def test_a_users_mujoco_loop_is_aligned_by_one_call_per_period(robot, model):
    mj_model = build_model(robot, 0.2)
    data = mujoco.MjData(mj_model)
    align = MujocoAligner(model, mj_model, dt=0.02, payload_mass=0.2)
    sim = AlignedSim(robot, model, 0.2)
    for _ in range(2):
        mujoco.mj_resetData(mj_model, data)
        align.reset()
        sim.reset()
        for target in commands(25, 3):
            data.ctrl[:] = align(data, target)
            mujoco.mj_step(mj_model, data, robot.decimation)
            sim.step(target)
        np.testing.assert_allclose(data.qpos, sim.qpos, atol=1e-6)


def test_other_rates_simulators_and_locked_joints_are_refused(robot, model, tmp_path):
    with pytest.raises(ModelError, match=r"40\.0"):
        AlignedSim(robot, model, dt=0.025)
    bare = small_model(robot, tmp_path / "model")
    other = write_arm(tmp_path, TOML.replace("kp = 20.0", "kp = 21.0"))
    with pytest.raises(ModelError, match="beside"):
        AlignedSim(other, bare)
    with pytest.raises(UsageError, match="locked"):
        AlignedSim(robot, model, options=AlignedSimOptions(locked=("elbow",)))


@pytest.mark.parametrize("target", [[0.1], [0.1, 0.2, 0.3], 0.1, [np.nan, 0.1]])
def test_targets_that_are_no_finite_number_for_each_joint_are_refused(robot, target):
    sim = AlignedSim(robot)
    sim.step([0.1, 0.2])
    before = sim.qpos.copy()
    with pytest.raises(UsageError, match=r"AlignedSim\.step"):
        sim.step(target)
    assert np.array_equal(sim.qpos, before)


def test_a_robot_may_be_named(tmp_path):
    robot = write_arm(tmp_path / "arm")
    assert AlignedSim(str(robot.mjcf.parent)).joint_names == robot.joint_names
    assert Compensator(robot.mjcf.parent, dt=robot.dt).robot.joint_names == robot.joint_names


def test_a_scene_that_does_not_fit_is_refused(robot, model):
    mj_model = build_model(robot)
    with pytest.raises(ModelError, match=r"50\.0"):
        MujocoAligner(model, mj_model, dt=0.025, payload_mass=0.0)
    with pytest.raises(ModelError, match="left/shoulder"):
        MujocoAligner(model, mj_model, dt=0.02, payload_mass=0.0, prefix="left/")


def test_a_scene_without_actuators_is_refused(robot):
    scene = mujoco.MjModel.from_xml_path(str(robot.mjcf))
    assert scene.nu == 0

    with pytest.raises(ModelError, match="actuator"):
        MujocoAligner(robot, scene, dt=0.02, payload_mass=0.0)


def test_a_scene_moves_like_an_identified_robot_without_a_model(robot):
    law = {"kp": 15.0, "frictionloss": 0.05, "stribeck": 0.05, "stribeck_speed": 0.1}
    known = robot.with_identified(dict.fromkeys(robot.joint_names, law))
    mj_model = build_model(robot, 0.2)
    data = mujoco.MjData(mj_model)
    align = MujocoAligner(known, mj_model, dt=0.02, payload_mass=0.2)
    sim = AlignedSim(known, None, 0.2)
    plain = AlignedSim(robot, None, 0.2)
    apart = []
    for target in commands(60, 3):
        data.ctrl[:] = align(data, target)
        mujoco.mj_step(mj_model, data, robot.decimation)
        sim.step(target)
        plain.step(target)
        apart.append([np.abs(sim.qpos - other).max() for other in (data.qpos, plain.qpos)])
    aligned, nominal = np.mean(apart, axis=0)
    assert aligned < 0.1 * nominal
    assert (
        MujocoAligner(robot, mj_model, dt=0.02, payload_mass=0.2).transfer is None
    )  # it moves so of itself


def test_a_network_on_a_simulator_with_backlash_is_transferred_to_a_scene_without(robot, tmp_path):
    gap = {"backlash": 0.05}
    loose = robot.with_identified(dict.fromkeys(robot.joint_names, gap))
    save_robot(loose, tmp_path / "robot")
    model = small_model(loose, tmp_path / "model")

    align = MujocoAligner(model, build_model(robot), dt=0.02, payload_mass=0.0)

    assert align.transfer is not None
