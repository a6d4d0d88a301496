"""The compensator on an arm with weak, late servos: it follows, and stays calm whatever happens."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from arm import TOML, XML, commands, write_arm
from weak_arm import CONFIG, WEAK, Operator

from gaponet.base.errors import LogError, ModelError, RobotError, UsageError
from gaponet.deploy.aligned_sim import AlignedSim
from gaponet.deploy.compensator import Compensator, CompensatorConfig
from gaponet.nn.adaptation import Adaptation
from gaponet.nn.artifact import GapModel, make_card
from gaponet.sim.batch import BatchSim, differing_fields

NOW = CompensatorConfig(blend=0.0)


class WeakArm:
    """The robot: weak servos, commands `late` periods under way and sometimes lost, a payload that
    may change.
    """

    masses = (0.0, 0.4)

    def __init__(self, robot, payload=0.0, late=0, lost=0.0, seed=0):
        weak = robot.with_servo(kp=WEAK * robot.servo.kp)
        self.sim = BatchSim(weak, [(m, "both", robot.dt) for m in (payload, *self.masses)], 1)
        self.late = late
        self.lost = lost
        self.rng = np.random.default_rng(seed)

    def start(self, qpos):
        self.sim.reset(slice(None), np.tile(qpos, (3, 1)), 0.0)
        self.sent = [np.array(qpos)] * (self.late + 1)
        for _ in range(200):
            self.step(np.array(qpos))

    def load(self, heavy):
        for name in differing_fields(list(self.sim.models.values())):
            field = self.sim.batch.expand(name)
            field[0] = field[1 + heavy]

    def step(self, u):
        self.sent.append(self.sent[-1] if self.rng.random() < self.lost else u)
        self.sim.step(np.tile(self.sent[-1 - self.late], (3, 1)))

    @property
    def qpos(self):
        return self.sim.qpos[0].copy()


@pytest.fixture(scope="module")
def robot(tmp_path_factory):
    return write_arm(tmp_path_factory.mktemp("arm"))


@pytest.fixture(scope="module")
def model(robot):
    return GapModel(Path("exact"), make_card(CONFIG, robot, dt=[0.02]), CONFIG, Operator(1.0))


def play(arm, targets, compensator=None, payload=0.0, events=None):
    """Positions and commands, (T, 2) each; events {period: call}."""
    arm.start(targets[0])
    if compensator is not None:
        compensator.reset(targets[0], payload)
    q = []
    u = []
    for t, target in enumerate(targets):
        (events or {}).get(t, lambda: None)()
        q.append(arm.qpos)
        u.append(target if compensator is None else compensator.step(target, arm.qpos))
        arm.step(u[-1])
    return np.array(q), np.array(u)


def error(q, targets, skip=50):
    return float(np.abs(q - targets)[skip:].mean())


def test_with_aim_simulator_the_robot_moves_like_the_nominal_simulator(robot, model):
    targets = commands(200, 1)
    nominal = BatchSim(robot, [(0.2, "both", 0.02)], 1)
    nominal.reset(slice(None), targets[:1], np.zeros((1, 2)))
    for _ in range(200):
        nominal.step(targets[:1])
    expected = []
    for target in targets:
        expected.append(nominal.qpos[0].copy())
        nominal.step(target[None])
    config = replace(NOW, aim="simulator", feedback=0.0)
    raw, _ = play(WeakArm(robot, 0.2), targets)
    q, _ = play(
        WeakArm(robot, 0.2),
        targets,
        Compensator(robot, model, config=config, payload_step=0.1),
        0.2,
    )
    assert error(q, expected) < 0.1 * error(raw, expected)


@pytest.mark.parametrize("given", [{}, {"limit": 0.05}])
def test_a_command_is_no_further_from_its_target_than_the_limit(robot, given):
    soft = robot.with_identified(
        {name: {"kp": 1.0} for name in robot.joint_names}
    )  # gravity asks for more than 0.5 rad
    compensate = Compensator(soft, config=CompensatorConfig(blend=0.0, **given))
    target = np.zeros(2)
    compensate.reset(target)
    sent = [compensate.step(target, target) for _ in range(20)]
    assert np.abs(sent).max() == pytest.approx(given.get("limit", 0.5))


def test_a_command_stays_within_the_range_of_its_joint(robot):
    compensate = Compensator(robot, config=NOW)
    _, high = robot.qpos_range[0]
    target = np.array([high - 0.03, 0.0])
    compensate.reset(target)
    # The shoulder stays behind, and feedback asks for up to 0.1 rad more.
    sent = [compensate.step(target, target - [0.1, 0.0])[0] for _ in range(300)]
    assert max(sent) == high


def test_what_is_measured_changes_nothing_without_feedback(robot, model):
    targets = commands(60, 2)
    one, two = (Compensator(robot, model, config=replace(NOW, feedback=0.0)) for _ in range(2))
    for compensator in (one, two):
        compensator.reset(targets[0], 0.0)
    rng = np.random.default_rng(0)
    for target in targets:
        np.testing.assert_array_equal(one.step(target, rng.normal(0, 1, 2)), two.step(target, None))


def test_commands_blend_in(robot, model):
    target = np.array([0.5, 0.3])
    compensator = Compensator(robot, model, config=CompensatorConfig(blend=1.0))
    compensator.reset(target, 0.4)
    u = np.array([compensator.step(target, None) for _ in range(80)])
    np.testing.assert_array_equal(u[0], target)
    assert np.abs(u[-1] - target).max() > 0.05
    assert np.abs(np.diff(u, axis=0)).max() < 0.1 * np.abs(u[-1] - target).max()


def test_by_default_half_of_the_compensation_is_there_after_half_a_second_and_all_after_one(robot):
    target = np.array([0.5, 0.3])
    whole = Compensator(robot, config=NOW)
    default = Compensator(robot)
    for compensator in (whole, default):
        compensator.reset(target, 0.4)

    wanted = np.array([whole.step(target, None) - target for _ in range(60)])
    given = np.array([default.step(target, None) - target for _ in range(60)])

    assert np.abs(wanted[25]).max() > 0.01
    np.testing.assert_allclose(given[25], wanted[25] / 2, atol=1e-9)
    np.testing.assert_allclose(given[50:], wanted[50:], atol=1e-9)


@pytest.mark.parametrize(("late", "lost"), [(0, 0.0), (4, 0.2)])
def test_steps_of_command_and_payload_die_out(robot, model, late, lost):
    targets = np.repeat([[0.3, -0.2], [-0.4, 0.5], [0.2, 0.2]], 150, axis=0)
    arm = WeakArm(robot, 0.0, late, lost)
    compensator = Compensator(robot, model, config=NOW)

    def load(heavy, mass):
        arm.load(heavy)
        compensator.set_payload(mass)

    events = {200: lambda: load(1, 0.4), 350: lambda: load(0, 0.0)}
    q, u = play(arm, targets, compensator, 0.0, events)
    assert np.abs(u - targets).max() <= NOW.limit + 1e-12
    for end in (150, 300, 450):
        assert np.abs(np.diff(u[end - 20 : end], axis=0)).max() < 1e-3
        assert np.abs(q[end - 20 : end] - targets[end - 20 : end]).max() < 0.02


def test_the_default_feedback_is_stable_on_a_weakly_damped_arm(tmp_path):
    swinging = write_arm(
        tmp_path,
        TOML.replace("kp = 20.0", "kp = 20.0\nkd = 0.0"),
        XML.replace('damping="0.5"', 'damping="0.05"'),
    )
    model = GapModel(Path("exact"), make_card(CONFIG, swinging, dt=[0.02]), CONFIG, Operator(1.0))
    targets = np.repeat([[0.3, -0.2], [-0.4, 0.5]], 400, axis=0)
    calm = {}
    for name, config in (("default", NOW), ("fast", replace(NOW, feedback=5.0, feedback_time=0.0))):
        arm = WeakArm(swinging, 0.4, late=4)
        q, _ = play(arm, targets, Compensator(swinging, model, config=config), 0.4)
        calm[name] = float(np.abs(np.diff(q[-100:], axis=0)).max())
    assert calm["default"] < 1e-3 < calm["fast"]


def test_a_payload_that_is_not_stated_is_estimated(robot, model):
    targets = np.repeat([[0.3, -0.2]], 500, axis=0)
    arm = WeakArm(robot)
    compensator = Compensator(robot, model, config=NOW, payload_step=0.1)
    q, _ = play(arm, targets, compensator, None, {100: lambda: arm.load(1)})
    # the servo law overrates torque by 1 / 0.8
    assert compensator.payload.mass[0] == pytest.approx(0.4, abs=0.12)
    assert np.abs(q[-20:] - targets[-20:]).max() < 0.02
    assert np.abs(np.diff(q[-50:], axis=0)).max() < 1e-3


def test_a_robot_without_a_mount_carries_no_payload(tmp_path):
    handless = write_arm(tmp_path, TOML.split("[[payload_mount]]")[0])
    with pytest.raises(UsageError, match=r"\[\[payload_mount\]\]"):
        Compensator(handless).reset(np.zeros(2), 2.0)


def test_a_robot_that_shall_carry_nothing_is_not_said_to_lack_a_mount(robot):
    empty = Compensator(robot, config=CompensatorConfig(payload_max=0.0))
    with pytest.raises(UsageError, match="up to 0, or raise payload_max"):
        empty.reset(np.zeros(2), 0.5)


def test_a_start_does_not_change_with_the_callers_array(robot):
    compensator = Compensator(robot)
    target = np.array([0.3, -0.2])
    compensator.reset(target, 0.0)
    target[0] = np.nan
    assert np.isfinite(compensator.step(target, np.zeros(2))).all()


def test_a_payload_that_is_stated_during_a_motion_is_no_longer_estimated(robot, model):
    targets = np.repeat([[0.3, -0.2]], 200, axis=0)
    compensator = Compensator(robot, model, config=NOW)
    events = {100: lambda: compensator.set_payload(0.2)}

    play(WeakArm(robot, 0.4), targets, compensator, None, events)

    assert compensator.payload.mass == pytest.approx(0.2, abs=0)


def test_a_payload_is_estimated_from_the_moment_on_at_which_its_torques_suffice(robot):
    """At rest the leverage is the integral of the squared torque per kg, with forgetting, in
    (N·m/kg)² s.
    """
    estimate = Compensator(robot).payload.estimate
    posture = np.array([[1.2, 0.3]])
    empty, full = estimate.gravity(posture[0])
    leverage = float(np.sum(((full - empty) / estimate.max_mass) ** 2))
    needed_s = -np.log(1.0 - 0.4 / leverage)

    certain = []
    for _ in range(500):
        estimate.observe(posture, 0.0 * posture, posture, None, np.array([True]))
        certain.append(bool(estimate.certain[0]))

    assert certain.count(False) * estimate.dt == pytest.approx(needed_s, abs=1.1 * estimate.dt)


@pytest.mark.parametrize(("mass", "contradicts"), [(1.45, False), (1.55, True)])
def test_torques_contradict_a_payload_that_is_wrong_by_more_than_half_of_the_largest(
    robot, mass, contradicts
):
    estimate = Compensator(robot, config=CompensatorConfig(payload_max=3.0)).payload.estimate
    posture = np.array([[1.2, 0.3]])
    empty, full = estimate.gravity(posture[0])
    held = empty + (full - empty) * mass / estimate.max_mass
    for _ in range(500):
        estimate.observe(posture, 0.0 * posture, posture, held[None], np.array([True]))

    assert bool(estimate.contradiction(0.0)) == contradicts


@pytest.mark.parametrize(
    ("held", "told", "doubted"), [(0, 0.4, True), (1, 0.0, True), (0, 0.0, False), (1, 0.4, False)]
)
def test_a_stated_payload_is_compared_with_the_servo_torques(robot, model, held, told, doubted):
    arm = WeakArm(robot, WeakArm.masses[held])
    compensator = Compensator(robot, model, config=NOW, payload_step=0.1)
    play(arm, np.repeat([[0.3, -0.2]], 200, axis=0), compensator, told)
    assert (
        f"{told:g} kg were stated, but the torques are those of about" in compensator.doubt
    ) == doubted
    assert compensator.payload.mass[0] == told


def test_a_payload_stated_at_a_pick_is_not_compared_with_the_torques_before(robot, model):
    arm = WeakArm(robot)
    compensator = Compensator(robot, model, config=NOW, payload_step=0.1)
    doubts = []

    def pick():
        arm.load(1)
        compensator.set_payload(0.4)
        doubts.append(compensator.doubt)

    play(arm, np.repeat([[0.3, -0.2]], 400, axis=0), compensator, 0.0, {200: pick})

    assert doubts == [""]
    assert compensator.doubt == ""


def test_torques_unlike_a_payload_give_mass_zero(robot, model):
    target = np.array([0.3, -0.2])
    compensator = Compensator(robot, model, config=NOW, payload_step=0.1)
    compensator.reset(target, None)
    per_kg = np.subtract(*compensator.payload.estimate.gravity(target)[::-1])
    across = 6.0 * np.array([-per_kg[1], per_kg[0]]) + 2.0 * per_kg  # mostly what no payload does
    torque = compensator.payload.estimate.gravity(target)[0] + across
    for _ in range(200):
        compensator.step(target, target, np.zeros(2), torque)
    assert compensator.payload.mass[0] == 0.0


def test_the_integral_of_a_blocked_joint_is_limited(robot, model):
    target = np.array([0.3, 0.3])
    compensator = Compensator(robot, model, config=replace(NOW, limit=0.05))
    compensator.reset(target, 0.0)
    for _ in range(500):  # 10 s against a stop
        compensator.step(target, np.array([-0.5, -0.5]))
    wound = compensator.feedback.integral.copy()
    assert np.abs(wound).max() <= NOW.feedback_limit
    periods = 0
    while (compensator.limits.saturation > 0).any():  # it slips free, a little beyond the target
        compensator.step(target, np.array([0.4, 0.4]))
        periods += 1
    assert periods <= 50


def test_without_fresh_states_feedback_waits(robot, model):
    compensator = Compensator(robot, model, config=NOW)
    compensator.reset(np.zeros(2), 0.0)
    for _ in range(20):
        compensator.step(np.zeros(2), np.array([0.1, 0.1]))
    before = compensator.feedback.integral.copy()
    compensator.step(np.zeros(2), None)
    np.testing.assert_array_equal(compensator.feedback.integral, before)
    assert (before < 0).all()


def test_several_robots_are_compensated_as_each_alone(robot, model):
    targets = np.stack([commands(40, 0), commands(40, 1)], axis=1)
    both = Compensator(robot, model, config=NOW, num_envs=2, payload_step=0.1)
    both.reset(targets[0], np.array([0.0, 0.3]))
    alone = [Compensator(robot, model, config=NOW, payload_step=0.1) for _ in range(2)]
    for i, c in enumerate(alone):
        c.reset(targets[0, i], (0.0, 0.3)[i])
    for target in targets:
        u = both.step(target, 0.9 * target)
        each = [c.step(a, 0.9 * a) for c, a in zip(alone, target, strict=True)]
        np.testing.assert_allclose(u, each, atol=1e-9)


def test_a_step_before_a_start_is_refused(robot):
    with pytest.raises(UsageError, match="reset"):
        Compensator(robot).step(np.zeros(2), np.zeros(2))


def test_other_arrays_and_robots_are_refused(robot, model):
    with pytest.raises(UsageError, match="joints"):
        Compensator(robot, model).reset(np.zeros(3), 0.0)
    with pytest.raises(UsageError, match="target"):
        Compensator(robot, model).reset(np.array([0.0, np.nan]), 0.0)
    with pytest.raises(LogError, match=r"shoulder .*degrees"):
        Compensator(robot, model).reset(np.array([45.0, 0.0]), 0.0)
    in_degrees = Compensator(robot, model)
    in_degrees.reset(np.zeros(2), 0.0)
    with pytest.raises(LogError, match=r"elbow .*degrees"):
        in_degrees.step(np.zeros(2), np.array([0.0, -45.0]))
    for name, wrong in {
        "gain": 0.0,
        "feedback_limit": -0.1,
        "feedback_time": np.nan,
        "aim": "Simulator",
    }.items():
        with pytest.raises(UsageError, match="gain"):
            CompensatorConfig(**{name: wrong})


def test_dynamic_feed_forward_reduces_the_error_of_a_moving_arm(robot, model):
    targets = commands(150, 1)
    missed = {}
    for dynamics in (False, True):
        compensator = Compensator(robot, model, config=replace(NOW, dynamics=dynamics))
        q, _ = play(WeakArm(robot, 0.2), targets, compensator, 0.2)
        missed[dynamics] = error(q, targets)
    assert missed[True] < 0.6 * missed[False]


def test_without_a_model_what_was_identified_is_fed_forward(robot):
    """Weak servos with friction at rest: known, they follow."""
    law = {"kp": 16.0, "offset": 0.03, "frictionloss": 0.1, "stribeck": 0.1, "stribeck_speed": 0.05}
    identified = robot.with_identified(dict.fromkeys(robot.joint_names, law))
    targets = commands(150, 1)
    missed = {}
    for name, known in (("raw", None), ("nominal", robot), ("identified", identified)):
        arm = BatchSim(identified, [(0.2, "both", 0.02)], 1)
        arm.reset(slice(None), targets[:1], np.zeros((1, 2)), past=targets[None, :1])
        compensator = Compensator(known, config=replace(NOW, dynamics=True)) if known else None
        if compensator:
            compensator.reset(targets[0], 0.2)
        q = []
        for target in targets:
            q.append(arm.qpos[0].copy())
            arm.step((compensator.step(target, q[-1]) if compensator else target)[None])
        missed[name] = error(np.array(q), targets)
    assert missed["identified"] < 0.5 * missed["nominal"] < 0.5 * missed["raw"]


def test_without_a_model_servos_with_other_gains_and_absurd_payloads_are_refused(robot):
    compensator = Compensator(
        robot.with_identified({"elbow": {"kp": 12.0}}), config=CompensatorConfig(payload_max=0.5)
    )
    joints = robot.joint_names
    kd = np.zeros(2)
    # as robot.toml says, not as identified
    compensator.require_gains(joints, np.array([20.0, 20.1]), kd)
    with pytest.raises(RobotError, match="12"):
        compensator.require_gains(joints, np.array([20.0, 12.0]), kd)
    for mass in (np.nan, -1.0, 0.6):
        with pytest.raises(UsageError, match="payload_mass"):
            compensator.reset(np.zeros(2), mass)


def test_payloads_beyond_the_training_data_are_refused_without_extrapolate(robot):
    def trained(*seen):
        return GapModel(
            Path("exact"),
            make_card(CONFIG, robot, dt=[0.02], payload_seen=seen),
            CONFIG,
            Operator(1.0),
        )

    light = Compensator(robot, trained(0.0, 0.2))
    loaded = Compensator(robot, trained(0.1, 0.2))
    light.reset(np.zeros(2), 0.2)
    assert light.payload.masses.max() == 0.2
    for compensator, mass in ((light, 0.3), (loaded, 0.0), (loaded, 0.3)):
        with pytest.raises(ModelError, match="extrapolate"):
            compensator.reset(np.zeros(2), mass)
    with pytest.raises(ModelError, match=r"0\.3"):
        light.set_payload(0.3)
    for mass in (np.nan, -1.0):
        with pytest.raises(UsageError, match="payload_mass"):
            light.set_payload(mass)
    beyond = Compensator(robot, trained(0.0, 0.2), extrapolate=True)
    beyond.reset(np.zeros(2), 0.4)
    assert beyond.payload.masses.max() == 0.4
    with pytest.raises(ModelError):
        AlignedSim(robot, trained(0.0, 0.2), 0.3)
    AlignedSim(robot, trained(0.0, 0.2), 0.3, extrapolate=True)


@pytest.mark.parametrize("payload", [0.2, None], ids=["told", "estimated"])
@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_values_that_are_not_finite_have_no_lasting_effect(robot, model, payload, bad):
    targets = commands(60, 0)
    one, two = (Compensator(robot, model, config=NOW, num_envs=2) for _ in range(2))
    for compensator in (one, two):
        compensator.reset(np.tile(targets[0], (2, 1)), payload)
    q = np.tile(targets[0], (2, 1))
    for k, target in enumerate(np.repeat(targets[:, None], 2, axis=1)):
        spoilt = target.copy()
        state = q.copy()
        force = np.zeros((2, 2))
        if k == 20:
            spoilt[0, 0] = bad
            state[0, 1] = bad
        if k == 25:
            force[0, 0] = bad
        whole = two.step(target, q, np.zeros((2, 2)), np.zeros((2, 2)))
        part = one.step(spoilt, state, np.zeros((2, 2)), force)
        assert np.isfinite(part).all()
        np.testing.assert_array_equal(part[1], whole[1])  # the other robot never notices
        q = q + 0.3 * (target - q)
    np.testing.assert_allclose(part[0], whole[0], atol=0.02)
    assert np.isfinite(one.payload.mass).all()


def test_a_first_position_that_is_missing_is_not_taken_for_degrees(robot, model):
    compensator = Compensator(robot, model, config=NOW)
    compensator.reset(np.zeros(2), 0.0)
    sent = compensator.step(np.zeros(2), np.array([0.0, np.nan]))
    assert np.isfinite(sent).all()


def test_a_first_position_that_is_missing_hides_no_degrees_of_another_robot(robot, model):
    compensator = Compensator(robot, model, config=NOW, num_envs=2)
    compensator.reset(np.zeros((2, 2)), 0.0)
    with pytest.raises(LogError, match=r"elbow .*degrees"):
        compensator.step(np.zeros((2, 2)), np.array([[0.0, np.nan], [0.0, -45.0]]))


def test_an_adapted_unit_follows_where_the_model_alone_does_not(robot):
    ignorant = GapModel(Path("exact"), make_card(CONFIG, robot, dt=[0.02]), CONFIG, Operator(0.0))
    targets = np.tile([0.4, 0.8], (200, 1))
    still = replace(NOW, feedback=0.0)
    servos = {}
    for joint, kp in zip(robot.joint_names, robot.servo.kp, strict=True):
        servos[joint] = {"kp": WEAK * float(kp), "delay": 0.0}
    unit = Adaptation("a", "weights", servos, (), 30.0, 0.0, 0.0)
    error = {}
    for name, adaptation in (("common", None), ("unit", unit)):
        compensator = Compensator(robot, ignorant, config=still, adaptation=adaptation)
        q, _ = play(WeakArm(robot, 0.4), targets, compensator, 0.4)
        error[name] = np.abs(q[1:] - targets[:-1])[100:].mean()
    assert error["unit"] < 0.2 * error["common"]


def test_servos_with_other_gains_than_the_data_are_refused_without_extrapolate(robot):
    card = make_card(CONFIG, robot, dt=[0.02], recorded={"kp": [20.0, 20.0], "kd": None})
    model = GapModel(Path("exact"), card, CONFIG, Operator(1.0))
    joints = robot.joint_names
    kd = np.zeros(2)
    Compensator(robot, model).require_gains(joints, np.array([20.0, 20.1]), kd)
    with pytest.raises(ModelError, match="elbow"):
        Compensator(robot, model).require_gains(joints, np.array([20.0, 10.0]), kd)
    Compensator(robot, model, extrapolate=True).require_gains(joints, np.array([20.0, 10.0]), kd)


def test_without_dt_the_period_is_the_only_one_of_the_models_training(robot):
    quick = GapModel(Path("exact"), make_card(CONFIG, robot, dt=[0.01]), CONFIG, Operator(1.0))
    assert Compensator(robot, quick).shadow.sim.periods.seconds.tolist() == [0.01]


def test_without_dt_the_period_is_the_robots_where_the_model_takes_it(robot):
    measured = GapModel(
        Path("exact"), make_card(CONFIG, robot, dt=[0.02006]), CONFIG, Operator(1.0)
    )
    assert Compensator(robot, measured).shadow.sim.periods.seconds.tolist() == [robot.dt]
