"""Commands of the page: what a stranger's folder may say, and how a command ends."""

import json
import os
import signal
import subprocess
import sys
import time

import pytest
from arm import recordings, write_arm

from gaponet.base.errors import UsageError
from gaponet.base.files import lock_file
from gaponet.data.store import Dataset
from gaponet.report.steps import make_robot, use_robot
from gaponet.report.view.app import App, make_places
from gaponet.report.view.job_text import ending, picture, report
from gaponet.report.view.jobs import Jobs

HURT = '<img src=x onerror="alert(1)">'


def store(folder, number, step, words, result="{}", log=""):
    """The files of a job, as somebody may have written them."""
    job = folder / "jobs" / f"{number:03d}-{step}"
    job.mkdir(parents=True)
    (job / "command.json").write_text(json.dumps(words))
    (job / "result.json").write_text(result)
    (job / "log.txt").write_text(log)
    return job


@pytest.mark.parametrize(
    "figure",
    [
        "/etc/hostname",
        "../secret.png",
        "a/../../b.svg",
        "C:\\x.png",
        "..\\x.png",
        "",
        "x.txt",
        "a\n.png",
    ],
)
def test_a_result_that_names_a_file_outside_is_no_result(tmp_path, figure):
    store(tmp_path, 1, "doctor", ["doctor", "./x"], json.dumps({"figures": [figure]}))
    (job,) = Jobs(tmp_path).all
    assert job.result is None
    assert "jobs/001-doctor/result.json" in Jobs(tmp_path).unreadable()[0]


@pytest.mark.parametrize(
    "result",
    [
        "[1]",
        '"x"',
        "{",
        '{"findings": [{"level": 3}]}',
        '{"findings": {}}',
        '{"val_mpjae": {"added": "x"}}',
    ],
)
def test_a_result_of_another_shape_is_no_result(tmp_path, result):
    store(tmp_path, 1, "doctor", ["doctor", "./x"], result)
    assert Jobs(tmp_path).all[0].result is None
    assert len(Jobs(tmp_path).unreadable()) == 1


@pytest.mark.parametrize(
    "words",
    [
        ["import", "logs", "--out", "/home/somebody/data"],
        ["import", "logs", "--out", "../data"],
        ["import", "logs", "--out", "link"],
        ["robot", "check", "--help"],
        ["robot", "check", "/home/somebody/robot"],
        ["robot", "check", "../robot"],
        [],
        {"robot": 1},
        ["robot", 3],
    ],
)
def test_a_job_that_uses_another_folder_is_left_out_with_the_reason(tmp_path, words):
    folder = tmp_path / "work"
    (folder / "link").parent.mkdir()
    (folder / "link").symlink_to(tmp_path)
    store(folder, 1, "import", words)
    jobs = Jobs(folder)
    assert jobs.all == []
    assert "jobs/001-import" in jobs.unreadable()[0]


def test_a_folder_outside_may_be_used_if_the_user_names_it(tmp_path):
    folder = tmp_path / "work"
    robot = tmp_path / "robot"
    store(folder, 1, "robot", ["robot", "check", str(robot)])
    assert f"--outside {robot}" in Jobs(folder).unreadable()[0]
    assert Jobs(folder, (robot,)).result("robot").out == str(robot)


def test_a_new_job_writes_into_no_folder_that_is_there(tmp_path):
    folder = tmp_path / "work"
    outside = tmp_path / "outside"
    (folder / "jobs").mkdir(parents=True)
    outside.mkdir()
    (folder / "jobs" / "001-robot").symlink_to(outside)
    (folder / "robot2").mkdir()
    job = Jobs(folder).add(make_robot("x", "\0"))
    assert job.words[-1] == "robot3"
    assert list(outside.iterdir()) == []


def test_a_folder_of_the_page_that_is_a_link_is_refused(tmp_path):
    folder = tmp_path / "work"
    folder.mkdir()
    (folder / "logs").symlink_to(tmp_path)
    with pytest.raises(UsageError, match="link"):
        make_places(folder)


def test_a_picture_that_is_a_link_out_of_the_folder_is_not_shown(tmp_path):
    folder = tmp_path / "work"
    folder.mkdir()
    (tmp_path / "secret.svg").write_text("secret")
    (folder / "x.svg").symlink_to(tmp_path / "secret.svg")
    assert "data:" not in picture(folder, "x.svg")
    assert "a link leads out" in picture(folder, "x.svg")


def test_the_name_of_a_picture_ends_no_attribute(tmp_path):
    name = f'a"{HURT}.svg'.replace("/", "")
    (tmp_path / name).write_text("<svg/>")
    shown = picture(tmp_path, name)
    assert shown.count("<") == 3  # img, a, /a
    assert "&quot;&lt;img" in shown


def test_what_a_job_says_of_itself_stays_text(tmp_path):
    store(tmp_path, 1, "gap", [f"gap{HURT}", "x"], result="", log=f"Usage: {HURT}\n")
    (job,) = Jobs(tmp_path).all
    assert "<img" not in ending(job).replace(r"\<img", "")
    assert "<img" not in report(job).replace(r"\<img", "")


def test_a_finding_of_a_stranger_stays_text_in_the_page(tmp_path):
    pytest.importorskip("viser")
    finding = {"level": "error", "check": HURT, "message": HURT}
    store(tmp_path, 1, "robot", ["robot", "check", "so101"])
    store(tmp_path, 2, "import", ["import", "logs", "--out", "import2"])
    (tmp_path / "import2").mkdir()
    store(tmp_path, 3, "doctor", ["doctor", "./import2"], json.dumps({"findings": [finding]}))
    page = App(tmp_path, 0)
    try:
        text = page.controls.places["identify"].text.content
        assert "finds an error" in text
        assert "<img" not in text.replace(r"\<img", "")
    finally:
        page.server.stop()


def test_a_stored_command_is_never_run_again(tmp_path, monkeypatch):
    pytest.importorskip("viser")
    started = []
    monkeypatch.setattr(Jobs, "start", lambda self, *words: started.append(words))
    store(tmp_path, 1, "robot", ["robot", "check", "so101"])
    for number, step in ((2, "import"), (3, "identify")):
        store(tmp_path, number, step, [step, "x", "--out", f"{step}{number}"])
    arm = write_arm(tmp_path / "arm")
    Dataset.create(tmp_path / "import2", arm).append(recordings(arm, 1, rows=60)[0])
    (tmp_path / "identify3").mkdir()
    page = App(tmp_path, 0)
    try:
        assert page.jobs.result("identify").number == 3
        page.seen = None
        page.refresh()
        assert started == []
    finally:
        page.server.stop()


# A server of the page whose command starts a program and waits, as identify does with its workers.
SERVER = """
import sys, threading
from pathlib import Path
from types import SimpleNamespace
from gaponet.report.steps import measure_error
from gaponet.report.view import app, jobs

COMMAND = '''
import subprocess, sys, time
from pathlib import Path
from gaponet.report.view.run_job import run

def wait():
    child = subprocess.Popen([sys.executable, "-c", "import time; time.sleep(600)"])
    print(child.pid, flush=True)
    time.sleep(600)

run(Path(sys.argv[1]), wait)
'''
jobs.module_command = lambda module, folder, *words: [sys.executable, "-c", COMMAND, folder]
running = jobs.Jobs(Path(sys.argv[1]))
running.start(measure_error("data"))
print(running.process.pid, flush=True)
server = SimpleNamespace(stop=lambda: None)
app.serve(SimpleNamespace(address="", server=server, tick=lambda _: None, jobs=running), print)
"""


def lives(process):
    """True for a process that is neither ended nor a zombie."""
    try:
        with open(f"/proc/{process}/stat") as file:
            return file.read().rpartition(")")[2].split()[0] != "Z"
    except FileNotFoundError:
        return False


def first_line(path):
    end = time.monotonic() + 60
    while not path.exists() or not path.read_text().endswith("\n"):
        assert time.monotonic() < end
        time.sleep(0.05)
    return path.read_text()


def wait_until_ended(*processes):
    end = time.monotonic() + 30
    while any(lives(process) for process in processes):
        assert time.monotonic() < end, "still there"
        time.sleep(0.05)


def obey_signals():
    """Undo what nohup and background jobs of a shell do: programs that they start ignore these
    signals.
    """
    signal.signal(signal.SIGHUP, signal.SIG_DFL)
    signal.signal(signal.SIGINT, signal.default_int_handler)


@pytest.fixture
def serving(tmp_path):
    """A server of the page, its command and what the command started: (process, process number,
    process number).
    """
    server = subprocess.Popen(
        [sys.executable, "-c", SERVER, str(tmp_path)],
        stdout=subprocess.PIPE,
        text=True,
        preexec_fn=obey_signals,
    )
    command = int(server.stdout.readline())
    grandchild = int(first_line(tmp_path / "jobs" / "001-gap" / "result.json"))
    yield server, command, grandchild
    server.kill()
    server.wait()


@pytest.mark.skipif(sys.platform != "linux", reason="reads /proc")
@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGHUP, signal.SIGTERM, signal.SIGINT])
def test_a_command_and_its_children_end_with_the_server_of_the_page(tmp_path, serving, number):
    server, command, grandchild = serving
    assert "open" in server.stdout.readline()  # it handles signals from here on
    assert lives(command)
    assert lives(grandchild)
    server.send_signal(number)
    wait_until_ended(server.pid, command, grandchild)
    (job,) = Jobs(tmp_path).all
    assert not job.lives
    assert "it ended with the server of the page" in ending(job)


@pytest.mark.skipif(sys.platform != "linux", reason="reads /proc")
def test_a_command_that_is_killed_is_not_called_cancelled(tmp_path, serving):
    _, command, grandchild = serving
    os.kill(command, signal.SIGKILL)
    os.kill(grandchild, signal.SIGKILL)
    wait_until_ended(command)
    (tmp_path / "jobs" / "001-gap" / "result.json").write_text("")
    assert "it was killed" in ending(Jobs(tmp_path).all[0])


def test_while_a_command_of_an_earlier_page_lives_no_other_starts(tmp_path):
    job = store(tmp_path, 1, "gap", ["gap", "./x"], result="")
    descriptor = lock_file(job / "lock")
    jobs = Jobs(tmp_path)
    try:
        with pytest.raises(UsageError, match="earlier"):
            jobs.start(use_robot("so101"))
    finally:
        os.close(descriptor)
    assert jobs.running_elsewhere is None
    jobs.require_idle()


def test_a_command_without_a_result_says_why(tmp_path):
    job = store(
        tmp_path, 1, "gap", ["gap", "./x"], result="", log="gap: 50 %, 3 s\nUsage: no data\n"
    )
    assert "Usage: no data" in ending(Jobs(tmp_path).all[0])
    (job / "log.txt").write_text("")
    for how, why in (("cancelled", "was cancelled"), ("exit", "exit code 3"), ("server", "server")):
        (job / "ended.json").write_text(json.dumps({"how": how, "code": 3}))
        assert why in ending(Jobs(tmp_path).all[0])
    (job / "ended.json").write_text('{"how": "<b>", "code": 3}')
    assert "it was killed" in ending(Jobs(tmp_path).all[0])
