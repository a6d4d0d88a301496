"""benchmarks/results.py: what runs, and what is kept."""

import re

import results

DATA = results.ROOT


def step(command, quick=None, program=None):
    return results.Step("one", command, "", quick, program)


def run(one, work, *, quick=False):
    return results.run_steps([one], work, DATA, quick=quick, dry=False)


def test_a_step_with_an_answer_does_not_run_again(tmp_path):
    counting = step(f"echo x >> {tmp_path}/runs")

    run(counting, tmp_path)
    run(counting, tmp_path)

    assert (tmp_path / "runs").read_text() == "x\n"


def test_a_step_whose_command_has_changed_runs_again(tmp_path):
    run(step(f"echo x >> {tmp_path}/runs"), tmp_path)
    run(step(f"echo y >> {tmp_path}/runs"), tmp_path)

    assert (tmp_path / "runs").read_text() == "x\ny\n"


def test_a_step_that_fails_has_no_answer_and_runs_again(tmp_path):
    failing = step("exit 3")

    assert run(failing, tmp_path) == ["one"]
    assert run(failing, tmp_path) == ["one"]


def test_a_step_without_its_program_is_no_failure(tmp_path):
    assert run(step("exit 3", program="no-such-program"), tmp_path) == []


def test_a_quick_run_takes_the_short_form_where_there_is_one(tmp_path):
    run(step("exit 3", quick=f"touch {tmp_path}/short"), tmp_path, quick=True)

    assert (tmp_path / "short").exists()


def test_every_short_form_is_of_a_step():
    names = {one.name for one in results.listed_steps()}

    assert set(results.LISTED["quick"]) <= names


def test_the_steps_name_no_path_of_a_machine():
    text = results.STEPS_LOG.read_text(encoding="utf-8")
    assert re.search(r"/(root|home|Users)/", text) is None
