"""Is the command a copy of the state? Judged on the rows as they were logged: resampling hides
copies.

Converters write such tables: the command of a row is the recorded position of that row or of the
next one. What was sent to the servos is then not in the log.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from gaponet.base.arrays import Array
from gaponet.data.log import Channel
from gaponet.data.signals import encoder_step

MAX_COPIED_ROWS = 3  # in both directions
MIN_COPIED_CHANGES = 20  # of the command; fewer can be equal by chance
MAX_COMPARED_CHANGES = 20_000  # one after the other, amid a long recording; more tell nothing new
# steps of the readings that a joint passes from row to row, from which chance repeats few of them
FINE_STEPS = 10
# Share of the changes that a copy repeats. Rows may be missing. A stiff servo with a coarse encoder
# repeats most of a slow motion.
FINE_SHARE = 0.7
COARSE_SHARE = 0.99
# Steps of rounded readings, coarse first: decimals of rad and deg, and turns divided by powers of
# two.
USUAL_STEPS_RAD = sorted(
    [
        *(10.0**-k for k in range(1, 7)),
        *(np.radians(10.0**-k) for k in range(6)),
        *(2 * np.pi / 2**k for k in range(8, 21)),
    ],
    reverse=True,
)
MAX_OFF_STEP = 0.02  # of a step, by which rounded readings lie beside its multiples
# A copy may have noise on it: what is left is small, of one row unlike that of the next, and tells
# nothing of the motion. A servo's error is none of these.
NOISE_SHARE = 0.3  # of the usual change of the command
MIN_NOISE_ROWS = 100
MAX_COLOUR = 0.15  # correlation of the noise with that of the row before
MAX_EXPLAINED = 0.05  # share of the noise that position, velocity and acceleration explain
NO_DIGIT_RAD = 1.01e-6  # closer readings are the same one, in another precision


def copied_rows(command: Channel, state: Channel) -> Array:
    """Return by how many rows the state repeats the command, (n); 0: in the same row; NaN where it
    does not.

    "Repeats" means to the last digit, or to the step of the coarser of both.

    Args:
        command: Commands (k, n); only those that differ from the one before are compared, since a
            joint at rest is where it was told to be.
        state: Positions (m, n) of the same joints, with any clock.
    """
    rows, nearest = _pairs(command.time, state.time)
    inside = (nearest >= MAX_COPIED_ROWS) & (nearest < len(state.time) - MAX_COPIED_ROWS)
    rows = rows[inside]
    nearest = nearest[inside]
    shifts = np.arange(-MAX_COPIED_ROWS, MAX_COPIED_ROWS + 1)
    result = np.full(command.values.shape[1], np.nan)
    if len(rows) <= MIN_COPIED_CHANGES:
        return result
    for joint in range(len(result)):
        told = command.values[rows, joint].astype(float)
        reading = state.values[:, joint].astype(float)
        changes = np.flatnonzero(np.diff(told)) + 1
        if len(changes) < MIN_COPIED_CHANGES:
            continue
        if len(changes) > MAX_COMPARED_CHANGES:
            start = (len(changes) - MAX_COMPARED_CHANGES) // 2
            changes = changes[start : start + MAX_COMPARED_CHANGES]
        compared = _Changes(
            told=told[changes],
            later=reading[nearest[changes][:, None] + shifts],
            shifts=shifts,
            usual=float(np.median(np.abs(told[changes] - told[changes - 1]))),
        )
        result[joint] = _shift(compared)
    return result


@dataclass(frozen=True)
class _Changes:
    """Changes of one joint's command, and the states of the rows around each."""

    told: Array  # commands, (changes) rad
    later: Array  # states, (changes, shifts) rad
    shifts: Array  # rows from the command to the state, (shifts)
    usual: float  # size of a change from one row to the next, rad


def _pairs(command: Array, state: Array) -> tuple[Array, Array]:
    """Return rows of the command, and the row of the state nearest in time to each; of the slower
    of both, each row.
    """
    if len(command) == len(state) and np.array_equal(command, state):
        rows = np.arange(len(command))
        return rows, rows
    if len(command) <= len(state):
        return np.arange(len(command)), _nearest(state, command)
    return _nearest(command, state), np.arange(len(state))


def _nearest(time: Array, at: Array) -> Array:
    """Return the row of `time` nearest to each instant of `at`."""
    right = np.clip(np.searchsorted(time, at), 1, len(time) - 1)
    before_is_nearer = at - time[right - 1] < time[right] - at
    return np.asarray(right - before_is_nearer)


def _shift(changes: _Changes) -> float:
    """Return the shift of one joint's copy, rows; NaN if it is none."""
    told = changes.told
    steps = [_step(told), _step(changes.later[:, MAX_COPIED_ROWS])]
    coarse = max(steps)
    rounded = min(steps) < 0.9 * coarse  # one of them, to the steps of the other
    tolerance = NO_DIGIT_RAD
    if rounded:
        tolerance = max(0.501 * coarse, NO_DIGIT_RAD)
    equal = np.abs(changes.later - told[:, None]) <= tolerance  # (changes, shifts)
    if changes.usual >= FINE_STEPS * coarse:
        if equal.any(axis=1).mean() < FINE_SHARE:
            return _noisy_shift(changes)
        return float(changes.shifts[equal.sum(axis=0).argmax()])
    share = equal.mean(axis=0)
    if tolerance > NO_DIGIT_RAD or share.max() < COARSE_SHARE:
        return np.nan
    return float(changes.shifts[share.argmax()])


def _noisy_shift(changes: _Changes) -> float:
    """Return the shift of one joint's copy that has noise on it, rows; NaN if it is none."""
    if len(changes.told) < MIN_NOISE_ROWS:
        return np.nan
    errors = changes.later - changes.told[:, None]
    size = np.sqrt((errors**2).mean(axis=0))  # rms at each shift, rad
    best = int(size.argmin())
    if size[best] > NOISE_SHARE * changes.usual or size[best] <= NO_DIGIT_RAD:
        return np.nan
    noise = errors[:, best]
    colour = np.corrcoef(noise[1:], noise[:-1])[0, 1]
    if abs(colour) > MAX_COLOUR or _explained_by_motion(noise, changes.later) > MAX_EXPLAINED:
        return np.nan
    return float(changes.shifts[best])


def _explained_by_motion(noise: Array, later: Array) -> float:
    """Return the share of noise (changes) that position, velocity and acceleration of the rows
    around, (changes, shifts), explain.
    """
    position = later.mean(axis=1)
    first = later[:, 0]
    last = later[:, -1]
    terms = [np.ones(len(noise)), position, last - first, last + first - 2 * position]
    motion = np.stack(terms, axis=1)
    rest = noise - motion @ np.linalg.lstsq(motion, noise, rcond=None)[0]
    return float(1 - (rest**2).sum() / (noise**2).sum())


def _step(values: Array) -> float:
    """Return the step to which readings (k,) were rounded, rad; 0 where they are continuous."""
    from_first = values - values[0]
    for step in USUAL_STEPS_RAD:
        multiples = from_first / step
        if np.abs(multiples - np.round(multiples)).max() < MAX_OFF_STEP:
            return float(step)
    return encoder_step([values])
