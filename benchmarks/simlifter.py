"""The virtual SimLifter dataset: how fast it is made, how large it is, and how its gap grows with the payload.

    python benchmarks/simlifter.py [--motions 16] [--nproc 2]

1. Speed and size. Plays some motions of the simlifter recipe with their twins (joint, upper body, whole body in the
   recipe's own shares, all payloads, units, rates and repetitions; 16 motions: a tenth of it). On a machine that does
   other work too, look at the figure per CPU second, which holds for each core that is free, and at mj_step_us, a plain
   MuJoCo loop on one core just before and after: how fast the machine was at the time.
2. Gap. Units 1 to 4, every payload, motions spread over the recipe: mean |q_sim − q_robot| by joint in free run of the
   nominal simulator, and the spread over repetitions beside it.

Writes docs/results/simlifter.{json,md,svg,png}. Every number in it is from VIRTUAL robots.
"""

from __future__ import annotations

import argparse
import json
import os
import resource
import tempfile
import time
from collections import defaultdict
from dataclasses import replace
from datetime import date
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

from gaponet.data.sequence import Sequence
from gaponet.data.store import Dataset
from gaponet.eval import dataset_figures
from gaponet.metrics import metrics, runs
from gaponet.motion.library import Library
from gaponet.motion.recipe import takes
from gaponet.plot.style import save
from gaponet.robot import RobotSpec, load_robot
from gaponet.sim.model import build_model
from gaponet.sim.replay import replay
from gaponet.virtual.collect import collect, load_recipe
from gaponet.virtual.fleet import load_fleet

DOCS = Path(__file__).parents[1] / "docs" / "results"
UNITS = ("virtual-1", "virtual-2", "virtual-3", "virtual-4")


def cpu_s() -> float:
    """CPU seconds of this process and of its ended children."""
    spent = [resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)]
    return sum(r.ru_utime + r.ru_stime for r in spent)


def memory_gib() -> float:
    """Peak resident memory of this process and of its largest child."""
    return sum(resource.getrusage(w).ru_maxrss for w in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)) / 2**20


def mj_step_us(seconds: float = 2.0) -> float:
    """Microseconds of one mj_step of the nominal H1-2 with 3 kg and moving arms, one core."""
    model = build_model(load_robot("h1_2"), 3.0)
    data, speed = mujoco.MjData(model), np.random.default_rng(0).uniform(1, 3, model.nu)
    start, count = time.perf_counter(), 0
    while time.perf_counter() - start < seconds:
        data.ctrl[:] = 0.3 * np.sin(speed * count * model.opt.timestep)
        mujoco.mj_step(model, data, nstep=10)
        count += 10
    return (time.perf_counter() - start) / count * 1e6


def spread(names: list[str], count: int) -> tuple[str, ...]:
    """So many of them, evenly spaced."""
    return tuple(names[i * len(names) // count] for i in range(count))


def speed(robot: RobotSpec, names: list[str], count: int, nproc: int) -> dict[str, Any]:
    """Collect `count` motions of the recipe and replay the twins."""
    recipe, library = load_recipe("simlifter"), Library(robot)
    load, yardstick, cpu = os.getloadavg()[0], [mj_step_us()], [cpu_s()]
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / "data"
        part = replace(recipe, motions=spread(names, count))
        done = collect(robot, load_fleet("easy", robot), part, out, nproc=nproc)
        cpu.append(cpu_s())
        size, twins_size = (sum(f.stat().st_size for f in (out / d).rglob("*.parquet")) for d in (".", "twins"))
        channels = sorted(set.intersection(*(set(e.channels) for e in Dataset(out).entries)))
    recorded_s = done.hours * 3600
    length = {name: library.make(name).duration for name in names}
    hours = sum(length[t.motion] for t in takes(recipe, names)) / 3600
    return {
        "motions": part.motions,
        "sequences": done.written,
        "hours": done.hours,
        "channels": channels,
        "times_real_time": done.times_real_time,
        "recorded_s_per_cpu_s": recorded_s / (cpu[1] - cpu[0]),
        "load_average_before": load,
        "mj_step_us": [*yardstick, mj_step_us()],
        "peak_memory_gib": memory_gib(),
        "bytes_on_disk": size,
        "bytes_of_twins": twins_size,
        "simlifter_sequences": len(takes(recipe, names)),
        "simlifter_hours": hours,
        "simlifter_wall_minutes": hours * 60 / done.times_real_time,
        "simlifter_gb": size / recorded_s * hours * 3.6e-6,
    }


def gap(robot: RobotSpec, names: list[str], nproc: int) -> tuple[dict[str, Any], dict[float, np.ndarray]]:
    """MPJAE by payload, unit and joint, and the spread over repetitions, rad."""
    upper = [n for n in names if "-all-" not in n]
    recipe = replace(
        load_recipe("simlifter"), motions=spread(upper, 12), units=UNITS, rates=(50.0,), repetitions=2
    )  # fmt: skip
    with tempfile.TemporaryDirectory() as folder:
        collect(robot, load_fleet("easy", robot), recipe, Path(folder) / "data", nproc=nproc, twins=False)
        sequences = Dataset(Path(folder) / "data").sequences()
    twins = replay(sequences, robot, nthread=nproc, lock_idle=True)
    both = runs(sequences, [t.qpos for t in twins], robot)
    by: dict[str, Any] = {}
    drawn: dict[float, np.ndarray] = {}
    for payload in recipe.payloads:
        part = [r for r in both if r.real.meta.payload_mass == payload]
        drawn[payload] = np.array([np.abs(r.error).mean(axis=0) for r in part])
        by[f"{payload:g}"] = {
            "mpjae": metrics(part)["mpjae"],
            "by_joint": dict(zip(robot.operated, drawn[payload].mean(axis=0).tolist(), strict=True)),
            "by_unit": {u: metrics([r for r in part if r.real.meta.unit_id == u])["mpjae"] for u in UNITS},
        }
    return {"motions": recipe.motions, "by_payload": by, "repeatability": repeatability(sequences, robot)}, drawn


def repeatability(sequences: list[Sequence], robot: RobotSpec) -> float:
    """Mean |difference| between two repetitions of the same take over √2, rad."""
    takes_of: dict[Any, list[Sequence]] = defaultdict(list)
    for s in sequences:
        takes_of[s.meta.motion, s.meta.unit_id, s.meta.payload_mass].append(s)
    op = robot.operated_index
    return float(np.mean([np.abs(a.qpos[:, op] - b.qpos[:, op]).mean() / np.sqrt(2) for a, b in takes_of.values()]))


def page(result: dict[str, Any]) -> str:
    """The results as Markdown."""
    s, g = result["speed"], result["gap"]
    payloads = list(g["by_payload"])
    head = "| " + " | ".join(["joint", *(f"{p} kg" for p in payloads)]) + " |"
    rule = "| --- |" + " ---: |" * len(payloads)
    row = lambda name, values: "| " + " | ".join([name, *(f"{1e3 * v:.1f}" for v in values)]) + " |"  # noqa: E731
    by = g["by_payload"].values()
    joints = [row(j, [p["by_joint"][j] for p in by]) for j in next(iter(by))["by_joint"]]
    units = [row(u, [p["by_unit"][u] for p in by]) for u in UNITS]
    yard = " and ".join(f"{x:.0f}" for x in s["mj_step_us"])
    return f"""# The virtual SimLifter dataset

**Every number on this page is from virtual H1-2 robots (fleet `easy`).** {date.today()}, 2 cores, no GPU.
Regenerate: `python benchmarks/simlifter.py`.

## Speed and size

A tenth of the `simlifter` recipe: {s["sequences"]} sequences, {s["hours"]:.2f} h, with
{", ".join(f"`{c}`" for c in s["channels"])}.

Robots and twins together: **{s["times_real_time"]:.1f} × real time**, {s["recorded_s_per_cpu_s"]:.1f} s recorded
per CPU second. The machine at the time: one mj_step of the nominal H1-2 took {yard} µs before and after. Peak memory
{s["peak_memory_gib"]:.2f} GiB, {s["bytes_on_disk"] / 1e6:.0f} MB on disk, {s["bytes_of_twins"] / 1e6:.0f} of them
twins. The whole recipe at this rate: {s["simlifter_sequences"]} sequences, {s["simlifter_hours"]:.1f} h,
{s["simlifter_wall_minutes"]:.0f} minutes, {s["simlifter_gb"]:.1f} GB.

## Gap of the nominal simulator, mrad

Free run over whole motions, units 1 to 4, {len(g["motions"])} motions, 50 Hz. Spread over repetitions:
{1e3 * g["repeatability"]:.2f} mrad.

{head}
{rule}
{chr(10).join(joints)}
{row("**mean**", [p["mpjae"] for p in by])}

{head.replace("joint", "unit")}
{rule}
{chr(10).join(units)}

![](simlifter.svg)
"""


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--motions", type=int, default=16, help="how many of the recipe's")
    parser.add_argument("--nproc", type=int, default=os.cpu_count())
    parser.add_argument("--speed-only", action="store_true", help="print the speed and write nothing")
    parser.add_argument("--out", type=Path, default=DOCS)
    args = parser.parse_args()
    robot, recipe = load_robot("h1_2"), load_recipe("simlifter")
    names = list(dict.fromkeys(t.motion for t in takes(recipe, Library(robot).names(recipe.variants))))
    measured = speed(robot, names, args.motions, args.nproc)
    if args.speed_only:
        print(json.dumps(measured, indent=1))
        return 0
    found, drawn = gap(robot, names, args.nproc)
    result = {"virtual": True, "speed": measured, "gap": found}
    args.out.mkdir(parents=True, exist_ok=True)
    (args.out / "simlifter.json").write_text(json.dumps(result, indent=1) + "\n", encoding="utf-8")
    (args.out / "simlifter.md").write_text(page(result), encoding="utf-8")
    save(dataset_figures.gap_by_payload(drawn, list(robot.operated), "VIRTUAL h1_2, units 1 to 4: gap to the nominal "
         "simulator, free run"), args.out / "simlifter")  # fmt: skip
    print(page(result))
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
