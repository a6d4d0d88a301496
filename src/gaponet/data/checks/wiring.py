"""Do the logs mean what they say: order, sign, unit and range of their joints, and their labels?"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator
from itertools import chain

import numpy as np

from gaponet.base.arrays import Array
from gaponet.data.checks.check import Check
from gaponet.data.checks.survey import Survey, Tracking
from gaponet.robot.finding import Finding, abbreviate, masked_names
from gaponet.robot.spec import RobotSpec

MIN_COMMAND_RAD = 0.05  # a joint with a smaller command range shows neither order, sign nor unit
MAX_REST_RAD = 0.02  # command range of a joint that was not told to move
# Slope of the state over the command: a loaded joint falls short of its command, or passes it if
# its load is on top. Below the least slope of a scale, a joint is stuck or has another unit.
SLOPE_BOUNDS = (0.5, 1.25)
MIN_SCALE_SLOPE = 0.1
# Correlations of commanded with measured velocities, in one motion:
MAX_UNRELATED = 0.3  # of a joint that does not follow a command
MIN_RELATED = 0.6  # of one that does
# and in several motions, where a swap shows more surely:
MIN_MOTIONS = 3
MAX_OWN_CORRELATION = 0.8
MIN_OTHER_CORRELATION = 0.95
# Motion against the command counts, also where motion along it shows, if it correlates so much, and
# by the margin more.
MIN_OPPOSITION = 0.9
MIN_OPPOSITION_MARGIN = 0.1
MAX_DISTANCE = 0.7  # of positions from position commands, in standard deviations of the positions
MIN_KIND_CORRELATION = 0.7  # of the command with what else it may be
# correlation of velocities, from which commands are positions that a weak motor does not reach
MIN_FOLLOWING = 0.75
# measured over commanded range; between 0.03 and 0.1 a joint may be stuck
RATIO_BOUNDS = (0.03, 10.0)
QVEL_RATIO_BOUNDS = (0.5, 2.0)  # recorded velocity over the derivative of the position
MIN_ENCODER_STEPS = 20  # that a joint passes whose velocity is judged
MIN_WIDEST_COMMAND_RAD = 0.12
MAX_READ_AS_DEGREES_RAD = np.radians(3.3)
MAX_COMMANDED_BEYOND_RAD = 0.01  # of a joint's range
MAX_MEASURED_BEYOND_RAD = 0.05


def _moved(surveys: list[Survey], joint: int) -> list[Survey]:
    """Return the recordings in which a joint is commanded to move."""
    return [survey for survey in surveys if survey.ctrl_range[joint] > MIN_COMMAND_RAD]


def _follow_small_commands(survey: Survey) -> Array:
    """Return which joints move far with a small command, as where state and command have different
    units, (n).
    """
    follow = np.diag(survey.tracking.follows) > MIN_FOLLOWING
    far = np.maximum(MIN_COMMAND_RAD, RATIO_BOUNDS[1] * survey.ctrl_range)
    return np.asarray(follow & (survey.qpos_range > far))


def _order(surveys: list[Survey], robot: RobotSpec) -> Iterator[Finding]:
    """Does each command move its own joint?"""
    motions = np.zeros(len(robot.joint_names), int)  # that command each joint, (n)
    for survey in surveys:
        motions += (survey.ctrl_range > MIN_COMMAND_RAD) | _follow_small_commands(survey)
    moves_another = _swapped_in_one_motion(surveys) | _swapped_pairs(surveys, motions)
    swapped = False
    for (own, other), correlations in moves_another.items():
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
    yield from _never_commanded(surveys, robot, motions)
    if not swapped:
        yield Finding("ok", "order", "each command moves the joint of its name")


# indices of a command and of the joint that it moves → correlations, one per motion
_Swaps = dict[tuple[int, int], list[float]]


def _swapped_in_one_motion(surveys: list[Survey]) -> _Swaps:
    """Return commands that move another joint than their own, by each motion for itself."""
    swaps: _Swaps = defaultdict(list)
    for survey in surveys:
        follows = survey.tracking.follows  # (n, n)
        unrelated = np.diag(follows) < MAX_UNRELATED
        unrelated &= np.diag(survey.tracking.opposes) < MIN_RELATED
        at_rest = survey.ctrl_range < MAX_REST_RAD
        for i in np.flatnonzero((survey.ctrl_range > MIN_COMMAND_RAD) & unrelated):
            # the other joint was not told to move, or another command moves this one
            explained = at_rest | (follows[:, i] > MIN_RELATED).any()
            others = np.flatnonzero((follows[i] > MIN_RELATED) & explained)
            if others.size:
                j = int(others[follows[i, others].argmax()])
                swaps[int(i), j].append(float(follows[i, j]))
    return swaps


def _never_commanded(surveys: list[Survey], robot: RobotSpec, motions: Array) -> Iterator[Finding]:
    """Report joints that no motion commands. motions: that command each joint, (n)."""
    idle = masked_names(robot, motions == 0)
    if not idle:
        return
    level = "warning" if set(idle) & set(robot.operated) else "note"
    text = f"no motion commands {abbreviate(list(idle))} over more than {MIN_COMMAND_RAD:g} rad"
    if set(idle) & set(_read_as_degrees(surveys)):
        text += ", read as degrees; were they logged in rad?"
    yield Finding(level, "order", f"{text}: nothing can be learned there", idle)


def _swapped_pairs(surveys: list[Survey], motions: Array) -> _Swaps:
    """Return swapped joints over several motions; in one motion, joints that move together look
    alike.
    """
    follows = np.array([survey.tracking.follows for survey in surveys])  # (sequences, n, n)
    own = np.median(np.diagonal(follows, axis1=1, axis2=2), axis=0)  # (n)
    cross = np.median(follows, axis=0)  # (n, n)
    candidates = (motions >= MIN_MOTIONS) & (own < MAX_OWN_CORRELATION)
    swaps: _Swaps = {}
    for i in np.flatnonzero(candidates):
        j = int(cross[i].argmax())
        both_ways = min(cross[i, j], cross[j, i])
        if j == i or own[j] >= MAX_OWN_CORRELATION or both_ways <= MIN_OTHER_CORRELATION:
            continue
        of_motions = follows[:, i, j]
        swaps[int(i), j] = of_motions[of_motions > MIN_OTHER_CORRELATION].tolist()
    return swaps


def _command(surveys: list[Survey], robot: RobotSpec) -> Iterator[Finding]:
    """Are the commands positions?"""
    operated = robot.operated_index
    distance = np.stack([survey.kind.distance for survey in surveys])[:, operated]
    spans = np.stack([survey.ctrl_range for survey in surveys])[:, operated]
    judged = np.isfinite(distance) & (spans > 0)  # (sequences, operated)
    if not judged.any() or float(np.median(distance[judged])) < MAX_DISTANCE:
        return

    def median(by_sequence: list[Array]) -> float:
        return float(np.median(np.stack(by_sequence)[:, operated][judged]))

    correlation = {
        "velocities": median([survey.kind.velocity_correlation for survey in surveys]),
        "torques": median([survey.kind.torque_correlation for survey in surveys]),
    }
    following = median([np.diag(survey.tracking.follows) for survey in surveys])
    text = (
        f"states are {np.median(distance[judged]):.2f} times as far from their commands as from "
        "their own mean"
    )
    alike = max(np.nan_to_num(list(correlation.values()))) >= MIN_KIND_CORRELATION
    if not alike and following > MIN_FOLLOWING:
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
    if against > MIN_RELATED and along < MAX_UNRELATED:
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
        for survey in _moved(surveys, i):
            rows = float(survey.tracking.copied_rows[i])
            if np.isfinite(rows):
                motions_of = copies.setdefault(round(rows), {})
                motions_of.setdefault(name, []).append(survey.motion)
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
        other_unit = [*_range_unit(surveys, i, name)]
        wrong += other_unit or _scale(surveys, i, name)
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
    if slope > SLOPE_BOUNDS[1] or MIN_SCALE_SLOPE < slope < SLOPE_BOUNDS[0]:
        text = (
            f"{name} goes {slope:.2f} rad where its command goes 1 rad: another scale (a "
            "gear, a range, ticks a turn), or a motor that does not reach its targets; check "
            "both at a right angle"
        )
        yield Finding("warning", "unit", text, (name,), {"slope": slope})


def _velocity_unit(surveys: list[Survey], i: int, name: str) -> Iterator[Finding]:
    """Is the recorded velocity of joint i the derivative of its position?"""
    ratios = []
    for survey in surveys:
        ratio = survey.encoders.qvel_ratio[i]
        least_range = MIN_ENCODER_STEPS * survey.encoders.resolution[i]
        if np.isfinite(ratio) and survey.qpos_range[i] > least_range:
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
    for i in range(len(robot.joint_names)):
        ctrl = np.array([survey.ctrl_limits[i] for survey in surveys])
        qpos = np.array([survey.qpos_limits[i] for survey in surveys])
        yield from _beyond_range(surveys, robot, i, "commanded", ctrl)
        yield from _beyond_range(surveys, robot, i, "measured", qpos)


def _beyond_range(
    surveys: list[Survey], robot: RobotSpec, i: int, kind: str, limits: Array
) -> Iterator[Finding]:
    """Report positions of joint i beyond its range.

    Args:
        kind: commanded or measured.
        limits: The least and the greatest of each sequence, (sequences, 2) rad.
    """
    level = "note"
    tolerance = MAX_MEASURED_BEYOND_RAD
    clips = ""
    if kind == "commanded":
        level = "warning"
        tolerance = MAX_COMMANDED_BEYOND_RAD
        clips = ", and the simulator clips there"
    name = robot.joint_names[i]
    low, high = robot.qpos_range[i]
    beyond = np.maximum(low - limits[:, 0], limits[:, 1] - high)  # (sequences) rad
    if not (beyond > tolerance).any():
        return
    worst = surveys[int(beyond.argmax())].motion
    text = (
        f"{name} is {kind} up to {beyond.max():.3f} rad beyond [{low:.2f}, {high:.2f}] in "
        f"{(beyond > tolerance).sum()} sequence(s), worst {worst}{clips}: check its zero, or its "
        "range in robot.xml"
    )
    yield Finding(level, "range", text, (name,), {"beyond_rad": float(beyond.max())})


def _labels(surveys: list[Survey], robot: RobotSpec) -> Iterator[Finding]:
    """Is one recording filed under two payloads or units, and were all made with the same gains?"""
    gains = {(survey.meta.kp, survey.meta.kd) for survey in surveys}
    if len(gains) > 1:
        text = (
            f"{len(gains)} sets of kp and kd while recording: each recording is simulated with "
            "its own; is that meant?"
        )
        yield Finding("note", "labels", text)
    ids: dict[str, list[str]] = defaultdict(list)
    for survey in surveys:
        ids[survey.content].append(survey.entry.id)
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
