"""Control steps per second on a GPU: bare mujoco_warp, gaponet's simulations, and with resets.

    python benchmarks/gpu.py [--device cuda] [--robot so101] [--seconds 5] 1024 4096 16384
    python benchmarks/gpu.py --reached RUN OTHER

Measured for each number of simulations, with the plain servo and with servo terms (Stribeck
friction, friction by load):

    plain    mujoco_warp with the robot's own MJCF, without any code of gaponet: what an expert
             would write
    graph    gaponet's own CUDA graph of one control period, with the kernel of the servo terms,
             and nothing else
    gaponet  a step of gaponet's simulations
    resets   the same; one simulation in a hundred is reset in every period

--reached prints how long each of two trainings took to reach the best validation error of RUN.
benchmarks/gpu.sh runs both.
"""

from __future__ import annotations

import json
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import torch
from common import command_line, read_rows

from gaponet.robot.spec import RobotSpec, load_robot
from gaponet.sim.batch import BatchSim, Condition

SERVO_TERMS = {
    "stribeck": 0.02,
    "stribeck_speed": 0.05,
    "friction_motor": 0.1,
    "friction_external": 0.1,
}


def rate(period: Callable[[], object], num_envs: int, seconds: float) -> float:
    """Return the control steps per second of all simulations; a first period compiles."""
    import warp

    period()
    warp.synchronize()
    periods = 0
    began = time.perf_counter()
    while time.perf_counter() - began < seconds:
        period()
        periods += 1
        if periods % 20 == 0:
            warp.synchronize()
    warp.synchronize()
    return num_envs * periods / (time.perf_counter() - began)


def plain_rate(robot: RobotSpec, num_envs: int, device: str, seconds: float) -> float:
    """Return the control steps per second of mujoco_warp alone with the robot's own MJCF."""
    import mujoco
    import mujoco_warp
    import warp

    spec = mujoco.MjSpec.from_file(str(robot.mjcf))
    for name, kp, kd in zip(robot.joint_names, robot.servo.kp, robot.servo.kd, strict=True):
        servo = spec.add_actuator(target=name, trntype=mujoco.mjtTrn.mjTRN_JOINT)
        servo.set_to_position(kp=kp, kv=kd)
    model = spec.compile()
    substeps = round(robot.dt / model.opt.timestep)
    warp_device = warp.get_device("cuda" if device == "cuda" else "cpu")
    with warp.ScopedDevice(warp_device):
        worlds = mujoco_warp.put_model(model)
        data = mujoco_warp.put_data(model, mujoco.MjData(model), num_envs)

        def period() -> None:
            for _ in range(substeps):
                mujoco_warp.step(worlds, data)

        period()  # compiles
        if not warp_device.is_cuda:
            return rate(period, num_envs, seconds)
        with warp.ScopedCapture() as capture:
            period()
        return rate(lambda: warp.capture_launch(capture.graph), num_envs, seconds)


def measure(robot: RobotSpec, num_envs: int, device: str, seconds: float) -> dict[str, float]:
    """Measure the speeds by name, control steps/s."""
    from gaponet.sim.warp import WarpSim

    sim = WarpSim(BatchSim(robot, [Condition(0.0, "both", robot.dt)] * num_envs, 1), device)
    home = sim.array(np.tile(robot.qpos_home, (num_envs, 1)))
    some = sim.array(np.arange(0, num_envs, 100))
    target = home + 0.1

    def begin(ids: torch.Tensor) -> None:
        sim.reset(ids, home[ids], torch.zeros_like(home[ids]), past=home[ids][:, None])

    def with_resets() -> None:
        begin(some)
        sim.step(target)

    begin(torch.arange(num_envs, device=home.device))
    (worlds,) = sim._worlds.of_rates
    turns: dict[str, Callable[[], object]] = {"graph": lambda: worlds.launch(worlds.period)}
    turns |= {"gaponet": lambda: sim.step(target), "resets": with_resets}
    rates = {"plain": plain_rate(robot, num_envs, device, seconds)}
    for name, turn in turns.items():
        rates[name] = rate(turn, num_envs, seconds)
    return rates


def reached(runs: list[Path]) -> None:
    """Print when each run reached the best validation error of the first.

    The time includes labels and sensors.
    """
    lines = [read_rows(run / "progress.jsonl") for run in runs]
    best = min(line["val_mpjae"] for line in lines[0])
    for run, rows in zip(runs, lines, strict=True):
        when = "never"
        for row in rows:
            if row["val_mpjae"] <= best:
                when = f"{row['seconds']:.0f} s, {row['steps']:,} steps"
                break
        own = min(row["val_mpjae"] for row in rows)
        last = rows[-1]
        print(
            f"{run.name}: {best * 1e3:.3f} mrad after {when}; its best {own * 1e3:.3f} mrad; "
            f"{last['steps']:,} steps in {last['seconds']:.0f} s"
        )


def main() -> None:
    """Measure and print one JSON line per size and servo."""
    parser = command_line(__doc__)
    parser.add_argument("sizes", type=int, nargs="*")
    parser.add_argument("--reached", type=Path, nargs=2, metavar=("RUN", "OTHER"))
    parser.add_argument("--device", default="cuda", choices=("cuda", "warp-cpu"))
    parser.add_argument("--robot", default="so101")
    parser.add_argument("--seconds", type=float, default=5.0, help="of each measurement")
    args = parser.parse_args()
    if args.reached:
        reached(args.reached)
    stated = load_robot(args.robot)
    with_terms = stated.with_identified(dict.fromkeys(stated.operated, SERVO_TERMS))
    for size in args.sizes:
        for servo, robot in (("stated", stated), ("law", with_terms)):
            rates = measure(robot, size, args.device, args.seconds)
            memory = torch.cuda.max_memory_reserved() >> 20 if args.device == "cuda" else 0
            row: dict[str, object] = {"num_envs": size, "servo": servo, "torch_mb": memory}
            row |= {name: round(value) for name, value in rates.items()}
            print(json.dumps(row), flush=True)


if __name__ == "__main__":
    main()
