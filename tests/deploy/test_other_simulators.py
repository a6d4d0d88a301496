"""A network that was trained in many simulators corrects one that it has never seen."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import mujoco
import numpy as np
import pytest
from arm import recordings, write_arm, write_dataset

from gaponet.base.errors import ModelError
from gaponet.deploy.aligned_sim import AlignedSim
from gaponet.deploy.mujoco_loop import MujocoAligner
from gaponet.evaluation.evaluate import evaluate
from gaponet.export.torch_program import export_program
from gaponet.nn.config import ModelConfig
from gaponet.nn.training.config import Budget, PPOConfig, PretrainingConfig, TrainConfig
from gaponet.nn.training.trainer import Trainer
from gaponet.robot.mjcf import compile_spec
from gaponet.robot.simulator_change import SimulatorRanges
from gaponet.robot.spec import RobotSpec
from gaponet.sim.model import build_model, build_spec

SIMULATORS = 30
OTHER_KP = 0.7  # of the robot's
CONFIG = TrainConfig(
    model=ModelConfig(history=2, branch_hidden=(32,), trunk_hidden=(16,)),
    pretraining=PretrainingConfig(
        rounds=2, num_envs=48, steps=60, gradient_steps=200, batch_size=256, sensor_states=512
    ),
    ppo=PPOConfig(num_envs=48, num_steps=8, epochs=1, critic_warmup=1, explained=-1e9),
    simulators=SIMULATORS,
    simulator_ranges=SimulatorRanges(kp=(0.4, 2.5), damping=(0.4, 2.5)),
    threads=1,
)


@pytest.fixture(scope="module")
def trained(tmp_path_factory: pytest.TempPathFactory) -> SimpleNamespace:
    place = tmp_path_factory.mktemp("many")
    robot = write_arm(place)
    data = write_dataset(place / "data", robot, recordings(robot, 8, kp=0.5, delay=2))
    run = place / "run"
    model = Trainer(data, robot, run, CONFIG, Budget(steps=2 * 48 * 60)).run()
    return SimpleNamespace(robot=robot, data=data, run=run, model=model)


def test_an_actuator_of_a_tendon_drives_no_joint(tmp_path):
    robot = write_arm(tmp_path)
    scene = build_spec(robot)
    scene.add_tendon(name="both").wrap_joint("elbow", 1.0)
    pull = scene.add_actuator(name="pull", target="both", trntype=mujoco.mjtTrn.mjTRN_TENDON)
    pull.set_to_position(kp=0.0)
    aligner = MujocoAligner(robot, compile_spec(scene, robot.mjcf), dt=0.02, payload_mass=0.0)
    assert list(aligner.actuator) == [0, 1]


def with_kp(robot: RobotSpec, factor: float) -> RobotSpec:
    """Return the robot as another simulator has it, with other stiffness."""
    return robot.with_servo(kp=factor * robot.servo.kp)


def late(robot: RobotSpec) -> RobotSpec:
    """Return the robot with servos that are later than a transfer allows."""
    return with_kp(robot, OTHER_KP).with_servo(delay=robot.servo.delay + 0.012)


def positions(robot: RobotSpec, step) -> np.ndarray:
    """Return what `step`, target → positions, does under a moving target, (30, n) rad."""
    wave = 0.3 * np.sin(0.3 * np.arange(30))[:, None] * np.ones(len(robot.joint_names))
    return np.array([step(robot.qpos_home + target) for target in wave])


def test_it_corrects_a_simulator_with_other_gains_that_it_has_not_seen(trained) -> None:
    other = with_kp(trained.robot, OTHER_KP)

    methods = evaluate([trained.run], trained.data, trained.robot, target=other).result["methods"]

    assert methods["told"]["mpjae"] < 0.8 * methods["uncorrected"]["mpjae"]


def test_where_no_transfer_is_possible_the_evaluation_says_so_and_shows_the_rest(trained) -> None:
    result = evaluate([trained.run], trained.data, trained.robot, target=late(trained.robot)).result

    assert "told" in result["methods"]
    assert "transfer" not in result["methods"]
    assert "later" in " ".join(result["notes"])


def test_another_robot_is_refused_at_any_rate(trained) -> None:
    other = replace(trained.robot, name="another")

    for dt in (trained.robot.dt, trained.robot.dt / 2):
        with pytest.raises(ModelError, match="made"):
            AlignedSim(other, trained.model, dt=dt)


def test_the_exact_transfer_comes_first(trained) -> None:
    sim = AlignedSim(with_kp(trained.robot, OTHER_KP), trained.model)

    assert sim.transfer is not None


def test_a_simulator_that_cannot_be_transferred_is_corrected_by_its_answers(trained) -> None:
    sim = AlignedSim(late(trained.robot), trained.model)

    assert sim.transfer is None
    told = sim.loop.network_input
    context = told.x[0, told.layout.context]
    assert np.abs(context - trained.model.nominal_context).max() > 1e-3


def test_a_simulator_with_neither_is_refused(trained) -> None:
    far = with_kp(trained.robot, 4.0).with_servo(delay=trained.robot.servo.delay + 0.1)

    with pytest.raises(ModelError, match="later"):
        AlignedSim(far, trained.model)


def test_a_scene_moves_like_the_aligned_simulator(trained) -> None:
    robot = late(trained.robot)
    aligned = AlignedSim(robot, trained.model)
    scene = build_model(robot)
    data = mujoco.MjData(scene)
    align = MujocoAligner(trained.model, scene, dt=robot.dt, payload_mass=0.0)

    def step_aligned(target: np.ndarray) -> np.ndarray:
        aligned.step(target)
        return aligned.qpos.copy()

    def step_scene(target: np.ndarray) -> np.ndarray:
        data.ctrl[:] = align(data, target)
        mujoco.mj_step(scene, data, round(robot.dt / scene.opt.timestep))
        return data.qpos.copy()

    aligned.reset(robot.qpos_home)
    data.qpos[:] = robot.qpos_home
    difference = positions(robot, step_aligned) - positions(robot, step_scene)

    assert align.transfer is None
    assert np.abs(difference).max() < 1e-5


def test_the_torch_program_equals_the_network_in_the_simulator_of_training(
    trained, tmp_path
) -> None:
    assert export_program(trained.model, trained.run, tmp_path) < 1e-5
