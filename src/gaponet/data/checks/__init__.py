"""Checks: what a person must know about a dataset, judged from the surveys of its sequences.

A check takes the surveys and the robot and yields findings; where nothing is wrong it says so. CHECKS of each file are
asked of every dataset; gravity, rests and touching need more (data/doctor.py).
"""

from __future__ import annotations

from collections.abc import Callable, Iterator

from gaponet.data.checks import motor, recording, timing, wiring
from gaponet.data.survey import Survey
from gaponet.robot.finding import Finding
from gaponet.robot.spec import RobotSpec

CHECKS: tuple[Callable[[list[Survey], RobotSpec], Iterator[Finding]], ...] = (
    *wiring.CHECKS, *timing.CHECKS, *recording.CHECKS, *motor.CHECKS,
)  # fmt: skip
