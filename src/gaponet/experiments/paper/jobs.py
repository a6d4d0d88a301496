"""Jobs of the experiment, each in a process of its own: identification and baselines, and every
training.

Every job writes one result file. A job whose file exists is done; an interrupted training continues
at its checkpoint.
"""

from __future__ import annotations

import json
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from gaponet.base.errors import DatasetError, ModelError
from gaponet.base.executor import open_pool
from gaponet.base.files import atomic_write, lock_folder, write_json
from gaponet.base.progress import Running
from gaponet.base.structure import read_json
from gaponet.data.split import stratified_subset
from gaponet.experiments.paper.commands import ShareDone
from gaponet.experiments.paper.measure import (
    Delivery,
    measure_alignment,
    measure_commands,
    measure_delivery,
    measure_latency,
)
from gaponet.experiments.paper.study import SETUP_HINT, Study
from gaponet.experiments.paper.trainings import Training
from gaponet.nn.artifact import GapModel
from gaponet.nn.delay_offset import DelayOffset
from gaponet.nn.training.config import TrainConfig
from gaponet.robot.folder import save_robot
from gaponet.robot.spec import RobotSpec, load_robot

BASELINES_FILE = "baselines.json"
RESULT_FILE = "result.json"
DELAY_OFFSET_FILE = "delay_offset.json"
LABELS_FILE = "labels.npy"
LABEL_SHARE_OF_BOUND = 0.99  # largest label, as a share of the largest correction
# recordings that judge a hurried identification
HURRIED_JUDGES = 8
# exists while the experiment is to end: running trainings store a checkpoint and end
STOP_FILE = "stop"
LOCK_TIMEOUT_S = 60.0  # trainings of an experiment that was killed end within this time

Show = Callable[[Running, int], None]


def make_shared_inputs(study: Study, config: TrainConfig, progress: ShareDone) -> None:
    """Store what all trainings at the slowest rate have in common: it takes as long as a training.

    OUT/delay_offset.json: delay and offset of the training recordings, a baseline of every run.
    OUT/labels.npy: Δa of each labelled row, (rows, n) rad.

    Args:
        config: Settings of any of these trainings; they choose the recordings.
    """
    from gaponet.nn.training.pretraining import ITERATIONS, trajectory_labels
    from gaponet.nn.training.run_folder import TrainingData

    labels_file = study.out / LABELS_FILE
    if labels_file.is_file():
        return
    data = TrainingData(study.data, study.robot, config, study.holdout_units)
    write_json(study.out / DELAY_OFFSET_FILE, DelayOffset.fit(data.train, study.robot, 0))
    iterations = 0

    def tick() -> None:
        nonlocal iterations
        iterations += 1
        progress(iterations / (ITERATIONS + 2))

    sequences = data.labelled_subset(config.pretraining.rows)
    largest = LABEL_SHARE_OF_BOUND * config.model.delta_max
    labels = trajectory_labels(sequences, study.robot, largest, 0, tick)
    with atomic_write(labels_file) as temporary, temporary.open("wb") as file:
        np.save(file, labels)


def shared_inputs(study: Study, training: Training) -> dict[str, Any]:
    """Return what a training takes from `make_shared_inputs`, in the form of Trainer's `shared`."""
    if training.config.rates != study.rates[:1]:
        return {}
    no_time = 0.0  # s that count for this training
    baseline = DelayOffset.read(study.out)
    labels = np.load(study.out / LABELS_FILE)
    return {"baseline": (baseline, no_time), "labels": (labels, no_time)}


@dataclass(frozen=True)
class Job:
    """One job; without a training it identifies the robot and measures all that needs no
    network.
    """

    study: Study
    training: Training | None = None

    @property
    def name(self) -> str:
        """Name for people."""
        return self.training.folder if self.training else "identification and baselines"

    @property
    def result_file(self) -> Path:
        """Its result."""
        if self.training is None:
            return self.study.out / BASELINES_FILE
        return self.run_folder / RESULT_FILE

    @property
    def run_folder(self) -> Path:
        """Run folder of its training."""
        assert self.training is not None
        return self.study.out / "trainings" / self.training.folder

    def result(self) -> dict[str, Any]:
        """Read the result."""
        return read_json(dict[str, Any], self.result_file, DatasetError, SETUP_HINT)

    def progress(self) -> float:
        """Return the share that is done, from the training's own log."""
        if self.training is None:
            return 0.0
        file = self.run_folder / "progress.jsonl"
        try:
            last_line = file.read_text(encoding="utf-8").splitlines()[-1]
            return min(float(json.loads(last_line)["steps"]) / self.training.steps, 1.0)
        except (FileNotFoundError, IndexError, ValueError):  # not yet, or just being written
            return 0.0


def run_jobs(jobs: list[Job], show: Show) -> list[str]:
    """Do the jobs that have no result yet. Return a sentence for each that failed.

    Args:
        jobs: All jobs of the experiment.
        show: Shows the running trainings and how many of all jobs are done, those of earlier runs
            included.

    Raises:
        KeyboardInterrupt: After every running training has stored a checkpoint.
    """
    todo = [job for job in jobs if not job.result_file.is_file()]
    if not todo:
        return []
    study = jobs[0].study
    stop = study.out / STOP_FILE
    stop.unlink(missing_ok=True)
    failures: list[str] = []
    done_before = len(jobs) - len(todo)
    ended: set[str] = set()

    def request_stop(job: Job) -> bool:
        stop.touch()
        return True

    def poll() -> None:
        running = {}
        for job in todo:
            if job.name not in ended and job.training and job.run_folder.is_dir():
                running[job.name] = (job.progress(), "")
        show(running, done_before + len(ended))

    with open_pool(study.options.executor, study.options.workers) as pool:
        for outcome in pool.run(do_job, todo, poll, request_stop):
            ended.add(outcome.job.name)
            if outcome.error is not None:
                failures.append(f"{outcome.job.name} failed: {outcome.error}")
            show({}, done_before + len(ended))
    return failures


def do_job(job: Job) -> None:
    """Do a job and write its result. It runs in a worker."""
    if job.training is None:
        measure_baselines(job)
    else:
        train_and_measure(job, job.training)


def measure_baselines(job: Job) -> None:
    """Identify the robot on the training recordings, and measure everything without a network."""
    study = job.study
    began = time.process_time()
    identified = identified_robot(study)
    seconds = time.process_time() - began
    recorded = study.recorded()
    result: dict[str, Any] = {
        "motions": recorded.motions,
        "payloads": recorded.payloads,
        "durations_s": recorded.durations,
        "identify_cpu_s": round(seconds, 1),
        "nominal": {"alignment": measure_alignment(recorded, study.robot, None)},
        "identified": {"alignment": measure_alignment(recorded, identified, None)},
    }
    if len(study.rates) > 1:
        fastest = study.recorded(study.rates[-1])
        result["nominal_fastest"] = {"alignment": measure_alignment(fastest, study.robot, None)}
    if study.virtual:
        unit = study.virtual_unit()
        result["nominal"]["commands"] = measure_commands(unit, None)
        if study.delivers:
            result["nominal"]["delivery"] = measure_delivery(unit, Delivery.plan(unit), None)
        result["identified"]["commands"] = measure_commands(unit, None, identified)
    write_json(job.result_file, result)


def identified_robot(study: Study) -> RobotSpec:
    """Return the robot identified on the training recordings; it is stored in OUT/identified."""
    from gaponet.nn.training.run_folder import MAX_VALIDATION_ROLLOUTS
    from gaponet.sysid.identify import identify
    from gaponet.sysid.options import IdentifyOptions

    folder = study.out / "identified"
    if not (folder / "robot.toml").is_file():
        splits = study.splits()
        options = IdentifyOptions(nthread=1, windows=study.options.identify_windows)
        judges = MAX_VALIDATION_ROLLOUTS  # as many recordings as judge the networks
        if study.options.identifies_joints_alone:
            options = replace(options, terms=(), table=False, joints_alone=True)
            judges = HURRIED_JUDGES
        fitted = identify(
            study.data.sequences(splits["train"]),
            study.robot,
            study.data.sequences(stratified_subset(splits["val"], judges)),
            options,
        )
        save_robot(fitted.robot, folder)
    return load_robot(folder)


def train_and_measure(job: Job, training: Training) -> None:
    """Train a network, or continue its training, and measure it."""
    facts = train(job, training)
    study = job.study
    model = GapModel.load(job.run_folder)
    rate = training.config.rates[0]
    measured: dict[str, Any] = {
        "alignment": measure_alignment(study.recorded(rate), study.robot, model)
    }
    if training.block != "table2":
        measured["latency"] = measure_latency(model)
        if study.virtual:
            unit = study.virtual_unit()
            measured["commands"] = measure_commands(unit, model)
            if study.delivers:
                measured["delivery"] = measure_delivery(unit, Delivery.plan(unit), model)
    write_json(job.result_file, facts | measured)


def train(job: Job, training: Training) -> dict[str, Any]:
    """Train a network, or continue its training; return the facts of the training.

    Raises:
        ModelError: It was asked to stop; its checkpoint is stored.
    """
    import torch  # here, so that the parent process does not load it

    from gaponet.nn.networks import build_network
    from gaponet.nn.training.config import Budget, Status
    from gaponet.nn.training.trainer import Trainer

    torch.set_num_threads(1)
    study = job.study
    stop = study.out / STOP_FILE
    ending = False

    def end_if_asked(status: Status) -> None:
        nonlocal ending
        if stop.exists() and not ending:
            ending = True  # once: the trainer then stores what it has
            raise KeyboardInterrupt

    resumed = (job.run_folder / "checkpoint.pt").is_file()
    began = time.process_time()
    with lock_folder(job.run_folder, "run", wait=LOCK_TIMEOUT_S):
        trainer = Trainer(
            study.data,
            study.robot,
            job.run_folder,
            training.config,
            Budget(steps=training.steps),
            resume=resumed,
            holdout_units=study.holdout_units,
            show=end_if_asked,
            shared=shared_inputs(study, training),
        )
        trainer.run()
    if trainer.interrupted:
        raise ModelError("interrupted; the same command continues it")
    network = build_network(training.config.model, len(study.robot.operated))
    card = GapModel.load(job.run_folder).card
    return {
        "block": training.block,
        "name": training.name,
        "seed": training.seed,
        "parameters": sum(parameter.numel() for parameter in network.parameters()),
        "obs_dim": training.config.model.observation_dim(len(study.robot.operated)),
        "steps": card["steps"],
        "seconds": card["seconds"],
        # Of a resumed training the time of the first part is not known.
        "cpu_s": None if resumed else round(time.process_time() - began, 1),
        "val_mpjae": card["val_mpjae"],
        "gain": card["gain"],
        "sensor_r2": card["sensor_r2"],
    }
