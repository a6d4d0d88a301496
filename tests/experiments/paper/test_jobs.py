"""The experiment's jobs, continued after an interruption."""

from concurrent.futures import ThreadPoolExecutor

from gaponet.experiments.paper.jobs import Job, run_jobs
from gaponet.experiments.paper.options import PaperOptions
from gaponet.experiments.paper.study import Study
from gaponet.experiments.paper.trainings import all_trainings
from gaponet.robot.spec import load_robot


def test_a_continued_experiment_counts_what_was_done_before(tmp_path):
    options = PaperOptions(
        seeds=1,
        methods=("MLP", "GAPONet"),
        blocks=("ppo",),
        executor=ThreadPoolExecutor(1),  # type: ignore[arg-type]
    )
    missing = str(tmp_path / "nothing_recorded_here")
    study = Study(missing, load_robot("xl330_bench"), tmp_path / "out", options)
    jobs = [Job(study, training) for training in all_trainings(options, (50.0,), (0.0,))]
    jobs[0].run_folder.mkdir(parents=True)
    jobs[0].result_file.write_text("{}")
    counts = []

    failures = run_jobs(jobs, lambda running, done: counts.append(done))

    assert set(counts) <= {1, 2}
    assert counts[-1] == 2
    assert len(failures) == 1  # the other one, which has no recordings
