"""Tables and figure of a comparison, from numbers worked by hand."""

import csv
from types import SimpleNamespace

import pytest

from gaponet.experiments import compare as module
from gaponet.experiments.compare import MEASURES, Compare
from gaponet.experiments.result_files import write


def metrics(value):
    return dict.fromkeys(MEASURES, value)


def summary(light, heavy, unit="a"):
    part = {"0": metrics(light), "3": metrics(heavy), "0.5": metrics(light)}
    mean = metrics((light + heavy) / 2)
    return mean | {
        "by_payload": part,
        "by_unit": {unit: mean},
        "by_joint": {"elbow": mean},
        "by_motion": {},
    }


@pytest.fixture
def result(make_study, make_outcomes, monkeypatch, tmp_path):
    study = make_study(payloads=(0.0, 0.1), units=("a",))
    new = {"new": summary(0.03, 0.03, "b")}
    runs = [
        {"seed": i, "known": summary(0.005, 0.01 * i), "parameters": 1234, "seconds": 90.0} | new
        for i in (1, 3)
    ]
    cells = {"mlp": [SimpleNamespace(folder=tmp_path)]}
    monkeypatch.setattr(module, "select_entries", lambda runs, data: (study.data.entries[:6], True))
    base = {
        "nominal": {"known": summary(0.01, 0.03)} | new,
        "delay_offset": {"known": summary(0.01, 0.02)} | new,
    }
    return Compare(("mlp",)).result(study, make_outcomes({"mlp": runs}, base, cells))


def table(result, name):
    return next(t for t in result.tables if t.name == name)


def test_the_main_table_has_deviation_ratio_and_the_worst_payload(result):
    made = table(result, "totals")
    assert made.columns == (
        "method", "weights", "MPJAE mrad", "of nominal", "Q_dis rad·s", "worst payload", "new unit", "min",
    )  # fmt: skip
    rows = made.texts()
    assert rows[0][2:6] == ["20.00", "1.00", "0.02", "30.00 (3 kg)"]
    # Means of the seeds are 7.5 and 17.5 mrad: 12.5 ± 10/√2; at 3 kg 10 and 30.
    assert rows[2] == [
        "MLP, full coupling",
        "1.23 k",
        "12.50 ± 7.07",
        "0.62",
        "0.01",
        "20.00 ± 14.14 (3 kg)",
        "30.00 ± 0.00",
        "1.5",
    ]


def test_payloads_are_in_order_of_mass_and_new_units_are_named(result):
    assert [row[0] for row in table(result, "groups").rows] == [
        "0 kg",
        "0.5 kg",
        "3 kg",
        "b, never trained on",
    ]


def test_everything_is_written_and_no_line_is_lost(result, tmp_path):
    files = [f.name for f in write(result, tmp_path / "out")]
    assert files == [
        "compare.csv", "compare-totals.csv", "compare-groups.csv", "compare.svg", "compare.png",
        "compare.md", "compare.json", "report.html",
    ]  # fmt: skip
    lines = list(csv.DictReader((tmp_path / "out" / "compare.csv").open()))
    assert len(lines) == 4 * 2 * (
        1 + 3 + 1 + 1
    )  # runs × groups of units × (all, payloads, unit, joint)
    assert sum(float(line["mpjae"]) == 0.03 for line in lines if line["seed"] == "3") == 1 + 6
    text = (tmp_path / "out" / "compare.md").read_text()
    assert "**VIRTUAL arm" in text
    assert "Units never trained on: b" in text
    assert "| method | seed |" not in text  # it has one line per seed and group, for programs


def test_bars_show_the_deviation_over_seeds(result):
    ax = result.figures["compare"].axes[0]
    assert [t.get_text() for t in ax.get_xticklabels()] == [
        "0 kg",
        "0.5 kg",
        "3 kg",
        "b\n(new unit)",
    ]
    assert [bar.get_height() for bar in ax.containers[0]] == [10, 10, 30, 30]
    # matplotlib puts an error container before the bars of its method
    bars = [c for c in ax.containers if hasattr(c, "patches")][-1]
    assert bars.errorbar.lines[2][0].get_segments()[2][:, 1] == pytest.approx(
        [20 - 14.142, 20 + 14.142], abs=1e-3
    )
