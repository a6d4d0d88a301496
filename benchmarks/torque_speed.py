"""Torque-speed line on VIRTUAL robots: verdicts, intervals of the no-load speed, errors.

    python benchmarks/torque_speed.py WORK [--first 0] [--robots 40] [--timestep 0.005]  # resumes

Arms with one or two joints, drawn by seed. Every second robot has a line; two of four come from
the package's virtual robots, two from MuJoCo's <dcmotor> behind a current controller. The file's
kp differs from the true one, and in about every second file the torque limit or kd does. Half of
the robots without a line have backlash and a lagging current loop instead. Half of the package's
lines begin at a corner, not at rest. Eight motions of 5 s are fitted or validate, six others are
the test set. The results are in docs/results/know.md.
"""

from __future__ import annotations

import time
from dataclasses import dataclass, replace
from pathlib import Path

import mujoco
import numpy as np
from common import (
    Row,
    command_line,
    measure_seeds,
    plus_minus,
    print_table,
    share_inside,
)
from virtual_arms import arm_xml, play_virtual, write_robot

from gaponet.data.sequence import Sequence, SequenceMeta
from gaponet.robot.servo_fields import Term
from gaponet.robot.spec import RobotSpec
from gaponet.sim.replay import motion_errors
from gaponet.sysid.identify import identify
from gaponet.sysid.motion_limits import default_terms
from gaponet.sysid.options import IdentifyOptions
from gaponet.virtual.physics import neutral
from gaponet.virtual.virtual_robot import VirtualRobot

DT = 0.01  # s
ROWS = 500  # of a motion
FITTED = 8  # motions, the first of which validate
VALIDATION = 3
TEST = 6
VOLTS = 24.0
STRIBECK_SPEED = 0.1  # rad/s
MOTOR_TIMESTEP = 1e-3  # s, of <dcmotor>


@dataclass(frozen=True)
class Arm:
    """True values of an arm, (n,) each, and factors of its file on them.

    Attributes:
        kp, kd, damping: N·m/rad, N·m·s/rad.
        friction, stribeck: N·m; more friction at rest, over friction.
        armature, limit: kg·m², N·m.
        no_load: rad/s; inf without a line.
        corner: Share of the no-load speed up to which the whole torque is there.
        delay, current_time: s.
        noise, backlash: rad.
        lengths, masses: m, kg.
        pace: Hz, of the servos.
        speed: rad/s that a joint reaches in a step of 0.8 rad at its torque limit.
        stated_limit, stated_kp, stated_kd: Factors of the file.
    """

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
    speed: np.ndarray
    stated_limit: float
    stated_kp: np.ndarray
    stated_kd: np.ndarray

    def xml(self) -> str:
        """Return the arm as MJCF without actuators."""
        attributes = []
        for armature, friction, damping in zip(
            self.armature, self.friction, self.damping, strict=True
        ):
            attributes.append(
                f'armature="{armature}" frictionloss="{friction}" damping="{damping}"'
            )
        return arm_xml(self.lengths, self.masses, attributes)

    def write(self, folder: Path, name: str, timestep: float) -> RobotSpec:
        """Write the vendor's file, with its errors, for a physics step in s."""
        joints: list[dict[str, object]] = []
        for j in range(len(self.kp)):
            joints.append(
                {
                    "kp": f"{self.kp[j] * self.stated_kp[j]:.6g}",
                    "kd": f"{self.kd[j] * self.stated_kd[j]:.6g}",
                    "effort_limit": f"{self.limit[j] * self.stated_limit:.6g}",
                }
            )
        return write_robot(folder, self.xml(), name=name, dt=DT, timestep=timestep, joints=joints)


def draw(seed: int) -> tuple[Arm, str, bool]:
    """Draw an arm, its simulator, and whether it has a line."""
    rng = np.random.default_rng([seed, 11])
    line = seed % 2 == 0
    simulator = ("package", "dcmotor")[seed // 2 % 2]
    n = 1 + seed // 4 % 2
    lengths = rng.uniform(0.1, 0.3, n)
    masses = rng.uniform(0.1, 0.6, n)
    load = np.zeros(n)
    weight = np.zeros(n)
    for j in range(n):
        load[j] = sum(masses[j:]) * sum(lengths[j:]) ** 2 / 2
        weight[j] = 9.81 * sum(masses[j:]) * sum(lengths[j:]) / 2
    armature = load * rng.uniform(0.3, 1.5, n)
    inertia = load + armature
    pace = rng.uniform(2.0, 4.0)
    kp = np.maximum(inertia * (2 * np.pi * pace) ** 2, weight / 0.1)
    total = 2 * rng.uniform(0.5, 1.0, n) * np.sqrt(kp * inertia)
    share = rng.uniform(0.4, 1.0) if seed % 3 else 0.0  # every third drive has no velocity feedback
    limit = 1.3 * weight + inertia * rng.uniform(60, 150, n)
    speed = np.sqrt(0.4 * (limit - weight / 2) / inertia)
    has_other = bool(rng.random() < 0.5)  # effects of another form: a corner, or backlash and lag
    friction = kp * rng.uniform(1e-3, 1e-2)
    stribeck = rng.uniform(0, 1, n)
    no_load = speed * rng.uniform(0.8, 2.0, n) if line else np.full(n, np.inf)
    corner = rng.uniform(0.0, 0.3)
    delay = rng.uniform(0, 0.02)
    backlash = rng.uniform(3e-3, 8e-3)
    current_time = rng.uniform(2e-3, 8e-3)
    lags = has_other and not line
    has_corner = line and has_other and simulator == "package"
    stated_limit = float(rng.uniform(0.8, 1.3)) if rng.random() < 0.5 else 1.0
    stated_kp = rng.uniform(0.7, 1.4, n)
    stated_kd = rng.uniform(0.8, 1.2, n) if rng.random() < 0.5 else np.ones(n)
    arm = Arm(
        kp=kp,
        kd=share * total,
        damping=(1 - share) * total,
        friction=friction,
        stribeck=stribeck,
        armature=armature,
        limit=limit,
        no_load=no_load,
        corner=corner if has_corner else 0.0,
        delay=delay,
        noise=2e-4,
        backlash=backlash if lags else 0.0,
        current_time=current_time if lags else 0.0,
        lengths=lengths,
        masses=masses,
        pace=pace,
        speed=speed,
        stated_limit=stated_limit,
        stated_kp=stated_kp,
        stated_kd=stated_kd,
    )
    return arm, simulator, line


def commands(arm: Arm, seed: int, number: int) -> np.ndarray:
    """Draw jumps, sines and ramps, (ROWS, n) rad."""
    rng = np.random.default_rng([seed, number, 12])
    n = len(arm.kp)
    time = DT * np.arange(ROWS)[:, None]
    jumps = np.repeat(rng.uniform(-0.8, 0.8, (10, n)), ROWS // 10, axis=0)
    hertz = arm.pace * rng.uniform(0.1, 0.5, n)
    size = rng.uniform(0.2, 0.7, n)
    waves = np.sin(2 * np.pi * hertz * time + rng.uniform(0, 6, n))
    sines = size * waves * np.minimum(1, time)
    weak = rng.uniform(0.1, 0.5)
    return (jumps, sines, 0.6 * jumps + 0.5 * sines, sines * weak)[number % 4]


def play_package(arm: Arm, robot: RobotSpec, ctrl: np.ndarray, seed: int) -> np.ndarray:
    """Play commands (motions, ROWS, n) on a virtual robot; return positions and speeds, (2, …)."""
    n = len(arm.kp)
    unit = replace(
        neutral(n),
        kp_scale=arm.kp / robot.servo.kp,
        kd_scale=1 / arm.stated_kd,
        stribeck=arm.stribeck,
        stribeck_speed=np.full(n, STRIBECK_SPEED),
        no_load_speed=arm.no_load,
        corner=np.full(n, arm.corner),
        delay=np.array([arm.delay]),
        encoder_noise=np.full(n, arm.noise),
        velocity_noise=np.full(n, 20 * arm.noise),
        backlash=np.full(n, arm.backlash),
        current_time=np.full(n, arm.current_time),
    )
    true = robot.with_servo(effort_limit=arm.limit)
    virtual = VirtualRobot(true, [unit] * len(ctrl), [(0.0, "both")] * len(ctrl), dt=DT)
    virtual.reset(ctrl[:, 0], list(range(seed, seed + len(ctrl))))
    answers = play_virtual(virtual, ctrl)
    return np.stack([answers.qpos, answers.qvel])


def play_dcmotor(arm: Arm, robot: RobotSpec, ctrl: np.ndarray, seed: int) -> np.ndarray:
    """Play commands on <dcmotor>, whose voltage a current controller sets; see `play_package`."""
    no_load = np.where(np.isfinite(arm.no_load), arm.no_load, 100 * arm.speed)
    constant = VOLTS / no_load
    resistance = constant * VOLTS / arm.limit
    model = _dcmotor_model(arm, constant, resistance)
    rng = np.random.default_rng([seed, 13])
    out = np.empty((2, *ctrl.shape))
    steps = round(DT / MOTOR_TIMESTEP)
    late = round(arm.delay / MOTOR_TIMESTEP)
    lag = min(1.0, MOTOR_TIMESTEP / max(arm.current_time, MOTOR_TIMESTEP))
    for m, targets in enumerate(ctrl):
        data = mujoco.MjData(model)
        data.qpos[:] = targets[0] - 0.5 * arm.friction / arm.kp
        torque = np.zeros(len(arm.kp))
        for k in range(ROWS * steps):
            if k % steps == 0:
                out[0, m, k // steps] = data.qpos
                out[1, m, k // steps] = data.qvel
            error = targets[max(k - late, 0) // steps] - data.qpos
            error = np.sign(error) * np.maximum(np.abs(error) - arm.backlash / 2, 0.0)
            asked = arm.kp * error - arm.kd * data.qvel
            torque = torque + (asked - torque) * lag
            voltage = torque * resistance / constant + constant * data.qvel
            data.ctrl[:] = np.clip(voltage, -VOLTS, VOLTS)
            at_rest = np.exp(-np.abs(data.qvel) / STRIBECK_SPEED)
            model.dof_frictionloss[:] = arm.friction * (1 + arm.stribeck * at_rest)
            mujoco.mj_step(model, data)
    noise = np.array([arm.noise, 20 * arm.noise])[:, None, None, None]
    return out + rng.standard_normal(out.shape) * noise


def _dcmotor_model(arm: Arm, constant: np.ndarray, resistance: np.ndarray) -> mujoco.MjModel:
    """Return the arm with motors; motor constant in N·m/A and resistance in Ω, (n,) each."""
    spec = mujoco.MjSpec.from_string(arm.xml())
    spec.option.timestep = MOTOR_TIMESTEP
    for joint in spec.joints:
        joint.solref_friction = [2.5 * MOTOR_TIMESTEP, 1.0]
        joint.solimp_friction = [0.9999, 0.9999, 0.001, 0.5, 2.0]
    for j in range(len(arm.kp)):
        motor = spec.add_actuator(name=f"j{j}", target=f"j{j}", trntype=mujoco.mjtTrn.mjTRN_JOINT)
        motor.set_to_dcmotor(
            motorconst=[constant[j], 0.0],
            resistance=resistance[j],
            ctrlspec=int(mujoco.mjtCtrlInput.mjINPUT_VOLTAGE),
        )
        motor.forcelimited = True
        motor.forcerange = [-arm.limit[j], arm.limit[j]]
    return spec.compile()


def record(arm: Arm, simulator: str, robot: RobotSpec, seed: int) -> list[Sequence]:
    """Play and log the motions of a robot."""
    ctrl = np.stack([commands(arm, seed, i) for i in range(FITTED + TEST)])
    play = play_package if simulator == "package" else play_dcmotor
    qpos, qvel = play(arm, robot, ctrl, seed)
    logs = []
    for i in range(len(ctrl)):
        meta = SequenceMeta(robot.name, "a", f"m{i}", 0.0, virtual=True)
        logs.append(Sequence(meta, robot.joint_names, DT, ctrl[i], qpos[i], qvel[i]))
    return logs


def measure(seed: int, work: Path, timestep: float) -> Row:
    """Identify one robot with and without the term, and compare both on the test motions."""
    arm, simulator, line = draw(seed)
    robot = arm.write(work / f"{seed:04}", f"arm{seed}", timestep)
    motions = record(arm, simulator, robot, seed)
    validation = motions[:VALIDATION]
    train = motions[VALIDATION:FITTED]
    test = motions[FITTED:]
    began = time.perf_counter()
    terms = default_terms(train, robot)
    n = len(arm.kp)
    row: Row = {
        "seed": seed,
        "simulator": simulator,
        "line": line,
        "joints": n,
        "tried": "speed" in terms,
        "terms": terms,
        "corner": arm.corner,
        "other": arm.backlash > 0,
        "kd": bool(arm.kd.any()),
        "kd_right": bool((arm.kd * (arm.stated_kd - 1) == 0).all()),
        "stated": arm.stated_limit,
    }
    if not row["tried"]:  # the term costs nothing and changes nothing
        none = dict.fromkeys(("estimate", "no_load", "std"), [0.0] * n)
        return row | {"without": [0.0], "with": [0.0]} | none
    without_speed = tuple(term for term in terms if term not in ("speed", "load"))
    options = IdentifyOptions(windows=8, table=False, nthread=1)
    rich_options = replace(options, terms=_with_speed(without_speed))
    rich = identify(train, robot, validation, rich_options)
    row["seconds"] = time.perf_counter() - began
    plain = rich
    if rich.robot.servo.no_load_speed.any():  # else nothing of the term is left in the robot
        plain = identify(train, robot, validation, replace(options, terms=without_speed))
    return row | {
        "accepted": [c.name for c in rich.comparisons if c.accepted],
        "without": (1e3 * motion_errors(test, plain.robot)).tolist(),
        "with": (1e3 * motion_errors(test, rich.robot)).tolist(),
        "no_load": np.where(np.isfinite(arm.no_load), arm.no_load, 0.0).tolist(),
        "estimate": rich.robot.servo.no_load_speed.tolist(),
        "limit": (rich.robot.servo.effort_limit / arm.limit).tolist(),
        "plain_limit": (plain.robot.servo.effort_limit / arm.limit).tolist(),
        "std": [rich.std[joint].get("no_load_speed", 0.0) for joint in robot.operated],
    }


def _with_speed(terms: tuple[Term, ...]) -> tuple[Term, ...]:
    """Put the term after the torque limit, which it needs, and before the others."""
    limits = tuple(term for term in terms if term == "limit")
    return (*limits, "speed", *terms[len(limits) :])


def table(rows: list[Row]) -> None:
    """Print verdicts, coverage and errors of each kind of robots."""
    lines = []
    for line in (True, False):
        for simulator in ("package", "dcmotor"):
            kind = f"{'line' if line else 'no line'}, {simulator}"
            some = [r for r in rows if r["line"] == line and r["simulator"] == simulator]
            lines.append((kind, *_cells(some)))
    columns = (
        "VIRTUAL robots",
        "robots",
        "tried",
        "accepted",
        "without, mrad",
        "with, mrad",
        "better by, mrad",
        "no-load speed inside 90 %",
    )
    print_table(columns, lines)


def _cells(rows: list[Row]) -> tuple[object, ...]:
    """Return the cells of one kind of robots."""
    tried = [r for r in rows if r["tried"]]
    without = np.array([np.mean(r["without"]) for r in tried])
    rich = np.array([np.mean(r["with"]) for r in tried])
    accepted = sum(any(r["estimate"]) for r in rows)
    intervals = []
    for r in rows:
        # With a corner or a wrong kd the estimate has another meaning.
        if r["line"] and not r["corner"] and r["kd_right"]:
            for interval in zip(r["estimate"], r["no_load"], r["std"], strict=True):
                if interval[0]:
                    intervals.append(interval)
    return (
        len(rows),
        len(tried),
        accepted,
        plus_minus(without),
        plus_minus(rich),
        plus_minus(without - rich),
        share_inside(intervals),
    )


def main() -> None:
    """Measure robots that are not in the file yet, then print the table."""
    parser = command_line(__doc__)
    parser.add_argument("work", type=Path)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--robots", type=int, default=40)
    parser.add_argument(
        "--timestep", type=float, default=0.005, help="physics step of the fitted robot, s"
    )
    args = parser.parse_args()
    file = args.work / "torque_speed.jsonl"
    seeds = range(args.first, args.first + args.robots)
    table(measure_seeds(file, seeds, lambda seed: measure(seed, args.work, args.timestep)))


if __name__ == "__main__":
    main()
