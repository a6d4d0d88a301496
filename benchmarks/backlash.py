"""Backlash on VIRTUAL robots: right verdicts, widths and errors, with and without a play hinge.

    python benchmarks/backlash.py OUT.jsonl --robots 12 --first 0     # resumes
    python benchmarks/backlash.py OUT.jsonl --robots 12 --hinge

The robots are plain MuJoCo models. Backlash is a hinge of its own with a range of ± b/2 between
the motor (armature, damping, friction) and the link, or a spring stands there. The encoder is on
the link. One or two joints hang under gravity, or turn without it. Ten motions of 4 s are fitted
and validated, four test.

With --hinge, forms for plain MuJoCo are compared with gaponet's own simulation of the same gap
instead: without a gap, and with a play hinge. Its servo reads the motor (also with the best
offset), or the link by code in every step.
"""

from __future__ import annotations

import tempfile
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
from draws import log_uniform, minimum_jerk
from virtual_arms import write_robot

from gaponet.data.sequence import Sequence, SequenceMeta
from gaponet.robot.servo_fields import Term
from gaponet.robot.spec import RobotSpec
from gaponet.sim.batch import Batch
from gaponet.sim.model import STIFF_MOBILITY, STIFF_SOLIMP, STIFF_SOLREF, build_model
from gaponet.sim.replay import motion_errors, replay
from gaponet.sysid.identify import identify
from gaponet.sysid.options import IdentifyOptions

DT = 0.01  # s, of the logs
TRUE_TIMESTEP = 5e-4  # s, of the true robot's physics
MOTIONS = 14
FITTED = 6  # the first so many
VALIDATED = 10  # up to this one; the others test
MOTION_S = 4.0
SETTLE_ROWS = 50  # before a log begins
COUNT_RAD = 2 * np.pi / 4096  # of the encoder
NOISE_RAD = 2e-4
STRIBECK_SPEED = 0.05  # rad/s
FILE_KP = 0.8  # of the true gain
FILE_MOTOR = 0.7  # of the true armature and damping
SLOW_SINES, REST_AND_WAY, STEPS, FAST_SINES = range(4)  # kinds of motions


@dataclass(frozen=True)
class PlayRobot:
    """VIRTUAL robot of n joints; arrays (n,) in SI units."""

    seed: int
    gravity: bool
    mass: np.ndarray
    length: np.ndarray
    kp: np.ndarray
    damping: np.ndarray
    friction: np.ndarray
    stribeck: np.ndarray
    armature: np.ndarray
    delay: float
    backlash: np.ndarray
    grease: float = 0.0  # friction inside the gap, over the motor's
    spring: float = 0.0  # stiffness between motor and link instead of a gap, over kp
    motor_encoder: bool = False  # else the encoder is on the link

    @classmethod
    def draw(cls, seed: int, backlash: bool, joints: int | None = None) -> PlayRobot:
        """Draw the robot of a seed; the same robot with and without backlash."""
        rng = np.random.default_rng([seed, 77])
        n = joints or 1 + seed % 2
        mass = rng.uniform(0.05, 0.3, n)
        length = rng.uniform(0.1, 0.25, n)
        inertia = _stretched_inertia(mass, length)
        armature = mass * length**2 / 3 * log_uniform(rng, 0.2, 3.0, n)
        pace = rng.uniform(12, 35, n)
        kp = (inertia + armature) * pace**2
        damping = 2 * rng.uniform(0.3, 1.0, n) * pace * (inertia + armature)
        friction = kp * log_uniform(rng, 1e-3, 1e-2, n)
        has_stribeck = rng.random() < 0.5
        stribeck = kp * rng.uniform(0, 5e-3, n)
        delay = float(rng.uniform(0, 0.02))
        width = log_uniform(rng, 3e-3, 2e-2, n)
        none = np.zeros(n)
        return cls(
            seed=seed,
            gravity=seed // 2 % 2 == 1,
            mass=mass,
            length=length,
            kp=kp,
            damping=damping,
            friction=friction,
            stribeck=stribeck if has_stribeck else none,
            armature=armature,
            delay=delay,
            backlash=width if backlash else none,
        )

    @property
    def has_hinge(self) -> np.ndarray:
        """Return whether a hinge with a gap or a spring is between motor and link, (n,)."""
        return (self.backlash > 0) | (self.spring > 0)

    def xml(self, true: bool) -> str:
        """Return the MJCF, of the true robot with play hinges, else of a vendor's file."""
        bodies = ""
        ends = ""
        at = "0 0 0"
        for i, has_hinge in enumerate(self.has_hinge):
            if true and has_hinge:
                bodies += self._motor_and_link(i, at)
                ends += "</body></body>"
            else:
                bodies += self._rigid_link(i, at, 1.0 if true else FILE_MOTOR)
                ends += "</body>"
            at = self._end(i)
        timestep = TRUE_TIMESTEP if true else DT / 5
        return (
            '<mujoco><compiler angle="radian" autolimits="true"/>'
            f'<option integrator="implicitfast" timestep="{timestep}"/>'
            f"<worldbody>{bodies}{ends}</worldbody></mujoco>"
        )

    @property
    def _axis(self) -> str:
        return "0 1 0" if self.gravity else "0 0 1"

    def _end(self, i: int) -> str:
        """Return where link i ends in its own frame, m."""
        length = self.length[i]
        return f"0 0 -{length}" if self.gravity else f"{length} 0 0"

    def _rod(self, i: int) -> str:
        return (
            f'<geom type="capsule" fromto="0 0 0 {self._end(i)}" size="0.01" '
            f'mass="{self.mass[i]}" contype="0" conaffinity="0"/>'
        )

    def _rigid_link(self, i: int, at: str, factor: float) -> str:
        """Return a link without its end tag; its motor has a factor on armature and damping."""
        return (
            f'<body name="b{i}" pos="{at}">'
            f'<joint name="j{i}" axis="{self._axis}" range="-1.6 1.6" '
            f'armature="{factor * self.armature[i]}" '
            f'damping="{factor * self.damping[i]}"/>{self._rod(i)}'
        )

    def _motor_and_link(self, i: int, at: str) -> str:
        """Return a motor, a gap or a spring, and the link, without their end tags."""
        half = self.backlash[i] / 2
        between = (
            f'range="{-half} {half}" limited="true" frictionloss="{self.grease * self.friction[i]}"'
        )
        if self.spring:
            stiffness = self.spring * self.kp[i]
            # Damped to a fiftieth.
            damping = 0.04 * np.sqrt(stiffness * self.mass[i] / 3) * self.length[i]
            between = f'stiffness="{stiffness}" damping="{damping}" limited="false"'
        return (
            f'<body name="m{i}" pos="{at}">'
            '<inertial pos="0 0 0" mass="1e-6" diaginertia="1e-9 1e-9 1e-9"/>'
            f'<joint name="j{i}" axis="{self._axis}" armature="{self.armature[i]}" '
            f'damping="{self.damping[i]}"/>'
            f'<body name="b{i}"><joint name="p{i}" axis="{self._axis}" {between} '
            f'solreflimit="{2 * TRUE_TIMESTEP} 1" solimplimit="0.99 0.999 1e-4"/>{self._rod(i)}'
        )

    def spec(self) -> RobotSpec:
        """Return the vendor's robot folder as a robot."""
        name = f"play{self.seed}"
        joints = []
        for kp in self.kp:
            joints.append({"kp": FILE_KP * kp, "effort_limit": 100 * kp})
        return write_robot(
            Path(tempfile.mkdtemp()) / name,
            self.xml(true=False),
            name=name,
            dt=DT,
            timestep=DT / 5,
            joints=joints,
        )

    def commands(self, number: int, seconds: float = MOTION_S) -> np.ndarray:
        """Return targets of a motion, (T, n) rad: sines, ways with rests, steps, fast sines."""
        rng = np.random.default_rng([self.seed, number, 5])
        time = np.arange(round(seconds / DT))[:, None] * DT
        kind = number % 4
        if kind == SLOW_SINES:
            return 0.5 * self._sines(rng, time, 1.0) + self._centre(rng)
        if kind == FAST_SINES:
            return 0.12 * self._sines(rng, time, 4.0) + self._centre(rng)
        knots = rng.uniform(-0.5, 0.5, (7, len(self.kp)))
        at = np.clip(time / seconds * 6, 0, 5.999)
        i = at.astype(int)[:, 0]
        moving_share = 0.6 if kind == REST_AND_WAY else 0.02
        size = 1.0 if kind == REST_AND_WAY else 0.4
        way = minimum_jerk(np.clip(at % 1 / moving_share, 0, 1))
        return knots[i] + (knots[i + 1] - knots[i]) * way * size

    def _sines(self, rng: np.random.Generator, time: np.ndarray, faster: float) -> np.ndarray:
        """Draw the mean of three sines, (T, n)."""
        n = len(self.kp)
        hertz = rng.uniform(0.2, 0.8, (3, n)) * faster
        phases = rng.uniform(0, 6, (3, n))
        return np.sin(2 * np.pi * hertz * time[:, None] + phases).mean(axis=1)

    def _centre(self, rng: np.random.Generator) -> np.ndarray:
        return rng.uniform(-0.2, 0.2, len(self.kp))

    def record(self, ctrl: np.ndarray, names: list[str]) -> list[Sequence]:
        """Simulate motions (m, T, n) rad and log them."""
        model = mujoco.MjModel.from_xml_string(self.xml(true=True))
        model.dof_solref[:] = [2.5 * TRUE_TIMESTEP, 1.0]
        model.dof_solimp[:] = [0.9999, 0.9999, 0.001, 0.5, 2.0]
        batch = Batch(model, nsim=len(ctrl), nthread=1)
        qpos = batch.bind("qpos")
        qvel = batch.bind("qvel")
        torque = batch.bind("qfrc_applied")
        friction = batch.expand("dof_frictionloss")
        motor = np.array([model.joint(f"j{i}").dofadr[0] for i in range(len(self.kp))])
        hinge = motor + self.has_hinge  # the play hinge of a joint is the next one
        read_hinge = self.has_hinge & (not self.motor_encoder)
        friction[:, hinge] = self.grease * self.friction
        friction[:, motor] = self.friction
        qpos[:, motor] = ctrl[:, 0]
        steps = round(DT / TRUE_TIMESTEP)
        late = round(self.delay / TRUE_TIMESTEP)
        rows = ctrl.shape[1]
        link = np.zeros(ctrl.shape)
        for t in range(-SETTLE_ROWS, rows):
            for step in range(steps):
                read = qpos[:, motor] + read_hinge * qpos[:, hinge]
                if t >= 0 and step == 0:
                    link[:, t] = read
                sent = (t * steps + step - late) // steps
                target = ctrl[:, min(max(sent, 0), rows - 1)]
                if self.stribeck.any():
                    speed = qvel[:, motor] / STRIBECK_SPEED
                    friction[:, motor] = self.friction + self.stribeck / (1 + speed**2)
                torque[:, motor] = self.kp * (target - read)
                batch.step()
        return [self.log(ctrl[i], link[i], name, i) for i, name in enumerate(names)]

    def log(self, ctrl: np.ndarray, qpos: np.ndarray, motion: str, number: int) -> Sequence:
        """Return the log of a motion, (T, n) rad each, with an encoder's noise and steps."""
        noise = np.random.default_rng([self.seed, number, 9]).standard_normal(qpos.shape)
        qpos = np.round((qpos + NOISE_RAD * noise) / COUNT_RAD) * COUNT_RAD
        meta = SequenceMeta(f"play{self.seed}", "a", motion, 0.0, virtual=True)
        names = tuple(f"j{i}" for i in range(len(self.kp)))
        return Sequence(meta, names, DT, ctrl, qpos, np.gradient(qpos, DT, axis=0))


def _stretched_inertia(mass: np.ndarray, length: np.ndarray) -> np.ndarray:
    """Return about the inertia that each joint of a chain moves, (n,) kg·m²."""
    inertia = np.zeros(len(mass))
    for i in range(len(mass)):
        rods = (mass[i:] * length[i:] ** 2).sum() / 3
        inertia[i] = rods + 0.5 * mass[i + 1 :].sum() * length[i] ** 2
    return inertia


# ---- verdicts


def verdicts(seed: int) -> Row:
    """Identify a robot with a gap, with and without the term, and the same robot without a gap."""
    gap = PlayRobot.draw(seed, backlash=True)
    none = PlayRobot.draw(seed, backlash=False)
    return {
        "with": result(gap),
        "left out": result(gap, ("stribeck", "load")),
        "no gap": result(none),
    }


def result(robot: PlayRobot, terms: tuple[Term, ...] | None = None) -> Row:
    """Identify a robot from its logs; return widths, standard errors, and errors of new motions."""
    ctrl = np.stack([robot.commands(k) for k in range(MOTIONS)])
    logs = robot.record(ctrl, [f"m{k:02}" for k in range(MOTIONS)])
    options = IdentifyOptions(terms=terms, table=False, folds=1)
    fit = identify(logs[:FITTED], robot.spec(), logs[FITTED:VALIDATED], options=options)
    fitted = fit.robot
    return {
        "seed": robot.seed,
        "true_rad": robot.backlash.tolist(),
        "findings": fit.findings,
        "rad": fitted.servo.backlash[fitted.operated_index].tolist(),
        "std_rad": [fit.std[joint].get("backlash", 0.0) for joint in fitted.operated],
        "test_rad": motion_errors(logs[VALIDATED:], fitted).tolist(),
    }


def print_verdicts(rows: list[Row]) -> None:
    """Print accepted gaps, intervals and errors of each kind of robots."""
    lines = []
    for name in ("with", "left out", "no gap"):
        results = [row[name] for row in rows]
        widths = np.concatenate([r["rad"] for r in results])
        true = np.concatenate([r["true_rad"] for r in results])
        stds = np.concatenate([r["std_rad"] for r in results])
        found = widths != 0
        inside = share_inside(zip(widths[found], true[found], stds[found], strict=True))
        error = plus_minus(1e3 * np.mean(r["test_rad"]) for r in results)
        lines.append((name, len(results), len(widths), found.sum(), inside, error))
    columns = ("VIRTUAL robots", "robots", "joints", "gaps accepted", "inside 90 %", "error, mrad")
    print_table(columns, lines)


# ---- forms of a gap for plain MuJoCo


def hinge_result(seed: int) -> Row:
    """Return how far each form of one joint with a gap is from gaponet's simulation, rad."""
    robot = PlayRobot.draw(seed, backlash=True, joints=1)
    robot = replace(robot, delay=0.0, stribeck=np.zeros(1))
    servo = {
        "kp": float(robot.kp[0]),
        "damping": float(robot.damping[0]),
        "armature": float(robot.armature[0]),
        "backlash": float(robot.backlash[0]),
        "frictionloss": float(robot.friction[0]),
    }
    spec = robot.spec().with_identified({"j0": servo})
    motions = []
    for k in range(MOTIONS - VALIDATED):
        ctrl = robot.commands(k)
        log = robot.log(ctrl, ctrl, f"m{k}", k)
        motions.append(replace(log, qpos=0 * ctrl + ctrl[0], qvel=0 * ctrl))
    ours = _paths(motions, spec)
    model = build_model(spec)
    motor_read = []
    link_read = []
    for motion in motions:
        motor_read.append(play_hinge(robot, spec.timestep, motion, model, reads_link=False))
        link_read.append(play_hinge(robot, spec.timestep, motion, model, reads_link=True))
    by_motor = np.array(motor_read)
    forms = {
        "left out": _paths(motions, spec.with_servo(backlash=np.zeros(1))),
        "motor read": by_motor,
        "link read": np.array(link_read),
        "motor read, best offset": by_motor - np.median(by_motor - ours),
    }
    return {name: float(np.abs(path - ours)[:, 1:].mean()) for name, path in forms.items()}


def _paths(motions: list[Sequence], robot: RobotSpec) -> np.ndarray:
    """Return simulated positions, (motions, T, n) rad."""
    return np.array([one.qpos for one in replay(motions, robot)])


def play_hinge(
    robot: PlayRobot, timestep: float, motion: Sequence, own: mujoco.MjModel, reads_link: bool
) -> np.ndarray:
    """Play a motion with a play hinge in plain MuJoCo; return the link's path, (T, 1) rad.

    Args:
        timestep: Physics step, s.
        own: gaponet's model of the robot: its tolerance, and the side on which the link rests.
        reads_link: The servo reads the link, else the motor.
    """
    model = mujoco.MjModel.from_xml_string(robot.xml(true=True))
    model.opt.timestep = timestep
    model.opt.tolerance = own.opt.tolerance
    model.jnt_solref[1] = (2 * timestep, 1)
    model.dof_invweight0[:] = STIFF_MOBILITY * model.dof_invweight0
    model.dof_solref[:] = STIFF_SOLREF
    model.dof_solimp[:] = STIFF_SOLIMP
    model.dof_frictionloss[:] = (robot.friction[0], 0.0)
    data = mujoco.MjData(model)
    gap = _resting_side(own, motion) * robot.backlash[0] / 2
    data.qpos[:] = (motion.qpos[0, 0] + gap, -gap)
    path = np.array(motion.qpos, float)
    for t in range(len(path) - 1):
        for _ in range(round(DT / timestep)):
            motor, hinge = data.qpos
            error = motion.ctrl[t, 0] - motor
            if reads_link:
                error -= hinge
            data.qfrc_applied[0] = robot.kp[0] * error
            mujoco.mj_step(model, data)
        path[t + 1] = data.qpos.sum()
    return path


def _resting_side(own: mujoco.MjModel, motion: Sequence) -> float:
    """Return ±1: the side of the gap that gravity presses the motor to at the start of a motion."""
    rest = mujoco.MjData(own)
    rest.qpos[:] = motion.qpos[0]
    mujoco.mj_forward(own, rest)
    return float(np.copysign(1.0, rest.qfrc_bias[0]))


def print_forms(rows: list[Row]) -> None:
    """Print how far each form is from gaponet's own simulation."""
    lines = []
    for name in rows[0]:
        if name == "seed":
            continue
        worse = sum(row[name] > row["left out"] for row in rows)
        difference = plus_minus(1e3 * row[name] for row in rows)
        lines.append((name, difference, f"{worse} of {len(rows)}"))
    print_table(("form in plain MuJoCo", "difference, mrad", "worse than left out"), lines)


def main() -> None:
    parser = command_line(__doc__)
    parser.add_argument("out", type=Path)
    parser.add_argument("--robots", type=int, default=12)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--hinge", action="store_true")
    args = parser.parse_args()
    seeds = range(args.first, args.first + args.robots)
    if args.hinge:
        print_forms(measure_seeds(args.out, seeds, hinge_result))
    else:
        print_verdicts(measure_seeds(args.out, seeds, verdicts))


if __name__ == "__main__":
    main()
