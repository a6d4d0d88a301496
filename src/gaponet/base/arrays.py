"""The array type of annotations (docstrings state shapes and units), and operations common to
numpy and torch.
"""

from __future__ import annotations

from collections.abc import Sequence
from importlib import import_module
from typing import Any, TypeVar

import numpy as np

Array = np.ndarray
_T = TypeVar("_T")
GOLDEN_RATIO = (5**0.5 - 1) / 2


def array_module(x: Any) -> Any:
    """Return the module of an array: numpy or torch."""
    return np if isinstance(x, np.ndarray) else import_module(type(x).__module__.partition(".")[0])


def array_like(x: Any, values: Any) -> Any:
    """Convert values to an array of x's module and device; in torch, floats get the type of x."""
    if isinstance(x, np.ndarray):
        return np.asarray(values)
    new = x.new_tensor if np.asarray(values).dtype.kind == "f" else array_module(x).tensor
    return new(np.asarray(values), device=x.device)


def within(values: Array, low: Array | float, high: Array | float) -> Array:
    """Limit values to [low, high]: np.clip, in a third of its time where arrays have few joints."""
    return np.asarray(np.minimum(np.maximum(values, low), high))


def zeros_like(x: Any, *shape: int) -> Any:
    """Return zeros of this shape, with the module, type and device of x."""
    return np.zeros(shape, x.dtype) if isinstance(x, np.ndarray) else x.new_zeros(shape)


def copy_array(x: Any) -> Any:
    """Copy a numpy or torch array."""
    return x.copy() if isinstance(x, np.ndarray) else x.clone()


def to_numpy(x: Any) -> Array:
    """Return a numpy or torch array in numpy; a tensor on a GPU is copied to the host."""
    return x if isinstance(x, np.ndarray) else x.cpu().numpy()


def float32(x: Any) -> Any:
    """Return a numpy or torch array as float32."""
    return x.astype(np.float32) if isinstance(x, np.ndarray) else x.float()


def joined(parts: Sequence[_T]) -> _T:
    """Return dataclasses of arrays as one: each field of all parts, one behind the other."""
    fields = {}
    for name in vars(parts[0]):
        fields[name] = np.concatenate([getattr(part, name) for part in parts])
    return type(parts[0])(**fields)


def evenly_spread_order(count: int, phase: float = 0.0) -> Array:
    """Return 0 to count − 1, (count,), in an order whose first ones are spread evenly, however
    many of them are taken.

    Multiples of the golden ratio fill a circle in this way. In a regular sequence, such as four
    payloads again and again, an even step may meet one payload alone; this order does not.

    Args:
        phase: 0 to 1; another one begins elsewhere.
    """
    places = (GOLDEN_RATIO * np.arange(count) + phase) % 1.0
    return np.argsort(places)
