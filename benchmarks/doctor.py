"""Faults of logs that gaponet doctor detects on random robots (random_robots.py), and its false alarms.

    python benchmarks/doctor.py --robots 10        # the table of docs/results/doctor.md

A fault is detected if a warning or an error of its kind (FAULTS) appears that the unchanged logs do not have. All
robots are VIRTUAL. Faults of payload labels need a payload, so an arm.
"""

from __future__ import annotations

import argparse
import tempfile
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
from random_robots import RandomRobot, Recording, draw_robot

from gaponet.data.doctor import Diagnosis
from gaponet.data.log import Channel, Log
from gaponet.data.sequence import SequenceMeta, to_sequence
from gaponet.data.store import Dataset
from gaponet.robot.finding import Finding
from gaponet.robot.new import RobotOptions, new_robot
from gaponet.robot.spec import PayloadMount, RobotSpec
from gaponet.sim.dynamics import gravity_of

MOTIONS, SECONDS = 8, 18.0
Logs = list[Recording]


def every(change: Callable[[Recording], Recording]) -> Callable[[RandomRobot, Logs], Logs]:
    """Put a fault into all logs."""
    return lambda robot, logs: [change(log) for log in logs]


def one(change: Callable[[Recording], Recording]) -> Callable[[RandomRobot, Logs], Logs]:
    """Put a fault into the fourth log."""
    return lambda robot, logs: [change(log) if i == 3 else log for i, log in enumerate(logs)]


def shifted(seconds: float) -> Callable[[Recording], Recording]:
    """Delay the commands."""

    def change(log: Recording) -> Recording:
        rows = np.clip(np.searchsorted(log.time, log.time - seconds, side="right") - 1, 0, len(log.time) - 1)
        return replace(log, ctrl=log.ctrl[rows])

    return change


def state(log: Recording, values: Callable[[np.ndarray], np.ndarray]) -> Recording:
    """Change positions and velocities."""
    return replace(log, qpos=values(log.qpos), qvel=None if log.qvel is None else values(log.qvel))


def drifted(log: Recording) -> Recording:
    """Let the clock of the state run 2,000 ppm fast."""
    at = np.minimum(log.time * 1.002, log.time[-1])
    return state(log, lambda x: np.stack([np.interp(at, log.time, c) for c in x.T], axis=1))


def averaged(log: Recording) -> Recording:
    """Log the mean of the last 150 ms."""
    total = lambda x: np.concatenate([np.zeros((1, x.shape[1])), x.cumsum(axis=0)])  # noqa: E731
    first = np.searchsorted(log.time, log.time - 0.15, side="right")
    end = np.arange(1, len(log.time) + 1)
    return state(log, lambda x: (total(x)[end] - total(x)[first]) / (end - first)[:, None])


def velocities(log: Recording) -> Recording:
    """Log velocity commands as positions."""
    return replace(log, ctrl=np.clip(np.gradient(log.ctrl, log.time, axis=0), -3, 3))


def played(robot: RandomRobot, logs: Logs, number: int, told: Callable[[np.ndarray], np.ndarray]) -> Recording:
    """Play a motion that differs from the logged commands."""
    told_it = robot.commands(number, SECONDS)
    log = robot.play(logs[number].motion, told(told_it), logs[number].payload, number)
    return replace(log, ctrl=told_it[np.minimum(np.round(log.time * robot.rate).astype(int), len(told_it) - 1)])


def e_stop(robot: RandomRobot, logs: Logs) -> Logs:
    """Hold the brakes for four seconds of one motion."""
    a, b = (round(x * robot.rate) for x in (7, 11))
    hold = lambda u: np.concatenate([u[:a], np.repeat(u[a : a + 1], b - a, axis=0), u[b:]])  # noqa: E731
    return [played(robot, logs, i, hold) if i == 3 else log for i, log in enumerate(logs)]


def two_units(robot: RandomRobot, logs: Logs) -> Logs:
    """Replace half of the logs by those of a second robot of the same type."""
    rng, n = np.random.default_rng(robot.seed), len(robot.joints)
    servo = replace(robot.servo, offset=rng.normal(0, 0.015, n), kp=robot.servo.kp * rng.uniform(0.85, 1.15, n),
                  friction=robot.servo.friction * rng.uniform(0.6, 1.6, n))  # fmt: skip
    other = replace(robot, servo=servo)
    return [
        other.play(x.motion, robot.commands(i, SECONDS), x.payload, i) if i >= len(logs) / 2 else x
        for i, x in enumerate(logs)
    ]


def degrees(robot: RandomRobot, logs: Logs) -> Logs:
    """Log a joint that hardly moves in degrees."""
    j, found = len(robot.joints) // 2, []
    for i, x in enumerate(logs):
        ctrl = robot.commands(i, SECONDS)
        ctrl[:, j] = np.clip(0.02 * ctrl[:, j], robot.low[j], robot.high[j])
        log = robot.play(x.motion, ctrl, x.payload, i)
        for values in (log.ctrl, log.qpos, log.qvel):
            if values is not None:
                values[:, j] = np.degrees(values[:, j])
        found.append(log)
    return found


def torques(robot: RandomRobot, logs: Logs) -> Logs:
    """Log torques as positions."""
    robot = replace(robot, log_noise=replace(robot.log_noise, torque=True, dropped=0.0))
    again = [robot.play(x.motion, robot.commands(i, SECONDS), x.payload, i) for i, x in enumerate(logs)]
    return [replace(x, ctrl=x.tau, tau=None) for x in again if x.tau is not None]


def swapped(robot: RandomRobot, logs: Logs) -> Logs:
    """Swap the payload labels."""
    return [replace(x, payload=0.0 if x.payload else robot.payload) for x in logs] if robot.payload else []


FAULTS: dict[str, tuple[Callable[[RandomRobot, Logs], Logs], tuple[str, ...]]] = {
    "velocity commands as positions": (every(velocities), ("command",)),
    "torque commands as positions": (torques, ("command",)),
    "payload labels swapped": (swapped, ("payload",)),
    "two units under one name": (two_units, ("unit_id",)),
    "a joint in degrees that hardly moves": (degrees, ("unit", "gravity", "range")),
    "states' clock 2,000 ppm fast": (every(drifted), ("clock",)),
    "commands 30 ms late, one log": (one(shifted(0.03)), ("lag", "copied")),
    "commands 30 ms late, all logs": (every(shifted(0.03)), ("lag", "copied")),
    "commands 80 ms early, one log": (one(shifted(-0.08)), ("lag", "copied")),
    "commands 80 ms early, all logs": (every(shifted(-0.08)), ("lag", "copied")),
    "e-stop in the middle": (e_stop, ("blocked", "stuck", "stop")),
    "states averaged over 150 ms": (every(averaged), ("averaged", "lag")),
}


def examine(robot: RandomRobot, spec: RobotSpec, logs: Logs, folder: Path) -> list[Finding]:
    """Return the doctor's warnings and errors."""
    data = Dataset.create(folder, spec)
    for log in logs:
        names = {c: v for c in ("ctrl", "qpos", "qvel", "tau") if (v := getattr(log, c)) is not None}
        raw = Log(spec.name, robot.joints, {c: Channel(log.time, v) for c, v in names.items()}, log.motion)
        data.append(to_sequence(raw, spec, SequenceMeta(spec.name, "a", log.motion, log.payload)))
    found = Diagnosis.of(data, spec, gravity_model=gravity_of(spec)).findings
    return [f for f in found if f.level in ("warning", "error")]


def drawn(first: int, count: int) -> Iterator[RandomRobot]:
    """Draw robots of up to 250 Hz; those with a hand carry a payload."""
    for seed in range(first, first + count):
        robot = draw_robot(seed)
        robot = replace(robot, rate=min(robot.rate, 250.0))
        if robot.body == "arm" or "ur5e" in robot.body or "xarm" in robot.body:
            robot = replace(
                robot, payload=robot.payload or round(0.15 * float(robot.spec.compile().body_mass.sum()), 3)
            )
        yield robot


def main() -> None:
    """Simulate the faults and count detections."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--robots", type=int, default=10)
    parser.add_argument("--first", type=int, default=300)
    parser.add_argument("--faults", nargs="*", default=list(FAULTS))
    args = parser.parse_args()
    hits: dict[str, list[bool]] = {name: [] for name in args.faults}
    alarms: Counter[str] = Counter()
    clean = 0
    for robot in drawn(args.first, args.robots):
        with tempfile.TemporaryDirectory() as place:
            folder = Path(place)
            (folder / "vendor.xml").write_text(robot.file())
            wanted = RobotOptions(rate=robot.rate, name="stranger", joints=robot.joints)
            spec = new_robot(folder / "vendor.xml", folder / "robot", wanted).robot
            if robot.payload:
                spec = replace(spec, payload_mounts=(PayloadMount("hand", robot.bodies[-1], (0.0, 0.0, 0.0)),))
            robot = replace(robot, joints=spec.joint_names) if "/" not in robot.joints[0] else robot
            logs = list(robot.recordings(MOTIONS, MOTIONS * SECONDS))
            good = examine(robot, spec, logs, folder / "good")
            known = Counter((f.check, f.joints) for f in good)
            alarms.update({f.check for f in good})
            clean += not good
            print(
                f"== {robot.seed} {robot.body} {len(robot.joints)} joints {robot.rate:g} Hz {robot.effects}", flush=True
            )
            for f in good:
                print(f"   good: {f.level} {f.check}: {f.message[:200]}", flush=True)
            for number, name in enumerate(args.faults):
                damage, kinds = FAULTS[name]
                bad = damage(robot, logs)
                if not bad:
                    continue
                new = [f for f in examine(robot, spec, bad, folder / str(number)) if (f.check, f.joints) not in known]
                hits[name].append(any(f.check in kinds for f in new))
                print(f"   {'found ' if hits[name][-1] else 'MISSED'} {name}: "
                      + "; ".join(f"{f.level} {f.check}: {f.message[:110]}" for f in new[:4]), flush=True)  # fmt: skip
    lines = ["| fault | found |", "|---|---:|"]
    lines += [f"| {name} | {sum(found)} of {len(found)} |" for name, found in hits.items() if found]
    told = ", ".join(f"{check} {count}" for check, count in alarms.most_common()) or "none"
    lines += ["", f"Good logs of the same {args.robots} robots: {clean} without a warning; warnings by kind: {told}."]
    print("\n".join(lines))


if __name__ == "__main__":
    main()
