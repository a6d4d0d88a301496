"""Speed of one correction or compensated command, and of the aligned simulator.

    python benchmarks/speed.py latency --run RUN   one robot: network, delta(), Compensator
    python benchmarks/speed.py aligned --run RUN   the aligned simulator beside the nominal one

All parts take turns in one run, so that a slow moment of the machine slows all of them. Of repeated
turns the fastest counts, because other programs only add time. Results are printed as JSON.
"""

from __future__ import annotations

import itertools
import json
import time
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from common import command_line

from gaponet.base.arrays import Array
from gaponet.deploy.aligned_sim import AlignedSim, AlignedSimOptions
from gaponet.deploy.compensator import Compensator
from gaponet.nn.artifact import GapModel
from gaponet.nn.onnx_export import trained_network
from gaponet.robot.folder import load_stored_robot
from gaponet.robot.spec import RobotSpec
from gaponet.sim.batch import BatchSim, Condition
from gaponet.sim.model import idle_joints

Turn = Callable[[], object]

TURN_STEPS = 40  # control periods of a turn
INFERENCE_BATCH = 4096
CALLS = 300  # of each runtime in a turn
TURNS = 10


def bench_latency(run: Path) -> dict[str, Any]:
    """Measure one correction on each runtime, µs, and corrections per second in batches.

    Beside it the Compensator of the run's simulator, with and without the network, and one control
    period of that simulator alone.

    Args:
        run: Run folder of gaponet train.
    """
    model = GapModel.load(run)
    rng = np.random.default_rng(0)
    n = len(model.card["joint_names"])
    x = rng.normal(0, 0.3, (INFERENCE_BATCH, model.config.input_dim(n))).astype(np.float32)
    turns: dict[str, Turn] = {"network, onnxruntime": partial(model.infer, x[:1])}
    if (run / "checkpoint.pt").is_file():
        torch.set_num_threads(1)
        net = trained_network(run, model.config, n)
        turns["network, torch"] = torch.inference_mode()(partial(net, torch.from_numpy(x[:1])))
    turns["delta()"] = _correction(model, rng.normal(0, 0.3, (64, 3, n)))
    robot = model.simulator()
    turns["Compensator.step without network"] = _compensation(robot, None)
    turns["Compensator.step"] = _compensation(robot, model)
    turns["simulator, one control period"] = _period(robot)
    micro: dict[str, list[Array]] = {name: [] for name in turns}
    for _ in range(TURNS):
        for name, turn in turns.items():
            micro[name].append(_durations(turn, CALLS))
    batch_s = _durations(partial(GapModel.load(run, 1).infer, x), 3).min() * 1e-6
    return {
        "run": str(run),
        "joints": n,
        "model": model.card["model"],
        "microseconds": {name: _quantiles(np.concatenate(t)) for name, t in micro.items()},
        "batch": INFERENCE_BATCH,
        "deltas_per_s": INFERENCE_BATCH / batch_s,
    }


def _quantiles(times: Array) -> dict[str, float]:
    return {
        "p50": float(np.median(times)),
        "p99": float(np.quantile(times, 0.99)),
        "max": float(times.max()),
    }


def bench_aligned(run: Path, num_envs: int, rounds: int) -> dict[str, dict[str, float]]:
    """Control steps per second of the nominal and the aligned simulator; idle limbs are locked in
    both.
    """
    model = GapModel.load(run, threads=0)
    robot = load_stored_robot(run, model.card["robot"])
    locked = idle_joints(robot, robot.operated)
    nominal = BatchSim(robot, [Condition(0.0, "both", robot.dt)] * num_envs, 0, locked)
    options = AlignedSimOptions(locked=locked)
    aligned = AlignedSim(robot, model, num_envs=num_envs, options=options)
    phase = np.random.default_rng(0).uniform(0, 2 * np.pi, (num_envs, nominal.n))
    angles = np.pi * robot.dt * np.arange(TURN_STEPS)
    home = robot.qpos_home[robot.index(aligned.joint_names)]
    targets = [home + 0.3 * np.sin(phase + angle) for angle in angles]

    def run_nominal() -> None:
        start = targets[0]
        nominal.reset(slice(None), start, 0.0, past=start[:, None])  # type: ignore[arg-type]
        for target in targets:
            nominal.step(target)

    def run_aligned() -> None:
        aligned.reset(targets[0])
        for target in targets:
            aligned.step(target)

    seconds: dict[str, list[float]] = {"nominal": [], "aligned": []}
    for _ in range(rounds + 1):
        for name, turn in (("nominal", run_nominal), ("aligned", run_aligned)):
            start = time.perf_counter()
            turn()
            seconds[name].append(time.perf_counter() - start)
    speed = {}
    for name, times in seconds.items():
        speed[name] = num_envs * TURN_STEPS / min(times[1:])  # the first one warms up
    found = {}
    for name, rate in speed.items():
        found[name] = {"control_steps_per_s": rate, "ratio": rate / speed["nominal"]}
    return found


def _correction(model: GapModel, states: Array) -> Turn:
    """delta() at changing states, (k, 3, n)."""
    loop = model.loop()
    k = 0

    def step() -> Array:
        nonlocal k
        k = (k + 1) % len(states)
        qpos, qvel, ctrl = states[k]
        delta: Array = loop.delta(qpos, qvel, ctrl, 1.0)
        return delta

    return step


def _targets(robot: RobotSpec) -> Iterator[Array]:
    """Yield targets of a slow motion around home, (n) rad."""
    for t in itertools.count():
        yield robot.qpos_home + 0.1 * np.sin(t * robot.dt * np.ones(len(robot.joint_names)))


def _compensation(robot: RobotSpec, model: GapModel | None) -> Turn:
    """One period of a robot that is where it should be and carries nothing, as stated."""
    compensator = Compensator(robot, model)
    compensator.reset(robot.qpos_home, payload_mass=0.0)
    targets = _targets(robot)

    def step() -> Array:
        target = next(targets)
        return compensator.step(target, target)

    return step


def _period(robot: RobotSpec) -> Turn:
    """One control period of the simulator."""
    locked = idle_joints(robot, robot.operated)
    sim = BatchSim(robot, [Condition(0.0, "both", robot.dt)], 1, locked)
    free = robot.index(sim.joint_names)
    home = robot.qpos_home[None, free]
    sim.reset(slice(None), home, 0.0, past=home[:, None])  # type: ignore[arg-type]
    targets = _targets(robot)
    return lambda: sim.step(next(targets)[None, free])


def _durations(turn: Turn, calls: int) -> Array:
    """Durations of calls after 20 to warm up, (calls,) µs."""
    for _ in range(20):
        turn()
    times = np.empty(calls)
    for k in range(calls):
        start = time.perf_counter()
        turn()
        times[k] = time.perf_counter() - start
    return times * 1e6


def main() -> None:
    """Measure and print JSON."""
    parser = command_line(__doc__)
    parser.add_argument("what", choices=("latency", "aligned"))
    parser.add_argument("--run", type=Path, default=Path("."), help="run folder of gaponet train")
    parser.add_argument("--num-envs", type=int, default=512)
    parser.add_argument("--rounds", type=int, default=15)
    args = parser.parse_args()
    if args.what == "latency":
        result = bench_latency(args.run)
    else:
        result = bench_aligned(args.run, args.num_envs, args.rounds)
    print(json.dumps(result, indent=1))


if __name__ == "__main__":
    main()
