"""Static offsets: the static error beyond the nominal sag, recorded per unit and not applied."""

import json

import numpy as np
import pytest
from arm import TOML, write_arm
from logs import arm_sequence, wave

from gaponet.base.errors import DatasetError
from gaponet.data.offsets import FILE, JointOffset, read_offsets, record_offsets, unit_offsets
from gaponet.data.static_poses import StaticPoses
from gaponet.data.store import Dataset
from gaponet.sim.dynamics import gravity_of

BAND = 0.01  # half of the stiction band, rad


def static_poses(robot, offset: float, mass: float) -> StaticPoses:
    """Static poses of a robot with an offset, stiction and half a milliradian of noise."""
    rng = np.random.default_rng(0)
    qpos, approach = rng.uniform(-1.2, 1.2, (120, 2)), rng.choice([-1, 1], (120, 2))
    sag = -gravity_of(robot)(qpos, mass, "both") / robot.servo.kp
    ctrl = qpos - (sag + offset - BAND * approach + 5e-4 * rng.normal(size=(120, 2)))
    return StaticPoses(qpos, ctrl, approach, np.ones((120, 2), bool))


@pytest.fixture
def heavy(tmp_path):
    """The arm with soft motors: 20 N·m/rad is stiff for half a kilogram, 5 N·m/rad is not."""
    return write_arm(tmp_path / "heavy", toml=TOML.replace("kp = 20.0", "kp = 5.0"))


@pytest.mark.parametrize("offset", [0.0, 0.02])
def test_the_tracking_offset_is_the_static_error_without_the_nominal_sag(heavy, tmp_path, offset):
    dataset, known = Dataset.create(tmp_path / "data", heavy), {}
    for i, mass in enumerate((0.0, 0.3)):
        sequence = arm_sequence(heavy, wave(100, 2) + 0.1 * i, wave(100, 2), payload=mass)
        known[dataset.append(sequence).hash] = static_poses(heavy, offset, mass)
    joint = unit_offsets(dataset, heavy, "a", gravity_of(heavy), known)["shoulder"]
    assert joint.tracking_offset == pytest.approx(offset, abs=1e-3)
    assert joint.stiction_band == pytest.approx(BAND, abs=1e-3)
    assert joint.nominal_sag > 0.05
    assert joint.static_error == pytest.approx(joint.nominal_sag + joint.tracking_offset, abs=1e-5)
    assert joint.rests_up + joint.rests_down == 240


def test_motions_without_a_static_pose_have_no_offsets(heavy, tmp_path):
    dataset = Dataset.create(tmp_path / "data", heavy)
    dataset.append(arm_sequence(heavy, wave(200, 2), wave(200, 2)))
    elbow = unit_offsets(dataset, heavy, "a", gravity_of(heavy), {})["elbow"]
    assert elbow == JointOffset(0, 0, None, None, None, None)


def test_offsets_are_recorded_per_unit_and_marked_as_not_applied(heavy, tmp_path):
    dataset = Dataset.create(tmp_path / "data", heavy)
    record_offsets(dataset, "a", {"elbow": JointOffset(3, 4, 0.1, 0.01, 0.05, 0.05)}, "abc")
    record_offsets(dataset, "b", {}, "abc")
    content = json.loads((dataset.path / FILE).read_text())
    assert content["applied"] is False
    assert sorted(content["units"]) == ["a", "b"]
    assert content["units"]["a"]["simulator"] == "abc"
    assert content["units"]["a"]["joints"]["elbow"]["tracking_offset"] == 0.05
    assert read_offsets(dataset) == content


@pytest.mark.parametrize(
    "content", [b"\xff{}", b'{"applied": false, "units": []}', b'{"units": {}}']
)
def test_a_damaged_file_says_what_to_do(heavy, tmp_path, content):
    dataset = Dataset.create(tmp_path / "data", heavy)
    (dataset.path / FILE).write_bytes(content)
    with pytest.raises(DatasetError, match=r"offsets\.json"):
        read_offsets(dataset)


def test_a_real_so101_sags_at_lift_and_elbow(real_dataset):
    joints = read_offsets(real_dataset)["units"]["lab"]["joints"]
    assert joints["shoulder_lift"]["static_error"] == pytest.approx(0.037, abs=0.005)
    assert joints["elbow_flex"]["static_error"] == pytest.approx(0.033, abs=0.005)
    assert joints["elbow_flex"]["stiction_band"] == pytest.approx(0.038, abs=0.005)
    assert abs(joints["shoulder_pan"]["static_error"]) < 0.003
