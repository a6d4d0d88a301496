"""Is the recording whole: rate, jitter, gaps, blocked joints, saturated torque, dead channels?"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator

import numpy as np

from gaponet.data.survey import Survey, Torque
from gaponet.robot.finding import Finding, abbreviate, masked_names
from gaponet.robot.spec import RobotSpec

COARSE = 3e-3  # rad
HALTED = 1.0  # s
ALIKE = 0.02  # share by which an encoder's steps may differ
ENOUGH = 20  # rows of torque cut off flat


def _rate(surveys: list[Survey], robot: RobotSpec) -> Iterator[Finding]:
    """At which rate was each sequence recorded?"""
    groups: dict[float, int] = defaultdict(int)
    for s in surveys:
        groups[next((g for g in groups if abs(g - s.rate_hz) < 0.01 * g), s.rate_hz)] += 1
    told = ", ".join(f"{count} at {r:.2f} Hz ({1e3 / r:.2f} ms)" for r, count in groups.items())
    off = max(abs(s.rate_hz * robot.dt - 1) for s in surveys)
    level = "warning" if len(groups) > 1 else "note" if off > 0.05 else "ok"
    hint = f"; robot.toml says {1 / robot.dt:.2f} Hz, each sequence keeps its own" if off > 0.001 else ""
    yield Finding(level, "rate", told + hint, values={f"{r:.2f}": count for r, count in groups.items()})
    moved = [s.motion for s in surveys if "resampled" in str(s.entry.meta.notes.get("rows", ""))]
    if moved:
        yield Finding("note", "rate", f"{len(moved)} sequence(s) were put on a uniform grid: {abbreviate(moved)}")


def _regularity(surveys: list[Survey], robot: RobotSpec) -> Iterator[Finding]:
    """How evenly was it sampled, and what is missing?"""
    share = [s.jitter_ms * s.rate_hz / 1e3 for s in surveys]  # of a period
    worst = surveys[int(np.argmax(share))]
    level = "ok" if max(share) <= 0.1 else "note" if max(share) <= 0.5 else "warning"
    where = f" ({worst.motion})" if worst.jitter_ms else ""
    text = f"periods deviate from their median by at most {worst.jitter_ms:.2f} ms{where}"
    yield Finding(level, "jitter", text, values={"jitter_ms": worst.jitter_ms})
    longest = max(surveys, key=lambda s: s.longest_gap_ms)
    gaps = [s for s in surveys if s.longest_gap_ms * s.rate_hz / 1e3 > 2.5]
    if not gaps:
        yield Finding("ok", "gaps", f"no samples missing; longest period {longest.longest_gap_ms:.2f} ms")
        return
    text = (
        f"{len(gaps)} sequence(s) miss samples, at worst {longest.longest_gap_ms:.0f} ms ({longest.motion}): the state "
        "there is interpolated; cut the log at long gaps"
    )
    yield Finding("warning", "gaps", text, values={"longest_gap_ms": longest.longest_gap_ms})


def _jumps(surveys: list[Survey], robot: RobotSpec) -> Iterator[Finding]:
    """Is the state somewhere that no joint can reach and leave in one period?"""
    found = []
    for i, name in enumerate(robot.joint_names):
        hit = [s for s in surveys if s.jumps[i] > s.dropped]
        if hit:
            text = (
                f"{name} jumps and comes back faster than any motor in {sum(int(s.jumps[i]) for s in hit)} rows of "
                f"{abbreviate([s.motion for s in hit])}: a misread sample or a wrap of the encoder; repair or cut "
                "these rows"
            )
            found.append(Finding("warning", "jumps", text, (name,), {"rows": sum(int(s.jumps[i]) for s in hit)}))
    dropped = [s for s in surveys if s.dropped]
    if dropped:
        rows = sum(s.dropped for s in dropped)
        text = (
            f"all joints are exactly 0 for {rows} rows of {abbreviate([s.motion for s in dropped])}, and far from it "
            "a row "
            "before or after: nothing was read there; repair or cut these rows"
        )
        found.append(Finding("warning", "jumps", text, values={"rows": rows}))
    yield from found or [Finding("ok", "jumps", "no joint jumps")]


def _nonsense(surveys: list[Survey], robot: RobotSpec) -> Iterator[Finding]:
    """Was a channel made up for where it could not be?"""
    told: dict[str, list[Survey]] = defaultdict(list)
    for s in surveys:
        for channel in s.entry.meta.notes.get("nonsense", {}):
            told[channel].append(s)
    for channel, found in told.items():
        notes = [s.entry.meta.notes["nonsense"][channel] for s in found]
        rows, done = sum(n["rows"] for n in notes), ", ".join(dict.fromkeys(n["done"] for n in notes))
        joints = tuple(dict.fromkeys(j for n in notes for j in n["joints"]))
        text = (
            f"{channel} of {abbreviate(list(joints))} was what no joint does (first {notes[0]['worst']:.4g}) in "
            f"{rows} rows "
            f"of {abbreviate([s.motion for s in found])}, a counter or a bad read: there it is {done}"
        )
        yield Finding("warning", "nonsense", text, joints, {"rows": rows})
    if not told:
        yield Finding("ok", "nonsense", "no channel holds what no joint does")


def _blocked(surveys: list[Survey], robot: RobotSpec) -> Iterator[Finding]:
    """Did a joint run into a stop, or were all of them held?"""
    found = []
    held = [s for s in surveys if s.halted_s >= HALTED]
    if held:
        worst = max(held, key=lambda s: s.halted_s)
        text = (
            f"all joints stand still for up to {worst.halted_s:.1f} s while their commands move on in "
            f"{abbreviate([s.motion for s in held])}: an emergency stop, brakes, or drives that were off; cut it out"
        )
        found.append(Finding("warning", "stop", text, (), {"seconds": worst.halted_s}))
    for i, name in enumerate(robot.joint_names):
        hit = [s for s in surveys if s.blocked_s[i] >= 0.5 and s not in held]
        if hit:
            worst = max(hit, key=lambda s: s.blocked_s[i])
            text = (
                f"{name} stood at {worst.blocked_at[i]:.2f} rad for {worst.blocked_s[i]:.1f} s, far from its command, "
                f"in {abbreviate([s.motion for s in hit])}: a stop, an obstacle, too little torque, or not read; "
                "leave it "
                "out or cut it"
            )
            values = {"at_rad": float(worst.blocked_at[i]), "seconds": float(worst.blocked_s[i])}
            found.append(Finding("warning" if name in robot.operated else "note", "blocked", text, (name,), values))
    yield from found or [Finding("ok", "blocked", "no joint ran into a stop")]


def _saturation(surveys: list[Survey], robot: RobotSpec) -> Iterator[Finding]:
    """Did a motor reach its torque limit?"""
    told = [(s, s.torque) for s in surveys if s.torque is not None]
    over = [(s, t) for s, t in told if t.over_limit.any()]
    if not over:
        found = [*_flat(told, robot)]
        yield from found or [Finding("ok", "saturation", "no torque at a limit" if told else "no torque recorded")]
        return
    worst = np.max([np.maximum(-t.low, t.high) for _, t in over], axis=0)  # (n,) N·m
    i = int((worst / robot.effort_limit).argmax())
    rows = sum(int(t.over_limit.sum()) for _, t in over)
    text = (
        f"torque beyond the limit of robot.toml in {rows} rows of {abbreviate([s.motion for s, _ in over])}; worst "
        f"{worst[i]:.2f} N·m on {robot.joint_names[i]} (limit {robot.effort_limit[i]:.2f}): a collision, a spike or a "
        "wrong limit"
    )
    yield Finding("warning", "saturation", text, (robot.joint_names[i],), {"rows": rows, "worst": float(worst[i])})


def _flat(told: list[tuple[Survey, Torque]], robot: RobotSpec) -> Iterator[Finding]:
    """Torques cut off flat, above a hundredth of the limit."""
    for i, name in enumerate(robot.joint_names):
        top = max((max(-float(t.low[i]), float(t.high[i])) for _, t in told), default=0.0)
        near = [(s, t) for s, t in told if max(-t.low[i], t.high[i]) > 0.999 * top]
        rows = sum(int(t.flat[i]) for _, t in near)
        if top > 0.01 * robot.effort_limit[i] and rows >= ENOUGH:
            text = (
                f"torque of {name} is cut off flat at {top:.3g} N·m in {rows} rows of "
                f"{abbreviate([s.motion for s, _ in near])}: the motor or its driver gives no more. Write "
                "effort_limit = "
                f"{top:.3g} in robot.toml, or leave these out"
            )
            yield Finding("warning", "saturation", text, (name,), {"rows": rows, "limit": top})


def _resolution(surveys: list[Survey], robot: RobotSpec) -> Iterator[Finding]:
    """Are positions told finely enough?"""
    step = np.max([s.step for s in surveys], axis=0)
    degrees = (
        masked_names(robot, np.abs(np.radians(step) / np.median(step[step > 0]) - 1) < ALIKE) if step.any() else ()
    )
    if degrees and len(degrees) < (step > 0).sum() / 2:
        text = f"{', '.join(degrees)} is told in steps 57.3 times as coarse as other joints: degrees beside radians?"
        yield Finding("warning", "unit", f"{text} Import again with the right unit", degrees)
    coarse = [(float(x), name) for x, name in zip(step, robot.joint_names, strict=True) if x > COARSE]
    if not coarse:
        yield Finding("ok", "resolution", f"positions are told in steps of at most {step.max() * 1e3:.2f} mrad")
        return
    worst, name = max(coarse)
    text = (
        f"positions of {abbreviate([name for _, name in coarse])} come in steps of up to {worst * 1e3:.1f} mrad "
        f"({name}): "
        "rounded when logged, or a coarse encoder (12 bits: 1.5 mrad). No error below half of that can be seen; log "
        "more digits"
    )
    level = "warning" if worst > 2 * COARSE else "note"
    yield Finding(level, "resolution", text, tuple(name for _, name in coarse), {"step": worst})


def _stuck(surveys: list[Survey], robot: RobotSpec) -> Iterator[Finding]:
    """Does every channel change when it should?"""
    found = []
    for i, name in enumerate(robot.joint_names):
        asked = [s for s in surveys if s.ctrl_range[i] > 0.1]
        still = [s for s in asked if s.qpos_range[i] < 0.03 and s.qpos_range[i] < 0.05 * s.ctrl_range[i]]
        if still:
            text = (
                f"{name} does not move when commanded in {abbreviate([s.motion for s in still])}: unplugged, torque "
                "off or "
                "not read; leave these out"
            )
            found.append(Finding("error" if len(still) == len(asked) else "warning", "stuck", text, (name,)))
        # At a stop an encoder's steps repeat one number too: `_blocked` says that.
        steps = any(s.step[i] for s in surveys)
        stopped = [s for s in surveys if s.stopped_s[i] > 0.25 and s not in still and not (steps and s.blocked_s[i])]
        if stopped and not any(s.frozen_s > 0.25 for s in stopped):
            worst = max(stopped, key=lambda s: s.stopped_s[i])
            text = (
                f"{name} repeats one number for up to {worst.stopped_s[i]:.2f} s while its command moves on in "
                f"{abbreviate([s.motion for s in stopped])}: it was not read; cut these logs there"
            )
            found.append(Finding("warning", "stuck", text, (name,)))
    frozen = [s for s in surveys if s.frozen_s > 0.25]
    if frozen:
        worst = max(frozen, key=lambda s: s.frozen_s)
        text = (
            f"the whole state repeats itself for up to {worst.frozen_s:.2f} s while the command moves in "
            f"{abbreviate([s.motion for s in frozen])}: samples were lost; cut the logs there"
        )
        found.append(Finding("warning", "stuck", text))
    yield from found or [Finding("ok", "stuck", "every channel changes when it should")]


CHECKS = (_rate, _regularity, _jumps, _nonsense, _blocked, _saturation, _resolution, _stuck)
