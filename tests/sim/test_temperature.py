"""Friction follows the recorded temperature; a simulation without one has the robot's reference
temperature.
"""

from dataclasses import replace

import numpy as np
import pytest
from arm import recordings, write_arm

from gaponet.data.sequence import Sequence
from gaponet.robot.folder import save_robot
from gaponet.robot.spec import load_robot
from gaponet.sim.batch import Condition
from gaponet.sim.model import model_hash
from gaponet.sim.replay import replay
from gaponet.sim.temperature import temperature_findings, temperature_varies
from gaponet.sysid.joint_rollouts import JointRollouts
from gaponet.sysid.motion_limits import default_terms
from gaponet.sysid.robot_rollouts import RobotRollouts

SERVO = {
    "kp": 20.0,
    "damping": 0.5,
    "frictionloss": 0.2,
    "armature": 0.02,
    "offset": 0.0,
    "delay": 0.0,
}
WARM = {"friction_per_kelvin": -0.02, "damping_per_kelvin": -0.005, "friction_temperature": 30.0}


def at(sequence: Sequence, celsius: float, **meta: object) -> Sequence:
    warm = np.full(sequence.qpos.shape, celsius)
    return replace(sequence, temperature=warm, meta=replace(sequence.meta, **meta))


@pytest.mark.parametrize("celsius", [20.0, 30.0, 55.0])
def test_every_simulation_has_the_friction_of_the_recorded_temperature(tmp_path, celsius):
    robot = write_arm(tmp_path / "arm")
    (real,) = recordings(robot, 1, rows=150)
    both = dict.fromkeys(robot.joint_names, SERVO | WARM)
    now = {
        "frictionloss": 0.2 * (1 - 0.02 * (celsius - 30)),
        "damping": 0.5 - 0.005 * (celsius - 30),
    }
    expected = replay([real], robot.with_identified(dict.fromkeys(robot.joint_names, SERVO | now)))
    warm = at(real, celsius)
    (moved,) = replay([warm], robot.with_identified(both))
    np.testing.assert_allclose(moved.qpos, expected[0].qpos, atol=1e-6)
    values = {f: np.full((1, 2), v) for f, v in (SERVO | WARM).items()}
    plain = {f: np.full((1, 2), v) for f, v in (SERVO | now).items()}
    for runs in (JointRollouts([warm], robot, nthread=1), RobotRollouts([warm], robot, 1)):
        np.testing.assert_allclose(runs.flat_errors(values), runs.flat_errors(plain), atol=1e-5)


def test_a_simulation_without_temperature_is_at_the_reference(tmp_path):
    robot = write_arm(tmp_path / "arm")
    (real,) = recordings(robot, 1, rows=100)
    made = [
        robot.with_identified(dict.fromkeys(robot.joint_names, SERVO | more)) for more in (WARM, {})
    ]
    (one,), (other,) = (replay([real], r) for r in made)
    np.testing.assert_array_equal(one.qpos, other.qpos)
    assert model_hash(made[0]) != model_hash(made[1])  # stored replays of one are not the other's
    assert Condition.of(at(real, 50.0), made[1]).temperature is None
    assert (made[0].at_temperature((300.0, 300.0)).servo.frictionloss > 0).all()
    one_known = made[0].at_temperature((float("nan"), 50.0))
    assert one_known.servo.frictionloss[0] == made[0].servo.frictionloss[0]
    assert one_known.servo.frictionloss[1] < made[0].servo.frictionloss[1]


def test_the_term_is_in_the_robot_folder(tmp_path):
    robot = write_arm(tmp_path / "arm")
    save_robot(
        robot.with_identified(dict.fromkeys(robot.joint_names, SERVO | WARM)), tmp_path / "out"
    )
    again = load_robot(tmp_path / "out")
    assert again.servo.friction_per_kelvin.tolist() == [-0.02] * 2
    assert again.servo.friction_temperature.tolist() == [30.0] * 2


def test_the_term_is_tried_where_the_temperature_varies_and_no_gain_with_it(tmp_path):
    robot = write_arm(tmp_path / "arm")
    cold, hot = recordings(robot, 1, rows=60), (25.0, 28.0, 36.0, 39.0)
    mixed = [
        at(cold[0], t, kp=(k, k), kd=(0.0, 0.0))
        for t, k in zip(hot, (5.0, 9.0, 5.0, 9.0), strict=True)
    ]
    rising = [
        at(cold[0], t, kp=(k, k), kd=(0.0, 0.0))
        for t, k in zip(hot, (5.0, 5.0, 9.0, 9.0), strict=True)
    ]
    assert temperature_varies(mixed, robot).all()
    assert "temperature" in default_terms(mixed, robot)
    for recorded in (rising, [at(cold[0], 25.0), at(cold[0], 26.0)], [at(cold[0], 25.0), cold[0]]):
        assert not temperature_varies(recorded, robot).any()
    assert "temperature" not in default_terms(rising, robot)
    std = {joint: {"friction_per_kelvin": 0.002} for joint in robot.operated}
    assert temperature_findings(mixed, robot, std) == ()
    assert all(
        "varies with gains or payload" in s for s in temperature_findings(rising, robot, std)
    )
    warm = robot.with_identified({robot.operated[0]: SERVO | WARM})
    (sentence,) = temperature_findings(mixed, warm, std)
    assert "friction falls by 2.00 ± 0.20 % per K, recorded at 25 to 39 °C" in sentence
    assert sentence.endswith("the stated value is that at 30 °C")
