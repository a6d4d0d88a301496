"""What is put into a simulated arm comes back: the terms of the servo's law, and the table."""

from dataclasses import replace

import numpy as np
import pytest
from arm import TOML, XML, commands, recordings, write_arm

from gaponet.robot.servo_fields import SERVO_TERMS
from gaponet.robot.spec import Table
from gaponet.sim.replay import replay
from gaponet.sysid import table_contact
from gaponet.sysid.axes import CLASSIC, Bounds
from gaponet.sysid.identify import identify
from gaponet.sysid.joint_rollouts import JointRollouts
from gaponet.sysid.motion_limits import default_terms
from gaponet.sysid.options import IdentifyOptions
from gaponet.sysid.problem import JointFit
from gaponet.sysid.robot_rollouts import cut
from gaponet.sysid.standard_errors import contradicted_gains, standard_errors

SERVO = {
    "kp": 20.0,
    "damping": 0.5,
    "frictionloss": 0.05,
    "armature": 0.06,
    "offset": 0.0,
    "delay": 0.0,
}


def answered(asked, acting):
    """The recordings with what this robot does on their commands."""
    made = []
    for s, t in zip(asked, replay(asked, acting), strict=True):
        made.append(replace(s, qpos=t.qpos, qvel=t.qvel))
    return made


def played(robot, acting, count, rows):
    """Recordings of an arm of known servos."""
    template = recordings(robot, 1, rows=rows)[0]
    asked = [replace(template, ctrl=commands(rows, seed)) for seed in range(count)]
    return answered(asked, acting)


def jumps(count):
    """Targets that jump four times each, (count, 80, 2) rad."""
    return np.random.default_rng(0).uniform(-1, 1, (count, 4, 2)).repeat(20, axis=1)


def joint_fit(parts, robot):
    return JointFit(JointRollouts(parts, robot), robot, Bounds(robot, parts))


def start_of(fit, terms=()):
    """Values from which a search starts: those of SERVO, and what is guessed of the terms."""
    values = {field: np.full(2, value) for field, value in SERVO.items()}
    for field in terms:
        values[field] = fit.bounds.guess[field]
    return values


def test_a_delay_shorter_than_the_time_between_two_rows_is_recovered(tmp_path):
    robot = write_arm(tmp_path / "arm")
    acting = robot.with_identified(dict.fromkeys(robot.joint_names, SERVO | {"delay": 0.006}))
    fit = joint_fit(played(robot, acting, 3, 120), robot)
    assert fit.rollouts.dt == 0.02
    np.testing.assert_allclose(fit.search(start_of(fit))["delay"], 0.006, atol=0.002)


@pytest.mark.parametrize(
    "law",
    [
        {"stribeck": 0.15, "stribeck_speed": 0.2},
        {"friction_motor": 0.2},
        {"friction_external": 0.25},
    ],
)
def test_a_term_of_the_servo_model_is_recovered(tmp_path, law):
    robot = write_arm(tmp_path / "arm")
    acting = robot.with_identified(dict.fromkeys(robot.joint_names, SERVO | law))
    fit = joint_fit(played(robot, acting, 3, 120), robot)
    terms = [term for term in SERVO_TERMS if term in law]
    found = fit.search(start_of(fit, terms))
    assert set(CLASSIC) < set(found)
    std = standard_errors(fit, found).std
    for field, value in law.items():
        for i, joint in enumerate(robot.joint_names):  # within 5 %, or two standard errors
            assert abs(found[field][i] - value) < max(0.05 * value, 2 * std[joint][field])
            assert std[joint][field] < value


@pytest.mark.parametrize("no_load", [1.5, 0.0])
def test_a_torque_speed_line_is_recovered_and_none_is_seen_where_none_is(tmp_path, no_load):
    robot = write_arm(tmp_path / "arm").with_servo(effort_limit=np.full(2, 2.5), kd=np.full(2, 0.5))
    template = recordings(robot, 1, rows=80)[0]
    true = SERVO | {"no_load_speed": no_load}
    asked = [replace(template, ctrl=ctrl) for ctrl in jumps(2)]
    acting = robot.with_identified(dict.fromkeys(robot.joint_names, true))
    parts = answered(asked, acting)
    assert "speed" in default_terms(parts, robot)
    fit = joint_fit(parts, robot)
    found = fit.search(start_of(fit, ["no_load_speed"]))
    np.testing.assert_allclose(fit.bounds.visible("no_load_speed", found), no_load, rtol=0.1)


def test_a_torque_limit_of_half_the_files_is_recovered(tmp_path):
    robot = write_arm(tmp_path / "arm")
    template = recordings(robot, 1, rows=80)[0]
    asked = []
    for i, ctrl in enumerate(jumps(5)):
        meta = replace(template.meta, motion=f"m{i}")
        asked.append(replace(template, ctrl=ctrl, meta=meta))
    weak = robot.with_identified({joint: {"effort_limit": 2.5} for joint in robot.joint_names})
    parts = answered(asked, weak)
    options = IdentifyOptions(windows=4, terms=("limit",), table=False, folds=1)
    found = identify(parts[:4], robot, parts[4:], options=options)
    assert [c.name for c in found.comparisons if c.accepted] == ["limit"]
    np.testing.assert_allclose(found.robot.servo.effort_limit, 2.5, rtol=0.05)
    assert found.after < 0.1 * found.before


def test_damping_of_an_unmoved_joint_is_recovered_from_the_motion_of_another(tmp_path):
    """The file's damping of the shoulder, which no command moves, is ten times too much."""
    robot = write_arm(tmp_path / "arm")
    swung = [replace(s, ctrl=s.ctrl * [0, 1]) for s in played(robot, robot, 3, 200)]
    true = robot.with_identified({"shoulder": {"damping": 0.2, "kp": 20.0}})
    told = robot.with_identified({"shoulder": {"damping": 2.0, "kp": 20.0}})
    parts = answered(swung, true)
    options = IdentifyOptions(windows=2, terms=(), table=False, folds=1)
    found = identify(parts[:2], told, parts[2:], options=options)
    assert found.improved
    assert found.after < 0.1 * found.before
    assert any("shoulder: not determined" in text for text in found.warnings)


TIP = '[[tip]]\nbody = "fore"\npos = [0.2, 0.0, 0.0]\n'


def test_a_table_is_recovered(tmp_path):
    robot = write_arm(tmp_path / "arm", toml=TOML + TIP)
    parts = played(robot, robot.with_table(Table(-0.02, 0.3, 2000.0)), 3, 100)
    heights = table_contact.tip_heights(parts, robot)
    lowest = min(height.min() for height in heights)
    found = table_contact.fit_table(parts, robot, lowest, 1, lambda error: None)
    assert found.accepted
    assert found.after.mean() < 0.2 * found.before.mean()
    assert found.robot.scene.table.height == pytest.approx(-0.02, abs=0.004)
    assert np.abs(found.robot.servo.zero).max() < 0.02
    free = played(robot, robot, 2, 100)
    assert not table_contact.fit_table(free, robot, -0.1, 1, lambda error: None).accepted


def test_half_of_the_rows_remain_for_motions_close_to_the_table(tmp_path):
    robot = write_arm(tmp_path, toml=TOML + TIP)
    heights = [np.linspace(0.30, 0.33, 50), np.full(40, 0.32)]
    below = table_contact.contact_height(robot, heights)
    assert np.mean(np.concatenate(heights) >= below) >= 0.5
    far = [np.r_[0.0, np.full(50, 0.4)]]
    assert table_contact.contact_height(robot, far) == table_contact.CONTACT_CLEARANCE_M


def test_a_kd_of_the_file_that_is_eight_times_too_low_is_overruled_and_named(tmp_path):
    """The prior of damping is weaker than recordings that keep their lag."""
    light = XML.replace('damping="0.5"', 'damping="0.02"')

    def robot(name, kd):
        return write_arm(tmp_path / name, TOML.replace("kp = 20.0", f"kp = 20.0\nkd = {kd}"), light)

    rng = np.random.default_rng(0)
    sequences = []
    for s in recordings(robot("real", 4.0), 4, rows=300, delay=2):
        sequences.append(replace(s, qpos=s.qpos + 1e-3 * rng.standard_normal(s.qpos.shape)))
    errors = []
    doubts = []
    for name, kd in (("right", 4.0), ("low", 0.5)):
        given = robot(name, kd)
        bounds = Bounds(given, sequences)
        rollouts = JointRollouts(cut(sequences, 4), given, nthread=1)
        fit = JointFit(rollouts, given, bounds)
        found = fit.search(bounds.start, fit.regressed())
        np.testing.assert_allclose((found["damping"] + kd) / found["kp"], 4.0 / 20.0, rtol=0.05)
        candidate = {field: value[None] for field, value in found.items()}
        errors.append(np.abs(rollouts.errors(candidate)).mean())
        doubts.append(contradicted_gains(bounds, found, standard_errors(fit, found).std))
    assert errors[1] < 1.02 * errors[0]
    assert doubts[0] == []
    assert len(doubts[1]) == 2
    assert all("kd" in text for text in doubts[1])
