"""Link masses on VIRTUAL arms whose file is right or wrong: identify --masses and two baselines.

    python benchmarks/link_masses.py OUT.jsonl --robots 20 --first 100     # resumes

Arms have two joints. In a wrong file one link has 1 / 1.3 to 1 / 2 of the true mass, or its centre
of mass 2 to 5 cm away. Half of the arms are recorded with two payloads, half with none. Seven
motions of 8 s are fitted and validated; three new motions, and three with a payload that no fit
has seen, test. The baselines are plain_fit.py with mass and centre of mass of each link as four
more parameters, and mujoco.sysid with its pseudo-inertia of each link as ten more (where
"mujoco[sysid]" is installed). With --torque, recordings hold the motors' torque, which only
identify reads. Its scale is wrong by 5 % in each joint (standard deviation), as torque constants
are.
"""

from __future__ import annotations

import contextlib
import importlib.util
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TypeVar

import mujoco
import numpy as np
from common import NORMAL_90, Row, command_line, measure_seeds, plus_minus, print_table
from plain_fit import Problem, fit
from virtual_arms import play_virtual, write_robot

from gaponet.data.sequence import Sequence, SequenceMeta
from gaponet.robot.spec import Link, RobotSpec
from gaponet.sim.model import build_model, stiffen_friction
from gaponet.sim.replay import motion_errors
from gaponet.sysid.acceptance import Identified
from gaponet.sysid.identify import identify
from gaponet.sysid.options import IdentifyOptions
from gaponet.virtual.physics import Physics, neutral
from gaponet.virtual.virtual_robot import VirtualRobot

JOINTS = 2
LINKS = tuple(f"link{i}" for i in range(JOINTS))
DT = 0.02  # s
MOTION_S = 8.0
TRAIN = 4  # motions
VALIDATION = 3
TEST = 3
TORQUE_ERROR = 0.05  # standard deviation of a torque constant
SHIFT_M = 0.05  # a large change of the baseline's centres of mass
LOG_MASS = np.log(1.5)  # and of its masses
SERVO_SIZE = 6 * JOINTS  # parameters of the servos, which come first
LINK_SIZE = 4  # parameters of each link: log mass and centre of mass
PSEUDO_INERTIA_SIZE = 10  # of each link in mujoco.sysid
KNOWN = 0.7  # of the prior's standard deviation; a value with less is determined
HAS_RIVAL = importlib.util.find_spec("colorama") is not None  # of mujoco[sysid]
T = TypeVar("T")


def draw_arm(rng: np.random.Generator, folder: Path) -> tuple[RobotSpec, np.ndarray]:
    """Write a robot folder; return the robot and the torques that hold it, (n,) N·m."""
    lengths = rng.uniform(0.12, 0.3, JOINTS)
    masses = np.sort(rng.uniform(0.15, 1.2, JOINTS))[::-1]
    upright = rng.random() < 0.3
    bodies = ""
    for i, (length, mass) in enumerate(zip(lengths, masses, strict=True)):
        at = f"{lengths[i - 1]:.3f} 0 0" if i else "0 0 0"
        axis = "0 0 1" if upright and i == 0 else "0 1 0"
        centre = length * rng.uniform(0.2, 0.9)
        height = rng.uniform(-0.02, 0.02)
        bodies += (
            f'<body name="link{i}" pos="{at}">'
            f'<joint name="j{i}" axis="{axis}" range="-2.5 2.5"/>'
            f'<geom type="capsule" fromto="0 0 0 {length:.3f} 0 0" size="0.02" '
            f'mass="{0.6 * mass:.3f}"/>'
            f'<geom type="box" pos="{centre:.3f} 0 {height:.3f}" size="0.03 0.02 0.02" '
            f'mass="{0.4 * mass:.3f}"/>'
        )
    xml = (
        '<mujoco><compiler angle="radian" autolimits="true"/>'
        '<option integrator="implicitfast"/><default><geom contype="0" conaffinity="0"/>'
        '<joint damping="0" armature="0.01" frictionloss="0"/></default>'
        f"<worldbody>{bodies}{'</body>' * JOINTS}</worldbody></mujoco>"
    )
    hold = _holding_torque(lengths, masses)
    kp = np.round(hold / rng.uniform(0.03, 0.1, JOINTS), 1)
    joints: list[dict[str, object]] = []
    for i in range(JOINTS):
        limit = f"{6 * hold[i]:.2f}"
        joints.append({"kp": kp[i], "kd": f"{0.03 * kp[i]:.3f}", "effort_limit": limit})
    mount = (
        f'[[payload_mount]]\nside = "hand"\nbody = "{LINKS[-1]}"\n'
        f"pos = [{lengths[-1]:.3f}, 0.0, 0.0]\n"
    )
    robot = write_robot(folder, xml, name="arm", dt=DT, timestep=0.005, joints=joints, more=mount)
    return robot, np.maximum(hold, 0.3 * hold.max())


def _holding_torque(lengths: np.ndarray, masses: np.ndarray) -> np.ndarray:
    """Return the torque that holds the links of a stretched arm, (n,) N·m; m and kg, (n,) each."""
    hold = np.zeros(len(lengths))
    for i in range(len(lengths)):
        levers = [masses[k] * (lengths[i:k].sum() + lengths[k] / 2) for k in range(i, len(lengths))]
        hold[i] = 9.81 * sum(levers)
    return hold


def draw_physics(
    rng: np.random.Generator, robot: RobotSpec, hold: np.ndarray, wrong: bool
) -> Physics:
    """Draw servos that differ from the file, and one link that does, if the file is to be wrong."""
    n = JOINTS
    physics = replace(
        neutral(n),
        kp_scale=np.exp(0.15 * rng.standard_normal(n)),
        kd_scale=np.exp(0.3 * rng.standard_normal(n)),
        friction=hold * rng.uniform(0.02, 0.1, n),
        damping=robot.servo.kp * rng.uniform(0, 0.03, n),
        delay=np.full(1, rng.uniform(0.01, 0.04)),
        zero_offset=0.005 * rng.standard_normal(n),
        encoder_step=np.full(n, 0.0015),
        velocity_noise=np.full(n, 0.02),
        encoder_noise=np.full(n, 2e-4),
    )
    if not wrong:
        return physics
    upright = bool(build_model(robot).jnt_axis[0][2])
    first = 1 if upright else 0  # gravity does not see an upright first link
    link = int(rng.integers(first, n))
    change = np.zeros(n)
    if rng.random() < 0.5:
        change[link] = rng.uniform(0.3, 1.0)
        return replace(physics, mass_scale=1 + change)
    change[link] = rng.uniform(0.02, 0.05) * rng.choice([-1, 1])
    if rng.random() < 0.7:
        return replace(physics, com_x=change)
    return replace(physics, com_z=change)


def record(
    rng: np.random.Generator,
    robot: RobotSpec,
    physics: Physics,
    name: str,
    payloads: list[float],
    torque_scale: np.ndarray | None,
) -> list[Sequence]:
    """Record one motion for each of the payloads, kg; with torque where its scale (n,) is given."""
    count = len(payloads)
    rows = round(MOTION_S / DT)
    ctrl = np.stack([_commands(rng, rows) for _ in payloads])
    units = VirtualRobot(robot, [physics] * count, [(mass, "both") for mass in payloads])
    units.reset(ctrl[:, 0], rng.integers(0, 1 << 30, count).tolist())
    answers = play_virtual(units, ctrl)
    logs = []
    for i, mass in enumerate(payloads):
        tau = None if torque_scale is None else torque_scale * answers.tau[i]
        meta = SequenceMeta("arm", "u", f"{name}{i}", payload_mass=mass, virtual=True)
        log = Sequence(
            meta, robot.joint_names, DT, ctrl[i], answers.qpos[i], answers.qvel[i], tau=tau
        )
        logs.append(log)
    return logs


def _commands(rng: np.random.Generator, rows: int) -> np.ndarray:
    """Draw three sines around a posture, (rows, n) rad."""
    time_s = DT * np.arange(rows)[:, None]
    posture = rng.uniform(-1, 1, JOINTS)
    sines = np.zeros((rows, JOINTS))
    for most_hertz in (0.2, 0.5, 0.9):
        hertz = rng.uniform(0.05, most_hertz, JOINTS)
        phases = rng.uniform(0, 6, JOINTS)
        size = rng.uniform(0.1, 0.5, JOINTS)
        sines += size * np.sin(2 * np.pi * hertz * time_s + phases)
    return np.clip(posture + sines, -2, 2)


# ---- baselines


class MassProblem(Problem):
    """Plain fit of servos with log mass and centre of mass of each link, (6 n + 4 L,)."""

    def __init__(self, sequences: list[Sequence], robot: RobotSpec) -> None:
        super().__init__(sequences, robot)
        size = LINK_SIZE * len(LINKS)
        self.start = np.r_[self.start, np.zeros(size)]
        self.low = np.r_[self.low, np.full(size, -3.0)]
        self.high = np.r_[self.high, np.full(size, 3.0)]

    def servos(self, x: np.ndarray, window: int) -> dict[str, np.ndarray]:
        """Return the servos' values in a window."""
        return super().servos(x[:SERVO_SIZE], window)

    def changed(self, x: np.ndarray, window: int, model: mujoco.MjModel) -> mujoco.MjModel:
        """Return a copy of a window's model with these parameters."""
        one = super().changed(x, window, model)
        for name, (log_mass, *shift) in zip(
            LINKS, x[SERVO_SIZE:].reshape(-1, LINK_SIZE), strict=True
        ):
            body = one.body(name)
            scale = np.exp(LOG_MASS * log_mass)
            body.mass[:] = scale * body.mass
            body.inertia[:] = scale * body.inertia
            body.ipos[:] += SHIFT_M * np.array(shift)
        mujoco.mj_setConst(one, mujoco.MjData(one))
        stiffen_friction(one)
        return one

    def robot_with(self, x: np.ndarray) -> RobotSpec:
        """Return the robot with fitted servos and links."""
        model = self.changed(x, 0, self.specs[0].compile())
        return replace(super().robot_with(x[:SERVO_SIZE]), links=links_of(model))


def links_of(model: mujoco.MjModel) -> dict[str, Link]:
    """Return masses, centres and inertias of a model's links."""
    links = {}
    for name in LINKS:
        body = model.body(name)
        turn = np.zeros(9)
        mujoco.mju_quat2Mat(turn, body.iquat)
        axes = turn.reshape(3, 3)
        full = axes @ np.diag(body.inertia) @ axes.T
        numbers = (*np.diag(full), *full[[0, 0, 1], [1, 2, 2]])
        inertia = tuple(map(float, numbers))
        links[name] = Link(float(body.mass[0]), tuple(body.ipos.tolist()), inertia)
    return links


def mujoco_sysid(sequences: list[Sequence], robot: RobotSpec) -> tuple[RobotSpec, np.ndarray]:
    """Fit with mujoco.sysid; return the robot, and 90 % intervals of its masses, (L, 2) kg."""
    import mujoco_sysid as rival
    from mujoco import sysid

    problem = Problem(sequences, robot)
    with contextlib.redirect_stdout(None):
        params, result = rival.fit(problem, LINKS)
    half_widths = sysid.calculate_intervals([result.fun], result.jac, alpha=0.1)[1]
    spec = problem.specs[0].copy()
    masses = []
    for i, name in enumerate(LINKS):
        params[name].apply_modifier(spec)
        log_mass = params[name].value[0]
        half = half_widths[SERVO_SIZE + PSEUDO_INERTIA_SIZE * i]
        masses.append(np.exp(2 * np.array([log_mass - half, log_mass + half])))
    servos = problem.robot_with(params.as_vector()[:SERVO_SIZE])
    return replace(servos, links=links_of(spec.compile())), np.array(masses)


# ---- one arm


@dataclass(frozen=True)
class Recordings:
    """Recordings of one arm: to fit, to validate, of new motions, and of a new payload."""

    train: list[Sequence]
    validation: list[Sequence]
    test: list[Sequence]
    new_payload: list[Sequence]


def play(seed: int, torque: bool) -> Row:
    """Identify one VIRTUAL arm in three ways; return errors, mrad, and what is known of links."""
    wrong = seed % 2 == 1
    loads = 1 + seed // 2 % 2
    row: Row = {
        "seed": seed,
        "wrong": wrong,
        "payloads": loads,
        "test": {},
        "new payload": {},
        "s": {},
    }
    with tempfile.TemporaryDirectory() as folder:
        robot, hold = draw_arm(np.random.default_rng([seed, 1]), Path(folder) / "arm")
        physics = draw_physics(np.random.default_rng([seed, 2]), robot, hold, wrong)
        recordings = _record_all(seed, robot, physics, hold, loads, torque)
        _identify_in_three_ways(row, recordings, robot, physics)
    return row


def _record_all(
    seed: int, robot: RobotSpec, physics: Physics, hold: np.ndarray, loads: int, torque: bool
) -> Recordings:
    """Record an arm with one or two payloads in turn."""
    rng = np.random.default_rng([seed, 3])
    heavy = round(0.1 * float(hold[-1]), 2)  # kg
    masses = [0.0, heavy][:loads]
    scale = None
    if torque:
        errors = np.random.default_rng([seed, 4]).standard_normal(JOINTS)
        scale = np.exp(TORQUE_ERROR * errors)

    def motions(name: str, count: int) -> list[Sequence]:
        payloads = [masses[i % loads] for i in range(count)]
        return record(rng, robot, physics, name, payloads, scale)

    return Recordings(
        train=motions("train", TRAIN),
        validation=motions("validation", VALIDATION),
        test=motions("test", TEST),
        new_payload=record(rng, robot, physics, "payload", [2 * heavy] * TEST, scale),
    )


def _identify_in_three_ways(
    row: Row, recordings: Recordings, robot: RobotSpec, physics: Physics
) -> None:
    """Put the errors of each fit into a row, and which masses its intervals hold."""

    def judge(name: str, fitted: RobotSpec, seconds: float) -> None:
        for key, motions in (("test", recordings.test), ("new payload", recordings.new_payload)):
            row[key][name] = 1e3 * float(motion_errors(motions, fitted).mean())
        row["s"][name] = seconds

    def identified(masses: bool) -> Identified:
        options = IdentifyOptions(table=False, masses=masses)
        return identify(recordings.train, robot, recordings.validation, options=options)

    fitted_logs = [*recordings.train, *recordings.validation]
    judge("file", robot, 0.0)
    plain, seconds = _timed(lambda: identified(masses=False))
    judge("identify", plain.robot, seconds)
    made, seconds = _timed(lambda: identified(masses=True))
    judge("identify --masses", made.robot, seconds)
    least_squares, seconds = _timed(lambda: fit(MassProblem(fitted_logs, robot), 1))
    judge("plain, masses", least_squares, seconds)
    nominal = build_model(robot)
    file_mass = np.array([nominal.body(name).mass[0] for name in LINKS])
    mass = file_mass * physics.mass_scale
    if HAS_RIVAL:
        (rival, intervals), seconds = _timed(lambda: mujoco_sysid(fitted_logs, robot))
        judge("mujoco.sysid", rival, seconds)
        inside = (intervals[:, 0] < mass) & (mass < intervals[:, 1])
        errors = [rival.links[name].mass / mass[i] - 1 for i, name in enumerate(LINKS)]
        row["mujoco.sysid masses inside"] = int(inside.sum())
        row["mujoco.sysid mass error"] = errors
    row["accepted"] = made.links is not None
    if made.links is not None:
        row |= _known_links(made, mass, physics)


def _timed(make: Callable[[], T]) -> tuple[T, float]:
    """Return what a function returns, and its seconds of processor."""
    began = time.process_time()
    made = make()
    return made, time.process_time() - began


def _known_links(made: Identified, mass: np.ndarray, physics: Physics) -> Row:
    """Compare masses and centres of mass with the truth; masses (L,) kg."""
    assert made.links is not None
    _, now, std, prior = (moment[:, :4] for moment in made.links.moments())  # (L, 4) each
    true = np.stack([mass, physics.com_x, physics.com_y, physics.com_z], axis=1)
    inside = np.abs(now - true) < NORMAL_90 * std
    known = std < KNOWN * prior
    return {
        "mass error": (now[:, 0] / mass - 1).tolist(),
        "masses inside": int(inside[:, 0].sum()),
        "inside": int(inside[known].sum()),
        "known": int(known.sum()),
    }


# ---- tables


def table(rows: list[Row]) -> None:
    """Print errors of both payloads, verdicts and intervals, by kind of file and payloads."""
    titles = []
    groups = []
    for wrong in (False, True):
        for payloads in (1, 2):
            titles.append(f"{'wrong' if wrong else 'right'} file, {payloads} payload(s)")
            groups.append([r for r in rows if r["wrong"] == wrong and r["payloads"] == payloads])
    for key in ("test", "new payload"):
        errors: list[tuple[object, ...]] = []
        for name in rows[0][key]:
            cells = [plus_minus(r[key][name] for r in some) for some in groups]
            errors.append((name, *cells))
        print_table((f"mrad, {key}", *titles), errors)
    lines = [
        ("arms", *map(len, groups)),
        ("--masses accepted", *map(len, map(_accepted, groups))),
        ("masses inside 90 %", *map(_masses_inside, groups)),
        ("mujoco.sysid masses inside 90 %", *map(_masses_inside_of_rival, groups)),
        ("all values inside 90 %", *map(_values_inside, groups)),
    ]
    print_table(("number", *titles), lines)
    seconds = []
    for name in rows[0]["s"]:
        seconds.append(f"{name} {np.mean([r['s'][name] for r in rows]):.1f}")
    print("processor, s:", ", ".join(seconds))


def _accepted(rows: list[Row]) -> list[Row]:
    return [row for row in rows if row["accepted"]]


def _masses_inside(rows: list[Row]) -> str:
    accepted = _accepted(rows)
    return f"{_sum(accepted, 'masses inside')} of {JOINTS * len(accepted)}"


def _masses_inside_of_rival(rows: list[Row]) -> str:
    return f"{_sum(rows, 'mujoco.sysid masses inside')} of {JOINTS * len(rows)}"


def _values_inside(rows: list[Row]) -> str:
    return f"{_sum(rows, 'inside')} of {_sum(rows, 'known')}"


def _sum(rows: list[Row], key: str) -> int:
    return sum(row.get(key, 0) for row in rows)


def main() -> None:
    """Play robots that are not in the file yet, then print the tables."""
    parser = command_line(__doc__)
    parser.add_argument("out", type=Path)
    parser.add_argument("--robots", type=int, default=20)
    parser.add_argument("--first", type=int, default=100)
    parser.add_argument("--torque", action="store_true", help="record torque too")
    args = parser.parse_args()
    seeds = range(args.first, args.first + args.robots)
    table(measure_seeds(args.out, seeds, lambda seed: play(seed, args.torque)))


if __name__ == "__main__":
    main()
