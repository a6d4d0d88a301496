"""Pair: a recording and its simulated twin, row by row."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Any

from gaponet.base.arrays import Array
from gaponet.base.errors import DatasetError
from gaponet.data.sequence import Sequence


@dataclass(frozen=True)
class Twin:
    """What the nominal simulator did under the same commands from the same start.

    Attributes:
        model_hash: Hash of the simulator (sim.model.model_hash).
        qpos, qvel, tau: (T, n) rad, rad/s, N·m; row t is the state at t·dt, tau the actuator torque at the end of
            [t-1, t).
        ctrl: (T, n) rad, targets applied over [t, t+1), where a corrector altered them; not stored.
    """

    model_hash: str
    qpos: Array
    qvel: Array
    tau: Array
    ctrl: Array | None = None


@dataclass(frozen=True)
class Pair:
    """real and sim share ctrl, dt and joints; gap = real − sim."""

    real: Sequence
    sim: Twin

    def __post_init__(self) -> None:
        if self.sim.qpos.shape != self.real.qpos.shape:
            raise DatasetError(
                f"twin of '{self.real.meta.motion}' has shape {self.sim.qpos.shape}, recording {self.real.qpos.shape}; "
                "run gaponet gap again"
            )

    @property
    def gap(self) -> Array:
        """real.qpos − sim.qpos, (T, n), rad."""
        return self.real.qpos - self.sim.qpos


def hash_order(names: Iterable[str]) -> list[str]:
    """Distinct names in the order of their SHA-256: as good as shuffled, the same everywhere."""
    return sorted(set(names), key=lambda name: hashlib.sha256(name.encode()).hexdigest())


def require_disjoint(*parts: list[Any], key: Callable[[Any], str] = Sequence.content_hash) -> None:
    """Refuse parts of a split that share a recording under two names.

    Args:
        parts: Sequences, or anything else with a `meta` and the given content key.
    """
    seen: dict[str, int] = {}
    for i, part in enumerate(parts):
        for sequence in part:
            if seen.setdefault(key(sequence), i) != i:
                raise DatasetError(
                    f"'{sequence.meta.motion}' is in two parts of the split under different names (same content); "
                    "remove the duplicate"
                )
