"""Gate: nothing is learned from recordings in which the doctor finds an error, unless a person
insists.

identify, adapt and train pass it before they fit; `gaponet start` and the page stop at the same
findings of the whole doctor. Nothing is stored: the recordings are examined each time, since they
may have changed.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from collections.abc import Sequence as ListOf
from dataclasses import dataclass

from gaponet.base.errors import DatasetError
from gaponet.base.progress import Progress, no_progress
from gaponet.data.checks import CHECKS, run_checks
from gaponet.data.checks.check import Check
from gaponet.data.checks.survey import Survey
from gaponet.data.store import Dataset, Entry
from gaponet.robot.finding import Finding, errors_of
from gaponet.robot.spec import RobotSpec

ERROR_CHECKS: tuple[Check, ...] = tuple(check for check in CHECKS if check.may_be_error)
# Checks of a robot that is driven by torque: its commands are copies of the measured positions.
TORQUE_DRIVEN_CHECKS: tuple[Check, ...] = tuple(
    check for check in ERROR_CHECKS if check.name in ("unit", "labels")
)


WAY_OUT = (
    "Correct the logs and import them into a new folder; gaponet doctor DATASET --fix proposes "
    "lines for logs.toml"
)


@dataclass(frozen=True)
class GateReport:
    """What the gate found in the recordings of a result.

    Attributes:
        errors: Findings despite which a person went on; empty otherwise.
        warnings: Findings that a person should know of.
    """

    errors: tuple[Finding, ...] = ()
    warnings: tuple[Finding, ...] = ()

    @property
    def findings(self) -> tuple[Finding, ...]:
        """Errors, then warnings."""
        return self.errors + self.warnings

    def to_dict(self) -> dict[str, tuple[str, ...]]:
        """Return the report as plain data: a sentence per finding."""
        return {
            "despite_errors": tuple(_sentence(f) for f in self.errors),
            "warnings": tuple(_sentence(f) for f in self.warnings),
        }


def used_recordings(dataset: Dataset, splits: Mapping[str, ListOf[Entry]]) -> list[Entry]:
    """Return all recordings of the units that train or validate.

    Their test motions count, so that the gate judges what the doctor judges; a unit that is held
    out does not.
    """
    units = {entry.meta.unit_id for entry in (*splits["train"], *splits["val"])}
    return [entry for entry in dataset.entries if entry.meta.unit_id in units]


def pass_gate(
    dataset: Dataset,
    entries: ListOf[Entry],
    robot: RobotSpec,
    *,
    despite_errors: bool = False,
    checks: ListOf[Check] = ERROR_CHECKS,
    place: str = "",
    progress: Progress = no_progress,
) -> GateReport:
    """Examine the recordings that something is to be learned from, and refuse those with errors.

    Only checks that may yield errors are run. It takes about as long as to read the recordings.

    Args:
        entries: Recordings of the dataset, at least one.
        despite_errors: Return the errors instead of refusing.
        place: What a person calls the recordings; default the dataset's place.

    Raises:
        DatasetError: The doctor finds an error.
    """
    surveys = list[Survey]()
    for entry in entries:
        surveys.append(Survey.of(entry, dataset.read(entry), robot))
        progress(len(surveys), len(entries), f"checking {entry.meta.motion}")
    findings = run_checks(checks, surveys, robot)
    errors = errors_of(findings)
    if not despite_errors:
        refuse_errors(errors, place or str(dataset.path))
    warnings = tuple(f for f in findings if f.level == "warning")
    return GateReport(errors, warnings)


def refuse_errors(findings: Iterable[Finding], place: str, way_out: str = WAY_OUT) -> None:
    """Refuse findings among which is an error.

    Args:
        findings: Of the doctor, of any level.
        place: Dataset that they are about.
        way_out: How to correct them.

    Raises:
        DatasetError: With the first error and the way out.
    """
    errors = errors_of(findings)
    if not errors:
        return
    others = [f.check for f in errors[1:]]
    more = f" Other errors: {', '.join(dict.fromkeys(others))}." if others else ""
    raise DatasetError(
        f"{place}: stopped at what the doctor calls an error, {_sentence(errors[0])}.{more} "
        f"{way_out}. To go on all the same: --despite-errors (Python: despite_errors=True)"
    )


def _sentence(finding: Finding) -> str:
    return f"{finding.check}: {finding.message}"
