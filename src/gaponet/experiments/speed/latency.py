"""How long one correction takes: the network alone on each runtime, the whole delta() call, and many robots at once."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from gaponet.base import child
from gaponet.base.arrays import Array
from gaponet.base.errors import GAPONetError, ModelError
from gaponet.nn.artifact import GapModel
from gaponet.nn.backends import Backend

BATCH = 4096
ONE_THREAD = {f"{name}_NUM_THREADS": "1" for name in ("OPENBLAS", "OMP", "MKL")}


def in_own_process(run: Path, calls: int, threads: int) -> str:
    """The JSON of `measure` from a fresh interpreter: how many threads numpy has is fixed when it is loaded."""
    words = child.words("gaponet.experiments.speed.latency", str(run), str(calls), str(threads))
    done = subprocess.run(words, env=os.environ | ONE_THREAD, stdout=subprocess.PIPE, text=True, check=False)
    if done.returncode == 2:
        raise ModelError(done.stdout.strip().splitlines()[-1])
    if done.returncode:
        raise ModelError(f"{run}: the measurement ended with code {done.returncode}; its message is above")
    return done.stdout.strip().splitlines()[-1]


def measure(run: Path, calls: int, threads: int) -> dict[str, Any]:
    """Microseconds per call, p50, p99 and max, and corrections per second in batches.

    Args:
        calls: How often each is called; they take turns of a tenth, so that a machine that slows down slows all.
        threads: Threads of onnxruntime for the batch; 0 for all cores. Single steps have one.
    """
    models = {name: GapModel.load(run, name) for name in _backends(run)}
    n = len(models["onnxruntime"].card["joint_names"])
    rng = np.random.default_rng(0)
    turns: dict[str, Callable[[], object]] = {}
    for name, model in models.items():
        bound = model.infer.bind(1)
        bound.x[:] = rng.normal(0, 0.3, bound.x.shape)
        turns[f"network, {name}"] = bound.run
    turns |= _torch(models["onnxruntime"], run)
    for name, model in models.items():
        turns[f"delta(), {name}"] = _delta(model, rng.normal(0, 0.3, (64, 3, n)))
    micro: dict[str, list[Array]] = {name: [] for name in turns}
    for _ in range(10):
        for what, turn in turns.items():
            micro[what].append(timed(turn, max(calls // 10, 10)))
    calls_us = {what: quantiles(np.concatenate(times)) for what, times in micro.items()}
    batch = {name: batch_speed(GapModel.load(run, name, threads), rng) for name in models}
    return {"run": str(run), "joints": n, "model": models["onnxruntime"].card["model"], "microseconds": calls_us,
            "batch": BATCH, "threads": threads, "deltas_per_s": batch}  # fmt: skip


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


def batch_speed(model: GapModel, rng: np.random.Generator, rounds: int = 3) -> float:
    """Network answers per second for BATCH robots at once; the fastest round."""
    bound = model.infer.bind(BATCH)
    bound.x[:] = rng.normal(0, 0.3, bound.x.shape)
    return BATCH / (timed(bound.run, rounds).min() * 1e-6)


def _backends(run: Path) -> tuple[Backend, ...]:
    try:
        GapModel.load(run, "numpy")
    except ModelError:
        GapModel.load(run)  # a folder that holds no model at all says so here
        return ("onnxruntime",)
    return ("onnxruntime", "numpy")


def _delta(model: GapModel, states: Array) -> Callable[[], object]:
    """The whole call at changing states."""
    loop, k = model.loop(), 0

    def step() -> Array:
        nonlocal k
        k = (k + 1) % len(states)
        q, v, a = states[k]
        return loop.delta(q, v, a, 1.0)

    return step


def _torch(model: GapModel, run: Path) -> dict[str, Callable[[], object]]:
    """The network as trained, where torch is installed and the run holds it."""
    if not (run / "checkpoint.pt").is_file():
        return {}
    try:
        import torch
    except ImportError:
        return {}
    from gaponet.nn.onnx_export import trained_network

    torch.set_num_threads(1)
    n = len(model.card["joint_names"])
    net, x = trained_network(run, model.config, n), torch.zeros(1, model.config.input_dim(n))

    def step() -> object:
        with torch.inference_mode():
            return net(x)

    return {"network, torch": step}


if __name__ == "__main__":
    try:
        print(json.dumps(measure(Path(sys.argv[1]), int(sys.argv[2]), int(sys.argv[3]))))
    except GAPONetError as error:
        print(error)
        sys.exit(2)
