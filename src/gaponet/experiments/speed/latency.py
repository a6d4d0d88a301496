"""How long one correction takes: the network alone on onnxruntime and torch, the whole delta() call, many robots."""

from __future__ import annotations

import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from gaponet.base.arrays import Array
from gaponet.nn.artifact import GapModel

BATCH = 4096


def measure(run: Path, calls: int, threads: int) -> dict[str, Any]:
    """Microseconds per call, p50, p99 and max, and corrections per second in batches.

    Args:
        calls: How often each is called; they take turns of a tenth, so that a machine that slows down slows all.
        threads: Threads of onnxruntime for the batch; 0 for all cores. Single steps have one.
    """
    model, rng = GapModel.load(run), np.random.default_rng(0)
    n = len(model.card["joint_names"])
    x = rng.normal(0, 0.3, (BATCH, model.config.input_dim(n))).astype(np.float32)
    turns: dict[str, Callable[[], object]] = {"network, onnxruntime": partial(model.infer, x[:1])}
    turns |= _torch(model, run, x[:1])
    turns["delta()"] = _delta(model, rng.normal(0, 0.3, (64, 3, n)))
    micro: dict[str, list[Array]] = {name: [] for name in turns}
    for _ in range(10):
        for what, turn in turns.items():
            micro[what].append(timed(turn, max(calls // 10, 10)))
    calls_us = {what: quantiles(np.concatenate(times)) for what, times in micro.items()}
    batch = timed(partial(GapModel.load(run, threads).infer, x), 3).min() * 1e-6
    return {"run": str(run), "joints": n, "model": model.card["model"], "microseconds": calls_us,
            "batch": BATCH, "threads": threads, "deltas_per_s": BATCH / batch}  # fmt: skip


def timed(turn: Callable[[], object], calls: int) -> Array:
    """Durations of calls after some to warm up, (calls,) µs."""
    for _ in range(20):
        turn()
    times = np.empty(calls)
    clock = time.perf_counter
    for k in range(calls):
        start = clock()
        turn()
        times[k] = clock() - start
    return times * 1e6


def quantiles(times: Array) -> dict[str, float]:
    """p50, p99 and max."""
    return {"p50": float(np.median(times)), "p99": float(np.quantile(times, 0.99)), "max": float(times.max())}


def _delta(model: GapModel, states: Array) -> Callable[[], object]:
    """The whole call at changing states."""
    loop, k = model.loop(), 0

    def step() -> Array:
        nonlocal k
        k = (k + 1) % len(states)
        q, v, a = states[k]
        return loop.delta(q, v, a, 1.0)

    return step


def _torch(model: GapModel, run: Path, x: Array) -> dict[str, Callable[[], object]]:
    """The network as trained, where torch is installed and the run holds it."""
    if not (run / "checkpoint.pt").is_file():
        return {}
    try:
        import torch
    except ImportError:
        return {}
    from gaponet.nn.onnx_export import trained_network

    torch.set_num_threads(1)
    net = trained_network(run, model.config, len(model.card["joint_names"]))
    return {"network, torch": torch.inference_mode()(partial(net, torch.from_numpy(x)))}
