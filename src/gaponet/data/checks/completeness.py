"""Is the recording complete: rate, jitter, gaps, blocked joints, saturated torque, channels
without values?
"""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Iterable, Iterator
from itertools import chain
from typing import NamedTuple

import numpy as np

from gaponet.base.arrays import Array
from gaponet.data.checks.check import Check
from gaponet.data.checks.survey import Recorded, Survey, with_torque
from gaponet.data.log import COMMANDS
from gaponet.robot.finding import Finding, abbreviate, masked_names
from gaponet.robot.spec import RobotSpec

MAX_RATE_DIFFERENCE = 0.05  # of the robot's rate, by which a recorded one may differ untold
MAX_OK_JITTER = 0.1  # of a period
MAX_NOTED_JITTER = 0.5  # of a period; more is a warning
MIN_BLOCKED_S = 0.5
MIN_STANDSTILL_S = 1.0  # of all joints
MIN_REPEATED_S = 0.25
MAX_CUT_SHARE = 0.02  # of the rows that are left, from which cut rows are told
MIN_USED_RAD = 0.05  # range of a joint whose torque is judged
MIN_COMMANDED_RAD = 0.1  # range of a command that moves a joint
# A joint that moves by less than both of these, though commanded, stands still.
MAX_STILL_RAD = 0.03
MAX_STILL_SHARE = 0.05  # of the command's range
MAX_RESOLUTION_RAD = 3e-3  # step between positions; twice as much is a warning
RESOLUTION_TOLERANCE = 0.02  # relative difference of an encoder's steps
MIN_FLAT_ROWS = 20  # with torque cut off at one value
MIN_PILE = 3  # times as many rows as at the next smaller torque
MIN_FLAT_SHARE = 0.01  # of the torque limit, for this value


def _joined(parts: list[Iterable[str]]) -> tuple[str, ...]:
    """Return the names of all parts, each once."""
    return tuple(dict.fromkeys(chain.from_iterable(parts)))


def _motions(surveys: list[Survey]) -> str:
    return abbreviate([survey.motion for survey in surveys])


def _rate(surveys: list[Survey], robot: RobotSpec) -> Iterator[Finding]:
    """At which rate was each sequence recorded?"""
    rates: Counter[float] = Counter()
    for survey in surveys:
        rates[_same_rate(survey, rates)] += 1
    parts = []
    for rate, count in rates.items():
        parts.append(f"{count} at {rate:.2f} Hz ({1e3 / rate:.2f} ms)")
    text = ", ".join(parts)
    deviation = max(abs(survey.timing.rate_hz * robot.dt - 1) for survey in surveys)
    level = "ok"
    if len(rates) > 1:
        level = "warning"
    elif deviation > MAX_RATE_DIFFERENCE:
        level = "note"
    if deviation > 0.001:
        text += f"; robot.toml says {1 / robot.dt:.2f} Hz; the recorded rate is used"
    counts = {f"{rate:.2f}": count for rate, count in rates.items()}
    yield Finding(level, "rate", text, values=counts)
    resampled = [survey for survey in surveys if _is_resampled(survey)]
    if resampled:
        text = f"{len(resampled)} sequence(s) were put on a uniform grid: {_motions(resampled)}"
        yield Finding("note", "rate", text)


def _same_rate(survey: Survey, rates: Iterable[float]) -> float:
    """Return the rate, Hz, out of these, at which a sequence was recorded too; else its own."""
    # of a period; a median of such periods scatters
    uneven = survey.timing.uneven_ms * survey.timing.rate_hz / 1e3
    near = 0.01 + 0.1 * uneven
    for rate in rates:
        if abs(rate - survey.timing.rate_hz) < near * rate:
            return rate
    return survey.timing.rate_hz


def _is_resampled(survey: Survey) -> bool:
    return "resampled" in str(survey.meta.notes.get("rows", ""))


def _regularity(surveys: list[Survey], robot: RobotSpec) -> Iterator[Finding]:
    """How evenly was it sampled, and what is missing?"""
    yield _jitter(surveys)
    yield _gaps(surveys)


def _jitter(surveys: list[Survey]) -> Finding:
    timings = [survey.timing for survey in surveys]
    jitter = [timing.jitter_ms * timing.rate_hz / 1e3 for timing in timings]  # of a period
    worst = surveys[int(np.argmax(jitter))]
    level = "warning"
    if max(jitter) <= MAX_OK_JITTER:
        level = "ok"
    elif max(jitter) <= MAX_NOTED_JITTER:
        level = "note"
    where = f" ({worst.motion})" if worst.timing.jitter_ms else ""
    text = f"periods deviate from their median by at most {worst.timing.jitter_ms:.2f} ms{where}"
    unknown = 2 * max(timing.uneven_ms for timing in timings)
    if level == "warning" and unknown:
        text += (
            f". Delays shorter than {unknown:.0f} ms cannot be told between such rows; log at an "
            "even rate"
        )
    return Finding(level, "jitter", text, values={"jitter_ms": worst.timing.jitter_ms})


def _gaps(surveys: list[Survey]) -> Finding:
    worst = max(surveys, key=lambda survey: survey.timing.longest_gap_ms)
    longest_ms = worst.timing.longest_gap_ms
    gaps = [survey for survey in surveys if survey.timing.missing_samples]
    if not gaps:
        text = f"no samples missing; longest period {longest_ms:.2f} ms"
        return Finding("ok", "gaps", text)
    text = (
        f"{len(gaps)} sequence(s) miss samples, at worst {longest_ms:.0f} ms ({worst.motion}): the "
        "state there is interpolated; cut the log at long gaps"
    )
    return Finding("warning", "gaps", text, values={"longest_gap_ms": longest_ms})


def _jumps(surveys: list[Survey], robot: RobotSpec) -> Iterator[Finding]:
    """Is the state somewhere that no joint can reach and leave in one period?"""
    for i, name in enumerate(robot.joint_names):
        # a row of zeros counts as a jump of each joint, and is told below
        hit = [s for s in surveys if s.encoders.jump_rows[i] > s.encoders.zero_rows]
        if not hit:
            continue
        rows = sum(int(survey.encoders.jump_rows[i]) for survey in hit)
        text = (
            f"{name} jumps and comes back faster than any motor in {rows} rows of "
            f"{_motions(hit)}: a misread sample or a wrap of the encoder; repair or cut these "
            "rows"
        )
        yield Finding("warning", "jumps", text, (name,), {"rows": rows})
    dropped = [survey for survey in surveys if survey.encoders.zero_rows]
    if dropped:
        rows = sum(survey.encoders.zero_rows for survey in dropped)
        text = (
            f"all joints are exactly 0 for {rows} rows of {_motions(dropped)}, and far from it a "
            "row before or after: nothing was read there; repair or cut these rows"
        )
        yield Finding("warning", "jumps", text, values={"rows": rows})


def _nonsense(surveys: list[Survey], robot: RobotSpec) -> Iterator[Finding]:
    """Were impossible values of a channel replaced at import?"""
    for channel, hit in _with_note(surveys, "nonsense").items():
        notes = [survey.meta.notes["nonsense"][channel] for survey in hit]
        rows = sum(note["rows"] for note in notes)
        done = ", ".join(dict.fromkeys(note["done"] for note in notes))
        joints = _joined([note["joints"] for note in notes])
        text = (
            f"{channel} of {abbreviate(list(joints))} was what no joint does (first "
            f"{notes[0]['worst']:.4g}) in {rows} rows of {_motions(hit)}, a counter or a bad "
            f"read: there it is {done}"
        )
        yield Finding("warning", "nonsense", text, joints, {"rows": rows})


def _repeated_rows(surveys: list[Survey], robot: RobotSpec) -> Iterator[Finding]:
    """Were rows that the logger wrote twice left out at import?"""
    hit = [survey for survey in surveys if "repeated" in survey.meta.notes]
    if not hit:
        return
    rows = sum(survey.meta.notes["repeated"]["rows"] for survey in hit)
    text = (
        f"{rows} rows of {_motions(hit)} repeat the row before within a fraction of a period: the "
        "logger wrote them twice, and they were left out at import"
    )
    yield Finding("note", "repeated", text, values={"rows": rows})


def _as_logged(surveys: list[Survey], robot: RobotSpec) -> Iterator[Finding]:
    """What was held, left out, continued or cut at import?"""
    for channel, hit in _with_note(surveys, "slower").items():
        yield _slower(channel, hit)
    for channel, hit in _with_note(surveys, "absent").items():
        yield _absent(channel, hit)
    for joint, hit in _with_note(surveys, "turns").items():
        yield _turns(joint, hit)
    cut = [survey for survey in surveys if _rows_cut(survey) > MAX_CUT_SHARE * survey.entry.rows]
    if cut:
        rows = sum(_rows_cut(survey) for survey in cut)
        left = sum(survey.entry.rows for survey in cut)
        text = (
            f"--skip-bad cut {rows} rows of {_motions(cut)}, and left {left}: what moved there is "
            "interpolated. Look at the lines that import listed, and repair their cause"
        )
        yield Finding("warning", "cut", text, values={"rows": rows})


def _with_note(surveys: list[Survey], note: str) -> dict[str, list[Survey]]:
    """Return channel or joint → recordings that had this note on it at import."""
    by_name: dict[str, list[Survey]] = defaultdict(list)
    for survey in surveys:
        for name in survey.meta.notes.get(note, ()):
            by_name[name].append(survey)
    return by_name


def _rows_cut(survey: Survey) -> int:
    return int(survey.meta.notes.get("rows_cut", 0))


def _slower(channel: str, hit: list[Survey]) -> Finding:
    notes = [survey.meta.notes["slower"][channel] for survey in hit]
    filled = "held" if channel in COMMANDS else "interpolated"
    rows = sum(note["rows"] for note in notes)
    of_rows = sum(note["of"] for note in notes)
    text = (
        f"{channel} stands in {rows} of {of_rows} rows of {_motions(hit)}: it is {filled} between "
        "them"
    )
    return Finding("note", "slower", text)


def _absent(channel: str, hit: list[Survey]) -> Finding:
    joints = _joined([survey.meta.notes["absent"][channel] for survey in hit])
    text = (
        f"{channel} of {abbreviate(list(joints))} is empty in all rows of {_motions(hit)}: "
        f"{channel} is left out"
    )
    return Finding("note", "absent", text, joints)


def _turns(joint: str, hit: list[Survey]) -> Finding:
    notes = [survey.meta.notes["turns"][joint] for survey in hit]
    wraps = sum(note["wraps"] for note in notes)
    moved = any(note["turns"] for note in notes)
    if not wraps and not moved:
        text = (
            f"{joint} was counted from zero to a whole turn in {_motions(hit)}: its angles were "
            "brought into its range"
        )
        return Finding("note", "turns", text, (joint,))
    text = f"{joint} turns on: {wraps} jumps by a whole turn in {_motions(hit)} were continued"
    if moved:
        text += ", and its state was moved by whole turns to its command"
    return Finding("note", "turns", text, (joint,))


def _blocked(surveys: list[Survey], robot: RobotSpec) -> Iterator[Finding]:
    """Did a joint run into a stop, or were all of them held?"""
    held = [survey for survey in surveys if survey.standstill.all_s >= MIN_STANDSTILL_S]
    if held:
        seconds = max(survey.standstill.all_s for survey in held)
        text = (
            f"all joints stand still for up to {seconds:.1f} s while their commands move on in "
            f"{_motions(held)}: an emergency stop, brakes, or drives that were off; cut it out"
        )
        yield Finding("warning", "stop", text, (), {"seconds": seconds})
    for i, name in enumerate(robot.joint_names):
        blocked = [survey for survey in surveys if survey.standstill.blocked_s[i] >= MIN_BLOCKED_S]
        hit = [survey for survey in blocked if survey not in held]
        if not hit:
            continue
        worst = max(hit, key=lambda survey: survey.standstill.blocked_s[i]).standstill
        at_rad = float(worst.blocked_at[i])
        seconds = float(worst.blocked_s[i])
        text = (
            f"{name} stood at {at_rad:.2f} rad for {seconds:.1f} s, far from its command, in "
            f"{_motions(hit)}: a stop, an obstacle, too little torque, or not read; leave it out "
            "or cut it"
        )
        level = "warning" if name in robot.operated else "note"
        values = {"at_rad": at_rad, "seconds": seconds}
        yield Finding(level, "blocked", text, (name,), values)


def unsigned_torque(recorded: Recorded, robot: RobotSpec) -> tuple[str, ...]:
    """Return the joints with a changing torque if none of these torques is ever negative:
    magnitudes, no torques.
    """
    if not recorded:
        return ()
    torques = torque_limits(recorded)
    changes = torques.moved & (torques.low < torques.high)
    if (changes & (torques.low < 0)).any():
        return ()
    return masked_names(robot, changes)


class TorqueLimits(NamedTuple):
    """What the torque of each joint was in some recordings, (n)."""

    low: Array  # N·m
    high: Array  # N·m
    moved: Array  # whether the joint moves, bool


def torque_limits(recorded: Recorded) -> TorqueLimits:
    """Return the least and greatest torque of each joint, and whether it moves."""
    ranges = np.max([survey.qpos_range for survey, _ in recorded], axis=0)  # (n) rad
    return TorqueLimits(
        low=np.min([torque.low for _, torque in recorded], axis=0),
        high=np.max([torque.high for _, torque in recorded], axis=0),
        moved=ranges > MIN_USED_RAD,
    )


def _saturation(surveys: list[Survey], robot: RobotSpec) -> Iterator[Finding]:
    """Did a motor reach its torque limit?"""
    recorded = with_torque(surveys)
    if unsigned_torque(recorded, robot):  # the torque check warns of it
        yield Finding("ok", "saturation", "no signed torque recorded")
        return
    over = [(survey, torque) for survey, torque in recorded if torque.over_limit.any()]
    if not over:
        text = "no torque at a limit" if recorded else "no torque recorded"
        flat = [*_flat_torque(recorded, robot)]
        yield from flat or [Finding("ok", "saturation", text)]
        return
    worst = np.max([torque.largest for _, torque in over], axis=0)  # (n) N·m
    limit = robot.servo.effort_limit
    i = int((worst / limit).argmax())
    name = robot.joint_names[i]
    rows = sum(int(torque.over_limit.sum()) for _, torque in over)
    motions = _motions([survey for survey, _ in over])
    text = (
        f"torque beyond the limit of robot.toml in {rows} rows of {motions}; worst "
        f"{worst[i]:.2f} N·m on {name} (limit {limit[i]:.2f}): a collision, a spike or a wrong "
        "limit"
    )
    values = {"rows": rows, "worst": float(worst[i])}
    yield Finding("warning", "saturation", text, (name,), values)


def _flat_torque(recorded: Recorded, robot: RobotSpec) -> Iterator[Finding]:
    """Find torques that are cut off at one value below the limit of robot.toml."""
    for i, name in enumerate(robot.joint_names):
        top = max((float(torque.largest[i]) for _, torque in recorded), default=0.0)
        near = []  # recordings that reach this torque
        rows = 0
        rows_below = 0  # at the next smaller torque: as many, where torque is recorded in steps
        for survey, torque in recorded:
            if float(torque.largest[i]) > 0.999 * top:
                near.append(survey)
                rows += int(torque.flat[i])
                rows_below += int(torque.below_flat[i])
        if top <= MIN_FLAT_SHARE * robot.servo.effort_limit[i] or rows < MIN_FLAT_ROWS:
            continue
        if rows < MIN_PILE * rows_below:
            continue
        text = (
            f"torque of {name} is cut off flat at {top:.3g} N·m in {rows} rows of "
            f"{_motions(near)}: the motor or its driver gives no more. Write "
            f"effort_limit = {top:.3g} in robot.toml, or leave these recordings out"
        )
        yield Finding("warning", "saturation", text, (name,), {"rows": rows, "limit": top})


def _resolution(surveys: list[Survey], robot: RobotSpec) -> Iterator[Finding]:
    """Are positions recorded finely enough?"""
    step = np.max([survey.encoders.resolution for survey in surveys], axis=0)  # (n) rad
    yield from _degrees_beside_radians(step, robot)
    coarse = masked_names(robot, step > MAX_RESOLUTION_RAD)
    if not coarse:
        text = f"positions change in steps of at most {step.max() * 1e3:.2f} mrad"
        yield Finding("ok", "resolution", text)
        return
    worst = float(step.max())
    name = max(masked_names(robot, step == worst))
    text = (
        f"positions of {abbreviate(list(coarse))} come in steps of up to {worst * 1e3:.1f} mrad "
        f"({name}): rounded when logged, or a coarse encoder (12 bits: 1.5 mrad). No error below "
        "half of that can be seen; log more digits"
    )
    level = "warning" if worst > 2 * MAX_RESOLUTION_RAD else "note"
    yield Finding(level, "resolution", text, coarse, {"step": worst})


def _degrees_beside_radians(step: Array, robot: RobotSpec) -> Iterator[Finding]:
    """Find joints whose steps are 57.3 times those of the others. step: (n) rad, 0 if unknown."""
    if not step.any():
        return
    ratio = np.radians(step) / np.median(step[step > 0])
    degrees = masked_names(robot, np.abs(ratio - 1) < RESOLUTION_TOLERANCE)
    if degrees and len(degrees) < (step > 0).sum() / 2:
        text = (
            f"{', '.join(degrees)} has steps 57.3 times as coarse as other joints: degrees beside "
            "radians? Import again with the right unit"
        )
        yield Finding("warning", "unit", text, degrees)


def _stuck(surveys: list[Survey], robot: RobotSpec) -> Iterator[Finding]:
    """Does every position change while its command moves?

    Three faults, each told once: a joint that never moves in a recording, a joint that repeats one
    number in a part of it, and a part in which the whole state repeats itself.
    """
    for i, name in enumerate(robot.joint_names):
        commanded = [survey for survey in surveys if survey.ctrl_range[i] > MIN_COMMANDED_RAD]
        still = [survey for survey in commanded if _stands_still(survey, i)]
        if still:
            text = (
                f"{name} does not move when commanded in {_motions(still)}: unplugged, torque off "
                "or not read; leave these out"
            )
            level = "error" if len(still) == len(commanded) else "warning"
            yield Finding(level, "stuck", text, (name,))
        repeating = [survey for survey in _repeating(surveys, i) if survey not in still]
        whole_state = any(_repeats_whole_state(survey) for survey in repeating)
        if repeating and not whole_state:  # _frozen tells of the whole state
            seconds = max(survey.standstill.repeated_s[i] for survey in repeating)
            text = (
                f"{name} repeats one number for up to {seconds:.2f} s while its command moves on "
                f"in {_motions(repeating)}: it was not read; cut these logs there"
            )
            yield Finding("warning", "stuck", text, (name,))
    yield from _frozen(surveys)


def _stands_still(survey: Survey, i: int) -> bool:
    """Return True if the position of joint i changes little, and far less than its command."""
    moved = survey.qpos_range[i]
    return bool(moved < MAX_STILL_RAD and moved < MAX_STILL_SHARE * survey.ctrl_range[i])


def _repeats_whole_state(survey: Survey) -> bool:
    return survey.standstill.all_repeated_s > MIN_REPEATED_S


def _repeating(surveys: list[Survey], i: int) -> list[Survey]:
    """Return the recordings in which joint i repeats one number while its command moves on.

    At a stop, an encoder with coarse steps repeats one number too: _blocked reports that.
    """
    repeated = [survey for survey in surveys if survey.standstill.repeated_s[i] > MIN_REPEATED_S]
    if any(survey.encoders.resolution[i] for survey in surveys):
        repeated = [survey for survey in repeated if not survey.standstill.blocked_s[i]]
    return repeated


def _frozen(surveys: list[Survey]) -> Iterator[Finding]:
    """Find recordings whose whole state repeats itself."""
    repeated = [survey for survey in surveys if _repeats_whole_state(survey)]
    frozen = [survey for survey in repeated if not _all_blocked(survey)]
    if frozen:
        seconds = max(survey.standstill.all_repeated_s for survey in frozen)
        text = (
            f"the whole state repeats itself for up to {seconds:.2f} s while the command moves in "
            f"{_motions(frozen)}: samples were lost; cut the logs there"
        )
        yield Finding("warning", "stuck", text)


def _all_blocked(survey: Survey) -> bool:
    """True if every joint that is commanded ran into a stop, where an encoder with coarse steps
    repeats one number.
    """
    commanded = survey.ctrl_range > MIN_COMMANDED_RAD
    coarse = survey.encoders.resolution[commanded] > 0
    return bool((coarse & (survey.standstill.blocked_s[commanded] > 0)).all())


CHECKS = (
    Check(_rate, "rate", ""),
    Check(_regularity, "jitter", ""),
    Check(_jumps, "jumps", "no joint jumps"),
    Check(_nonsense, "nonsense", "no value is implausible"),
    Check(_as_logged, "as logged", "no channel was empty, and no row was cut"),
    Check(_repeated_rows, "repeated", "no row was written twice"),
    Check(_blocked, "blocked", "no joint ran into a stop", needs_commands=True),
    Check(_saturation, "saturation", ""),
    Check(_resolution, "resolution", ""),
    Check(
        _stuck,
        "stuck",
        "every channel changes while its joint moves",
        may_be_error=True,
        needs_commands=True,
    ),
)
