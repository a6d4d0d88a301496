"""Progress without a terminal."""

import time

from gaponet.base import progress


def test_a_pipe_receives_a_first_line_one_per_interval_and_a_last_one(capfd, monkeypatch):
    now = [0.0]
    monkeypatch.setattr(time, "monotonic", lambda: now[0])
    with progress.progress_bar("importing [all]") as update:
        for k in range(1, 101):
            now[0] += 0.4
            update(k, 100, f"motion-{k}")
    lines = capfd.readouterr().err.splitlines()
    assert lines[0] == "importing [all]: 1 %, 0 s, motion-1"
    assert lines[1] == "importing [all]: 26 %, 10 s, motion-26"
    assert lines[-1] == "importing [all]: 100 %, 40 s, motion-100"
    assert len(lines) == 5


def test_100_percent_is_printed_once_at_the_end(capfd, monkeypatch):
    now = [0.0]
    monkeypatch.setattr(time, "monotonic", lambda: now[0])
    with progress.progress_bar("training") as update:
        for stage in ("ppo", "gain", "gain", "export"):
            update(1, 1, stage)
    with progress.progress_bar("fitting") as update:
        update(1, 2, "joints")
        for now[0] in (11.0, 12.0, 30.0):
            update(2, 2, "table")
    assert capfd.readouterr().err.splitlines() == [
        "training: 100 %, 0 s, export",
        "fitting: 50 %, 0 s, joints",
        "fitting: 99 %, 11 s, table",
        "fitting: 99 %, 30 s, table",
        "fitting: 100 %, 30 s, table",
    ]


def test_parallel_tasks_share_a_line(capfd):
    with progress.progress_bars("runs", 4) as show:
        show({"mlp seed 0": (0.5, "round 3"), "gaponet seed 0": (0.25, "")}, 1)
    assert capfd.readouterr().err.startswith(
        "runs: 44 %, 0 s, 1 of 4 done; mlp seed 0 50 % round 3; gaponet seed 0 25 %\n"
    )


def test_in_a_notebook_progress_is_text_on_stderr(capfd, monkeypatch):
    monkeypatch.setattr("rich.console._is_jupyter", lambda: True)
    with progress.progress_bar("training") as update:
        update(1, 2, "half")
    assert capfd.readouterr().err.startswith("training: 50 %")


def test_a_pipe_shows_that_a_silent_task_is_alive(capfd, monkeypatch):
    monkeypatch.setenv(progress.LINE_INTERVAL_VARIABLE, "0.01")
    printed = ""
    with progress.progress_bar("labels"):
        while printed.count("labels: 0 %") < 2:
            printed += capfd.readouterr().err
