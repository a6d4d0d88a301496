"""Tables as people have them: slow commands, empty channels, dates, lists in cells, joints that
turn on.
"""

import numpy as np
import pyarrow as pa
import pyarrow.csv as pacsv
import pyarrow.parquet as pq
import pytest
from arm import TOML, XML, write_arm
from logs import arm_columns, table_text

from gaponet.base.errors import LogError
from gaponet.data.describe.guess import guess_logs
from gaponet.data.formats import ReadOptions, files_under, look, read_logs
from gaponet.data.log import skip_bad_rows
from gaponet.data.sequence import SequenceMeta, to_sequence

SI = {"position_unit": "rad", "time_unit": "s"}
RAD = {"position_unit": "rad"}
LABELS = SequenceMeta("arm", "lab", "wave", 0.0)
ROWS = 200
JOINTS = ("shoulder", "elbow")


def cells(columns):
    """CSV with empty cells for NaN."""
    return table_text(columns).replace("nan", "")


def only(path, robot, **options):
    ((_, log),) = read_logs(path, robot, ReadOptions(**options))
    return log


@pytest.mark.parametrize("every", [2, 5, 9])
def test_a_command_that_is_slower_than_the_state_is_held(tmp_path, arm, every):
    columns = arm_columns(ROWS)
    told = np.arange(ROWS) % every == 0
    for joint in JOINTS:
        columns[f"ctrl.{joint}"] = np.where(told, columns[f"ctrl.{joint}"], np.nan)
    (tmp_path / "m.csv").write_text(cells(columns))
    log = only(tmp_path / "m.csv", arm, **SI)
    last = columns["time"][-1:]
    until_the_end = np.unique(np.append(columns["time"][told], last))
    assert np.allclose(log.channels["ctrl"].time, until_the_end)
    assert len(log.channels["qpos"].time) == ROWS
    assert log.meta["notes"]["slower"]["ctrl"] == {"rows": told.sum(), "of": ROWS}


def test_commands_of_joints_that_come_in_turn_are_held_each(tmp_path, arm):
    columns = arm_columns(ROWS)
    sent = [columns[f"ctrl.{joint}"] for joint in JOINTS]
    for j, joint in enumerate(JOINTS):
        mine = np.arange(ROWS) % 2 == j
        columns[f"ctrl.{joint}"] = np.where(mine, columns[f"ctrl.{joint}"], np.nan)
    (tmp_path / "m.csv").write_text(cells(columns))
    ctrl = only(tmp_path / "m.csv", arm, **SI).channels["ctrl"].values
    rows = np.arange(1, ROWS)  # the elbow was told nothing in row 0
    assert np.array_equal(ctrl[:, 0], sent[0][rows - rows % 2])
    assert np.array_equal(ctrl[:, 1], sent[1][rows - 1 + rows % 2])


def test_a_step_that_is_sent_once_is_held_to_the_end(tmp_path, arm):
    columns = arm_columns(ROWS)
    told = np.isin(np.arange(ROWS), (0, 50))
    for joint in JOINTS:
        columns[f"ctrl.{joint}"] = np.where(told, columns[f"ctrl.{joint}"], np.nan)
    (tmp_path / "m.csv").write_text(cells(columns))
    sequence = to_sequence(only(tmp_path / "m.csv", arm, **SI), arm, LABELS)
    assert len(sequence) == ROWS
    assert np.allclose(sequence.ctrl[-1], sequence.ctrl[60])


def test_one_joint_that_is_slower_than_the_others_is_no_bad_row(tmp_path, arm):
    columns = arm_columns(ROWS)
    for channel in ("ctrl", "qpos"):
        values = columns[f"{channel}.elbow"]
        columns[f"{channel}.elbow"] = np.where(np.arange(ROWS) % 3 == 0, values, np.nan)
    (tmp_path / "m.csv").write_text(cells(columns))
    log = only(tmp_path / "m.csv", arm, **SI)
    known = 3 * ((ROWS - 1) // 3) + 1  # rows up to the elbow's last position
    assert len(log.channels["qpos"].time) == known


def test_tabs_at_the_end_of_the_last_row_are_empty_cells(tmp_path, arm):
    torque = np.where(np.arange(ROWS) % 5 == 0, 0.1, np.nan)
    columns = arm_columns(ROWS) | {f"tau.{joint}": torque for joint in JOINTS}
    (tmp_path / "m.tsv").write_text(cells(columns).replace(",", "\t"))
    assert len(only(tmp_path / "m.tsv", arm, **SI).channels["qpos"].time) == ROWS


def test_of_a_stamp_that_is_too_late_only_its_row_is_cut(tmp_path, arm):
    columns = arm_columns(ROWS)
    columns["time"][100] += 1.0
    (tmp_path / "m.csv").write_text(table_text(columns))
    with skip_bad_rows() as cut:
        log = only(tmp_path / "m.csv", arm, **SI)
    assert len(cut) == 1
    assert np.array_equal(log.channels["qpos"].time, np.delete(columns["time"], 100))


def test_one_empty_cell_is_a_bad_row(tmp_path, arm):
    columns = arm_columns(ROWS)
    columns["ctrl.elbow"][50] = np.nan
    (tmp_path / "m.csv").write_text(cells(columns))
    with pytest.raises(LogError, match=r"m\.csv:52:"):
        only(tmp_path / "m.csv", arm, **SI)


def test_a_torque_that_is_never_there_is_left_out(tmp_path, arm):
    columns = arm_columns(ROWS) | {f"tau.{joint}": np.full(ROWS, np.nan) for joint in JOINTS}
    (tmp_path / "m.csv").write_text(table_text(columns))
    log = only(tmp_path / "m.csv", arm, **SI)
    assert "tau" not in log.channels
    assert log.meta["notes"]["absent"] == {"tau": list(JOINTS)}


@pytest.mark.parametrize(
    "form",
    [
        "%Y-%m-%dT%H:%M:%S.%fZ",
        "%Y-%m-%dT%H:%M:%S.%f789Z",
        "%Y-%m-%d %H:%M:%S.%f+02:00",
        "%Y-%m-%d %H:%M:%S.%f",
        "%H:%M:%S.%f",
    ],
)
@pytest.mark.parametrize("kind", ["csv", "parquet"])
def test_a_clock_of_dates_needs_no_unit(tmp_path, arm, form, kind):
    columns = arm_columns(ROWS)
    start = np.datetime64("2026-03-01T23:59:58")
    at = start + (1e6 * columns.pop("time")).round().astype("timedelta64[us]")
    text = [moment.item().strftime(form) for moment in at]
    if kind == "parquet":
        arrays = {"time": pa.array(text)} | {k: pa.array(v) for k, v in columns.items()}
        pq.write_table(pa.table(arrays), tmp_path / "m.parquet")
    else:
        lines = table_text(columns).splitlines()
        rows = [f"{a},{row}" for a, row in zip(["time", *text], lines, strict=True)]
        (tmp_path / "m.csv").write_text("\n".join(rows) + "\n")
    log = only(tmp_path / f"m.{kind}", arm, position_unit="rad")
    assert np.allclose(log.channels["qpos"].time, 0.02 * np.arange(ROWS), atol=2e-6)


def test_typed_dates_of_parquet_need_no_unit(tmp_path, arm):
    columns = arm_columns(ROWS)
    at = np.datetime64("2026-03-01") + (1e9 * columns.pop("time")).round().astype("timedelta64[ns]")
    arrays = {"time": pa.array(at)} | {k: pa.array(v) for k, v in columns.items()}
    pq.write_table(pa.table(arrays), tmp_path / "m.parquet")
    log = only(tmp_path / "m.parquet", arm, position_unit="rad")
    assert np.allclose(log.channels["qpos"].time, 0.02 * np.arange(ROWS), atol=2e-6)


@pytest.mark.parametrize("kind", ["dates", "typed dates", "stamps", "seconds"])
def test_clocks_of_one_instant_keep_what_lies_between_their_first_stamps(tmp_path, arm, kind):
    columns = arm_columns(ROWS)
    for name, after in (("sent", 0.97), ("seen", 1.02)):
        seconds = columns["time"] + after
        moments = np.datetime64("2026-03-01") + (1e6 * seconds).round().astype("timedelta64[us]")
        if kind == "stamps":
            columns[f"{name}.sec"] = 1.7e9 + np.floor(seconds)
            columns[f"{name}.nanosec"] = 1e9 * (seconds % 1)
        elif kind == "typed dates":
            columns[name] = moments
        else:
            columns[name] = moments.astype(str) if kind == "dates" else 1.7e9 + seconds
    del columns["time"]
    pq.write_table(pa.table({k: pa.array(v) for k, v in columns.items()}), tmp_path / "m.parquet")
    (tmp_path / "logs.toml").write_text(
        'position_unit = "rad"\ntime_unit = "s"\n[clock]\nctrl = "sent"\nqpos = "seen"\n'
    )
    log = only(tmp_path, arm)
    assert log.channels["ctrl"].time[0] == 0.0
    assert log.channels["qpos"].time[0] == pytest.approx(0.05, abs=2e-6)


@pytest.mark.parametrize("kind", ["slow command", "rows twice"])
def test_an_error_names_the_line_in_the_file(tmp_path, arm, kind):
    columns = arm_columns(ROWS)
    if kind == "slow command":
        slow = np.arange(ROWS) % 5 > 0
        columns["ctrl.elbow"][100] = 57.3
        for joint in JOINTS:
            columns[f"ctrl.{joint}"][slow] = np.nan
    else:
        columns["qpos.elbow"][50] = np.nan
        columns = {name: values.repeat(2) for name, values in columns.items()}
    (tmp_path / "m.csv").write_text(cells(columns))
    with pytest.raises(LogError, match=r"m\.csv:102: "):
        only(tmp_path / "m.csv", arm, **SI)


@pytest.mark.parametrize("stamps", ["seconds", "dates", "times of day"])
@pytest.mark.parametrize("empty", [0, 100])
@pytest.mark.parametrize("kind", ["csv", "parquet"])
def test_an_empty_stamp_costs_one_row(tmp_path, arm, stamps, empty, kind):
    columns = arm_columns(ROWS)
    columns["time"][empty] = np.nan
    table = {name: pa.array(values) for name, values in columns.items()}
    if stamps != "seconds":
        # Midnight is between rows 100 and 101.
        at = np.datetime64("2026-03-01T23:59:58") + (1e6 * columns["time"]).astype(
            "timedelta64[us]"
        )
        form = "%H:%M:%S.%f" if stamps == "times of day" else "%Y-%m-%dT%H:%M:%S.%f"
        text = [None if np.isnat(moment) else moment.item().strftime(form) for moment in at]
        table["time"] = pa.array(text)
    if kind == "parquet":
        pq.write_table(pa.table(table), tmp_path / "m.parquet")
    else:
        pacsv.write_csv(pa.table(table), tmp_path / "m.csv")
    with skip_bad_rows(True) as cut:
        log = only(tmp_path / f"m.{kind}", arm, **(SI if stamps == "seconds" else RAD))
    assert len(log.channels["qpos"].time) == ROWS - 1
    assert len(cut) == 1


def test_an_error_names_the_line_where_rows_before_were_cut_or_written_twice(tmp_path, arm):
    columns = arm_columns(ROWS)
    columns["qpos.elbow"][10:30] = np.nan
    columns["time"][150:] += 5.0
    (tmp_path / "cut.csv").write_text(cells(columns))
    with skip_bad_rows(True), pytest.raises(LogError, match=r"cut\.csv:152"):
        to_sequence(only(tmp_path / "cut.csv", arm, **SI), arm, LABELS)
    twice = {name: values.repeat(2) for name, values in arm_columns(ROWS).items()}
    twice["time"][1::2] += 4e-4
    twice["time"][150:] += 5.0
    (tmp_path / "twice.csv").write_text(cells(twice))
    with pytest.raises(LogError, match=r"twice\.csv:152"):
        to_sequence(only(tmp_path / "twice.csv", arm, **SI), arm, LABELS)


def test_an_empty_table_is_one_clear_error(tmp_path, arm):
    columns = {k: pa.array(v[:0]) for k, v in arm_columns(ROWS).items()}
    columns["time"] = pa.array([], pa.string())
    pq.write_table(pa.table(columns), tmp_path / "m.parquet")
    with pytest.raises(LogError):
        only(tmp_path / "m.parquet", arm, position_unit="rad")


def test_lists_in_parquet_cells_are_arrays(tmp_path, arm):
    columns = arm_columns(ROWS)
    action, state = (
        np.stack([columns[f"{name}.{joint}"] for joint in JOINTS], axis=1)
        for name in ("ctrl", "qpos")
    )
    pq.write_table(
        pa.table(
            {
                "timestamp": pa.array(columns["time"]),
                "action": pa.array(action.tolist()),
                "observation.state": pa.FixedSizeListArray.from_arrays(pa.array(state.ravel()), 2),
            }
        ),
        tmp_path / "m.parquet",
    )
    (tmp_path / "logs.toml").write_text(
        'time = "timestamp"\ntime_unit = "s"\nposition_unit = "rad"\nctrl = "action"\n'
        'qpos = "observation.state"\njoints = ["shoulder", "elbow"]\n'
    )
    log = only(tmp_path, arm)
    assert np.array_equal(log.channels["ctrl"].values, action)
    assert np.array_equal(log.channels["qpos"].values, state)


@pytest.mark.parametrize("turns", [0, 1, -3])
@pytest.mark.parametrize("wrapped", [("qpos",), ("ctrl",), ("ctrl", "qpos")])
def test_a_joint_that_turns_on_is_continued_beside_its_command(tmp_path, wrapped, turns):
    robot = write_arm(
        tmp_path / "arm",
        TOML,
        XML.replace(
            'name="shoulder" axis="0 1 0" range="-1.5 1.5"', 'name="shoulder" axis="0 1 0"'
        ),
    )
    columns = arm_columns(ROWS)
    true = {
        name: 2.9 + columns[f"{name}.shoulder"] + 2 * columns["time"] for name in ("ctrl", "qpos")
    }
    for name, values in true.items():
        shown = (values + np.pi) % (2 * np.pi) - np.pi if name in wrapped else values
        columns[f"{name}.shoulder"] = shown + 2 * np.pi * turns * (name == "qpos")
    (tmp_path / "m.csv").write_text(table_text(columns))
    log = only(tmp_path / "m.csv", robot, **SI)
    off = log.channels["qpos"].values[:, 0] - log.channels["ctrl"].values[:, 0]
    assert np.allclose(off, true["qpos"] - true["ctrl"], atol=1e-9)
    assert "shoulder" in log.meta["notes"]["turns"]


@pytest.mark.parametrize(
    "files",
    [
        ("{}_desired.csv", "{}_measured.csv", "{}_time.csv"),
        ("cmd-{}.txt", "actual-{}.txt", "timestamp-{}.txt"),
        ("{}PosTarget.csv", "{}PosActual.csv", "{}Time.csv"),
    ],
)
def test_files_that_belong_together_are_proposed_and_then_read_as_one_recording(
    tmp_path, arm, files
):
    for name in ("run1", "run2"):
        columns = arm_columns(ROWS)
        command, state = (
            np.stack([columns[f"{channel}.{joint}"] for joint in JOINTS], axis=1)
            for channel in ("ctrl", "qpos")
        )
        for pattern, values in zip(files, (command, state, columns["time"]), strict=True):
            np.savetxt(tmp_path / pattern.format(name), values, delimiter=",")
    if files[0].endswith("txt"):
        (tmp_path / "logs.toml").write_text('format = "table"\n')
    kind, known, found = look(tmp_path)
    (tmp_path / "logs.toml").write_text(guess_logs(found, arm, kind, dict(known)))
    logs = dict(read_logs(tmp_path, arm, ReadOptions(format="table")))
    assert list(logs) == ["run1", "run2"]
    assert np.array_equal(logs["run1"].channels["ctrl"].values, command)
    assert np.array_equal(logs["run1"].channels["qpos"].values, state)
    assert np.allclose(logs["run1"].channels["qpos"].time, columns["time"])


@pytest.mark.parametrize("named", [True, False])
def test_a_table_with_a_row_per_signal_is_called_transposed(tmp_path, arm, named):
    columns = arm_columns(ROWS)
    lines = [
        ",".join([*[name] * named, *map(repr, values.tolist())]) for name, values in columns.items()
    ]
    (tmp_path / "m.csv").write_text("\n".join(lines) + "\n")
    with pytest.raises(LogError, match="transposed"):
        only(tmp_path / "m.csv", arm, **SI)


@pytest.mark.parametrize("clock", [True, False])
def test_arrays_with_a_column_per_sample_are_turned(tmp_path, arm, clock):
    columns = arm_columns(ROWS)
    arrays = {
        name: np.stack([columns[f"{name}.{joint}"] for joint in JOINTS])
        for name in ("ctrl", "qpos")
    }
    if clock:
        arrays["time"] = columns["time"][None]
    np.savez(tmp_path / "m.npz", **arrays)
    (tmp_path / "logs.toml").write_text(
        'ctrl = "ctrl"\nqpos = "qpos"\nposition_unit = "rad"\njoints = ["shoulder", "elbow"]\n'
        + ('time = "time"\ntime_unit = "s"\n' if clock else "rate = 50.0\n")
    )
    log = only(tmp_path, arm)
    assert np.array_equal(log.channels["qpos"].values, arrays["qpos"].T)
    assert log.meta["notes"]["transposed"] == ["ctrl", "qpos"]


def test_logs_behind_a_link_are_found_once_also_where_links_go_in_a_circle(tmp_path):
    (tmp_path / "disk" / "day").mkdir(parents=True)
    (tmp_path / "disk" / "day" / "m.npz").write_bytes(b"")
    (tmp_path / "disk" / "day" / "back").symlink_to(tmp_path / "disk")
    (tmp_path / "logs").mkdir()
    (tmp_path / "logs" / "linked").symlink_to(tmp_path / "disk")
    assert files_under(tmp_path / "logs", (".npz",)) == [tmp_path / "logs/linked/day/m.npz"]


def test_a_joint_with_a_range_may_count_from_zero_to_a_turn(tmp_path, arm):
    columns = arm_columns(ROWS)
    degrees = {
        name: values if name == "time" else np.degrees(values) % 360
        for name, values in columns.items()
    }
    (tmp_path / "m.csv").write_text(table_text(degrees))
    log = only(tmp_path / "m.csv", arm, position_unit="deg", time_unit="s")
    assert np.allclose(log.channels["qpos"].values[:, 0], columns["qpos.shoulder"])
    assert "shoulder" in log.meta["notes"]["turns"]


@pytest.mark.parametrize("kind", ["speeds", "torques"])
def test_speeds_or_torques_under_the_name_of_targets_are_named(tmp_path, arm, kind):
    columns = arm_columns(ROWS)
    for joint in JOINTS:
        speed = np.gradient(columns[f"qpos.{joint}"], columns["time"])
        driven = speed if kind == "speeds" else np.gradient(speed, columns["time"])
        columns[f"ctrl.{joint}"] = 20.0 * driven
    (tmp_path / "m.csv").write_text(table_text(columns))
    with pytest.raises(LogError, match=kind):
        only(tmp_path / "m.csv", arm, **SI)


def test_command_and_state_are_brought_into_the_range_by_the_same_turns(tmp_path):
    arm = write_arm(tmp_path / "wide", xml=XML.replace("-1.5 1.5", "-3.14 3.14"))
    state = np.linspace(200.0, 240.0, ROWS)  # −160° to −120°; beyond 180° and 1 rad at its end
    columns = {"time": 0.02 * np.arange(ROWS)}
    for joint in arm.joint_names:
        columns |= {f"ctrl.{joint}": state - 5.0, f"qpos.{joint}": state}
    (tmp_path / "m.csv").write_text(table_text(columns))
    log = only(tmp_path / "m.csv", arm, position_unit="deg", time_unit="s")
    assert np.allclose(log.channels["qpos"].values[:, 0], np.radians(state - 360.0))
    assert np.allclose(log.channels["ctrl"].values[:, 0], np.radians(state - 365.0))
