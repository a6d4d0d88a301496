"""Friction follows the recorded temperature; a simulation without one has the robot's reference
temperature.
"""

from dataclasses import replace

import numpy as np
import pytest
from arm import TOML, recordings, write_arm

from gaponet.data.sequence import Sequence
from gaponet.robot.folder import save_robot
from gaponet.robot.spec import RobotSpec, load_robot
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


def with_servo(robot: RobotSpec, servo: dict[str, float]) -> RobotSpec:
    """The robot with this servo in every joint."""
    return robot.with_identified(dict.fromkeys(robot.joint_names, servo))


def candidate(servo: dict[str, float]) -> dict[str, np.ndarray]:
    """The servo in both joints: field → (1, 2)."""
    return {field: np.full((1, 2), value) for field, value in servo.items()}


@pytest.fixture
def warm(arm):
    """The arm whose friction and damping fall with the temperature."""
    return with_servo(arm, SERVO | WARM)


@pytest.mark.parametrize("celsius", [20.0, 30.0, 55.0])
def test_every_simulation_has_the_friction_of_the_recorded_temperature(tmp_path, celsius):
    robot = write_arm(tmp_path / "arm")
    (real,) = recordings(robot, 1, rows=150)
    kelvin = celsius - 30
    now = {"frictionloss": 0.2 * (1 - 0.02 * kelvin), "damping": 0.5 - 0.005 * kelvin}
    (expected,) = replay([real], with_servo(robot, SERVO | now))
    warm = at(real, celsius)
    (moved,) = replay([warm], with_servo(robot, SERVO | WARM))
    np.testing.assert_allclose(moved.qpos, expected.qpos, atol=1e-6)
    values = candidate(SERVO | WARM)
    plain = candidate(SERVO | now)
    for runs in (JointRollouts([warm], robot, nthread=1), RobotRollouts([warm], robot, 1)):
        np.testing.assert_allclose(runs.flat_errors(values), runs.flat_errors(plain), atol=1e-5)


def test_damping_that_warmth_takes_from_kd_keeps_its_ratio_at_other_gains(tmp_path):
    robot = write_arm(tmp_path / "arm", TOML.replace("kp = 20.0", "kp = 20.0\nkd = 2.0"))
    (real,) = recordings(robot, 1, rows=150)
    warm = at(real, 40.0, kp=(20.0, 20.0), kd=(1.0, 1.0))
    servo = SERVO | WARM | {"damping_per_kelvin": -0.1}  # below zero at 40 °C
    (moved,) = replay([warm], with_servo(robot, servo))
    expected = np.abs(moved.qpos - warm.qpos)[1:].mean()
    for runs in (JointRollouts([warm], robot, nthread=1), RobotRollouts([warm], robot, 1)):
        error = np.abs(runs.flat_errors(candidate(servo))).mean()
        assert error == pytest.approx(expected, rel=0.05)


def test_a_simulation_without_temperature_is_at_the_reference(arm, warm):
    recorded = recordings(arm, 1, rows=100)
    (one,) = replay(recorded, warm)
    (other,) = replay(recorded, with_servo(arm, SERVO))
    np.testing.assert_array_equal(one.qpos, other.qpos)


def test_stored_replays_without_the_term_are_not_those_with_it(arm, warm):
    assert model_hash(warm) != model_hash(with_servo(arm, SERVO))


def test_a_robot_without_the_term_has_no_condition_of_temperature(arm):
    (real,) = recordings(arm, 1, rows=100)
    assert Condition.of(at(real, 50.0), with_servo(arm, SERVO)).temperature is None


def test_friction_stays_above_zero_at_any_temperature(warm):
    assert (warm.at_temperature((300.0, 300.0)).servo.frictionloss > 0).all()


def test_a_joint_of_unknown_temperature_is_at_the_reference(warm):
    friction = warm.at_temperature((float("nan"), 50.0)).servo.frictionloss
    assert friction[0] == warm.servo.frictionloss[0]
    assert friction[1] < warm.servo.frictionloss[1]


def test_the_term_is_in_the_robot_folder(warm, tmp_path):
    save_robot(warm, tmp_path / "out")
    again = load_robot(tmp_path / "out")
    assert again.servo.friction_per_kelvin.tolist() == [-0.02] * 2
    assert again.servo.friction_temperature.tolist() == [30.0] * 2


def at_each(sequence: Sequence, gains: tuple[float, ...]) -> list[Sequence]:
    """The recording at 25, 28, 36 and 39 °C, each at its gain."""
    made = []
    for celsius, kp in zip((25.0, 28.0, 36.0, 39.0), gains, strict=True):
        made.append(at(sequence, celsius, kp=(kp, kp), kd=(0.0, 0.0)))
    return made


@pytest.fixture
def cold(arm):
    """A recording without temperature."""
    (real,) = recordings(arm, 1, rows=60)
    return real


@pytest.fixture
def mixed(cold):
    """Recordings whose gains have nothing to do with their temperature."""
    return at_each(cold, (5.0, 9.0, 5.0, 9.0))


@pytest.fixture
def rising(cold):
    """Recordings whose gains rise with their temperature."""
    return at_each(cold, (5.0, 5.0, 9.0, 9.0))


def test_the_term_is_tried_where_the_temperature_varies_and_no_gain_with_it(arm, mixed):
    assert temperature_varies(mixed, arm).all()
    assert "temperature" in default_terms(mixed, arm)


def test_the_term_is_not_tried_where_gains_vary_with_the_temperature(arm, rising):
    assert not temperature_varies(rising, arm).any()
    assert "temperature" not in default_terms(rising, arm)


def test_a_temperature_that_hardly_varies_or_is_recorded_once_does_not_vary(arm, cold):
    for recorded in ([at(cold, 25.0), at(cold, 26.0)], [at(cold, 25.0), cold]):
        assert not temperature_varies(recorded, arm).any()


STD = {joint: {"friction_per_kelvin": 0.002} for joint in ("shoulder", "elbow")}


def test_gains_that_vary_with_the_temperature_are_a_finding(arm, mixed, rising):
    assert temperature_findings(mixed, arm, STD) == ()
    said = temperature_findings(rising, arm, STD)
    assert all("varies with gains or payload" in sentence for sentence in said)


def test_a_finding_states_the_fall_of_friction_and_its_temperatures(arm, mixed):
    shoulder = arm.with_identified({"shoulder": SERVO | WARM})
    (sentence,) = temperature_findings(mixed, shoulder, STD)
    assert "friction falls by 2.00 ± 0.20 % per K, recorded at 25 to 39 °C" in sentence
    assert sentence.endswith("the stated value is that at 30 °C")
