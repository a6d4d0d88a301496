"""Do the logs mean what they say: order, sign, unit and range of their joints, and their labels?"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator
from itertools import chain

import numpy as np

from gaponet.base.arrays import Array
from gaponet.data.checks.check import Check
from gaponet.data.checks.survey import Survey, Tracking
from gaponet.robot.finding import Finding, abbreviate
from gaponet.robot.spec import RobotSpec

MIN_COMMAND_RAD = 0.05  # a joint with a smaller command range shows neither order, sign nor unit
# a loaded joint falls short of its command, or passes it if its load is on top
SLOPE_BOUNDS = (0.5, 1.25)
# of a swap that shows in several motions
MAX_OWN_CORRELATION = 0.8
MIN_OTHER_CORRELATION = 0.95
# of motion against the command, also where motion along it shows; by which it must be greater
MIN_OPPOSITION = 0.9
MIN_OPPOSITION_MARGIN = 0.1
MIN_MOTIONS = 3
MAX_DISTANCE = 0.7  # of positions from position commands, in standard deviations of the positions
MIN_KIND_CORRELATION = 0.7  # of the command with what else it may be
# correlation of velocities, from which commands are positions that a weak motor does not reach
MIN_FOLLOWING = 0.75
# measured over commanded range; between 0.03 and 0.1 a joint may be stuck
RATIO_BOUNDS = (0.03, 10.0)
QVEL_RATIO_BOUNDS = (0.5, 2.0)
MIN_WIDEST_COMMAND_RAD = 0.12
MAX_READ_AS_DEGREES_RAD = np.radians(3.3)


def _moved(surveys: list[Survey], joint: int) -> list[Survey]:
    return [s for s in surveys if s.ctrl_range[joint] > MIN_COMMAND_RAD]


def _follow_small_commands(survey: Survey) -> Array:
    """Return which joints move far with a small command, as where state and command have different
    units, (n).
    """
    follow = np.diag(survey.tracking.follows) > MIN_FOLLOWING
    return follow & (
        survey.qpos_range > np.maximum(MIN_COMMAND_RAD, RATIO_BOUNDS[1] * survey.ctrl_range)
    )


def _order(surveys: list[Survey], robot: RobotSpec) -> Iterator[Finding]:
    """Does each command move its own joint?"""
    candidates: dict[tuple[int, int], list[float]] = defaultdict(list)
    motions = np.zeros(len(robot.joint_names), int)
    for s in surveys:
        moved = s.ctrl_range > MIN_COMMAND_RAD
        motions += moved | _follow_small_commands(s)
        follows = s.tracking.follows
        itself = np.diag(follows)
        for i in np.flatnonzero(moved & (itself < 0.3) & (np.diag(s.tracking.opposes) < 0.6)):
            others = np.flatnonzero(
                (follows[i] > 0.6) & ((s.ctrl_range < 0.02) | (follows[:, i] > 0.6).any())
            )
            if others.size:
                j = int(others[follows[i, others].argmax()])
                candidates[int(i), j].append(float(follows[i, j]))
    candidates |= _swapped_pairs(surveys, motions)
    swapped = False
    for (own, other), correlations in candidates.items():
        if 2 * len(correlations) < motions[own]:
            continue
        swapped = True
        a = robot.joint_names[own]
        b = robot.joint_names[other]
        text = (
            f"the command of {a} moves {b}, not {a} (correlation {np.median(correlations):.2f}, "
            f"{len(correlations)} of {motions[own]} motions): the columns of command and state "
            "are in different orders; name the command's "
            f'columns in logs.toml ([columns] "ctrl.{b}" = "what is ctrl.{a} now") and import again'
        )
        yield Finding("error", "order", text, (a, b))
    idle = tuple(name for name, count in zip(robot.joint_names, motions, strict=True) if not count)
    if idle:
        level = "warning" if set(idle) & set(robot.operated) else "note"
        text = f"no motion commands {abbreviate(list(idle))} over more than {MIN_COMMAND_RAD:g} rad"
        if set(idle) & set(_read_as_degrees(surveys)):
            text += ", read as degrees; were they logged in rad?"
        yield Finding(level, "order", f"{text}: nothing can be learned there", idle)
    if not swapped:
        yield Finding("ok", "order", "each command moves the joint of its name")


def _swapped_pairs(surveys: list[Survey], motions: Array) -> dict[tuple[int, int], list[float]]:
    """Return swapped joints over several motions; in one motion, joints that move together look
    alike.
    """
    follows = np.array([s.tracking.follows for s in surveys])  # (sequences, n, n)
    own = np.median(np.diagonal(follows, axis1=1, axis2=2), axis=0)
    cross = np.median(follows, axis=0)
    pairs = {}
    for i in np.flatnonzero((motions >= MIN_MOTIONS) & (own < MAX_OWN_CORRELATION)):
        j = int(cross[i].argmax())
        if (
            j != i
            and min(cross[i, j], cross[j, i]) > MIN_OTHER_CORRELATION
            and own[j] < MAX_OWN_CORRELATION
        ):
            pairs[int(i), j] = follows[follows[:, i, j] > MIN_OTHER_CORRELATION, i, j].tolist()
    return pairs


def _command(surveys: list[Survey], robot: RobotSpec) -> Iterator[Finding]:
    """Are the commands positions?"""
    operated = robot.operated_index
    distance = np.stack([s.kind.distance for s in surveys])[:, operated]
    spans = np.stack([s.ctrl_range for s in surveys])[:, operated]
    judged = np.isfinite(distance) & (spans > 0)  # (sequences, operated)
    if not judged.any() or float(np.median(distance[judged])) < MAX_DISTANCE:
        return

    def median(by_sequence: list[Array]) -> float:
        return float(np.median(np.stack(by_sequence)[:, operated][judged]))

    correlation = {
        "velocities": median([s.kind.velocity_correlation for s in surveys]),
        "torques": median([s.kind.torque_correlation for s in surveys]),
    }
    text = (
        f"states are {np.median(distance[judged]):.2f} times as far from their commands as from "
        "their own mean"
    )
    alike = max(np.nan_to_num(list(correlation.values()))) >= MIN_KIND_CORRELATION
    if not alike and median([np.diag(s.tracking.follows) for s in surveys]) > MIN_FOLLOWING:
        text += (
            ", though they move with them: motors too weak for their load, or a wrong kp; check "
            "payload and kp"
        )
        yield Finding("warning", "command", text, (), correlation)
        return
    text += (
        f": these are no position targets; {_likely_kind(correlation)}. Log the targets of the "
        "position controller"
    )
    yield Finding("error", "command", text, (), correlation)


def _likely_kind(correlation: dict[str, float]) -> str:
    """Say what commands are that are no positions, by their correlation with each kind."""
    best = max(correlation, key=lambda kind: np.nan_to_num(correlation[kind]))
    if not correlation[best] > MIN_KIND_CORRELATION:
        return "are they torques?"
    words = {
        "velocities": "velocities, or steps from the present position (deltas)",
        "torques": "torques",
    }
    return f"they are most like {words[best]} (correlation {correlation[best]:.2f})"


def _sign(surveys: list[Survey], robot: RobotSpec) -> Iterator[Finding]:
    """Does each joint move in the direction of its command?"""
    for i, name in enumerate(robot.joint_names):
        moved = _moved(surveys, i)
        against = [survey for survey in moved if _opposes(survey.tracking, i)]
        if against and 2 * len(against) >= len(moved):
            text = (
                f"{name} moves against its command in {len(against)} of {len(moved)} motions: "
                "command and state have opposite signs; negate one of them and import again"
            )
            yield Finding("error", "sign", text, (name,))


def _opposes(tracking: Tracking, i: int) -> bool:
    """Return True if joint i moves against its command, by the greatest correlations of both.

    Commands that come and go show some motion along them too, a part of their period later.
    """
    against = float(tracking.opposes[i, i])
    along = float(tracking.follows[i, i])
    if against > 0.6 and along < 0.3:
        return True
    return against > MIN_OPPOSITION and against - along > MIN_OPPOSITION_MARGIN


def _copied(surveys: list[Survey], robot: RobotSpec) -> Iterator[Finding]:
    """Are command and state two signals, and does the command come first?"""
    if driven_by_torque(surveys):
        text = (
            "command and position are the same numbers, and torque is recorded: taken as driven "
            "by torque or current. gaponet identify fits armature, friction and delay; gap and "
            "train need position commands. If positions were commanded, log what the servo was sent"
        )
        yield Finding("warning", "copied", text)
        return
    copies = _copies(surveys, robot)
    copied = set[str]().union(*copies.values())
    usual: list[int] = []  # joints that follow their commands in most recordings
    for i, name in enumerate(robot.joint_names):
        if name in copied:
            continue
        moved = _moved(surveys, i)
        leads = _leads(moved, i)
        if len(leads) > 0.5 * len(moved):
            lead = float(np.median(leads))
            text = (
                f"{name} moves {lead * 1e3:.0f} ms before its command in {len(leads)} of "
                f"{len(moved)} motions: are command and state swapped, or their clocks apart?"
            )
            yield Finding("error", "copied", text, (name,), {"lead_s": lead})
        else:
            usual.append(i)
    early = [s for s in surveys if _moves_first(s, usual)]
    if early:
        yield _swapped_recordings(early)
    with_torque = all(s.torque is not None for s in surveys)
    for rows, motions in copies.items():
        yield _copy(rows, motions, with_torque)


def _swapped_recordings(early: list[Survey]) -> Finding:
    """Report recordings in which joints move before their commands."""
    text = (
        f"joints move before their commands in {abbreviate([s.motion for s in early])}, not "
        "in other recordings: command and state are swapped there; leave these out, or import "
        "them with the columns exchanged"
    )
    return Finding("error", "copied", text, (), {"recordings": [s.entry.id for s in early]})


def _leads(surveys: list[Survey], i: int) -> list[float]:
    """Return by how much joint i moves before its command, s, where it does."""
    return [float(s.tracking.lead[i]) for s in surveys if np.isfinite(s.tracking.lead[i])]


def _copies(surveys: list[Survey], robot: RobotSpec) -> dict[int, dict[str, list[str]]]:
    """Return where a state repeats its command: rows between both → joint → motions."""
    copies: dict[int, dict[str, list[str]]] = {}
    for i, name in enumerate(robot.joint_names):
        for s in _moved(surveys, i):
            if np.isfinite(s.tracking.copied_rows[i]):
                motions = copies.setdefault(round(float(s.tracking.copied_rows[i])), {})
                motions.setdefault(name, []).append(s.motion)
    return copies


def driven_by_torque(surveys: list[Survey]) -> bool:
    """True if no position was commanded: each command is the joint's position, and torque is
    recorded.
    """
    for s in surveys:
        moves = s.qpos_range > MIN_COMMAND_RAD
        if s.torque is None or not moves.any() or (s.tracking.copied_rows[moves] != 0).any():
            return False
    return True


def _copy(rows: int, motions: dict[str, list[str]], with_torque: bool) -> Finding:
    """Return the error that the state repeats the command by so many rows.

    motions: joint → motions.
    """
    joints = abbreviate(list(motions))
    where = abbreviate(list(chain.from_iterable(motions.values())))
    count = f"{abs(rows)} row{'s' * (abs(rows) > 1)}"
    if rows == 0:
        text = (
            f"command and state of {joints} are the same numbers in {where}: one was logged as "
            "both; log the command that the servo was sent"
        )
    elif rows > 0:
        text = (
            f"the command of {joints} is the recorded position {count} later, to the last digit or "
            f"up to noise, in {where}: what was sent to the servos is not in this log. Record "
            "the goal positions that the robot was sent"
        )
    else:
        text = (
            f"the position of {joints} is the command {count} later, to the last digit or up to "
            f"noise, in {where}: the state was not measured. Record the positions of the encoders"
        )
    if with_torque:
        text += ". Of a robot that is driven by torque or current: gaponet identify --current"
    return Finding("error", "copied", text, tuple(motions), {"rows": rows})


def _moves_first(survey: Survey, joints: list[int]) -> bool:
    """True if several of the joints move before their commands in a recording, and most of those
    that move.
    """
    moved = [i for i in joints if survey.ctrl_range[i] > MIN_COMMAND_RAD]
    first = int(np.isfinite(survey.tracking.lead[moved]).sum())
    return first >= 2 and 2 * first > len(moved)


def _unit(surveys: list[Survey], robot: RobotSpec) -> Iterator[Finding]:
    """Are commands, positions and velocities in the same unit, the radian?"""
    wrong: list[Finding] = []
    for i, name in enumerate(robot.joint_names):
        wrong += _range_unit(surveys, i, name)
        if not wrong:
            wrong += _scale(surveys, i, name)
        wrong += _velocity_unit(surveys, i, name)
    wrong += _small_commands(surveys)
    yield from _converted(surveys, robot)
    yield from wrong or [Finding("ok", "unit", "commands, positions and velocities agree in unit")]


def _median_or_one(values: list[float]) -> float:
    return float(np.median(values)) if values else 1.0


def _range_unit(surveys: list[Survey], i: int, name: str) -> Iterator[Finding]:
    """Does joint i move as far as it is commanded?"""
    commanded = _moved(surveys, i) or [s for s in surveys if _follow_small_commands(s)[i]]
    ratio = _median_or_one([s.qpos_range[i] / s.ctrl_range[i] for s in commanded])
    if ratio > RATIO_BOUNDS[1] or 0 < ratio < RATIO_BOUNDS[0]:
        text = (
            f"{name} moves {ratio:.3g} times as far as commanded (57.3 and 0.0175 are degrees "
            "beside radians): convert the command or the state in the logs, and import again"
        )
        yield Finding("error", "unit", text, (name,), {"ratio": ratio})


def _scale(surveys: list[Survey], i: int, name: str) -> Iterator[Finding]:
    """Does joint i go 1 rad where its command goes 1 rad?"""
    slopes = [s.tracking.slope[i] for s in surveys]
    slope = _median_or_one([one for one in slopes if np.isfinite(one)])
    if slope > SLOPE_BOUNDS[1] or 0.1 < slope < SLOPE_BOUNDS[0]:
        text = (
            f"{name} goes {slope:.2f} rad where its command goes 1 rad: another scale (a "
            "gear, a range, ticks a turn), or a motor that does not reach its targets; check "
            "both at a right angle"
        )
        yield Finding("warning", "unit", text, (name,), {"slope": slope})


def _velocity_unit(surveys: list[Survey], i: int, name: str) -> Iterator[Finding]:
    """Is the recorded velocity of joint i the derivative of its position?"""
    ratios = []
    for s in surveys:
        ratio = s.encoders.qvel_ratio[i]
        if np.isfinite(ratio) and s.qpos_range[i] > 20 * s.encoders.resolution[i]:
            ratios.append(ratio)
    ratio = _median_or_one(ratios)
    if not QVEL_RATIO_BOUNDS[0] < ratio < QVEL_RATIO_BOUNDS[1]:
        text = (
            f"recorded velocity of {name} is {ratio:.3g} times the derivative of its "
            "position: not rad/s; leave the velocity out at import, it is then computed"
        )
        yield Finding("warning", "unit", text, (name,), {"ratio": ratio})


def _small_commands(surveys: list[Survey]) -> Iterator[Finding]:
    """Are commands so small that they were radians, read as degrees?"""
    small = [s.motion for s in surveys if np.abs(s.ctrl_limits).max() < MAX_READ_AS_DEGREES_RAD]
    widest = max(float(s.ctrl_range.max()) for s in surveys)
    if widest < MIN_WIDEST_COMMAND_RAD:
        text = f"no command spans more than {widest:.3f} rad: were radians read as degrees?"
        yield Finding("warning", "unit", text)
    elif small and _read_as_degrees(surveys):
        text = (
            f"no command of {abbreviate(small)} is further than "
            f"{np.degrees(MAX_READ_AS_DEGREES_RAD):.1f}° from zero: radians that were read as "
            "degrees, beside logs in degrees? Import them by themselves, with their unit"
        )
        yield Finding("error", "unit", text)


def _units(surveys: list[Survey]) -> dict[str, str]:
    """Return joint → unit from which its positions were converted."""
    units: dict[str, str] = {}
    for s in surveys:
        units |= s.entry.meta.notes.get("converted_from", {})
    return units


def _read_as_degrees(surveys: list[Survey]) -> tuple[str, ...]:
    return tuple(name for name, unit in _units(surveys).items() if unit == "deg")


def _converted(surveys: list[Survey], robot: RobotSpec) -> Iterator[Finding]:
    if degrees := _read_as_degrees(surveys):
        yield Finding(
            "note", "unit", f"logged in degrees, converted: {', '.join(degrees)}", degrees
        )
    for name, unit in _units(surveys).items():
        if unit != "fraction":
            continue
        low, high = robot.qpos_range[robot.joint_names.index(name)]
        text = (
            f"{name} is logged as 0..1, not in rad: mapped to its range [{low:.2f}, {high:.2f}], "
            "velocity computed"
        )
        yield Finding("note", "unit", text, (name,))


def _limits(surveys: list[Survey], robot: RobotSpec) -> Iterator[Finding]:
    """Do commands and positions stay in the joint ranges of the MJCF?"""
    for i, name in enumerate(robot.joint_names):
        low, high = robot.qpos_range[i]
        for kind, level, tolerance, limits in (
            ("commanded", "warning", 0.01, [s.ctrl_limits[i] for s in surveys]),
            ("measured", "note", 0.05, [s.qpos_limits[i] for s in surveys]),
        ):
            beyond = np.array([max(low - a, b - high) for a, b in limits])
            if (beyond > tolerance).any():
                clips = ", and the simulator clips there" if kind == "commanded" else ""
                text = (
                    f"{name} is {kind} up to {beyond.max():.3f} rad beyond [{low:.2f}, "
                    f"{high:.2f}] in {(beyond > tolerance).sum()} sequence(s), worst "
                    f"{surveys[int(beyond.argmax())].motion}{clips}: check its zero, or its range "
                    "in robot.xml"
                )
                yield Finding(level, "range", text, (name,), {"beyond_rad": float(beyond.max())})


def _labels(surveys: list[Survey], robot: RobotSpec) -> Iterator[Finding]:
    """Is one recording filed under two payloads or units, and were all made with the same gains?"""
    if (kinds := len({(s.entry.meta.kp, s.entry.meta.kd) for s in surveys})) > 1:
        text = (
            f"{kinds} sets of kp and kd while recording: each recording is simulated with its "
            "own; is that meant?"
        )
        yield Finding("note", "labels", text)
    ids: dict[str, list[str]] = defaultdict(list)
    for s in surveys:
        ids[s.content].append(s.entry.id)
    for same in ids.values():
        if len(same) > 1:
            text = f"same samples under different labels: {', '.join(same)}; remove the wrong one"
            yield Finding("error", "labels", text)


CHECKS = (
    Check(
        _command,
        "command",
        "commands are positions that the joints come near",
        may_be_error=True,
        needs_commands=True,
    ),
    Check(_order, "order", "", may_be_error=True, needs_commands=True),
    Check(
        _sign, "sign", "no joint moves against its command", may_be_error=True, needs_commands=True
    ),
    Check(_copied, "copied", "no state comes before its command", may_be_error=True),
    Check(_unit, "unit", "", may_be_error=True),
    Check(_limits, "range", "commands and positions stay inside the joint ranges"),
    Check(_labels, "labels", "no recording is stored twice", may_be_error=True),
)
