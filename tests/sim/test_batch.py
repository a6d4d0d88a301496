"""Many simulations step exactly as one does."""

import mujoco
import numpy as np
import pytest
from arm import TOML, XML, write_arm

from gaponet.base.errors import UsageError
from gaponet.robot.servo_fields import SERVO_FIELDS, SERVO_TERMS, STOP_FIELDS, TERMS
from gaponet.sim.batch import BatchSim, Condition, OneByOne
from gaponet.sim.commands import speed_limited
from gaponet.sim.model import build_model


def test_a_batch_is_bit_identical_to_mj_step(tmp_path):
    robot = write_arm(tmp_path)
    conditions = [(0.0, "both", 0.02), (0.3, "both", 0.02), (0.3, "both", 0.01)]
    sim = BatchSim(robot, conditions, nthread=2)
    start = np.array([[0.1, -0.2], [0.3, 0.0], [0.0, 0.4]])
    sim.reset(slice(None), start, 0.0)
    targets = np.random.default_rng(0).uniform(-1, 1, (20, 3, 2))
    for target in targets:
        sim.step(target)
    for i, (mass, side, dt) in enumerate(conditions):
        model = build_model(robot, mass, side, dt)
        data = mujoco.MjData(model)
        data.qpos[:] = start[i]
        for target in targets:
            data.ctrl[:] = target[i]
            mujoco.mj_step(model, data, robot.steps_per(dt))
        np.testing.assert_array_equal(sim.qpos[i], data.qpos)
        np.testing.assert_array_equal(sim.qvel[i], data.qvel)


def test_targets_beyond_the_joint_range_are_clipped(tmp_path):
    sim = BatchSim(write_arm(tmp_path), [(0.0, "both", 0.02)])
    sim.step(np.array([[9.0, -9.0]]))
    np.testing.assert_array_equal(sim.commands.ctrl, [[1.5, -1.5]])


@pytest.mark.parametrize("rates", [(0.02, 0.02, 0.02), (0.02, 0.02, 0.01), (0.01, 0.02, 0.02)])
def test_simulations_left_out_of_a_step_stand_still(tmp_path, rates):
    sim = BatchSim(write_arm(tmp_path), [(0.0, "both", dt) for dt in rates])
    sim.step(np.ones((3, 2)), np.array([0, 2]))
    assert (sim.qpos[1] == 0).all()
    assert (sim.qpos[[0, 2]] != 0).any(axis=1).all()


def test_a_delayed_servo_moves_as_one_without_delay_under_earlier_commands(tmp_path):
    robot = write_arm(tmp_path)
    late = robot.with_servo(delay=[0.04, 0.0])
    targets = np.random.default_rng(1).uniform(-1, 1, (25, 2))
    shifted = targets.copy()
    shifted[2:, 0] = targets[:-2, 0]
    sims = [BatchSim(r, [(0.0, "both", 0.02)]) for r in (late, robot)]
    for sim in sims:
        sim.reset(slice(None), np.zeros(2), np.zeros(2), past=targets[None, 1::-1])
    for t in range(2, len(targets)):
        sims[0].step(targets[t][None])
        sims[1].step(shifted[t][None])
        # Between physics steps MuJoCo interpolates: the new target is fully there one physics step
        # later.
        np.testing.assert_allclose(sims[0].qpos, sims[1].qpos, atol=2e-3)
    sims[0].reset(np.array([0]), np.zeros((1, 2)), np.zeros((1, 2)), past=targets[None, 1::-1])
    sims[1].reset(np.array([0]), np.zeros((1, 2)), np.zeros((1, 2)))
    for t in range(2, 6):
        sims[0].step(targets[t][None])
        sims[1].step(shifted[t][None])
    np.testing.assert_allclose(sims[0].qpos, sims[1].qpos, atol=2e-3)


@pytest.mark.parametrize("period", [0.02006, 0.0025, 0.001])
def test_delayed_servos_at_several_rates_step_together_as_each_does_alone(tmp_path, period):
    late = write_arm(tmp_path).with_servo(delay=[0.05, 0.013])
    conditions = [(0.0, "both", 0.02), (0.2, "both", 0.01), (0.0, "both", period)]
    rng = np.random.default_rng(2)
    past = rng.uniform(-1, 1, (3, 60, 2))
    targets = rng.uniform(-1, 1, (80, 3, 2))
    together = BatchSim(late, conditions)
    alone = [BatchSim(late, [c]) for c in conditions]
    together.reset(slice(None), np.zeros((3, 2)), np.zeros((3, 2)), past=past)
    for i, sim in enumerate(alone):
        sim.reset(slice(None), np.zeros((1, 2)), np.zeros((1, 2)), past=past[i : i + 1])
    for target in targets:
        together.step(target)
        for i, sim in enumerate(alone):
            sim.step(target[i : i + 1])
    np.testing.assert_array_equal(together.qpos, np.concatenate([sim.qpos for sim in alone]))


def test_delayed_servos_need_past_targets(tmp_path):
    sim = BatchSim(write_arm(tmp_path).with_servo(delay=0.03), [(0.0, "both", 0.02)])
    with pytest.raises(UsageError, match="past"):
        sim.reset(slice(None), np.zeros((1, 2)), np.zeros((1, 2)))


@pytest.mark.parametrize("delay", [(0.0, 0.0), (0.05, 0.013)])
def test_one_by_one_is_bit_identical_to_mujocos_batch(tmp_path, monkeypatch, delay):
    """Payloads, rates, laws, late servos, steps of some, forces: all that gaponet writes into a
    batch.
    """
    pytest.importorskip("mujoco.batch")
    robot = write_arm(tmp_path).with_servo(
        delay=list(delay), stribeck=[0.1, 0.2], friction_motor=[0.1, 0.0]
    )
    conditions = [(0.0, "both", 0.02), (0.3, "both", 0.02), (0.3, "both", 0.01)]
    rng = np.random.default_rng(3)
    past = rng.uniform(-1, 1, (8, 3, 2))
    targets = rng.uniform(-1, 1, (20, 3, 2))
    pushes = rng.uniform(-1, 1, (20, 3, 2))

    def moved():
        """A simulation of these targets and pushes, and what it had after each period."""
        sim = BatchSim(robot, conditions)
        force = sim.batch.bind("qfrc_applied")
        bias = sim.batch.bind("qfrc_bias")
        sim.batch.expand("dof_damping")[1] *= 2
        sim.reset(slice(None), past[0], past[1], past=past[:6].transpose(1, 0, 2))
        path = []
        for t, target in enumerate(targets):
            force[:] = pushes[t]
            sim.step(target, np.array([0, 2]) if t % 3 == 0 else None)
            torque = sim.torque[[0, 0, 2]]  # always of those that moved
            seen = [sim.qpos.copy(), sim.qvel.copy(), torque]
            look_ahead(sim)
            path.append([*seen, bias.copy()])
        np.testing.assert_array_equal(sim.batch.get_data(1).qpos, sim.qpos[1])
        return sim, np.array(path)

    together, path = moved()
    monkeypatch.setattr("gaponet.sim.batch.Batch", OneByOne)
    alone, same_path = moved()
    np.testing.assert_array_equal(path, same_path)
    assert not isinstance(together.batch, OneByOne)
    assert isinstance(alone.batch, OneByOne)
    # A look at what follows from a state leaves each simulation the torque of its own step.
    alone.step(targets[0])
    torque = alone.torque.copy()
    look_ahead(alone)
    np.testing.assert_array_equal(alone.torque, torque)
    assert len(np.unique(torque, axis=0)) == 3


def look_ahead(sim):
    """Compute what follows from positions and speeds."""
    sim.batch.forward(stage=mujoco.mjtStage.mjSTAGE_VEL.value)


@pytest.mark.parametrize("rates", [(0.02, 0.02), (0.01, 0.02)])
def test_a_speed_limited_servo_moves_as_another_under_ramped_commands(tmp_path, rates):
    robot = write_arm(tmp_path)
    slow = robot.with_servo(target_speed=[0.5, 0.0])
    jumps = np.repeat(np.random.default_rng(2).uniform(-1, 1, (3, 2, 2)), 30, axis=0)
    speed = np.array([0.5, np.inf])
    ramps = np.zeros_like(jumps)
    for i, dt in enumerate(rates):
        ramps[:, i] = speed_limited(jumps[:, i], np.zeros(2), speed, dt)
    conditions = [(0.0, "both", dt) for dt in rates]
    sims = [BatchSim(slow, conditions), BatchSim(robot, conditions)]
    for sim in sims:
        sim.reset(slice(None), np.zeros(2), 0.0, past=jumps[0][:, None])
    assert (np.abs(np.diff(ramps[:, 0, 0])) <= 0.5 * rates[0] + 1e-12).all()
    for t, both in enumerate(zip(jumps, ramps, strict=True)):
        for sim, target in zip(sims, both, strict=True):
            sim.step(target)
        if t == 40:  # a state holds how far the ramp has come
            state = sims[0].state()
            sims[0].step(np.ones((2, 2)))
            sims[0].set_state(state)
    np.testing.assert_array_equal(sims[0].qpos, sims[1].qpos)


def test_ramps_of_simulations_left_out_of_a_step_stand_still(tmp_path):
    sim = BatchSim(
        write_arm(tmp_path).with_servo(target_speed=[0.5, 0.5]), [(0.0, "both", 0.02)] * 2
    )
    sim.reset(slice(None), np.zeros(2), 0.0)
    sim.step(np.ones((2, 2)), np.array([1]))
    np.testing.assert_allclose(sim.commands.ctrl, [[0, 0], [0.01, 0.01]])


OTHER = {
    "kp": 11.0,
    "kd": 0.7,
    "effort_limit": 0.4,
    "damping": 0.9,
    "armature": 0.05,
    "frictionloss": 0.3,
    "delay": 0.013,
    "offset": 0.1,
    "zero": 0.2,
    "target_speed": 0.4,
    "stribeck": 0.2,
    "stribeck_speed": 0.3,
    "friction_motor": 0.4,
    "friction_external": 0.4,
    "min_torque": 0.5,
    "encoder_step": 0.05,
    "no_load_speed": 1.0,
    "backlash": 0.3,
}


@pytest.mark.parametrize("field", sorted(set(SERVO_FIELDS) - {*STOP_FIELDS, *TERMS["temperature"]}))
def test_servos_set_in_a_batch_move_as_a_robot_made_with_them(tmp_path, field):
    """One joint's value changes; the other joint keeps the robot's own."""
    robot = write_arm(tmp_path, xml=XML.replace('range="-1.5 1.5"', 'range="-1.5 1.5" ref="0.1"'))
    base = {"damping": 0.5, "frictionloss": 0.05, "armature": 0.02, "kd": 0.3}
    if field == "delay":
        base["delay"] = 0.02
    if field in SERVO_TERMS:
        base |= dict.fromkeys(SERVO_TERMS, 0.02)
        base["no_load_speed"] = 9.0
    robot = robot.with_identified(dict.fromkeys(robot.joint_names, base))
    other = robot.with_identified({"elbow": {field: OTHER[field]}})
    condition = (0.0, "both", 0.02)
    changed = BatchSim(robot, [condition])
    given = {name: other.servo[name][1:][None] for name in (*base, "kp", "offset", field)}
    changed.set_servos(("elbow",), given)
    targets = np.repeat(np.random.default_rng(5).uniform(-1, 1, (4, 1, 2)), 15, axis=0)
    own = driven(BatchSim(robot, [condition]), targets)
    made = driven(BatchSim(other, [condition]), targets)
    assert np.abs(own - made).max() > 1e-3
    # Friction holds a little less firmly where MuJoCo computed a joint's mobility with another
    # armature.
    tolerance = 1e-4 if field == "armature" else 1e-12
    np.testing.assert_allclose(driven(changed, targets), made, atol=tolerance)


def test_damping_below_zero_is_taken_from_kd_in_one_ratio_at_other_gains(tmp_path):
    robot = write_arm(tmp_path, TOML.replace("kp = 20.0", "kp = 20.0\nkd = 2.0"))
    values = {"kp": 20.0, "damping": -0.8, "frictionloss": 0.05, "armature": 0.02, "offset": 0.0}
    half = Condition(0.0, "both", 0.02, kp=(20.0, 20.0), kd=(1.0, 1.0))
    changed = BatchSim(robot, [half])
    changed.set_servos(
        robot.joint_names, {name: np.full((1, 2), value) for name, value in values.items()}
    )
    fitted = robot.with_identified(dict.fromkeys(robot.joint_names, values))
    targets = np.repeat(np.random.default_rng(5).uniform(-1, 1, (4, 1, 2)), 15, axis=0)
    made = driven(BatchSim(fitted, [half]), targets)
    np.testing.assert_allclose(driven(changed, targets), made, atol=1e-12)


def driven(sim, targets):
    """Positions of a simulation after each target, (T, 1, 2) rad."""
    sim.reset(slice(None), np.zeros((1, 2)), 0.0, past=targets[0][:, None])
    path = []
    for target in targets:
        sim.step(target)
        path.append(sim.qpos.copy())
    return np.array(path)


@pytest.mark.parametrize("field", [*STOP_FIELDS, "delay", *SERVO_TERMS])
def test_a_value_that_simulations_cannot_take_is_refused(tmp_path, field):
    robot = write_arm(tmp_path)
    sim = BatchSim(robot, [(0.0, "both", 0.02)])
    fields = ("kp", "damping", "frictionloss", "armature", "offset", field)
    values = dict.fromkeys(fields, np.full((1, 1), 0.1))
    with pytest.raises(UsageError, match=field):
        sim.set_servos(("elbow",), values)
