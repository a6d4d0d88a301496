"""A servo's law fitted at three gains and judged at the fourth: docs/results/bam_xl330.md.

    python benchmarks/bam_xl330.py LOGS WORK          # 4 gains in turn × 5 fits, some minutes each
    python benchmarks/bam_xl330.py LOGS WORK --page   # the tables

LOGS: BAM's logs of one XL330 on a pendulum at four gains. Whole recordings in free run, ± standard error over them.
"""

from __future__ import annotations

import argparse
import json
import time
from pathlib import Path

import numpy as np

import gaponet as gp
from gaponet.data.sequence import Sequence
from gaponet.robot.spec import SERVO_FIELDS, RobotSpec, load_robot
from gaponet.sim.metrics import standard_error
from gaponet.sim.replay import replay
from gaponet.sysid.identify import identify

LAWS = {
    "classic": ("limit",),
    "+ Stribeck": ("limit", "stribeck"),
    "+ load": ("limit", "load", "external"),
    "+ load + Stribeck": ("limit", "load", "external", "stribeck"),
    "the same, fitted on the judged gain": ("limit", "load", "external", "stribeck"),
}


def gain(sequence: Sequence) -> float:
    """Of the firmware."""
    return float(sequence.meta.notes["firmware_kp"])


def errors(sequences: list[Sequence], robot: RobotSpec) -> list[float]:
    """Mean |error| of each recording, mrad."""
    return [
        1e3 * float(np.abs(t.qpos - s.qpos)[1:].mean())
        for s, t in zip(sequences, replay(sequences, robot), strict=True)
    ]


def judge(sequences: list[Sequence], held: float, law: str) -> dict[str, object]:
    """Fit on the other gains; the errors on this one, and the numbers found."""
    robot = load_robot("xl330_bench")
    test = [s for s in sequences if gain(s) == held]
    train = test if law.startswith("the same") else [s for s in sequences if gain(s) != held]
    began = time.monotonic()
    fit = identify(train, robot, terms=LAWS[law])
    return {
        "held": held, "law": law, "seconds": time.monotonic() - began,
        "motions": [s.meta.motion for s in test], "nominal": errors(test, robot), "test": errors(test, fit.robot),
        "train": errors(train, fit.robot), "servo": {f: float(getattr(fit.robot, f)[0]) for f in SERVO_FIELDS},
        "std": fit.std["motor"],
    }  # fmt: skip


def page(found: list[dict[str, object]]) -> None:
    """The tables, from what was measured."""
    gains = sorted({f["held"] for f in found})
    cell = lambda x: f"{np.mean(x):.1f} ± {standard_error(np.array(x)):.1f}"  # noqa: E731
    print(f"| law | {' | '.join(f'{g:g} held out' for g in gains)} | mean | fitted gains |")
    print("| --- |" + " ---: |" * (len(gains) + 2))
    for law in ("nominal", *LAWS):
        mine = [f for f in found if f["law"] == (law if law in LAWS else "classic")]
        tests = {f["held"]: f["test" if law in LAWS else "nominal"] for f in mine}
        cells = [cell(tests[g]) for g in gains] + [cell(np.concatenate(list(tests.values())))]
        cells.append(cell(np.concatenate([f["train"] for f in mine])) if law in LAWS else "")
        print(f"| {law} | {' | '.join(cells)} |")
    motions = found[0]["motions"]
    print(f"\n| law, gain | {' | '.join(motions)} |\n| --- |" + " ---: |" * len(motions))
    for f in found:
        print(f"| {f['law']}, {f['held']:g} | {' | '.join(f'{x:.1f}' for x in f['test'])} |")
    for f in found:
        print(
            f["law"],
            f["held"],
            {k: f"{v:.4g} ± {f['std'].get(k, np.nan):.2g}" for k, v in f["servo"].items() if v == v and v},
        )


def main() -> None:
    """Fit what is not there yet, then show."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("logs", type=Path)
    parser.add_argument("work", type=Path)
    parser.add_argument("--page", action="store_true", help="print the tables of what was measured")
    args = parser.parse_args()
    file = args.work / "found.json"
    found = json.loads(file.read_text()) if file.is_file() else []
    if not args.page:
        data = gp.import_logs(args.logs, "xl330_bench", args.work / "data", unit_id="bam").dataset
        sequences = data.sequences(data.entries)
        for held in sorted({gain(s) for s in sequences}):
            for law in LAWS:
                if not any(f["held"] == held and f["law"] == law for f in found):
                    found.append(judge(sequences, held, law))
                    file.write_text(json.dumps(found, indent=1) + "\n")
                    print(json.dumps(found[-1]), flush=True)
    page(found)


if __name__ == "__main__":
    main()
