"""What an experiment found, in every file that it is written to."""

import csv
import json

import pytest
from arm import recordings

from gaponet.base.errors import DatasetError, FolderError
from gaponet.base.result_table import MeanStd, ResultTable, format_cell
from gaponet.data.store import Dataset
from gaponet.experiments.result import Result, command_line, facts
from gaponet.experiments.result_files import write, write_report
from gaponet.report.candidate import describe_provenance
from gaponet.report.figures.style import figure


def drawing():
    fig = figure(2, 2)
    fig.subplots().plot([0, 1], [0, 1])
    return fig


@pytest.fixture
def result():
    first = ResultTable(
        "all",
        ("method", "MPJAE, mrad", "runs"),
        (("A|B", MeanStd.from_values([0.001, 0.003], 1e3), 1234), ("C", None, 2)),
    )
    second = ResultTable(
        "by_joint", ("joint", "mrad"), (("elbow", 1.23456),), "Of every joint.", digits=1
    )
    figures = {"bars": drawing(), "curve": drawing()}
    return Result("thing", "A thing", "VIRTUAL arm: nothing real.", {"command": "gaponet", "seeds": [0, 1]},
                  (first, second), figures, ("It is < 3.",))  # fmt: skip


def test_several_values_have_a_sample_standard_deviation_and_one_value_has_none():
    assert format_cell(MeanStd.from_values([0.001, 0.003], 1e3)) == "2.00 ± 1.41"
    assert format_cell(MeanStd.from_values([0.5])) == "0.50"
    assert format_cell(MeanStd.from_values([])) == ""
    assert format_cell(MeanStd.from_values([1.0, float("nan"), 3.0])) == "2.00 ± 1.41"
    assert [format_cell(v) for v in (None, "a", 1234, float("nan"), True, -0.001)] == [
        "", "a", "1,234", "", "yes", "0.00"
    ]  # fmt: skip


def test_a_row_of_the_wrong_length_is_refused():
    with pytest.raises(ValueError, match="3 cells under 2 columns"):
        ResultTable("t", ("a", "b"), ((1, 2, 3),))


def test_every_form_is_written_and_files_are_exact(result, tmp_path):
    files = [f.name for f in write(result, tmp_path / "out")]
    assert files == ["thing.csv", "thing-by_joint.csv", "thing.svg", "thing.png", "thing-curve.svg", "thing-curve.png",
                     "thing.md", "thing.json", "report.html"]  # fmt: skip
    assert sorted(f.name for f in (tmp_path / "out").iterdir()) == sorted([".gaponet", *files])
    rows = list(csv.reader((tmp_path / "out" / "thing.csv").open()))
    assert rows[0] == ["method", "MPJAE, mrad", "MPJAE, mrad: std", "MPJAE, mrad: n", "runs"]
    assert rows[1] == ["A|B", "2.0", pytest.approx("1.4142135623730951"), "2", "1234"]
    assert rows[2] == ["C", "", "", "", "2"]
    assert list(csv.reader((tmp_path / "out" / "thing-by_joint.csv").open()))[1] == [
        "elbow",
        "1.23456",
    ]
    kept = json.loads((tmp_path / "out" / "thing.json").read_text())
    assert kept["tables"][0]["rows"][0][1] == {
        "mean": 2.0,
        "std": pytest.approx(2**0.5),
        "count": 2,
    }
    markdown = (tmp_path / "out" / "thing.md").read_text()
    assert "| A\\|B | 2.00 ± 1.41 | 1,234 |" in markdown
    assert "![](thing-curve.svg)" in markdown
    assert "**VIRTUAL arm: nothing real.**" in markdown


def test_one_report_holds_every_result_of_the_folder_and_needs_no_other_file(result, tmp_path):
    write(result, tmp_path)
    (tmp_path / "collect.json").write_text("[1]")
    write(Result("other", "Another", "Recordings of a real arm.", {}), tmp_path)
    page = (tmp_path / "report.html").read_text()
    assert page.count('src="data:image/svg+xml') == 2
    assert "It is &lt; 3." in page
    assert page.index("Another</h1>") < page.index("A thing</h1>")
    assert '<span class="tag real">' in page
    assert '<span class="tag virtual">' in page
    assert page.count("src=") == 2


def test_a_folder_without_results_and_a_result_without_its_figure_are_named(result, tmp_path):
    with pytest.raises(DatasetError, match="no result of gaponet experiment here"):
        write_report(tmp_path)
    write(result, tmp_path)
    (tmp_path / "thing-curve.svg").unlink()
    with pytest.raises(DatasetError, match=r"thing-curve\.svg: is missing"):
        write_report(tmp_path)
    with pytest.raises(FolderError, match="is no folder"):
        write(result, tmp_path / "thing.md")


def test_a_published_command_has_no_private_paths():
    assert command_line(["experiment", "compare", "/home/me/data", "out", "--seeds", "3"]) == (
        "gaponet experiment compare data out --seeds 3"
    )


def test_facts_and_label_come_from_the_dataset(arm, tmp_path):
    data = Dataset.create(tmp_path / "data", arm)
    for sequence in recordings(arm, 2, rows=90):
        data.append(sequence)
    found = facts(data, [0, 1], budget="1m")
    assert found["recorded_hours"] == round(2 * 90 * 0.02 / 3600, 3)
    assert found["seeds"] == [0, 1]
    assert found["budget"] == "1m"
    assert found["units"] == ["a"]
    assert set(found["versions"]) == {"gaponet", "mujoco", "numpy", "torch"}
    assert (
        describe_provenance(data) == "VIRTUAL arm: these numbers say nothing about real hardware."
    )
