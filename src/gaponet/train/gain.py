"""Shrinkage: how much of the trained correction to apply, chosen in free run on validation motions.

A correction learnt from an hour of one robot is partly noise. Where little is left to correct, as after identification,
half of it can be better than all of it. One number for all joints: chosen joint by joint it fits the few validation
motions rather than the robot (docs/log.md).
"""

from __future__ import annotations

from collections.abc import Callable

from gaponet.model.deeponet import DeltaMLP, OperatorNet

GAINS = (1.0, 0.75, 0.5, 0.25)


def choose_gain(net: OperatorNet | DeltaMLP, error: Callable[[], float]) -> float:
    """Set the gain of GAINS with the least error, and return it; error() is that of the network as it then is."""
    found = {}
    for gain in GAINS:
        net.bounded.gain.fill_(gain)
        found[gain] = error()
    best = min(GAINS, key=lambda gain: found[gain])
    net.bounded.gain.fill_(best)
    return best
