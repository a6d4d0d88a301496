"""Text of tables as other programs write it: encodings, line ends, comments, units, clocks."""

import numpy as np
import pytest
from logs import arm_columns, table_text

from gaponet.base.errors import LogError
from gaponet.data.describe.guess import guess_logs
from gaponet.data.formats import ReadOptions, look, read_logs
from gaponet.data.formats.text import heading

SI = {"position_unit": "rad", "time_unit": "s"}
ROWS = 60


def qpos_of(path, robot):
    ((_, log),) = read_logs(path, robot, ReadOptions(**SI))
    return log.channels["qpos"].values[:, 1]


@pytest.mark.parametrize(
    ("encoding", "end"), [("utf-16", "\n"), ("utf-8-sig", "\r\n"), ("utf-8", "\r")]
)
def test_encoding_and_line_ends_do_not_matter(tmp_path, arm, encoding, end):
    columns = arm_columns(ROWS)
    text = table_text(columns).replace("\n", end)
    (tmp_path / "m.csv").write_bytes(text.encode(encoding))
    assert np.array_equal(qpos_of(tmp_path, arm), columns["qpos.elbow"])


@pytest.mark.parametrize(
    "before",
    ["# robot: arm\n# rate, 50\n", "% site\n", "Recorded by,ACME\nDate,2026-01-02\n\n", "# "],
)
def test_text_before_the_header_is_left_out(tmp_path, arm, before):
    columns = arm_columns(ROWS)
    (tmp_path / "m.csv").write_text(before + table_text(columns))
    assert np.array_equal(qpos_of(tmp_path, arm), columns["qpos.elbow"])


@pytest.mark.parametrize("header", [True, False])
def test_a_separator_at_the_end_of_rows_makes_no_column(tmp_path, arm, header):
    columns = arm_columns(ROWS)
    names, *rows = table_text(columns).splitlines()
    lines = [names + "," * header, *(row + "," for row in rows)]
    (tmp_path / "m.csv").write_text("\n".join(lines) + "\n")
    assert np.array_equal(qpos_of(tmp_path, arm), columns["qpos.elbow"])


def test_a_second_line_of_units_is_no_row(tmp_path, arm):
    columns = arm_columns(ROWS)
    names, *rows = table_text(columns).splitlines()
    units = ",".join(["s", *["rad"] * (len(columns) - 1)])
    (tmp_path / "m.csv").write_text("\n".join([names, units, *rows]) + "\n")
    assert np.array_equal(qpos_of(tmp_path, arm), columns["qpos.elbow"])


def test_numbers_of_columns_above_an_array_are_no_row():
    rows = "0.0,0.1,0.2\n0.02,0.1,0.2\n"
    assert heading(rows).first == 0
    assert heading(f"0,1,2\n{rows}").first == 1
    assert heading("0,1,2\n1,1,2\n").first == 0
    assert heading("0;1;2\n0,0;0,1;0,2\n").first == 1
    numbered = heading(",0,1,2\n0,2048,1024,5\n1,2048,1025,5\n")
    assert (numbered.first, numbered.cells) == (1, ["0", "2048", "1024", "5"])
    assert heading("0,1,2\n2048,1024,5\n2049,1024,5\n").first == 1


@pytest.mark.parametrize("cell", ['"1,234.5"', '"1.234,5"'])
def test_separators_between_thousands_are_named(tmp_path, arm, cell):
    columns = arm_columns(ROWS)
    lines = table_text(columns).splitlines()
    lines[9] = cell + lines[9][lines[9].index(",") :]
    (tmp_path / "m.csv").write_text("\n".join(lines) + "\n")
    with pytest.raises(LogError, match="thousands"):
        qpos_of(tmp_path, arm)


def test_rows_written_twice_at_one_instant_count_once(tmp_path, arm):
    columns = arm_columns(ROWS)
    (tmp_path / "m.csv").write_text(
        table_text({name: np.repeat(values, 2) for name, values in columns.items()})
    )
    assert np.array_equal(qpos_of(tmp_path, arm), columns["qpos.elbow"])


def test_channels_of_different_lengths_have_no_rate_in_common(tmp_path, arm):
    columns = arm_columns(ROWS)
    np.savez(
        tmp_path / "m.npz",
        cmd=np.stack([columns["ctrl.shoulder"], columns["ctrl.elbow"]], axis=1)[::2],
        pos=np.stack([columns["qpos.shoulder"], columns["qpos.elbow"]], axis=1),
    )
    (tmp_path / "logs.toml").write_text(
        'rate = 50.0\nctrl = "cmd"\nqpos = "pos"\nposition_unit = "rad"\n'
        'joints = ["shoulder", "elbow"]\n'
    )
    with pytest.raises(LogError, match="rows"):
        list(read_logs(tmp_path, arm))


@pytest.mark.parametrize("decimal", [".", ","])
@pytest.mark.parametrize(
    "form", ["%d.%m.%Y %H:%M:%S,%f", "%m/%d/%Y %I:%M:%S.%f %p", "%d/%m/%Y %H:%M:%S.%f"]
)
def test_dates_may_begin_with_the_day_or_the_month(tmp_path, arm, form, decimal):
    columns = arm_columns(ROWS)
    start = np.datetime64("2026-03-04T23:59:59.5")
    at = start + (1e6 * columns.pop("time")).round().astype("timedelta64[us]")
    names, *rows = table_text(columns).splitlines()
    lines = [f"stamp;{names.replace(',', ';')}"]
    for moment, row in zip(at, rows, strict=True):
        cells = row.replace(",", ";").replace(".", decimal)
        lines.append(f"{moment.item().strftime(form)};{cells}")
    (tmp_path / "m.csv").write_text("\n".join(lines) + "\n")
    (tmp_path / "logs.toml").write_text('time = "stamp"\nposition_unit = "rad"\n')
    ((_, log),) = read_logs(tmp_path, arm)
    assert np.allclose(log.channels["qpos"].time, 0.02 * np.arange(ROWS), atol=2e-6)


def test_seconds_and_nanoseconds_of_a_stamp_are_one_clock(tmp_path, arm):
    columns = arm_columns(ROWS)
    stamps = columns.pop("time") + 1_774_000_000
    whole = np.floor(stamps)
    clock = {"stamp.sec": whole, "stamp.nanosec": 1e9 * (stamps - whole)}
    (tmp_path / "m.csv").write_text(table_text(clock | columns))
    (tmp_path / "logs.toml").write_text('time = "stamp"\nposition_unit = "rad"\n')
    ((_, log),) = read_logs(tmp_path, arm)
    assert np.allclose(log.channels["qpos"].time, 0.02 * np.arange(ROWS), atol=1e-6)


def test_a_clock_of_whole_seconds_is_called_coarse(tmp_path, arm):
    columns = arm_columns(ROWS)
    columns["time"] = np.floor(columns["time"])
    (tmp_path / "m.csv").write_text(table_text(columns))
    with pytest.raises(LogError, match="coarse"):
        qpos_of(tmp_path, arm)


def guessed(path, robot):
    kind, known, found = look(path)
    return guess_logs(found, robot, kind, dict(known))


@pytest.mark.parametrize(
    ("name", "unit"),
    [("{}_pos_deg", "deg"), ("{} pos [rad]", "rad"), ("{}_pos_turns", "turns")],
)
def test_a_unit_in_the_names_of_columns_counts_more_than_the_size_of_values(
    tmp_path, arm, name, unit
):
    columns = arm_columns(ROWS)
    renamed = {"time": columns["time"]}
    for joint in ("shoulder", "elbow"):
        renamed[name.format(joint)] = 0.01 * columns[f"qpos.{joint}"]
        renamed[name.format(joint).replace("pos", "cmd")] = 0.01 * columns[f"ctrl.{joint}"]
    (tmp_path / "m.csv").write_text(table_text(renamed))
    assert f'position_unit = "{unit}"' in guessed(tmp_path, arm)


def test_a_gripper_beside_the_joints_decides_no_unit_and_is_left_out(tmp_path, arm):
    columns = arm_columns(ROWS)
    for channel in ("ctrl", "qpos"):
        columns[f"{channel}.gripper"] = 50 + 50 * np.sin(columns["time"])
    (tmp_path / "m.csv").write_text(table_text(columns))
    (tmp_path / "logs.toml").write_text(guessed(tmp_path, arm))
    ((_, log),) = read_logs(tmp_path, arm)
    assert np.array_equal(log.channels["qpos"].values[:, 1], columns["qpos.elbow"])


def test_turns_become_radians(tmp_path, arm):
    columns = arm_columns(ROWS)
    turns = {n: x if n == "time" else x / (2 * np.pi) for n, x in columns.items()}
    (tmp_path / "m.csv").write_text(table_text(turns))
    ((_, log),) = read_logs(tmp_path, arm, ReadOptions(position_unit="turns", time_unit="s"))
    assert np.allclose(log.channels["qpos"].values[:, 1], columns["qpos.elbow"])


def test_a_commented_header_counts_also_where_cells_hold_text(tmp_path, arm):
    columns = arm_columns(ROWS)
    names, *rows = table_text(columns).splitlines()
    lines = [f"%{names},frame", *(f"{row},base" for row in rows)]
    (tmp_path / "m.csv").write_text("\n".join(lines) + "\n")
    assert np.array_equal(qpos_of(tmp_path, arm), columns["qpos.elbow"])


def test_a_commented_header_may_have_other_separators_than_the_rows(tmp_path, arm):
    columns = arm_columns(ROWS)
    names, *rows = table_text(columns).splitlines()
    (tmp_path / "m.csv").write_text("\n".join(["# " + names.replace(",", " "), *rows]) + "\n")
    assert np.array_equal(qpos_of(tmp_path, arm), columns["qpos.elbow"])


def test_an_empty_first_row_is_no_line_of_units():
    assert heading("ctrl.a,qpos.a\nnan,nan\n0.1,0.2\n").first == 1


def test_comments_before_a_row_per_joint_are_left_out(tmp_path, arm):
    lines = ["# robot: arm", "time,joint,ctrl,qpos"]
    for row in range(ROWS):
        lines += [f"{0.02 * row:.2f},{name},{0.01 * row:.2f},0.5" for name in arm.joint_names]
    (tmp_path / "m.csv").write_text("\n".join(lines) + "\n")
    (tmp_path / "logs.toml").write_text('ctrl = "ctrl"\nqpos = "qpos"\n')
    assert np.array_equal(qpos_of(tmp_path, arm), np.full(ROWS, 0.5))


def test_a_clock_in_nanoseconds_beside_one_in_seconds_is_not_added_to_it(tmp_path, arm):
    columns = arm_columns(ROWS)
    time = columns.pop("time")
    clocks = {"t_sec": time, "t_nsec": 1e9 * time}
    (tmp_path / "m.csv").write_text(table_text(clocks | columns))
    described = 'time = "t_sec"\ntime_unit = "s"\nposition_unit = "rad"\n'
    (tmp_path / "logs.toml").write_text(described)
    ((_, log),) = read_logs(tmp_path, arm)
    assert np.array_equal(log.channels["qpos"].time, time)


def test_raw_in_the_name_of_a_column_is_no_unit(tmp_path, arm):
    columns = arm_columns(ROWS)
    renamed = {"time": columns["time"]}
    for joint in arm.joint_names:
        renamed[f"raw_q_{joint}"] = columns[f"qpos.{joint}"]
        renamed[f"cmd_q_{joint}"] = columns[f"ctrl.{joint}"]
    (tmp_path / "m.csv").write_text(table_text(renamed))
    assert 'position_unit = "rad"' in guessed(tmp_path, arm)
