"""Checks: what a person must know about a dataset, judged from the surveys of its sequences.

A check takes the surveys and the robot and yields findings; where nothing is wrong it says so.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator

from gaponet.data.checks.finding import Finding
from gaponet.data.checks.motor import lag, sag, torque
from gaponet.data.checks.recording import (
    blocked,
    jumps,
    nonsense,
    rate,
    regularity,
    resolution,
    saturation,
    stuck,
)
from gaponet.data.checks.timing import timing
from gaponet.data.checks.wiring import command, copied, labels, limits, order, sign, unit
from gaponet.data.survey import Survey
from gaponet.robot import RobotSpec

CHECKS: tuple[Callable[[list[Survey], RobotSpec], Iterator[Finding]], ...] = (
    command, order, sign, copied, timing, unit, limits, rate, regularity, jumps, nonsense, blocked, saturation,
    resolution, stuck, lag, sag, torque, labels,
)  # fmt: skip
