"""Doctor: examine a dataset, and report what a person must know before training on it."""

from __future__ import annotations

from collections import Counter
from concurrent.futures import Executor
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from gaponet.base.executor import LOCAL
from gaponet.base.progress import Progress, no_progress
from gaponet.data.checks import CHECKS, run_checks
from gaponet.data.checks.arrangement import arrangement
from gaponet.data.checks.gravity import gravity
from gaponet.data.checks.motor import fast_lags, lag_values, static_errors
from gaponet.data.checks.static_checks import feedforward, static_checks
from gaponet.data.checks.survey import Survey, survey_all
from gaponet.data.checks.wiring import driven_by_torque
from gaponet.data.offsets import Dynamics, Gravity
from gaponet.data.static_poses import StaticError
from gaponet.data.store import Dataset
from gaponet.robot.finding import LEVELS, Finding
from gaponet.robot.spec import RobotSpec


@dataclass(frozen=True)
class DoctorResult:
    """Problems of a dataset.

    Attributes:
        findings: Problems, the worst first.
        sequences, joints: One row of numbers per sequence and per joint.
    """

    findings: tuple[Finding, ...]
    sequences: tuple[dict[str, Any], ...]
    joints: tuple[dict[str, Any], ...]

    def count(self, level: str) -> int:
        """Return the number of findings of a level: error, warning or note."""
        return sum(finding.level == level for finding in self.findings)

    @property
    def verdict(self) -> str:
        """The result in one sentence."""
        errors = self.count("error")
        warnings = self.count("warning")
        if errors and warnings:
            problems = f"{_counted(errors, 'error')} and {_counted(warnings, 'warning')}"
            return f"Do not train on this yet: {problems}."
        if errors:
            return f"Do not train on this yet: {_counted(errors, 'error')}."
        if warnings:
            return f"Usable. Read the {_counted(warnings, 'warning').removeprefix('1 ')} first."
        return "Good: no error and no warning."

    def to_dict(self) -> dict[str, Any]:
        """Return the result as plain data."""
        return {"verdict": self.verdict} | asdict(self)

    @classmethod
    def of(
        cls,
        dataset: Dataset,
        robot: RobotSpec,
        *,
        gravity_model: Gravity | None = None,
        dynamics_model: Dynamics | None = None,
        progress: Progress = no_progress,
        executor: str | Executor = LOCAL,
    ) -> DoctorResult:
        """Examine every sequence, and judge them together.

        Args:
            gravity_model: Gravity of the nominal model, which shows wrong zeros, signs, gains and
                payload labels; these are not examined without it.
            dynamics_model: Inverse dynamics of the nominal model, which show joints under each
                other's names; likewise.

        Raises:
            DatasetError: The dataset is empty, damaged or another robot's.
        """
        dataset.require_robot(robot)
        dataset.require_sequences()
        surveys = survey_all(dataset, robot, progress, executor)
        findings = run_checks(CHECKS, surveys, robot)
        if gravity_model is not None:
            findings += _examine_loads(findings, surveys, robot, gravity_model, dynamics_model)
        findings.sort(key=lambda finding: -LEVELS.index(finding.level))
        rows = tuple(_sequence_row(survey, robot) for survey in surveys)
        return DoctorResult(tuple(findings), rows, tuple(_joint_rows(surveys, robot)))

    @staticmethod
    def inventory(dataset: Dataset) -> str:
        """Return the number of sequences, motions and minutes, and the units and payloads."""
        motions = len({entry.meta.motion for entry in dataset.entries})
        units = Counter(entry.meta.unit_id for entry in dataset.entries)
        payloads = sorted({entry.meta.payload_mass for entry in dataset.entries})
        virtual = sum(entry.meta.virtual for entry in dataset.entries)
        kind = f", {virtual} of them VIRTUAL" if virtual else ""
        return (
            f"{len(dataset)} recordings{kind}, {motions} motions, {dataset.hours() * 60:.1f} min; "
            f"units {', '.join(units)}; payloads {', '.join(f'{p:g}' for p in payloads)} kg"
        )


def _examine_loads(
    findings: list[Finding],
    surveys: list[Survey],
    robot: RobotSpec,
    model: Gravity,
    dynamics: Dynamics | None,
) -> list[Finding]:
    """Compare torques and static poses with gravity, unless another error would cause these
    findings too.
    """
    errors = [finding.check for finding in findings if finding.level == "error"]
    result = list[Finding]()
    if dynamics is not None and not errors:
        result += arrangement(surveys, robot, dynamics)
    if _warns(result):  # wrong names would cause findings of the others
        return result
    errors += [finding.check for finding in findings if "slope" in finding.values]
    if errors:
        text = (
            "zeros, offsets, gains and payloads are judged by gravity once this is mended: "
            f"{', '.join(dict.fromkeys(errors))}"
        )
        return [*result, Finding("ok", "gravity", text)]
    by_commands = () if driven_by_torque(surveys) else (feedforward, static_checks)
    for check in (gravity, *by_commands):
        result += check(surveys, robot, model)
        if _warns(result):  # it would cause findings of the next
            break
    return result


def _counted(count: int, word: str) -> str:
    return f"1 {word}" if count == 1 else f"{count} {word}s"


def _warns(findings: list[Finding]) -> bool:
    return any(finding.level == "warning" for finding in findings)


def _sequence_row(survey: Survey, robot: RobotSpec) -> dict[str, Any]:
    lags = {}  # joint → its lag, s
    for name, (lag,) in fast_lags([survey], robot).items():
        lags[name] = round(lag, 4)
    meta = survey.meta
    return {
        "motion": meta.motion,
        "unit": meta.unit_id,
        "payload_mass": meta.payload_mass,
        "repetition": meta.repetition,
        "rows": survey.entry.rows,
        "seconds": round(survey.entry.rows * survey.entry.dt, 2),
        "rate_hz": round(survey.timing.rate_hz, 2),
        "jitter_ms": survey.timing.jitter_ms,
        "longest_gap_ms": survey.timing.longest_gap_ms,
        "rows_are": meta.notes.get("rows", ""),
        "fast_lag_s": lags,
    }


def _joint_rows(surveys: list[Survey], robot: RobotSpec) -> list[dict[str, Any]]:
    lags = fast_lags(surveys, robot)
    errors = static_errors(surveys, robot)
    ctrl = np.array([survey.ctrl_limits for survey in surveys])  # (sequences, n, 2)
    qpos = np.array([survey.qpos_limits for survey in surveys])
    torques = [survey.torque for survey in surveys if survey.torque]
    rows = []
    for i, name in enumerate(robot.joint_names):
        row = {
            "joint": name,
            "operated": name in robot.operated,
            "commanded_rad": [float(ctrl[:, i, 0].min()), float(ctrl[:, i, 1].max())],
            "measured_rad": [float(qpos[:, i, 0].min()), float(qpos[:, i, 1].max())],
            "lag_s": lag_values(lags[name]) if name in lags else None,
            **_static_values(errors.get(name)),
            "torque_spikes": sum(int(torque.spikes[i]) for torque in torques),
        }
        rows.append(row)
    return rows


def _static_values(error: StaticError | None) -> dict[str, Any]:
    """Return static error and stiction of a joint, as far as they are known."""
    values: dict[str, Any] = {"static_error_rad": None, "stiction_band_rad": None, "rests": 0}
    if error is None:
        return values
    values["rests"] = error.up + error.down
    if np.isfinite(error.middle):
        values["static_error_rad"] = error.middle
    if error.balanced:
        values["stiction_band_rad"] = error.half_band
    return values
