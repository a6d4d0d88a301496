"""A simulator is told to move as another one does, whatever differs between them."""

from dataclasses import replace

import mujoco
import numpy as np
import pytest
from arm import TOML, XML, commands, write_arm
from runs import corrects_by

from gaponet.base.errors import ModelError
from gaponet.deploy.aligned_sim import AlignedSim, AlignedSimOptions
from gaponet.deploy.compensator import Compensator, CompensatorConfig
from gaponet.deploy.mujoco_loop import MujocoAligner
from gaponet.robot.spec import Scene, Table, Tip
from gaponet.sim.model import build_model

STRONG = TOML.replace("effort_limit = 5.0", "effort_limit = 50.0")
ONE_STEP = STRONG.replace(
    "timestep = 0.005", "timestep = 0.02"
)  # a period: nothing happens within it
HEAVY = XML.replace('armature="0.02"', 'armature="0.1"')
TARGETS = np.concatenate([commands(60, 5), commands(60, 6)])  # with a jump
PUSHED = slice(30, 40)


@pytest.fixture(scope="module")
def robot(tmp_path_factory):
    return write_arm(tmp_path_factory.mktemp("arm"), STRONG, HEAVY)


@pytest.fixture(scope="module")
def model(robot, tmp_path_factory):
    return corrects_by(0.05, robot, tmp_path_factory.mktemp("run"))


def other(robot, **factors):
    """The robot with some of its numbers multiplied."""
    model = build_model(robot)
    own = {f: getattr(model, f"dof_{f}") for f in ("damping", "frictionloss", "armature")} | {
        "kp": robot.servo.kp
    }
    return robot.with_servo(**{f: factor * own[f] for f, factor in factors.items()})


def follow(sim, targets=TARGETS, push=0.0, repeat=1):
    """Positions at each row under targets, from rest; a push is a torque on both joints for a
    while.
    """
    sim.reset(targets[0], ctrl=targets[0])
    applied = sim.sim.batch.bind("qfrc_applied")
    out = []
    for t, target in enumerate(targets):
        applied[:] = push * (PUSHED.start <= t < PUSHED.stop)
        for _ in range(repeat):
            sim.step(target)
        out.append(sim.qpos.copy())
    return np.array(out)


def test_twice_the_gain_follows_the_reference_to_a_microradian(tmp_path):
    reference = write_arm(tmp_path / "arm", ONE_STEP, HEAVY)
    target = other(reference, kp=2.0)
    there = follow(AlignedSim(reference, None))
    assert np.abs(follow(AlignedSim(target, None)) - there).max() > 0.05
    np.testing.assert_allclose(
        follow(AlignedSim(target, reference, extrapolate=True)), there, atol=1e-6
    )


@pytest.mark.parametrize(
    "factors",
    [
        {"kp": 0.5},
        {"kp": 2.2, "frictionloss": 3.0},
        {"damping": 2.0, "armature": 2.0},
        {"frictionloss": 0.0},
    ],
)
def test_the_target_moves_like_the_reference_with_its_model(robot, model, factors):
    there = follow(AlignedSim(robot, model))
    target = other(robot, **factors)
    apart = np.abs(follow(AlignedSim(target, model)) - there).mean()
    assert apart < 0.002 < 0.1 * np.abs(follow(AlignedSim(target, None)) - there).mean()


def test_transfer_follows_saturated_motors(tmp_path):
    weak, strong = (
        write_arm(tmp_path / limit, TOML.replace("effort_limit = 5.0", f"effort_limit = {limit}"))
        for limit in ("1.0", "5.0")
    )
    there = follow(AlignedSim(weak, None, 0.2))
    target = other(weak, kp=3.0)
    assert np.abs(follow(AlignedSim(strong, None, 0.2)) - there).max() > 0.05
    alone, given = (
        np.abs(follow(AlignedSim(target, like, 0.2)) - there).mean() for like in (None, weak)
    )
    assert given < 0.1 * alone


def mean_distance(motion, other):
    """Of all joints and periods, rad."""
    return np.abs(motion - other).mean()


def test_jumps_that_saturate_motors_cause_no_windup(tmp_path):
    weak = write_arm(tmp_path, TOML.replace("effort_limit = 5.0", "effort_limit = 0.7"), HEAVY)
    jumps = np.repeat([[-0.6, -0.6], [0.6, 0.6], [-0.6, -0.6]], [20, 60, 60], axis=0)
    there = follow(AlignedSim(weak, None), jumps)
    target = other(weak, kp=0.5)
    alone = mean_distance(follow(AlignedSim(target, None), jumps), there)
    given = mean_distance(follow(AlignedSim(target, weak), jumps), there)
    assert given < 0.1 * alone


def test_a_payload_that_the_simulator_does_not_know_of(robot, model):
    there = follow(AlignedSim(robot, model, 0.2))
    sim = AlignedSim(robot, model, 0.2, options=AlignedSimOptions(simulator_payload=0.0))
    assert mean_distance(follow(sim), there) < 0.001
    assert mean_distance(follow(AlignedSim(robot, model, 0.0)), there) > 0.01


def test_at_twice_the_control_rate_the_model_keeps_its_own_rate(robot, model):
    there = follow(AlignedSim(robot, model))
    quick = AlignedSim(other(robot, kp=2.0), model, dt=robot.dt / 2)
    assert mean_distance(follow(quick, repeat=2), there) < 0.001
    with pytest.raises(ModelError, match=r"40\.0"):
        AlignedSim(robot, model, dt=0.025)


def test_another_integrator_and_offsets(robot, model, tmp_path):
    there = follow(AlignedSim(robot, model))
    euler = write_arm(tmp_path, STRONG, HEAVY.replace("implicitfast", "Euler"))
    for target in (euler, robot.with_servo(offset=np.array([0.05, -0.03]))):
        assert mean_distance(follow(AlignedSim(target, model)), there) < 0.001


@pytest.fixture
def late(robot):
    """A reference whose servos are late."""
    return robot.with_servo(delay=np.array([0.03, 0.02]))


def test_servos_that_are_late_like_the_reference_follow_it(robot, late):
    there = follow(AlignedSim(late, None))
    equally_late = other(robot, kp=1.5).with_servo(delay=late.servo.delay)
    same = mean_distance(follow(AlignedSim(equally_late, late)), there)
    without = mean_distance(follow(AlignedSim(robot, None)), there)
    assert same < 0.2 * without


def test_servos_that_are_later_than_the_reference_are_refused_or_at_least_not_made_worse(
    robot, late
):
    there = follow(AlignedSim(late, None))
    with pytest.raises(ModelError, match="40 ms"):
        AlignedSim(robot.with_servo(delay=np.array([0.03, 0.06])), late)
    later = robot.with_servo(delay=np.array([0.06, 0.06]))
    given = follow(AlignedSim(later, late, extrapolate=True))
    alone = follow(AlignedSim(later, None, extrapolate=True))
    assert mean_distance(given, there) <= mean_distance(alone, there)


def test_transfer_is_causal(robot, model):
    target = other(robot, kp=2.0)
    changed = TARGETS.copy()
    changed[80:] += 0.3
    np.testing.assert_array_equal(
        *(follow(AlignedSim(target, model), rows)[:80] for rows in (TARGETS, changed))
    )


@pytest.mark.parametrize("factors", [{"kp": 2.0}, {"damping": 0.5}, {"frictionloss": 3.0}])
def test_transfer_reduces_the_difference_in_contact_and_under_a_push(robot, factors):
    tipped = replace(robot, scene=Scene(tips=(Tip("fore", (0.2, 0.0, 0.0), 0.01),)))
    reference = other(tipped, kp=0.8, damping=1.5)
    target = other(tipped, **factors)
    for plane, push in ((Table(-0.1, 0.3, 2e3), 0.0), (None, 1.0)):
        there = follow(AlignedSim(reference.with_table(plane), None), push=push)
        here = target.with_table(plane)
        given = mean_distance(follow(AlignedSim(here, reference), push=push), there)
        alone = mean_distance(follow(AlignedSim(here, None), push=push), there)
        assert given < 0.2 * alone


def test_in_the_simulator_of_training_nothing_is_transferred(robot, model):
    assert AlignedSim(robot, model).transfer is None
    assert AlignedSim(other(robot, kp=1.5), model).transfer is not None


def test_a_simulator_outside_the_measured_range_is_refused(robot, model):
    far = other(robot, kp=9.0)
    with pytest.raises(ModelError, match=r"shoulder.* kp"):
        AlignedSim(far, model)
    AlignedSim(far, model, extrapolate=True)


def scene(robot):
    """The robot in a compiled scene of somebody else's, with a ball lying about."""
    spec = mujoco.MjSpec.from_string(robot.mjcf.read_text())
    for name in robot.joint_names:
        actuator = spec.add_actuator(name=name, target=name, trntype=mujoco.mjtTrn.mjTRN_JOINT)
        actuator.set_to_position(kp=40.0)
    ball = spec.worldbody.add_body(name="ball", pos=(3.0, 0.0, 0.0))
    ball.add_freejoint()
    ball.add_geom(size=(0.02, 0.0, 0.0), mass=0.1)
    spec.option.timestep = 0.002
    return spec.compile()


def test_a_users_scene_moves_like_the_reference_with_its_model(robot, model):
    there = follow(AlignedSim(robot, model, 0.2))
    mj_model = scene(robot)
    align = MujocoAligner(model, mj_model, dt=0.02, payload_mass=0.2)
    apart = []
    for correct in (align, lambda data, target: target):
        data = mujoco.MjData(mj_model)
        data.qpos[:2] = TARGETS[0]
        out = []
        for target in TARGETS:
            data.ctrl[:] = correct(data, target)
            mujoco.mj_step(mj_model, data, 10)
            out.append(data.qpos[:2].copy())
        apart.append(np.abs(np.array(out) - there).mean())
    assert apart[0] < 0.1 * apart[1]


def test_in_a_scene_equal_to_the_simulator_of_training_nothing_is_transferred(robot, model):
    assert MujocoAligner(model, build_model(robot), dt=0.02, payload_mass=0.0).transfer is None
    assert MujocoAligner(model, build_model(robot), dt=0.02, payload_mass=0.2).transfer is not None


def test_the_compensator_takes_the_simulator_of_the_run(robot, model):
    stiff = other(robot, kp=2.0)
    assert Compensator(stiff, model).robot.servo.kp[0] == robot.servo.kp[0]
    with pytest.raises(ModelError, match="aim"):
        Compensator(stiff, model, config=CompensatorConfig(aim="simulator"))
