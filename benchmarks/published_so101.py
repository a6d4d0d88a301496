r"""Published servo parameters of the SO-101 as rivals of an identification.

    python benchmarks/compare_methods.py --sets so101 so101_another_day \
        --method benchmarks/published_so101.py:nvidia \
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

from gaponet.data.sequence import Sequence
from gaponet.data.split import split_entries
from gaponet.robot.spec import RobotSpec
from gaponet.sim.dataset_robot import open_dataset
from gaponet.sim.replay import replay

FIELDS = "kp", "damping", "armature", "frictionloss"
PAN = "shoulder_pan"
LIFT = "shoulder_lift"
ELBOW = "elbow_flex"
EVERY = ""  # joint
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
    values = SETS[name]
    joints: dict[str, dict[str, float]] = {}
    for joint in robot.operated:
        known = values.get(joint, values.get(EVERY, ()))
        joints[joint] = {}
        for field, value in zip(FIELDS, known, strict=False):
            if not isnan(value):
                joints[joint][field] = value
    return robot.with_identified(joints)


def main() -> None:
    """Print the error of each joint, mean over the test motions, mrad."""
    data, robot = open_dataset(sys.argv[1], None, None)
    test = data.sequences(split_entries(data)["test"])
    _print_errors("nominal", test, robot)
    for name in SETS:
        _print_errors(name, test, published(robot, name))


def _print_errors(name: str, test: list[Sequence], robot: RobotSpec) -> None:
    errors = []
    for log, simulated in zip(test, replay(test, robot), strict=True):
        error = np.abs(simulated.qpos - log.qpos)[1:, robot.operated_index]
        errors.append(error.mean(axis=0))
    cells = [f"{1e3 * error:.2f}" for error in np.mean(errors, axis=0)]
    print(f"| {name} | {' | '.join(cells)} |")


if __name__ == "__main__":
    main()
