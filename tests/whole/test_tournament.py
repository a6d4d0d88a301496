"""Two robots of the tournament (benchmarks/tournament.py), whom nobody tuned on, by commands alone."""

import importlib.util
import sys
from pathlib import Path

import pytest

BENCHMARKS = Path(__file__).parents[2] / "benchmarks"


@pytest.mark.slow
@pytest.mark.parametrize("seed", [6001, 6006])
def test_identification_is_never_worse_than_the_file_of_a_robot_it_never_met(seed, tmp_path, monkeypatch):
    monkeypatch.syspath_prepend(str(BENCHMARKS))
    spec = importlib.util.spec_from_file_location("tournament", BENCHMARKS / "tournament.py")  # tests have robots too
    robots = importlib.util.module_from_spec(spec)
    monkeypatch.setitem(sys.modules, "tournament", robots)
    spec.loader.exec_module(robots)
    row = robots.play(seed, tmp_path / "robot", 6, 30.0, True, rival=False)
    assert row["identified"] <= robots.WORSE * row["nominal"], row
