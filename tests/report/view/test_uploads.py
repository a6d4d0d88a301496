"""Files that a browser sends to the page, without a browser."""

import io
import threading
import zipfile
from types import SimpleNamespace

import pytest

from gaponet.base.errors import UsageError
from gaponet.report.steps import use_robot
from gaponet.report.view import uploads
from gaponet.report.view.jobs import Jobs
from gaponet.report.view.uploads import Uploads, connect_upload_button, move_files


def archive(**files):
    content = io.BytesIO()
    with zipfile.ZipFile(content, "w") as made:
        for name, text in files.items():
            made.writestr(name, text)
    return content.getvalue()


def broken_archive(compression=zipfile.ZIP_DEFLATED):
    """A .zip of two files; the second one is damaged."""
    packed = io.BytesIO()
    with zipfile.ZipFile(packed, "w", compression) as made:
        for name in "ab":
            made.writestr(f"{name}.csv", "".join(f"{k * k}\n" for k in range(3000)))
        middle = made.infolist()[1].header_offset + 200
    content = bytearray(packed.getvalue())
    content[middle : middle + 99] = b"\xff" * 99
    return bytes(content)


def contents(folder):
    return {
        path.relative_to(folder).as_posix(): path.read_text()
        for path in folder.rglob("*")
        if path.is_file()
    }


@pytest.fixture
def box(tmp_path):
    """Uploads of a page's folder; `shown` is what the page says."""
    folder = tmp_path / "work"
    (folder / "logs").mkdir(parents=True)
    made = Uploads(folder, Jobs(folder), lambda text, dismissible: shown.update(text=text))
    made.shown = shown = {"text": ""}
    made.logs = folder / "logs"
    return made


@pytest.mark.parametrize(
    "name", ["../out.csv", "/tmp/out.csv", "a/../../out.csv", "..\\out.csv", "C:out.csv"]
)
def test_no_name_of_an_upload_leads_out_of_the_folder(box, name):
    box.receive(name, b"x", "logs")
    assert contents(box.logs) == {"out.csv": "x"}
    (box.logs / "out.csv").unlink()
    box.receive("evil.zip", archive(**{name: "x"}), "logs")
    assert list(contents(box.logs).values()) == ["x"]
    assert {path.name for path in box.folder.iterdir()} == {"logs", "incoming"}


def test_the_files_of_a_zip_keep_their_folders(box):
    box.receive("a.zip", archive(**{"walk/state.csv": "1", "b.csv": "2"}), "logs")
    assert contents(box.logs) == {"walk/state.csv": "1", "b.csv": "2"}
    assert "a.zip is stored in logs" in box.shown["text"]


@pytest.mark.parametrize(
    ("content", "why"),
    [
        (b"no archive", "broken"),
        (broken_archive(), "broken"),
        (broken_archive(zipfile.ZIP_BZIP2), "Invalid data stream"),
        (archive(**{"a": "x", "a/b.csv": "y"}), "broken"),
        (archive(**{"../a.csv": "x", "a.csv": "y"}), "two files of one name"),
        (archive(), "holds no file"),
    ],
)
def test_a_broken_zip_is_named_and_nothing_of_it_is_stored(box, content, why):
    box.receive("walks.zip", content, "logs")
    assert "Not stored: walks.zip" in box.shown["text"]
    assert why in box.shown["text"]
    assert contents(box.logs) == {}
    assert not (box.folder / "incoming").exists()


@pytest.mark.parametrize(
    ("stored", "why"),
    [
        ("walk", "is a file where the upload has a folder"),
        ("z.csv", "exists"),
    ],
)
def test_a_zip_that_meets_something_in_its_way_stores_none_of_its_files(box, stored, why):
    (box.logs / stored).write_text("mine")
    files = {"a.csv": "1", "b.csv": "2", "walk/state.csv": "3", "z.csv": "4"}
    box.receive("x.zip", archive(**files), "logs")
    assert contents(box.logs) == {stored: "mine"}
    assert why in box.shown["text"]


def test_an_upload_goes_through_no_link(box, tmp_path):
    outside = tmp_path / "outside"
    outside.mkdir()
    (box.logs / "link").symlink_to(outside)
    (box.logs / "nothing.csv").symlink_to(outside / "nothing.csv")
    box.receive("x.zip", archive(**{"a.csv": "x", "link/b.csv": "x"}), "logs")
    box.receive("nothing.csv", b"x", "logs")
    assert list(outside.iterdir()) == []
    assert {path.name for path in box.logs.iterdir()} == {"link", "nothing.csv"}


def test_files_are_moved_back_when_one_cannot_be_moved(box, tmp_path, monkeypatch):
    source = tmp_path / "source"
    (source / "walk").mkdir(parents=True)
    for name in ("a.csv", "walk/b.csv", "z.csv"):
        (source / name).write_text(name)
    move = uploads.shutil.move

    def full(what, where):
        if where.name == "z.csv" and where.is_relative_to(box.logs):
            raise OSError(28, "No space left on device")
        return move(what, where)

    monkeypatch.setattr(uploads.shutil, "move", full)
    with pytest.raises(OSError, match="space"):
        move_files(source, box.logs)
    assert list(box.logs.iterdir()) == []
    assert len(contents(source)) == 3


def test_an_upload_waits_for_the_running_command_and_is_then_stored(box):
    running = SimpleNamespace(poll=lambda: None)
    box.jobs.started = box.jobs.add(use_robot("so101"))
    box.jobs.process = running
    box.receive("walk.csv", b"1", "logs")
    assert contents(box.logs) == {}
    assert "wait until the command has ended: walk.csv" in box.shown["text"]
    box.receive("bad.zip", b"1", "logs")  # this can be said at once
    assert "Not stored: bad.zip" in box.shown["text"]
    box.jobs.process = None
    box.place_waiting()
    assert contents(box.logs) == {"walk.csv": "1"}
    assert "wait" not in box.shown["text"]


def test_the_reason_of_a_refused_upload_stays_until_it_is_dismissed(box):
    box.receive("bad.zip", b"1", "logs")
    for number in range(100):
        box.receive(f"{number}.csv", b"1", "logs")
    assert "Not stored: bad.zip" in box.shown["text"]
    box.notices.dismiss()
    assert box.shown["text"] == ""


def test_what_a_killed_server_had_not_moved_yet_the_next_one_moves(box):
    (box.folder / "incoming" / "logs-7" / "walk").mkdir(parents=True)
    (box.folder / "incoming" / "logs-7" / "walk" / "b.csv").write_text("2")
    (box.logs / "walk").mkdir()
    (box.logs / "walk" / "a.csv").write_text("1")
    box.place_waiting()
    assert contents(box.logs) == {"walk/a.csv": "1", "walk/b.csv": "2"}
    assert list((box.folder / "incoming").iterdir()) == []


def test_of_two_uploads_of_one_name_at_once_one_is_stored(box):
    threads = [
        threading.Thread(target=box.receive, args=("a.csv", text, "logs")) for text in (b"1", b"2")
    ]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert list(contents(box.logs)) == ["a.csv"]
    assert "exists" in box.shown["text"]
    assert list((box.folder / "incoming").iterdir()) == []


def test_names_of_uploads_stay_text(box):
    box.receive("<img src=x onerror=alert(1)>.csv", b"1", "logs")
    assert r"\<img src=x onerror=alert(1)\>.csv is stored" in box.shown["text"]


def test_a_file_is_taken_when_it_arrives_although_the_callback_runs_later():
    """viser's own order: the value is replaced, then all callbacks are submitted to threads."""
    pytest.importorskip("viser")
    from gaponet.report.view.server import open_server

    server, _ = open_server("test", 0)
    received = []
    try:
        button = server.gui.add_upload_button("upload")
        connect_upload_button(button, lambda name, content: received.append((name, content)))
        submitted = []
        for name in ("a.csv", "b.csv"):
            button._impl.value = SimpleNamespace(name=name, content=name.encode())
            submitted += list(button._impl.update_cb)
        for callback in submitted:
            callback(None)
    finally:
        server.stop()
    assert received == [("a.csv", b"a.csv"), ("b.csv", b"b.csv")]


def test_a_viser_that_keeps_callbacks_elsewhere_is_refused():
    with pytest.raises(UsageError, match="uploads"):
        connect_upload_button(SimpleNamespace(), lambda name, content: None)


def test_a_large_file_is_stored_whole(box):
    box.receive("large.csv", bytes(200 << 20), "logs")
    assert (box.logs / "large.csv").stat().st_size == 200 << 20
