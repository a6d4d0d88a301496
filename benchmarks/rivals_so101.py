"""What others' identification leaves of the real SO-101's gap: docs/results/rivals_so101.md.

    python benchmarks/rivals_so101.py DATASET WORK           # PACE's search (minutes), then validation motions
    python benchmarks/rivals_so101.py DATASET WORK --test    # the test motions, looked at once
    python benchmarks/rivals_so101.py DATASET WORK --page    # the table

DATASET: gaponet import of the public logs. Needs `pip install cmaes`, the optimizer that PACE uses. Whole motions in
free run, 5 arm joints, ± standard error over motions.

BAM (Rhoban): an STS3215 measured on a pendulum, its published numbers put into this arm as they are: firmware gain,
supply, torque constant and winding make kp, damping and torque limit. 7.4 V and 12 V servos, firmware P of 32 (the
factory's) and 16 (LeRobot's). PACE (ETH RSL): armature, damping, friction, encoder bias of each joint and one delay by
CMA-ES on free runs of all joints at once, gains as given; bounds are those of its published example.
"""

from __future__ import annotations

import argparse
import json
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
from identify_so101 import rows

from gaponet.base.files import write_text
from gaponet.data.sequence import Sequence
from gaponet.data.split import split_entries
from gaponet.data.store import Dataset
from gaponet.robot.folder import save_robot
from gaponet.robot.spec import RobotSpec, load_robot
from gaponet.sim.batch import BatchSim, Condition
from gaponet.sim.replay import idle_limbs

BAM = {  # V, N·m/A or V·s/rad, ohm, kg·m², N·m, N·m·s/rad: Rhoban/bam, params/feetech_sts3215_*/m1.json
    "7.4 V": {"vin": 7.4, "kt": 1.2116, "R": 2.6762, "armature": 0.02840, "friction": 0.05239, "viscous": 0.05909},
    "12 V": {"vin": 12.0, "kt": 1.4440, "R": 2.0296, "armature": 0.03246, "friction": 0.19587, "viscous": 0.03047},
}
DUTY, LARGEST = 0.166, 0.97  # duty cycle by firmware gain and rad, and its limit: the same source
BOUNDS = {"armature": (1e-5, 1.0), "damping": (0.0, 7.0), "frictionloss": (0.0, 0.5), "zero": (-0.1, 0.1)}  # of PACE
DELAY = 10  # physics steps at most
POPULATION, GENERATIONS, SIGMA = 40, 120, 0.5
SECONDS = 5.0  # of each training motion


def bam(servo: str, gain: float) -> RobotSpec:
    """The package's arm with BAM's servo in every operated joint."""
    b, robot = BAM[servo], load_robot("so101")
    slope = b["kt"] / b["R"]
    numbers = {"kp": slope * b["vin"] * gain * DUTY, "armature": b["armature"], "frictionloss": b["friction"],
               "damping": b["kt"] * slope + b["viscous"]}  # fmt: skip
    limit = np.array(robot.effort_limit)
    limit[robot.operated_index] = slope * b["vin"] * LARGEST
    return replace(robot.with_servos(dict.fromkeys(robot.operated, numbers)), effort_limit=limit)


def pace(parts: list[Sequence]) -> tuple[RobotSpec, list[float]]:
    """The arm that PACE's search finds, and the best cost of each generation, rad²."""
    from cmaes import CMA

    robot = load_robot("so101")
    n = len(robot.operated)
    low, high = (np.r_[np.repeat([b[k] for b in BOUNDS.values()], n), [0.0, DELAY * robot.timestep][k]] for k in (0, 1))
    cost = RobotRollouts(parts, robot, high[-1])
    search = CMA(np.zeros(len(low)), SIGMA, np.tile([-1.0, 1.0], (len(low), 1)), seed=0, population_size=POPULATION)
    history = []
    for generation in range(GENERATIONS):
        asked = np.array([search.ask() for _ in range(POPULATION)])
        costs = cost(low + (asked + 1) / 2 * (high - low))
        search.tell(list(zip(asked, costs.tolist(), strict=True)))
        history.append(float(costs.min()))
        if generation % 10 == 0:
            print(f"{generation} of {GENERATIONS}: {1e3 * history[-1] ** 0.5:.2f} mrad rms", flush=True)
    x = low + (search.mean + 1) / 2 * (high - low)
    numbers = dict(zip(BOUNDS, np.split(x[:-1], len(BOUNDS)), strict=True))
    servos = {j: {f: float(v[i]) for f, v in numbers.items()} | {"delay": float(x[-1])}
              for i, j in enumerate(robot.operated)}  # fmt: skip
    return robot.with_servos(servos), history


class RobotRollouts:
    """Mean squared error of many arms beside the same recordings, in one batch."""

    def __init__(self, parts: list[Sequence], robot: RobotSpec, latest: float) -> None:
        late = np.array(robot.delay) + 0.0
        late = np.where(np.isin(robot.joint_names, robot.operated), latest, late)
        self.robot, self.parts, self.op = robot, parts, robot.operated_index
        self.locked = idle_limbs(parts, robot)
        self.sim = BatchSim(
            replace(robot, delay=late), [Condition.of(s, robot) for s in parts] * POPULATION, 1, self.locked
        )
        self.free = robot.index(self.sim.joint_names)
        self.place = np.array([self.sim.joint_names.index(j) for j in robot.operated])

    def __call__(self, xs: np.ndarray) -> np.ndarray:
        """Cost of parameter vectors (k, P), rad²."""
        k, m, n = len(xs), len(self.parts), len(self.op)
        values = {
            f: np.repeat(v, m, axis=0) for f, v in zip(BOUNDS, np.split(xs[:, :-1], len(BOUNDS), axis=1), strict=True)
        }
        values["delay"] = np.repeat(np.repeat(xs[:, -1:], n, axis=1), m, axis=0)
        values["kp"], values["offset"] = np.broadcast_to(self.robot.kp[self.op], (k * m, n)), np.zeros((k * m, n))
        self.sim.set_servos(self.robot.operated, values)
        ctrl = np.tile(np.stack([s.ctrl[:, self.free] for s in self.parts], axis=1), (1, k, 1))
        real = np.stack([s.qpos[:, self.op] for s in self.parts], axis=1)
        q0, v0 = (
            np.tile(np.stack([getattr(s, f)[0, self.free] for s in self.parts]), (k, 1)) for f in ("qpos", "qvel")
        )
        self.sim.reset(slice(None), q0, v0, past=ctrl[0][:, None])
        total = np.zeros(k)
        for t in range(len(ctrl) - 1):
            self.sim.step(ctrl[t])
            apart = self.sim.qpos[:, self.place].reshape(k, m, n) - real[t + 1]
            total += (apart**2).mean(axis=(1, 2))
        return total / (len(ctrl) - 1)


def simulators(work: Path, train: list[Sequence]) -> dict[str, RobotSpec]:
    """The rows; PACE's searches are kept in WORK."""
    found = {"nominal": load_robot("so101")}
    found |= {f"BAM, {servo}, P {gain}": bam(servo, gain) for servo in BAM for gain in (32, 16)}
    place = work / "pace"
    if not (place / "robot.toml").is_file():
        began = time.process_time()
        robot, history = pace([s.rows(slice(round(SECONDS / s.dt))) for s in train])
        save_robot(robot, place)
        write_text(work / "pace.json", json.dumps({"cost": history, "seconds": time.process_time() - began}) + "\n")
    found["PACE"] = load_robot(place)
    return found


def page(work: Path) -> None:
    """The table, from what was measured."""
    val, test = (json.loads((work / f"{part}.json").read_text()) for part in ("val", "test"))
    nominal = test[0]["mrad"]
    print("| simulator | validation, mrad | test, mrad | of nominal |\n| --- | ---: | ---: | ---: |")
    for v, t in zip(val, test, strict=True):
        cells = [f"{x['mrad']:.2f} ± {x['standard_error']:.2f}" for x in (v, t)]
        print(f"| {t['simulator']} | {' | '.join(cells)} | {t['mrad'] / nominal:.2f} |")


def main() -> None:
    """Search, then judge."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("dataset", type=Path)
    parser.add_argument("work", type=Path)
    parser.add_argument("--test", action="store_true")
    parser.add_argument("--page", action="store_true", help="print the table of what was measured")
    args = parser.parse_args()
    if not args.page:
        args.work.mkdir(parents=True, exist_ok=True)
        data = Dataset(args.dataset)
        parts = {name: data.sequences(entries) for name, entries in split_entries(data).items()}
        part = "test" if args.test else "val"
        found = rows(simulators(args.work, parts["train"]), parts[part])
        write_text(args.work / f"{part}.json", json.dumps(found, indent=1) + "\n")
    if args.page or args.test:
        page(args.work)


if __name__ == "__main__":
    main()
