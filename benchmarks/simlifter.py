"""The virtual SimLifter dataset, whole: how fast it is made, how large it is, how quick it is, and its gap.

    python benchmarks/simlifter.py WORK [--nproc 2]

Collects all of the simlifter recipe with its twins into WORK/data (11,448 sequences, 30.6 h, 5.5 GB; where that was
interrupted, it goes on and its time is not told), then runs what people run on it, each in a process of its own: the
card, the figures, opening it, reading sequences at random, and batches of a training environment that holds all of its
training motions. The gap is that of the twins: mean |q_sim − q_robot| by joint in free run of the nominal simulator.

Writes docs/results/simlifter.{json,md} and the figures. Every number in it is from VIRTUAL robots.
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import subprocess
import sys
import time
from collections import defaultdict
from datetime import date
from pathlib import Path
from typing import Any

import numpy as np

from gaponet.base.files import write_json
from gaponet.data.split import split_entries
from gaponet.data.store import Dataset
from gaponet.experiments.kept import read_kept
from gaponet.nn.config import ModelConfig
from gaponet.nn.training.config import RewardConfig
from gaponet.nn.training.env import DeltaEnv
from gaponet.robot.spec import load_robot
from gaponet.sim.model import model_hash

DOCS = Path(__file__).parents[1] / "docs" / "results"
FIGURES = ("composition", "joint_ranges", "torque_temperature", "real_and_twin", "gap_by_payload")
COMMANDS, TIMES = ("card", "figures"), ("wall_s", "cpu_s", "peak_gb")
SEQUENCES, BATCHES, ENVS = 400, 50, 1024  # read at random; and their size


def measured(*command: Any) -> dict[str, Any]:
    """What a command printed as JSON, with its wall and CPU seconds (children included) and its peak memory in GB."""
    start = time.perf_counter()
    process = subprocess.Popen([sys.executable, *map(str, command)], stdout=subprocess.PIPE, text=True)
    assert process.stdout
    out = process.stdout.read()
    _, status, used = os.wait4(process.pid, 0)
    if status:
        raise SystemExit(f"{' '.join(map(str, command))}: ended with {os.waitstatus_to_exitcode(status)}")
    told = {"wall_s": time.perf_counter() - start, "cpu_s": used.ru_utime + used.ru_stime}
    return json.loads(out) | told | {"peak_gb": used.ru_maxrss * 1.024e-6}


def gaponet(*words: Any) -> dict[str, Any]:
    """The same of a command of gaponet."""
    return measured("-m", "gaponet", *words, "--json")


# ---- in a process of their own


def opening(path: Path) -> dict[str, Any]:
    """Seconds to open, at best of three (files in the system's cache)."""
    taken = []
    for _ in range(3):
        start = time.perf_counter()
        dataset = Dataset(path)
        taken.append(time.perf_counter() - start)
    frames = sum(e.rows for e in dataset.entries)
    return {"open_s": min(taken), "sequences": len(dataset), "hours": dataset.hours(), "frames": frames}


def reading(path: Path) -> dict[str, Any]:
    """Milliseconds to read all channels of a sequence drawn at random."""
    dataset, rng, taken = Dataset(path), np.random.default_rng(1), []
    for i in rng.integers(len(dataset), size=SEQUENCES):
        start = time.perf_counter()
        dataset.read(dataset.entries[i])
        taken.append((time.perf_counter() - start) * 1e3)
    return {"sequence_ms": float(np.median(taken)), "sequence_p95_ms": float(np.percentile(taken, 95))}


def batches(path: Path) -> dict[str, Any]:
    """Seconds until a training environment holds all training motions, and ms to put it at frames drawn at random."""
    dataset, start = Dataset(path), time.perf_counter()
    train = dataset.sequences(split_entries(dataset)["train"], optional=False)
    env = DeltaEnv(train, load_robot("h1_2"), ModelConfig(), ENVS, 1000, RewardConfig(), nthread=1)
    loaded, taken = time.perf_counter() - start, []
    for _ in range(BATCHES):
        start = time.perf_counter()
        env.reset()
        env.get_observations()
        taken.append((time.perf_counter() - start) * 1e3)
    return {"load_s": loaded, "train_sequences": len(train), "train_rows": len(env.track),
            "batch_ms": float(np.median(taken)), "batch_p95_ms": float(np.percentile(taken, 95))}  # fmt: skip


def gap(path: Path) -> dict[str, Any]:
    """MPJAE of the twins by payload, joint and unit, of operated joints, rad; each row counts as much."""
    dataset, robot = Dataset(path), load_robot("h1_2")
    model, op, zero = model_hash(robot), robot.operated_index, (np.zeros(len(robot.operated)), 0)
    sums: dict[tuple[float, str], tuple[np.ndarray, int]] = defaultdict(lambda: zero)
    for entry in dataset.entries:
        pair, key = dataset.pair(entry, model), (entry.meta.payload_mass, entry.meta.unit_id)
        error = np.abs(pair.sim.qpos - pair.real.qpos)[:, op].sum(axis=0)
        sums[key] = sums[key][0] + error, sums[key][1] + entry.rows

    def mean(*keys: tuple[float, str]) -> np.ndarray:
        errors, rows = zip(*(sums[key] for key in keys), strict=True)
        return np.asarray(np.sum(errors, axis=0) / sum(rows))

    payloads, units = (sorted({key[i] for key in sums}) for i in (0, 1))
    by_joint = {f"{p:g}": mean(*((p, u) for u in units)).tolist() for p in payloads}
    return {
        "by_joint": {p: dict(zip(robot.operated, values, strict=True)) for p, values in by_joint.items()},
        "by_unit": {f"{p:g}": {u: float(mean((p, u)).mean()) for u in units} for p in payloads},
        "mean": float(mean(*sums).mean()),
    }


ALONE = {"opening": opening, "reading": reading, "batches": batches, "gap": gap}


# ---- the page


def page(found: dict[str, Any]) -> str:
    """The results as Markdown."""
    c, o, r, b, g = (found[name] for name in ("collect", "opening", "reading", "batches", "gap"))
    payloads = list(g["by_joint"])
    row = lambda name, values: "| " + " | ".join([name, *(f"{1e3 * v:.1f}" for v in values)]) + " |"  # noqa: E731
    head = lambda what: row(what, []).removesuffix(" |") + " | " + " | ".join(f"{p} kg" for p in payloads) + " |"  # noqa: E731
    rule = "| --- |" + " ---: |" * len(payloads)
    joints = [row(j, [g["by_joint"][p][j] for p in payloads]) for j in g["by_joint"][payloads[0]]]
    units = [row(u, [g["by_unit"][p][u] for p in payloads]) for u in g["by_unit"][payloads[0]]]
    mean = row("**mean**", [float(np.mean(list(g["by_joint"][p].values()))) for p in payloads])
    lines = [
        ("collecting, robots and twins" + ("" if c["whole"] else " (interrupted)"), c),
        ("`gaponet data card`", found["card"]), ("`gaponet data figures`", found["figures"]),
    ]  # fmt: skip
    table = [f"| {n} | {x['wall_s']:.0f} s | {x['cpu_s']:.0f} s | {x['peak_gb']:.2f} |" for n, x in lines]
    table += [
        f"| opening | {o['open_s']:.2f} s | | {o['peak_gb']:.2f} |",
        f"| a sequence at random, all channels | {r['sequence_ms']:.1f} ({r['sequence_p95_ms']:.1f}) ms | "
        f"| {r['peak_gb']:.2f} |",
        f"| all {b['train_rows'] / 1e6:.1f} million training rows into an environment | {b['load_s']:.0f} s | "
        f"| {b['peak_gb']:.2f} |",
        f"| a batch of it: {ENVS} simulations at frames drawn at random, with past and observation | "
        f"{b['batch_ms']:.1f} ({b['batch_p95_ms']:.1f}) ms | | |",
    ]  # fmt: skip
    return f"""# The virtual SimLifter dataset

**Every number on this page is from VIRTUAL H1-2 robots (fleet `hard`).** {date.today()}, 2 cores, no GPU.
Regenerate: `python benchmarks/simlifter.py WORK`. What it holds: [its card](simlifter_card.md).

## Speed and size

The whole `simlifter` recipe: {o["sequences"]:,} sequences, {o["hours"]:.2f} h, {o["frames"] / 1e6:.2f} million
frames of 27 joints, {c["bytes"] / 1e9:.2f} GB on disk, {c["bytes_of_twins"] / 1e9:.2f} of them twins. Recorded at
**{o["hours"] * 3600 / c["wall_s"]:.0f} × real time**, {o["hours"] * 3600 / c["cpu_s"]:.0f} s per CPU second.

| | wall time | CPU time | peak memory of a process, GB |
| --- | ---: | ---: | ---: |
{chr(10).join(table)}

Files in the system's cache; short times are medians, 95th percentiles in brackets.

## Gap of the nominal simulator, mrad

Free run over whole motions, the twins of all sequences; each row counts as much. Mean {1e3 * g["mean"]:.1f}.

{head("joint")}
{rule}
{chr(10).join(joints)}
{mean}

{head("unit")}
{rule}
{chr(10).join(units)}

{chr(10).join(f"![](simlifter-{name}.svg)" for name in FIGURES)}
"""


def collected(data: Path, note: Path, nproc: int) -> dict[str, Any]:
    """Collect it, or what is missing of it; the note is kept."""
    if not note.is_file():
        done = gaponet("collect", "--recipe", "simlifter", "--out", data, "--nproc", nproc)
        sizes = [sum(f.stat().st_size for f in (data / d).rglob("*.parquet")) for d in (".", "twins")]
        write_json(note, done | {"whole": not done["present"], "bytes": sizes[0], "bytes_of_twins": sizes[1]})
    return read_kept(note)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("work", type=Path)
    parser.add_argument("--nproc", type=int, default=0)
    parser.add_argument("--only", choices=tuple(ALONE), help="one measurement, in this process")
    args = parser.parse_args()
    data, pictures = args.work / "data", args.work / "figures"
    if args.only:
        print(json.dumps(ALONE[args.only](data)))
        return
    found = {"collect": collected(data, args.work / "collected.json", args.nproc)}
    found["card"] = gaponet("data", "card", data, "--source", "VIRTUAL H1-2, fleet hard, recipe simlifter")
    found["figures"] = gaponet("data", "figures", data, "--out", pictures)
    found |= {name: measured(__file__, args.work, "--only", name) for name in ALONE}
    DOCS.mkdir(parents=True, exist_ok=True)
    told = {name: {k: v for k, v in x.items() if k in TIMES} if name in COMMANDS else x for name, x in found.items()}
    write_json(DOCS / "simlifter.json", {"virtual": True} | told)
    (DOCS / "simlifter.md").write_text(page(found), encoding="utf-8")
    shutil.copy(data / "CARD.md", DOCS / "simlifter_card.md")
    for name in FIGURES:
        for end in (".svg", ".png"):
            shutil.copy(pictures / f"{name}{end}", DOCS / f"simlifter-{name}{end}")
    print(page(found))


if __name__ == "__main__":
    main()
