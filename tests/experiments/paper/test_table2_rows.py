"""Each row of Table 2 trains, and its setting changes the network that comes out."""

from dataclasses import replace

import numpy as np
import pytest
from arm import commands, record, write_dataset

from gaponet.experiments.paper.experiment import all_jobs
from gaponet.experiments.paper.jobs import make_shared_inputs, train
from gaponet.experiments.paper.options import PaperOptions
from gaponet.experiments.paper.study import Study, entries_at
from gaponet.experiments.paper.trainings import TABLE_2_CHANGES
from gaponet.nn.artifact import GapModel
from gaponet.sim.replay import rollout_errors

OPTIONS = PaperOptions(quick=True, blocks=("table2",)).for_quick_run()


@pytest.fixture(scope="module")
def study(robot, tmp_path_factory):
    """Recordings of a weak arm with two payloads; one rate, so there is no row of 100 Hz."""
    folder = tmp_path_factory.mktemp("table2")
    sequences = [
        record(robot, commands(60, motion), f"motion{motion}", payload, kp=0.5, delay=2)
        for motion in range(8)
        for payload in (0.0, 0.2)
    ]
    dataset = write_dataset(folder / "data", robot, sequences)
    return Study(str(dataset.path), robot, folder, OPTIONS)


def test_recordings_of_each_rate_are_tested_and_uneven_clocks_are_one_rate(robot, tmp_path):
    sequences = []
    for motion in range(8):
        recorded = record(robot, commands(60, motion), f"motion{motion}")
        for dt in (1 / 49.3, 1 / 49.9, 1 / 50.2, 0.01):
            labels = replace(recorded.meta, motion=f"motion{motion} {dt:.4f}", virtual=False)
            sequences.append(replace(recorded, dt=dt, meta=labels))
    dataset = write_dataset(tmp_path / "data", robot, sequences)
    study = Study(str(dataset.path), robot, tmp_path, OPTIONS)
    assert study.rates == (50.0, 100.0)
    assert sum(map(len, study.splits().values())) == 3 * 8
    for rate, slow in ((50.0, True), (100.0, False)):
        tested = study.recorded(rate).sequences
        assert tested
        assert all((sequence.dt > 0.015) == slow for sequence in tested)


def test_a_rate_between_whole_hertz_is_itself(robot, tmp_path):
    recorded = record(robot, commands(60, 0), "motion")
    odd = replace(recorded, dt=1 / 15.4, meta=replace(recorded.meta, virtual=False))
    dataset = write_dataset(tmp_path / "data", robot, [odd])
    study = Study(str(dataset.path), robot, tmp_path, OPTIONS)
    assert study.rates == pytest.approx((15.4,))
    assert entries_at(study.rates[0], study.data.entries) == study.data.entries


@pytest.fixture(scope="module")
def errors(robot, study):
    """Row → error of the simulator with its network on two motions, (2,) rad."""
    jobs = all_jobs(study)[1:]
    make_shared_inputs(study, jobs[0].training.config, lambda share: None)
    recordings = [record(robot, commands(60, 90 + k), "new", 0.2, kp=0.5, delay=2) for k in (0, 1)]
    measured = {}
    for job in jobs:
        train(job, job.training)
        corrector = GapModel.load(job.run_folder).corrector(robot)
        measured[job.training.name] = rollout_errors(recordings, robot, 1, corrector)
    return measured


@pytest.mark.slow
def test_every_row_that_the_data_allow_is_trained(errors):
    assert errors.keys() == TABLE_2_CHANGES.keys() - {"100 Hz"}


@pytest.mark.slow
def test_every_row_differs_from_the_paper_s_own(errors):
    own = errors.pop("payload out")
    for row, error in errors.items():
        assert not np.allclose(error, own, rtol=1e-6, atol=0), row
