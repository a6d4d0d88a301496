"""Several recordings in one table: each is a recording of its own, and no reset between them is a
motion.
"""

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from logs import arm_columns, table_text

from gaponet.base.errors import LogError
from gaponet.data.formats import ReadOptions, read_logs
from gaponet.data.importer import ImportRequest, import_logs

SI = {"position_unit": "rad", "time_unit": "s"}
ROWS = (120, 90, 150)
JUMP_RAD = 0.8  # between the end of an episode and the start of the next


def joined(**extra):
    """Columns of three episodes, each with its own clock from 0; the second stands elsewhere."""
    parts = [arm_columns(rows) for rows in ROWS]
    for part in parts:
        part["time"] = part["time"] - part["time"][0]
    for name in ("ctrl.shoulder", "qpos.shoulder"):
        parts[1][name] = parts[1][name] + JUMP_RAD
    columns = {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}
    return columns | {name: np.concatenate(values) for name, values in extra.items()}


def numbers(values):
    return [np.full(rows, value) for rows, value in zip(ROWS, values, strict=True)]


def write(file, columns):
    if file.suffix == ".parquet":
        pq.write_table(pa.table(columns), file)
    else:
        file.write_text(table_text(columns))


@pytest.mark.parametrize("name", ["log.csv", "log.parquet"])
@pytest.mark.parametrize("column", ["episode_index", "episode", "traj_id"])
def test_each_episode_is_a_recording(tmp_path, arm, name, column):
    write(tmp_path / name, joined(**{column: numbers([4, 5, 7])}))
    logs = dict(read_logs(tmp_path / name, arm, ReadOptions(**SI)))
    assert {motion: len(log.channels["qpos"].time) for motion, log in logs.items()} == {
        "log-0004": 120,
        "log-0005": 90,
        "log-0007": 150,
    }


def test_numbers_that_no_float_counts_are_no_episodes(tmp_path, arm):
    write(tmp_path / "log.csv", arm_columns(60) | {"episode": np.repeat([1e300, 2.0], 30)})
    assert [motion for motion, _ in read_logs(tmp_path / "log.csv", arm, ReadOptions(**SI))] == [
        "log"
    ]


def test_a_reset_between_episodes_is_no_motion(tmp_path, arm):
    write(tmp_path / "log.csv", joined(episode_index=numbers([0, 1, 2])))
    dataset = import_logs(
        tmp_path / "log.csv",
        arm,
        tmp_path / "data",
        ImportRequest(unit_id="u", payload_mass=0.0, **SI),
    ).dataset
    steps = [np.abs(np.diff(dataset.read(e).qpos, axis=0)).max() for e in dataset.entries]
    assert max(steps) < JUMP_RAD / 4


def test_episodes_whose_rows_alternate_are_taken_apart(tmp_path, arm):
    columns = joined(episode_index=numbers([0, 1, 2]))
    order = np.argsort(columns["time"], kind="stable")
    write(tmp_path / "log.csv", {name: values[order] for name, values in columns.items()})
    lengths = [
        len(log.channels["qpos"].time)
        for _, log in read_logs(tmp_path / "log.csv", arm, ReadOptions(**SI))
    ]
    assert lengths == list(ROWS)


def test_frames_that_begin_again_are_episodes(tmp_path, arm):
    columns = joined(frame_index=[np.arange(rows) for rows in ROWS])
    del columns["time"]
    write(tmp_path / "log.csv", columns)
    logs = list(read_logs(tmp_path / "log.csv", arm, ReadOptions(rate=50.0, position_unit="rad")))
    assert [len(log.channels["qpos"].time) for _, log in logs] == list(ROWS)


def test_the_line_of_a_bad_row_is_that_of_the_file(tmp_path, arm):
    columns = joined(episode_index=numbers([0, 1, 2]))
    columns["qpos.elbow"][ROWS[0] + 3] = np.nan
    write(tmp_path / "log.csv", columns)
    with pytest.raises(LogError, match=rf"log\.csv:{ROWS[0] + 3 + 2}:"):
        list(read_logs(tmp_path / "log.csv", arm, ReadOptions(**SI)))


@pytest.mark.parametrize("skip_bad", [False, True])
def test_a_clock_that_starts_again_is_several_recordings(tmp_path, arm, skip_bad):
    write(tmp_path / "log.csv", joined())
    with pytest.raises(LogError, match="episode_index"):
        import_logs(
            tmp_path / "log.csv",
            arm,
            tmp_path / "data",
            ImportRequest(unit_id="u", payload_mass=0.0, skip_bad=skip_bad, **SI),
        )
