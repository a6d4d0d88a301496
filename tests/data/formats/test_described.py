"""logs.toml: patterns, units, signs, clocks, names of recordings, sheets; and the one that --guess
writes.
"""

import json
import re
from typing import get_args

import mujoco
import numpy as np
import pytest
from logs import arm_columns, table_text, wave
from strange_logs import motion, write_gaponet

from gaponet.base.errors import JointMismatchError, LogError, UsageError
from gaponet.cli.main import main
from gaponet.data.describe.guess import guess_logs
from gaponet.data.describe.joints import resolve_all
from gaponet.data.describe.logs_file import Naming
from gaponet.data.formats import FORMATS, PositionUnit, detect, look, module, read_logs
from gaponet.data.importer import ImportRequest, import_logs
from gaponet.data.log import skip_bad_rows
from gaponet.data.store import Dataset
from gaponet.robot.log_joints import LOG_UNITS
from gaponet.sim.model import build_model

UNITS = 'time_unit = "s"\nposition_unit = "rad"\n'


def theirs(rows=60, **names):
    """The arm's table under a lab's own names."""
    columns = arm_columns(rows)
    told = {
        "time": "t",
        "ctrl.shoulder": "shoulder_des",
        "ctrl.elbow": "elbow_des",
        "qpos.shoulder": "shoulder_pos",
        "qpos.elbow": "elbow_pos",
    } | names
    return {told[name]: values for name, values in columns.items()}


def write(folder, toml, name="wave.csv", columns=None):
    folder.mkdir(exist_ok=True)
    (folder / name).write_text(table_text(theirs() if columns is None else columns))
    (folder / "logs.toml").write_text(UNITS + toml)
    return folder


NAMES = 'time = "t"\nctrl = "{joint}_des"\nqpos = "{joint}_pos"\n'


def test_the_name_of_a_file_says_motion_payload_repetition_and_gain(tmp_path, arm):
    told = NAMES + 'motion = "{motion}_{payload:g}kg_kp{kp:g}_{rep}"\n'
    ((name, log),) = read_logs(write(tmp_path / "logs", told, "lift_fast_0.5kg_kp12_3.csv"), arm)
    assert name == "lift_fast"
    assert log.meta["stated"] == {"payload_mass": 0.5, "repetition": 3}
    assert log.meta["kp"] == [12.0, 12.0]
    (tmp_path / "logs" / "other.csv").write_text(table_text(theirs()))
    with pytest.raises(LogError, match="other"):
        list(read_logs(tmp_path / "logs", arm))


@pytest.mark.parametrize("fmt", [fmt for fmt in FORMATS if hasattr(module(fmt), "SUFFIXES")])
def test_the_suffix_of_a_file_is_no_part_of_the_name_that_its_path_says(fmt):
    naming = Naming({"motion": "{unit}/{motion}"}, None)
    for suffix in module(fmt).SUFFIXES:
        for written in (suffix, suffix.upper()):
            assert naming.of("run", f"b/run{written}")["motion"] == "run"


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("file,motion,payload_mass\nrun_7,lift,0.2\n", "'payload_mass'"),
        ("file,motion,Payload\nrun_7,lift,0.2\n", "'Payload'"),
        ("file,motion,payload (kg)\nrun_7,lift,0.2\n", r"\(kg\)"),
        ("file,kp.elbow,kp.elbow\nrun_7,9,8\n", r"'kp\.elbow'"),
        ("file,motion,payload,unit\nrun_7,lift,0,2,b\n", "comma"),
    ],
)
def test_a_sheet_that_would_be_read_in_part_is_refused(tmp_path, arm, text, message):
    folder = write(tmp_path / "logs", NAMES + 'manifest = "sheet.csv"\n', "run_7.csv")
    (folder / "sheet.csv").write_text(text)
    with pytest.raises(UsageError, match=message):
        list(read_logs(folder, arm))
    (folder / "sheet.csv").write_text("file, motion, payload, , \nrun_7, lift, 0.2, , ,\n")
    ((name, log),) = read_logs(folder, arm)
    assert (name, log.meta["stated"]) == ("lift", {"payload_mass": 0.2})


def test_a_rate_that_the_clock_contradicts_is_refused(tmp_path, arm):
    with pytest.raises(LogError, match="rate"):
        list(read_logs(write(tmp_path / "logs", "rate = 100.0\n" + NAMES), arm))
    ((_, log),) = read_logs(write(tmp_path / "logs", "rate = 50.0\n" + NAMES), arm)
    assert log.meta["dt"] == 0.02


def test_a_sheet_says_what_names_do_not_and_every_recording_stands_in_it_once(tmp_path, arm):
    folder = write(tmp_path / "logs", NAMES + 'manifest = "sheet.csv"\n', "run_7.csv")
    sheet = folder / "sheet.csv"
    sheet.write_text(
        "file,motion,payload,unit,rep,kp,kp.elbow,who\nrun_7.csv,lift,0.2,b,1,15,9,Ann\n"
    )
    ((name, log),) = read_logs(folder, arm)
    assert (name, log.meta["kp"]) == ("lift", [15.0, 9.0])
    (folder / "run_7.csv").rename(folder / "run[7].csv")
    sheet = folder / "sheet.csv"
    sheet.write_text(sheet.read_text().replace("run_7", "run[7]"))
    assert [name for name, _ in read_logs(folder, arm)] == ["lift"]
    (folder / "run[7].csv").rename(folder / "run_7.csv")
    assert log.meta["stated"] == {"payload_mass": 0.2, "unit_id": "b", "repetition": 1}
    write(tmp_path / "logs", NAMES + 'manifest = "sheet.csv"\nkp = 20.0\n', "run_7.csv")
    sheet.write_text("file,kp\nrun_7.csv,15\n")
    with pytest.raises(LogError, match="kp"):
        list(read_logs(folder, arm))
    sheet.write_text("file,kp.elbow\nrun_7.csv,9\n")
    assert [log.meta["kp"] for _, log in read_logs(folder, arm)] == [
        [20.0, 9.0]
    ]  # of one joint beside that of all
    sheet.write_text("file,motion\nrun_8.csv,lift\n")
    with pytest.raises(LogError, match="run_7"):
        list(read_logs(folder, arm))
    sheet.write_text("file,motion\nrun_7,lift\nrun_9,lift\n")
    with pytest.raises(LogError, match="run_9"):
        list(read_logs(folder, arm))
    sheet.write_text("file,payload\nrun_7,heavy\n")
    with pytest.raises(LogError, match="heavy"):
        list(read_logs(folder, arm))


def test_each_position_unit_of_a_logs_toml_can_be_given_as_an_option():
    assert set(get_args(PositionUnit)) == set(LOG_UNITS)


def test_signs_and_offsets_come_after_units_and_are_noted(tmp_path, arm):
    told = NAMES + "[signs]\nelbow = -1\n[offsets]\nelbow = 0.1\n"
    ((_, log),) = read_logs(write(tmp_path / "logs", told), arm)
    assert np.allclose(log.channels["qpos"].values[:, 1], 0.1 - arm_columns()["qpos.elbow"])
    assert np.array_equal(log.channels["qpos"].values[:, 0], arm_columns()["qpos.shoulder"])
    assert log.meta["notes"] == {"signs": {"elbow": -1}, "offsets": {"elbow": 0.1}}


def test_the_clock_is_no_joint_where_columns_are_called_as_joints_are(tmp_path, arm):
    columns = {name.removesuffix("_pos"): values for name, values in theirs().items()}
    folder = write(
        tmp_path, 'time = "t"\nctrl = "{joint}_des"\nqpos = "{joint}"\n', columns=columns
    )
    ((_, log),) = read_logs(folder, arm)
    assert log.joint_names == ("shoulder", "elbow")


def test_strange_joints_are_all_named_at_once_and_ignored_where_that_is_said(tmp_path, arm):
    columns = theirs() | {f"{j}_{w}": np.zeros(60) for j in ("hip", "knee") for w in ("des", "pos")}
    folder = write(tmp_path / "logs", NAMES, columns=columns)
    with pytest.raises(
        JointMismatchError,
        match=r"hip=\S+ --map knee=",
    ):
        list(read_logs(folder, arm))
    write(tmp_path / "logs", NAMES + 'ignore = ["hip", "kn*"]\n', columns=columns)
    assert next(read_logs(folder, arm))[1].joint_names == ("shoulder", "elbow")


def test_names_that_are_all_another_robots_say_whose(arm, so101):
    with pytest.raises(JointMismatchError, match="so101"):
        resolve_all(so101.operated, arm, "a.csv", None)


@pytest.mark.parametrize("delimiter", [",", "\t", "   ", ";"])
def test_a_table_without_header(tmp_path, arm, delimiter):
    told = (
        UNITS + NAMES + 'header = ["t", "shoulder_des", "elbow_des", "shoulder_pos", "elbow_pos"]\n'
    )
    body = table_text(theirs()).split("\n", 1)[1].replace(",", delimiter)
    (tmp_path / "wave.txt").write_text(body)
    (tmp_path / "logs.toml").write_text(told)
    ((_, log),) = read_logs(tmp_path / "wave.txt", arm)
    assert np.array_equal(log.channels["qpos"].values[:, 0], arm_columns()["qpos.shoulder"])
    (tmp_path / "logs.toml").write_text(told.replace('"t", ', ""))
    with pytest.raises(LogError, match=r"wave\.txt:1"):
        list(read_logs(tmp_path / "wave.txt", arm))


def test_commands_in_a_file_of_their_own_keep_their_clock(tmp_path, arm):
    state = {k: v for k, v in theirs().items() if not k.endswith("_des")}
    command = {"t": 0.005 + 0.1 * np.arange(12)} | {
        f"{j}_des": wave(12, 2, 0.1)[:, i] for i, j in enumerate(arm.joint_names)
    }
    folder = write(tmp_path / "logs", NAMES + 'command_file = "{name}_cmd.csv"\n', columns=state)
    (folder / "wave_cmd.csv").write_text(table_text(command))
    ((name, log),) = read_logs(folder, arm)
    assert name == "wave"
    assert log.channels["ctrl"].time == pytest.approx(command["t"])
    assert len(log.channels["qpos"].time) == 60
    (folder / "wave_cmd.csv").rename(folder / "cmd.csv")
    with pytest.raises(LogError, match="command_file"):
        list(read_logs(folder, arm))


def test_a_log_without_a_clock_has_the_rate_that_was_said(tmp_path, arm):
    columns = {k: v for k, v in theirs().items() if k != "t"}
    folder = write(tmp_path / "logs", NAMES.replace('time = "t"\n', ""), columns=columns)
    with pytest.raises(LogError, match=r"rate = 50\.0"):
        list(read_logs(folder, arm))
    write(folder, NAMES.replace('time = "t"', "rate = 100.0"), columns=columns)
    ((_, log),) = read_logs(folder, arm)
    assert log.channels["qpos"].time[-1] == pytest.approx(0.59)


def test_a_log_without_commands_says_what_can_still_be_done(tmp_path, arm):
    folder = write(
        tmp_path / "logs",
        NAMES,
        columns={k: v for k, v in theirs().items() if not k.endswith("_des")},
    )
    with pytest.raises(LogError, match="ctrl"):
        list(read_logs(folder, arm))


def test_a_robot_driven_by_torques_is_refused_in_a_sentence(tmp_path, arm):
    columns = theirs() | {
        "shoulder_des": np.zeros(60),
        "elbow_des": np.zeros(60),
        "elbow_pos": np.linspace(0, 1.4, 60),
    }
    with pytest.raises(LogError, match="still"):
        list(read_logs(write(tmp_path / "logs", NAMES, columns=columns), arm))


@pytest.fixture
def damaged_logs(tmp_path):
    """A log with three bad rows, and one that cannot be read at all."""
    folder = write(tmp_path / "logs", NAMES)
    lines = (folder / "wave.csv").read_text().split("\n")
    lines[5] = lines[5].replace(",", ",x", 1)  # no number
    lines[9] = ",".join(["nan"] * 5)
    lines[20] = lines[10]  # back in time
    (folder / "wave.csv").write_text("\n".join(lines))
    (folder / "short.csv").write_text("t,shoulder_des\n0,1\n")
    return folder


def test_bad_rows_are_cut_and_listed_where_that_is_asked_for(damaged_logs, arm):
    with skip_bad_rows() as bad:
        ((_, log),) = read_logs(damaged_logs, arm)
    cut = [line for line in bad if line.endswith("cut")]
    numbers = [line.rpartition("/")[2].split(":")[1] for line in cut]
    assert numbers == ["6", "10", "21"]
    assert len(log.channels["qpos"].time) == 57
    assert log.meta["notes"]["rows_cut"] == 3


def test_a_log_without_a_good_row_is_left_out_and_listed_where_that_is_asked_for(damaged_logs, arm):
    with skip_bad_rows() as bad:
        list(read_logs(damaged_logs, arm))
    (left_out,) = [line for line in bad if line.startswith("left out: ")]
    assert "short.csv" in left_out


def command_line(logs, arm, out):
    """The arguments of `gaponet import`."""
    told = ["--robot", str(arm.mjcf.parent), "--unit-id", "lab", "--payload-mass", "0"]
    return ["import", str(logs), *told, "--out", str(out)]


def test_import_refuses_bad_rows_and_leaves_nothing(damaged_logs, arm, tmp_path):
    assert main(command_line(damaged_logs, arm, tmp_path / "data")) == 2
    assert not (tmp_path / "data").exists()


def test_import_lists_the_bad_rows_and_logs_that_it_skips(damaged_logs, arm, tmp_path, capsys):
    arguments = command_line(damaged_logs, arm, tmp_path / "data")
    assert main([*arguments, "--skip-bad", "--json"]) == 0
    assert len(json.loads(capsys.readouterr().out)["cut"]) == 4


def test_rows_that_were_cut_are_interpolated_on_the_clock_of_the_others(
    damaged_logs, arm, tmp_path
):
    """Nothing is stretched."""
    assert main([*command_line(damaged_logs, arm, tmp_path / "data"), "--skip-bad"]) == 0
    (entry,) = Dataset(tmp_path / "data").entries
    assert entry.rows == 60
    assert "resampled" in entry.meta.notes["rows"]


@pytest.mark.parametrize(
    ("toml", "message"),
    [
        ('motion = "{motion}_{speed}"', "{side}"),
        ('motion = "{motion}_{motion}"', "once"),
        ('motion = "{}_{}_{}_{motion}"', "words"),
        ('[clock]\ncmd = "t"', r"clock\.cmd"),
        ('manifest = "../sheet.csv"', "beside"),
        ('manifest = "no.csv"', "missing"),
        ("[signs]\nelbow = 0", "sign"),
        ("kp = -1.0", "kp"),
        ("rate = 0.0", "rate"),
        ('[columns]\n"speed.elbow" = "t"', r"'speed\.elbow'"),
        ('[columns]\n"ctrl.elbow" = "x"', "'x'"),
        ('[joint_units]\nelbow = "grad"', "'grad'"),
        ('[joint_units]\nelbow = ["deg"]', "joint_units"),
        ('tme = "t"', "tme"),
        ("ctrl", "TOML"),
    ],
)
def test_a_wrong_logs_toml_is_refused(tmp_path, arm, toml, message):
    with pytest.raises((UsageError, LogError), match=message):
        list(read_logs(write(tmp_path / "logs", NAMES + toml), arm))


def test_a_folder_of_two_formats_asks_which(tmp_path, arm):
    folder = write(tmp_path / "logs", NAMES)
    np.savez(folder / "a.npz", q=np.zeros((3, 2)))
    with pytest.raises(LogError, match="--format"):
        detect(folder)


def test_the_guess_for_a_strange_table_reads_it(tmp_path, arm, capsys):
    folder = write(tmp_path / "logs", "", "lift_0.2kg_1.csv")
    right = next(read_logs(write(tmp_path / "other", NAMES), arm))[1]
    (folder / "logs.toml").unlink()
    assert main(["import", str(folder), "--robot", str(arm.mjcf.parent), "--guess"]) == 0
    (folder / "logs.toml").write_text(capsys.readouterr().out)
    ((name, log),) = read_logs(folder, arm)
    assert name == "lift"
    assert log.meta["stated"] == {"payload_mass": 0.2, "repetition": 1}
    for channel in ("ctrl", "qpos"):
        assert np.array_equal(log.channels[channel].values, right.channels[channel].values)


@pytest.mark.parametrize(
    "names",
    [
        ("timestamp", "cmd_shoulder", "cmd_elbow", "q_shoulder", "q_elbow"),
        ("t", "shoulder.target", "elbow.target", "shoulder.position", "elbow.position"),
        ("time", "shoulder/command", "elbow/command", "shoulder/actual", "elbow/actual"),
        ("time", "q_des_1", "q_des_2", "q_1", "q_2"),
        ("time", "des_pos.shoulder", "des_pos.elbow", "pos.shoulder", "pos.elbow"),
    ],
)
def test_the_guess_knows_how_others_call_things(tmp_path, arm, names):
    folder = write(
        tmp_path / "logs", "", columns=dict(zip(names, arm_columns().values(), strict=True))
    )
    (folder / "logs.toml").unlink()
    fmt, logs, recordings = look(folder)
    (folder / "logs.toml").write_text(guess_logs(recordings, arm, fmt, dict(logs)))
    ((_, log),) = read_logs(folder, arm)
    assert np.array_equal(log.channels["ctrl"].values[:, 1], arm_columns()["ctrl.elbow"])
    assert np.array_equal(log.channels["qpos"].values[:, 1], arm_columns()["qpos.elbow"])


def test_a_channel_may_have_a_clock_of_its_own(tmp_path, arm):
    columns = theirs() | {"t_cmd": 0.02 * np.arange(60) + 0.007}
    folder = write(tmp_path / "logs", NAMES + '[clock]\nctrl = "t_cmd"\n', columns=columns)
    ((_, log),) = read_logs(folder, arm)
    assert log.channels["ctrl"].time[0] - log.channels["qpos"].time[0] == pytest.approx(0.007)


TORQUES = np.stack(
    [np.linspace(0, 3, 60), np.full(60, -1.0)], axis=1
)  # N·m fed forward to shoulder and elbow
FED = theirs() | {"tau_ff_shoulder": TORQUES[:, 0], "tau_ff_elbow": TORQUES[:, 1]}


def fed_command(folder, arm, toml, **stated):
    """The command of a recording with TORQUES, (60, 2)."""
    folder = write(folder, NAMES + toml, columns=FED)
    made = import_logs(
        folder,
        arm,
        folder.parent / f"{folder.name}_data",
        ImportRequest(unit_id="a", payload_mass=0.0, **stated),
    )
    return made.dataset.read(made.dataset.entries[0]), np.stack(
        [FED["shoulder_des"], FED["elbow_des"]], axis=1
    )


@pytest.mark.parametrize(
    "toml",
    [
        'feedforward_torque = "tau_ff_{joint}"\n',
        "[columns]\n"
        + "".join(f'"feedforward_torque.{j}" = "tau_ff_{j}"\n' for j in ("shoulder", "elbow")),
    ],
)
def test_a_feedforward_torque_is_the_position_command_by_which_a_pd_servo_gives_it(
    tmp_path, arm, toml
):
    sequence, command = fed_command(tmp_path / "logs", arm, "kp = 10.0\n" + toml)
    assert np.allclose(sequence.ctrl, command + TORQUES / 10, atol=1e-6)
    assert sequence.meta.notes["feedforward_torque"]["largest_rad"] == {
        "shoulder": 0.3,
        "elbow": 0.1,
    }
    sequence, _ = fed_command(tmp_path / "unused", arm, "kp = 10.0\n")
    assert np.allclose(sequence.ctrl, command, atol=1e-6)
    assert "feedforward_torque" not in sequence.meta.notes


def test_a_simulated_pd_servo_does_the_same_with_the_torque_as_with_the_equivalent_command(arm):
    model, rows = build_model(arm), 300
    torque, states = np.array([0.8, -0.3]), []
    for further, force in ((torque / arm.servo.kp, 0.0), (0.0, torque)):
        data = mujoco.MjData(model)
        data.qfrc_applied[:] = force
        for t in range(rows):
            data.ctrl[:] = further + 0.3 * np.sin(0.03 * t)
            mujoco.mj_step(model, data)
        states.append(data.qpos.copy())
    assert np.allclose(*states, atol=1e-9)
    assert abs(states[0]).max() > 0.05


@pytest.mark.parametrize(
    ("toml", "message"),
    [
        ('feedforward_torque = "tau_ff_{joint}"\n', "stated"),
        (
            'feedforward_torque = "tau_ff_{joint}"\nkp = { shoulder = 5.0, elbow = 0.0 }\n',
            "elbow is 0",
        ),
        ('feedforward_torque = "tau_{joint}_ff"\nkp = 5.0\n', "feedforward_torque"),
    ],
)
def test_a_feedforward_torque_without_gain_or_column_is_refused(tmp_path, arm, toml, message):
    with pytest.raises(LogError, match=re.escape(message)):
        fed_command(tmp_path / "logs", arm, toml)


def test_a_feedforward_torque_of_zero_needs_no_gain(tmp_path, arm):
    columns = theirs() | {f"feedforward_torque.{j}": np.zeros(60) for j in arm.joint_names}
    made = import_logs(
        write(tmp_path / "logs", NAMES, columns=columns),
        arm,
        tmp_path / "data",
        ImportRequest(unit_id="a", payload_mass=0.0),
    )
    assert np.allclose(
        made.dataset.read(made.dataset.entries[0]).ctrl[:, 1], columns["elbow_des"], atol=1e-6
    )


def test_the_guess_sees_a_feedforward_torque_and_not_the_measured_one(tmp_path, arm):
    folder = write(
        tmp_path / "logs",
        "",
        columns=FED | {"tau_shoulder": TORQUES[:, 0], "tau_elbow": TORQUES[:, 1]},
    )
    (folder / "logs.toml").unlink()
    fmt, logs, recordings = look(folder)
    text = guess_logs(recordings, arm, fmt, dict(logs))
    assert 'feedforward_torque = "tau_ff_{joint}"' in text
    assert 'tau = "tau_{joint}"' in text
    (folder / "logs.toml").write_text(text)
    ((_, log),) = read_logs(folder, arm)
    assert np.array_equal(log.channels["feedforward_torque"].values, TORQUES)


def test_a_feedforward_torque_in_the_file_of_the_commands_has_their_clock(tmp_path, arm):
    columns = theirs()
    states = {name: columns[name] for name in ("t", "shoulder_pos", "elbow_pos")}
    commands = {"t": columns["t"] + 0.01} | {
        name: FED[name] for name in FED if "_des" in name or "_ff_" in name
    }
    folder = write(
        tmp_path / "logs",
        NAMES + 'command_file = "{name}_cmd.csv"\nfeedforward_torque = "tau_ff_{joint}"\n',
        columns=states,
    )
    (folder / "wave_cmd.csv").write_text(table_text(commands))
    ((_, log),) = read_logs(folder, arm)
    assert np.array_equal(log.channels["feedforward_torque"].values, TORQUES)
    assert np.array_equal(log.channels["feedforward_torque"].time, log.channels["ctrl"].time)


@pytest.mark.parametrize(
    ("factor", "name"), [(2.0, "real_time"), (0.6, "t_host"), (1.5e3, "elapsed_ms")]
)
def test_two_columns_that_run_like_clocks_at_other_rates_are_asked_about(
    tmp_path, arm, factor, name
):
    columns = theirs()
    folder = write(tmp_path / "logs", NAMES, columns=columns | {name: 100 + factor * columns["t"]})
    with pytest.raises(LogError, match=name):
        list(read_logs(folder, arm))
    kind, known, found = look(folder)
    assert "differ by a factor" in guess_logs(found, arm, kind, dict(known))
    (folder / "logs.toml").write_text(UNITS + NAMES + f'ignore = ["{name}"]\n')
    ((_, log),) = read_logs(folder, arm)
    assert np.allclose(log.channels["qpos"].time, columns["t"])


def test_a_second_clock_at_the_same_rate_and_a_counter_of_rows_are_no_question(tmp_path, arm):
    columns = theirs()
    columns |= {"stamp_ms": 7e9 + 1e3 * columns["t"], "frame": np.arange(60.0)}
    ((_, log),) = read_logs(write(tmp_path / "logs", NAMES, columns=columns), arm)
    assert log.channels["qpos"].time[-1] == pytest.approx(59 * 0.02)


SHEET = NAMES + 'manifest = "sheet.csv"\n'


def sheeted(folder, *lines):
    """A folder of one recording, run_7, with a manifest of these lines."""
    write(folder, SHEET, "run_7.csv")
    (folder / "sheet.csv").write_text("\n".join(lines) + "\n")
    return folder


def test_a_sheet_says_which_recordings_are_virtual_which_to_leave_out_and_what_is_estimated(
    tmp_path, arm
):
    folder = sheeted(
        tmp_path / "logs",
        "file,virtual,estimated,leave_out",
        "run_7,yes,kp,no",
        ",,,",
        "run_8,no,,yes",
    )
    (folder / "run_8.csv").write_text(table_text(theirs()))
    ((name, log),) = read_logs(folder, arm)
    assert (name, log.meta["stated"]) == ("run_7", {"virtual": True})
    assert log.meta["notes"] == {"estimated": "kp"}


@pytest.mark.parametrize(
    ("lines", "word"),
    [
        (("file,virtual", "run_7,maybe"), "'maybe'"),
        (("name,motion", "run_7,lift"), "column file"),
        (("file,motion",), "column file"),
    ],
    ids=["neither yes nor no", "no column file", "no row"],
)
def test_a_sheet_that_says_nothing_clear_is_refused(tmp_path, arm, lines, word):
    with pytest.raises((UsageError, LogError), match=word):
        list(read_logs(sheeted(tmp_path / "logs", *lines), arm))


def test_a_name_and_a_sheet_may_say_the_same(tmp_path, arm):
    told = 'motion = "{motion}_{rep}"\n' + SHEET
    folder = write(tmp_path / "logs", told, "run_7.csv")
    (folder / "sheet.csv").write_text("file,rep\nrun_7,7\n")
    ((name, log),) = read_logs(folder, arm)
    assert (name, log.meta["stated"]) == ("run", {"repetition": 7})


def test_a_payload_that_a_file_contradicts_is_refused(tmp_path, arm):
    write_gaponet(tmp_path, objects=False)
    with (tmp_path / "logs.toml").open("a") as toml:
        toml.write('motion = "{motion}"\nmanifest = "sheet.csv"\n')
    (tmp_path / "sheet.csv").write_text("file,payload\na-0000,0\na-0001,0.3\n")
    with pytest.raises(UsageError, match="payload_mass"):
        list(read_logs(tmp_path, arm))


def test_gains_may_stand_in_a_column_as_long_as_they_stand_still(tmp_path, arm):
    kp = np.full(60, 12.0)
    folder = write(tmp_path / "logs", NAMES + 'kp = "gain"\n', columns=theirs() | {"gain": kp})
    ((_, log),) = read_logs(folder, arm)
    assert log.meta["kp"] == [12.0, 12.0]
    kp[30:] = 13.0
    (folder / "wave.csv").write_text(table_text(theirs() | {"gain": kp}))
    with pytest.raises(LogError, match="changes"):
        list(read_logs(folder, arm))
    (folder / "wave.csv").write_text(table_text(theirs()))
    with pytest.raises(LogError, match='"gain"'):
        list(read_logs(folder, arm))


def test_a_rate_stands_in_for_a_clock_that_stands_still(tmp_path, arm):
    columns = theirs() | {"t": np.full(60, 7.0)}
    folder = write(tmp_path / "logs", "rate = 50.0\n" + NAMES, columns=columns)
    ((_, log),) = read_logs(folder, arm)
    assert log.channels["qpos"].time[-1] == pytest.approx(59 * 0.02)


def test_a_clock_with_fewer_rows_than_the_state_is_refused(tmp_path, arm):
    ctrl, qpos = motion()
    np.savez(tmp_path / "a.npz", target=ctrl, q=qpos, clock=0.02 * np.arange(len(qpos) - 1))
    told = 'ctrl = "target"\nqpos = "q"\ntime = "clock"\njoints = ["shoulder", "elbow"]\n'
    (tmp_path / "logs.toml").write_text(UNITS + told)
    with pytest.raises(LogError, match="'clock'"):
        list(read_logs(tmp_path, arm))


@pytest.mark.parametrize("further", [{}, {"count": np.arange(60.0)}], ids=["alone", "beside"])
def test_the_clock_may_lie_in_a_file_of_its_own(tmp_path, arm, further):
    columns = theirs()
    clock = {"stamp": columns.pop("t") + 5.0} | further
    told = 'ctrl = "{joint}_des"\nqpos = "{joint}_pos"\ntime_file = "{name}-times.csv"\n'
    if further:
        told += 'time = "stamp"\n'
    folder = write(tmp_path / "logs", told, columns=columns)
    (folder / "wave-times.csv").write_text(table_text(clock))
    ((_, log),) = read_logs(folder, arm)
    assert np.allclose(log.channels["ctrl"].time, arm_columns()["time"])


def test_clocks_in_a_file_of_their_own_that_contradict_each_other_are_asked_about(tmp_path, arm):
    columns = theirs()
    clocks = {"stamp": columns["t"], "host_time": 2 * columns.pop("t")}
    told = NAMES.replace('"t"', '"stamp"') + 'state_file = "wave.csv"\ntime_file = "times.csv"\n'
    folder = write(tmp_path / "logs", told, columns=columns)
    (folder / "times.csv").write_text(table_text(clocks))
    with pytest.raises(LogError, match=r'time = "stamp" and ignore'):
        list(read_logs(folder, arm))
    (folder / "logs.toml").write_text(UNITS + told + 'ignore = ["time:host_time"]\n')
    ((_, log),) = read_logs(folder, arm)
    assert np.allclose(log.channels["qpos"].time, clocks["stamp"])


def test_commands_in_a_file_of_their_own_need_no_clock_beside_a_rate(tmp_path, arm):
    columns = theirs()
    state = {name: columns[name] for name in ("shoulder_pos", "elbow_pos")}
    told = NAMES.replace('time = "t"', "rate = 50.0") + 'command_file = "{name}_cmd.csv"\n'
    folder = write(tmp_path / "logs", told, columns=state)
    (folder / "wave_cmd.csv").write_text(
        table_text({name: columns[name] for name in ("shoulder_des", "elbow_des")})
    )
    ((_, log),) = read_logs(folder, arm)
    assert np.array_equal(log.channels["ctrl"].values[:, 0], columns["shoulder_des"])


def test_a_pattern_of_states_that_no_file_fits_is_refused(tmp_path, arm):
    folder = write(tmp_path / "logs", NAMES + 'state_file = "{name}_state.csv"\n')
    with pytest.raises(LogError, match="state_file"):
        list(read_logs(folder, arm))


def test_signs_turn_no_temperature(tmp_path, arm):
    warmth = {f"{joint}_warmth": np.full(60, 40.0) for joint in arm.joint_names}
    told = NAMES + 'temperature = "{joint}_warmth"\n[signs]\nelbow = -1\n'
    ((_, log),) = read_logs(write(tmp_path / "logs", told, columns=theirs() | warmth), arm)
    assert (log.channels["temperature"].values == 40.0).all()


def test_names_unlike_any_joint_are_told_which_joints_are_left(arm):
    with pytest.raises(JointMismatchError, match="one of elbow"):
        resolve_all(("shoulder", "xxxx", "zzzz"), arm, "a.csv", None)
