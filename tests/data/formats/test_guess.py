"""The logs.toml that is guessed: what it asks where names leave something open, and when a person
has to look at it first.
"""

import tomllib

import numpy as np
import pytest
from logs import arm_columns, table_text

from gaponet.base.errors import LogError, UsageError
from gaponet.data.describe.guess import guess_logs
from gaponet.data.describe.preview import DescriptionNeededError, read_first_recording
from gaponet.data.formats import ReadOptions, look, read_logs

COLUMNS = arm_columns(200)
TIME = COLUMNS["time"]
COMMAND = np.stack([COLUMNS["ctrl.shoulder"], COLUMNS["ctrl.elbow"]], axis=1)
STATE = np.stack([COLUMNS["qpos.shoulder"], COLUMNS["qpos.elbow"]], axis=1)
SPEED = np.gradient(STATE, 0.02, axis=0)


def guessed(path, robot):
    """Lines of the logs.toml that is guessed."""
    kind, known, found = look(path)
    return guess_logs(found, robot, kind, dict(known)).splitlines()


def by_joint(pattern, values, joints=("shoulder", "elbow")):
    """Columns with a joint's name at the {}."""
    return {pattern.format(joint): values[:, j] for j, joint in enumerate(joints)}


def write(file, columns):
    file.write_text(table_text(columns))
    return file


def test_no_recording_gives_no_description(arm):
    with pytest.raises(LogError, match="recording"):
        guess_logs([], arm, "table", {})


def test_states_and_torques_without_commands_may_be_of_a_robot_driven_by_torque(tmp_path, arm):
    columns = {"t": TIME} | by_joint("{}_pos", STATE) | by_joint("{}_torque", SPEED)
    lines = guessed(write(tmp_path / "m.csv", columns), arm)
    assert any(line.startswith("# ctrl =") for line in lines)
    assert any("driven by torque" in line for line in lines)


@pytest.mark.parametrize(("values", "channel"), [(COMMAND, "ctrl"), (SPEED, "qvel")])
def test_an_array_qd_is_the_desired_position_or_the_velocity_by_what_it_holds(
    tmp_path, arm, values, channel
):
    np.savez(tmp_path / "m.npz", t=TIME, q=STATE, qd=values)
    assert f'{channel} = "qd"' in guessed(tmp_path, arm)


@pytest.mark.parametrize("patterns", [("{}_pos", "{}_cmd"), ("{}", "{}")], ids=str)
def test_state_and_command_in_two_files_of_different_names_are_one_recording(
    tmp_path, arm, patterns
):
    state, command = patterns
    write(tmp_path / "robot_states.csv", {"t": TIME} | by_joint(state, STATE))
    write(tmp_path / "goal_command.csv", {"t": TIME} | by_joint(command, COMMAND))
    (tmp_path / "logs.toml").write_text("\n".join(guessed(tmp_path, arm)))
    ((_, log),) = read_logs(tmp_path, arm)
    assert np.array_equal(log.channels["ctrl"].values, COMMAND)
    assert np.array_equal(log.channels["qpos"].values, STATE)


def test_files_of_states_torques_and_times_ask_for_what_is_not_there(tmp_path, arm):
    for name in ("a", "b"):
        for kind, values in (("pos", STATE), ("torque", SPEED), ("time", TIME)):
            np.savetxt(tmp_path / f"{name}_{kind}.csv", values, delimiter=",")
    lines = guessed(tmp_path, arm)
    assert 'time_file = "{name}_time.csv"  # ?' in lines
    assert "# not read: {name}_torque.csv" in lines
    assert not any("command_file" in line for line in lines)


def test_an_uneven_clock_and_one_of_no_usual_rate_are_told(tmp_path, arm):
    rng = np.random.default_rng(0)
    uneven = np.cumsum(rng.uniform(10, 30, 200))
    lines = guessed(write(tmp_path / "uneven.csv", COLUMNS | {"time": uneven}), arm)
    assert any(line.startswith('time_unit = "ms"') and "uneven" in line for line in lines)
    slow = 5e10 * np.arange(200.0)  # 50 s, if they were ns
    lines = guessed(write(tmp_path / "slow.csv", COLUMNS | {"time": slow}), arm)
    assert any(line.startswith('time_unit = "s"') for line in lines)


def test_a_single_row_has_no_period_to_tell_the_unit_of_time_by(tmp_path, arm):
    one = {name: values[:1] for name, values in COLUMNS.items()}
    lines = guessed(write(tmp_path / "m.csv", one), arm)
    assert any(line.startswith('time_unit = "s"  # ?') for line in lines)


def test_two_arrays_of_commands_are_both_named(tmp_path, arm):
    np.savez(tmp_path / "m.npz", t=TIME, q=STATE, action_left=COMMAND, action_right=COMMAND)
    (line,) = [line for line in guessed(tmp_path, arm) if line.startswith("ctrl =")]
    assert "also: action_right" in line


def test_names_are_matched_in_order_only_where_as_many_are_left(tmp_path, arm):
    two = by_joint("{}_cmd", COMMAND, ("j_a", "j_b")) | by_joint("{}_pos", STATE, ("j_a", "j_b"))
    lines = guessed(write(tmp_path / "two.csv", {"t": TIME} | two), arm)
    assert '"j_a" = "shoulder"' in lines
    three = {"j_c_cmd": COMMAND[:, 0], "j_c_pos": STATE[:, 0]}
    lines = guessed(write(tmp_path / "three.csv", {"t": TIME} | two | three), arm)
    assert '"j_a" = "…"' in lines


def test_a_column_without_a_name_may_be_any_joint(tmp_path, arm):
    np.savez(tmp_path / "m.npz", t=TIME, q=STATE[:, :1], cmd=COMMAND[:, :1])
    (line,) = [line for line in guessed(tmp_path, arm) if line.startswith("joints =")]
    assert line.startswith('joints = ["shoulder"]')
    assert "which" in line


def test_commands_by_other_names_than_the_states_are_named_too(tmp_path, arm):
    names = ("motor_a", "motor_b")
    columns = {"t": TIME} | by_joint("{}_pos", STATE) | by_joint("{}_cmd", COMMAND, names)
    lines = guessed(write(tmp_path / "m.csv", columns), arm)
    start = lines.index("[names]")
    assert lines[start + 2 : start + 4] == ['"motor_a" = "shoulder"', '"motor_b" = "elbow"']


def test_commands_by_other_names_stand_under_names_where_a_position_is_ignored(tmp_path, arm):
    columns = {"t": TIME} | by_joint("q_{}", STATE) | {"q_camera": TIME}
    columns |= by_joint("cmd_{}", COMMAND, ("m1", "m2"))
    file = write(tmp_path / "m.csv", columns)
    toml = tomllib.loads("\n".join(guessed(file, arm)))
    assert toml["ignore"] == ["camera"]
    assert toml["names"] == {"1": "shoulder", "2": "elbow"}


def test_commands_by_number_in_an_array_beside_states_by_name_ask_for_their_order(tmp_path, arm):
    np.savez(tmp_path / "m.npz", t=TIME, action=COMMAND, **by_joint("{}_pos", STATE))
    (line,) = [line for line in guessed(tmp_path, arm) if line.startswith("joints =")]
    assert line.startswith('joints = ["shoulder", "elbow"]')


def test_a_rate_that_is_stated_already_is_kept(tmp_path, arm):
    (tmp_path / "logs.toml").write_text("rate = 100.0\n")
    write(tmp_path / "m.csv", COLUMNS)
    assert "rate = 100  # Hz" in guessed(tmp_path, arm)


def test_positions_to_exactly_100_are_percent_of_the_range(tmp_path, arm):
    percent = {name: np.clip(500 * values, -100, 100) for name, values in COLUMNS.items()}
    lines = guessed(write(tmp_path / "m.csv", percent | {"time": TIME}), arm)
    assert any(line.startswith('position_unit = "signed_percent"') for line in lines)


def test_a_row_of_units_says_the_unit_of_positions(tmp_path, arm):
    names, *rows = table_text(COLUMNS).splitlines()
    small = ",".join(["s", *["deg"] * 4])
    (tmp_path / "m.csv").write_text("\n".join([names, small, *rows]) + "\n")
    assert 'position_unit = "deg"' in guessed(tmp_path, arm)


def test_a_final_number_counts_repetitions_of_equal_commands_only(tmp_path, arm):
    for name, values in (("a_1", COLUMNS), ("a_2", COLUMNS)):
        write(tmp_path / f"{name}.csv", values)
    assert 'motion = "{motion}_{rep}"' in guessed(tmp_path, arm)
    other = {name: np.flip(values) for name, values in COLUMNS.items()} | {"time": TIME}
    write(tmp_path / "a_2.csv", other)
    assert 'motion = "{motion}"' in guessed(tmp_path, arm)


SI = ReadOptions(position_unit="rad", time_unit="s")


def test_logs_that_say_everything_are_read_without_a_guess(tmp_path, arm):
    log, count, described = read_first_recording(write(tmp_path / "m.csv", COLUMNS), arm, SI)
    assert (log.joint_names, count, described) == (("shoulder", "elbow"), 1, "")


def test_logs_that_say_nothing_of_units_are_read_by_a_guess_that_comes_back(tmp_path, arm):
    logs = write(tmp_path / "m.csv", COLUMNS)
    log, _, described = read_first_recording(logs, arm, ReadOptions())
    assert np.array_equal(log.channels["qpos"].values, STATE)
    assert 'position_unit = "rad"' in described


def test_a_guess_of_which_joint_is_which_is_for_a_person_to_look_at(tmp_path, arm):
    names = ("j_a", "j_b")
    columns = {"t": TIME} | by_joint("{}_cmd", COMMAND, names) | by_joint("{}_pos", STATE, names)
    logs = write(tmp_path / "m.csv", columns)
    with pytest.raises(DescriptionNeededError, match="guess") as refused:
        read_first_recording(logs, arm, ReadOptions())
    assert '"j_a" = "shoulder"' in refused.value.text
    log, _, _ = read_first_recording(logs, arm, ReadOptions(), anyhow=True)
    assert np.array_equal(log.channels["ctrl"].values, COMMAND)


def test_a_guess_by_which_nothing_can_be_read_says_why(tmp_path, arm):
    logs = write(tmp_path / "m.csv", {"t": TIME} | by_joint("{}_pos", STATE))
    with pytest.raises(DescriptionNeededError, match="ctrl") as refused:
        read_first_recording(logs, arm, ReadOptions())
    assert "# ctrl" in refused.value.text


def test_nothing_is_guessed_beside_a_logs_toml_that_is_given(tmp_path, arm):
    logs = write(tmp_path / "m.csv", COLUMNS)
    given = tmp_path / "mine.toml"
    given.write_text('position_unit = "rad"\n')
    with pytest.raises(UsageError, match="time unit"):
        read_first_recording(logs, arm, ReadOptions(logs=given))


def test_logs_of_which_all_are_left_out_hold_no_recording(tmp_path, arm):
    (tmp_path / "m.csv").write_text(table_text(COLUMNS).split("\n0.02", 1)[0] + "\n")
    with pytest.raises(LogError, match="no recording"):
        read_first_recording(tmp_path / "m.csv", arm, SI, skip_bad=True)
