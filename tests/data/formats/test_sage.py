"""SAGE folders: real timestamps, the robot's units, and a refusal by file and line of every row
that is not one.
"""

import numpy as np
import pytest
from logs import SERVO_NAMES, late, wave, write_sage, write_so101

from gaponet.base.errors import JointMismatchError, LogError, UsageError
from gaponet.data.formats import ReadOptions, detect, find_logs, look, read_logs


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
    low, high = so101.qpos_range[5]
    assert np.allclose(
        log.channels["ctrl"].values[:, 5], low + ctrl[:, 5] * (high - low)
    )  # a share of its range
    assert log.meta["converted_from"] == {"gripper": "fraction"}
    with pytest.raises(UsageError, match="--time-unit"):
        list(read_logs(tmp_path, so101, ReadOptions(time_unit="s")))


def test_the_period_tells_the_unit_of_time(tmp_path, so101):
    ctrl = wave(20, 6)
    for unit in (1e6, 1.0):
        write_sage(tmp_path / "wave", ctrl, ctrl, time=0.02 * unit * np.arange(20))
        ((_, log),) = read_logs(tmp_path, so101)
        assert np.diff(log.channels["qpos"].time) == pytest.approx(0.02)
    write_sage(tmp_path / "wave", ctrl, ctrl, time=20.0 * np.arange(20))
    with pytest.raises(LogError, match="period"):
        list(read_logs(tmp_path, so101))


@pytest.mark.parametrize(("old", "new"), [(b"CONTROL", b"Control"), (b"\n", b"\r\n")])
def test_neither_case_nor_line_ends_matter(motion, so101, old, new):
    before = next(read_logs(motion, so101))[1]
    control = motion / "control.csv"
    control.write_bytes(control.read_bytes().replace(old, new))
    assert np.array_equal(
        next(read_logs(motion, so101))[1].channels["ctrl"].values, before.channels["ctrl"].values
    )


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
        ("CONTROL", "\nCONTROL"),
    ],
)
def test_a_row_that_is_none_is_refused_by_file_and_line(motion, so101, old, new):
    edit(motion / "control.csv", 7, old, new)
    with pytest.raises(LogError, match=r"control\.csv:7:"):
        list(read_logs(motion, so101))


@pytest.mark.parametrize(
    ("file", "content", "message"),
    [
        ("control.csv", b"", r"control\.csv:1:"),
        ("state_motor.csv", b"type,timestamp,positions,positions\n", "twice"),
        ("control.csv", None, r"control\.csv"),
        ("joint_list.txt", None, r"joint_list\.txt"),
        ("control.csv", b"type,timestamp,positions\n", "rows"),
        ("state_motor.csv", b"type,timestamp,velocities\n", "'positions'"),
        ("control.csv", b"time,a,b\n1,2,3\n", r"control\.csv:1:"),
        ("control.csv", b"\xff\xfe\x00\x01", r"control\.csv:1:"),
        ("joint_list.txt", b"", "empty"),
        ("joint_list.txt", b"\xff\xfe", "UTF-8"),
        ("joint_list.txt", b"Rotation\nRotation\nElbow\nWrist_Pitch\nWrist_Roll\nJaw\n", "map"),
    ],
)
def test_a_broken_file_is_named(motion, so101, file, content, message):
    (motion / file).write_bytes(content) if content is not None else (motion / file).unlink()
    with pytest.raises((LogError, JointMismatchError), match=message):
        list(read_logs(motion, so101))


def test_a_joint_of_another_robot_says_how_to_map_it(motion, so101):
    (motion / "joint_list.txt").write_text(
        "\n".join([*SERVO_NAMES[:2], "forearm", *SERVO_NAMES[3:]])
    )
    with pytest.raises(JointMismatchError, match="forearm"):
        list(read_logs(motion, so101))
    ((_, log),) = read_logs(motion, so101, ReadOptions(joint_map={"forearm": "elbow_flex"}))
    assert log.joint_names == so101.joint_names


def test_swapped_files_are_known_by_the_type_of_their_rows(motion, so101):
    control, state = motion / "control.csv", motion / "state_motor.csv"
    texts = control.read_text(), state.read_text()
    control.write_text(texts[1])
    state.write_text(texts[0])
    with pytest.raises(
        LogError,
        match="STATE_MOTOR",
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
    with pytest.raises(
        LogError,
        match=rf"1e\+30 {unit}",
    ):
        list(read_logs(folder, so101, ReadOptions(strict=True)))
    ((_, log),) = read_logs(folder, so101)
    channel = ("", "qvel", "tau")[column]
    told = log.meta["notes"]["nonsense"][channel]
    assert (told["rows"], told["joints"], told["worst"]) == (1, ["shoulder_pan"], 1e30)
    assert abs(log.channels[channel].values[7, 0]) < 20.0


def test_a_folder_without_a_motion_is_refused(tmp_path, so101):
    with pytest.raises(LogError, match="SAGE"):
        list(read_logs(tmp_path, so101, ReadOptions("sage")))


def test_a_list_that_no_channel_holds_is_left_alone(motion, so101):
    before = next(read_logs(motion, so101))[1]
    state = motion / "state_motor.csv"
    state.write_text(state.read_text().replace("torques", "currents", 1))
    log = next(read_logs(motion, so101))[1]
    assert log.channels.keys() == before.channels.keys() - {"tau"}
    assert np.array_equal(log.channels["qpos"].values, before.channels["qpos"].values)


def test_a_clock_that_stands_still_is_refused_by_line(tmp_path, so101):
    ctrl = wave(20, 6)
    write_sage(tmp_path / "wave", ctrl, ctrl, time=np.full(20, 7.0))
    with pytest.raises(LogError, match=r"\.csv:3:"):
        list(read_logs(tmp_path, so101))


def test_what_a_sage_folder_holds_needs_no_guess(motion):
    with pytest.raises(UsageError, match="itself"):
        look(motion)
