"""Backlash beside friction: whether a search for it is worth its time, and how probable it is,
joint by joint.

A constant load presses motor and link together and hides the gap. Where the load changes its sign,
the link crosses the gap by itself. No friction does that, so the two can be told apart.
"""

from __future__ import annotations

from collections.abc import Mapping
from collections.abc import Sequence as ListOf

import numpy as np
from scipy.special import expit

from gaponet.base.arrays import Array
from gaponet.base.text import format_uncertainty
from gaponet.sysid.axes import Values, one_candidate
from gaponet.sysid.problem import JointFit

SCREENED_WIDTHS_RAD = (1e-3, 2.5e-3, 5e-3, 1e-2, 2e-2)
# Of a joint's squared error, at otherwise equal values.
MIN_SCREENED_GAIN = 0.02
MIN_PROBABILITY = 0.9  # of a gap that stays in the robot
MIN_WIDTH_RAD = 5e-4  # of a gap that is reported though it is not probable
MIN_SQUARED_ERROR = 1e-12  # rad², so that a ratio of two stays finite


def worth_a_search(fit: JointFit, values: Values) -> bool:
    """Return whether a gap of SCREENED_WIDTHS_RAD makes some joint's rollouts better, at values
    (n,) otherwise.
    """
    widths = np.array([0.0, *SCREENED_WIDTHS_RAD])
    candidates = {}  # field → (widths, n)
    for field, value in values.items():
        candidates[field] = np.repeat(value[None], len(widths), axis=0)
    candidates["backlash"] = np.repeat(widths[:, None], fit.bounds.n, axis=1)
    errors = fit.rollouts.errors(candidates)  # (widths, n, windows, rows) rad
    squared_error = np.square(errors).sum(axis=(2, 3))  # (widths, n)
    without_gap = squared_error[0]
    is_better = squared_error.min(axis=0) < (1 - MIN_SCREENED_GAIN) * without_gap
    return bool(is_better.any())


def probability(fit: JointFit, without: Values, values: Values) -> Array:
    """Return the probability of backlash by the Bayesian information criterion, (n,); both odds
    are equal before.

    N measurements with squared errors S₀ without a gap and S with it, which is one more parameter,
    have the log odds (N log(S₀ / S) − log N) / 2. Parts of the recordings as long as the errors'
    correlation time count as one measurement.

    Args:
        without, values: Best values (n,) without and with backlash, of the same search.
    """
    squared_without = np.maximum(_squared_error(fit, without), MIN_SQUARED_ERROR)
    squared_with = np.maximum(_squared_error(fit, values), MIN_SQUARED_ERROR)
    measurements = np.maximum(fit.rollouts.seconds / fit.prior.correlation_time, 1.0)  # (n,)
    gain = np.log(squared_without / squared_with)
    log_odds = 0.5 * (measurements * gain - np.log(measurements))
    return np.asarray(expit(log_odds))


def _squared_error(fit: JointFit, values: Values) -> Array:
    """Return the sum of squared errors of each joint at values (n,), (n,) rad²."""
    errors = fit.rollouts.flat_errors(one_candidate(values))[0]  # (n, rows) rad
    return np.asarray(np.square(errors).sum(axis=1))


def only_probable(
    without: ListOf[Values],
    values: ListOf[Values],
    chance: Array,
) -> list[Values]:
    """Return values (n,) with backlash at the joints where it is probable, and the others'
    without.
    """
    is_probable = chance >= MIN_PROBABILITY
    chosen = []
    for otherwise, with_backlash in zip(without, values, strict=True):
        mixed = {}
        for field, value in with_backlash.items():
            mixed[field] = np.where(is_probable, value, otherwise.get(field, 0.0))
        chosen.append(mixed)
    return chosen


def findings(
    joints: ListOf[str],
    width: Array,
    chance: Array,
    std: Mapping[str, Mapping[str, float]],
) -> tuple[str, ...]:
    """Return a sentence for each joint with backlash, or with a gap that friction explains as well.

    Args:
        width, chance: Fitted gap, rad, and its probability, (n,).
        std: Joint → field → standard error; of a robot without backlash it lacks the field.
    """
    sentences = []
    for joint, gap, p in zip(joints, width.tolist(), chance.tolist(), strict=True):
        finding = _finding(gap, p, std[joint].get("backlash"))
        if finding:
            sentences.append(f"{joint}: {finding}")
    return tuple(sentences)


def _finding(gap: float, p: float, std: float | None) -> str:
    """Return what is known of a gap, rad, of probability p; nothing of one that is neither probable
    nor wide.

    Args:
        std: Standard error, rad; None if the robot was left without backlash.
    """
    mrad = 1e3 * gap
    if p >= MIN_PROBABILITY and std is not None:
        size = format_uncertainty(mrad, 1e3 * std)
        chance = "above 0.99" if p > 0.99 else f"{p:.2f}"
        return f"backlash {size} mrad (probability {chance})"
    if p >= MIN_PROBABILITY:
        return f"validation motions do not show a gap of {mrad:.1f} mrad that fits suggest"
    if gap > MIN_WIDTH_RAD:
        return (
            f"backlash of {mrad:.1f} mrad is not distinguishable from static friction "
            f"(probability {p:.2f}); play the creep motions of gaponet excite to tell"
        )
    return ""
