"""Random found poses and hostile live targets against plan and fence, judged by MuJoCo's own
collision (contacts.py).

    PYTHONPATH=tests python tests/hw/control/plan_adversary.py --poses 1000 --seconds 60 --seed 0

Plans: poses over the joints' whole ranges in which the robot touches neither itself nor the plane
(h1_2: arms and torso), a motion of the package each, planned from there and back; a plan is judged
every 0.02 rad. Live: the virtual robots in simulated time, whose targets go for the plane, the body
and the ends of the ranges as fast as may be; what was commanded and where the robot was is judged
in every period. Prints counts as JSON; exit code 1 if anything touches.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections import Counter
from typing import Any

import numpy as np
from contacts import Contacts

from gaponet.base.errors import UsageError
from gaponet.hw.control.clock import SimulatedClock
from gaponet.hw.control.controller import Controller
from gaponet.hw.control.driver import State
from gaponet.hw.control.plan import Planner
from gaponet.motion.library import Library
from gaponet.robot.spec import RobotSpec, load_robot
from gaponet.virtual.fleet import load_fleet
from gaponet.virtual.virtual_driver import VirtualDriver

Array = np.ndarray
ROBOTS = {"so101": 0.0, "h1_2": 3.0}  # kg per hand that motions must be possible with
DT = 0.02


def found_pose(robot: RobotSpec, judge: Contacts, rng: np.random.Generator) -> Array:
    """A pose anywhere in the ranges that touches nothing; legs at home."""
    arms = [
        i
        for i, n in enumerate(robot.joint_names)
        if "hip" not in n and "knee" not in n and "ankle" not in n
    ]
    while True:
        qpos = robot.qpos_home.copy()
        qpos[arms] = rng.uniform(*robot.qpos_range[arms].T)
        if judge.deepest(qpos)[0] == 0:
            return qpos


def plans(robot: RobotSpec, poses: int, seed: int, motions: int | None = None) -> dict[str, Any]:
    """What came of planning that many times; `motions`: how many of the package's are taken,
    default all.
    """
    rng = np.random.default_rng(seed)
    judge = Contacts(robot)
    library = Library(robot, max_payload=ROBOTS[robot.name])
    moved = tuple(n for n in robot.joint_names if n in robot.operated or robot.name == "so101")
    names = [
        n
        for n in library.names()
        if not n.startswith(("squat", "march", "sway")) and "-all-" not in n
    ]
    names += ["tour-all-0", "limber-all-0"] if robot.name == "so101" else []
    names = names if motions is None else rng.choice(names, motions, replace=False).tolist()
    planner = Planner(robot, moved, limits=library.limits)
    count: Counter[str] = Counter()
    seconds = []
    refused = []
    touching = []
    straight = []
    for k in range(poses):
        found = found_pose(robot, judge, rng)
        motion = library.make(names[k % len(names)])
        began = time.process_time()
        try:
            plan = planner.plan(motion, found)
        except UsageError as error:
            count["refused"] += 1
            refused.append(str(error)[:160])
            continue
        seconds.append(time.process_time() - began)
        count["straight" if len(plan.approach.points) == 2 else "around"] += 1
        depth, pair = judge.along(plan.rows[::5], 0.02)
        direct = judge.along(np.stack([found, plan.motion.ctrl[0]]), 0.02)[0]
        straight.append(direct)
        if depth > 0:
            touching.append(f"{motion.name}: {pair} {depth:.4f} m")
    return {
        "poses": poses,
        "motions": len(names),
        **count,
        "touching": len(touching),
        "examples": touching[:3],
        "straight ways that would touch": int(np.sum(np.array(straight) > 0)),
        "planning s: p50, max": [round(float(f(seconds)), 2) for f in (np.median, np.max)],
        "refused because": Counter(refused).most_common(3),
    }


class Hostile:
    """Targets that go for the plane, for the body and for the ends of the ranges, at the fastest
    that is taken.
    """

    def __init__(
        self, robot: RobotSpec, judge: Contacts, rng: np.random.Generator, seconds: float
    ) -> None:
        self.robot = robot
        self.rng = rng
        self.judge = judge
        self.periods = round(seconds / DT)
        self.touching = 0
        self.low, self.high = robot.qpos_range.T
        self.still = ["hip" in n or "knee" in n or "ankle" in n for n in robot.joint_names]
        self.bad = []  # postures in which it would touch something
        while len(self.bad) < 100:
            qpos = np.where(self.still, robot.qpos_home, rng.uniform(self.low, self.high))
            if judge.deepest(qpos)[0] > 0.02:
                self.bad.append(qpos)
        self.target = robot.qpos_home.copy()

    def __call__(self, k: int, state: State) -> Array | None:
        if k >= self.periods:
            return None
        if k == 0:  # until it is there
            self.goal = self.robot.qpos_home
            self.speed = 1.0
        elif k % 20 == 0:
            self.goal = self.bad[self.rng.integers(len(self.bad))]
            self.speed = self.rng.choice([0.3, 1.0, 3.0, 5.0])
        if self.rng.random() < 0.02:
            self.target = np.where(
                self.still,
                self.target,
                self.target + 0.1 * self.rng.standard_normal(len(self.still)),
            )
        step = self.speed * DT
        self.target = self.target + np.clip(self.goal - self.target, -step, step)
        self.touching += self.judge.deepest(self.target)[0] > 0
        return self.target.copy()


def live(robot: RobotSpec, seconds: float, seed: int) -> dict[str, Any]:
    """What a virtual robot did in that time of hostile targets, in simulated time."""
    rng = np.random.default_rng(seed)
    judge = Contacts(robot)
    clock = SimulatedClock()
    driver = VirtualDriver(robot, load_fleet("easy", robot).unit("virtual-1"), clock, seed=seed)
    controller = Controller(driver, robot, clock=clock)
    hostile = Hostile(robot, judge, rng, seconds)
    recording = controller.run(hostile)
    asked = [r for r in recording.rows if r.ctrl is not None and r.phase == "run"]
    commanded = [judge.deepest(r.ctrl) for r in asked]
    measured = [judge.deepest(r.state.qpos) for r in asked]
    worst = max([*commanded, *measured, (0.0, "")])
    return {
        "seconds": round(len(asked) * DT, 1),
        "end": recording.events[-1].text,
        "fault": recording.fault.text if recording.fault else "",
        "commands that touch": sum(d > 0 for d, _ in commanded),
        "states that touch": sum(d > 0 for d, _ in measured),
        "targets that would": hostile.touching,
        "deepest": f"{worst[0]:.4f} m {worst[1]}",
    }


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--poses", type=int, default=1000)
    parser.add_argument("--seconds", type=float, default=60.0)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--robot", choices=list(ROBOTS), nargs="+", default=list(ROBOTS))
    args = parser.parse_args()
    bad = 0
    for name in args.robot:
        robot = load_robot(name)
        began = time.monotonic()
        result = {"robot": name, "plans": plans(robot, args.poses, args.seed)}
        result["live"] = live(robot, args.seconds, args.seed)
        result["minutes"] = round((time.monotonic() - began) / 60, 1)
        bad += (
            result["plans"]["touching"]
            + result["live"]["commands that touch"]
            + result["live"]["states that touch"]
        )
        print(json.dumps(result, indent=1), flush=True)
    sys.exit(bool(bad))


if __name__ == "__main__":
    main()
