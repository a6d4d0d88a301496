"""Is the log what it says: order, sign, unit and range of its joints, and its labels?"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator

import numpy as np

from gaponet.base.arrays import Array
from gaponet.data.survey import Survey
from gaponet.robot.finding import Finding, abbreviate
from gaponet.robot.spec import RobotSpec

SCALE = (0.5, 1.25)  # a loaded joint falls short of its commands, and beyond them where its load stands on it
OWN, OTHER, SEVERAL = 0.8, 0.95, 3  # correlations with the own joint and another's, and the motions to tell it
APART, ALIKE = 0.7, 0.7  # of the state's own spread from its command; correlation with what else a command may be
MOVED = 0.05  # a joint commanded over less says nothing about order, sign and unit, rad


def _order(surveys: list[Survey], robot: RobotSpec) -> Iterator[Finding]:
    """Does each command move its own joint?"""
    guilty: dict[tuple[int, int], list[float]] = defaultdict(list)
    asked = np.zeros(len(robot.joint_names), int)
    for s in surveys:
        moved = s.ctrl_range > MOVED
        asked += moved
        for i in np.flatnonzero(moved & (np.diag(s.follows) < 0.3) & (np.diag(s.opposes) < 0.6)):
            others = np.flatnonzero((s.follows[i] > 0.6) & ((s.ctrl_range < 0.02) | (s.follows[:, i] > 0.6)))
            if others.size:
                j = int(others[s.follows[i, others].argmax()])
                guilty[int(i), j].append(float(s.follows[i, j]))
    guilty |= _together(surveys, asked)
    swapped = {pair: found for pair, found in guilty.items() if 2 * len(found) >= asked[pair[0]]}
    for (own, other), found in swapped.items():
        a, b = robot.joint_names[own], robot.joint_names[other]
        text = (
            f"the command of {a} moves {b}, not {a} (correlation {np.median(found):.2f}, {len(found)} of {asked[own]} "
            "motions): names are swapped; import again with --map NAME_IN_LOG=NAME_OF_ROBOT"
        )
        yield Finding("error", "order", text, (a, b))
    idle = tuple(name for name, count in zip(robot.joint_names, asked, strict=True) if not count)
    if idle:
        level = "warning" if set(idle) & set(robot.operated) else "note"
        text = f"no motion commands {abbreviate(list(idle))} over more than {MOVED:g} rad: nothing can be learned there"
        yield Finding(level, "order", text, idle)
    if not swapped:
        yield Finding("ok", "order", "each command moves the joint of its name")


def _together(surveys: list[Survey], asked: Array) -> dict[tuple[int, int], list[float]]:
    """Pairs in each other's place, told over several motions: in one, joints that move together look alike."""
    follows = np.array([s.follows for s in surveys])  # (sequences, n, n)
    own = np.median(np.diagonal(follows, axis1=1, axis2=2), axis=0)
    cross = np.median(follows, axis=0)
    found = {}
    for i in np.flatnonzero((asked >= SEVERAL) & (own < OWN)):
        j = int(cross[i].argmax())
        if j != i and min(cross[i, j], cross[j, i]) > OTHER and own[j] < OWN:
            found[int(i), j] = follows[follows[:, i, j] > OTHER, i, j].tolist()
    return found


def _command(surveys: list[Survey], robot: RobotSpec) -> Iterator[Finding]:
    """Are the commands positions?"""
    column = lambda field: np.stack([getattr(s, field) for s in surveys])[:, robot.operated_index]  # noqa: E731
    beside = column("beside")
    judged = np.isfinite(beside) & (np.stack([s.ctrl_range for s in surveys])[:, robot.operated_index] > 0)
    if not judged.any() or float(np.median(beside[judged])) < APART:
        yield Finding("ok", "command", "commands are positions that the joints come near")
        return
    like = {
        what: float(np.median(column(f)[judged]))
        for what, f in (("velocities", "as_velocity"), ("torques", "as_torque"))
    }
    best = max(like, key=lambda what: np.nan_to_num(like[what]))
    what = f"they are most like {best} (correlation {like[best]:.2f})" if like[best] > ALIKE else "are they torques?"
    text = (
        f"states are {np.median(beside[judged]):.2f} times as far from their commands as from their own mean: these "
        f"are no position targets; {what}. Log the targets of the position controller"
    )
    yield Finding("error", "command", text, (), like)


def _sign(surveys: list[Survey], robot: RobotSpec) -> Iterator[Finding]:
    """Does each joint move the way it is told?"""
    wrong = []
    for i, name in enumerate(robot.joint_names):
        asked = [s for s in surveys if s.ctrl_range[i] > MOVED]
        against = [s for s in asked if s.opposes[i, i] > 0.6 and s.follows[i, i] < 0.3]
        if against and 2 * len(against) >= len(asked):
            wrong.append(name)
            text = (
                f"{name} moves against its command in {len(against)} of {len(asked)} motions: command and state have "
                "opposite signs; negate one of them and import again"
            )
            yield Finding("error", "sign", text, (name,))
    if not wrong:
        yield Finding("ok", "sign", "no joint moves against its command")


def _copied(surveys: list[Survey], robot: RobotSpec) -> Iterator[Finding]:
    """Are command and state two signals, and does the command come first?"""
    found, copies = [], {}
    for i, name in enumerate(robot.joint_names):
        asked = [s for s in surveys if s.ctrl_range[i] > MOVED]
        same = [s for s in asked if s.copied[i]]
        first = [s for s in asked if np.isfinite(s.lead[i])]
        if same:
            copies[name] = [s.motion for s in same]
        elif len(first) > 0.5 * len(asked):
            lead = float(np.median([s.lead[i] for s in first]))
            text = (
                f"{name} moves {lead * 1e3:.0f} ms before its command in {len(first)} of {len(asked)} motions: are "
                "command and state swapped, or their clocks apart?"
            )
            found.append(Finding("error", "copied", text, (name,), {"lead_s": lead}))
    if copies:
        where = [motion for motions in copies.values() for motion in motions]
        text = (
            f"command and state of {abbreviate(list(copies))} are the same numbers in {abbreviate(where)}: one was "
            "logged as both; "
            "log the command that the servo was sent"
        )
        found.append(Finding("error", "copied", text, tuple(copies)))
    yield from found or [Finding("ok", "copied", "commands come before states")]


def _unit(surveys: list[Survey], robot: RobotSpec) -> Iterator[Finding]:
    """Are commands, positions and velocities in the same unit, and is it the radian?"""
    wrong = []
    for i, name in enumerate(robot.joint_names):
        asked = [s.qpos_range[i] / s.ctrl_range[i] for s in surveys if s.ctrl_range[i] > MOVED]
        ratio = float(np.median(asked)) if asked else 1.0
        if ratio > 10 or 0 < ratio < 0.03:  # between 0.03 and 0.1 it may as well be stuck
            text = (
                f"{name} moves {ratio:.3g} times as far as commanded (57.3 and 0.0175 are degrees beside radians): "
                "import again with the right units"
            )
            wrong.append(Finding("error", "unit", text, (name,), {"ratio": ratio}))
        slopes = [s.slope[i] for s in surveys if np.isfinite(s.slope[i])]
        slope = float(np.median(slopes)) if slopes else 1.0
        if not wrong and (slope > SCALE[1] or 0.1 < slope < SCALE[0]):
            text = (
                f"{name} goes {slope:.2f} rad where its command goes 1 rad: another scale (a gear, a range, ticks a "
                "turn), or a motor that does not reach its targets; check both at a right angle"
            )
            wrong.append(Finding("warning", "unit", text, (name,), {"slope": slope}))
        gains = [s.qvel_gain[i] for s in surveys if np.isfinite(s.qvel_gain[i]) and s.qpos_range[i] > 20 * s.step[i]]
        gain = float(np.median(gains)) if gains else 1.0
        if not 0.5 < gain < 2:
            text = (
                f"recorded velocity of {name} is {gain:.3g} times the derivative of its position: not rad/s; leave the "
                "velocity out at import, it is then computed"
            )
            wrong.append(Finding("warning", "unit", text, (name,), {"ratio": gain}))
    widest = max(float(s.ctrl_range.max()) for s in surveys)
    if widest < 0.12:
        wrong.append(
            Finding("warning", "unit", f"no command spans more than {widest:.3f} rad: were radians read as degrees?")
        )
    yield from _converted(surveys, robot)
    yield from wrong or [Finding("ok", "unit", "commands, positions and velocities agree in unit")]


def _converted(surveys: list[Survey], robot: RobotSpec) -> Iterator[Finding]:
    odd: dict[str, str] = {}
    for s in surveys:
        odd |= s.entry.meta.notes.get("converted_from", {})
    degrees = tuple(name for name, was in odd.items() if was == "deg")
    if degrees:
        yield Finding("note", "unit", f"logged in degrees, converted: {', '.join(degrees)}", degrees)
    for name, was in odd.items():
        if was == "fraction":
            low, high = robot.qpos_range[robot.joint_names.index(name)]
            text = (
                f"{name} is logged as 0..1, not in rad: mapped to its range [{low:.2f}, {high:.2f}], velocity computed"
            )
            yield Finding("note", "unit", text, (name,))


def _limits(surveys: list[Survey], robot: RobotSpec) -> Iterator[Finding]:
    """Do commands and positions stay in the joint ranges of the MJCF?"""
    found = []
    for i, name in enumerate(robot.joint_names):
        low, high = robot.qpos_range[i]
        for what, level, slack, ends in (
            ("commanded", "warning", 0.01, [s.ctrl_limits[i] for s in surveys]),
            ("measured", "note", 0.05, [s.qpos_limits[i] for s in surveys]),
        ):
            beyond = np.array([max(low - a, b - high) for a, b in ends])
            if (beyond > slack).any():
                clips = ", and the simulator clips there" if what == "commanded" else ""
                text = (
                    f"{name} is {what} up to {beyond.max():.3f} rad beyond [{low:.2f}, {high:.2f}] in "
                    f"{(beyond > slack).sum()} sequence(s), worst {surveys[int(beyond.argmax())].motion}{clips}: check "
                    "its zero, or its range in robot.xml"
                )
                found.append(Finding(level, "range", text, (name,), {"beyond_rad": float(beyond.max())}))
    yield from found or [Finding("ok", "range", "commands and positions stay inside the joint ranges")]


def _labels(surveys: list[Survey], robot: RobotSpec) -> Iterator[Finding]:
    """Is one recording filed under two payloads or units?"""
    seen: dict[str, list[str]] = defaultdict(list)
    for s in surveys:
        seen[s.samples].append(s.entry.id)
    found = [
        Finding("error", "labels", f"same samples under different labels: {', '.join(ids)}; remove the wrong one")
        for ids in seen.values()
        if len(ids) > 1
    ]
    yield from found or [Finding("ok", "labels", "no recording is filed twice")]


CHECKS = (_command, _order, _sign, _copied, _unit, _limits, _labels)
