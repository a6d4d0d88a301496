"""Check: one test of a dataset."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import NamedTuple

from gaponet.data.checks.survey import Survey
from gaponet.robot.finding import Finding
from gaponet.robot.spec import RobotSpec


class Check(NamedTuple):
    """A function that yields findings of surveys, and the finding that stands for none."""

    function: Callable[[list[Survey], RobotSpec], Iterator[Finding]]
    name: str  # of the finding that stands for none; others may have another
    ok_message: str  # of that finding; "" if the function always yields one
    may_be_error: bool = False  # only such a check may yield errors; the gate runs no others
    needs_commands: bool = False  # not run where a robot is driven by torque

    def run(self, surveys: list[Survey], robot: RobotSpec) -> list[Finding]:
        """Return the findings, at least one."""
        return [*self.function(surveys, robot)] or [Finding("ok", self.name, self.ok_message)]
