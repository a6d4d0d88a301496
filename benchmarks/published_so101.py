"""Published servo parameters of the SO-101 as rivals of an identification.

    python benchmarks/compare_methods.py --sets so101 so101_another_day --method benchmarks/published_so101.py:nvidia \
        --method benchmarks/published_so101.py:community
    python benchmarks/published_so101.py DATASET        # error of each joint on the test motions

Values are kp N·m/rad, kd N·m·s/rad, armature kg·m², dry friction N·m; NaN and joints that are left
out are not known to us and have the robot file's value. Delay and offset: 0.
"""

from __future__ import annotations

import sys
from math import isnan, nan

import numpy as np
from real_robots.methods import FittedSim
from real_robots.questions import Question

from gaponet.data.split import split_entries
from gaponet.robot.spec import RobotSpec
from gaponet.sim.dataset_robot import open_dataset
from gaponet.sim.replay import replay

FIELDS = "kp", "damping", "armature", "frictionloss"
PAN, LIFT, ELBOW, EVERY = "shoulder_pan", "shoulder_lift", "elbow_flex", ""
SETS = {
    "NVIDIA so101-typing-task": {
        PAN: (48.9, 2.31, 0.058, 0.215),
        ELBOW: (18.6, 0.53, 0.055, 0.402),
    },
    "AnchorBench": {
        PAN: (48.4, 3.34, 0.068, 0.347),
        LIFT: (47.78, 2.563, 0.0276, 0.345),
        ELBOW: (14.7, nan, nan, nan),
    },
    "MuJoCo Playground": {PAN: (nan, nan, 0.109, 0.0001), ELBOW: (nan, nan, 0.122, 0.0)},
    "community MJCF": {EVERY: (17.8, 0.60, 0.028, 0.052)},
    "hand-tuned before AnchorBench": {EVERY: (33.0, 1.6, 0.02, 0.0)},
}


def nvidia(question: Question) -> FittedSim:
    """Return NVIDIA's values of two joints (gtc_berlin.yaml)."""
    return FittedSim(published(question.robot, "NVIDIA so101-typing-task"))


def anchorbench(question: Question) -> FittedSim:
    """Return the values of three joints in NVIDIA's USD."""
    return FittedSim(published(question.robot, "AnchorBench"))


def playground(question: Question) -> FittedSim:
    """Return armature and friction of two joints in MuJoCo Playground 1.0.0."""
    return FittedSim(published(question.robot, "MuJoCo Playground"))


def community(question: Question) -> FittedSim:
    """Return the values of the community's MJCF."""
    return FittedSim(published(question.robot, "community MJCF"))


def hand_tuned(question: Question) -> FittedSim:
    """Return the values that were tuned by hand before AnchorBench."""
    return FittedSim(published(question.robot, "hand-tuned before AnchorBench"))


def published(robot: RobotSpec, name: str) -> RobotSpec:
    """Return the robot with a published set."""
    joints = {j: SETS[name].get(j, SETS[name].get(EVERY, ())) for j in robot.operated}
    return robot.with_identified({
        j: {f: v for f, v in zip(FIELDS, values, strict=False) if not isnan(v)} for j, values in joints.items()
    })  # fmt: skip


def main() -> None:
    """Print the error of each joint, mean over the test motions, mrad."""
    data, robot = open_dataset(sys.argv[1], None, None)
    test, op = data.sequences(split_entries(data)["test"]), robot.operated_index
    for name, spec in {"nominal": robot, **{name: published(robot, name) for name in SETS}}.items():
        errors = [
            np.abs(t.qpos - s.qpos)[1:, op].mean(axis=0)
            for s, t in zip(test, replay(test, spec), strict=True)
        ]
        cells = [f"{1e3 * e:.2f}" for e in np.mean(errors, axis=0)]
        print(f"| {name} | {' | '.join(cells)} |")


if __name__ == "__main__":
    main()
