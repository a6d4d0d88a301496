"""Every command with a folder of the user's to write into looks at it first."""

import errno
import os
import shutil
import subprocess
import sys

import pytest
from logs import arm_sequence, late, wave

from gaponet.base.files import lock_folder
from gaponet.cli.main import main
from gaponet.data.store import Dataset

COMMANDS = [
    ["import", "nowhere", "--robot", "so101", "--out"],
    ["collect", "--robot", "so101", "--recipe", "arm", "--out"],
    ["train", "nowhere", "--out"],
    ["identify", "nowhere", "--out"],
    ["experiment", "paper", "nowhere", "--out"],
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
    with lock_folder(tmp_path / "a", "comparison"):
        (tmp_path / "a" / "compare.json").touch()
    assert main(["train", "nowhere", "--out", str(tmp_path / "a")]) == 2
    assert "holds gaponet's comparison, not run; choose another folder" in capsys.readouterr().err


def test_a_disk_that_cannot_be_written_is_one_line(tmp_path, capsys, monkeypatch):
    def read_only(path, *_):
        raise OSError(errno.EROFS, "Read-only file system", str(path))

    monkeypatch.setattr(os, "mkdir", read_only)
    assert main(["train", "nowhere", "--out", str(tmp_path / "a")]) == 2
    assert capsys.readouterr().err == f"File: {tmp_path / 'a'}: Read-only file system\n"


ALL = """
import sys
from gaponet.cli.main import main
(path,) = sys.argv[1:]
sys.exit(main(["gap", path]) or main(["data", "card", path]))
"""


@pytest.mark.skipif(os.name == "nt", reason="folders there have no such permissions")
def test_a_dataset_that_may_only_be_read_has_a_gap_and_a_card(arm, tmp_path):
    data = Dataset.create(tmp_path / "disk" / "set", arm)
    ctrl = wave(60, 2)
    data.append(arm_sequence(arm, ctrl, late(ctrl, 2), "wave", 0.0))
    disk = tmp_path / "disk"
    words = [sys.executable, "-c", ALL, f"{tmp_path}/disk/set"]
    folders = [p for p in (disk, *disk.rglob("*")) if p.is_dir()]
    for folder in folders:
        folder.chmod(0o555)
    if os.geteuid() == 0:  # to whom every folder is open: a disk that is mounted to be read
        mounted = f"mount --bind {disk} {disk} && mount -o remount,ro,bind {disk} && exec"
        words = ["unshare", "-m", "sh", "-c", f'{mounted} "$@"', "-", *words]
        if (
            not shutil.which("unshare")
            or subprocess.run([*words[:-2], "pass"], capture_output=True).returncode
        ):
            pytest.skip("root here may not mount")
    before = sorted(disk.rglob("*"))
    done = subprocess.run(words, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert sorted(disk.rglob("*")) == before
    for folder in folders:
        folder.chmod(0o755)
