"""What a run tells its user: the plan, notes, changes of phase, and the commands of a dry run.

The texts are made here, once. A `RunReporter` shows them; the command line has its own, with tables
and colours.
"""

from __future__ import annotations

import sys
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from gaponet.base.text import escape
from gaponet.hw.control.driver import Driver
from gaponet.hw.control.plan import NO_MOVEMENT, Plan
from gaponet.hw.control.recording import Event as Event
from gaponet.robot.spec import RobotSpec

COLUMNS = ("moves", "found, rad", "begins", "lowest", "highest", "ends")
ENDS = {  # by Driver.at_end
    "hand_over": "handed over to the robot's own controller",
    "hold": "held",
    "damp": "damped, then let go",
}


@dataclass(frozen=True)
class PlanText:
    """A plan in words.

    Attributes:
        title: Motion and duration.
        columns: Heads of the table.
        rows: One for each joint that moves; angles in rad.
        sentences: What else matters: what is held, clearances, limits, torque, the end.
    """

    title: str
    columns: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]
    sentences: tuple[str, ...]

    def __str__(self) -> str:
        """Return title, table and sentences, one a line."""
        cells = [self.columns, *self.rows]
        widths = [max(map(len, column)) for column in zip(*cells, strict=True)]
        lines = [self.title]
        for first, *numbers in cells:
            columns = [text.rjust(width) for text, width in zip(numbers, widths[1:], strict=True)]
            lines.append("  ".join([f" {first.ljust(widths[0])}", *columns]))
        lines += [f"  {sentence}" for sentence in self.sentences]
        return "\n".join(lines)


class RunReporter(Protocol):
    """Shows what happens in a run.

    Texts may hold names that strangers chose: escape them before a terminal.
    """

    def plan(self, text: PlanText) -> None:
        """Show the plan; the question for consent follows."""

    def note(self, text: str) -> None:
        """Show a sentence."""

    def event(self, event: Event) -> None:
        """Show a change of phase."""


class StderrReporter:
    """Writes everything to standard error, where the question for consent is asked too."""

    def plan(self, text: PlanText) -> None:
        for line in str(text).splitlines():
            self.note(line)

    def note(self, text: str) -> None:
        print(escape(text), file=sys.stderr, flush=True)

    def event(self, event: Event) -> None:
        self.note(f"{event.phase:>9}  {event_text(event)}")


def event_text(event: Event) -> str:
    """Return the text of an event, behind its kind if it has one."""
    return f"{event.kind}: {event.text}" if event.kind else event.text


def describe_plan(plan: Plan, robot: RobotSpec, driver: Driver, heaviest: float) -> PlanText:
    """Describe a plan with a motion: what moves from where to where, what is held, clearances, and
    how it ends.

    Args:
        robot: Whose limits and shapes hold.
        driver: The connected robot.
        heaviest: Payload for which the plan is feasible, kg in each hand.
    """
    assert plan.motion is not None
    postures = plan.rows
    spans = np.ptp(postures, axis=0)
    moving = [joint for joint, name in enumerate(robot.joint_names) if spans[joint] > NO_MOVEMENT]
    rows = []
    for joint in moving:
        path = postures[:, joint]
        angles = (plan.start[joint], plan.motion.ctrl[0, joint], path.min(), path.max(), path[-1])
        rows.append((robot.joint_names[joint], *(f"{angle:.2f}" for angle in angles)))
    approach = f"of which {plan.approach.duration:.1f} to where it begins"
    moves = {robot.joint_names[joint] for joint in moving}
    held = [name for name in driver.commanded if name not in moves]
    sentences = [
        *_movement(plan, held),
        *_clearances(plan),
        f"limits and collision shapes: {robot.folder}",
        _torque(plan, heaviest),
        *_source(driver),
        _end(plan, driver),
    ]
    return PlanText(
        title=f"Plan: {plan.motion.name}, {plan.duration:.1f} s, {approach}",
        columns=COLUMNS,
        rows=tuple(rows),
        sentences=tuple(sentences),
    )


def _movement(plan: Plan, held: list[str]) -> list[str]:
    """Return what is held, how the motion was changed, and the detour."""
    sentences = []
    if held:
        sentences.append(f"held where found: {', '.join(held)}")
    if plan.changed:
        sentences.append(f"the motion is {plan.changed}, to keep within limits")
    stops = len(plan.approach.points) - 2
    if stops:
        sentences.append(f"it goes around what is in between ({stops} stops)")
    return sentences


def _clearances(plan: Plan) -> list[str]:
    """Return the clearance of the targets, and that of the commands if they are corrected."""
    sentences = []
    if np.isfinite(plan.clearance):
        sentences.append(f"nearest to each other: {plan.nearest}, {100 * plan.clearance:.1f} cm")
    else:
        sentences.append("nobody looks whether it meets itself or what it stands on")
    if plan.corrected_joint:
        sentences.append(
            f"commands lead their targets by at most {plan.correction:.2f} rad "
            f"({plan.corrected_joint}); nearest to each other: {100 * plan.command_clearance:.1f} "
            "cm"
        )
    return sentences


def _torque(plan: Plan, heaviest: float) -> str:
    load = "with nothing in the hands (--payload-mass)"
    if heaviest:
        load = f"with up to {heaviest:g} kg in each hand"
    return f"most torque, {load}: {plan.joint}, {plan.torque:.2f} of what may be used"


def _source(driver: Driver) -> list[str]:
    """Return whose states are read, where the driver knows it."""
    source = driver.facts.get("source")
    return [f"states come from {source}"] if source else []


def _end(plan: Plan, driver: Driver) -> str:
    back = "goes back to where it was found and is " if plan.retreat else "is "
    return f"at the end it {back}{ENDS[driver.at_end]}; a stop {driver.at_stop} it"
