"""What is compared takes turns, so that a machine that slows down slows all of it."""

from __future__ import annotations

import time
from collections.abc import Callable

Turn = Callable[[], object]


def take_turns(turns: dict[str, Turn], rounds: int, of: Callable[[list[float]], float] = min) -> dict[str, float]:
    """Seconds of each one's fastest turn (or median, …), in `rounds` rounds after one that does not count."""
    seconds: dict[str, list[float]] = {name: [] for name in turns}
    for _ in range(rounds + 1):
        for name, turn in turns.items():
            start = time.perf_counter()
            turn()
            seconds[name].append(time.perf_counter() - start)
    return {name: of(s[1:]) for name, s in seconds.items()}
