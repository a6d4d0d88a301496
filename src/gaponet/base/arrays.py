"""What annotations call an array, whose docstrings say shape and unit; and what numpy and torch call differently."""

from __future__ import annotations

from importlib import import_module
from typing import Any

import numpy as np

Array = np.ndarray


def library(x: Any) -> Any:
    """The module, numpy or torch, that an array is of."""
    return np if isinstance(x, np.ndarray) else import_module(type(x).__module__.partition(".")[0])


def like(x: Any, values: Any) -> Any:
    """Values as an array of x's kind and device: as they are in numpy, floats in x's type in torch."""
    if isinstance(x, np.ndarray):
        return np.asarray(values)
    new = x.new_tensor if np.asarray(values).dtype.kind == "f" else library(x).tensor
    return new(np.asarray(values), device=x.device)


def zeros_like(x: Any, *shape: int) -> Any:
    """Zeros of x's kind, type and device, numpy or torch."""
    return np.zeros(shape, x.dtype) if isinstance(x, np.ndarray) else x.new_zeros(shape)


def copy_of(x: Any) -> Any:
    """A copy of a numpy or torch array."""
    return x.copy() if isinstance(x, np.ndarray) else x.clone()


def host(x: Any) -> Array:
    """The same in numpy; a copy of a tensor on a GPU."""
    return x if isinstance(x, np.ndarray) else x.cpu().numpy()
