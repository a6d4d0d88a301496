"""SAGE folders: real timestamps, the robot's units, and a refusal by file and line of every row that is not one."""

import numpy as np
import pytest
from logs import PERIOD_US, SERVO_NAMES, late, wave, write_sage, write_so101

from gaponet.base.errors import JointMismatchError, LogError, UsageError
from gaponet.data.formats import detect, find_logs, read_logs


def edit(file, line: int, old: str, new: str) -> None:
    """Replace text in one line, counted from 1."""
    lines = file.read_text().split("\n")
    assert old in lines[line - 1]
    lines[line - 1] = lines[line - 1].replace(old, new, 1)
    file.write_text("\n".join(lines))


@pytest.fixture
def motion(tmp_path):
    return write_so101(tmp_path / "real" / "so101" / "custom" / "wave")


def test_numbers_and_joints_come_back_as_written(tmp_path, so101):
    ctrl = wave(20, 6)
    tau = np.abs(wave(20, 6))
    write_sage(tmp_path / "wave", ctrl, late(ctrl, 1), tau)
    ((name, log),) = read_logs(tmp_path, so101)
    assert name == "wave"
    assert log.joint_names == so101.joint_names
    assert np.array_equal(log.channels["ctrl"].values[:, :5], ctrl[:, :5])
    assert np.array_equal(log.channels["qpos"].values[:, :5], late(ctrl, 1)[:, :5])
    assert np.array_equal(log.channels["tau"].values, tau)


def test_microseconds_become_seconds(motion, so101):
    ((_, log),) = read_logs(motion, so101)
    assert np.diff(log.channels["ctrl"].time) == pytest.approx(PERIOD_US * 1e-6)


def test_seconds_stay_seconds(tmp_path, so101):
    ctrl = wave(20, 6)
    write_sage(tmp_path / "wave", ctrl, ctrl, time=0.02 * np.arange(20))
    ((_, log),) = read_logs(tmp_path, so101)
    assert np.diff(log.channels["qpos"].time) == pytest.approx(0.02)


def test_a_gripper_at_one_half_stands_in_the_middle_of_its_range(tmp_path, so101):
    ctrl = np.full((20, 6), 0.5)
    write_sage(tmp_path / "wave", ctrl, ctrl)
    ((_, log),) = read_logs(tmp_path, so101)
    assert log.channels["qpos"].values[0] == pytest.approx([0.5] * 5 + [(-0.17453298 + 1.7453292) / 2])
    assert log.meta["converted_from"] == {"gripper": "fraction"}


def test_the_case_of_the_row_type_does_not_matter(motion, so101):
    before = next(read_logs(motion, so101))[1]
    control = motion / "control.csv"
    control.write_text(control.read_text().replace("CONTROL", "Control"))
    assert np.array_equal(next(read_logs(motion, so101))[1].channels["ctrl"].values, before.channels["ctrl"].values)


def test_windows_line_ends_do_not_matter(motion, so101):
    before = next(read_logs(motion, so101))[1]
    state = motion / "state_motor.csv"
    state.write_bytes(state.read_bytes().replace(b"\n", b"\r\n"))
    assert np.array_equal(next(read_logs(motion, so101))[1].channels["qpos"].values, before.channels["qpos"].values)


def test_simulated_motions_are_left_out(tmp_path, so101):
    write_so101(tmp_path / "real" / "so101" / "custom" / "b")
    write_so101(tmp_path / "real" / "so101" / "custom" / "a")
    write_so101(tmp_path / "sim" / "so101" / "custom" / "a")
    assert detect(tmp_path) == "sage"
    assert [name for name, _ in read_logs(tmp_path, so101)] == ["a", "b"]
    assert [folder.name for folder in find_logs(tmp_path)] == ["a", "b"]


@pytest.mark.parametrize(
    ("old", "new"),
    [
        (']"', ""),
        ('"[', '"[0.1, '),
        ('"[', '"[0.1 '),
        ('"[', '"[0.1.2'),
        ('"[', '"[- '),
        ('"[', '"[, '),
        ("CONTROL,", "CONTROL,x"),
        ("CONTROL,", "CONTROL,,"),
        ("CONTROL,", ""),
    ],
)
def test_a_row_that_is_none_is_refused_by_file_and_line(motion, so101, old, new):
    edit(motion / "control.csv", 7, old, new)
    with pytest.raises(LogError, match=r"control\.csv:7: expected TYPE,timestamp and 1 list\(s\) of 6 numbers, got"):
        list(read_logs(motion, so101))


def test_a_file_cut_short_names_its_last_line(motion, so101):
    state = motion / "state_motor.csv"
    text = state.read_text()
    state.write_text(text[: text.rindex(",")])
    with pytest.raises(LogError, match=r"state_motor\.csv:61: expected .*; the file may be cut short: remove the row"):
        list(read_logs(motion, so101))


def test_a_blank_line_between_rows_is_no_row(motion, so101):
    edit(motion / "control.csv", 9, "CONTROL", "\nCONTROL")
    with pytest.raises(LogError, match=r"control\.csv:9: expected"):
        list(read_logs(motion, so101))


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_a_value_that_is_not_finite_is_refused_by_file_line_and_joint(tmp_path, so101, value):
    ctrl = wave(20, 6)
    qpos = ctrl.copy()
    qpos[3, 1] = value
    write_sage(tmp_path / "wave", ctrl, qpos)
    with pytest.raises(LogError, match=r"state_motor\.csv:5: qpos of shoulder_lift is not finite"):
        list(read_logs(tmp_path, so101))


def test_time_going_back_is_refused_by_file_and_line(tmp_path, so101):
    time = PERIOD_US * np.arange(20)
    time[10] = 3.0
    write_sage(tmp_path / "wave", wave(20, 6), wave(20, 6), time=time)
    with pytest.raises(LogError, match=r"\.csv:12: time does not increase in channel"):
        list(read_logs(tmp_path, so101))


def test_milliseconds_are_neither_unit(tmp_path, so101):
    ctrl = wave(20, 6)
    write_sage(tmp_path / "wave", ctrl, ctrl, time=20.0 * np.arange(20))
    with pytest.raises(LogError, match="the median period is 20, neither microseconds nor seconds"):
        list(read_logs(tmp_path, so101))


def test_degrees_are_refused(tmp_path, so101):
    ctrl = wave(20, 6, amplitude=40.0)
    write_sage(tmp_path / "wave", ctrl, ctrl)
    with pytest.raises(LogError, match=r"control\.csv:\d+: ctrl of shoulder_pan is .* these look like degrees"):
        list(read_logs(tmp_path, so101))


@pytest.mark.parametrize(
    ("file", "content", "message"),
    [
        ("control.csv", b"", r"control\.csv:1: header is ''"),
        ("control.csv", b"type,timestamp,positions\n", r"control\.csv: holds no rows"),
        (
            "state_motor.csv",
            b"type,timestamp,velocities\n",
            r"state_motor\.csv:1: column 'positions' is missing; .*has: t",
        ),
        (
            "control.csv",
            b"time,a,b\n1,2,3\n",
            r"control\.csv:1: header is 'time,a,b', expected type,timestamp,positions",
        ),
        ("control.csv", b"\xff\xfe\x00\x01", r"control\.csv:1: header is"),
        ("joint_list.txt", b"", r"joint_list\.txt: empty; one joint name a line"),
        ("joint_list.txt", b"\xff\xfe", r"joint_list\.txt: not UTF-8 text"),
        ("joint_list.txt", b"Rotation\nRotation\nElbow\nWrist_Pitch\nWrist_Roll\nJaw\n", "two names map to one joint"),
    ],
)
def test_a_broken_file_is_named(motion, so101, file, content, message):
    (motion / file).write_bytes(content)
    with pytest.raises((LogError, JointMismatchError), match=message):
        list(read_logs(motion, so101))


@pytest.mark.parametrize("file", ["control.csv", "state_motor.csv", "joint_list.txt"])
def test_a_missing_file_is_named(motion, so101, file):
    (motion / file).unlink()
    with pytest.raises(LogError, match=f"{file}: (is )?missing"):
        list(read_logs(motion, so101))


def test_a_joint_of_another_robot_says_how_to_map_it(motion, so101):
    (motion / "joint_list.txt").write_text("\n".join([*SERVO_NAMES[:2], "forearm", *SERVO_NAMES[3:]]))
    with pytest.raises(JointMismatchError, match=r"joint_list\.txt names joint 'forearm', which robot 'so101'"):
        list(read_logs(motion, so101))
    ((_, log),) = read_logs(motion, so101, joint_map={"forearm": "elbow_flex"})
    assert log.joint_names == so101.joint_names


def test_units_are_not_asked_of_a_format_that_fixes_them(motion, so101):
    with pytest.raises(UsageError, match="--time-unit means nothing to the sage format"):
        list(read_logs(motion, so101, time_unit="s", logs=None))


def test_real_logs_run_at_their_own_rate(sage_so101, so101):
    name, log = next(read_logs(sage_so101, so101))
    assert name == "actuator_bandwidth"
    assert np.median(np.diff(log.channels["qpos"].time)) == pytest.approx(0.02006, abs=1e-5)
    assert log.meta["events"][0] == ["0", "CONTROL_MODE_ENABLE"]


def test_swapped_files_are_known_by_the_type_of_their_rows(motion, so101):
    control, state = motion / "control.csv", motion / "state_motor.csv"
    texts = control.read_text(), state.read_text()
    control.write_text(texts[1])
    state.write_text(texts[0])
    with pytest.raises(
        LogError, match=r"control\.csv:2: a row of type 'STATE_MOTOR', not CONTROL: are the files swapped"
    ):
        list(read_logs(motion, so101))


def test_one_row_of_another_type_is_named(motion, so101):
    edit(motion / "state_motor.csv", 7, "STATE_MOTOR", "CONTROL")
    with pytest.raises(LogError, match=r"state_motor\.csv:7: a row of type 'CONTROL', not STATE_MOTOR"):
        list(read_logs(motion, so101))


def test_a_header_with_positions_twice_is_refused(motion, so101):
    edit(motion / "state_motor.csv", 1, "velocities", "positions")
    with pytest.raises(
        LogError, match=r"state_motor\.csv:1: a column stands twice in the header type, timestamp, positions, positions"
    ):
        list(read_logs(motion, so101))


@pytest.mark.parametrize(("column", "unit"), [(1, "rad/s"), (2, "N·m")])
def test_what_no_joint_does_costs_that_channel_there_and_is_said(tmp_path, so101, column, unit):
    folder = write_so101(tmp_path / "wave")
    state = folder / "state_motor.csv"
    lines = state.read_text().split("\n")
    cells = lines[8].split('","')
    cells[column] = cells[column].replace("0.0", "1e30", 1)
    lines[8] = '","'.join(cells)
    state.write_text("\n".join(lines))
    with pytest.raises(LogError, match=rf"state_motor\.csv:9: .* of shoulder_pan is 1e\+30 {unit}: no joint does that"):
        list(read_logs(folder, so101, strict=True))
    ((_, log),) = read_logs(folder, so101)
    channel = ("", "qvel", "tau")[column]
    told = log.meta["notes"]["nonsense"][channel]
    assert (told["rows"], told["joints"], told["worst"]) == (1, ["shoulder_pan"], 1e30)
    assert abs(log.channels[channel].values[7, 0]) < 20.0
