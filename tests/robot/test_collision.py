import numpy as np
import pytest
from contacts import Contacts

from gaponet.base.errors import RobotError
from gaponet.robot.collision import CLEARANCE_M, Collision, read_shapes, segment_distance
from gaponet.robot.spec import load_robot, packaged_robots
from gaponet.sim.model import build_model
from gaponet.sim.robot_check import check_robot


def distance(a, b):
    return float(segment_distance(*(np.array(x, float) for x in (*a, *b))))


def test_distance_of_segments():
    x = ([0, 0, 0], [1, 0, 0])
    assert distance(x, ([0.5, -1, 2], [0.5, 1, 2])) == 2  # crossing above
    assert distance(x, ([4, 0, 4], [4, 0, 5])) == 5  # 3-4-5 from the end
    assert distance(x, ([0.2, 1, 0], [0.8, 1, 0])) == 1  # parallel
    assert distance(x, ([0.3, 0, 0], [0.4, 0, 0])) == 0  # on it


def test_segment_distance_is_the_minimum_over_pairs_of_points():
    rng = np.random.default_rng(0)
    s = np.linspace(0, 1, 201)[:, None]
    for _ in range(20):
        a0, a1, b0, b1 = rng.normal(size=(4, 3))
        a = a0 + s * (a1 - a0)
        b = b0 + s * (b1 - b0)
        brute = np.linalg.norm(a[:, None] - b[None], axis=-1).min()
        assert brute - 0.02 <= distance((a0, a1), (b0, b1)) <= brute + 1e-9


@pytest.fixture(scope="module")
def h1():
    robot = load_robot("h1_2")
    return robot, Collision(robot, build_model(robot))


def test_hanging_arms_are_free_and_folded_ones_collide(h1):
    robot, collision = h1
    hit = robot.qpos_home.copy()
    hit[robot.index(["left_shoulder_yaw_joint"])] = -1.5  # forearm into the belly
    distances = collision.distance(np.stack([robot.qpos_home, hit]))
    assert distances[0] > CLEARANCE_M
    assert distances[1] < 0
    nearest = collision.nearest(collision.along(hit[None]))
    assert "torso_link" in nearest
    assert "left_elbow_link" in nearest or "left_wrist_yaw_link" in nearest


def test_left_and_right_shapes_are_mirrored(h1):
    robot, collision = h1
    left = robot.qpos_home.copy()
    right = robot.qpos_home.copy()
    left[robot.index(["left_shoulder_roll_joint"])] = -0.3
    right[robot.index(["right_shoulder_roll_joint"])] = 0.3
    a, b = collision.distance(np.stack([left, right]))
    assert abs(a - b) < 1e-4


def test_a_robot_without_shapes_is_not_checked(arm):
    assert Collision(arm, build_model(arm)).distance(np.zeros((3, 2))).tolist() == [np.inf] * 3


def test_a_negative_radius_is_an_error(arm):
    file = arm.folder / "collision.toml"
    file.write_text(
        'capsule = [{ body = "upper", from = [0, 0, 0], to = [0, 0, 1], radius = -50.0 }]'
    )
    with pytest.raises(RobotError, match="radius"):
        read_shapes(arm.folder)
    with pytest.raises(RobotError, match="radius"):
        check_robot(arm)


def test_a_shape_on_an_unknown_body_is_an_error(arm):
    file = arm.mjcf.parent / "collision.toml"
    file.write_text('capsule = [{ body = "nose", from = [0, 0, 0], to = [0, 0, 1], radius = 0.1 }]')
    with pytest.raises(RobotError, match="nose"):
        Collision(arm, build_model(arm))


@pytest.mark.parametrize(
    "name", sorted({*packaged_robots()} - {"xl330_bench"})
)  # a bench has no shapes
def test_packaged_robots_are_free_at_home_and_have_a_plane(name):
    robot = load_robot(name)
    collision = Collision(robot, build_model(robot))
    assert collision.distance(robot.qpos_home[None])[0] >= collision.clearance
    assert collision.height == 0.0
    assert len(collision.above)


def test_distances_agree_with_contacts_of_mujoco(so101):
    collision = Collision(so101, build_model(so101))
    judge = Contacts(so101)
    postures = np.random.default_rng(0).uniform(*so101.qpos_range.T, (300, 6))
    touching = np.array([judge.deepest(q)[0] > 0 for q in postures])
    free = collision.distance(postures)
    assert 60 < touching.sum() < 240
    assert (free[touching] < 0.01).all(), (
        "lines of robot.xml may stick out of their shells by a centimetre"
    )
    assert touching[free < 0].all()


def test_the_height_of_the_plane_can_be_set(so101):
    down = so101.qpos_home.copy()
    down[so101.index(["shoulder_lift"])] = 1.0
    with pytest.raises(RobotError, match="--plane"):
        Collision(so101, build_model(so101), height=-75.0)
    lower = Collision(so101, build_model(so101), height=-0.2)
    (free,) = lower.distances(down[None])
    assert (
        lower.distance(down[None])[0]
        > 0
        > Collision(so101, build_model(so101)).distance(down[None])[0]
    )
    assert lower.nearest(free).endswith("and the plane at -0.2 m")
