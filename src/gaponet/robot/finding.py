"""Findings of checks of recordings and robots."""

from __future__ import annotations

import json
from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import Any

from gaponet.base.arrays import Array
from gaponet.base.text import escape
from gaponet.robot.spec import RobotSpec

# note: a fact; warning: usable after a look; error: correct it before training.
LEVELS = ("ok", "note", "warning", "error")
Mend = dict[str, dict[str, Any]]  # table of logs.toml → joint → corrected value


@dataclass(frozen=True)
class Finding:
    """One line of the doctor's report."""

    level: str  # one of LEVELS
    check: str
    message: str  # states the problem and what to do
    joints: tuple[str, ...] = ()
    values: dict[str, Any] = field(default_factory=dict)  # numbers of the message
    mend: Mend = field(default_factory=dict)  # corrections for logs.toml

    @staticmethod
    def proposal(findings: list[Finding]) -> str:
        """Return lines for logs.toml, with the findings that they correct as comments, and the
        names of the others.
        """
        bad = [f for f in findings if f.level in ("warning", "error")]
        if not bad:
            return "# gaponet doctor --fix: nothing to mend.\n"
        lines = [
            "# gaponet doctor --fix: a proposal, applied to nothing. Check it, add it to the "
            "logs.toml of these logs,",
            "# import into a new folder and call the doctor again. Joints have the robot's names.",
            "",
        ]
        tables: Mend = {}
        for finding in bad:
            if finding.mend:
                lines.append(f"# {finding.level}, {finding.check}: {escape(finding.message)}")
            for table, values in finding.mend.items():
                tables.setdefault(table, {}).update(values)
        for table, values in tables.items():
            lines += ["", f"[{table}]"]
            for joint, value in values.items():
                lines.append(f"{json.dumps(joint)} = {json.dumps(value)}")
        other = ", ".join(dict.fromkeys(f.check for f in bad if not f.mend))
        if other:
            unmended = f"# No line is known that mends: {other}. Do what the findings say."
            lines = [*lines, "", unmended] if tables else [unmended]
        return "\n".join(lines) + "\n"


def errors_of(findings: Iterable[Finding]) -> tuple[Finding, ...]:
    """Return the findings that must be corrected before anything is learned from the recordings."""
    return tuple(f for f in findings if f.level == "error")


def abbreviate(names: list[str]) -> str:
    """List up to three different names and count the others."""
    names = list(dict.fromkeys(names))
    return ", ".join(names[:3]) + (f" and {len(names) - 3} more" if len(names) > 3 else "")


def masked_names(robot: RobotSpec, mask: Array) -> tuple[str, ...]:
    """Return the joint names where mask (n) is true."""
    named = zip(robot.joint_names, mask, strict=True)
    return tuple(name for name, is_selected in named if is_selected)
