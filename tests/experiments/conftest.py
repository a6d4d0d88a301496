"""A study of the small arm: recordings, and nothing trained yet."""

from dataclasses import replace

import pytest
from arm import commands, record

from gaponet.data.store import Dataset
from gaponet.experiments.found import Found
from gaponet.experiments.options import Options
from gaponet.experiments.study import Study


@pytest.fixture
def make_study(arm, tmp_path):
    """make_study(rates, payloads, units, **options)."""

    def make(rates=(50,), payloads=(0.0, 0.1, 0.2), units=("a", "b"), **how):
        data = Dataset.create(tmp_path / "data", arm)
        for rate in rates:
            robot = replace(arm, dt=1 / rate)
            for seed in range(8):
                for payload in payloads:
                    for unit in units:
                        ctrl = commands(40, seed, 1 / rate)
                        data.append(record(robot, ctrl, f"motion{seed}", payload, kp=0.5, delay=2, unit=unit))
        return Study.of(data, arm, tmp_path / "out", Options(**how))

    return make


@pytest.fixture
def make_found():
    """make_found({word or (word, unit left out): outcomes}, baselines): what cells would have given."""

    def make(runs, base, cells=None):
        runs = {key if isinstance(key, tuple) else (key, ""): part for key, part in runs.items()}
        return Found(runs, lambda key: base.get(key, base), cells or {})

    return make
