"""The notebook of the paper, on a smaller robot and with tiny trainings, and the command that goes
on with it.
"""

import json
import re
from pathlib import Path
from types import SimpleNamespace

import pytest
from arm import write_arm
from short_experiment import shorten

from gaponet.cli.main import main
from gaponet.experiments.paper import page
from gaponet.report.page import PageFigure

pytest.importorskip("IPython")
from notebooks import run_notebook

FILE = Path(__file__).parents[2] / "examples" / "paper.ipynb"
RECIPE = """
motions = ["tour-all-*", "multisine-*"]
payloads = [0.0, 0.2]
units = ["virtual-1"]
rates = [50]
variants = 2
"""
IMPORTS = """
import gaponet as gp
from concurrent.futures import ThreadPoolExecutor
"""
TRAINING = "paper/trainings/labels-GAPONet-0"


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    """What the notebook showed, its folder, and when the result of its training was written."""
    folder = tmp_path_factory.mktemp("notebook")
    write_arm(folder / "arm")
    (folder / "recipe.toml").write_text(RECIPE)
    smaller = {
        "import gaponet as gp": IMPORTS,
        "work = Path(tempfile.mkdtemp())": f'work = Path("{folder}")',
        'robot="h1_2"': f'robot="{folder / "arm"}"',
        'recipe="demo"': f'recipe="{folder / "recipe.toml"}"',
        "seeds=1": 'quick=True, methods=("GAPONet",), executor=ThreadPoolExecutor(1)',
    }
    with pytest.MonkeyPatch.context() as patch:
        shorten(patch.setattr)
        shown = run_notebook(FILE, smaller)
    written = (folder / TRAINING / "result.json").stat().st_mtime_ns
    return SimpleNamespace(shown=shown, folder=folder, written=written)


@pytest.fixture
def command(finished):
    """The command of the same experiment."""
    folder = finished.folder
    return [
        *("experiment", "paper", str(folder / "data"), "--out", str(folder / "paper"), "--quick"),
        *("--methods", "GAPONet", "--blocks", "labels", "--json"),
    ]


def test_the_notebook_goes_from_recordings_to_figure_3(finished):
    assert "image/svg+xml" in finished.shown.kinds
    assert "recordings, " in finished.shown.text


def test_the_experiment_ends_in_a_page_with_the_paper_s_figures_and_tables(finished):
    out = finished.folder / "paper"
    text = (out / "paper.html").read_text(encoding="utf-8")
    for number in ("Figure 1", "Figure 2", "Figure 3", "Table 1"):
        assert f"<h2>{number}. " in text
    assert "QUICK RUN" in text
    assert (out / "figures" / "figure3_labels.svg").is_file()
    assert (out / "tables" / "table1_labels.csv").is_file()


def test_the_network_of_a_quick_run_takes_steps(finished):
    training = finished.folder / TRAINING
    result = json.loads((training / "result.json").read_text())
    last = (training / "progress.jsonl").read_text(encoding="utf-8").splitlines()[-1]
    assert json.loads(last)["stage"] == "ppo"
    assert json.loads(last)["kl"] > 0
    assert result["steps"] >= 1500


def test_the_command_goes_on_where_the_notebook_ended(finished, command, capsys, monkeypatch):
    # The notebook has drawn the figures.
    monkeypatch.setattr(page, "save", lambda *_: [])
    monkeypatch.setattr(page, "page_figure", lambda *_: PageFigure("", "plot", ""))
    assert main(command) == 0
    printed = json.loads(capsys.readouterr().out)
    kept = json.loads((finished.folder / "paper" / "paper.json").read_text())
    assert (finished.folder / TRAINING / "result.json").stat().st_mtime_ns == finished.written
    assert printed["tables"] == kept["tables"]


@pytest.mark.parametrize("other", [("--fleet", "easy"), ("--unit", "virtual-2")])
def test_results_of_another_experiment_are_not_mixed(command, capsys, other):
    assert main([*command, *other]) == 2
    assert f"another {other[0].removeprefix('--')}" in capsys.readouterr().err


def test_the_notebook_as_it_is_kept_names_no_place_of_the_machine_that_made_it():
    assert not re.search(r"/(tmp|home|work|root)/", FILE.read_text(encoding="utf-8"))
