"""The page of gaponet app without a browser: files, commands and what it shows."""

import json
import threading
import time
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from arm import recordings, write_arm

from gaponet.base.errors import UsageError
from gaponet.data.store import Dataset
from gaponet.report.steps import Step, make_robot, steps_from_logs
from gaponet.report.view import app
from gaponet.report.view.app import App
from gaponet.report.view.controls import Controls
from gaponet.report.view.job_text import ending, report
from gaponet.report.view.jobs import OUT, Jobs
from gaponet.report.view.player import draw_curves
from gaponet.report.view.scene import Scene
from gaponet.report.view.side_by_side import Clip, side_by_side
from gaponet.report.view.tabs import TARGETS, helping_network

LIST = Step("robot", ("robot", "list"))


def finish(jobs, step, result, words=("x",)):
    """A command that has ended."""
    folder = jobs.folder / "jobs" / f"{len(jobs.all) + 1:03d}-{step}"
    folder.mkdir(parents=True)
    (folder / "command.json").write_text(json.dumps(list(words)))
    (folder / "result.json").write_text("" if result is None else json.dumps(result))
    (folder / "log.txt").write_text("")


def wait_for(jobs):
    end = time.monotonic() + 120
    while jobs.running:
        assert time.monotonic() < end
        time.sleep(0.05)


def test_a_result_is_out_of_date_when_what_it_was_made_from_is_newer(tmp_path):
    jobs = Jobs(tmp_path)
    for step in ("robot", "import", "doctor", "identify"):
        finish(jobs, step, {"step": step})
    finish(jobs, "import", None)  # failed: the one before counts
    assert jobs.result("identify").result == {"step": "identify"}
    finish(jobs, "import", {"step": "import"})
    assert jobs.result("import").number == 6
    assert jobs.result("doctor") is None
    assert jobs.result("identify") is None
    assert jobs.result("robot").number == 1
    assert Jobs(tmp_path).result("import").number == 6  # another page, another day


def test_one_command_at_a_time_and_cancelling_leaves_what_was_there(tmp_path):
    jobs = Jobs(tmp_path)
    jobs.start(LIST)
    with pytest.raises(UsageError, match="running"):
        jobs.start(LIST)
    wait_for(jobs)
    assert "so101" in [robot["name"] for robot in jobs.result("robot").result["robots"]]
    assert jobs.result("robot").command == "gaponet robot list"
    jobs.start(make_robot("missing.xml", OUT))
    assert jobs.running.words[-2:] == ["--out", "robot2"]
    jobs.cancel()
    assert jobs.running is None
    assert jobs.all[-1].result is None
    assert jobs.result("robot").number == 1


def test_of_two_clicks_at_once_one_starts_a_command(tmp_path):
    jobs = Jobs(tmp_path)
    refused = []

    def click():
        try:
            jobs.start(LIST)
        except UsageError as error:
            refused.append(error)

    clicks = [threading.Thread(target=click) for _ in range(4)]
    for thread in clicks:
        thread.start()
    for thread in clicks:
        thread.join()
    jobs.cancel()
    assert len(refused) == 3
    assert len(jobs.all) == 1


def test_a_page_opens_after_its_import_was_deleted_and_shows_all_after_an_error(tmp_path):
    pytest.importorskip("viser")
    finish(jobs := Jobs(tmp_path), "import", {}, ("import", "logs", "--out", "import1"))
    finish(jobs, "notes", {})
    (tmp_path / "jobs" / "002-notes").rename(tmp_path / "jobs" / "notes-x")
    finish(jobs, "identify", {}, ("identify", "import1", "--out", "identify2"))
    assert jobs.result("import") is None
    page = App(tmp_path, 0)
    try:
        assert "Not done" not in page.controls.status.content
        (tmp_path / "import1").mkdir()  # no dataset
        finish(jobs, "robot", {}, ("robot", "check", "so101"))
        finish(jobs, "import", {}, ("import", "logs", "--out", "import4"))
        (tmp_path / "import4").mkdir()
        for _ in range(2):
            page.controls.status.content = ""
            page.tick(1.0)
            assert "Not done" in page.controls.status.content
        (tmp_path / "import4").rmdir()
        page.tick(1.0)
        assert "has ended" in page.controls.status.content
        page.player.advance = {}.pop
        page.tick(0.1)
        assert "Unexpected KeyError" in page.controls.status.content
    finally:
        page.server.stop()


@pytest.fixture
def page(tmp_path):
    pytest.importorskip("viser")
    opened = App(tmp_path, 0)
    yield opened
    if opened.jobs.running:
        opened.jobs.cancel()
    opened.server.stop()


def test_nothing_starts_before_what_it_needs_and_the_page_says_what(page):
    for act, hint in (
        (page.tabs.logs.read, "Choose a robot"),
        (page.tabs.gap.show_recording, "Choose a robot"),
        (page.tabs.identify.identify, "Choose a robot"),
    ):
        page.controls.attempt(act)
        assert hint in page.controls.status.content
    assert page.tabs.identify.button.disabled
    assert page.jobs.all == []


def test_a_hint_names_the_next_thing_to_do(page):
    hint = page.controls.places["identify"].text
    for step, said in (
        ("robot", "Read the logs"),
        ("import", "Check the recordings"),
        ("doctor", "Identify the robot"),
    ):
        finish(page.jobs, step, {}, ("robot", "check", "so101"))
        page.tabs.identify.show()
        assert said in hint.content


def test_beside_a_running_command_no_earlier_one_is_said_to_have_ended(page, monkeypatch):
    finish(page.jobs, "gap", {}, ("gap", "data"))
    page.refresh()
    assert "gaponet gap** has ended" in page.controls.status.content
    seen = []
    monkeypatch.setattr(page.tabs.gap, "show", lambda: seen.append(page.controls.status.content))
    page.jobs.start(LIST)
    page.refresh()
    page.jobs.cancel()
    assert seen == [""]


@pytest.mark.parametrize(("model", "offered"), [("model/arm.urdf", True), ("model/arm.xml", False)])
def test_a_urdf_is_exported_where_the_robot_was_made_from_one(page, model, offered):
    finish(page.jobs, "robot", {}, ("robot", "new", model, "--out", "robot1"))
    (page.controls.folder / "robot1").mkdir()
    page.tabs.use.show()
    assert ("urdf" in page.tabs.use.target.options) == offered


def test_the_next_step_is_offered_once_a_step_is_done(page):
    assert page.tabs.onwards["robot"].disabled
    finish(page.jobs, "robot", {}, ("robot", "check", "so101"))
    page.refresh()
    assert not page.tabs.onwards["robot"].disabled
    assert page.tabs.onwards["import"].disabled


def test_an_identification_is_bounded_in_rollouts_and_tries_all_terms(page):
    for step in ("robot", "import"):
        finish(page.jobs, step, {}, ("robot", "check", "so101"))
    finish(page.jobs, "doctor", {"findings": []})
    page.tabs.identify.windows.value = 12
    assert page.tabs.identify.identify().words[4:] == ("--windows", "12")


def test_identification_is_locked_while_the_check_finds_an_error(page):
    for step in ("robot", "import"):
        finish(page.jobs, step, {}, ("robot", "check", "so101"))
    finding = {"level": "error", "check": "sign", "message": "elbow moves against its command"}
    finish(page.jobs, "doctor", {"findings": [finding]})
    assert "Locked: the check finds an error (sign)" in page.tabs.identify.locked()
    page.controls.attempt(page.tabs.identify.identify)
    assert "Locked" in page.controls.status.content
    finish(page.jobs, "doctor", {"findings": [finding | {"level": "warning"}]})
    assert page.tabs.identify.locked() == ""


def test_what_a_command_prints_is_shown_as_a_table_and_names_stay_text(page):
    job = SimpleNamespace(
        command="gaponet gap data",
        lines=[
            "training auto: 50 %, 3 s, note",
            "By joint",
            "┏━━┳━━┓",
            "┃ joint ┃ MPJAE, mrad ┃",
            "┡━━╇━━┩",
            "│ <b>x</b> │ 3.1 │",
            "└──┴──┘",
            "     ok  sign: fine",
            "![x](https://evil.example)",
        ],
    )
    text = report(job)
    assert "| joint | MPJAE, mrad |\n| --- | ---: |\n| \\<b\\>x\\</b\\> | 3.1 |" in text
    assert r"!\[x\](https://evil.example)" in text
    assert "note" not in text
    assert "sign" not in text
    assert text.endswith(": gaponet gap data")


def test_a_wide_table_is_divided_and_each_part_has_the_first_column(page):
    names = ["joint", *(f"number {i}" for i in range(9))]
    values = ["elbow", *(f"{i}.0 ± 0.1" for i in range(9))]
    lines = ["┏━━┓", f"┃ {' ┃ '.join(names)} ┃", "┡━━┩", f"│ {' │ '.join(values)} │", "└──┘"]
    text = report(SimpleNamespace(command="gaponet identify data", lines=lines))
    shown = [line for line in text.splitlines() if line.startswith("| elbow")]
    assert max(map(len, shown)) <= 80
    found = [cell.strip() for line in shown for cell in line.strip("|").split("|")]
    assert [cell for cell in found if cell != "elbow"] == values[1:]


def test_a_heading_in_two_lines_stays_whole():
    lines = ["┏━━┳━━┓", "┃       ┃   kp, ┃", "┃ joint ┃ N·m/rad ┃", "┡━━╇━━┩", "│ x │ 3 │", "└──┘"]
    text = report(SimpleNamespace(command="gaponet identify data", lines=lines))
    assert "| joint | kp, N·m/rad |" in text


def test_tables_without_a_title_between_them_are_two():
    table = ["┏━━┳━━┓", "┃ a ┃ b ┃", "┡━━╇━━┩", "│ x │ 3 │", "└──┴──┘"]
    text = report(SimpleNamespace(command="gaponet gap data", lines=[*table, *table]))
    assert text.count("| a | b |") == 2
    assert "┏" not in text


def test_a_box_that_is_no_table_keeps_its_words():
    lines = ["╭──╮", "│ the robot is warm │", "╰──╯"]
    text = report(SimpleNamespace(command="gaponet gap data", lines=lines))
    assert "the robot is warm" in text


def test_a_name_in_the_form_is_no_option_of_the_command(page):
    finish(page.jobs, "robot", {}, ("robot", "check", "so101"))
    (page.controls.folder / "logs" / "logs.toml").write_text("mine")
    page.tabs.logs.unit.value = "--allow-pickle"
    page.tabs.logs.cut.value = 8.0
    page.jobs.start(page.tabs.logs.read())
    words = page.jobs.all[-1].words
    assert "--unit-id=--allow-pickle" in words
    assert "--cut 8" in " ".join(words)
    page.controls.attempt(page.tabs.logs.set_aside)
    assert "is running" in page.controls.status.content
    page.jobs.cancel()
    assert (page.controls.folder / "logs" / "logs.toml").read_text() == "mine"
    (page.controls.folder / "logs_aside2").mkdir()
    page.tabs.logs.set_aside()
    assert (page.controls.folder / "logs_aside1" / "logs.toml").read_text() == "mine"
    assert list((page.controls.folder / "logs").iterdir()) == []
    (page.controls.folder / "model" / "arm.xml").write_text("<mujoco/>")
    page.refresh()
    page.tabs.robot.model.value = "model/arm.xml"
    page.tabs.robot.options["kp"].value = "--contacts"
    page.controls.attempt(page.tabs.robot.use)
    assert "without a dash" in page.controls.status.content


def test_a_command_that_is_being_started_is_not_called_cancelled(page):
    with page.jobs.lock:
        page.jobs.add(LIST)
        watching = threading.Thread(target=page.refresh)
        watching.start()
        watching.join(0.3)
        assert "no result" not in page.controls.status.content
        page.jobs.started = page.jobs.all[-1]
        page.jobs.process = SimpleNamespace(poll=lambda: None)
    watching.join()
    page.jobs.process = None
    assert "**gaponet robot**, 0 %" in page.running.text.content


def test_a_guess_does_not_replace_the_logs_toml_of_the_folder(page):
    (page.controls.folder / "logs" / "logs.toml").write_text('unit = "deg"\n')
    page.controls.attempt(page.tabs.logs.guess)
    assert "a guess would replace it" in page.controls.status.content
    assert not page.tabs.logs.described.value


def test_a_proposal_is_added_to_the_logs_toml_of_the_folder(page):
    for step in ("robot", "import"):
        finish(page.jobs, step, {}, ("robot", "check", "so101"))
    finish(page.jobs, "doctor", {"findings": []})
    (page.controls.folder / "logs" / "logs.toml").write_text('unit = "deg"\n')
    page.controls.attempt(page.tabs.check.propose)
    assert page.tabs.logs.described.value.startswith('unit = "deg"\n')
    assert "nothing to mend" in page.tabs.logs.described.value


@pytest.fixture
def clicked(monkeypatch):
    """Buttons of the next page by label, and the commands that they start."""
    acts = {}
    words = []
    add = Controls.add_button

    def noted(self, label, act):
        acts[label] = act
        return add(self, label, act)

    monkeypatch.setattr(Controls, "add_button", noted)
    monkeypatch.setattr(Jobs, "start", lambda self, step: words.append(step.words))
    return acts, words


def test_the_page_has_a_button_for_each_step_of_start_from_logs_to_export(clicked, page):
    acts, _ = clicked
    steps = steps_from_logs(Path("logs"), "so101", {}, Path("out"), {}, "mjcf")
    elsewhere = ("causes", "report")  # the page measures causes after each identification
    assert {s.title for s in steps if s.name not in elsewhere} <= acts.keys()


def test_step_use_exports_the_calibrated_robot_and_a_network_only_if_it_helps(clicked, page):
    acts, words = clicked
    for step in ("robot", "import", "identify", "new", "adapt"):
        finish(page.jobs, step, {}, (step, "x", "y", "--out", step))
        (page.controls.folder / step).mkdir(exist_ok=True)
        if step == "identify":
            acts["Export"]()
            finish(page.jobs, "train", {"val_mpjae": {"added": 1e-4, "error": 2e-4, "start": 0.01}})
            page.seen = ()
            page.controls.attempt(page.refresh)
            assert page.tabs.use.target.options == TARGETS
            finish(page.jobs, "train", {"val_mpjae": {"added": 2e-3, "error": 2e-4, "start": 0.01}})
        if step == "new":
            acts["Check whether the robot changed"]()
            acts["Calibrate with the new logs"]()
    page.tabs.use.target.value = "mjlab"
    for label in ("Export", "Parameter sets for training", "Train a network"):
        acts[label]()
    assert helping_network(page.jobs) is not None
    assert [" ".join(w).replace(OUT, "OUT") for w in words] == [
        "export ./identify --to mjcf --out OUT",
        "check ./identify ./new",
        "adapt ./identify ./new --out OUT",
        "export ./adapt --to mjlab --out OUT",
        "export ./adapt --to randomization --engine mjlab --out OUT",
        "train ./import --robot ./identify --budget 10m --out OUT",
    ]


def test_view_shows_a_dataset_in_the_page_at_step_gap_and_leaves_no_folder(
    arm, tmp_path, monkeypatch
):
    pytest.importorskip("viser")
    data = Dataset.create(tmp_path / "data", arm)
    said = []
    pages = []
    for sequence in recordings(arm, 2, rows=60):
        data.append(sequence)
    shown = side_by_side(data, data.entries[1], arm)

    def once(server, tick):
        tick(1.0)
        pages.append(tick.__self__)
        server.stop()

    monkeypatch.setattr(app, "run_until_interrupt", once)
    monkeypatch.setattr(app.signal, "signal", lambda *_: None)
    app.serve_dataset(data, Scene(shown), Clip.from_start(shown, 0.0, 1.0), 0, 2.0, said.append)
    (page,) = pages
    assert said == [f"open {page.address}?step=4 in a browser; Ctrl-C ends"]
    assert page.tabs.logs.recording.options == tuple(e.id for e in data.entries)
    assert "differences drawn 2×" in page.player.title.content
    assert not page.controls.folder.exists()


def test_curves_are_saved_as_the_page_shows_them(page):
    pytest.importorskip("matplotlib")
    sent = {}
    client = SimpleNamespace(send_file_download=lambda name, content: sent.update({name: content}))
    chart = draw_curves(
        page.server.gui, np.arange(3.0), {"<b>x</b>": (np.zeros(3), "#00838f")}, "rad"
    )
    save = next(
        h
        for h in page.server.gui._gui_input_handle_from_uuid.values()
        if getattr(h, "label", "").startswith("Save")
    )
    assert chart.title == "rad"
    save._impl.update_cb[-1](SimpleNamespace(client=client))
    assert sent["curves.svg"].startswith(b"<?xml")
    assert sent["curves.png"].startswith(b"\x89PNG")


@pytest.mark.browser  # four processes
def test_the_page_says_what_is_wrong_with_logs_and_what_to_do(page):
    write_arm(page.controls.folder / "arm")
    finish(page.jobs, "robot", {}, ("robot", "new", "x", "--out", "arm"))
    page.tabs.logs.described.value = (
        'time = "t"\ntime_unit = "s"\nctrl = "{joint}_des"\nqpos = "{joint}_pos"\n'
    )
    page.tabs.logs.position.value = "rad"
    time_s = np.arange(300) * 0.02
    for joints, scale, why in (
        ((), 1.0, "no log of"),
        (("hip", "knee"), 1.0, "names joints hip, knee, which robot 'arm' does not have"),
        (("shoulder", "elbow"), 57.3, "these look like degrees"),
        (("shoulder",), 1.0, "has ended"),
    ):
        swing = [0.8 * scale * np.sin(time_s)] * len(joints)
        columns = ["t", *(f"{j}_des" for j in joints), *(f"{j}_pos" for j in joints)]
        if joints:
            rows = np.column_stack([time_s, *swing, *swing])
            np.savetxt(
                page.controls.folder / "logs" / "m.csv",
                rows,
                delimiter=",",
                header=",".join(columns),
                comments="",
            )
        page.jobs.start(page.tabs.logs.read())
        wait_for(page.jobs)
        assert why in ending(page.jobs.all[-1])
    assert "elbow: missing in some recordings" in report(page.jobs.all[-1])


@pytest.mark.slow
def test_a_calibration_and_a_training_end_in_step_use_with_their_result(tmp_path, monkeypatch):
    """Real commands on a VIRTUAL arm, by the buttons of the page; the nominal arm stands for the
    identified one.
    """
    pytest.importorskip("viser")
    acts = {}
    add = Controls.add_button
    monkeypatch.setattr(
        Controls,
        "add_button",
        lambda self, label, act: acts.update({label: act}) or add(self, label, act),
    )
    robot = write_arm(tmp_path / "robot")
    for place, kp in (("data", 0.7), ("new", 0.6)):
        data = Dataset.create(tmp_path / place, robot)
        for sequence in recordings(robot, 4, rows=400, kp=kp, delay=2):
            data.append(sequence)
    made = {"robot": "robot", "import": "data", "doctor": "data", "identify": "robot", "new": "new"}
    for step, out in made.items():
        finish(Jobs(tmp_path), step, {"findings": []}, (step, "x", "--out", out))
    page = App(tmp_path, 0)
    try:
        page.tabs.use.budget.value = "40000"
        for label, step in (("Calibrate with the new logs", "adapt"), ("Train a network", "train")):
            page.controls.attempt(acts[label])
            wait_for(page.jobs)
            page.controls.attempt(page.refresh)
            assert page.controls.status.content == f"**gaponet {step}** has ended."
        assert (
            "recording(s) of unit a; robot folder adapt"
            in page.controls.places["adapt"].text.content
        )
        assert "best on validation" in page.controls.places["train"].text.content
    finally:
        page.jobs.cancel()
        page.server.stop()
