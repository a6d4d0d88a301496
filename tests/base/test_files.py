"""Atomic writes, one writer per folder, no writes into other people's folders."""

import os
import shutil
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
    whole_folder,
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
    with pytest.raises(FolderError, match="run"):
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


@pytest.mark.skipif(os.name == "nt", reason="an open file cannot be removed there")
def test_a_block_whose_folder_was_removed_fails_with_its_own_error(tmp_path):
    folder = tmp_path / "a"

    def fail():
        with lock_folder(folder, "run"):
            shutil.rmtree(folder)
            raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        fail()
    with lock_folder(folder, "run"):
        assert names(folder) == [FOLDER_MARKER]  # locked anew


@pytest.mark.parametrize("name", ["notes.txt", ".env", "dataset"])
def test_a_folder_of_another_program_is_refused_and_unchanged(tmp_path, name):
    (tmp_path / name).mkdir()
    with (
        pytest.raises(FolderError, match=name),
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
            with pytest.raises(FolderError, match=str(os.getpid())):
                pool.submit(other, 0.0).result()
            patient = pool.submit(other, 60.0)
        assert patient.result()


def test_the_next_writer_removes_unfinished_files_of_a_killed_one(tmp_path):
    code = (
        "import os, sys; from pathlib import Path; from gaponet.base.files import atomic_write, "
        "lock_folder\nwith lock_folder(Path(sys.argv[1]), 'run'), atomic_write(Path(sys.argv[1]) "
        "/ 'sub' / 'x') as file:\n    file.parent.mkdir(); file.write_text('half'); "
        "os.kill(os.getpid(), 9)\n"
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
    with pytest.raises(FolderError, match="run"):
        require_own_folder(tmp_path, "run")


def test_a_whole_folder_appears_when_its_block_ends(tmp_path):
    with whole_folder(tmp_path / "robot", "robot", last="robot.toml") as place:
        (place / "robot.toml").write_text("new")
        (place / "meshes").mkdir()
        (place / "meshes" / "arm.obj").write_text("v")
        assert not (tmp_path / "robot" / "robot.toml").exists()
    assert names(tmp_path / "robot") == [FOLDER_MARKER, "meshes", "robot.toml"]
    assert (tmp_path / "robot" / "meshes" / "arm.obj").read_text() == "v"


def test_a_whole_folder_whose_block_fails_stays_as_it_was(tmp_path):
    with whole_folder(tmp_path, "robot", last="robot.toml") as place:
        (place / "robot.toml").write_text("old")

    def fail():
        with whole_folder(tmp_path, "robot", last="robot.toml", obsolete=("x.json",)) as place:
            (place / "robot.toml").write_text("new")
            (place / "picture.png").write_text("new")
            raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        fail()
    assert names(tmp_path) == [FOLDER_MARKER, "robot.toml"]
    assert (tmp_path / "robot.toml").read_text() == "old"


def test_what_describes_the_replaced_files_is_removed_with_them(tmp_path):
    for name in ("uncertainty.json", "report.html"):
        (tmp_path / name).write_text("of the old robot")
    (tmp_path / FOLDER_MARKER).write_text("robot\n")
    with whole_folder(
        tmp_path, "robot", last="robot.toml", obsolete=("uncertainty.json",)
    ) as place:
        (place / "robot.toml").write_text("new")
    assert names(tmp_path) == [FOLDER_MARKER, "report.html", "robot.toml"]


def test_a_whole_folder_of_a_killed_process_with_our_own_number_is_replaced(tmp_path):
    (tmp_path / f"{FOLDER_MARKER}-{os.getpid()}-new").mkdir()  # as in a container
    with whole_folder(tmp_path, "robot", last="robot.toml") as place:
        (place / "robot.toml").write_text("new")
    assert (tmp_path / "robot.toml").read_text() == "new"


def test_a_whole_folder_of_a_killed_process_is_left_as_it_was_and_tidied_by_the_next(tmp_path):
    killed = (
        "import os; from pathlib import Path; from gaponet.base.files import whole_folder\n"
        f"with whole_folder(Path({str(tmp_path)!r}), 'robot', last='robot.toml') as place:\n"
        "    (place / 'robot.toml').write_text('half')\n"
        "    os._exit(9)\n"
    )
    assert subprocess.run([sys.executable, "-c", killed], check=False).returncode == 9
    assert not (tmp_path / "robot.toml").exists()
    with whole_folder(tmp_path, "robot", last="robot.toml") as place:
        (place / "robot.toml").write_text("whole")
    assert names(tmp_path) == [FOLDER_MARKER, "robot.toml"]
