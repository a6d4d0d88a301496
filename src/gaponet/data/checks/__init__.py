"""Checks of a dataset, judged from the surveys of its sequences.

A check takes the surveys and the robot, and yields findings; if it yields none, its finding is `ok_message`. CHECKS are
run on every dataset. The gravity and static checks need a gravity model too (data.doctor).
"""

from __future__ import annotations

from gaponet.data.checks import completeness, motor, timing, wiring
from gaponet.data.checks.check import Check

CHECKS: tuple[Check, ...] = (*wiring.CHECKS, *timing.CHECKS, *completeness.CHECKS, *motor.CHECKS)
