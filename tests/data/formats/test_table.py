"""Tables: CSV and Parquet with named columns; units are said, never guessed."""

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from logs import arm_columns, table_text

from gaponet.base.errors import LogError, UsageError
from gaponet.data.describe.plausibility import require_plausible
from gaponet.data.formats import ReadOptions, detect, find_logs, read_logs

SI = {"position_unit": "rad", "time_unit": "s"}


def write(path, columns, old="", new=""):
    path.write_text(table_text(columns).replace(old, new, 1))
    return path


def write_parquet(path, columns):
    pq.write_table(pa.table({k: pa.array(v) for k, v in columns.items()}), path)
    return path


def only(path, robot, **options):
    ((_, log),) = read_logs(path, robot, ReadOptions(**(SI | options)))
    return log


@pytest.mark.parametrize("kind", ["csv", "parquet"])
def test_numbers_come_back_as_written(tmp_path, arm, kind):
    columns = arm_columns() | {
        "tau.shoulder": np.arange(60.0),
        "tau.elbow": np.zeros(60),
        "note": np.ones(60),
    }
    file = tmp_path / f"wave.{kind}"
    (write if kind == "csv" else write_parquet)(file, columns)
    log = only(file, arm)
    assert log.joint_names == ("shoulder", "elbow")
    assert sorted(log.channels) == ["ctrl", "qpos", "tau"]
    assert np.allclose(log.channels["qpos"].time, 0.02 * np.arange(60))
    assert np.array_equal(log.channels["qpos"].values[:, 1], columns["qpos.elbow"])
    assert np.array_equal(log.channels["tau"].values[:, 0], np.arange(60.0))


COMMANDED, MEASURED = ("ctrl.elbow", "ctrl.shoulder"), ("qpos.elbow", "qpos.shoulder")


def by_joint(columns, path):
    """The columns as a table with a row per joint and time."""
    rows = ["t,joint,command,position,phase"]
    for i, time in enumerate(columns["time"]):
        rows += [
            f"{time!r},{j},{columns[f'ctrl.{j}'][i]!r},{columns[f'qpos.{j}'][i]!r},run"
            for j in ("elbow", "shoulder")
        ]
    path.write_text("\n".join(map(str, rows)) + "\n")
    return path


def test_rows_per_joint_give_the_same_log_as_columns_per_joint(tmp_path, arm):
    columns = {name: list(map(float, values)) for name, values in arm_columns().items()}
    logs = tmp_path / "logs.toml"
    logs.write_text('ctrl = "command"\nqpos = "position"\ntime_unit = "s"\nposition_unit = "rad"\n')
    ((_, log),) = read_logs(by_joint(columns, tmp_path / "long.csv"), arm, ReadOptions(logs=logs))
    for k, joint in enumerate(log.joint_names):
        assert np.array_equal(log.channels["qpos"].values[:, k], columns[f"qpos.{joint}"])
        assert np.array_equal(log.channels["ctrl"].values[:, k], columns[f"ctrl.{joint}"])
    text = (tmp_path / "long.csv").read_text().splitlines()
    (tmp_path / "long.csv").write_text("\n".join(text[:-1]) + "\n")
    with pytest.raises(LogError, match="59"):
        next(read_logs(tmp_path / "long.csv", arm, ReadOptions(logs=logs)))[1]()


def test_episodes_of_a_table_with_rows_per_joint_are_recordings(tmp_path, arm):
    columns = {name: list(map(float, values)) for name, values in arm_columns().items()}
    lines = by_joint(columns, tmp_path / "long.csv").read_text().splitlines()
    numbered = [f"{lines[0]},episode_index"]
    for row, line in enumerate(lines[1:]):
        numbered.append(f"{line},{row // 80}")  # of 120 rows
    (tmp_path / "long.csv").write_text("\n".join(numbered) + "\n")
    logs = tmp_path / "logs.toml"
    logs.write_text('ctrl = "command"\nqpos = "position"\ntime_unit = "s"\nposition_unit = "rad"\n')
    found = dict(read_logs(tmp_path / "long.csv", arm, ReadOptions(logs=logs)))
    lengths = {name: len(log.channels["qpos"].time) for name, log in found.items()}
    assert lengths == {"long-0000": 40, "long-0001": 20}


def test_a_column_called_joint_beside_a_column_per_joint_is_no_table_with_a_row_per_joint(
    tmp_path, arm
):
    log = only(write(tmp_path / "wave.csv", arm_columns() | {"joint": np.zeros(60)}), arm)
    assert log.joint_names == ("shoulder", "elbow")


def test_a_folder_holds_one_motion_per_file(tmp_path, arm):
    folder = tmp_path / "logs"
    folder.mkdir()
    write(folder / "b.csv", arm_columns())
    write_parquet(folder / "a.parquet", arm_columns())
    (folder / "readme.txt").touch()
    (folder / ".hidden.csv").touch()
    assert detect(folder) == "table"
    assert [f.name for f in find_logs(folder)] == ["a.parquet", "b.csv"]
    assert [name for name, _ in read_logs(folder, arm, ReadOptions(**SI))] == ["a", "b"]


@pytest.mark.parametrize("given", [{}, {"position_unit": "rad"}, {"time_unit": "s"}])
def test_a_unit_that_was_not_said_is_asked_for(tmp_path, arm, given):
    file = write(tmp_path / "wave.csv", arm_columns())
    missing = "position" if "time_unit" in given else "time"
    with pytest.raises(UsageError, match=missing):
        list(read_logs(file, arm, ReadOptions(**given)))


def test_90_degrees_are_half_pi_and_1500_ms_are_one_and_a_half_seconds(tmp_path, arm):
    columns = {name: np.full(4, 90.0) for name in arm_columns()} | {
        "time": np.array([0.0, 500.0, 1000.0, 1500.0])
    }
    columns |= {"qvel.shoulder": np.full(4, 180.0), "qvel.elbow": np.zeros(4)}
    log = only(write(tmp_path / "wave.csv", columns), arm, position_unit="deg", time_unit="ms")
    assert log.channels["ctrl"].values[0] == pytest.approx([np.pi / 2] * 2)
    assert log.channels["qvel"].values[0] == pytest.approx([np.pi, 0])
    assert log.channels["qpos"].time[-1] == pytest.approx(1.5)
    columns = {name: np.full(4, 0.75) for name in arm_columns()} | {
        "time": 1.7e18 + 2e7 * np.arange(4)
    }
    log = only(write(tmp_path / "wave.csv", columns), arm, position_unit="fraction", time_unit="ns")
    assert log.channels["qpos"].values[0] == pytest.approx([0.75, 0.75])  # −1.5 + 0.75 · 3 rad
    assert log.channels["qpos"].time == pytest.approx(
        0.02 * np.arange(4), abs=1e-6
    )  # from any start


COLUMN_MAP = """
time = "t"
time_unit = "ms"
position_unit = "rad"
[columns]
"ctrl.shoulder" = "cmd_1"
"ctrl.elbow" = "cmd_2"
"qpos.shoulder" = "pos_1"
"qpos.elbow" = "pos_2"
[joint_units]
elbow = "deg"
"""


def test_a_column_map_names_columns_and_units(tmp_path, arm):
    theirs = dict(
        zip(["t", "cmd_1", "cmd_2", "pos_1", "pos_2"], arm_columns().values(), strict=True)
    )
    theirs["t"] = theirs["t"] * 1000
    file = write(tmp_path / "wave.csv", theirs)
    toml = tmp_path / "map.toml"
    toml.write_text(COLUMN_MAP)
    ((_, log),) = read_logs(file, arm, ReadOptions(logs=toml))
    assert np.array_equal(log.channels["qpos"].values[:, 0], theirs["pos_1"])
    assert np.allclose(log.channels["qpos"].values[:, 1], theirs["pos_2"] * np.pi / 180)
    assert log.channels["qpos"].time[-1] == pytest.approx(1.18)
    assert log.meta["converted_from"] == {"elbow": "deg"}


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("time", "clock", r":1: column 'time'"),
        ("qpos.elbow", "elbow", r":1: column 'qpos\.elbow'"),
        ("ctrl.elbow", "note", r":1: column 'ctrl\.elbow'"),
        ("qpos.elbow", "qpos.shoulder", r":1: .*twice"),
        ("\n0.04,", "\n0.04,x", r":4: column 'ctrl\.shoulder'"),
        ("\n0.04,", "\n0.04,,", r":4: .*cells"),
        ("\n0.04,", "\n\n0.04,", r":4: .*empty"),
        ("\n0.04,", "\n,", r":4: .*empty"),
        ("\n0.04,", "\n0.01,", r":4: .*increase"),
    ],
)
def test_a_broken_table_is_refused_by_file_and_line(tmp_path, arm, old, new, message):
    file = write(tmp_path / "wave.csv", arm_columns(), old, new)
    with pytest.raises(LogError, match=r"wave\.csv" + message):
        only(file, arm)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "empty"),
        ("time\n", "ctrl"),
        (",".join(arm_columns()) + "\n", "rows"),
    ],
)
def test_an_empty_table_is_refused(tmp_path, arm, text, message):
    (tmp_path / "wave.csv").write_text(text)
    with pytest.raises(LogError, match=message):
        only(tmp_path / "wave.csv", arm)


def test_a_half_written_parquet_file_is_refused(tmp_path, arm):
    file = write_parquet(tmp_path / "wave.parquet", arm_columns())
    file.write_bytes(file.read_bytes()[: file.stat().st_size // 2])
    with pytest.raises(LogError, match=r"wave\.parquet"):
        only(file, arm)


def test_a_parquet_cell_that_is_empty_or_no_number_is_refused(tmp_path, arm):
    columns = arm_columns()
    hole = pa.array([None if i == 3 else x for i, x in enumerate(columns["ctrl.elbow"])])
    pq.write_table(pa.table(columns | {"ctrl.elbow": hole}), tmp_path / "hole.parquet")
    with pytest.raises(LogError, match=r"hole\.parquet:4:"):
        only(tmp_path / "hole.parquet", arm)
    pq.write_table(
        pa.table(columns | {"ctrl.elbow": pa.array(["1.0"] * 60)}), tmp_path / "text.parquet"
    )
    with pytest.raises(LogError, match=r"ctrl\.elbow"):
        only(tmp_path / "text.parquet", arm)


def test_a_folder_without_logs_names_the_known_formats(tmp_path, arm):
    (tmp_path / "readme.txt").touch()
    with pytest.raises(LogError, match="--formats"):
        list(read_logs(tmp_path, arm))
    with pytest.raises(LogError, match="nowhere"):
        list(read_logs(tmp_path / "nowhere", arm))
    with pytest.raises(LogError, match="ascii"):
        list(read_logs(tmp_path, arm, ReadOptions("ascii")))


def test_a_cell_longer_than_the_csv_module_takes_is_refused_by_line(tmp_path, arm):
    file = write(tmp_path / "wave.csv", arm_columns(), "\n0.04,", "\n" + "9" * 140_000 + "x,")
    with pytest.raises(
        LogError,
        match=r"wave\.csv:4:",
    ):
        only(file, arm)
    file.write_text("x" * 140_000 + "\n1\n2\n")
    with pytest.raises(LogError, match=r"wave\.csv:1:"):
        only(file, arm)


def test_names_in_a_parquet_file_that_are_no_text_are_refused(tmp_path, arm):
    file = write_parquet(tmp_path / "wave.parquet", arm_columns())
    file.write_bytes(file.read_bytes().replace(b"ctrl.elbow", b"ctrl.\xff\xfebow"))
    with pytest.raises(LogError, match=r"wave\.parquet"):
        only(file, arm)


def test_a_git_lfs_pointer_is_named_as_one(tmp_path, arm):
    for kind in ("csv", "parquet"):
        file = tmp_path / f"wave.{kind}"
        file.write_text("version https://git-lfs.github.com/spec/v1\noid sha256:4d7a\nsize 12345\n")
        with pytest.raises(LogError, match="LFS"):
            only(file, arm)


def test_a_column_that_stands_twice_is_refused_only_if_it_is_read(tmp_path, arm):
    plain = only(write(tmp_path / "plain.csv", arm_columns()), arm)
    further = arm_columns() | {"current_a": np.arange(60.0), "current_b": np.arange(60.0)}
    unused = write(tmp_path / "unused.csv", further, "current_a", "current_b")
    used = write(tmp_path / "used.csv", further, "current_a", "qpos.elbow")

    assert np.array_equal(only(unused, arm).channels["qpos"].values, plain.channels["qpos"].values)
    with pytest.raises(LogError, match="twice"):
        only(used, arm)


@pytest.mark.parametrize("separator", [";", "\t"])
def test_decimal_commas_are_read_as_numbers(tmp_path, arm, separator):
    plain = only(write(tmp_path / "plain.csv", arm_columns()), arm)
    text = table_text(arm_columns()).replace(",", separator)
    header, _, rows = text.partition("\n")
    file = tmp_path / "comma.csv"
    file.write_text(header + "\n" + rows.replace(".", ","))

    assert np.array_equal(only(file, arm).channels["qpos"].values, plain.channels["qpos"].values)


def test_a_bad_cell_among_decimal_commas_is_refused_by_line(tmp_path, arm):
    header, _, rows = table_text(arm_columns()).replace(",", ";").partition("\n")
    file = tmp_path / "comma.csv"
    file.write_text(header + "\n" + rows.replace(".", ",").replace("\n0,04;", "\n0,04;x", 1))

    with pytest.raises(LogError, match=r"comma\.csv:4"):
        only(file, arm)


def test_ticks_of_an_encoder_are_named_and_2048_is_the_zero(tmp_path, arm):
    columns = arm_columns()
    for name in columns:
        if name != "time":
            columns[name] = np.round(2048 + np.degrees(columns[name]) / 360 * 4096)
    file = write(tmp_path / "wave.csv", columns)

    with pytest.raises(LogError, match="ticks"):
        require_plausible(only(file, arm), arm)
    with pytest.raises(LogError, match="ticks"):
        require_plausible(only(file, arm, position_unit="deg"), arm)
    positions = only(file, arm, position_unit="ticks").channels["qpos"].values
    assert np.abs(positions[:, 1] - arm_columns()["qpos.elbow"]).max() < 2 * np.pi / 4096


def test_rows_that_were_written_twice_count_once(tmp_path, arm):
    once = arm_columns()
    twice = {name: np.repeat(values, 2) for name, values in once.items()}
    twice["time"][1::2] += 4e-4

    log = only(write(tmp_path / "twice.csv", twice), arm)

    assert np.allclose(log.channels["qpos"].time, once["time"])
    assert log.meta["notes"]["repeated"] == {"rows": 60}


def test_a_robot_at_rest_repeats_its_numbers_at_its_usual_period(tmp_path, arm):
    resting = arm_columns()
    for name in ("qpos.shoulder", "qpos.elbow"):
        resting[name] = np.full(60, 0.25)

    log = only(write(tmp_path / "rest.csv", resting), arm)

    assert len(log.channels["qpos"].time) == 60


def test_decimal_commas_between_spaces_are_read_as_numbers(tmp_path, arm):
    plain = only(write(tmp_path / "plain.csv", arm_columns()), arm)
    header, _, rows = table_text(arm_columns()).replace(",", " ").partition("\n")
    file = tmp_path / "comma.txt"
    file.write_text(header + "\n" + rows.replace(".", ","))

    assert np.array_equal(only(file, arm).channels["qpos"].values, plain.channels["qpos"].values)


def test_a_semicolon_in_a_name_does_not_separate_columns(tmp_path, arm):
    columns = arm_columns() | {"current [A; rms]": np.arange(60.0)}

    log = only(write(tmp_path / "wave.csv", columns), arm)

    assert log.joint_names == ("shoulder", "elbow")


def test_cells_of_named_values_are_refused(tmp_path, arm):
    columns = {name: pa.array(values) for name, values in arm_columns().items()}
    columns["ctrl.elbow"] = pa.array([{"goal": 0.1}] * 60)
    pq.write_table(pa.table(columns), tmp_path / "wave.parquet")
    with pytest.raises(LogError, match="flatten"):
        only(tmp_path / "wave.parquet", arm)


def test_lists_of_different_lengths_are_refused(tmp_path, arm):
    lists = [[0.1, 0.2]] * 59 + [[0.1]]
    columns = {"time": pa.array(arm_columns()["time"]), "u": pa.array(lists), "q": pa.array(lists)}
    pq.write_table(pa.table(columns), tmp_path / "wave.parquet")
    (tmp_path / "logs.toml").write_text(
        'ctrl = "u"\nqpos = "q"\njoints = ["shoulder", "elbow"]\n'
        'time_unit = "s"\nposition_unit = "rad"\n'
    )
    with pytest.raises(LogError, match="long"):
        list(read_logs(tmp_path, arm))


def test_lists_in_cells_of_text_are_named(tmp_path, arm):
    text = table_text(arm_columns()).splitlines()
    time, _, *others = text[3].split(",")
    text[3] = ",".join([time, '"[0.1; 0.2]"', *others])
    (tmp_path / "wave.csv").write_text("\n".join(text) + "\n")
    with pytest.raises(LogError, match="Parquet"):
        only(tmp_path / "wave.csv", arm)


def test_a_long_table_of_many_columns_without_a_header_is_not_called_transposed(tmp_path, arm):
    columns = arm_columns() | {f"further_{i}": np.zeros(60) for i in range(20)}
    (tmp_path / "wave.csv").write_text(table_text(columns).split("\n", 1)[1])
    (tmp_path / "logs.toml").write_text(
        f'header = {list(columns)}\ntime_unit = "s"\nposition_unit = "rad"\n'
    )
    ((_, log),) = read_logs(tmp_path, arm)
    assert np.array_equal(log.channels["ctrl"].values[:, 0], columns["ctrl.shoulder"])


def test_a_first_row_of_dates_that_is_cut_short_is_refused_by_line(tmp_path, arm):
    header, first, *rows = table_text(arm_columns()).splitlines()
    short = "2026-03-01T12:00:00," + ",".join(first.split(",")[2:])
    (tmp_path / "wave.csv").write_text("\n".join([header, short, *rows]) + "\n")
    with pytest.raises(LogError, match=r"wave\.csv:2:"):
        only(tmp_path / "wave.csv", arm)


def test_a_folder_without_tables_that_is_said_to_hold_some_is_refused(tmp_path, arm):
    with pytest.raises(LogError, match=r"\.parquet"):
        list(read_logs(tmp_path, arm, ReadOptions("table")))


def test_rows_per_joint_may_lie_in_parquet_and_need_a_time_and_numbers(tmp_path, arm):
    columns = arm_columns()
    long = {"t": np.repeat(columns["time"], 2), "joint": ["shoulder", "elbow"] * 60}
    for name, channel in (("command", "ctrl"), ("position", "qpos")):
        both = [columns[f"{channel}.{joint}"] for joint in ("shoulder", "elbow")]
        long[name] = np.stack(both, axis=1).ravel()
    file = write_parquet(tmp_path / "long.parquet", long)
    (tmp_path / "logs.toml").write_text(
        'ctrl = "command"\nqpos = "position"\ntime_unit = "s"\nposition_unit = "rad"\n'
    )
    ((_, log),) = read_logs(tmp_path, arm)
    assert np.array_equal(log.channels["qpos"].values[:, 1], columns["qpos.elbow"])

    write_parquet(file, {("stamped" if name == "t" else name): long[name] for name in long})
    with pytest.raises(LogError, match="times"):
        list(read_logs(tmp_path, arm))
    write_parquet(file, long | {"command": [None, *long["command"][1:].tolist()]})
    with pytest.raises(LogError, match="'command'"):
        list(read_logs(tmp_path, arm))


def test_percent_that_are_called_degrees_or_radians_are_named(tmp_path, arm):
    columns = {name: 500 * values for name, values in arm_columns().items()}
    for name in columns.keys() - {"time"}:
        columns[name] = columns[name].clip(-100, 100)
    file = write(tmp_path / "wave.csv", columns | {"time": arm_columns()["time"]})
    with pytest.raises(LogError, match="signed_percent"):
        only(file, arm)


def test_commands_beyond_all_ranges_that_follow_the_recorded_torque_are_torques(tmp_path, arm):
    columns = arm_columns()
    for joint in arm.joint_names:
        torque = np.random.default_rng(0).normal(size=60)
        columns |= {f"tau.{joint}": torque, f"ctrl.{joint}": 20 * torque}
    with pytest.raises(LogError, match="torques"):
        only(write(tmp_path / "wave.csv", columns), arm)


def test_noise_beyond_all_ranges_is_refused_as_no_position(tmp_path, arm):
    columns = arm_columns()
    for joint in arm.joint_names:
        columns[f"ctrl.{joint}"] = 20 * np.random.default_rng(0).normal(size=60)
    with pytest.raises(LogError, match="radians"):
        only(write(tmp_path / "wave.csv", columns), arm)


def test_a_torque_that_is_mostly_nonsense_is_left_out(tmp_path, arm):
    columns = arm_columns() | {f"tau.{joint}": np.full(60, 1e9) for joint in arm.joint_names}
    log = only(write(tmp_path / "wave.csv", columns), arm)
    assert "tau" not in log.channels
    assert log.meta["notes"]["nonsense"]["tau"]["done"] == "left out"
