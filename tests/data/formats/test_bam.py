"""BAM's logs: one servo, its load and its gain said in the file."""

import json
from dataclasses import replace

import numpy as np
import pytest
from logs import late, wave, write_bam

from gaponet.base.errors import JointMismatchError, LogError, UsageError
from gaponet.data.formats import ReadOptions, detect, read_logs
from gaponet.data.importer import ImportRequest, import_logs
from gaponet.robot.spec import load_robot
from gaponet.sim.batch import Condition


@pytest.fixture(scope="module")
def bench():
    return load_robot("xl330_bench")


def with_type(bench, servo):
    """Return the bench with another type of servo."""
    return replace(bench, servo=replace(bench.servo, types=(servo,)))


def test_a_recording_says_its_gain_and_its_load(tmp_path, bench):
    write_bam(tmp_path / "a.json")
    write_bam(tmp_path / "b.json", kp=100, vin=5.0, trajectory="up", length=0.15, arm_mass=0.02)
    (tmp_path / "notes.json").write_text('{"entries": "of a diary"}')
    assert detect(tmp_path) == detect(tmp_path / "a.json") == "bam"
    report = import_logs(tmp_path, bench, tmp_path / "data", ImportRequest(unit_id="mine"))
    first, second = report.dataset.sequences(report.entries)
    assert first.meta.motion == "sin_sin"
    assert (first.meta.payload_mass, first.meta.payload_side) == (0.49, "100mm")
    np.testing.assert_allclose(
        first.meta.kp, bench.servo.kp, rtol=1e-3
    )  # robot.toml is at the factory's gain and 7.4 V
    assert Condition.of(first, bench).kp is None
    assert (second.meta.payload_mass, second.meta.payload_side) == (0.5, "150mm")
    np.testing.assert_allclose(second.meta.kp, bench.servo.kp / 4 * 5.0 / 7.4, rtol=1e-3)
    np.testing.assert_allclose(Condition.of(second, bench).kp, second.meta.kp)
    np.testing.assert_allclose(first.qpos[:, 0], late(wave(60, 1, 0.0053), 3)[:, 0], atol=1e-6)
    assert sorted(report.entries[0].channels) == ["ctrl", "qpos", "qvel", "temperature"]


def test_a_supply_voltage_that_the_servo_contradicts_is_named(tmp_path, bench, caplog):
    file = write_bam(tmp_path / "a.json", vin=15.0)
    told = json.loads(file.read_text())
    for volts, warned in ((14.8, False), (12.0, True)):
        told["entries"] = [e | {"input_volts": volts} for e in told["entries"]]
        file.write_text(json.dumps(told))
        for _, load in read_logs(file, bench):
            assert load.channels
        assert ("vin says 15 V, the servo measured 12 V" in caplog.text) is warned


def test_a_recording_ends_where_torque_is_switched_off(tmp_path, bench):
    report = import_logs(
        write_bam(tmp_path / "a.json", off=40),
        bench,
        tmp_path / "data",
        ImportRequest(unit_id="mine"),
    )
    assert (report.entries[0].rows, report.entries[0].meta.notes["cut"]) == (
        40,
        "torque is off from 0.22 s on",
    )


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"off": 1}, "off"),
        ({"kp": 0}, "kp"),
        ({"mass": -1}, "mass"),
        ({"entries": []}, "entries"),
        ({"entries": [{"position": "high"}] * 3}, r"entries\[0\]"),
    ],
)
def test_what_cannot_be_a_recording_is_refused(tmp_path, bench, changes, message):
    with pytest.raises(LogError, match=message):
        list(read_logs(write_bam(tmp_path / "a.json", **changes), bench, ReadOptions("bam")))


def test_any_servo_comes_in_whose_gain_law_robot_toml_states(tmp_path, bench):
    servo = replace(
        bench.servo.types[0], gain=0.02, gain_volts=None
    )  # one whose current follows the error
    log_joints = replace(bench.log_joints, aliases={"mx64": "motor"})
    mine = replace(with_type(bench, servo), log_joints=log_joints)
    ((_, log),) = read_logs(write_bam(tmp_path / "a.json", motor="mx64", kp=50, vin=12.0), mine)
    assert log.meta["kp"] == [pytest.approx(1.0)]
    with pytest.raises(JointMismatchError, match="mx64"):
        list(read_logs(tmp_path, bench))
    with pytest.raises(
        LogError,
        match="gain_volts",
    ):
        list(read_logs(tmp_path, with_type(mine, replace(servo, gain=None))))


def test_an_arm_of_another_length_is_named(tmp_path, bench):
    with pytest.raises(UsageError, match="123mm"):
        import_logs(
            write_bam(tmp_path / "a.json", length=0.123),
            bench,
            tmp_path / "data",
            ImportRequest(unit_id="mine"),
        )


def test_a_folder_that_is_called_like_a_recording_is_none(tmp_path):
    (tmp_path / "x.json").mkdir()
    with pytest.raises(LogError, match="sage"):
        detect(tmp_path)
