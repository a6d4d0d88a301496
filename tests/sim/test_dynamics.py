"""Inverse dynamics against a second, independent implementation, and against a hand."""

import numpy as np
import pytest

from gaponet.robot.spec import load_robot
from gaponet.sim.dynamics import inverse_dynamics, static_torque
from gaponet.sim.model import build_model


def test_static_torque_of_a_level_arm_is_its_weight(arm):
    # upper arm 0.3 kg at 0.1 m; fore arm 0.2 kg at 0.3 m; 0.5 kg in the hand at 0.4 m. y axis: positive turns down
    tau = static_torque(build_model(arm, 0.5), np.zeros((1, 2)))[0]
    assert tau[0] == pytest.approx(-9.81 * (0.3 * 0.1 + 0.2 * 0.3 + 0.5 * 0.4), rel=1e-6)
    assert tau[1] == pytest.approx(-9.81 * (0.2 * 0.1 + 0.5 * 0.2), rel=1e-6)


@pytest.mark.parametrize("payload", [0.0, 3.0])
def test_h1_2_agrees_with_pinocchio(payload):
    """An independent rigid-body library reads the same MJCF and gets the payload as an extra body."""
    pin = pytest.importorskip("pinocchio", reason="pinocchio (package pin) is not installed")
    robot = load_robot("h1_2")
    other = pin.buildModelFromMJCF(str(robot.mjcf))
    for mount in robot.payload_mounts:
        frame = other.frames[other.getFrameId(mount.body)]
        place = frame.placement * pin.SE3(np.eye(3), np.array(mount.pos))
        radius = max((3 * payload / (4 * np.pi * 7850.0)) ** (1 / 3), 1e-3)  # a solid steel ball
        other.appendBodyToJoint(frame.parentJoint, pin.Inertia.FromSphere(payload, radius), place)
    order = [other.joints[other.getJointId(name)].idx_v for name in robot.joint_names]
    rng = np.random.default_rng(0)
    model = build_model(robot, payload)
    low, high = robot.qpos_range.T
    qpos, qvel, qacc = rng.uniform(low, high, (50, 27)), rng.normal(size=(50, 27)), 5 * rng.normal(size=(50, 27))
    ours = inverse_dynamics(model, qpos, qvel, qacc)
    theirs = np.empty_like(ours)
    data = other.createData()
    other.armature[:] = 0.0  # added by hand below, since versions differ in whether rnea counts it
    for t in range(50):
        q, v, a = np.zeros(27), np.zeros(27), np.zeros(27)
        q[order], v[order], a[order] = qpos[t], qvel[t], qacc[t]
        theirs[t] = pin.rnea(other, data, q, v, a)[order]
    theirs += model.dof_armature * qacc + model.dof_damping * qvel
    assert np.abs(ours - theirs).max() < 1e-6 * np.abs(ours).max()
