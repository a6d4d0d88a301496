"""Layouts of logs that people publish or ask about: the guess reads them, or the refusal names the
cause.

Values are the tests' own; column names and files are those of the source that each layout names.
"""

import json

import numpy as np
import pytest
from arm import write_arm
from logs import late, table_text, wave

from gaponet.base.errors import LogError
from gaponet.data.describe.guess import guess_logs
from gaponet.data.formats import detect, look, read_logs

ROWS = 200
DT = 0.02
TIME = DT * np.arange(ROWS)
COMMAND = wave(ROWS, 2, DT)
STATE = late(COMMAND, 2)


def pairs(pattern, values):
    """Columns of two joints, numbered from 0 at the {}."""
    return {pattern.format(i): values[:, i] for i in range(2)}


def understood(folder, arm):
    """Command and state of the one log, as its guessed logs.toml reads them."""
    kind, facts, recordings = look(folder)
    (folder / "logs.toml").write_text(guess_logs(recordings, arm, kind, dict(facts)))
    ((_, log),) = read_logs(folder, arm)
    return log.channels["ctrl"].values, log.channels["qpos"].values


# Source: columns of one table.
TABLES = {
    "two-joint arm on an Arduino": {"pc_time_s": 1.7e9 + TIME, "arduino_ms": 5123 + 1e3 * TIME}
    | {"q1": STATE[:, 0], "q2": STATE[:, 1], "q1_ref": COMMAND[:, 0], "q2_ref": COMMAND[:, 1]}
    | {"u1": 0 * TIME, "u2": 0 * TIME},
    "bagpy's table of a controller's state": {"Time": 1.6e9 + TIME}
    | pairs("desired.positions_{}", COMMAND)
    | pairs("actual.positions_{}", STATE)
    | pairs("error.positions_{}", COMMAND - STATE),
    "unitree_cpp_deploy": {"time": TIME, "unix_time": np.round(1.7e9 + TIME, 1)}
    | pairs("q_des_{}", COMMAND)
    | pairs("q_{}", STATE)
    | pairs("dq_{}", np.gradient(STATE, DT, axis=0))
    | pairs("temperatures_{}", 40 + 0 * STATE),
    "libfranka, its second q_d called q_c": {"time": 1e3 * TIME}
    | pairs("q[{}]", STATE)
    | pairs("q_d[{}]", COMMAND)
    | pairs("dq[{}]", np.gradient(STATE, DT, axis=0))
    | pairs("tau_J[{}]", STATE),
}


@pytest.mark.parametrize("source", TABLES)
def test_the_columns_of_a_public_table_are_understood(tmp_path, arm, source):
    folder = tmp_path / "logs"
    folder.mkdir()
    (folder / "log.csv").write_text(table_text(TABLES[source]))
    command, state = understood(folder, arm)
    assert np.allclose(command, COMMAND, atol=1e-6)
    assert np.allclose(state, STATE, atol=1e-6)


def test_plotjugglers_table_names_commands_by_number_and_states_by_joint(tmp_path, arm):
    folder = tmp_path / "logs"
    folder.mkdir()
    columns = {"__time": 1.6e9 + TIME}
    columns |= {f"/joint_states/{n}/position": STATE[:, i] for i, n in enumerate(arm.joint_names)}
    columns |= pairs("/joint_position_controller/commands/data[{}]", COMMAND)
    (folder / "export.csv").write_text(table_text(columns))
    command, state = understood(folder, arm)
    assert np.allclose(command, COMMAND, atol=1e-6)
    assert np.allclose(state, STATE, atol=1e-6)


def test_two_echoed_topics_are_one_recording(tmp_path, arm):
    folder = tmp_path / "logs"
    folder.mkdir()
    state = {"%time": 1e9 * TIME} | pairs("field.position{}", STATE)
    command = {"%time": 1e9 * TIME} | pairs("field.data{}", COMMAND)
    (folder / "joint_states.csv").write_text(table_text(state))
    (folder / "command.csv").write_text(table_text(command))
    assert all(
        np.allclose(read, sent, atol=1e-6)
        for read, sent in zip(understood(folder, arm), (COMMAND, STATE), strict=True)
    )


def test_measured_and_desired_tables_with_the_same_columns_are_one_recording_each(tmp_path):
    robot = write_arm(tmp_path / "one", ONE_JOINT_TOML, ONE_JOINT)
    folder = tmp_path / "logs"
    folder.mkdir()
    for file, values in (("a_measured.csv", STATE), ("a_desired.csv", COMMAND)):
        columns = {"time": TIME, "position": values[:, 0], "velocity": 0 * TIME, "torque": 0 * TIME}
        (folder / file).write_text(table_text(columns))
    command, state = understood(folder, robot)
    assert np.allclose(command[:, 0], COMMAND[:, 0], atol=1e-6)
    assert np.allclose(state[:, 0], STATE[:, 0], atol=1e-6)


ONE_JOINT = """
<mujoco><compiler angle="radian"/><worldbody><body><joint name="motor" axis="0 1 0" range="-3 3"/>
<geom type="capsule" fromto="0 0 0 0.1 0 0" size="0.01" mass="0.1"/></body></worldbody></mujoco>
"""
ONE_JOINT_TOML = """
name = "one"
dt = 0.02
timestep = 0.005
[[joint]]
name = "motor"
kp = 5.0
effort_limit = 1.0
"""


def test_a_dynamixel_motors_raw_current_is_not_taken_for_a_torque(tmp_path):
    robot = write_arm(tmp_path / "one", ONE_JOINT_TOML, ONE_JOINT)
    folder = tmp_path / "logs"
    folder.mkdir()
    ticks = np.round(2048 + 600 * COMMAND[:, 0])
    columns = {"timestamp": TIME, "goal_position": ticks, "present_position": ticks - 3}
    columns |= {"present_current": 30 * STATE[:, 0], "present_velocity": 9 * STATE[:, 0]}
    (folder / "log.csv").write_text(table_text(columns))
    kind, facts, recordings = look(folder)
    (folder / "logs.toml").write_text(guess_logs(recordings, robot, kind, dict(facts)))
    ((_, log),) = read_logs(folder, robot)
    assert set(log.channels) == {"ctrl", "qpos"}
    assert np.allclose(log.channels["ctrl"].values[:, 0], (ticks - 2048) * 2 * np.pi / 4096)


def test_states_without_commands_are_refused_by_cause(tmp_path, arm):
    columns = {"ts": TIME} | {f"{n}_q": STATE[:, i] for i, n in enumerate(arm.joint_names)}
    (tmp_path / "log.csv").write_text(table_text(columns))
    with pytest.raises(LogError, match="gap"):
        understood(tmp_path, arm)


def test_a_name_that_two_columns_have_is_refused_where_it_is_wanted(tmp_path, arm):
    text = table_text(TABLES["libfranka, its second q_d called q_c"] | {"dq_d[0]": TIME})
    (tmp_path / "log.csv").write_text(text.replace("dq_d[0]", "q_d[0]", 1))
    with pytest.raises(LogError, match="twice"):
        understood(tmp_path, arm)


def test_lines_of_json_are_refused_with_the_way_to_a_table(tmp_path):
    (tmp_path / "log.jsonl").write_text(json.dumps({"t": 0.0, "q": [0.0]}) + "\n")
    with pytest.raises(LogError, match="to_parquet"):
        detect(tmp_path)
