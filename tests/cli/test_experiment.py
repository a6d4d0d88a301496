"""gaponet experiment paper, as a user types it."""

import json
from concurrent.futures import ThreadPoolExecutor

import pytest
from arm import recordings, write_arm
from short_experiment import shorten

from gaponet.base.executor import open_pool
from gaponet.cli.main import main
from gaponet.data.store import Dataset
from gaponet.experiments.paper import jobs


@pytest.fixture(scope="module")
def place(tmp_path_factory):
    folder = tmp_path_factory.mktemp("experiment")
    robot = write_arm(folder / "arm")
    dataset = Dataset.create(folder / "data", robot)
    for sequence in recordings(robot, 8, rows=60, kp=0.5, delay=2):
        dataset.append(sequence)
    return folder


@pytest.fixture(scope="module")
def words(place):
    return [
        *("experiment", "paper", str(place / "data"), "--out", str(place / "out"), "--quick"),
        *("--methods", "GAPONet", "--blocks", "labels", "--json"),
    ]


@pytest.fixture(scope="module")
def first_run(words, place):
    """Exit code of the first run, and when its result was written.

    Motions and holds take fractions of a second, and the jobs run in this process.
    """
    with pytest.MonkeyPatch.context() as patch:
        shorten(patch.setattr)
        patch.setattr(jobs, "open_pool", lambda where, workers: open_pool(ThreadPoolExecutor(1), 1))
        code = main(words)
    return code, (place / "out/trainings/labels-GAPONet-0/result.json").stat().st_mtime_ns


def test_the_experiment_ends_in_a_page_with_the_paper_s_figures_and_tables(place, first_run):
    assert first_run[0] == 0
    page = (place / "out" / "paper.html").read_text(encoding="utf-8")
    for number in ("Figure 1", "Figure 2", "Figure 3", "Table 1"):
        assert f"<h2>{number}. " in page
    assert "QUICK RUN" in page
    assert (place / "out" / "figures" / "figure3_labels.svg").is_file()
    assert (place / "out" / "tables" / "table1_labels.csv").is_file()


def test_the_network_of_a_quick_run_takes_steps(place, first_run):
    result = json.loads((place / "out/trainings/labels-GAPONet-0/result.json").read_text())
    progress = place / "out/trainings/labels-GAPONet-0/progress.jsonl"
    last = json.loads(progress.read_text(encoding="utf-8").splitlines()[-1])
    assert last["stage"] == "ppo"
    assert last["kl"] > 0
    assert result["steps"] >= 1500


def test_the_same_command_goes_on_where_it_was_and_prints_the_same(words, place, first_run, capsys):
    assert main(words) == 0
    again = json.loads(capsys.readouterr().out)
    written = (place / "out/trainings/labels-GAPONet-0/result.json").stat().st_mtime_ns
    assert written == first_run[1]
    assert again["tables"] == json.loads((place / "out" / "paper.json").read_text())["tables"]


@pytest.mark.parametrize("other", [("--fleet", "easy"), ("--unit", "virtual-2")])
def test_results_of_another_experiment_are_not_mixed(words, first_run, capsys, other):
    assert main([*words, *other]) == 2
    assert f"another {other[0].removeprefix('--')}" in capsys.readouterr().err
