"""Recordings that grow in a file: what memory holds of them, and what is left after a full disk or
a kill.
"""

from __future__ import annotations

import errno
import json
import os
import subprocess
import sys
import threading
import tracemalloc
from datetime import datetime

import numpy as np
import pytest

import gaponet
from gaponet.base.errors import FolderError, LogError, UnsavedError
from gaponet.data.formats import find_logs
from gaponet.hw.control import rows as module
from gaponet.hw.control.driver import State
from gaponet.hw.control.recording import Recording
from gaponet.hw.control.rows import CHUNK_ROWS, Row, Rows

NAMES = ("elbow", "wrist")


def row(k: int, names: tuple[str, ...] = NAMES) -> Row:
    q = np.full(len(names), 0.001 * k)
    return Row(
        0.02 * k,
        "run",
        q,
        q if k % 50 else None,
        State(0.02 * k - 0.001, q, 2 * q, 3 * q, 40 + q, k, 0.1),
    )


def recording(count: int, folder=None) -> Recording:
    made = Recording("arm", True, NAMES, NAMES, 0.02)
    if folder:
        made.write_to(folder)
    for k in range(count):
        made.rows.append(row(k))
    return made


@pytest.mark.parametrize("count", [0, 1, CHUNK_ROWS, 3 * CHUNK_ROWS + 5])
def test_rows_come_back_as_they_were(count):
    rows = Rows(NAMES)
    for k in range(count):
        rows.append(row(k))
        if k == CHUNK_ROWS + 3:
            assert len(rows) == k + 1  # looking at it half-way changes nothing
    assert len(rows) == count
    for k, found in enumerate(rows):
        want = row(k)
        assert (found.time, found.phase, found.state.refused) == (want.time, "run", k)
        assert (found.ctrl is None) == (want.ctrl is None)
        np.testing.assert_array_equal(found.state.tau, want.state.tau)
    assert [r.time for r in rows[-2:]] == [row(k).time for k in range(count)][-2:]


def test_a_saved_recording_says_when_and_with_which_version(tmp_path):
    before = datetime.now().astimezone().replace(microsecond=0)
    recording(3, tmp_path).save(tmp_path, "sweep")
    facts = json.loads((tmp_path / "sweep.json").read_text())
    assert before <= datetime.fromisoformat(facts["saved"]) <= datetime.now().astimezone()
    assert facts["gaponet"] == gaponet.__version__


def test_an_import_of_a_run_whose_motion_did_not_begin_says_so(tmp_path):
    recording(0, tmp_path).save(tmp_path, "sweep")
    with pytest.raises(LogError, match=r"did not begin; the events in sweep\.json say why"):
        find_logs(tmp_path)


def test_memory_holds_none_of_an_hours_rows():
    names = tuple(f"joint_{i}" for i in range(27))
    rows = Rows(names)
    one = row(1, tuple(map(str, range(27))))
    tracemalloc.start()
    try:
        for k in range(20_000):
            rows.append(one)
            if k % 1000 == 0:
                # A busy machine's disk may be behind; what waits for it is in memory.
                rows.wait_written()
        rows.close()
        assert tracemalloc.get_traced_memory()[1] < 10e6  # bytes; all rows are 28 MB
    finally:
        tracemalloc.stop()
    assert len(rows) == 20_000


def test_a_killed_process_leaves_its_periods_readable_by_name(tmp_path):
    script = (
        "import os, sys; sys.path.insert(0, 'tests')\n"
        "from pathlib import Path; from hw.control.test_rows import recording\n"
        "made = recording(300, Path(sys.argv[1])); made.rows.wait_written(); "
        "os.kill(os.getpid(), 9)\n"
    )
    folder = tmp_path / "logs"
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(sys.path)}
    assert subprocess.run([sys.executable, "-c", script, folder], env=environment).returncode == -9
    (left,) = folder.glob("*.cycles.npy")
    found = np.load(left)
    assert len(found) == 300 // CHUNK_ROWS * CHUNK_ROWS
    np.testing.assert_allclose(found["qpos.wrist"], 0.001 * np.arange(len(found)))
    recording(10, folder).save(folder, "next")  # which removes nothing
    assert left.exists()


def test_a_disk_that_is_full_keeps_what_was_written_and_says_so(tmp_path, monkeypatch):
    folder = tmp_path / "logs"
    real = os.pwrite

    def full(descriptor: int, data: bytes, at: int) -> int:
        if at > 20_000 and len(data) > 3_000:
            return real(descriptor, data[:3_000], at)  # in the middle of a row
        if at > 20_000:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        return real(descriptor, data, at)

    monkeypatch.setattr(module.os, "pwrite", full)
    made = recording(500, folder)
    kept = len(made.rows)
    assert CHUNK_ROWS <= kept < 500
    assert made.rows.error == "No space left on device"
    with pytest.raises(LogError, match="space"):
        made.log("sway")
    path = made.save(folder, "sway")
    np.testing.assert_allclose(
        np.load(folder / "sway.cycles.npy")["qpos.elbow"], 0.001 * np.arange(kept)
    )
    assert json.loads((folder / "sway.json").read_text())["not_whole"] == "No space left on device"
    assert path.exists()  # there was room for the table


def test_a_summary_has_the_age_of_states_and_the_lateness_of_periods_in_ms():
    made = recording(10)  # each state is 1 ms old
    made.late = [0.002] * 10

    summary = made.summary()

    assert set(summary["state_age_ms"].values()) == {1.0}
    assert set(summary["late_ms"].values()) == {2.0}


def test_a_full_disk_without_room_for_the_header_either_ends_the_recording_only(
    tmp_path, monkeypatch
):
    folder = tmp_path / "logs"
    real = os.pwrite
    writes = []

    # A file system that copies what is overwritten.
    def full(descriptor: int, data: bytes, at: int) -> int:
        writes.append(at)
        if len(writes) > 5:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        return real(descriptor, data, at)

    monkeypatch.setattr(module.os, "pwrite", full)
    made = recording(500, folder)
    close_in_time(made)
    assert made.rows.error == "No space left on device"
    np.testing.assert_allclose(
        np.load(made.rows.path)["qpos.elbow"], 0.001 * np.arange(2 * CHUNK_ROWS)
    )


def close_in_time(made: Recording) -> None:
    """Close a recording whose writer may have ended."""
    end = threading.Thread(target=made.rows.close, daemon=True)
    end.start()
    end.join(10)
    assert not end.is_alive(), "it waits for ever for a writer that has ended"


def test_a_writer_that_fails_in_any_way_ends_the_recording_only(tmp_path, monkeypatch):
    def no_memory(descriptor: int, data: bytes, at: int) -> int:
        raise MemoryError

    made = recording(10, tmp_path / "logs")
    monkeypatch.setattr(module.os, "pwrite", no_memory)
    close_in_time(made)
    assert "MemoryError" in made.rows.error


def test_a_file_that_takes_no_header_is_not_left_behind(tmp_path, monkeypatch):
    def full(descriptor: int, data: bytes, at: int) -> int:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(module.os, "pwrite", full)
    with pytest.raises(OSError, match="space"):
        Rows(NAMES).write_to(tmp_path)
    assert list(tmp_path.iterdir()) == []


def test_what_cannot_be_written_at_the_end_leaves_the_periods(tmp_path, monkeypatch):
    made = recording(200, tmp_path / "logs")

    def full(*_: object) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), "sway.json")

    monkeypatch.setattr("gaponet.hw.control.recording.write_text", full)
    with pytest.raises(UnsavedError, match=r"sway\.cycles"):
        made.save(tmp_path / "logs", "sway")
    assert len(np.load(tmp_path / "logs" / "sway.cycles.npy")) == 200


def test_a_folder_of_somebody_else_is_refused_before_anything_moves(tmp_path):
    (tmp_path / "thesis.tex").write_text("")
    with pytest.raises(FolderError, match=r"thesis\.tex"):
        recording(0, tmp_path)
