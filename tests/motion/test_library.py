import numpy as np
import pytest
from arm import TOML, XML, write_arm

from gaponet.base.errors import UsageError
from gaponet.motion.feasible import MAX_PAYLOAD_KG
from gaponet.motion.library import SIGNALS, Library, short
from gaponet.robot.spec import load_robot

SOME = [
    "sweep-left_shoulder_roll",
    "steps-right_elbow",
    "reach-both-0",
    "punch-right-1",
    "wave-left-0",
    "march-all-0",
]


@pytest.fixture(scope="module")
def library():
    return Library(load_robot("h1_2"))


@pytest.mark.parametrize("name", SOME)
def test_a_motion_is_within_all_limits_at_every_payload(library, name):
    motion = library.make(name)
    need = library.limits.demand(motion.ctrl, motion.dt)
    assert library.limits.max_payload == MAX_PAYLOAD_KG
    assert need.met, need
    assert np.abs(np.diff(motion.ctrl, axis=0)[[0, -1]]).max() < 1e-3  # from rest to rest


def test_per_joint_motions_cover_nine_tenths_of_every_operated_joint_at_three_kilograms(library):
    robot = library.robot
    for joint in robot.operated:
        column = library.make(f"sweep-{short(joint, robot)}").ctrl[:, robot.index([joint])[0]]
        low, high = robot.qpos_range[robot.index([joint])[0]]
        assert np.ptp(column) >= 0.9 * (high - low), joint


@pytest.mark.filterwarnings("error::RuntimeWarning")
def test_a_joint_that_turns_without_end_sweeps_a_turn_about_its_home():
    robot = load_robot("xl330_bench")
    (joint,) = robot.operated
    motion = Library(robot, max_payload=0.0).make(f"sweep-{short(joint, robot)}")
    column = motion.ctrl[:, robot.index([joint])[0]]
    assert np.ptp(column) == pytest.approx(2 * np.pi, rel=0.1)


def test_left_and_right_reach_the_same_places_mirrored(library):
    kit = library.kit
    for point in ([0.4, 0.2, 1.2], [0.3, 0.35, 1.0]):
        left = kit.at(kit.ready, ("left",), point)
        right = kit.at(kit.ready, ("right",), point)
        palm = kit.ik["left"].position(left)
        assert np.linalg.norm(palm - point) < 2e-3
        assert np.allclose(kit.ik["right"].position(right) * [1, -1, 1], palm, atol=4e-3)


def test_the_same_seed_makes_the_same_motion_and_another_seed_another():
    robot = load_robot("h1_2")
    one = Library(robot, 0).make("reach-both-0").ctrl
    same = Library(robot, 0).make("reach-both-0").ctrl
    other = Library(robot, 1).make("reach-both-0").ctrl
    assert np.array_equal(one, same)
    assert not np.array_equal(one, other)


def test_levels_follow_from_the_joints_that_move(library):
    assert library.make("creep-left_elbow").moved(library.robot) == ("left_elbow_joint",)
    assert library.make("creep-left_elbow").level == "joint"
    assert all("hip" not in j for j in library.make("carry-both-0").moved(library.robot))
    assert library.make("squat-all-0").level == "whole_body"


def test_half_the_rate_plays_every_second_row(library):
    motion = library.make("stir-left-0")
    assert np.array_equal(motion.sample(0.02), motion.sample(0.01)[::2])
    assert abs(motion.sample(0.007)[100] - motion.sample(0.01)[70]).max() < 1e-9


def test_joints_may_have_hyphens_and_names_of_which_one_is_another_s_and_a_suffix(tmp_path):
    for old, new in (("shoulder", "elbow_joint"), ("shoulder", "joint-1")):
        robot = write_arm(tmp_path / new, TOML.replace(old, new), XML.replace(old, new))
        library = Library(robot, max_payload=0.0)
        for name in ("sweep-elbow", f"sweep-{new}"):
            assert library.make(name).moved(robot) == (name.removeprefix("sweep-"),)


def test_an_unknown_name_lists_the_forms(library):
    with pytest.raises(UsageError, match="dance-left-0"):
        library.make("dance-left-0")
    with pytest.raises(UsageError, match="left_knee"):
        library.make("sweep-left_knee")


def test_a_robot_without_arms_by_name_has_signals_and_tours(arm):
    library = Library(arm, max_payload=0.2)
    names = library.names()
    assert "sweep-shoulder" in names
    assert "tour-all-0" in names
    assert not [n for n in names if n.startswith(("reach", "squat"))]
    assert library.limits.demand(library.make("tour-all-0").ctrl, 0.01).met


DT = 0.01


@pytest.mark.parametrize("name", SIGNALS)
@pytest.mark.parametrize("span", [(-1.0, 2.0), (-0.2, 0.25)])
def test_every_signal_stays_inside_and_starts_and_ends_at_rest(name, span):
    y = SIGNALS[name](*span, np.random.default_rng(1), DT)
    assert y.min() >= span[0] - 1e-9
    assert y.max() <= span[1] + 1e-9
    assert np.ptp(y) > 0.05
    assert np.abs(np.diff(y)[[0, -1]]).max() < 1e-9


def test_a_creep_is_slow():
    y = SIGNALS["creep"](-1.0, 2.0, np.random.default_rng(0), DT)
    assert np.abs(np.diff(y) / DT).max() < 0.101


def test_a_chirp_gets_faster():
    y = SIGNALS["chirp"](-1.0, 1.0, np.random.default_rng(0), DT)
    moving = y[50:-50] - y[0]
    crossings = np.flatnonzero(np.diff(np.sign(moving)))
    gaps = np.diff(crossings) * DT
    assert gaps[0] > 3 * gaps[-1]


def test_trapezoids_cruise_at_constant_speeds():
    y = SIGNALS["trapezoids"](-2.0, 2.0, np.random.default_rng(3), DT)
    speed = np.abs(np.diff(y)) / DT
    cruising = set()
    for value in speed[speed > 0.1]:
        rows = (np.abs(speed - value) < 0.01).sum()
        if rows > 30:
            cruising.add(round(float(value), 1))
    assert cruising == {0.4, 0.7, 1.0, 1.4}
