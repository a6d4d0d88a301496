"""Static offsets: found where the rests show them, called unidentified where they do not, and never applied."""

import json

import numpy as np
import pytest
from arm import TOML, XML, write_arm
from logs import arm_sequence, wave

from gaponet.base.errors import DatasetError
from gaponet.data.holds import Holds
from gaponet.data.offsets import FILE, UnitOffsets, read_offsets, record_offsets
from gaponet.data.store import Dataset
from gaponet.sim.dynamics import static_torque
from gaponet.sim.model import build_model

BAND = 0.01  # half of the stiction band, rad


def gravity_of(robot):
    return lambda qpos, mass, side: static_torque(build_model(robot, mass, side), qpos)


def rests(robot, zero, offset=0.0, stiffness=1.0, mass=0.0, count=120, reach=1.2, seed=0) -> Holds:
    """Rests of a robot whose encoders are turned by `zero`, with stiction and half a milliradian of noise."""
    rng = np.random.default_rng(seed)
    n = len(robot.joint_names)
    qpos = rng.uniform(-reach, reach, (count, n))
    approach = rng.choice([-1, 1], (count, n))
    sag = -gravity_of(robot)(qpos + zero, mass, "both") / (stiffness * robot.kp)
    ctrl = qpos - (sag + offset - BAND * approach + 5e-4 * rng.normal(size=(count, n)))
    return Holds(qpos, ctrl, approach, np.ones((count, n), bool))


@pytest.fixture
def heavy(tmp_path):
    """The arm with soft motors: 20 N·m/rad is stiff for half a kilogram, 5 N·m/rad is not."""
    return write_arm(tmp_path / "heavy", toml=TOML.replace("kp = 20.0", "kp = 5.0"))


def test_a_perfect_unit_has_no_offset(heavy):
    joint = UnitOffsets.of({(0.0, "both", None): rests(heavy, np.zeros(2))}, heavy, gravity_of(heavy)).joints[
        "shoulder"
    ]
    assert joint.tracking_offset == pytest.approx(0, abs=1e-3)
    assert joint.stiction_band == pytest.approx(BAND, abs=1e-3)
    assert joint.nominal_sag > 0.05
    assert joint.rests_up + joint.rests_down == 120


def test_a_constant_offset_is_what_gravity_does_not_explain(heavy):
    found = UnitOffsets.of({(0.0, "both", None): rests(heavy, np.zeros(2), offset=0.02)}, heavy, gravity_of(heavy))
    assert found.joints["elbow"].tracking_offset == pytest.approx(0.02, abs=1e-3)


def test_a_turned_encoder_is_found_from_how_sag_changes_with_posture(heavy):
    zero = np.array([0.15, -0.1])
    found = UnitOffsets.of({(0.0, "both", None): rests(heavy, zero)}, heavy, gravity_of(heavy))
    for name, true in zip(heavy.joint_names, zero, strict=True):
        joint = found.joints[name]
        assert joint.identifiable
        assert joint.zero_offset == pytest.approx(true, abs=3 * joint.zero_std + 0.01)
        assert joint.zero_std < 0.1
    assert found.stiffness == pytest.approx(1.0, abs=0.03)


def test_two_payloads_are_fitted_together(heavy):
    zero = np.array([0.1, 0.05])
    parts = {(mass, "both", None): rests(heavy, zero, mass=mass, seed=i) for i, mass in enumerate((0.0, 0.3))}
    found = UnitOffsets.of(parts, heavy, gravity_of(heavy))
    assert found.joints["shoulder"].zero_offset == pytest.approx(0.1, abs=0.02)
    assert found.joints["shoulder"].rests_up + found.joints["shoulder"].rests_down == 240


def test_a_vertical_axis_does_not_see_gravity(tmp_path):
    toml = TOML.replace("kp = 20.0", "kp = 5.0")
    robot = write_arm(tmp_path / "pan", toml=toml, xml=XML.replace('axis="0 1 0"', 'axis="0 0 1"', 1))
    found = UnitOffsets.of({(0.0, "both", None): rests(robot, np.array([0.2, 0.0]))}, robot, gravity_of(robot))
    assert not found.joints["shoulder"].identifiable
    assert found.joints["shoulder"].reason == "gravity hardly loads this joint in these postures"
    assert found.joints["shoulder"].zero_offset == pytest.approx(0, abs=0.01)  # not the true 0.2: nothing shows it


def test_softer_motors_in_a_narrow_range_are_not_taken_for_a_turned_encoder(heavy):
    found = UnitOffsets.of(
        {(0.0, "both", None): rests(heavy, np.zeros(2), stiffness=0.6, reach=0.3)}, heavy, gravity_of(heavy)
    )
    assert found.stiffness == pytest.approx(0.6, abs=0.1)
    assert not found.joints["elbow"].identifiable


def test_a_few_rests_say_nothing_about_zeros(heavy):
    found = UnitOffsets.of({(0.0, "both", None): rests(heavy, np.zeros(2), count=8)}, heavy, gravity_of(heavy))
    assert found.stiffness is None
    assert found.joints["elbow"].zero_offset is None
    assert "fewer than 20 rests" in found.joints["elbow"].reason


def test_motions_without_a_rest_leave_everything_open(heavy, tmp_path):
    dataset = Dataset.create(tmp_path / "data", heavy)
    dataset.append(arm_sequence(heavy, wave(200, 2), wave(200, 2)))
    found = UnitOffsets.of_unit(dataset, heavy, "a", gravity_of(heavy))
    assert found.joints["elbow"].static_error is None
    assert found.joints["elbow"].tracking_offset is None


def test_offsets_are_recorded_per_unit_and_marked_as_not_applied(heavy, tmp_path):
    dataset = Dataset.create(tmp_path / "data", heavy)
    found = UnitOffsets.of({(0.0, "both", None): rests(heavy, np.zeros(2))}, heavy, gravity_of(heavy))
    record_offsets(dataset, "a", found, "abc")
    record_offsets(dataset, "b", found, "abc")
    content = json.loads((dataset.path / FILE).read_text())
    assert content["applied"] is False
    assert sorted(content["units"]) == ["a", "b"]
    assert content["units"]["a"]["simulator"] == "abc"
    assert content["units"]["a"]["joints"]["elbow"]["identifiable"] is True
    assert read_offsets(dataset) == content


@pytest.mark.parametrize("content", [b"{", b"\xff{}", b"[]", b'{"applied": false, "units": []}', b'{"units": {}}'])
def test_a_damaged_file_says_what_to_do(heavy, tmp_path, content):
    dataset = Dataset.create(tmp_path / "data", heavy)
    (dataset.path / FILE).write_bytes(content)
    with pytest.raises(DatasetError, match=r"offsets\.json: .*; delete it, the next import writes it again"):
        read_offsets(dataset)


def test_a_real_so101_sags_at_lift_and_elbow_and_its_zeros_stay_open(real_dataset):
    joints = read_offsets(real_dataset)["units"]["lab"]["joints"]
    assert joints["shoulder_lift"]["static_error"] == pytest.approx(0.037, abs=0.005)
    assert joints["elbow_flex"]["static_error"] == pytest.approx(0.033, abs=0.005)
    assert joints["elbow_flex"]["stiction_band"] == pytest.approx(0.038, abs=0.005)
    assert abs(joints["shoulder_pan"]["static_error"]) < 0.003
    assert not any(joint["identifiable"] for joint in joints.values())
