"""Is the recording complete: rate, jitter, gaps, blocked joints, saturated torque, channels
without values?
"""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Iterable, Iterator
from itertools import chain

import numpy as np

from gaponet.base.arrays import Array
from gaponet.data.checks.check import Check
from gaponet.data.checks.survey import Survey, Torque
from gaponet.data.log import COMMANDS
from gaponet.robot.finding import Finding, abbreviate, masked_names
from gaponet.robot.spec import RobotSpec

MAX_JITTER = (0.1, 0.5)  # of a period, up to which jitter is ok and a note
MIN_BLOCKED_S = 0.5
MIN_STANDSTILL_S = 1.0
MIN_REPEATED_S = 0.25
MAX_CUT_SHARE = 0.02  # of the rows that are left, from which cut rows are told
MIN_USED_RAD = 0.05  # range of a joint whose torque is judged
MIN_COMMANDED_RAD = 0.1  # range of a command that moves a joint
MAX_RESOLUTION_RAD = 3e-3  # step between positions; twice as much is a warning
RESOLUTION_TOLERANCE = 0.02  # relative difference of an encoder's steps
# of torque cut off at one value; of the torque limit
MIN_FLAT_ROWS = 20
MIN_FLAT_SHARE = 0.01


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
    text = ", ".join(f"{count} at {r:.2f} Hz ({1e3 / r:.2f} ms)" for r, count in rates.items())
    deviation = max(abs(survey.timing.rate_hz * robot.dt - 1) for survey in surveys)
    level = "ok"
    if len(rates) > 1:
        level = "warning"
    elif deviation > 0.05:
        level = "note"
    if deviation > 0.001:
        text += f"; robot.toml says {1 / robot.dt:.2f} Hz; the recorded rate is used"
    yield Finding(level, "rate", text, values={f"{r:.2f}": count for r, count in rates.items()})
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
    return "resampled" in str(survey.entry.meta.notes.get("rows", ""))


def _regularity(surveys: list[Survey], robot: RobotSpec) -> Iterator[Finding]:
    """How evenly was it sampled, and what is missing?"""
    timings = [survey.timing for survey in surveys]
    jitter = [timing.jitter_ms * timing.rate_hz / 1e3 for timing in timings]  # of a period
    worst = surveys[int(np.argmax(jitter))]
    level = "warning"
    if max(jitter) <= MAX_JITTER[0]:
        level = "ok"
    elif max(jitter) <= MAX_JITTER[1]:
        level = "note"
    where = f" ({worst.motion})" if worst.timing.jitter_ms else ""
    text = f"periods deviate from their median by at most {worst.timing.jitter_ms:.2f} ms{where}"
    unknown = 2 * max(timing.uneven_ms for timing in timings)
    if level == "warning" and unknown:
        text += (
            f". Delays shorter than {unknown:.0f} ms cannot be told between such rows; log at an "
            "even rate"
        )
    yield Finding(level, "jitter", text, values={"jitter_ms": worst.timing.jitter_ms})
    longest = max(surveys, key=lambda survey: survey.timing.longest_gap_ms)
    gaps = [survey for survey in surveys if survey.timing.missing_samples]
    if not gaps:
        yield Finding(
            "ok",
            "gaps",
            f"no samples missing; longest period {longest.timing.longest_gap_ms:.2f} ms",
        )
        return
    text = (
        f"{len(gaps)} sequence(s) miss samples, at worst {longest.timing.longest_gap_ms:.0f} ms "
        f"({longest.motion}): the state there is interpolated; cut the log at long gaps"
    )
    yield Finding("warning", "gaps", text, values={"longest_gap_ms": longest.timing.longest_gap_ms})


def _jumps(surveys: list[Survey], robot: RobotSpec) -> Iterator[Finding]:
    """Is the state somewhere that no joint can reach and leave in one period?"""
    for i, name in enumerate(robot.joint_names):
        hit = [s for s in surveys if s.encoders.jump_rows[i] > s.encoders.zero_rows]
        if hit:
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
        notes = [survey.entry.meta.notes["nonsense"][channel] for survey in hit]
        rows = sum(n["rows"] for n in notes)
        done = ", ".join(dict.fromkeys(n["done"] for n in notes))
        joints = _joined([n["joints"] for n in notes])
        text = (
            f"{channel} of {abbreviate(list(joints))} was what no joint does (first "
            f"{notes[0]['worst']:.4g}) in {rows} rows of {_motions(hit)}, a counter or a bad "
            f"read: there it is {done}"
        )
        yield Finding("warning", "nonsense", text, joints, {"rows": rows})


def _repeated_rows(surveys: list[Survey], robot: RobotSpec) -> Iterator[Finding]:
    """Were rows that the logger wrote twice left out at import?"""
    hit = [survey for survey in surveys if "repeated" in survey.entry.meta.notes]
    if not hit:
        return
    rows = sum(survey.entry.meta.notes["repeated"]["rows"] for survey in hit)
    text = (
        f"{rows} rows of {_motions(hit)} repeat the row before within a fraction of a period: the "
        "logger wrote them twice, and they were left out at import"
    )
    yield Finding("note", "repeated", text, values={"rows": rows})


def _as_logged(surveys: list[Survey], robot: RobotSpec) -> Iterator[Finding]:
    """What was held, left out, continued or cut at import?"""
    for note, finding_of in (("slower", _slower), ("absent", _absent), ("turns", _turns)):
        for name, hit in _with_note(surveys, note).items():
            yield finding_of(name, hit)
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
        for name in survey.entry.meta.notes.get(note, ()):
            by_name[name].append(survey)
    return by_name


def _rows_cut(survey: Survey) -> int:
    return int(survey.entry.meta.notes.get("rows_cut", 0))


def _slower(channel: str, hit: list[Survey]) -> Finding:
    notes = [survey.entry.meta.notes["slower"][channel] for survey in hit]
    filled = "held" if channel in COMMANDS else "interpolated"
    rows = sum(n["rows"] for n in notes)
    text = (
        f"{channel} stands in {rows} of {sum(n['of'] for n in notes)} rows of {_motions(hit)}: it "
        f"is {filled} between them"
    )
    return Finding("note", "slower", text)


def _absent(channel: str, hit: list[Survey]) -> Finding:
    joints = _joined([survey.entry.meta.notes["absent"][channel] for survey in hit])
    text = (
        f"{channel} of {abbreviate(list(joints))} is empty in all rows of {_motions(hit)}: "
        f"{channel} is left out"
    )
    return Finding("note", "absent", text, joints)


def _turns(joint: str, hit: list[Survey]) -> Finding:
    notes = [survey.entry.meta.notes["turns"][joint] for survey in hit]
    wraps = sum(n["wraps"] for n in notes)
    moved = any(n["turns"] for n in notes)
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
        if hit:
            worst = max(hit, key=lambda survey: survey.standstill.blocked_s[i]).standstill
            at_rad = float(worst.blocked_at[i])
            seconds = float(worst.blocked_s[i])
            text = (
                f"{name} stood at {at_rad:.2f} rad for {seconds:.1f} s, "
                f"far from its command, in {_motions(hit)}: a stop, an obstacle, too little "
                "torque, or not read; leave it out or cut it"
            )
            values = {"at_rad": at_rad, "seconds": seconds}
            yield Finding(
                "warning" if name in robot.operated else "note", "blocked", text, (name,), values
            )


def unsigned_torque(recorded: list[tuple[Survey, Torque]], robot: RobotSpec) -> tuple[str, ...]:
    """Return the joints with a changing torque if none of these torques is ever negative:
    magnitudes, no torques.
    """
    if not recorded:
        return ()
    low, high, used = torque_limits(recorded)
    alive = used & (low < high)
    return () if (alive & (low < 0)).any() else masked_names(robot, alive)


def torque_limits(recorded: list[tuple[Survey, Torque]]) -> tuple[Array, Array, Array]:
    """Return each joint's least and greatest torque, N·m, and whether it moves, (n)."""
    low = np.min([t.low for _, t in recorded], axis=0)
    high = np.max([t.high for _, t in recorded], axis=0)
    moved = np.max([survey.qpos_range for survey, _ in recorded], axis=0) > MIN_USED_RAD
    return low, high, moved


def _saturation(surveys: list[Survey], robot: RobotSpec) -> Iterator[Finding]:
    """Did a motor reach its torque limit?"""
    recorded = [(survey, survey.torque) for survey in surveys if survey.torque is not None]
    if unsigned_torque(recorded, robot):  # the torque check warns of it
        yield Finding("ok", "saturation", "no signed torque recorded")
        return
    over = [(survey, t) for survey, t in recorded if t.over_limit.any()]
    if not over:
        ok = Finding(
            "ok", "saturation", "no torque at a limit" if recorded else "no torque recorded"
        )
        yield from [*_flat_torque(recorded, robot)] or [ok]
        return
    worst = np.max([np.maximum(-t.low, t.high) for _, t in over], axis=0)  # (n,) N·m
    i = int((worst / robot.servo.effort_limit).argmax())
    rows = sum(int(t.over_limit.sum()) for _, t in over)
    motions = _motions([survey for survey, _ in over])
    text = (
        f"torque beyond the limit of robot.toml in {rows} rows of "
        f"{motions}; worst {worst[i]:.2f} N·m on {robot.joint_names[i]} "
        f"(limit {robot.servo.effort_limit[i]:.2f}): a collision, a spike or a wrong limit"
    )
    yield Finding(
        "warning",
        "saturation",
        text,
        (robot.joint_names[i],),
        {"rows": rows, "worst": float(worst[i])},
    )


def _flat_torque(recorded: list[tuple[Survey, Torque]], robot: RobotSpec) -> Iterator[Finding]:
    """Find torques that are cut off at one value below the limit of robot.toml."""
    for i, name in enumerate(robot.joint_names):
        largest = [max(-float(torque.low[i]), float(torque.high[i])) for _, torque in recorded]
        top = max(largest, default=0.0)
        near = []
        rows = 0
        for (survey, torque), most in zip(recorded, largest, strict=True):
            if most > 0.999 * top:
                near.append(survey)
                rows += int(torque.flat[i])
        if top > MIN_FLAT_SHARE * robot.servo.effort_limit[i] and rows >= MIN_FLAT_ROWS:
            motions = _motions(near)
            text = (
                f"torque of {name} is cut off flat at {top:.3g} N·m in {rows} rows of "
                f"{motions}: the motor or its driver gives no more. Write "
                f"effort_limit = {top:.3g} in robot.toml, or leave these recordings out"
            )
            yield Finding("warning", "saturation", text, (name,), {"rows": rows, "limit": top})


def _resolution(surveys: list[Survey], robot: RobotSpec) -> Iterator[Finding]:
    """Are positions recorded finely enough?"""
    step = np.max([survey.encoders.resolution for survey in surveys], axis=0)
    ratio = np.radians(step) / np.median(step[step > 0]) if step.any() else np.zeros_like(step)
    degrees = masked_names(robot, np.abs(ratio - 1) < RESOLUTION_TOLERANCE)
    if degrees and len(degrees) < (step > 0).sum() / 2:
        text = (
            f"{', '.join(degrees)} has steps 57.3 times as coarse as other joints: degrees beside "
            "radians?"
        )
        yield Finding("warning", "unit", f"{text} Import again with the right unit", degrees)
    steps = zip(step.tolist(), robot.joint_names, strict=True)
    coarse = [(size, name) for size, name in steps if size > MAX_RESOLUTION_RAD]
    if not coarse:
        yield Finding(
            "ok", "resolution", f"positions change in steps of at most {step.max() * 1e3:.2f} mrad"
        )
        return
    worst, name = max(coarse)
    text = (
        f"positions of {abbreviate([name for _, name in coarse])} come in steps of up to "
        f"{worst * 1e3:.1f} mrad ({name}): rounded when logged, or a coarse encoder (12 bits: 1.5 "
        "mrad). No error below half of that can be seen; log more digits"
    )
    level = "warning" if worst > 2 * MAX_RESOLUTION_RAD else "note"
    yield Finding(level, "resolution", text, tuple(name for _, name in coarse), {"step": worst})


def _stuck(surveys: list[Survey], robot: RobotSpec) -> Iterator[Finding]:
    """Does every channel change when it should?"""
    for i, name in enumerate(robot.joint_names):
        moved = [survey for survey in surveys if survey.ctrl_range[i] > MIN_COMMANDED_RAD]
        still = [survey for survey in moved if _stands_still(survey, i)]
        if still:
            text = (
                f"{name} does not move when commanded in {_motions(still)}: unplugged, torque off "
                "or not read; leave these out"
            )
            level = "error" if len(still) == len(moved) else "warning"
            yield Finding(level, "stuck", text, (name,))
        repeated = [survey for survey in _repeating(surveys, i) if survey not in still]
        whole = [s for s in repeated if s.standstill.all_repeated_s > MIN_REPEATED_S]
        if repeated and not whole:
            seconds = max(survey.standstill.repeated_s[i] for survey in repeated)
            text = (
                f"{name} repeats one number for up to {seconds:.2f} s while its command moves on "
                f"in {_motions(repeated)}: it was not read; cut these logs there"
            )
            yield Finding("warning", "stuck", text, (name,))
    yield from _frozen(surveys)


def _stands_still(survey: Survey, i: int) -> bool:
    """Return True if joint i moves little, and far less than commanded."""
    moved = survey.qpos_range[i]
    return bool(moved < 0.03 and moved < 0.05 * survey.ctrl_range[i])


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
    repeated = [survey for survey in surveys if survey.standstill.all_repeated_s > MIN_REPEATED_S]
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
