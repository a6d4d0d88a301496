"""Is the recording whole: rate, jitter, gaps, blocked joints, saturated torque, dead channels?"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator

import numpy as np

from gaponet.data.checks.finding import Finding, some
from gaponet.data.survey import Survey
from gaponet.robot import RobotSpec


def rate(surveys: list[Survey], robot: RobotSpec) -> Iterator[Finding]:
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
        yield Finding("note", "rate", f"{len(moved)} sequence(s) were put on a uniform grid: {some(moved)}")


def regularity(surveys: list[Survey], robot: RobotSpec) -> Iterator[Finding]:
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


def jumps(surveys: list[Survey], robot: RobotSpec) -> Iterator[Finding]:
    """Is the state somewhere that no joint can reach and leave in one period?"""
    found = []
    for i, name in enumerate(robot.joint_names):
        hit = [s for s in surveys if s.jumps[i]]
        if hit:
            text = (
                f"{name} jumps and comes back faster than any motor in {sum(int(s.jumps[i]) for s in hit)} rows of "
                f"{some([s.motion for s in hit])}: a misread sample or a wrap of the encoder; repair or cut these rows"
            )
            found.append(Finding("warning", "jumps", text, (name,), {"rows": sum(int(s.jumps[i]) for s in hit)}))
    dropped = [s for s in surveys if s.dropped]
    if dropped:
        rows = sum(s.dropped for s in dropped)
        text = (
            f"all joints are exactly 0 for {rows} rows of {some([s.motion for s in dropped])}, and far from it a row "
            "before or after: nothing was read there; repair or cut these rows"
        )
        found.append(Finding("warning", "jumps", text, values={"rows": rows}))
    yield from found or [Finding("ok", "jumps", "no joint jumps")]


def blocked(surveys: list[Survey], robot: RobotSpec) -> Iterator[Finding]:
    """Did a joint run into a stop?"""
    found = []
    for i, name in enumerate(robot.joint_names):
        hit = [s for s in surveys if s.blocked_s[i] >= 0.5]
        if hit:
            worst = max(hit, key=lambda s: s.blocked_s[i])
            text = (
                f"{name} stood at {worst.blocked_at[i]:.2f} rad for {worst.blocked_s[i]:.1f} s, far from its command, "
                f"in {some([s.motion for s in hit])}: a stop, an obstacle or too little torque; leave it out or cut it"
            )
            values = {"at_rad": float(worst.blocked_at[i]), "seconds": float(worst.blocked_s[i])}
            found.append(Finding("warning" if name in robot.operated else "note", "blocked", text, (name,), values))
    yield from found or [Finding("ok", "blocked", "no joint ran into a stop")]


def saturation(surveys: list[Survey], robot: RobotSpec) -> Iterator[Finding]:
    """Did a motor reach its torque limit?"""
    told = [(s, s.torque) for s in surveys if s.torque is not None]
    over = [(s, t) for s, t in told if t.over_limit.any()]
    if not over:
        yield Finding("ok", "saturation", "no torque beyond the limits of robot.toml" if told else "no torque recorded")
        return
    worst = np.max([np.maximum(-t.low, t.high) for _, t in over], axis=0)  # (n,) N·m
    i = int((worst / robot.effort_limit).argmax())
    rows = sum(int(t.over_limit.sum()) for _, t in over)
    text = (
        f"torque beyond the limit of robot.toml in {rows} rows of {some([s.motion for s, _ in over])}; worst "
        f"{worst[i]:.2f} N·m on {robot.joint_names[i]} (limit {robot.effort_limit[i]:.2f}): a collision, a spike or a "
        "wrong limit"
    )
    yield Finding("warning", "saturation", text, (robot.joint_names[i],), {"rows": rows, "worst": float(worst[i])})


def stuck(surveys: list[Survey], robot: RobotSpec) -> Iterator[Finding]:
    """Does every channel change when it should?"""
    found = []
    for i, name in enumerate(robot.joint_names):
        asked = [s for s in surveys if s.ctrl_range[i] > 0.1]
        still = [s for s in asked if s.qpos_range[i] < 0.03 and s.qpos_range[i] < 0.05 * s.ctrl_range[i]]
        if still:
            text = (
                f"{name} does not move when commanded in {some([s.motion for s in still])}: unplugged, torque off or "
                "not read; leave these out"
            )
            found.append(Finding("error" if len(still) == len(asked) else "warning", "stuck", text, (name,)))
    frozen = [s for s in surveys if s.frozen_s > 0.25]
    if frozen:
        worst = max(frozen, key=lambda s: s.frozen_s)
        text = (
            f"the whole state repeats itself for up to {worst.frozen_s:.2f} s while the command moves in "
            f"{some([s.motion for s in frozen])}: samples were lost; cut the logs there"
        )
        found.append(Finding("warning", "stuck", text))
    yield from found or [Finding("ok", "stuck", "every channel changes when it should")]
