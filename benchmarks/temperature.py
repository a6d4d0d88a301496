"""Friction by temperature on VIRTUAL robots: verdicts, intervals, errors: docs/results/know.md.

    python benchmarks/temperature.py OUT.jsonl [--first 0] [--robots 40]     # resumes

Arms with one or two joints, drawn by seed. The friction of every second robot falls by 0.3 to 2 %
per K of its housing; half of these lose viscous damping as well. Of the others every second one
loses gain with the temperature, by magnets (0.1 % per K) and derating. Recordings begin 0 to 30 K
above ambient in random order, motors heat up, and the thermometer is in the winding. Six motions
of 4 s are fitted, four validate, six test.
"""

from __future__ import annotations

import tempfile
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
from common import (
    Row,
    command_line,
    measure_seeds,
    plus_minus,
    print_table,
    share_inside,
)
from draws import log_uniform
from virtual_arms import arm_xml, play_virtual, write_robot

from gaponet.data.sequence import Sequence, SequenceMeta
from gaponet.robot.servo_fields import Term
from gaponet.robot.spec import RobotSpec
from gaponet.sim.replay import motion_errors
from gaponet.sysid.identify import identify
from gaponet.sysid.options import IdentifyOptions
from gaponet.virtual.physics import Physics, neutral
from gaponet.virtual.virtual_robot import VirtualRobot

DT = 0.02  # s
ROWS = 200  # of a motion
MOTIONS = 16
FITTED = 6  # the first so many
VALIDATED = 10  # up to this one; the others test
KT_PER_KELVIN = 0.001  # loss of a motor's torque constant
DERATING_PER_KELVIN = 0.005  # loss of a drive's gain
COUNT_RAD = 2 * np.pi / 4096  # of the encoder
OTHER_TERMS: tuple[Term, ...] = ("stribeck", "load", "backlash")
KINDS = (  # by the seed's remainder
    "friction and damping fall",
    "the gain falls, friction does not",
    "friction alone falls",
    "nothing depends",
)


def draw(seed: int) -> tuple[RobotSpec, Physics, np.ndarray]:
    """Draw an arm, its hidden physics, and the loss of friction per K, (n,)."""
    rng = np.random.default_rng([seed, 21])
    n = 1 + seed // 4 % 2
    lengths = rng.uniform(0.1, 0.3, n)
    masses = rng.uniform(0.1, 0.4, n)
    load = np.array([sum(masses[j:]) * sum(lengths[j:]) ** 2 / 2 for j in range(n)])
    armature = load * rng.uniform(0.3, 1.5, n)
    inertia = load + armature
    pace = 2 * np.pi * rng.uniform(2.0, 4.0)
    kp = np.maximum(inertia * pace**2, 40 * masses * lengths)
    total = 2 * rng.uniform(0.5, 1.0, n) * np.sqrt(kp * inertia)
    friction = kp * log_uniform(rng, 3e-3, 2e-2, n)
    robot = _write(seed, lengths, masses, armature, kp, total)
    falls = seed % 2 == 0
    every_second = seed // 2 % 2 == 0
    thinning = log_uniform(rng, 3e-3, 2e-2, n)
    if not falls:
        thinning = np.zeros(n)
    passive = rng.uniform(0.3, 0.6)
    if not (falls and every_second):
        passive = 0.0
    loses_gain = every_second and not falls
    stribeck = rng.choice([0.0, 0.5])
    held = kp * 0.1  # N·m: heats the winding by about 10 K
    unit = replace(
        neutral(n),
        kp_scale=kp / robot.servo.kp,
        kd_scale=(1 - passive) * total / robot.servo.kd,
        damping=passive * total,
        friction=friction,
        stribeck=np.full(n, stribeck),
        stribeck_speed=np.full(n, 0.1),
        thinning=thinning,
        motor_constant=held / np.sqrt(10.0),
        winding_time=np.full(n, 30.0),
        kt_drift=np.full(n, KT_PER_KELVIN if loses_gain else 0.0),
        derating=np.full(n, DERATING_PER_KELVIN if loses_gain else 0.0),
        delay=np.array([rng.uniform(0, 0.02)]),
        encoder_noise=np.full(n, 2e-4),
        encoder_step=np.full(n, COUNT_RAD),
        velocity_noise=np.full(n, 4e-3),
    )
    return robot, unit, thinning


def _write(
    seed: int,
    lengths: np.ndarray,
    masses: np.ndarray,
    armature: np.ndarray,
    kp: np.ndarray,
    damping: np.ndarray,
) -> RobotSpec:
    """Write the vendor's file, whose kp is 0.8 of the true one; (n,) each."""
    attributes = [f'armature="{value}" damping="0"' for value in armature]
    joints: list[dict[str, object]] = []
    for j in range(len(kp)):
        joints.append({"kp": 0.8 * kp[j], "kd": 0.4 * damping[j], "effort_limit": 3 * kp[j]})
    name = f"warm{seed}"
    return write_robot(
        Path(tempfile.mkdtemp()) / name,
        arm_xml(lengths, masses, attributes),
        name=name,
        dt=DT,
        timestep=DT / 4,
        joints=joints,
    )


def commands(n: int, seed: int, number: int) -> np.ndarray:
    """Draw sines, slow ways with rests, jumps or fast sines, (ROWS, n) rad."""
    rng = np.random.default_rng([seed, number, 22])
    time_s = DT * np.arange(ROWS)
    kind = number % 4
    hertz = rng.uniform(0.2, 0.8, n) * (4 if kind == 3 else 1)
    size = rng.uniform(0.3, 0.8, n)
    phases = rng.uniform(0, 6, n)
    waves = np.sin(2 * np.pi * hertz * time_s[:, None] + phases)
    sines = size * waves * np.minimum(1, time_s)[:, None]
    knots = rng.uniform(-0.7, 0.7, (8, n))
    jumps = 0.5 * np.repeat(knots, ROWS // 8, axis=0)
    return (sines, _ways_with_rests(knots, time_s), jumps, 0.3 * sines)[kind]


def _ways_with_rests(knots: np.ndarray, time_s: np.ndarray) -> np.ndarray:
    """Return straight ways of 0.3 s between knots (8, n) rad, and rests of 0.3 s, (T, n)."""
    corners = np.repeat(np.arange(8), 2) * 0.6 + [0, 0.3] * 8
    joints = [np.interp(time_s, corners, np.repeat(column, 2)) for column in knots.T]
    return np.stack(joints, axis=1)


def record(robot: RobotSpec, unit: Physics, seed: int) -> list[Sequence]:
    """Play all motions from random temperatures and log them."""
    n = len(robot.joint_names)
    ctrl = np.stack([commands(n, seed, k) for k in range(MOTIONS)])
    virtual = VirtualRobot(robot, [unit] * MOTIONS, [(0.0, "both")] * MOTIONS, dt=DT)
    warmth = np.random.default_rng([seed, 23]).uniform(0, 30, MOTIONS)
    virtual.reset(ctrl[:, 0], list(range(MOTIONS)), warmth)
    answers = play_virtual(virtual, ctrl)
    logs = []
    for k in range(MOTIONS):
        log = Sequence(
            SequenceMeta(robot.name, "a", f"m{k:02}", 0.0, virtual=True),
            robot.joint_names,
            DT,
            ctrl[k],
            answers.qpos[k],
            answers.qvel[k],
            temperature=np.round(answers.temperature[k]),
        )
        logs.append(log)
    return logs


def result(seed: int) -> Row:
    """Identify a robot with and without the term; return estimates and errors of test motions."""
    robot, unit, thinning = draw(seed)
    logs = record(robot, unit, seed)
    train = logs[:FITTED]
    validation = logs[FITTED:VALIDATED]
    test = logs[VALIDATED:]
    options = IdentifyOptions(table=False, folds=1, nthread=1)
    began = time.process_time()
    fit = identify(train, robot, validation, options=options)
    seconds = time.process_time() - began
    tried = [c for c in fit.comparisons if c.name == "temperature"]
    accepted = bool(tried) and tried[0].accepted
    without = fit
    if accepted:  # else the term changes nothing
        options = replace(options, terms=OTHER_TERMS)
        without = identify(train, robot, validation, options=options)
    servo = fit.robot.servo
    return {
        "seed": seed,
        "true_per_kelvin": (-thinning).tolist(),
        "per_kelvin": servo.friction_per_kelvin.tolist(),
        "damping_per_kelvin": servo.damping_per_kelvin.tolist(),
        "true_damping_per_kelvin": (-thinning * unit.damping).tolist(),
        "std": [fit.std[j].get("friction_per_kelvin", 0.0) for j in robot.operated],
        "tried": bool(tried),
        "accepted": accepted,
        "gain_rad": tried[0].gain if tried else None,
        "seconds": seconds,
        "temperatures": [s.temperatures for s in logs],
        "findings": fit.findings,
        "chosen": fit.chosen,
        "friction": servo.frictionloss.tolist(),
        "true_friction": unit.friction.tolist(),
        "test_rad": motion_errors(test, fit.robot).tolist(),
        "test_without_rad": motion_errors(test, without.robot).tolist(),
    }


def table(rows: list[Row]) -> None:
    """Print verdicts, coverage and errors of each kind of robots."""
    lines = []
    for i, kind in enumerate(KINDS):
        some = [r for r in rows if r["seed"] % 4 == i]
        accepted = [r for r in some if r["accepted"]]
        intervals: list[tuple[float, float, float]] = []
        for r in accepted:
            intervals += zip(r["per_kelvin"], r["true_per_kelvin"], r["std"], strict=True)
        before = 1e3 * np.array([np.mean(r["test_without_rad"]) for r in some])
        after = 1e3 * np.array([np.mean(r["test_rad"]) for r in some])
        cells = (
            kind,
            len(some),
            len(accepted),
            plus_minus(before),
            plus_minus(after),
            plus_minus(after - before),
            share_inside(intervals),
        )
        lines.append(cells)
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
    parser = command_line(__doc__)
    parser.add_argument("out", type=Path)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--robots", type=int, default=40)
    args = parser.parse_args()
    table(measure_seeds(args.out, range(args.first, args.first + args.robots), result))


if __name__ == "__main__":
    main()
