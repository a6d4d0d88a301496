"""Torque-speed line on VIRTUAL robots: verdicts, intervals of the no-load speed, errors: docs/results/know.md.

    python benchmarks/torque_speed.py WORK [--first 0] [--robots 40] [--timestep 0.005]     # resumes

Arms with one or two joints, drawn by seed. Every second robot has a line; two of four come from the package's virtual
robots, two from MuJoCo's <dcmotor> behind a current controller. The file's kp differs from the true one, and in about
every second file the torque limit or kd does. Half of the robots without a line have backlash and a lagging current
loop instead. Half of the package's lines begin at a corner, not at rest. Eight motions of 5 s are fitted or validate,
six others are the test set.
"""

from __future__ import annotations

import argparse
import time
from dataclasses import dataclass, replace
from pathlib import Path

import mujoco
import numpy as np
from by_seed import Row, measure_seeds, plus_minus, print_table

from gaponet.data.sequence import Sequence, SequenceMeta
from gaponet.robot.spec import RobotSpec, load_robot
from gaponet.sim.replay import motion_errors
from gaponet.sysid.identify import identify
from gaponet.sysid.motion_limits import default_terms
from gaponet.sysid.options import IdentifyOptions
from gaponet.virtual.physics import neutral
from gaponet.virtual.virtual_robot import VirtualRobot

DT, ROWS, FITTED, TEST, VALIDATION = 0.01, 500, 8, 6, 3
NORMAL_90 = 1.645
VOLTS = 24.0
XML = """<mujoco><compiler angle="radian" autolimits="true"/><option integrator="implicitfast"/>
<default><joint axis="0 1 0" range="-2.5 2.5"/><geom type="capsule" size="0.02" contype="0" conaffinity="0"/></default>
<worldbody>{}</worldbody></mujoco>"""


@dataclass(frozen=True)
class Arm:
    """True values of an arm, (n,) each: N·m/rad, N·m·s/rad, N·m, kg·m², rad/s, s; no_load is inf without a line."""

    kp: np.ndarray
    kd: np.ndarray
    damping: np.ndarray
    friction: np.ndarray
    stribeck: np.ndarray
    armature: np.ndarray
    limit: np.ndarray
    no_load: np.ndarray
    corner: float
    delay: float
    noise: float
    backlash: float
    current_time: float
    lengths: np.ndarray
    masses: np.ndarray
    pace: float
    speed: np.ndarray  # that a joint reaches in a step of 0.8 rad at its torque limit
    stated_limit: float
    stated_kp: np.ndarray
    stated_kd: np.ndarray

    def xml(self) -> str:
        """Return the arm as MJCF without actuators."""
        inside = ""
        for j in reversed(range(len(self.kp))):
            length = self.lengths[j]
            inside = (
                f'<body name="b{j}" pos="{self.lengths[j - 1] if j else 0} 0 0"><joint name="j{j}" '
                f'armature="{self.armature[j]}" frictionloss="{self.friction[j]}" damping="{self.damping[j]}"/>'
                f'<geom fromto="0 0 0 {length} 0 0" mass="{self.masses[j]}"/>{inside}</body>'
            )
        return XML.format(inside)


def draw(seed: int) -> tuple[Arm, str, bool]:
    """Draw an arm, its simulator, and whether it has a line."""
    rng = np.random.default_rng([seed, 11])
    line, simulator, n = seed % 2 == 0, ("package", "dcmotor")[seed // 2 % 2], 1 + seed // 4 % 2
    lengths, masses = rng.uniform(0.1, 0.3, n), rng.uniform(0.1, 0.6, n)
    load = np.array([sum(masses[j:]) * sum(lengths[j:]) ** 2 / 2 for j in range(n)])
    weight = np.array([9.81 * sum(masses[j:]) * sum(lengths[j:]) / 2 for j in range(n)])
    armature = load * rng.uniform(0.3, 1.5, n)
    inertia, pace = load + armature, rng.uniform(2.0, 4.0)
    kp = np.maximum(inertia * (2 * np.pi * pace) ** 2, weight / 0.1)
    total = 2 * rng.uniform(0.5, 1.0, n) * np.sqrt(kp * inertia)
    share = rng.uniform(0.4, 1.0) if seed % 3 else 0.0  # every third drive has no velocity feedback
    limit = 1.3 * weight + inertia * rng.uniform(60, 150, n)
    speed = np.sqrt(0.4 * (limit - weight / 2) / inertia)
    other = bool(rng.random() < 0.5)  # effects of another form
    arm = Arm(
        kp, share * total, (1 - share) * total, kp * rng.uniform(1e-3, 1e-2), rng.uniform(0, 1, n), armature, limit,
        speed * rng.uniform(0.8, 2.0, n) if line else np.full(n, np.inf),
        rng.uniform(0.0, 0.3) * (line and other and simulator == "package"),
        rng.uniform(0, 0.02), 2e-4, rng.uniform(3e-3, 8e-3) * (other and not line),
        rng.uniform(2e-3, 8e-3) * (other and not line), lengths, masses, pace, speed,
        float(rng.uniform(0.8, 1.3)) if rng.random() < 0.5 else 1.0, rng.uniform(0.7, 1.4, n),
        rng.uniform(0.8, 1.2, n) if rng.random() < 0.5 else np.ones(n),
    )  # fmt: skip
    return arm, simulator, line


def commands(arm: Arm, seed: int, number: int) -> np.ndarray:
    """Draw jumps, sines and ramps, (ROWS, n) rad."""
    rng, t, n = (
        np.random.default_rng([seed, number, 12]),
        DT * np.arange(ROWS)[:, None],
        len(arm.kp),
    )
    jumps = np.repeat(rng.uniform(-0.8, 0.8, (10, n)), ROWS // 10, axis=0)
    pace = arm.pace * rng.uniform(0.1, 0.5, n)
    sines = (
        rng.uniform(0.2, 0.7, n)
        * np.sin(2 * np.pi * pace * t + rng.uniform(0, 6, n))
        * np.minimum(1, t)
    )
    return (jumps, sines, 0.6 * jumps + 0.5 * sines, sines * rng.uniform(0.1, 0.5))[number % 4]


def play_package(arm: Arm, robot: RobotSpec, ctrl: np.ndarray, seed: int) -> np.ndarray:
    """Play commands (motions, ROWS, n) on a virtual robot of the package; return positions and speeds, (2, …)."""
    n = len(arm.kp)
    unit = replace(
        neutral(n), kp_scale=arm.kp / robot.servo.kp, kd_scale=1 / arm.stated_kd, stribeck=arm.stribeck,
        stribeck_speed=np.full(n, 0.1), no_load_speed=arm.no_load, corner=np.full(n, arm.corner),
        delay=np.array([arm.delay]), encoder_noise=np.full(n, arm.noise), velocity_noise=np.full(n, 20 * arm.noise),
        backlash=np.full(n, arm.backlash), current_time=np.full(n, arm.current_time),
    )  # fmt: skip
    true = robot.with_servo(effort_limit=arm.limit)
    virtual = VirtualRobot(true, [unit] * len(ctrl), [(0.0, "both")] * len(ctrl), dt=DT)
    virtual.reset(ctrl[:, 0], list(range(seed, seed + len(ctrl))))
    out = np.empty((2, *ctrl.shape))
    for t in range(ROWS):
        reading = virtual.read()
        out[:, :, t] = reading.qpos, reading.qvel
        virtual.step(ctrl[:, t])
    return out


def play_dcmotor(arm: Arm, robot: RobotSpec, ctrl: np.ndarray, seed: int) -> np.ndarray:
    """Play commands on MuJoCo's <dcmotor>, whose voltage a current controller sets; return as `play_package`."""
    n, h = len(arm.kp), 1e-3
    spec = mujoco.MjSpec.from_string(arm.xml())
    spec.option.timestep = h
    for joint in spec.joints:
        joint.solref_friction, joint.solimp_friction = (
            [2.5 * h, 1.0],
            [0.9999, 0.9999, 0.001, 0.5, 2.0],
        )
    no_load = np.where(np.isfinite(arm.no_load), arm.no_load, 100 * arm.speed)
    constant = VOLTS / no_load
    resistance = constant * VOLTS / arm.limit
    for j in range(n):
        motor = spec.add_actuator(name=f"j{j}", target=f"j{j}", trntype=mujoco.mjtTrn.mjTRN_JOINT)
        motor.set_to_dcmotor(
            motorconst=[constant[j], 0.0],
            resistance=resistance[j],
            ctrlspec=int(mujoco.mjtCtrlInput.mjINPUT_VOLTAGE),
        )
        motor.forcelimited, motor.forcerange = True, [-arm.limit[j], arm.limit[j]]
    model = spec.compile()
    rng, out, each = np.random.default_rng([seed, 13]), np.empty((2, *ctrl.shape)), round(DT / h)
    late = round(arm.delay / h)
    for m, targets in enumerate(ctrl):
        data = mujoco.MjData(model)
        data.qpos[:] = targets[0] - 0.5 * arm.friction / arm.kp
        torque = np.zeros(n)
        for k in range(ROWS * each):
            if k % each == 0:
                out[:, m, k // each] = data.qpos, data.qvel
            error = targets[max(k - late, 0) // each] - data.qpos
            error = np.sign(error) * np.maximum(np.abs(error) - arm.backlash / 2, 0.0)
            asked = arm.kp * error - arm.kd * data.qvel
            torque = torque + (asked - torque) * min(1.0, h / max(arm.current_time, h))
            data.ctrl[:] = np.clip(
                torque * resistance / constant + constant * data.qvel, -VOLTS, VOLTS
            )
            model.dof_frictionloss[:] = arm.friction * (
                1 + arm.stribeck * np.exp(-np.abs(data.qvel) / 0.1)
            )
            mujoco.mj_step(model, data)
    return (
        out
        + rng.standard_normal(out.shape)
        * np.array([arm.noise, 20 * arm.noise])[:, None, None, None]
    )


def measure(seed: int, work: Path, timestep: float) -> dict[str, object]:
    """Identify one robot with and without the term, and compare both on the test motions."""
    arm, simulator, line = draw(seed)
    n, folder = len(arm.kp), work / f"{seed:04}"
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "robot.xml").write_text(arm.xml())
    joints = "".join(
        f'[[joint]]\nname = "j{j}"\nkp = {arm.kp[j] * arm.stated_kp[j]:.6g}\nkd = {arm.kd[j] * arm.stated_kd[j]:.6g}\n'
        f"effort_limit = {arm.limit[j] * arm.stated_limit:.6g}\n" for j in range(n)
    )  # fmt: skip
    (folder / "robot.toml").write_text(
        f'name = "arm{seed}"\ndt = {DT}\ntimestep = {timestep}\n{joints}'
    )
    robot = load_robot(folder)
    ctrl = np.stack([commands(arm, seed, i) for i in range(FITTED + TEST)])
    play = play_package if simulator == "package" else play_dcmotor
    qpos, qvel = play(arm, robot, ctrl, seed)
    motions = [
        Sequence(
            SequenceMeta(robot.name, "a", f"m{i}", 0.0, virtual=True), robot.joint_names, DT, *x
        )
        for i, x in enumerate(zip(ctrl, qpos, qvel, strict=True))
    ]
    train, validation, test = motions[VALIDATION:FITTED], motions[:VALIDATION], motions[FITTED:]
    terms, began = default_terms(train, robot), time.perf_counter()
    base = tuple(t for t in terms if t not in ("speed", "load"))
    row: dict[str, object] = {
        "seed": seed, "simulator": simulator, "line": line, "joints": n, "tried": "speed" in terms, "terms": terms,
        "corner": arm.corner, "other": arm.backlash > 0, "kd": bool(arm.kd.any()),
        "kd_right": bool((arm.kd * (arm.stated_kd - 1) == 0).all()), "stated": arm.stated_limit,
    }  # fmt: skip
    if not row["tried"]:  # the term costs nothing and changes nothing
        return row | {
            "without": [0.0],
            "with": [0.0],
            "estimate": [0.0] * n,
            "no_load": [0.0] * n,
            "std": [0.0] * n,
        }
    options = IdentifyOptions(windows=8, table=False, nthread=1)
    limits = tuple(t for t in base if t == "limit")
    rich = plain = identify(
        train,
        robot,
        validation,
        replace(options, terms=(*limits, "speed", *base[len(limits) :])),
    )
    row["seconds"] = time.perf_counter() - began
    if rich.robot.servo.no_load_speed.any():  # else nothing of the term is left in the robot
        plain = identify(train, robot, validation, replace(options, terms=base))
    errors = [1e3 * np.array(motion_errors(test, one.robot)) for one in (plain, rich)]
    row |= {
        "accepted": [c.name for c in rich.comparisons if c.accepted], "without": errors[0].tolist(),
        "with": errors[1].tolist(), "no_load": [float(v) if np.isfinite(v) else 0.0 for v in arm.no_load],
        "estimate": rich.robot.servo.no_load_speed.tolist(),
        "limit": (rich.robot.servo.effort_limit / arm.limit).tolist(),
        "plain_limit": (plain.robot.servo.effort_limit / arm.limit).tolist(),
    }  # fmt: skip
    return row | {"std": [rich.std[joint].get("no_load_speed", 0.0) for joint in robot.operated]}


def table(rows: list[Row]) -> None:
    """Print verdicts, coverage and errors of each kind of robots."""
    lines = []
    for line, simulator in (
        (True, "package"),
        (True, "dcmotor"),
        (False, "package"),
        (False, "dcmotor"),
    ):
        some = [r for r in rows if (r["line"], r["simulator"]) == (line, simulator)]
        tried = [r for r in some if r["tried"]]
        without, rich = (np.array([np.mean(r[k]) for r in tried]) for k in ("without", "with"))
        inside = [
            abs(v - e) < NORMAL_90 * s
            for r in some if line and not r["corner"] and r["kd_right"]
            for v, e, s in zip(r["no_load"], r["estimate"], r["std"], strict=True) if e
        ]  # fmt: skip
        kind = f"{'line' if line else 'no line'}, {simulator}"
        lines.append((kind, len(some), len(tried), sum(any(r["estimate"]) for r in some), plus_minus(without),
                      plus_minus(rich), plus_minus(without - rich), f"{sum(inside)} of {len(inside)}"))  # fmt: skip
    columns = (
        "VIRTUAL robots",
        "robots",
        "tried",
        "accepted",
        "without, mrad",
        "with, mrad",
        "better by, mrad",
    )
    print_table((*columns, "no-load speed inside 90 %"), lines)


def main() -> None:
    """Measure robots that are not in the file yet, then print the table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("work", type=Path)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--robots", type=int, default=40)
    parser.add_argument(
        "--timestep", type=float, default=0.005, help="physics step of the fitted robot, s"
    )
    args = parser.parse_args()
    file, seeds = args.work / "torque_speed.jsonl", range(args.first, args.first + args.robots)
    table(measure_seeds(file, seeds, lambda seed: measure(seed, args.work, args.timestep)))


if __name__ == "__main__":
    main()
