"""The README's table and picture: real SO-101 logs, 3 seeds, whole-motion free run on 10 motions never used otherwise.

    python benchmarks/real_so101.py LOGS WORK [--budget 409600] [--seeds 3]

From the nominal simulator: delay + offset, both MLPs, GAPONet. Identification, and GAPONet trained from what it found.
Trains and measures in WORK, where what is there is kept; writes docs/results/real_so101.{md,json,csv,svg,png} and the
tables by group and by horizon beside them.
"""

from __future__ import annotations

import argparse
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from publish import publish, say

from gaponet.cli.main import main as gaponet
from gaponet.data.store import Dataset
from gaponet.robot import load_robot
from gaponet.training.config import TrainConfig, WarmStartConfig
from gaponet_lab.plot.charts import Course, against
from gaponet_lab.plot.style import joint_label
from gaponet_lab.study.compare import Compare, identified
from gaponet_lab.study.found import Found, answer
from gaponet_lab.study.result import Result
from gaponet_lab.study.study import Study
from gaponet_lab.view.side_by_side import pick, side_by_side

SHOWN, JOINT, SECONDS = "dual_joint_elbow_wrist", "elbow_flex", 25.0
MODELS = ("mlp:mlp_match=on", "shared_mlp", "gaponet", "identified+gaponet")
CONFIG = TrainConfig(warm_start=WarmStartConfig(rounds=4, gradient_steps=800))  # labels are fitted then (label_rmse)


@dataclass(frozen=True)
class RealSO101(Compare):
    """A comparison with one joint of one motion beside it."""

    def result(self, study: Study, found: Found) -> Result:
        """The comparison, and one joint of one held-out motion."""
        made = super().result(study, found)
        run = found.cells["gaponet", ""][0].folder
        shown = side_by_side(study.data, pick(study.data, [run], SHOWN), study.robot, [run])
        start = len(shown.real) // 4
        rows = slice(start, start + round(SECONDS / shown.real.dt))
        column = shown.real.joint_names.index(JOINT)
        motions = {m.method: m for m in shown.motions if m.method != "target"}
        looks = {name: (m.name, m.colour) for name, m in motions.items()}
        recorded = motions.pop("recorded").qpos[rows, column]
        simulated = {name: m.qpos[rows, column] for name, m in motions.items()}
        time, joint = np.arange(len(recorded)) * shown.real.dt, joint_label(JOINT, wrapped=False)
        example = against(time, {joint: Course(simulated, recorded)}, looks, "recorded", f"{SHOWN}, real SO-101")
        return replace(made, figures=dict(made.figures) | {"example": example})


def main() -> None:
    """Measure, write, draw."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("logs", type=Path)
    parser.add_argument("work", type=Path)
    parser.add_argument("--budget", default="409600", help="four rounds; where they are in vain, three and PPO")
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--workers", type=int, default=0, help="trainings at a time; 0 for as many as there are cores")
    args = parser.parse_args()
    data = args.work / "data"
    if not data.exists():
        given = ["--robot", "so101", "--unit-id", "lab", "--payload-mass", "0", "--out", str(data)]
        if gaponet(["import", str(args.logs), *given]):
            raise SystemExit(2)
    study = Study(Dataset(data), load_robot("so101"), args.work, CONFIG, args.budget, args.seeds, workers=args.workers)
    study = identified(study, lambda done, total, rms: None)
    result = answer(RealSO101(MODELS), study, say)
    publish(replace(result, name="real_so101"), args.work / "results")


if __name__ == "__main__":
    main()
