"""gaponet bench latency."""

from __future__ import annotations

import json
from pathlib import Path

from gaponet.cli.out import Out


def latency(run: Path, out: Out, calls: int = 3000, threads: int = 1) -> None:
    """Print how long one correction takes on each runtime, and corrections per second for many robots at once."""
    from gaponet.deploy.latency import in_own_process

    result = json.loads(in_own_process(run, calls, threads))
    out.table(
        f"One step of {run}, {result['joints']} joints, one thread", ["", "p50 µs", "p99 µs", "max µs"],
        [[name, *(f"{t[q]:.0f}" for q in ("p50", "p99", "max"))] for name, t in result["microseconds"].items()],
    )  # fmt: skip
    for name, speed in result["deltas_per_s"].items():
        out.say(f"{result['batch']} robots at once, {name}: {speed:,.0f} deltas/s")
    out.result(result)
