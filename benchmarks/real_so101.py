"""The README's table and picture: real SO-101 logs, 3 seeds, whole-motion free run on 10 motions never used otherwise.

    python benchmarks/real_so101.py LOGS WORK [--budget 614000] [--mlp-budget 614000] [--seeds 0 1 2]

From the nominal simulator: delay + offset, MLP, GAPONet. Identification, and GAPONet trained from what it found.
Calls the commands a user would call; writes docs/results/real_so101.{json,md,svg,png}. Runs found in WORK are kept.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
from datetime import date
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np

from gaponet.plot.methods import COLOURS, NAMES
from gaponet.plot.style import STYLE, figure

TITLES = NAMES | {"identified": "identification", "identified_gaponet": "identification + GAPONet"}
FILL = COLOURS | {"identified_gaponet": "#7d0a1d"}

# Six rounds of the warm start from the nominal simulator, four from the identified one; PPO adds less than 2 % to it.
ROUNDS = 4  # of the warm start from the identified simulator: later ones fit noise
# Networks of the published numbers, twice as wide as today's default.
WIDE = ("--model.branch-hidden", 128, 128, "--model.trunk-hidden", 64, 64, "--model.sensor-hidden", 256, 256)
DOCS = Path(__file__).parents[1] / "docs" / "results"
ENVIRONMENT = os.environ | {"OMP_WAIT_POLICY": "PASSIVE"}


def gaponet(*words: object) -> dict[str, Any]:
    """Run a command with --json and return its object."""
    command = [sys.executable, "-m", "gaponet.cli.main", *map(str, words), "--json"]
    print("gaponet", *words, flush=True)
    done = subprocess.run(command, check=True, stdout=subprocess.PIPE, text=True, env=ENVIRONMENT)
    return json.loads(done.stdout)


def measure(logs: Path, work: Path, budgets: dict[str, str], seeds: list[int]) -> list[dict[str, Any]]:
    """One evaluation per seed, all methods side by side."""
    data, fitted = work / "data", work / "identified"
    if not data.exists():
        gaponet("import", logs, "--robot", "so101", "--unit-id", "lab", "--payload-mass", 0, "--out", data)
    further = any("_from_identified" in run for run in budgets)
    if further and not fitted.exists():
        gaponet("identify", data, "--out", fitted)
    for run in budgets:
        for seed in seeds:
            train(data, fitted, work / f"{run}-{seed}", seed, run, budgets)
    results = []
    for seed in seeds:
        result = gaponet("eval", work / f"gaponet-{seed}", data, "--also", work / f"mlp-{seed}")
        if further:
            found = gaponet("eval", work / f"gaponet_from_identified-{seed}", data)["methods"]
            result["methods"] |= {"identified": found["identified"], "identified_gaponet": found["gaponet"]}
        results.append(result)
    return results


def train(data: Path, fitted: Path, out: Path, seed: int, run: str, budgets: dict[str, str]) -> None:
    """One run, unless it is there."""
    if (out / "model" / "card.json").exists():
        return
    kind, *start = run.split("_from_")
    robot = ["--robot", fitted, "--warm-start.rounds", ROUNDS] if start else []
    gaponet("train", data, "--out", out, "--model", kind, "--seed", seed, "--budget", budgets[run], *WIDE, *robot)


def spread(results: list[dict[str, Any]], *path: str) -> tuple[float, float]:
    """Mean and standard deviation over seeds of one number of a method."""
    values = []
    for value in (r["methods"] for r in results):
        for key in path:
            value = value[key]
        values.append(value)
    return float(np.mean(values)), float(np.std(values, ddof=1)) if len(values) > 1 else 0.0


def table(results: list[dict[str, Any]]) -> str:
    """Markdown, method by method."""
    nominal = spread(results, "nominal", "mpjae")[0]
    rows = [
        "| method | MPJAE, mrad | of nominal | Q_dis, rad·s | share ≥ 0.05 rad |",
        "| --- | ---: | ---: | ---: | ---: |",
    ]
    for name in results[0]["methods"]:
        mean, std = spread(results, name, "mpjae")
        text = f"{mean * 1e3:.2f} ± {std * 1e3:.2f}" if std > 1e-9 else f"{mean * 1e3:.2f}"
        large, q_dis = spread(results, name, "large_0.05")[0] * 100, spread(results, name, "q_dis")[0]
        rows.append(f"| {TITLES[name]} | {text} | {mean / nominal:.2f} | {q_dis:.2f} | {large:.1f} % |")
    return "\n".join(rows)


def horizons(results: list[dict[str, Any]]) -> str:
    """Markdown: MPJAE in mrad by time since the common start."""
    methods = list(results[0]["methods"])
    times = list(results[0]["methods"]["nominal"]["by_horizon"])
    lines = ["| after | " + " | ".join(TITLES[m] for m in methods) + " |", "| --- |" + " ---: |" * len(methods)]
    for time in times:
        found = [spread(results, m, "by_horizon", time, "mpjae") for m in methods]
        cells = [f"{a * 1e3:.2f} ± {b * 1e3:.2f}" if b > 1e-9 else f"{a * 1e3:.2f}" for a, b in found]
        lines.append(f"| {time + ' s' if time != 'whole' else 'whole motion'} | {' | '.join(cells)} |")
    return "\n".join(lines)


def draw(results: list[dict[str, Any]], run: Path) -> None:
    """Error by joint with spread over seeds; one joint of one held-out motion beside it."""
    with mpl.rc_context(STYLE | {"font.size": 10}):  # type: ignore[arg-type]
        fig = figure(10.5, 3.6)
        left, right = fig.subplots(1, 2, width_ratios=[1, 1.15])
        methods = list(results[0]["methods"])
        joints = list(results[0]["methods"]["nominal"]["by_joint"])
        width = 0.8 / len(methods)
        for i, name in enumerate(methods):
            values = 1e3 * np.array([spread(results, name, "by_joint", j, "mpjae") for j in joints])
            x = np.arange(len(joints)) + (i - (len(methods) - 1) / 2) * width
            error = values[:, 1] if values[:, 1].any() else None
            left.bar(
                x, values[:, 0], width * 0.92, yerr=error, color=FILL[name], error_kw={"lw": 0.8}, label=TITLES[name]
            )
        left.set_xticks(np.arange(len(joints)), [j.replace("_", "\n") for j in joints])
        left.grid(axis="x", visible=False)
        left.set_ylabel("MPJAE, mrad")
        left.set_title("Real SO-101, 10 held-out motions, whole-motion free run")
        _trajectory(right, run, joints)
        handles, labels = left.get_legend_handles_labels()
        fig.legend(handles, labels, loc="outside upper center", ncols=len(labels))
        for suffix in ("svg", "png"):
            fig.savefig(DOCS / f"real_so101.{suffix}", dpi=160)


def _trajectory(ax: Any, run: Path, joints: list[str]) -> None:
    shown = json.loads((run / "metrics.json").read_text())["shown"]
    row = next((i for i, s in enumerate(shown) if s["motion"] == "dual_joint_elbow_wrist"), 0)
    with np.load(run / "trajectories.npz") as arrays:
        j = joints.index("elbow_flex")
        n = round(25 / shown[row]["dt"])
        time = np.arange(n) * shown[row]["dt"]
        part = slice(n // 2, n // 2 + n)
        for name in ("nominal", "delay_offset", "gaponet"):
            ax.plot(time, arrays[f"{row}/{name}"][part, j], color=FILL[name])
        ax.plot(time, arrays[f"{row}/recorded"][part, j], color=COLOURS["recorded"], ls=(0, (4, 1.5)), lw=1)
    ax.set_title(f"elbow_flex in {shown[row]['motion']} (dashed: the robot)")
    ax.set_xlabel("time, s")
    ax.set_ylabel("position, rad")


def main() -> None:
    """Measure, write, draw."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("logs", type=Path)
    parser.add_argument("work", type=Path)
    parser.add_argument("--budget", default="614000")
    parser.add_argument("--mlp-budget", default="614000")
    parser.add_argument("--identified-budget", default="409000", help="for GAPONet from the identified simulator")
    parser.add_argument("--nominal-only", action="store_true", help="without identification and what starts from it")
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1, 2])
    args = parser.parse_args()
    args.work.mkdir(parents=True, exist_ok=True)
    budgets = {"gaponet": args.budget, "mlp": args.mlp_budget}
    if not args.nominal_only:
        budgets["gaponet_from_identified"] = args.identified_budget
    results = measure(args.logs, args.work, budgets, args.seeds)
    DOCS.mkdir(parents=True, exist_ok=True)
    first = results[0]
    steps = ", ".join(f"{value} ({run.replace('_', ' ')})" for run, value in budgets.items())
    text = (
        f"# Real SO-101\n\nWhole-motion free run on {first['sequences']} held-out motions, mean ± std over seeds "
        f"{args.seeds}; training budgets in control steps: {steps}; {date.today()}.\nSimulator "
        f"{first['simulator_hash']}. Regenerate: `python benchmarks/real_so101.py LOGS WORK"
        f"{' --nominal-only' if args.nominal_only else ''}`.\n\n"
        f"{table(results)}\n\nMPJAE in mrad by time since the start (of the last half of that time):\n\n"
        f"{horizons(results)}\n\nHeld-out motions: {', '.join(first['motions'])}.\n\n![](real_so101.svg)\n"
    )
    (DOCS / "real_so101.md").write_text(text, encoding="utf-8")
    (DOCS / "real_so101.json").write_text(
        json.dumps(dict(zip(map(str, args.seeds), results, strict=True)), indent=1) + "\n"
    )
    draw(results, args.work / f"gaponet-{args.seeds[0]}")
    print(table(results))


if __name__ == "__main__":
    main()
