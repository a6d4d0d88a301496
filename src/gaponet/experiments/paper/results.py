"""The result files of an experiment, read into arrays."""

from __future__ import annotations

from collections.abc import Sequence as ListOf
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from gaponet.base.arrays import Array
from gaponet.experiments.paper.jobs import Job
from gaponet.experiments.paper.measure import Recorded
from gaponet.experiments.paper.options import Block
from gaponet.experiments.paper.study import Study
from gaponet.experiments.paper.trainings import NETWORKS, block_title

WRIST = "wrist"  # the paper's Figure 3 and MPJAE are without wrists


@dataclass(frozen=True)
class Results:
    """What was measured.

    Attributes:
        baselines: Result of the job without a training, as `jobs.measure_baselines` writes it.
        trainings: Results of the finished trainings, as `jobs.train_and_measure` writes them.
    """

    study: Study
    baselines: dict[str, Any]
    trainings: list[dict[str, Any]]

    @classmethod
    def read(cls, study: Study, jobs: ListOf[Job]) -> Results:
        """Read the results of the jobs that are done."""
        baselines: dict[str, Any] = {}
        trainings = []
        for job in jobs:
            if not job.result_file.is_file():
                continue
            if job.training is None:
                baselines = job.result()
            else:
                trainings.append(job.result())
        return cls(study, baselines, trainings)

    # ---- what there is

    @property
    def simulators(self) -> dict[str, str]:
        """Simulator without a network in baselines.json (`jobs.measure_baselines`) → its heading in
        tables.
        """
        identified = "identification"
        if self.study.options.identifies_joints_alone:
            identified = "identification, each joint alone"
        return {"nominal": "nominal (raw)", "identified": identified}

    @property
    def motions(self) -> list[str]:
        """Motion of each recording."""
        return list(self.baselines["motions"])

    @cached_property
    def payloads(self) -> Array:
        """Payload of each recording, (recordings,) kg in each hand."""
        return np.array(self.baselines["payloads"], float)

    @cached_property
    def durations(self) -> Array:
        """Duration of each recording, (recordings,) s."""
        return np.array(self.baselines["durations_s"], float)

    @cached_property
    def fastest(self) -> Recorded:
        """The recordings at the fastest rate, in the order of "nominal_fastest"."""
        return self.study.recorded(self.study.rates[-1])

    @property
    def masses(self) -> list[float]:
        """Payloads, kg, ascending."""
        return sorted(set(self.payloads.tolist()))

    @cached_property
    def eight_joints(self) -> list[int]:
        """Columns of the operated joints without the wrists."""
        names = self.study.robot.operated
        return [column for column, name in enumerate(names) if WRIST not in name]

    def networks(self, block: Block) -> list[str]:
        """Return the methods of a block that have a finished training, in the order of NETWORKS."""
        done = {run["name"] for run in self.trainings if run["block"] == block}
        return [name for name in NETWORKS if name in done]

    def trained_by(self, block: Block) -> str:
        """Return how the networks of a block were trained."""
        return block_title(block, self.study.options)

    def runs(self, block: Block, name: str) -> list[dict[str, Any]]:
        """Return the finished trainings of a setting, by seed."""
        runs = [run for run in self.trainings if (run["block"], run["name"]) == (block, name)]
        return sorted(runs, key=lambda run: int(run["seed"]))

    def seeds(self, block: Block, name: str) -> list[int]:
        """Return the seeds of the finished trainings of a setting, in the order of `runs`."""
        return [int(run["seed"]) for run in self.runs(block, name)]

    # ---- errors, by recording

    def baseline_q_dis(self, name: str) -> Array:
        """Q_dis of a simulator without network: nominal or identified, (recordings, n) rad·s."""
        return np.array(self.baselines[name]["alignment"]["q_dis"])

    def q_dis(self, block: Block, name: str) -> list[Array]:
        """Q_dis of the simulator with a network, for each seed, (recordings, n) rad·s."""
        return [np.array(run["alignment"]["q_dis"]) for run in self.runs(block, name)]

    def plain_command_q_dis(self, way: str, simulator: str = "nominal") -> Array:
        """Q_dis between target and robot without a network, (recordings, n) rad·s."""
        return np.array(self.baselines[simulator]["commands"][way])

    def command_q_dis(self, block: Block, name: str, way: str) -> list[Array]:
        """Q_dis between target and robot with a network, for each seed, (recordings, n) rad·s."""
        return [np.array(run["commands"][way]) for run in self.runs(block, name)]

    def plain_offsets(self, way: str) -> Array:
        """Offsets of the hands without a network, (payloads, goals, 3) m."""
        return np.array(self.baselines["nominal"]["delivery"][way]["offset"])

    def offsets(self, block: Block, name: str, way: str) -> list[Array]:
        """Offsets of the hands with a network, for each seed, (payloads, goals, 3) m."""
        return [np.array(run["delivery"][way]["offset"]) for run in self.runs(block, name)]

    def over_joints(self, q_dis: Array) -> Array:
        """Mean over the eight joints: (recordings, n) → (recordings,) rad·s."""
        return np.asarray(q_dis[:, self.eight_joints].mean(axis=1))

    def mean_over_joints(self, q_dis: Array) -> float:
        """Mean over the eight joints and all recordings, (recordings, n) → rad·s."""
        return float(self.over_joints(q_dis).mean())
