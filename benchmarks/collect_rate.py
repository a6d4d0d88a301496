"""How many times faster than the robot: virtual fleet, its nominal twins, and both together.

    python benchmarks/collect_rate.py [--motions 6] [--nproc 2]

Plays some motions of the simlifter recipe (joint, upper body and whole body in the recipe's own shares, all payloads,
units, rates and repetitions), then the twins of what was recorded, and prints one JSON object with × real time, memory,
size on disk, and what that makes for the whole recipe. On a machine that does other work too, look at the figures per
CPU second, which hold for each core that is free, and at mj_step_us, a plain MuJoCo loop on one core just before and
after: the yardstick of how fast the machine was at the time.
"""

from __future__ import annotations

import argparse
import json
import os
import resource
import sys
import tempfile
import time
from dataclasses import replace
from pathlib import Path

import mujoco
import numpy as np

from gaponet.collect import collect, load_recipe
from gaponet.data.store import Dataset
from gaponet.motion.library import Library
from gaponet.motion.recipe import takes
from gaponet.robot import load_robot
from gaponet.sim.model import build_model
from gaponet.sim.replay import replay
from gaponet.virtual.fleet import load_fleet


def cpu_s() -> float:
    """CPU seconds of this process and of its ended children."""
    spent = [resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)]
    return sum(r.ru_utime + r.ru_stime for r in spent)


def mj_step_us(seconds: float = 2.0) -> float:
    """Microseconds of one mj_step of the nominal H1-2 with 3 kg and moving arms, one core."""
    model = build_model(load_robot("h1_2"), 3.0)
    data, rng = mujoco.MjData(model), np.random.default_rng(0)
    rate = rng.uniform(1, 3, model.nu)
    start, count = time.perf_counter(), 0
    while time.perf_counter() - start < seconds:
        data.ctrl[:] = 0.3 * np.sin(rate * count * model.opt.timestep)
        mujoco.mj_step(model, data, nstep=10)
        count += 10
    return (time.perf_counter() - start) / count * 1e6


def memory_gib() -> float:
    """Peak resident memory of this process and of its largest child."""
    who = (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)
    return sum(resource.getrusage(w).ru_maxrss for w in who) / 2**20


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--motions", type=int, default=6, help="how many of the recipe's 159")
    parser.add_argument("--nproc", type=int, default=os.cpu_count())
    args = parser.parse_args()
    robot, recipe = load_robot("h1_2"), load_recipe("simlifter")
    names = list(dict.fromkeys(t.motion for t in takes(recipe, Library(robot).names(recipe.variants))))
    some = tuple(names[i * len(names) // args.motions] for i in range(args.motions))
    load_before, yardstick = os.getloadavg()[0], [mj_step_us()]
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / "data"
        cpu = [cpu_s()]
        done = collect(robot, load_fleet("default", robot), replace(recipe, motions=some), out, nproc=args.nproc)
        cpu.append(cpu_s())
        size = sum(f.stat().st_size for f in out.rglob("*") if f.is_file())
        sequences = Dataset(out).sequences()
        start = time.monotonic()
        replay(sequences, robot, nthread=args.nproc, lock_idle=True)
        twins_s = time.monotonic() - start
        cpu.append(cpu_s())
    yardstick.append(mj_step_us())
    recorded_s = done.hours * 3600
    both = recorded_s / (done.wall_s + twins_s)
    library = Library(robot)
    length = {name: library.make(name).duration for name in names}
    hours = sum(length[t.motion] for t in takes(recipe, library.names(recipe.variants))) / 3600
    result = {
        "motions": some,
        "sequences": done.written,
        "recorded_s": recorded_s,
        "fleet_times_real_time": done.times_real_time,
        "twins_times_real_time": recorded_s / twins_s,
        "both_times_real_time": both,
        "fleet_per_cpu_s": recorded_s / (cpu[1] - cpu[0]),
        "both_per_cpu_s": recorded_s / (cpu[2] - cpu[0]),
        "load_average_before": load_before,
        "mj_step_us": yardstick,
        "peak_memory_gib": memory_gib(),
        "bytes_on_disk": size,
        "simlifter_sequences": len(takes(recipe, names)),
        "simlifter_hours": hours,
        "simlifter_wall_minutes": hours * 60 / both,
        "simlifter_gb": size / recorded_s * hours * 3.6e-6,
    }
    print(json.dumps(result))
    return 0


if __name__ == "__main__":
    sys.exit(main())
