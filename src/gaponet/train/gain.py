"""Shrinkage: how much of the trained correction each joint should get, chosen in free run on validation motions.

A correction learnt from an hour of one robot is partly noise. Where little is left to correct, as after identification,
half of it can be better than all of it, and none of it better still.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import torch

from gaponet.model.deeponet import DeltaMLP, OperatorNet

Array = np.ndarray

GAINS = (0.0, 0.25, 0.5, 0.75)


def choose_gain(net: OperatorNet | DeltaMLP, errors: Callable[[], Array]) -> float:
    """Set each joint's gain to the one of GAINS, or what it is, with the least error; returns the error with all set.

    Args:
        net: Changed in place, and only if the gains chosen joint by joint do better together too.
        errors: Mean |error| of each joint in free run with the network as it is, (n,).
    """
    gain = net.bounded.gain
    present = gain.clone()
    tried, seen = [present], [errors()]
    for g in GAINS:
        gain.fill_(g)
        tried.append(gain.clone())
        seen.append(errors())
    best = torch.from_numpy(np.argmin(seen, axis=0))
    gain.copy_(torch.stack(tried).gather(0, best[None])[0])
    together = float(errors().mean())
    if together >= seen[0].mean():
        gain.copy_(present)
        return float(seen[0].mean())
    return together
