"""Atomic writes, one writer per folder, no writes into other people's folders."""

import os
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor

import pytest

from gaponet.base.errors import FolderError
from gaponet.base.files import (
    FOLDER_MARKER,
    atomic_write,
    lock_folder,
    require_own_folder,
    write_text,
)


def names(folder):
    return sorted(f.name for f in folder.iterdir())


def test_a_failed_write_leaves_the_file_unchanged(tmp_path):
    write_text(tmp_path / "a.json", "old")

    def full():
        with atomic_write(tmp_path / "a.json") as temporary:
            temporary.write_text("new")
            raise OSError(28, "No space left on device", "somewhere")

    with pytest.raises(OSError, match=r"a\.json"):
        full()
    assert (tmp_path / "a.json").read_text() == "old"
    assert names(tmp_path) == ["a.json"]


def test_a_new_folder_is_marked_with_its_kind(tmp_path):
    with lock_folder(tmp_path / "a" / "b", "run"):
        write_text(tmp_path / "a" / "b" / "x", "")
    assert (tmp_path / "a" / "b" / FOLDER_MARKER).read_text() == "run\n"
    with lock_folder(tmp_path / "a" / "b", "run"), lock_folder(tmp_path / "a" / "b", "run"):
        pass
    with pytest.raises(
        FolderError, match="b: holds gaponet's run, not dataset; choose another folder"
    ):
        require_own_folder(tmp_path / "a" / "b", "dataset")


def test_a_block_that_fails_before_writing_leaves_no_folder(tmp_path):
    (tmp_path / "empty").mkdir()
    for folder in (tmp_path / "a" / "b", tmp_path / "empty"):
        with pytest.raises(ZeroDivisionError), lock_folder(folder, "run"):
            raise ZeroDivisionError
    assert names(tmp_path) == ["empty"]
    assert names(tmp_path / "empty") == []


def test_a_block_that_fails_after_writing_removes_nothing(tmp_path):
    def fail():
        with lock_folder(tmp_path / "a", "run"):
            write_text(tmp_path / "a" / "x", "")
            raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        fail()
    assert names(tmp_path / "a") == [FOLDER_MARKER, "x"]


@pytest.mark.parametrize("name", ["notes.txt", ".env", "dataset"])
def test_a_folder_of_another_program_is_refused_and_unchanged(tmp_path, name):
    (tmp_path / name).mkdir()
    with (
        pytest.raises(FolderError, match=f"holds {name}, so it is no run of gaponet"),
        lock_folder(tmp_path, "run"),
    ):
        pass
    assert names(tmp_path) == [name]


def test_a_second_writer_is_refused_or_waits_for_the_first(tmp_path):
    def other(wait):
        with lock_folder(tmp_path / "a", "run", wait):
            return True

    with ThreadPoolExecutor(1) as pool:
        with lock_folder(tmp_path / "a", "run"):
            with pytest.raises(
                FolderError, match=rf"another gaponet \(process {os.getpid()}\) is writing here"
            ):
                pool.submit(other, 0.0).result()
            patient = pool.submit(other, 60.0)
        assert patient.result()


def test_the_next_writer_removes_unfinished_files_of_a_killed_one(tmp_path):
    code = (
        "import os, sys; from pathlib import Path; from gaponet.base.files import atomic_write, lock_folder\n"
        "with lock_folder(Path(sys.argv[1]), 'run'), atomic_write(Path(sys.argv[1]) / 'sub' / 'x') as file:\n"
        "    file.parent.mkdir(); file.write_text('half'); os.kill(os.getpid(), 9)\n"
    )
    out = tmp_path / "out"
    subprocess.run([sys.executable, "-c", code, str(out)], check=False)
    left = next((out / "sub").iterdir()).name
    assert left.startswith(f"{FOLDER_MARKER}-")
    mine = out / "sub" / f"{FOLDER_MARKER}-{os.getpid()}-y"  # of a process that lives
    mine.touch()
    (out / "sub" / f"{FOLDER_MARKER}rc").touch()
    with lock_folder(out, "run"):
        assert names(out / "sub") == [mine.name, f"{FOLDER_MARKER}rc"]


@pytest.mark.parametrize(
    ("kind", "file"),
    [
        ("dataset", "dataset.json"),
        ("model", "card.json"),
    ],
)
def test_a_folder_of_an_older_version_is_recognised_by_its_files(tmp_path, kind, file):
    (tmp_path / file).parent.mkdir(parents=True, exist_ok=True)
    (tmp_path / file).write_text("{}")
    with lock_folder(tmp_path, kind):
        pass
    assert names(tmp_path)[0] == FOLDER_MARKER
    (tmp_path / FOLDER_MARKER).unlink()
    with pytest.raises(FolderError, match="so it is no run of gaponet"):
        require_own_folder(tmp_path, "run")
