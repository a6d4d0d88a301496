"""Do command and state belong to the same time: in every recording, to its end, and unsmoothed?"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator

import numpy as np

from gaponet.base.arrays import Array
from gaponet.data.signals import Response
from gaponet.data.survey import HERTZ, Survey
from gaponet.robot.finding import Finding, abbreviate
from gaponet.robot.spec import RobotSpec

ROUNDS = 6  # of shifts and of what all follow
FEW = 4  # recordings that say nothing of one among them
LATE, FAR = 0.012, 4.0  # s, and times the usual scatter, by which a recording follows later than the others
FIRST = -0.015  # s: joints that begin so long before their command
EARLY = 1.08  # times as much unexplained without commands to come, from which joints begin before them
LONG, APART = 0.1, 0.05  # s: dead time worth a warning; of one joint beyond the others'
DEAD_TIMES = (
    (0.035, "as good as no dead time"), (LONG, "usual for a bus, a servo's firmware and its inertia"),
    (np.inf, "long; hobby servos have it: look for a buffer, a filter, or clocks of command and state that are apart"),
)  # fmt: skip
DRIFT, SURE, OWN, LASTS = 3e-4, 4.5, 0.7, 10.0  # s a second; errors; what of one motions differ by; s of a recording
NOTCH = 1.5  # depth, natural logarithm of power
WIDTHS = np.geomspace(0.04, 0.4, 150)  # of an average, s
GAP = 2.5  # periods without a sample


def _timing(surveys: list[Survey], robot: RobotSpec) -> Iterator[Finding]:
    """Are commands and states of one time, and is their clock one clock?"""
    step = Counter(s.response.step for s in surveys).most_common(1)[0][0]
    every = [s for s in surveys if s.response.step == step]
    # Across a hole states are interpolated: they begin to move before anything was measured.
    same = [s for s in every if s.longest_gap_ms * s.rate_hz / 1e3 <= GAP] or every
    found = [*_late(every)]
    odd = {recording for f in found for recording in f.values["recordings"]}
    told = Response.following([s.response for s in same], [s.entry.id not in odd for s in same])
    known = np.isfinite(told.onset)
    onset = float(np.median(told.onset[known])) if known.any() else np.nan
    onset = max(onset, 0.0) if known.any() and np.median(told.early[known]) < EARLY else onset
    apart = SURE * _scatter(told.onset - onset)
    if onset < FIRST - step or onset < -max(-FIRST / 3, step, apart):
        text = (
            f"joints begin to move {-onset * 1e3:.0f} ms before their commands: are command and state swapped, or are "
            "their clocks apart? Shift one of them at import"
        )
        found.append(Finding("error", "copied", text, (), {"onset_s": onset}))
    elif np.isfinite(onset):
        words = next(word for most, word in DEAD_TIMES if onset <= most)
        text = f"joints begin to move {max(onset, 0) * 1e3:.0f} ms after their commands: {words}"
        yield Finding("warning" if onset > LONG else "ok", "lag", text, (), {"onset_s": onset})
    for name, late in zip(robot.operated, told.onset - onset, strict=True):
        if late > APART and np.isfinite(told.onset).sum() > 2:
            text = (
                f"{name} begins to move {late * 1e3:.0f} ms later than the other joints: its channel is read late, "
                "filtered or from another bus, or it moves stiffly; shift it at import if the time of reading is known"
            )
            found.append(Finding("warning", "lag", text, (name,), {"extra_s": float(late)}))
    found += _drift(same, told.shifts)
    asked, moved = np.mean([s.spectra for s in same], axis=0)
    width, depth = _averaged(moved)
    if depth > NOTCH and _averaged(asked, np.array([width]))[1] < depth / 3:  # steps at a regular pace have notches too
        text = (
            f"states never move at the multiples of {1 / width:.1f} Hz, as averages over {width * 1e3:.0f} ms: log the "
            "encoder itself; what is averaged is late, and fast motions are lost"
        )
        found.append(Finding("warning", "averaged", text, (), {"width_s": width}))
    yield from found or [Finding("ok", "timing", "commands and states keep one time")]


def _scatter(away: Array) -> float:
    """Standard error of a median from which values are so far away; those unknown do not count."""
    known = np.abs(away[np.isfinite(away)])
    return 1.48 * float(np.median(known)) / np.sqrt(len(known)) if len(known) else np.inf


def _shifts(own: list[Response]) -> Array:
    """How much later each recording follows than all do, (recordings) s: found together with how all follow, since
    one that is late bends what is found of the others."""
    more = Response.following(own).whole
    found = np.where(np.isfinite(more), 0.0, np.nan)
    for _ in range(ROUNDS if np.isfinite(found).sum() >= FEW else 0):
        away = np.nan_to_num(more - np.nanmedian(more))
        if not (far := np.abs(away) > LATE / 2).any():
            break
        found = found + np.where(far, away, 0.0)
        more = Response.following([r.later(-s) for r, s in zip(own, found, strict=True)]).whole
    return found + np.nan_to_num(more)


def _late(surveys: list[Survey]) -> Iterator[Finding]:
    away = _shifts([s.response for s in surveys])
    if np.isfinite(away).sum() < FEW:
        return
    away = away - np.nanmedian(away)
    usual = max(1.48 * float(np.nanmedian(np.abs(away))), 1e-3)
    far = [(s, late) for s, late in zip(surveys, away.tolist(), strict=True) if abs(late) > max(LATE, FAR * usual)]
    for word, these in (("later", [f for f in far if f[1] > 0]), ("sooner", [f for f in far if f[1] < 0])):
        alone = len(these) < FEW
        for part in [[one] for one in these] if alone else [these]:
            which = [f"{s.motion} ({s.entry.meta.unit_id}, {s.entry.meta.payload_mass:g} kg)" for s, _ in part]
            ms = sorted(abs(late) * 1e3 for _, late in part)
            by = f"{ms[0]:.0f} ms" if alone else f"{ms[0]:.0f} to {ms[-1]:.0f} ms"
            text = (
                f"{abbreviate(which)} {'follows its' if alone else 'follow their'} commands {by} {word} than the other "
                "recordings: clocks of command and state that are apart, another servo, or friction in slow motions; "
                "leave them out if it is the clocks"
            )
            values = {"recordings": [s.entry.id for s, _ in part], "late_s": [late for _, late in part]}
            yield Finding("warning", "lag", text, (), values)


def _drift(surveys: list[Survey], shifts: np.ndarray) -> Iterator[Finding]:
    long = (between := np.array([s.response.duration for s in surveys])) >= LASTS  # in less friction shifts more
    between = between[long] * (1 - 1 / shifts.shape[1])
    first, middle, last = shifts[long, 0], shifts[long, 1:-1].mean(axis=1), shifts[long, -1]
    slope, bent = (last - first) / between, (last + first - 2 * middle) / between / np.sqrt(3)
    slope, bent = slope[np.isfinite(slope)], bent[np.isfinite(bent)]  # of one that drifts, what bends is chance
    if len(slope) < FEW:
        return
    drift = float(np.median(slope))
    error = max(OWN * _scatter(slope - drift), _scatter(bent), 2e-3 / float(between.max()) / np.sqrt(len(slope)))
    if abs(drift) > max(DRIFT, SURE * error):
        text = (
            f"to its end each recording follows its commands {'later' if drift > 0 else 'sooner'} "
            f"({abs(drift) * 1e6:.0f} ± {error * 1e6:.0f} ppm): the clocks of both drift apart; log them with one"
        )
        yield Finding("error", "clock", text, (), {"drift": drift})


def _averaged(levels: Array, widths: Array = WIDTHS) -> tuple[float, float]:
    """Width in s of the average that best explains notches at its multiples in `levels` (H), and how deep they are."""
    best = (0.0, 0.0)
    known = HERTZ[np.isfinite(levels)]
    if not len(known):
        return best
    for width in widths:
        depth = []
        for k in range(1, 5):
            if (k + 0.4) / width > known[-1]:
                break
            near = levels[np.abs(HERTZ - k / width) < max(0.11, 0.012 * k / width)].min()
            depth.append(np.interp([(k - 0.35) / width, (k + 0.35) / width], HERTZ, levels).mean() - near)
        if depth and min(depth) > best[1]:
            best = (float(width), float(min(depth)))
    return best


CHECKS = (_timing,)
