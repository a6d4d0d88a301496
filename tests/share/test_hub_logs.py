"""Logs of the Hub by their address; the Hub is a stand-in on this machine."""

import pytest

from gaponet.base.progress import no_progress
from gaponet.cli.main import main
from gaponet.data.store import Dataset
from gaponet.data.writers import export
from gaponet.share.hub_logs import logs_folder

VIDEO = "videos/front/chunk-000/file-000.mp4"


@pytest.fixture
def uploaded(hub, dataset, tmp_path):
    """A LeRobot set with a video on the Hub, of the dataset's first rate."""
    written = export(dataset, tmp_path / "sets", no_progress)[0].path
    files = {VIDEO: b"not a log"}
    for file in written.rglob("*"):
        if file.is_file():
            files[file.relative_to(written).as_posix()] = file.read_bytes()
    hub.commit("datasets/me/set", files)
    return files


def test_a_set_of_the_hub_is_imported_by_its_address(uploaded, arm, tmp_path):
    out = tmp_path / "imported"
    command = ["import", "hf://me/set", "--robot", str(arm.folder), "--out", str(out)]
    assert main(command) == 0
    assert {entry.meta.motion for entry in Dataset(out).entries} >= {"wave 0", "wave 3"}


def test_videos_stay_on_the_hub(uploaded):
    folder = logs_folder("hf://datasets/me/set@main")
    assert (folder / "meta" / "info.json").is_file()
    assert not (folder / VIDEO).exists()


def test_an_address_that_is_not_there_is_one_clear_line(hub, arm, tmp_path, capsys):
    command = ["import", "hf://me/nobody", "--robot", str(arm.folder)]
    assert main([*command, "--out", str(tmp_path / "out")]) == 2
    said = capsys.readouterr().err
    assert "hf://me/nobody" in said
    assert "Traceback" not in said
