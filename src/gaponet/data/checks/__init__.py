"""Checks of a dataset, judged from the surveys of its sequences.

A check takes the surveys and the robot, and yields findings; if it yields none, its finding is
`ok_message`. CHECKS are run on every dataset; the gravity and static checks need a gravity model
too (data.doctor). A new check is a function and a row of CHECKS in one of the modules, and a
measurement in data.checks.survey where none there serves.
"""

from __future__ import annotations

from collections.abc import Iterable

from gaponet.data.checks import completeness, motor, timing, wiring
from gaponet.data.checks.check import Check
from gaponet.data.checks.survey import Survey
from gaponet.robot.finding import Finding
from gaponet.robot.spec import RobotSpec

CHECKS: tuple[Check, ...] = (*wiring.CHECKS, *timing.CHECKS, *completeness.CHECKS, *motor.CHECKS)
WRONG_JOINT_CHECKS = ("order", "sign", "unit")  # errors name exchanged, mirrored, scaled joints
CONSEQUENCES = ("blocked", "stuck", "sag")  # checks that such a joint fails too


def run_checks(checks: Iterable[Check], surveys: list[Survey], robot: RobotSpec) -> list[Finding]:
    """Return the findings of checks, without those that an exchanged, mirrored or mis-scaled joint
    explains.
    """
    findings = list[Finding]()
    by_torque = wiring.driven_by_torque(surveys)
    for check in checks:
        if by_torque and check.needs_commands:
            continue
        findings += check.run(surveys, robot)
    wrong_joints = set[str]()
    for finding in findings:
        if finding.level == "error" and finding.check in WRONG_JOINT_CHECKS:
            wrong_joints |= set(finding.joints)
    return [f for f in findings if not _is_consequence(f, wrong_joints)]


def _is_consequence(finding: Finding, wrong_joints: set[str]) -> bool:
    """True if all joints of a finding are known to be wrong, and that explains it."""
    if finding.check not in CONSEQUENCES or not finding.joints:
        return False
    return set(finding.joints) <= wrong_joints
