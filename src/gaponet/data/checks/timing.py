"""Do command and state belong to the same time: in every recording, to its end, and unsmoothed?"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from gaponet.base.arrays import Array
from gaponet.data.checks.check import Check
from gaponet.data.checks.survey import SPECTRUM_HZ, Survey
from gaponet.data.signals import (
    FAST_COMMAND_RAD_S,
    SHIFT_STEP_S,
    SHIFTS_S,
    CommonResponse,
    Response,
)
from gaponet.robot.finding import Finding, abbreviate
from gaponet.robot.spec import RobotSpec

MAX_ITERATIONS = 6  # of estimating shifts and the common response in turn
MIN_RECORDINGS = 4  # from which one of them can be compared with the others
# A late recording follows later than the others by all of these.
MIN_SHIFT_S = 0.012
SHIFT_SCATTERS = 4.0
MIN_SHIFT_PERIODS = 0.75
MIN_AGREEMENT = 0.5  # of such a shift that the delays of single joints must show
# of the unevenness of rows: a command may be that late, and an interpolated state that early
UNEVEN_ROWS_SHARE = 2.0
MIN_LEAD_S = 0.015  # by which joints begin to move before their commands
# unexplained motion without future commands over that with them, if joints move before them
MIN_EARLY_RATIO = 1.08
MAX_DEAD_TIME_S = 0.1  # of all joints
MAX_EXTRA_LAG_S = 0.05  # of one joint, beyond the others
WHY_LATE = "its channel is read late, filtered or from another bus, or it moves stiffly"
# Up to so many s → what a dead time before joints begin to move is.
VERDICTS = {
    0.035: "as good as no dead time",
    MAX_DEAD_TIME_S: "usual for a bus, a servo's firmware and its inertia",
    np.inf: "long; hobby servos have it: look for a buffer, a filter, or clocks of command and "
    "state that are apart",
}
MIN_DRIFT = 3e-4  # of a clock, s/s
MIN_DRIFT_ERRORS = 4.5  # standard errors by which a drift, or a lead, is no chance
MOTION_SHARE = 0.7  # of the scatter of slopes that motions explain
MIN_DRIFT_DURATION_S = 10.0  # of a recording; in shorter ones friction changes the shift
MIN_NOTCH_DEPTH = 1.5  # natural logarithm of power
AVERAGING_WIDTHS_S = np.geomspace(0.04, 0.4, 150)
MAX_NOTCHES = 4  # of a moving average that are looked at, the lowest frequencies first
NOTCH_HZ = 0.11  # half the width in which a notch is looked for, at least
NOTCH_SHARE = 0.012  # of its frequency, the same
SIDES = (-0.35, 0.35)  # between two notches, where levels are compared with theirs


def _timing(surveys: list[Survey], robot: RobotSpec) -> Iterator[Finding]:
    """Do commands and states have one clock?"""
    surveys = [survey for survey in surveys if not np.isfinite(survey.tracking.copied_rows).any()]
    if not surveys:
        yield Finding("ok", "timing", "a command that repeats the state shows no clocks")
        return
    groups = _by_rate(surveys)
    found = []
    for group in groups:
        rate = float(np.median([survey.timing.rate_hz for survey in group]))
        for finding in _timing_at_one_rate(group, robot):
            if len(groups) > 1:
                message = f"{len(group)} of {len(surveys)} at {rate:.1f} Hz: {finding.message}"
                finding = replace(finding, message=message)
            found.append(finding)
    if all(finding.level == "ok" for finding in found):
        found.append(Finding("ok", "timing", "commands and states have the same clock"))
    yield from found


def _by_rate(surveys: list[Survey]) -> list[list[Survey]]:
    """Return the recordings whose responses can be compared, the largest group first."""
    groups: list[list[Survey]] = []
    for survey in sorted(surveys, key=lambda one: one.tracking.response.step):
        response = survey.tracking.response
        if not groups or not response.is_comparable(groups[-1][0].tracking.response):
            groups.append([])
        groups[-1].append(survey)
    return sorted(groups, key=len, reverse=True)


def _timing_at_one_rate(comparable: list[Survey], robot: RobotSpec) -> Iterator[Finding]:
    """Report what is wrong with the clocks of recordings at one rate."""
    step = comparable[0].tracking.response.step  # s
    # Across a gap states are interpolated: they begin to move before anything was measured.
    complete = [survey for survey in comparable if not survey.timing.missing_samples] or comparable
    uneven_ms = max(survey.timing.uneven_ms for survey in complete)
    unknown = uneven_ms * UNEVEN_ROWS_SHARE / 1e3  # s
    late = _late_recordings(comparable, unknown)
    common = _common_response(complete, late)
    onset = _usual_onset(common)
    findings = [*_report_late(late)]  # of what is wrong
    if _moves_early(common, onset, unknown, step):
        findings.append(_early(onset))
    elif np.isfinite(onset):
        yield _dead_time(onset)
    findings += _late_joints(common, onset, robot)
    findings += clock_drift(complete, common.shifts, unknown)
    if unknown < step:
        findings += _averaged(complete)
    yield from findings


# recordings that follow their commands later than the others, and by how much, s; < 0 is sooner
_Late = list[tuple[Survey, float]]


def _common_response(surveys: list[Survey], late: _Late) -> CommonResponse:
    """Return the common response of the recordings that are not late."""
    odd = {survey.entry.id for survey, _ in late}
    usual = [survey.entry.id not in odd for survey in surveys]
    return Response.common([survey.tracking.response for survey in surveys], usual)


def _usual_onset(common: CommonResponse) -> float:
    """Return when joints usually begin to move after their commands, s; NaN if it is not known.

    It is negative only where commands that are still to come explain the motion: else it is chance.
    """
    known = np.isfinite(common.onset)
    if not known.any():
        return np.nan
    onset = float(np.median(common.onset[known]))
    if np.median(common.early[known]) < MIN_EARLY_RATIO:
        return max(onset, 0.0)
    return onset


def _moves_early(common: CommonResponse, onset: float, unknown: float, step: float) -> bool:
    """Return True if joints begin to move before their commands.

    Args:
        onset: Of _usual_onset, s.
        unknown: Time that uneven rows leave open, s.
        step: Resolution of the response, s.
    """
    if onset < -unknown - MIN_LEAD_S - step:
        return True
    # a shorter lead counts where the joints agree on it
    error = MIN_DRIFT_ERRORS * _standard_error(common.onset - onset)
    return onset < -unknown - max(MIN_LEAD_S / 3, step, error)


def _early(onset: float) -> Finding:
    text = (
        f"joints begin to move {-onset * 1e3:.0f} ms before their commands: are command and "
        "state swapped, or are their clocks apart? Correct the time stamps, and import again"
    )
    return Finding("error", "copied", text, (), {"onset_s": onset})


def _dead_time(onset: float) -> Finding:
    verdict = verdict_on(onset, VERDICTS)
    text = f"joints begin to move {max(onset, 0) * 1e3:.0f} ms after their commands: {verdict}"
    level = "warning" if onset > MAX_DEAD_TIME_S else "ok"
    return Finding(level, "lag", text, (), {"onset_s": onset})


def verdict_on(seconds: float, verdicts: dict[float, str]) -> str:
    """Return what a time is. verdicts: up to so many s → what it is, ascending."""
    return next(words for limit, words in verdicts.items() if seconds <= limit)


def _late_joints(common: CommonResponse, onset: float, robot: RobotSpec) -> Iterator[Finding]:
    """Find joints that begin to move later than the others."""
    if np.isfinite(common.onset).sum() <= 2:
        return
    for name, extra in zip(robot.operated, common.onset - onset, strict=True):
        if extra > MAX_EXTRA_LAG_S:
            text = (
                f"{name} begins to move {extra * 1e3:.0f} ms later than the other joints: "
                f"{WHY_LATE}; shift it at import if the time of reading is known"
            )
            yield Finding("warning", "lag", text, (name,), {"extra_s": float(extra)})


def _averaged(surveys: list[Survey]) -> Iterator[Finding]:
    """Find states that are averages over time."""
    commanded, moved = np.mean([survey.spectra for survey in surveys], axis=0)
    width, depth = _averaging(moved)
    if depth <= MIN_NOTCH_DEPTH:
        return
    # steps at a regular pace have notches too
    in_commands = _averaging(commanded, np.array([width]))[1]
    if in_commands < depth / 3:
        text = (
            f"states never move at the multiples of {1 / width:.1f} Hz, as averages over "
            f"{width * 1e3:.0f} ms: log the encoder itself; what is averaged is late, and fast "
            "motions are lost"
        )
        yield Finding("warning", "averaged", text, (), {"width_s": width})


def _standard_error(deviations: Array) -> float:
    """Return the standard error of a median from the deviations of the values; unknown ones do not
    count.
    """
    known = np.abs(deviations[np.isfinite(deviations)])
    if not len(known):
        return np.inf
    scatter = 1.48 * float(np.median(known))  # standard deviation, of a normal distribution
    return float(scatter / np.sqrt(len(known)))


def _shifts(responses: list[Response]) -> Array:
    """Return how much later each recording follows than all do, (recordings) s.

    Shifts and the common response are estimated in turn, since a late recording changes the common
    response.
    """
    more = Response.common(responses).whole
    shifts = np.where(np.isfinite(more), 0.0, np.nan)
    if np.isfinite(shifts).sum() < MIN_RECORDINGS:
        return np.asarray(shifts + np.nan_to_num(more))
    for _ in range(MAX_ITERATIONS):
        deviation = np.nan_to_num(more - np.nanmedian(more))
        far = np.abs(deviation) > MIN_SHIFT_S / 2
        if not far.any():
            break
        shifts = shifts + np.where(far, deviation, 0.0)
        moved = [r.later(-shift) for r, shift in zip(responses, shifts, strict=True)]
        more = Response.common(moved).whole
    return np.asarray(shifts + np.nan_to_num(more))


def _late_recordings(surveys: list[Survey], unknown: float) -> _Late:
    """Return the recordings that follow their commands later, or sooner, than the others.

    Args:
        unknown: Time that uneven rows leave open, s.
    """
    shifts = _shifts([survey.tracking.response for survey in surveys])
    if np.isfinite(shifts).sum() < MIN_RECORDINGS:
        return []
    shifts = shifts - np.nanmedian(shifts)
    scatter = max(1.48 * float(np.nanmedian(np.abs(shifts))), 1e-3)
    period = float(np.median([1 / survey.timing.rate_hz for survey in surveys]))
    limit = max(MIN_SHIFT_S, SHIFT_SCATTERS * scatter, unknown, MIN_SHIFT_PERIODS * period)
    delays = _relative_delays(surveys)
    late: _Late = []
    for survey, shift, delay in zip(surveys, shifts.tolist(), delays.tolist(), strict=True):
        fast = max(survey.tracking.speed) >= FAST_COMMAND_RAD_S  # stiction delays slow motions
        if abs(shift) > limit and fast and _agree(shift, delay):
            late.append((survey, shift))
    return late


def _report_late(late: _Late) -> Iterator[Finding]:
    """Report recordings that follow their commands later, or sooner, than the others."""
    yield from _report_group("later", [(survey, shift) for survey, shift in late if shift > 0])
    yield from _report_group("sooner", [(survey, shift) for survey, shift in late if shift < 0])


def _report_group(word: str, group: _Late) -> Iterator[Finding]:
    """Report recordings that are all later, or all sooner: a few each by itself, many as one."""
    if len(group) >= MIN_RECORDINGS:
        yield _shift_finding(word, group)
        return
    for one in group:
        yield _shift_finding(word, [one])


def _shift_finding(word: str, group: _Late) -> Finding:
    labels = []
    for survey, _ in group:
        meta = survey.meta
        labels.append(f"{meta.motion} ({meta.unit_id}, {meta.payload_mass:g} kg)")
    ms = sorted(abs(shift) * 1e3 for _, shift in group)
    follow = "follow their"
    by = f"{ms[0]:.0f} to {ms[-1]:.0f} ms"
    if len(group) == 1:
        follow = "follows its"
        by = f"{ms[0]:.0f} ms"
    text = (
        f"{abbreviate(labels)} {follow} commands {by} {word} than the other recordings: clocks of "
        "command and state that are apart, or another servo; leave them out if it is the clocks"
    )
    values = {
        "recordings": [survey.entry.id for survey, _ in group],
        "late_s": [shift for _, shift in group],
    }
    return Finding("warning", "lag", text, (), values)


def _relative_delays(surveys: list[Survey]) -> Array:
    """Return how much longer the measured delays of each recording are than those of the same
    joints in all, (N) s.

    NaN where no joint's delay is known.
    """
    delays = np.array([survey.tracking.delay for survey in surveys])  # (recordings, n)
    usual = np.full(delays.shape[1], np.nan)
    known = np.isfinite(delays).sum(axis=0) > 1
    usual[known] = np.nanmedian(delays[:, known], axis=0)
    longer = delays - usual
    result = np.full(len(surveys), np.nan)
    some = np.isfinite(longer).any(axis=1)
    result[some] = np.nanmedian(longer[some], axis=1)
    return result


def _agree(shift: float, delay: float) -> bool:
    """Return True if the delays that the same page shows do not contradict a shift; both relative
    to the others, s.
    """
    if np.isnan(delay):
        return abs(shift) < float(SHIFTS_S[-1])
    return delay * shift > 0 and abs(delay) >= min(MIN_AGREEMENT * abs(shift), MIN_SHIFT_S)


def clock_drift(surveys: list[Survey], shifts: Array, unknown: float = 0.0) -> Iterator[Finding]:
    """Find a drift between the clocks of command and state.

    Args:
        shifts: Of the parts of each recording, (recordings, parts) s.
        unknown: Time that uneven rows leave open, s.
    """
    duration = np.array([survey.tracking.response.duration for survey in surveys])
    long = duration >= MIN_DRIFT_DURATION_S
    between = duration[long] * (1 - 1 / shifts.shape[1])  # from the first part to the last, s
    first = shifts[long, 0]
    middle = shifts[long, 1:-1].mean(axis=1)
    last = shifts[long, -1]
    # Of each recording, s/s. A drift has a slope and no curvature; scaled so that independent
    # errors of the parts scatter both alike, curvature shows the scatter of slopes.
    slope = (last - first) / between
    curvature = (last + first - 2 * middle) / between / np.sqrt(3)
    slope = slope[np.isfinite(slope)]
    curvature = curvature[np.isfinite(curvature)]
    if len(slope) < MIN_RECORDINGS:
        return
    drift = float(np.median(slope))
    longest = float(between.max())
    resolution = SHIFT_STEP_S / longest / np.sqrt(len(slope))
    scatter = MOTION_SHARE * _standard_error(slope - drift)
    error = max(scatter, _standard_error(curvature), resolution)
    if abs(drift) > max(MIN_DRIFT, MIN_DRIFT_ERRORS * error, unknown / longest):
        word = "later" if drift > 0 else "sooner"
        text = (
            f"to its end each recording follows its commands {word} ({abs(drift) * 1e6:.0f} ± "
            f"{error * 1e6:.0f} ppm): the clocks of both drift apart; log them with one"
        )
        yield Finding("error", "clock", text, (), {"drift": drift})


def _averaging(levels: Array, widths: Array = AVERAGING_WIDTHS_S) -> tuple[float, float]:
    """Return the width, s, of the moving average that best explains notches in a spectrum (H), and
    their depth.
    """
    known = SPECTRUM_HZ[np.isfinite(levels)]
    best_width = 0.0
    best_depth = 0.0
    if not len(known):
        return best_width, best_depth
    for width in widths:
        depths = []
        for k in range(1, MAX_NOTCHES + 1):
            if (k + 0.4) / width > known[-1]:
                break
            depths.append(_notch_depth(levels, width, k))
        if depths and min(depths) > best_depth:
            best_width = float(width)
            best_depth = min(depths)
    return best_width, best_depth


def _notch_depth(levels: Array, width: float, k: int) -> float:
    """Return how far a spectrum (H) falls at the k-th zero, k / width, of a moving average."""
    notch_hz = k / width
    near = np.abs(SPECTRUM_HZ - notch_hz) < max(NOTCH_HZ, NOTCH_SHARE * k / width)
    sides_hz = [(k + side) / width for side in SIDES]
    sides = np.interp(sides_hz, SPECTRUM_HZ, levels)
    return float(sides.mean() - levels[near].min())


CHECKS = (Check(_timing, "timing", "", may_be_error=True, needs_commands=True),)
