"""A command that repeats the state is named, whatever clock and digits; and a robot that is driven
by torque.
"""

import numpy as np
import pytest
from arm import recordings
from logs import arm_columns, table_text
from scipy.signal import lfilter

from gaponet.cli.main import main
from gaponet.data.describe.row_copies import copied_rows
from gaponet.data.doctor import DoctorResult
from gaponet.data.importer import ImportRequest, import_logs
from gaponet.data.log import Channel

ROWS = 400
TICK = 2 * np.pi / 4096
JOINTS = ("shoulder", "elbow")


def led_by_hand(seed: int) -> np.ndarray:
    """Positions of a hand-led arm, (ROWS, 2) rad."""
    rng = np.random.default_rng(seed)
    t = np.linspace(0, 8, ROWS)[:, None]
    return 0.6 * np.sin(rng.uniform(1, 3, 2) * t + rng.uniform(0, 6, 2)) + rng.normal(
        0, 1e-3, (ROWS, 2)
    )


def clock(seed: int, uneven: bool) -> np.ndarray:
    jitter = np.random.default_rng(seed).uniform(-0.006, 0.006, ROWS) if uneven else 0.0
    return 0.02 * np.arange(ROWS) + jitter


def imported(folder, arm, time, ctrl, qpos, **more):
    folder.mkdir()
    columns = {"time": time}
    for j, joint in enumerate(JOINTS):
        columns |= {f"ctrl.{joint}": ctrl[:, j], f"qpos.{joint}": qpos[:, j]}
        columns |= {f"{channel}.{joint}": values[:, j] for channel, values in more.items()}
    (folder / "m.csv").write_text(table_text(columns))
    units = {"position_unit": "rad", "time_unit": "s"}
    return import_logs(
        folder, arm, folder / "data", ImportRequest(unit_id="u", payload_mass=0.0, **units)
    ).dataset


def errors(dataset, arm):
    return [f for f in DoctorResult.of(dataset, arm).findings if f.level == "error"]


@pytest.mark.parametrize("uneven", [False, True])
@pytest.mark.parametrize("step", [0.0, TICK, 1e-3])
@pytest.mark.parametrize("rows", [-2, 1, 3])
def test_the_position_of_another_row_as_command_is_an_error_also_with_an_uneven_clock(
    tmp_path, arm, rows, step, uneven
):
    qpos = led_by_hand(rows + 5)
    if step:
        qpos = np.round(qpos / step) * step
    data = imported(tmp_path / "logs", arm, clock(1, uneven), np.roll(qpos, -rows, axis=0), qpos)
    (error,) = errors(data, arm)
    assert (error.check, error.joints, error.values["rows"]) == ("copied", JOINTS, rows)


def test_a_position_that_is_the_rounded_command_is_a_copy(tmp_path, arm):
    told = led_by_hand(3)
    seen = np.round(np.roll(told, 1, axis=0), 3)
    (error,) = errors(imported(tmp_path / "logs", arm, clock(2, True), told, seen), arm)
    assert error.check == "copied"


def test_a_long_recording_is_judged_by_a_part_of_its_rows():
    rows = 60_000
    told = np.random.default_rng(0).normal(size=(rows, 1)).cumsum(axis=0) * 1e-3
    time = 0.02 * np.arange(rows)
    assert copied_rows(Channel(time, told), Channel(time, np.roll(told, 2, axis=0))) == 2
    followed = Channel(time, 0.99 * np.roll(told, 2, axis=0))
    assert np.isnan(copied_rows(Channel(time, told), followed)).all()


@pytest.mark.parametrize("step", [1e-9, 1e-4, TICK, 1e-2])
def test_a_simulated_servo_repeats_no_command(arm, step):
    for sequence in recordings(arm, 3):
        time = sequence.dt * np.arange(len(sequence))
        both = [np.round(x / step) * step for x in (sequence.ctrl, sequence.qpos)]
        rows = copied_rows(*(Channel(time, values) for values in both))
        assert np.isnan(rows).all()


@pytest.mark.parametrize("uneven", [False, True])
def test_without_commands_and_with_torque_a_robot_is_taken_as_driven_by_torque(
    tmp_path, arm, uneven
):
    qpos = led_by_hand(7)
    data = imported(tmp_path / "logs", arm, clock(3, uneven), qpos, qpos, tau=0.5 * qpos)
    findings = DoctorResult.of(data, arm).findings
    assert [f.check for f in findings if f.level == "error"] == []
    (warning,) = [f for f in findings if f.check == "copied"]
    assert "torque" in warning.message
    assert not [f for f in findings if f.check in ("lag", "sag", "timing", "rests")]


def test_current_beside_position_commands_is_refused_and_not_ignored(tmp_path, arm, capsys):
    columns = arm_columns(ROWS)
    columns |= {f"tau.{joint}": columns[f"qpos.{joint}"] for joint in JOINTS}
    (tmp_path / "m.csv").write_text(table_text(columns))
    words = ["--robot", str(arm.folder), "--unit-id", "u", "--payload-mass", "0", "--out"]
    units = ["--time-unit", "s", "--position-unit", "rad"]
    assert main(["import", str(tmp_path / "m.csv"), *words, str(tmp_path / "data"), *units]) == 0
    assert (
        main(["identify", str(tmp_path / "data"), "--out", str(tmp_path / "id"), "--current"]) == 2
    )
    assert "--current" in capsys.readouterr().err


@pytest.mark.parametrize("noise", [1e-4, 1e-3])
@pytest.mark.parametrize("rows", [-1, 0, 2])
def test_a_copy_with_noise_on_it_is_an_error(tmp_path, arm, rows, noise):
    qpos = led_by_hand(rows + 5)
    told = np.roll(qpos, -rows, axis=0)
    told += np.random.default_rng(0).normal(0, noise, told.shape)
    (error,) = errors(imported(tmp_path / "logs", arm, clock(1, True), told, qpos), arm)
    assert (error.check, error.joints, error.values["rows"]) == ("copied", JOINTS, rows)


@pytest.mark.parametrize("noise", [1e-5, 1e-4, 1e-3])
def test_a_simulated_servo_with_noisy_encoders_repeats_no_command(arm, noise):
    rng = np.random.default_rng(0)
    for sequence in recordings(arm, 3):
        time = sequence.dt * np.arange(len(sequence))
        read = sequence.qpos + rng.normal(0, noise, sequence.qpos.shape)
        assert np.isnan(copied_rows(Channel(time, sequence.ctrl), Channel(time, read))).all()


def test_an_error_that_changes_over_some_rows_is_a_servos_also_in_a_long_recording():
    rows = 400_000  # 400 s at 1 kHz
    rng = np.random.default_rng(0)
    told = rng.normal(size=(rows, 1)).cumsum(axis=0) * 1e-3
    error = lfilter([1.0], [1.0, -0.8], 1e-4 * rng.normal(size=(rows, 1)), axis=0)
    time = 1e-3 * np.arange(rows)
    assert np.isnan(copied_rows(Channel(time, told), Channel(time, told + error))).all()
