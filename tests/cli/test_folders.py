"""Every command with a folder of the user's to write into looks at it first."""

import errno
import os

import pytest

from gaponet.cli.main import main
from gaponet.files import writing

COMMANDS = [
    ["import", "nowhere", "--robot", "so101", "--out"],
    ["collect", "--robot", "so101", "--recipe", "arm", "--out"],
    ["train", "nowhere", "--out"],
    ["identify", "nowhere", "--out"],
    ["experiment", "compare", "nowhere", "--out"],
    ["experiment", "ablation", "nowhere", "--out"],
    ["experiment", "payload", "nowhere", "--out"],
    ["experiment", "unit", "nowhere", "--out"],
    ["experiment", "data", "nowhere", "--out"],
    ["experiment", "tracking", "nowhere", "--out"],
    ["experiment", "delivery", "nowhere", "--out"],
    ["run", "--motion", "wave", "--out"],
    ["record", "--motion", "wave", "--payload-mass", "0", "--out"],
    ["demo", "--out"],
]


@pytest.mark.parametrize("command", COMMANDS, ids=" ".join)
def test_a_folder_with_a_dot_file_in_it_is_refused_before_any_work(command, tmp_path, capsys):
    (tmp_path / ".env").write_text("mine")
    assert main([*command, str(tmp_path)]) == 2
    assert f"Folder: {tmp_path}: holds .env, so it is no " in capsys.readouterr().err
    assert [f.name for f in tmp_path.iterdir()] == [".env"]


def test_another_commands_folder_is_refused(tmp_path, capsys):
    with writing(tmp_path / "a", "comparison"):
        (tmp_path / "a" / "compare.json").touch()
    assert main(["train", "nowhere", "--out", str(tmp_path / "a")]) == 2
    assert "holds gaponet's comparison, not run; choose another folder" in capsys.readouterr().err


def test_a_disk_that_cannot_be_written_is_one_line(tmp_path, capsys, monkeypatch):
    def read_only(path, *_):
        raise OSError(errno.EROFS, "Read-only file system", str(path))

    monkeypatch.setattr(os, "mkdir", read_only)
    assert main(["train", "nowhere", "--out", str(tmp_path / "a")]) == 2
    assert capsys.readouterr().err == f"File: {tmp_path / 'a'}: Read-only file system\n"
