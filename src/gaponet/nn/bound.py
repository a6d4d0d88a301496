"""Bound of a network's answers at run time: within ±delta_max, and zero where an answer is not
finite.

A network that was tested on some inputs may give anything for others: NaN, infinity, or a
correction far beyond the training data. Everything that evaluates a network in a control loop
therefore uses its answer through AnswerBound. The step that gaponet export writes for torch
(export/torch_program.py) does the same.
"""

from __future__ import annotations

import warnings
from typing import Any

import numpy as np

from gaponet.base.arrays import array_module


class AnswerBound:
    """Limits the answers of one network.

    An answer is what the network returns for one robot, (n,) rad. If one of its numbers is not
    finite, the whole answer counts as no correction: the joints then follow their targets as
    without a model.

    Attributes:
        delta_max: Largest correction of the model's card, rad.
        refused: Number of answers that were not finite.
    """

    def __init__(self, delta_max: float) -> None:
        self.delta_max = delta_max
        self.refused = 0

    def __call__(self, delta: Any) -> Any:
        """Return the answers (…, n) rad within the bound; numpy's or torch's, as given.

        The first answer that is not finite gives a RuntimeWarning.
        """
        if isinstance(delta, np.ndarray) and np.vdot(delta, delta) <= self.delta_max**2:
            return delta  # the usual case in 1 µs: each entry is finite and within the bound
        module = array_module(delta)
        finite = module.isfinite(delta).all(-1)[..., None]
        count = int((~finite).sum())
        if count and not self.refused:
            warnings.warn(
                "the network's answer is not finite (NaN or infinity); zero is used instead: no "
                "correction",
                RuntimeWarning,
                stacklevel=2,
            )
        self.refused += count
        limited = module.clip(delta, -self.delta_max, self.delta_max)
        return module.where(finite, limited, 0.0)
