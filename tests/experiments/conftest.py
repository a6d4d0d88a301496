"""A study of the small arm: recordings, nothing trained yet."""

from dataclasses import replace

import pytest
from arm import commands, record

from gaponet.data.store import Dataset
from gaponet.experiments.outcomes import StudyOutcomes
from gaponet.experiments.study import Options, Study


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
                        data.append(
                            record(
                                robot, ctrl, f"motion{seed}", payload, kp=0.5, delay=2, unit=unit
                            )
                        )
        return Study.from_options(data, arm, tmp_path / "out", Options(**how))

    return make


@pytest.fixture
def make_outcomes():
    """make_outcomes({word: outcomes}, baselines, cells): the outcomes of finished cells."""

    def make(runs, base, cells=None):
        return StudyOutcomes(runs, lambda word: base, cells or {})

    return make
