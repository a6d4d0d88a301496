"""Finding: one line of the doctor's report."""

from __future__ import annotations

import json
from dataclasses import dataclass, field
from typing import Any

from gaponet.base.arrays import Array
from gaponet.robot.spec import RobotSpec

# ok; note, a fact to know; warning, usable but look first; error, do not train on it before it is mended.
LEVELS = ("ok", "note", "warning", "error")


Mend = dict[str, dict[str, Any]]  # table of logs.toml → joint → value


@dataclass(frozen=True)
class Finding:
    """`message` is for people and says what to do; `values` are the numbers in it, `mend` what logs.toml would say."""

    level: str
    check: str
    message: str
    joints: tuple[str, ...] = ()
    values: dict[str, Any] = field(default_factory=dict)
    mend: Mend = field(default_factory=dict)

    @staticmethod
    def proposal(findings: list[Finding]) -> str:
        """Lines to add to a logs.toml where the findings say how, and as comments what it cannot mend."""
        bad = [f for f in findings if f.level in ("warning", "error")]
        lines = [
            "# gaponet doctor --fix: a proposal, applied to nothing. Look it over, add it to the logs.toml of these "
            "logs,",
            "# import into a new folder and call the doctor again. Joints have the robot's names.",
            "",
        ]
        tables: Mend = {}
        for finding in bad:
            lines += [f"# {finding.level}, {finding.check}: {finding.message}"]
            for table, values in finding.mend.items():
                tables.setdefault(table, {}).update(values)
        for table, values in tables.items():
            lines += [
                "",
                f"[{table}]",
                *(f"{json.dumps(joint)} = {json.dumps(value)}" for joint, value in values.items()),
            ]
        if not bad:
            lines = ["# gaponet doctor --fix: nothing to mend."]
        return "\n".join(lines) + "\n"


def abbreviate(motions: list[str]) -> str:
    """Up to three names, each once, and how many more."""
    motions = list(dict.fromkeys(motions))
    return ", ".join(motions[:3]) + (f" and {len(motions) - 3} more" if len(motions) > 3 else "")


def masked_names(robot: RobotSpec, mask: Array) -> tuple[str, ...]:
    """Joint names where mask (n) is true."""
    return tuple(name for name, yes in zip(robot.joint_names, mask, strict=True) if yes)
