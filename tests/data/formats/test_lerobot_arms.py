"""What stock sets of LeRobot hold: actions that are no joint targets, ticks and percent of a
calibrated arm.
"""

import json

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from logs import SO101, stock, wave

from gaponet.base.errors import JointMismatchError, LogError, UsageError
from gaponet.data.describe.encoders import Encoder
from gaponet.data.doctor import DoctorResult
from gaponet.data.importer import ImportRequest, import_logs

HAND = ("ee.x", "ee.y", "ee.z", "ee.wx", "ee.wy", "ee.wz")
CALIBRATION = {
    name: {
        "id": i + 1,
        "drive_mode": 0,
        "homing_offset": 37,
        "range_min": 800 + i,
        "range_max": 3200 + i,
    }
    for i, name in enumerate(SO101)
}
PER_TICK = 2 * np.pi / 4095


def read(folder, robot, out, **options):
    return import_logs(
        folder, robot, out, ImportRequest(unit_id="u", payload_mass=0.0, **options)
    ).dataset


def renamed(folder, feature, names, **more):
    """Change the names of a feature in info.json."""
    file = folder / "meta" / "info.json"
    info = json.loads(file.read_text())
    info["features"][feature]["names"] = list(names)
    info["features"] |= more
    file.write_text(json.dumps(info))
    return folder


@pytest.mark.parametrize(
    ("names", "what"),
    [
        (HAND, "effector"),
        (("x", "y", "z", "roll", "pitch", "yaw"), "effector"),
        (("tcp_x", "tcp_y", "tcp_z", "tcp_rx", "tcp_ry", "tcp_rz"), "effector"),
        (("delta_x", "delta_y", "delta_z", "delta_rx", "delta_ry", "gripper"), "deltas"),
        (("x.vel", "y.vel", "theta.vel", "a.vel", "b.vel", "c.vel"), "speeds"),
    ],
)
def test_an_action_that_is_no_joint_target_is_refused_by_name(so101, tmp_path, names, what):
    folder = renamed(stock(tmp_path / "set"), "action", names)
    with pytest.raises(LogError, match=what):
        read(folder, so101, tmp_path / "data", position_unit="deg")


def test_values_of_the_hand_beside_joints_are_named_to_be_left_out(so101, tmp_path):
    names = (*SO101[:3], "ee.x", "ee.y", "ee.z")
    folder = renamed(stock(tmp_path / "set"), "action", names)
    with pytest.raises(LogError, match="ignore"):
        read(folder, so101, tmp_path / "data", position_unit="deg")


def test_another_feature_can_hold_the_targets(so101, tmp_path):
    folder = stock(tmp_path / "set")
    info = json.loads((folder / "meta" / "info.json").read_text())
    features = info["features"]
    features["goal.joints"] = dict(features["action"])
    features["action"]["names"] = HAND
    (folder / "meta" / "info.json").write_text(json.dumps(info))
    file = folder / "data" / "chunk-000" / "file-000.parquet"
    table = pq.read_table(file)
    pq.write_table(table.append_column("goal.joints", table["action"]), file)
    with pytest.raises(LogError, match=r"goal\.joints"):
        read(folder, so101, tmp_path / "none", position_unit="deg")
    (folder / "logs.toml").write_text('ctrl = "goal.joints"\n')
    dataset = read(folder, so101, tmp_path / "data", position_unit="deg")
    assert dataset.read(dataset.entries[0]).ctrl[0, 0] == pytest.approx(np.radians(10))


def of_ticks(tmp_path, unit="ticks"):
    """A set in ticks, and what its joints do, (rows, 6) ticks."""
    ticks = np.round(2000 + 600 * wave(120, 6, 1 / 30))
    folder = stock(tmp_path / "set", [ticks])
    (folder / "logs.toml").write_text(f'calibration = "arm.json"\nposition_unit = "{unit}"\n')
    (folder / "arm.json").write_text(json.dumps(CALIBRATION))
    return folder, ticks


def test_ticks_of_a_calibrated_arm_become_angles_about_the_middle_of_its_range(so101, tmp_path):
    folder, ticks = of_ticks(tmp_path)
    dataset = read(folder, so101, tmp_path / "data")
    ctrl = dataset.read(dataset.entries[0]).ctrl
    middle = 2000 + np.arange(5)
    assert np.allclose(ctrl[:, :5], (ticks[:, :5] - middle) * PER_TICK, atol=1e-6)


def test_ticks_of_a_calibrated_gripper_are_shares_of_its_range(so101, tmp_path):
    folder, ticks = of_ticks(tmp_path)
    dataset = read(folder, so101, tmp_path / "data")
    low, high = so101.qpos_range[5]
    share = (ticks[:, 5] - 805) / 2400
    assert np.allclose(
        dataset.read(dataset.entries[0]).ctrl[:, 5], low + share * (high - low), atol=1e-5
    )


def test_percent_of_a_calibrated_arm_become_angles(so101, tmp_path):
    percent = 90 * wave(120, 6, 1 / 30, amplitude=1.0)
    percent[:, 5] = np.abs(percent[:, 5])
    folder = stock(tmp_path / "set", [percent])
    (folder / "logs.toml").write_text('calibration = "arm.json"\n')
    (folder / "arm.json").write_text(json.dumps(CALIBRATION))
    dataset = read(folder, so101, tmp_path / "data", position_unit="signed_percent")
    ctrl = dataset.read(dataset.entries[0]).ctrl
    assert np.allclose(ctrl[:, :5], percent[:, :5] / 100 * 1200 * PER_TICK, atol=1e-5)


def test_a_calibration_of_another_arm_is_refused(so101, tmp_path):
    folder, _ = of_ticks(tmp_path)
    (folder / "arm.json").write_text(json.dumps({"left_hip": CALIBRATION["gripper"]}))
    with pytest.raises(UsageError, match="left_hip"):
        read(folder, so101, tmp_path / "data")


def test_percent_that_are_called_degrees_are_refused(so101, tmp_path):
    percent = np.clip(130 * wave(120, 6, 1 / 30, amplitude=1.0), -99, 100)  # the state is one less
    folder = stock(tmp_path / "set", [percent])
    with pytest.raises(LogError, match="signed_percent"):
        read(folder, so101, tmp_path / "data", position_unit="deg")


def test_degrees_that_are_called_percent_are_refused(so101, tmp_path):
    folder = stock(tmp_path / "set", [108 * wave(120, 6, 1 / 30, amplitude=1.0)])
    with pytest.raises(LogError, match="degrees"):
        read(folder, so101, tmp_path / "data", position_unit="signed_percent")


def test_steps_under_the_names_of_joints_are_no_position_targets_to_the_doctor(so101, tmp_path):
    path = 60 * wave(400, 6, 1 / 30, amplitude=1.0)
    path[:, 5] = np.abs(path[:, 5])
    folder = stock(tmp_path / "set", [path])
    file = folder / "data" / "chunk-000" / "file-000.parquet"
    table = pq.read_table(file)
    steps = np.diff(path, axis=0, append=path[-1:]).astype(np.float32)
    column = table.schema.get_field_index("action")
    action = pa.FixedSizeListArray.from_arrays(pa.array(steps.ravel()), 6)
    pq.write_table(table.set_column(column, "action", action), file)
    dataset = read(folder, so101, tmp_path / "data", position_unit="deg")
    findings = DoctorResult.of(dataset, so101).findings
    assert [f for f in findings if f.level == "error" and "deltas" in f.message]


def test_a_calibration_may_lie_in_the_home_folder(so101, tmp_path, monkeypatch):
    folder, ticks = of_ticks(tmp_path)
    monkeypatch.setenv("HOME", str(tmp_path))
    (folder / "arm.json").rename(tmp_path / "arm.json")
    (folder / "logs.toml").write_text('calibration = "~/arm.json"\nposition_unit = "ticks"\n')
    dataset = read(folder, so101, tmp_path / "data")
    ctrl = dataset.read(dataset.entries[0]).ctrl
    assert ctrl[0, 0] == pytest.approx((ticks[0, 0] - 2000) * PER_TICK, abs=1e-6)


@pytest.mark.parametrize(("inverted", "sign"), [(False, 1), (True, -1)])
def test_speeds_of_an_encoder_have_no_zero(inverted, sign):
    """2400 of 4095 ticks a turn are its range."""
    encoder = Encoder(800, 3200, inverted)
    still, fast = np.array([0.0]), np.array([240.0])
    assert encoder.angles(still, "ticks", speed=True) == 0
    assert encoder.angles(fast, "ticks", speed=True) == pytest.approx(240 * PER_TICK)
    assert encoder.fractions(still, speed=True) == 0
    assert encoder.fractions(fast, speed=True) == pytest.approx(sign * 0.1)


def test_an_inverted_gripper_is_open_where_its_reading_is_low():
    assert Encoder(800, 3200, True).fractions(np.array([800.0, 2600.0])).tolist() == [1, 0.25]


def test_a_range_that_ends_before_it_starts_is_refused(so101, tmp_path):
    folder, _ = of_ticks(tmp_path)
    turned = CALIBRATION["gripper"] | {"range_min": 3200, "range_max": 800}
    (folder / "arm.json").write_text(json.dumps(CALIBRATION | {"gripper": turned}))
    with pytest.raises(UsageError, match="gripper"):
        read(folder, so101, tmp_path / "data")


def test_a_feature_that_is_not_there_names_those_that_are(so101, tmp_path):
    folder = stock(tmp_path / "set")
    (folder / "logs.toml").write_text('ctrl = "goal.joints"\n')
    with pytest.raises(LogError, match=r"goal\.joints"):
        read(folder, so101, tmp_path / "data", position_unit="deg")


def test_names_of_values_may_lie_in_a_dictionary(so101, tmp_path):
    plain = read(stock(tmp_path / "plain"), so101, tmp_path / "a", position_unit="deg")
    folder = stock(tmp_path / "set")
    for feature in ("action", "observation.state"):
        file = folder / "meta" / "info.json"
        info = json.loads(file.read_text())
        info["features"][feature]["names"] = {"motors": list(SO101)}
        file.write_text(json.dumps(info))
    named = read(folder, so101, tmp_path / "b", position_unit="deg")
    assert {e.hash for e in named.entries} == {e.hash for e in plain.entries}


def test_a_joint_that_is_only_in_the_state_is_refused_by_name(so101, tmp_path):
    folder = renamed(stock(tmp_path / "set"), "action", (*SO101[:5], "lamp"))
    (folder / "logs.toml").write_text('ignore = ["lamp"]\n')
    with pytest.raises(JointMismatchError, match="gripper"):
        read(folder, so101, tmp_path / "data", position_unit="deg")


def test_a_unit_that_no_position_has_is_refused(so101, tmp_path):
    folder = stock(tmp_path / "set")
    with pytest.raises(UsageError, match="'inch'"):
        read(folder, so101, tmp_path / "data", position_unit="inch")
