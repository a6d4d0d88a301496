"""The paper's experiment from top to bottom.

1. Motions that are in no recording, played by a unit that no network sees.
2. Identification of the nominal robot, and every network: equal recordings, inputs, training and
   seeds.
3. Each is measured on these motions: the simulator with Δa against the robot (equation 5), commands
   on the robot, and delivery of payloads.
4. The paper's claims, Figures 2 and 3, Tables 1 and 2, on one page.
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import AbstractContextManager
from dataclasses import dataclass, replace
from pathlib import Path

from gaponet.base.errors import ModelError, UsageError
from gaponet.base.files import lock_folder
from gaponet.base.progress import Running
from gaponet.base.result_table import ResultTable
from gaponet.data.checks.gate import pass_gate, used_recordings
from gaponet.data.paper_counts import count_as_paper, table_beside_paper
from gaponet.data.store import Dataset
from gaponet.experiments.paper.claims import Claim, claim_table, claims
from gaponet.experiments.paper.commands import ShareDone
from gaponet.experiments.paper.figure3 import draw_figure_3, figure_3_table
from gaponet.experiments.paper.jobs import Job, make_shared_inputs, run_jobs
from gaponet.experiments.paper.measure import record_unit
from gaponet.experiments.paper.options import PaperOptions
from gaponet.experiments.paper.page import Section, write_page
from gaponet.experiments.paper.results import Results
from gaponet.experiments.paper.study import Study, entries_at, quick_dataset
from gaponet.experiments.paper.tables import (
    commands_table,
    large_gaps_table,
    method_table,
    sensor_table,
    table_1,
    table_2,
)
from gaponet.experiments.paper.trainings import METHOD_BLOCKS, all_trainings
from gaponet.experiments.paper.unseen_motions import require_unseen
from gaponet.robot.spec import RobotSpec

KIND = "experiments"  # of the results folder

OpenBar = Callable[[str], AbstractContextManager[ShareDone]]
OpenBars = Callable[[str, int], AbstractContextManager[Callable[[Running, int], None]]]


@dataclass(frozen=True)
class PaperResult:
    """Result of the experiment.

    Attributes:
        page: The page with all figures and tables.
        claims: The paper's claims, and what each method reaches.
        tables: Tables by name.
        sentences: Conclusions.
        failures: A sentence for each training that failed.
    """

    page: Path
    claims: list[Claim]
    tables: dict[str, ResultTable]
    sentences: list[str]
    failures: list[str]


def run_paper_experiment(
    dataset: Dataset,
    robot: RobotSpec,
    out: Path,
    options: PaperOptions,
    open_bar: OpenBar,
    open_bars: OpenBars,
) -> PaperResult:
    """Run the experiment, or continue it, and write its page.

    Args:
        dataset: Recordings of a VIRTUAL fleet, or of a real robot.
        robot: The dataset's robot.
        out: Folder of the results; an interrupted experiment continues there.
        open_bar: Opens a progress bar, title → update(share).
        open_bars: Opens the bars of the trainings, title and number → show(running, done).

    Raises:
        UsageError: The dataset or the folder does not fit, a motion of the experiment was recorded,
            or the options leave nothing to train.
        ModelError: Every training failed.
    """
    with lock_folder(out, KIND):
        study = prepare(dataset, robot, out, options, open_bar)
        jobs = all_jobs(study)
        trainings = [job.training for job in jobs if job.training]
        with open_bar("labels of the recordings") as update:
            make_shared_inputs(study, trainings[0].config, update)
        with open_bars("trainings", len(jobs)) as show:
            failures = run_jobs(jobs, show)
        baselines, *networks = [job.result_file.is_file() for job in jobs]
        if not baselines or not any(networks):
            raise ModelError(f"{out}: nothing could be trained; the first: {failures[0]}")
        return summarise(study, jobs, failures)


def prepare(
    dataset: Dataset, robot: RobotSpec, out: Path, options: PaperOptions, open_bar: OpenBar
) -> Study:
    """Check all inputs, and record the unit that no network sees. Nothing is trained yet."""
    nominal = robot.before_identification
    dataset.require_robot(nominal)
    study = Study(str(dataset.path.resolve()), nominal, out, options)
    if not all_trainings(options, study.rates, study.payloads):
        raise UsageError(
            "--methods and --blocks leave nothing to train; name a block, and for labels and ppo a "
            "method too"
        )
    if options.quick:
        options = options.for_quick_run()
        study = replace(study, options=options)
    if study.virtual:
        unit = study.virtual_unit()
        require_unseen(unit.motions, dataset, nominal, study.dt)
    if options.quick:
        small = quick_dataset(dataset, nominal, out / "data", study.training_units)
        study = replace(study, dataset=str(small.path.resolve()))
    splits = study.splits()  # refuses what cannot be split
    if not study.has_results:
        with open_bar("checking the recordings") as update:
            pass_gate(
                study.data,
                used_recordings(study.data, splits),
                nominal,
                despite_errors=options.despite_errors,
                progress=lambda done, total, note: update(done / total),
            )
    study.require_same_setup()
    if study.virtual:
        compared_rates = {study.rates[0], study.rates[-1]}  # one, if all recordings have it
        for rate in compared_rates:
            with open_bar(f"the unseen {study.unit_name} at {rate:g} Hz") as update:
                record_unseen(study, rate, update)
    return study


def record_unseen(study: Study, rate: float, progress: ShareDone) -> None:
    """Store the recordings of the unit that no network sees in OUT/unseen, unless they are
    there.
    """
    unseen = Dataset.create(study.out / "unseen", study.robot)
    unit = study.virtual_unit(1.0 / rate)
    present = entries_at(rate, unseen.entries)
    if len(present) == len(unit.motion_runs()):
        return
    for sequence in record_unit(unit, progress).sequences:
        if unseen.find(sequence.content_hash()) is None:
            unseen.append(sequence)


def all_jobs(study: Study) -> list[Job]:
    """Return all jobs, identification and baselines first."""
    trainings = all_trainings(study.options, study.rates, study.payloads)
    return [Job(study), *(Job(study, training) for training in trainings)]


def summarise(study: Study, jobs: list[Job], failures: list[str]) -> PaperResult:
    """Read all results, and write the page."""
    results = Results.read(study, jobs)
    found = claims(results)
    sections = [Section("", "The paper's claims", tables=_claim_tables(found, results))]
    sections.append(_figure_2(study))
    sections += _figure_3(results)
    if study.virtual:
        sections += _table_1(results)
    if any(run["block"] == "table2" for run in results.trainings):
        sections.append(Section("Table 2", "One setting at a time", tables=[table_2(results)]))
        title = "What the Sensor Predictor saves"
        sections.append(Section("", title, tables=[sensor_table(results)]))
    sections.append(Section("", "Methods", tables=[method_table(results)]))
    gaps = []
    for block in METHOD_BLOCKS:
        if results.networks(block):
            gaps.append(large_gaps_table(results, block))
    sections.append(Section("", "Large gaps by payload", tables=gaps))
    page = write_page(study, sections, failures)
    sentences = [*_conclusions(found, results), *failures]
    tables: dict[str, ResultTable] = {}
    for section in sections:
        tables |= {table.name: table for table in section.tables}
    return PaperResult(page, found, tables, sentences, failures)


def _claim_tables(found: list[Claim], results: Results) -> list[ResultTable]:
    blocks = dict.fromkeys(claim.block for claim in found)
    return [claim_table(found, block, results.trained_by(block)) for block in blocks]


def _figure_2(study: Study) -> Section:
    from gaponet.report.figures.dataset_figures import draw_figures

    figures, _ = draw_figures(study.data, study.robot)
    counts = table_beside_paper(count_as_paper(study.data))
    return Section("Figure 2", "The recordings", figures=figures, tables=[counts])


def _figure_3(results: Results) -> list[Section]:
    sections = []
    for block in METHOD_BLOCKS:
        if not results.networks(block):
            continue
        sections.append(
            Section(
                "Figure 3",
                f"Simulator against robot, by joint and payload ({results.trained_by(block)})",
                "Q_dis is the area between the positions of the simulator, under a + Δa, and of "
                "the robot, under a. No network has seen these motions.",
                {f"figure3_{block}": draw_figure_3(results, block)},
                [figure_3_table(results, block)],
            )
        )
    return sections


def _table_1(results: Results) -> list[Section]:
    sections = []
    for block in METHOD_BLOCKS:
        if not results.networks(block):
            continue
        if results.study.delivers:
            title = f"Delivery: offsets of the hands ({results.trained_by(block)})"
            sections.append(Section("Table 1", title, tables=[table_1(results, block)]))
        title = f"Commands on the robot ({results.trained_by(block)})"
        sections.append(Section("", title, tables=[commands_table(results, block)]))
    return sections


def _conclusions(found: list[Claim], results: Results) -> list[str]:
    """Return a sentence for each claim of the paper."""
    sentences = []
    for claim in found:
        if claim.printed is None or not claim.verdict:
            continue
        ours = claim.reductions["GAPONet"]
        sentence = (
            f"{claim.text} ({results.trained_by(claim.block)}): "
            f"the paper claims {claim.printed:g} %; "
            f"GAPONet {ours} %, {claim.verdict}."
        )
        others = []
        for name, reduction in claim.reductions.items():
            if name != "GAPONet":
                others.append(f"{name} {reduction} %")
        if others:
            sentence = f"{sentence} Beside it: {', '.join(others)}."
        sentences.append(sentence)
    return sentences
