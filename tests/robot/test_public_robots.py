"""Packaged robots have the masses of their published models and the joint order of their
vendors.
"""

import mujoco
import numpy as np
import pytest

from gaponet.robot.spec import load_robot
from gaponet.sim.model import build_model

# Root mean square of gravity's torque (N·m) and mean inertia without armature (kg·m²) at each joint
# over 100 postures drawn by numpy's default_rng(0) within the ranges: MuJoCo on Unitree's URDF
# g1_29dof_rev_1_0, as example-robot-data 6.0.0 has it. robot.xml was written from the MJCF of that
# name.
G1_GRAVITY = [
    9.406, 6.286, 3.734, 2.505, 0.1215, 0.05997, 9.738, 6.314, 4.048, 2.416, 0.1315, 0.06246, 0.0,
    9.927, 9.94, 2.569, 3.057, 0.9575, 0.9767, 0.1686, 0.1925, 0.1029, 2.471, 2.758, 0.877, 0.9925,
    0.1584, 0.2108, 0.09575,
]  # fmt: skip
G1_INERTIA = [
    0.4017, 0.5549, 0.124, 0.1125, 0.002771, 0.0003871, 0.3786, 0.5407, 0.1377, 0.1125, 0.00277,
    0.0003871, 0.5091, 1.134, 0.9802, 0.066, 0.1212, 0.02031, 0.02647, 0.00286, 0.003131, 0.001837,
    0.07104, 0.1189, 0.01997, 0.0277, 0.002657, 0.003438, 0.001837,
]  # fmt: skip
# Of the moving links, kg: google-deepmind/mujoco_menagerie, franka_fr3/fr3.xml and
# universal_robots_ur10e/ur10e.xml.
LINKS = {
    "fr3": [2.92747, 2.93554, 2.2449, 2.6156, 2.32712, 1.81704, 0.627143],
    "ur10e": [7.778, 12.93, 3.87, 1.96, 1.96, 0.202],
}
# Names of the SDK's G1JointIndex, in the order of its motors.
LEG = ("HipPitch", "HipRoll", "HipYaw", "Knee", "AnklePitch", "AnkleRoll")
ARM = (
    "ShoulderPitch",
    "ShoulderRoll",
    "ShoulderYaw",
    "Elbow",
    "WristRoll",
    "WristPitch",
    "WristYaw",
)


def test_g1_has_the_gravity_and_inertia_of_unitrees_urdf():
    robot = load_robot("g1_29")
    model = build_model(robot)
    model.dof_armature[:] = 0
    data = mujoco.MjData(model)
    rng = np.random.default_rng(0)
    gravity = []
    inertia = []
    for _ in range(100):
        data.qpos[:] = rng.uniform(*robot.qpos_range.T)
        mujoco.mj_forward(model, data)
        gravity.append(data.qfrc_bias.copy())
        columns = np.zeros((model.nv, model.nv))
        for column, unit in zip(columns, np.eye(model.nv), strict=True):
            mujoco.mj_mulM(model, data, column, unit)
        inertia.append(columns.diagonal())
    np.testing.assert_allclose(
        np.sqrt(np.mean(np.square(gravity), axis=0)), G1_GRAVITY, rtol=0.01, atol=1e-6
    )
    np.testing.assert_allclose(np.mean(inertia, axis=0), G1_INERTIA, rtol=0.01)
    assert model.body_mass.sum() == pytest.approx(33.341, abs=1e-3)


@pytest.mark.parametrize("name", LINKS)
def test_links_have_published_masses(name):
    model = build_model(load_robot(name))
    moving = [float(model.body_mass[b]) for b in model.jnt_bodyid]
    assert moving == LINKS[name]


def test_gravity_of_a_stretched_ur10e_follows_from_its_links():
    """Upper arm and forearm level: torques about the shoulder and the elbow, by hand."""
    robot = load_robot("ur10e")
    model = build_model(robot)
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    upper, fore, first, second, third = LINKS["ur10e"][1:]
    beyond = 0.613 + 0.571
    shoulder = 9.81 * (upper * 0.3065 + fore * (0.613 + 0.2855) + (first + second + third) * beyond)
    elbow = 9.81 * (fore * 0.2855 + (first + second + third) * 0.571)
    np.testing.assert_allclose(np.abs(data.qfrc_bias[1:3]), [shoulder, elbow], rtol=0.01)


WAIST = ("WaistYaw", "WaistRoll", "WaistPitch")
ONLY_LARGE = (
    "waist_roll_joint",
    "waist_pitch_joint",
    "left_wrist_pitch_joint",
    "left_wrist_yaw_joint",
    "right_wrist_pitch_joint",
    "right_wrist_yaw_joint",
)


def of_side(side, names):
    return [f"{side}{name}" for name in names]


def test_joints_of_g1_have_the_order_of_the_sdk():
    legs = of_side("Left", LEG) + of_side("Right", LEG)
    arms = of_side("Left", ARM) + of_side("Right", ARM)
    large = load_robot("g1_29")
    names = [large.resolve(name, "sdk") for name in (*legs, *WAIST, *arms)]
    assert names == list(large.joint_names)


def test_the_small_g1_has_the_joints_of_the_large_one_but_six():
    small = load_robot("g1_23").joint_names
    large = load_robot("g1_29").joint_names
    assert small == tuple(name for name in large if name not in ONLY_LARGE)


@pytest.mark.parametrize(("name", "count"), [("g1_29", 17), ("g1_23", 11)])
def test_all_joints_of_g1_above_the_legs_are_operated(name, count):
    assert len(load_robot(name).operated) == count
