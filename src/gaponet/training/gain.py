"""Shrinkage: how much of the trained correction to apply, chosen in free run on validation motions.

A correction learnt from an hour of one robot is partly noise. Where little is left to correct, as after identification,
half of it can be better than all of it. One number for all joints: chosen joint by joint it fits the few validation
motions rather than the robot (docs/log.md).
"""

from __future__ import annotations

from collections.abc import Callable

from gaponet.model.layers import DeltaNet

GAINS = (0.75, 0.5, 0.25)  # beside 1


def choose_gain(net: DeltaNet, error: Callable[[], float], whole: float) -> float:
    """Set the gain with the least error, and return it.

    Args:
        net: Its gain is changed in place.
        error: That of the network as it is when called.
        whole: The error with gain 1.
    """
    found = {1.0: whole}
    for gain in GAINS:
        net.bounded.gain.fill_(gain)
        found[gain] = error()
    best = min(found, key=lambda gain: found[gain])
    net.bounded.gain.fill_(best)
    return best
