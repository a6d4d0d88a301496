"""Doctor: looks through a dataset and says what a person must know before training on it."""

from __future__ import annotations

from collections import Counter
from concurrent.futures import Executor
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from gaponet.base.errors import DatasetError
from gaponet.base.executor import LOCAL
from gaponet.base.progress import Progress, no_progress
from gaponet.data.checks import CHECKS
from gaponet.data.checks.gravity import gravity
from gaponet.data.checks.looked import Looked
from gaponet.data.checks.motor import fast_lags, lag_values, static_errors
from gaponet.data.checks.rests import rests
from gaponet.data.checks.touching import Heights, touching
from gaponet.data.offsets import Gravity
from gaponet.data.store import Dataset
from gaponet.data.survey import Survey
from gaponet.robot.finding import LEVELS, Finding
from gaponet.robot.spec import RobotSpec


@dataclass(frozen=True)
class Diagnosis:
    """What was found in a dataset.

    Attributes:
        findings: What to look at, worst first.
        sequences, joints: One row of numbers each, for tables.
    """

    findings: list[Finding]
    sequences: list[dict[str, Any]]
    joints: list[dict[str, Any]]

    def count(self, level: str) -> int:
        """Findings of a level."""
        return sum(f.level == level for f in self.findings)

    @property
    def verdict(self) -> str:
        """The verdict in one sentence."""
        errors, warnings = self.count("error"), self.count("warning")
        if errors:
            return f"Do not train on this yet: {errors} error(s) and {warnings} warning(s)."
        if warnings:
            return f"Usable. Read the {warnings} warning(s) first."
        return "Good: nothing found that training should not see."

    def as_dict(self) -> dict[str, Any]:
        """The diagnosis as a dictionary that JSON can hold."""
        return {"verdict": self.verdict} | asdict(self)

    @classmethod
    def of(
        cls,
        dataset: Dataset,
        robot: RobotSpec,
        progress: Progress = no_progress,
        model: Gravity | None = None,
        heights: Heights | None = None,
        simulator: str = "",
        executor: str | Executor = LOCAL,
    ) -> Diagnosis:
        """Survey every sequence that was not yet, and judge them together; what each has is kept (checks.looked).

        Args:
            robot: The dataset's robot.
            model: Gravity of the nominal model, to tell wrong zeros and signs from torques; default: not looked for.
            heights: Lowest tip in postures, m, to tell motions that press on something; needs `model`.
            simulator: Hash of the model that both are of.
            executor: Where much that is new is looked at; default: on this machine's cores.
        """
        dataset.require_robot(robot)
        if not dataset.entries:
            raise DatasetError(f"{dataset.path}: holds no sequences yet; import or collect some")
        looked = Looked(dataset, robot, model, heights, simulator)
        surveys = looked.surveys(progress, executor)
        findings = [f for check in CHECKS for f in check(surveys, robot)]
        if model is not None:
            findings += _weighed(findings, surveys, robot, model)
        findings += touching(looked.sample, looked.standing)
        findings.sort(key=lambda f: -LEVELS.index(f.level))
        return Diagnosis(findings, [_sequence_row(s, robot) for s in surveys], _joint_rows(surveys, robot))

    @staticmethod
    def inventory(dataset: Dataset) -> str:
        """How much there is, of which units and payloads."""
        motions = len({e.meta.motion for e in dataset.entries})
        units = Counter(e.meta.unit_id for e in dataset.entries)
        payloads = sorted({e.meta.payload_mass for e in dataset.entries})
        virtual = sum(e.meta.virtual for e in dataset.entries)
        kind = f", {virtual} of them VIRTUAL" if virtual else ""
        return (
            f"{len(dataset)} sequences{kind}, {motions} motions, {dataset.hours() * 60:.1f} min; "
            f"units {', '.join(units)}; payloads {', '.join(f'{p:g}' for p in payloads)} kg"
        )


def _weighed(findings: list[Finding], surveys: list[Survey], robot: RobotSpec, model: Gravity) -> list[Finding]:
    """What gravity says, where nothing is wrong that it would only say in other words."""
    wrong = [f.check for f in findings if f.level == "error" or "slope" in f.values]
    if wrong:
        text = f"zeros, offsets, gains and payloads are judged by gravity once this is mended: {', '.join(set(wrong))}"
        return [Finding("ok", "gravity", text)]
    found = [*gravity(surveys, robot, model)]
    return found if any(f.level == "warning" for f in found) else [*found, *rests(surveys, robot, model)]


def _sequence_row(s: Survey, robot: RobotSpec) -> dict[str, Any]:
    lags = {name: round(x[0], 4) for name, x in fast_lags([s], robot).items()}
    meta = s.entry.meta
    return {
        "motion": meta.motion, "unit": meta.unit_id, "payload_mass": meta.payload_mass, "repetition": meta.repetition,
        "rows": s.entry.rows, "seconds": round(s.entry.rows * s.entry.dt, 2), "rate_hz": round(s.rate_hz, 2),
        "jitter_ms": s.jitter_ms, "longest_gap_ms": s.longest_gap_ms, "rows_are": meta.notes.get("rows", ""),
        "fast_lag_s": lags,
    }  # fmt: skip


def _joint_rows(surveys: list[Survey], robot: RobotSpec) -> list[dict[str, Any]]:
    lags, errors = fast_lags(surveys, robot), static_errors(surveys, robot)
    ctrl = np.array([s.ctrl_limits for s in surveys])  # (sequences, n, 2)
    qpos = np.array([s.qpos_limits for s in surveys])
    rows = []
    for i, name in enumerate(robot.joint_names):
        rest = errors.get(name)
        rows.append({
            "joint": name,
            "operated": name in robot.operated,
            "commanded_rad": [float(ctrl[:, i, 0].min()), float(ctrl[:, i, 1].max())],
            "measured_rad": [float(qpos[:, i, 0].min()), float(qpos[:, i, 1].max())],
            "lag_s": lag_values(lags[name]) if name in lags else None,
            "static_error_rad": rest.middle if rest and np.isfinite(rest.middle) else None,
            "stiction_band_rad": rest.half_band if rest and rest.balanced else None,
            "rests": rest.up + rest.down if rest else 0,
            "torque_spikes": sum(int(s.torque.spikes[i]) for s in surveys if s.torque),
        })  # fmt: skip
    return rows
