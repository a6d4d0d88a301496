"""Friction by temperature on VIRTUAL robots: verdicts, intervals, errors: docs/results/know.md.

    python benchmarks/temperature.py OUT.jsonl [--first 0] [--robots 40]     # resumes

Arms with one or two joints, drawn by seed. The friction of every second robot falls by 0.3 to 2 % per K of its housing;
half of these lose viscous damping as well. Of the others every second one loses gain with the temperature, by
magnets (0.1 % per K) and derating. Recordings begin 0 to 30 K above ambient in random order, motors heat up, and the
thermometer is in the winding. Six motions of 4 s are fitted, four validate, six test.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
from by_seed import Row, measure_seeds, plus_minus, print_table

from gaponet.data.sequence import Sequence, SequenceMeta
from gaponet.robot.servo_fields import Term
from gaponet.robot.spec import RobotSpec, load_robot
from gaponet.sim.replay import motion_errors
from gaponet.sysid.identify import identify
from gaponet.sysid.options import IdentifyOptions
from gaponet.virtual.physics import Physics, neutral
from gaponet.virtual.virtual_robot import VirtualRobot

DT, ROWS, FITTED, VALIDATED, MOTIONS = 0.02, 200, 6, 10, 16
NORMAL_90, KT_PER_KELVIN, DERATING_PER_KELVIN, COUNT_RAD = 1.645, 0.001, 0.005, 2 * np.pi / 4096
OTHER_TERMS: tuple[Term, ...] = ("stribeck", "load", "backlash")
XML = """<mujoco><compiler angle="radian" autolimits="true"/><option integrator="implicitfast"/>
<default><joint axis="0 1 0" range="-2.5 2.5"/><geom type="capsule" size="0.02" contype="0" conaffinity="0"/></default>
<worldbody>{}</worldbody></mujoco>"""


def draw(seed: int) -> tuple[RobotSpec, Physics, np.ndarray]:
    """Draw an arm, its hidden physics, and the loss of friction per K, (n,)."""
    rng, n = np.random.default_rng([seed, 21]), 1 + seed // 4 % 2
    lengths, masses = rng.uniform(0.1, 0.3, n), rng.uniform(0.1, 0.4, n)
    load = np.array([sum(masses[j:]) * sum(lengths[j:]) ** 2 / 2 for j in range(n)])
    armature = load * rng.uniform(0.3, 1.5, n)
    kp = np.maximum(
        (load + armature) * (2 * np.pi * rng.uniform(2.0, 4.0)) ** 2, 40 * masses * lengths
    )
    total = 2 * rng.uniform(0.5, 1.0, n) * np.sqrt(kp * (load + armature))
    friction = kp * np.exp(rng.uniform(np.log(3e-3), np.log(2e-2), n))
    body = ""
    for j in reversed(range(n)):
        at = lengths[j - 1] if j else 0
        body = (f'<body name="b{j}" pos="{at} 0 0"><joint name="j{j}" armature="{armature[j]}" damping="0"/>'
                f'<geom fromto="0 0 0 {lengths[j]} 0 0" mass="{masses[j]}"/>{body}</body>')  # fmt: skip
    folder = Path(tempfile.mkdtemp()) / f"warm{seed}"
    folder.mkdir()
    (folder / "robot.xml").write_text(XML.format(body))
    limit = 3 * kp
    joints = "".join(
        f'[[joint]]\nname = "j{j}"\nkp = {0.8 * kp[j]}\nkd = {0.4 * total[j]}\neffort_limit = {limit[j]}\n'
        for j in range(n)
    )
    (folder / "robot.toml").write_text(
        f'name = "warm{seed}"\ndt = {DT}\ntimestep = {DT / 4}\n{joints}'
    )
    robot, has, half = load_robot(folder), seed % 2 == 0, seed // 2 % 2 == 0
    thinning = has * np.exp(rng.uniform(np.log(3e-3), np.log(2e-2), n))
    passive = rng.uniform(0.3, 0.6) * half * has
    held = kp * 0.1  # N·m: heats the winding by about 10 K
    unit = replace(
        neutral(n), kp_scale=kp / robot.servo.kp, kd_scale=(1 - passive) * total / robot.servo.kd,
        damping=passive * total, friction=friction, stribeck=np.full(n, rng.choice([0.0, 0.5])),
        stribeck_speed=np.full(n, 0.1),
        thinning=thinning, motor_constant=held / np.sqrt(10.0), winding_time=np.full(n, 30.0),
        kt_drift=np.full(n, KT_PER_KELVIN * (half and not has)),
        derating=np.full(n, DERATING_PER_KELVIN * (half and not has)), delay=np.array([rng.uniform(0, 0.02)]),
        encoder_noise=np.full(n, 2e-4), encoder_step=np.full(n, COUNT_RAD), velocity_noise=np.full(n, 4e-3),
    )  # fmt: skip
    return robot, unit, thinning


def commands(n: int, seed: int, number: int) -> np.ndarray:
    """Draw sines, slow ways with rests, jumps or fast sines, (ROWS, n) rad."""
    rng, t = np.random.default_rng([seed, number, 22]), DT * np.arange(ROWS)[:, None]
    paces = rng.uniform(0.2, 0.8, n) * (4 if number % 4 == 3 else 1)
    waves = (
        rng.uniform(0.3, 0.8, n)
        * np.sin(2 * np.pi * paces * t + rng.uniform(0, 6, n))
        * np.minimum(1, t)
    )
    knots = rng.uniform(-0.7, 0.7, (8, n))
    ways = np.stack([np.interp(t[:, 0], np.repeat(np.arange(8), 2) * 0.6 + [0, 0.3] * 8, np.repeat(x, 2))
                     for x in knots.T], axis=1)  # fmt: skip
    return (waves, ways, 0.5 * np.repeat(knots, ROWS // 8, axis=0), 0.3 * waves)[number % 4]


def record(robot: RobotSpec, unit: Physics, seed: int) -> list[Sequence]:
    """Play all motions from random temperatures and log them."""
    n = len(robot.joint_names)
    ctrl = np.stack([commands(n, seed, k) for k in range(MOTIONS)])
    virtual = VirtualRobot(robot, [unit] * MOTIONS, [(0.0, "both")] * MOTIONS, dt=DT)
    warmth = np.random.default_rng([seed, 23]).uniform(0, 30, MOTIONS)
    virtual.reset(ctrl[:, 0], list(range(MOTIONS)), warmth)
    logs = np.empty((3, *ctrl.shape))
    for t in range(ROWS):
        reading = virtual.read()
        logs[:, :, t] = reading.qpos, reading.qvel, np.round(reading.temperature)
        virtual.step(ctrl[:, t])
    metas = [SequenceMeta(robot.name, "a", f"m{k:02}", 0.0, virtual=True) for k in range(MOTIONS)]
    return [
        Sequence(
            meta, robot.joint_names, DT, ctrl[k], logs[0, k], logs[1, k], temperature=logs[2, k]
        )
        for k, meta in enumerate(metas)
    ]


def result(seed: int) -> dict[str, object]:
    """Identify a robot with and without the term; return estimates and errors of the test motions."""
    robot, unit, thinning = draw(seed)
    logs, began = record(robot, unit, seed), time.process_time()
    fit = identify(
        logs[:FITTED],
        robot,
        logs[FITTED:VALIDATED],
        options=IdentifyOptions(table=False, folds=1, nthread=1),
    )
    seconds = time.process_time() - began
    term, without = next((c for c in fit.comparisons if c.name == "temperature"), None), fit
    if term and term.accepted:  # else the term changes nothing
        without = identify(
            logs[:FITTED],
            robot,
            logs[FITTED:VALIDATED],
            options=IdentifyOptions(terms=OTHER_TERMS, table=False, folds=1, nthread=1),
        )
    return {
        "seed": seed, "true_per_kelvin": (-thinning).tolist(),
        "per_kelvin": fit.robot.servo.friction_per_kelvin.tolist(),
        "damping_per_kelvin": fit.robot.servo.damping_per_kelvin.tolist(),
        "true_damping_per_kelvin": (-thinning * unit.damping).tolist(),
        "std": [fit.std[j].get("friction_per_kelvin", 0.0) for j in robot.operated], "tried": term is not None,
        "accepted": bool(term and term.accepted), "gain_rad": term.gain if term else None, "seconds": seconds,
        "temperatures": [s.temperatures for s in logs], "findings": fit.findings, "chosen": fit.chosen,
        "friction": fit.robot.servo.frictionloss.tolist(), "true_friction": unit.friction.tolist(),
        "test_rad": motion_errors(logs[VALIDATED:], fit.robot).tolist(),
        "test_without_rad": motion_errors(logs[VALIDATED:], without.robot).tolist(),
    }  # fmt: skip


def table(rows: list[Row]) -> None:
    """Print verdicts, coverage and errors of each kind of robots."""
    kinds = (
        "friction and damping fall",
        "the gain falls, friction does not",
        "friction alone falls",
        "nothing depends",
    )
    lines = []
    for i, kind in enumerate(kinds):
        some = [r for r in rows if r["seed"] % 4 == i]
        inside = [abs(c - true) <= NORMAL_90 * std for r in some if r["accepted"]
                  for c, true, std in zip(r["per_kelvin"], r["true_per_kelvin"], r["std"], strict=True)]  # fmt: skip
        before, after = (
            1e3 * np.array([np.mean(r[k]) for r in some]) for k in ("test_without_rad", "test_rad")
        )
        accepted = sum(r["accepted"] for r in some)
        lines.append((kind, len(some), accepted, plus_minus(before), plus_minus(after), plus_minus(after - before),
                      f"{sum(inside)} of {len(inside)}"))  # fmt: skip
    columns = (
        "VIRTUAL robots",
        "robots",
        "accepted",
        "without it, mrad",
        "with it, mrad",
        "change",
        "inside 90 %",
    )
    print_table(columns, lines)


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("out", type=Path)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--robots", type=int, default=40)
    args = parser.parse_args()
    table(measure_seeds(args.out, range(args.first, args.first + args.robots), result))


if __name__ == "__main__":
    main()
