"""An arm that is commanded to move as its nominal simulator does: it does, and stays calm whatever
happens.
"""

from dataclasses import replace

import numpy as np
import pytest
from arm import TOML, commands, write_arm

from gaponet.base.errors import ModelError, UsageError
from gaponet.deploy.compensator import Compensator, CompensatorConfig
from gaponet.sim.batch import BatchSim

NOW = CompensatorConfig(blend=0.0)
TARGETS = np.concatenate([commands(150, 5), commands(150, 6)])  # with a jump
SERVO = {"kp": 13.0, "offset": 0.04, "damping": 1.2, "frictionloss": 0.3, "armature": 0.05}
SKIP = 50  # periods


@pytest.fixture(scope="module")
def robot(tmp_path_factory):
    return write_arm(tmp_path_factory.mktemp("arm"))


def identified(robot, **other):
    return robot.with_identified(dict.fromkeys(robot.joint_names, SERVO | other))


def play(robot, targets, compensator=None, payload=0.0):
    """Return positions and commands, (T, 2) rad, of a simulated robot from rest."""
    sim = BatchSim(robot, [(payload, "both", robot.dt)], 1)
    sim.reset(slice(None), targets[:1], np.zeros((1, 2)), past=targets[None, :1])
    for _ in range(200):
        sim.step(targets[:1])
    if compensator is not None:
        compensator.reset(targets[0], payload)
    positions = []
    sent = []
    for target in targets:
        positions.append(sim.qpos[0].copy())
        command = target
        if compensator is not None:
            command = compensator.step(target, positions[-1])
        sent.append(command)
        sim.step(command[None])
    return np.array(positions), np.array(sent)


def apart(one, other):
    return float(np.abs(one - other)[SKIP:].mean())


@pytest.mark.parametrize("payload", [0.0, 0.2])
@pytest.mark.parametrize("delay", [0.0, 0.015, 0.04])
def test_the_robot_moves_as_its_nominal_simulator_does(robot, payload, delay):
    known = identified(robot, delay=delay)
    expected, _ = play(robot, TARGETS, payload=payload)
    uncorrected, _ = play(known, TARGETS, payload=payload)

    follower = Compensator(known, config=NOW, payload_step=0.1, follow="nominal")
    followed, _ = play(known, TARGETS, follower, payload)

    assert apart(followed, expected) < 0.1 * apart(uncorrected, expected)


def test_a_wrong_identification_ends_at_rest_and_where_the_nominal_simulator_does(robot):
    known = identified(robot)
    other = identified(robot, kp=18.0, offset=-0.03, frictionloss=0.1, damping=0.6, delay=0.04)
    targets = np.repeat([[0.3, -0.2], [-0.4, 0.5]], 400, axis=0)
    expected, _ = play(robot, targets)

    followed, sent = play(other, targets, Compensator(known, config=NOW, follow="nominal"))

    for end in (400, 800):
        last = slice(end - 20, end)
        assert np.abs(np.diff(sent[last], axis=0)).max() < 1e-3
        assert np.abs(followed[last] - expected[last]).max() < 0.02


def test_what_is_measured_changes_no_command_without_feedback(robot):
    config = replace(NOW, feedback=0.0)
    one, two = (Compensator(identified(robot), config=config, follow="nominal") for _ in range(2))
    one.reset(TARGETS[0], 0.0)
    two.reset(TARGETS[0], 0.0)
    rng = np.random.default_rng(0)

    for target in TARGETS[:60]:
        noisy = one.step(target, rng.normal(0.0, 1.0, 2))
        np.testing.assert_array_equal(noisy, two.step(target, None))


def test_several_robots_follow_as_each_alone(robot):
    known = identified(robot)
    targets = np.stack([commands(40, 0), commands(40, 1)], axis=1)
    payloads = (0.0, 0.3)
    both = Compensator(known, config=NOW, num_envs=2, payload_step=0.1, follow="nominal")
    both.reset(targets[0], np.array(payloads))
    alone = [Compensator(known, config=NOW, payload_step=0.1, follow="nominal") for _ in payloads]
    for i, compensator in enumerate(alone):
        compensator.reset(targets[0, i], payloads[i])

    for target in targets:
        sent = both.step(target, 0.9 * target)
        each = [c.step(own, 0.9 * own) for c, own in zip(alone, target, strict=True)]
        np.testing.assert_allclose(sent, each, atol=1e-9)


def test_a_motor_at_its_torque_limit_is_named_with_its_share_of_the_time(robot):
    """The shoulder holds the arm stretched out: 0.88 N·m by its masses, and the motor has 0.7."""
    weak = identified(robot, effort_limit=0.7, frictionloss=0.02)
    target = np.array([0.0, 0.0])
    follower = Compensator(weak, config=NOW, follow="nominal")
    follower.reset(target, 0.0)

    for _ in range(50):
        follower.step(target, None)

    assert follower.limited_shares == {"shoulder": 1.0}
    assert "shoulder" in follower.doubt


def test_a_robot_with_a_weaker_motor_than_identified_is_named(robot):
    """It hangs 0.3 rad below the arm stretched out, and no feedback lifts it."""
    known = identified(robot)
    target = np.array([0.0, 0.0])
    follower = Compensator(known, config=NOW, follow="nominal")
    follower.reset(target, 0.0)

    for _ in range(600):
        follower.step(target, target - [0.3, 0.0])

    assert list(follower.limited_shares) == ["shoulder"]


def test_after_a_torque_limit_the_robot_follows_again(robot):
    """The jump asks for more than the motors have; the motion after it does not."""
    weak = identified(robot, effort_limit=2.0, frictionloss=0.02)
    jump = np.repeat([[-0.5, 0.3], [0.5, -0.3]], 150, axis=0)
    expected, _ = play(robot, jump)

    follower = Compensator(weak, config=NOW, follow="nominal")
    followed, _ = play(weak, jump, follower)

    assert follower.limits.limited_periods.sum() > 0
    assert np.abs(followed - expected)[-50:].max() < 0.01


def test_a_robot_that_is_not_identified_has_nobody_to_follow(robot):
    with pytest.raises(UsageError, match="identified"):
        Compensator(robot, follow="nominal")


def test_a_robot_far_from_its_nominal_simulator_is_refused_without_extrapolate(robot):
    far = robot.with_identified({"elbow": {"kp": 200.0}})
    with pytest.raises(ModelError, match="elbow"):
        Compensator(far, follow="nominal")
    Compensator(far, follow="nominal", extrapolate=True)


def test_a_limit_of_the_correction_holds_while_following(robot):
    strong = write_arm(robot.folder.parent / "strong", TOML.replace("kp = 20.0", "kp = 80.0"))
    soft = strong.with_identified(dict.fromkeys(strong.joint_names, SERVO | {"kp": 20.0}))
    follower = Compensator(soft, config=replace(NOW, limit=0.05), follow="nominal")
    target = np.zeros(2)
    follower.reset(target, 0.0)

    sent = np.array([follower.step(target, None) for _ in range(20)])

    assert np.abs(sent).max() == pytest.approx(0.05)


def test_a_policy_sees_the_nominal_simulator_and_slowly_what_the_robot_does_differently(robot):
    """At rest, the robot is 0.05 rad from where its identified simulator is: half a second takes
    over 63 %.
    """
    known = identified(robot)
    follower = Compensator(known, config=replace(NOW, feedback=0.0), follow="nominal")
    target = np.array([0.3, -0.2])
    follower.reset(target, 0.0)
    expected, _ = play(robot, target[None])
    modelled = follower.shadow.qpos[0].copy()

    first, speed = follower.observe(modelled)
    for _ in range(25):
        follower.step(target, modelled + 0.05)
        seen, _ = follower.observe(modelled + 0.05)

    np.testing.assert_allclose(first, expected[0], atol=1e-3)
    np.testing.assert_allclose(speed, 0.0, atol=1e-3)
    np.testing.assert_allclose(seen - first, 0.63 * 0.05, atol=2e-3)


def test_what_is_not_a_number_is_not_observed(robot):
    follower = Compensator(identified(robot), config=NOW, follow="nominal")
    follower.reset(np.zeros(2), 0.0)
    before, _ = follower.observe(follower.shadow.qpos[0])

    seen, _ = follower.observe(np.array([np.nan, 0.1]))

    np.testing.assert_array_equal(seen, before)


def test_without_following_there_is_nothing_to_observe(robot):
    compensator = Compensator(robot)
    compensator.reset(np.zeros(2), 0.0)
    with pytest.raises(UsageError, match="follow"):
        compensator.observe(np.zeros(2))


GAIN = 2.0  # of a policy: in the nominal simulator it comes to rest
GOAL = np.array([0.3, -0.2])


def largest_step_at_the_end(known, robot, observe):
    """Return by how much a joint still moves in a period after 8 s of a proportional policy,
    rad.
    """
    sim = BatchSim(robot, [(0.0, "both", robot.dt)], 1)
    sim.reset(slice(None), GOAL[None], np.zeros((1, 2)), past=GOAL[None, None])
    follower = Compensator(known, config=NOW, follow="nominal")
    follower.reset(GOAL, 0.0)
    positions = []
    for _ in range(400):
        seen = observe(follower, sim.qpos[0])
        target = np.clip(GOAL + GAIN * (GOAL - seen), -1.5, 1.5)
        sim.step(follower.step(target, sim.qpos[0])[None])
        positions.append(sim.qpos[0].copy())
    return float(np.abs(np.diff(positions[-50:], axis=0)).max())


@pytest.mark.parametrize("delay", [0.02, 0.04, 0.1])
def test_a_policy_that_observes_is_stable_on_servos_later_than_identified(robot, delay):
    known = identified(robot)
    late = identified(robot, delay=delay)

    observed = largest_step_at_the_end(known, late, lambda f, qpos: f.observe(qpos)[0])
    measured = largest_step_at_the_end(known, late, lambda f, qpos: qpos)

    assert observed < 1e-3
    assert measured > 0.05
