"""Tables and figure of a comparison, from numbers worked by hand."""

import csv

import pytest
from matplotlib.colors import to_rgb

from gaponet.plot.methods import COLOURS
from gaponet.study.compare import CSV_COLUMNS, draw, group_table, main_table, palette, write


def metrics(value):
    return dict.fromkeys(CSV_COLUMNS[5:], value)


def summary(light, heavy, unit="a"):
    part = {"0": metrics(light), "3": metrics(heavy), "0.5": metrics(light)}
    mean = metrics((light + heavy) / 2)
    return mean | {"by_payload": part, "by_unit": {unit: mean}, "by_joint": {"elbow": mean}, "by_motion": {}}


def method(title, kind, runs, **facts):
    return {"title": title, "kind": kind, "parameters": None, "seconds": None, "runs": runs} | facts


@pytest.fixture
def result():
    new = {"new": summary(0.03, 0.03, "b")}
    return {
        "robot": "arm", "virtual": True, "unseen": True, "sequences": 6, "motions": ["wave"], "budget": "1m",
        "simulator_hash": "123",
        "methods": {
            "nominal": method("nominal simulator", "nominal", [{"known": summary(0.01, 0.03)} | new]),
            "mlp": method("MLP", "mlp", [{"seed": i, "known": summary(0.005, 0.01 * i)} | new for i in (1, 3)],
                          parameters=1234, seconds=90.0),
        },
    }  # fmt: skip


def test_the_main_table_has_spread_ratio_and_the_worst_payload(result):
    columns, rows = main_table(result)
    assert columns == [
        "method",
        "weights",
        "MPJAE mrad",
        "of nominal",
        "Q_dis rad·s",
        "worst payload",
        "new unit",
        "min",
    ]
    assert rows[0][2:6] == ["20.00", "1.00", "0.02", "30.00 (3 kg)"]
    # Means of the seeds are 7.5 and 17.5 mrad: 12.5 ± 10/√2; at 3 kg 10 and 30.
    assert rows[1] == ["MLP", "1.23 k", "12.50 ± 7.07", "0.62", "0.01", "20.00 ± 14.14 (3 kg)", "30.00 ± 0.00", "1.5"]


def test_payloads_are_in_order_of_mass_and_new_units_are_named(result):
    _, rows = group_table(result)
    assert [row[0] for row in rows] == ["0 kg", "0.5 kg", "3 kg", "b, never trained on"]


def test_everything_is_written_and_no_line_is_lost(result, tmp_path):
    files = write(result, tmp_path)
    assert [f.name for f in files] == [f"compare.{s}" for s in ("json", "csv", "md", "svg", "png")]
    lines = list(csv.DictReader((tmp_path / "compare.csv").open()))
    assert len(lines) == 3 * 2 * (1 + 3 + 1 + 1)  # runs × groups of units × (all, payloads, unit, joint)
    assert sum(float(line["mpjae"]) == 0.03 for line in lines if line["seed"] == "3") == 1 + 6
    text = (tmp_path / "compare.md").read_text()
    assert "VIRTUAL robot" in text
    assert "Units never trained on: b" in text


def test_bars_carry_the_spread_over_seeds(result):
    ax = draw(result).axes[0]
    assert [t.get_text() for t in ax.get_xticklabels()] == ["0 kg", "0.5 kg", "3 kg", "b\n(new unit)"]
    assert [bar.get_height() for bar in ax.containers[0]] == [10, 10, 30, 30]
    # matplotlib puts an error container before the bars of its method
    (bars,) = (c for c in ax.containers[1:] if hasattr(c, "patches"))
    assert bars.errorbar.lines[2][0].get_segments()[2][:, 1] == pytest.approx([20 - 14.142, 20 + 14.142], abs=1e-3)


def test_a_method_has_the_colour_that_it_has_everywhere_and_its_variants_shades_of_it():
    methods = {"mlp": {"kind": "mlp"}, "mlp:history=8": {"kind": "mlp"}, "new": {"kind": "new"},
               "identified+mlp": {"kind": "mlp", "start": "identified"}}  # fmt: skip
    found = palette(methods)
    assert found["mlp"] == pytest.approx(to_rgb(COLOURS["mlp"]))
    assert len(set(found.values())) == 4
    assert sum(found["identified+mlp"]) < sum(found["mlp"]) < sum(found["mlp:history=8"])
