"""Plain alternative to gaponet identify: least squares of scipy over rollouts of the whole robot.

    python benchmarks/plain_fit.py DATASET [--robot ROBOT] [--out FOLDER]

It fits kp, total damping, dry friction, armature, delay and offset of each joint, by finite
differences over windows of the training motions in MuJoCo, starting from the robot's file. The
error is that of whole validation motions.

    python benchmarks/compare_methods.py --method benchmarks/plain_fit.py:equal_windows

is the same with the windows and bounds of gaponet identify, fitted to all recordings that a
question gives to methods.
"""

from __future__ import annotations

import time
from dataclasses import dataclass
from pathlib import Path

import mujoco
import numpy as np
from common import command_line
from mujoco.rollout import Rollout
from real_robots.methods import FittedSim
from real_robots.questions import Question
from scipy.optimize import least_squares

from gaponet.data.sequence import Sequence
from gaponet.data.split import split_entries
from gaponet.robot.folder import save_robot
from gaponet.robot.spec import RobotSpec
from gaponet.sim.dataset_robot import open_dataset
from gaponet.sim.model import build_spec, stiffen_friction
from gaponet.sim.replay import idle_limbs, replay

SHORT_WINDOW_S = 5.0  # of plain_fit
SHORT_COUNT = 8
SHORT_MAX_FRICTION = 50.0
SETTLE_S = 0.1  # ignored start of a window
# Bounds of kp, total damping, friction, armature, delay and offset, each over its scale.
LOW = (0.1, 0.0, 0.0, 0.0, 0.0, -10.0)
HIGH = (10.0, 10.0, 50.0, 50.0, 5.0, 10.0)
FRICTION = 2  # its place in them
MARGIN = 0.2  # of the start from bounds, where the trust region is slow
STEP = 0.02  # of finite differences
EVALUATIONS = 25
LOSS = {"x_scale": "jac", "loss": "soft_l1", "f_scale": 0.01}  # of errors, rad


@dataclass(frozen=True)
class Servos:
    """Parameters of n joints, (n,) each; `damping` is the total of joint and servo."""

    kp: np.ndarray
    damping: np.ndarray
    friction: np.ndarray
    armature: np.ndarray
    delay: np.ndarray
    offset: np.ndarray


class Problem:
    """Windows of recordings, and the scaled parameters of n operated joints, (6 n,).

    Attributes:
        cuts: Windows.
        specs: Simulator of each window; limbs that no command moves are locked.
        states: Start of each window: time, positions, velocities.
        free: Columns of the joints that are not locked.
        op: Operated joints among these.
        gains: kp and kd of each window, (windows, 2, n).
        scale: Unit of each parameter, (6, n).
        start, low, high: Start and bounds of kp, total damping, friction, armature, delay and
            offset of each joint.
    """

    def __init__(
        self,
        sequences: list[Sequence],
        robot: RobotSpec,
        window: float = 8.0,
        count: int = 40,
        friction: float = 200.0,
    ) -> None:
        """Take `count` windows of so many seconds; `friction` bounds it in thousandths of kp."""
        self.robot = robot
        self.cuts = _windows(sequences, window, count)
        self.steps = [robot.steps_per(cut.dt) for cut in self.cuts]
        locked = idle_limbs(self.cuts, robot)
        free = [joint for joint in robot.joint_names if joint not in locked]
        self.free = robot.index(free)
        self.op = np.array([free.index(joint) for joint in robot.operated])
        operated = robot.operated_index
        self.kp = robot.servo.kp[operated]
        self.kd = robot.servo.kd[operated]
        self.specs = []
        gains = []
        states = []
        rows = []  # physics steps of each window
        for cut, steps in zip(self.cuts, self.steps, strict=True):
            payload = (cut.meta.payload_mass, cut.meta.payload_side)
            spec = build_spec(robot, *payload, cut.dt, locked, physics_only=True)
            self.specs.append(spec)
            recorded = robot.with_gains(*cut.meta.recorded_gains).servo
            gains.append([recorded.kp[operated], recorded.kd[operated]])
            states.append([0.0, *cut.qpos[0, self.free], *cut.qvel[0, self.free]])
            rows.append((len(cut) - 1) * steps)
        self.gains = np.array(gains)
        self.states = np.array(states, float)
        self.ticks = np.arange(max(rows))
        self._set_start(friction)

    def _set_start(self, friction: float) -> None:
        """Set scale, start and bounds from the model of the first window."""
        n = len(self.kp)
        own = self.specs[0].compile()
        damping = own.dof_damping[self.op] + self.kd
        slow = np.maximum(damping, 0.05 * self.kp)
        # Stiff joints are unstable with less armature at this step.
        armature = np.maximum(own.dof_armature[self.op], 2.5e-5 * self.kp)
        delay = np.full(n, 0.02)  # s
        self.scale = np.stack([self.kp, slow, 1e-3 * self.kp, armature, delay, delay / 2])
        most = np.array(HIGH)
        most[FRICTION] = friction
        self.low = np.repeat(LOW, n)
        self.high = np.repeat(most, n)
        first = [self.kp, damping, own.dof_frictionloss[self.op], armature, delay, 0 * delay]
        scaled = np.stack(first) / self.scale
        self.start = np.clip(scaled.ravel(), self.low + MARGIN, self.high - MARGIN)

    def unscaled(self, x: np.ndarray) -> Servos:
        """Return the parameters (6 n,) in SI units."""
        return Servos(*(np.reshape(x, (6, -1)) * self.scale))

    def servos(self, x: np.ndarray, window: int) -> dict[str, np.ndarray]:
        """Return kp, kd, damping, frictionloss, armature, delay and offset in a window, (n,) each.

        kp and kd follow the gains that were recorded.
        """
        servos = self.unscaled(x)
        given_kp, given_kd = self.gains[window]
        # What is less than the servo's own kd is taken from that.
        missing = np.maximum(self.kd - servos.damping, 0)
        return {
            "kp": servos.kp * given_kp / self.kp,
            "kd": np.maximum(given_kd - missing, 0),
            "damping": np.maximum(servos.damping - self.kd, 0),
            "frictionloss": servos.friction,
            "armature": servos.armature,
            "delay": servos.delay,
            "offset": servos.offset,
        }

    def controls(self, delay: np.ndarray, window: int) -> np.ndarray:
        """Return late commands by physics step, for delays (n,) s.

        They are linear between commands, so that a delay has a gradient.
        """
        cut = self.cuts[window]
        times = self.ticks * self.specs[window].option.timestep
        rows = np.minimum(self.ticks // self.steps[window], len(cut) - 1)
        ctrl = cut.ctrl[rows][:, self.free].astype(float)
        for late, j in zip(delay, self.op, strict=True):
            ctrl[:, j] = np.interp(times - late, times, ctrl[:, j])
        return ctrl

    def changed(self, x: np.ndarray, window: int, model: mujoco.MjModel) -> mujoco.MjModel:
        """Return a copy of a window's model with these parameters."""
        servos = self.servos(x, window)
        one = mujoco.MjModel.__copy__(model)
        op = self.op
        one.actuator_gainprm[op, 0] = servos["kp"]
        one.actuator_biasprm[op, 0] = servos["kp"] * servos["offset"]
        one.actuator_biasprm[op, 1] = -servos["kp"]
        one.actuator_biasprm[op, 2] = -servos["kd"]
        one.dof_damping[op] = servos["damping"]
        one.dof_frictionloss[op] = servos["frictionloss"]
        one.dof_armature[op] = servos["armature"]
        return one

    def errors(self, states: np.ndarray, window: int) -> np.ndarray:
        """Return q_sim − q_real of the joints that were recorded, (rows, n) rad, of a rollout."""
        cut = self.cuts[window]
        steps = self.steps[window]
        qpos = states[steps - 1 :: steps, 1 + self.op][: len(cut) - 1]
        error = np.clip(qpos - cut.qpos[1:, self.robot.operated_index], -1, 1)
        recorded = [joint not in cut.meta.unrecorded for joint in self.robot.operated]
        return np.where(np.isfinite(error), error, 1.0)[round(SETTLE_S / cut.dt) :] * recorded

    def robot_with(self, x: np.ndarray) -> RobotSpec:
        """Return the robot with fitted parameters."""
        servos = self.unscaled(x)
        joints = {}
        for i, joint in enumerate(self.robot.operated):
            joints[joint] = {
                "kp": float(servos.kp[i]),
                "damping": float(servos.damping[i] - self.kd[i]),
                "frictionloss": float(servos.friction[i]),
                "armature": float(servos.armature[i]),
                "delay": float(servos.delay[i]),
                "offset": float(servos.offset[i]),
            }
        return self.robot.with_identified(joints)


def _windows(sequences: list[Sequence], seconds: float, count: int) -> list[Sequence]:
    """Return evenly spaced pieces of recordings; whole recordings where all are short."""
    cuts = []
    for sequence in sequences:
        rows = round(seconds / sequence.dt)
        for first in range(0, len(sequence), rows):
            cut = sequence.rows(slice(first, first + rows))
            if cut.duration > 0.9 * seconds:
                cuts.append(cut)
    cuts = cuts or list(sequences)
    count = min(count, len(cuts))
    return [cuts[i * len(cuts) // count] for i in range(count)]


def equal_problem(question: Question) -> Problem:
    """Return 40 windows of 8 s and friction up to kp / 5, as gaponet identify has them."""
    robot = question.robot
    gains = {sequence.meta.recorded_gains for sequence in question.fitted}
    if len(gains) == 1:
        robot = robot.with_gains(*gains.pop())
    return Problem(question.fitted, robot)


def equal_windows(question: Question) -> FittedSim:
    """Fit with the windows and bounds of gaponet identify."""
    return FittedSim(fit(equal_problem(question)))


def plain_fit(sequences: list[Sequence], robot: RobotSpec) -> RobotSpec:
    """Fit the robot to eight windows of 5 s."""
    return fit(Problem(sequences, robot, SHORT_WINDOW_S, SHORT_COUNT, SHORT_MAX_FRICTION))


def fit(problem: Problem, threads: int = 2) -> RobotSpec:
    """Fit a robot by least squares."""
    models = [spec.compile() for spec in problem.specs]
    for model in models:
        stiffen_friction(model)
    engines = [mujoco.MjData(models[0]) for _ in range(threads)]
    pool = Rollout(nthread=threads)

    def errors(x: np.ndarray) -> np.ndarray:
        changed = []
        controls = []
        for window, model in enumerate(models):
            changed.append(problem.changed(x, window, model))
            delay = problem.servos(x, window)["delay"]
            controls.append(problem.controls(delay, window))
        states, _ = pool.rollout(changed, engines, problem.states, np.stack(controls))
        return np.concatenate([problem.errors(s, w).ravel() for w, s in enumerate(states)])

    def slopes(x: np.ndarray) -> np.ndarray:
        here = errors(x)
        steps = np.where(x + STEP > problem.high, -STEP, STEP)
        columns = []
        for i, step in enumerate(steps):
            moved = x.copy()
            moved[i] += step
            columns.append((errors(moved) - here) / step)
        return np.stack(columns, axis=1)

    box = (problem.low, problem.high)
    found = least_squares(errors, problem.start, slopes, box, max_nfev=EVALUATIONS, **LOSS)
    return problem.robot_with(found.x)


def main() -> None:
    """Fit on training motions, measure on whole validation motions."""
    parser = command_line(__doc__)
    parser.add_argument("dataset")
    parser.add_argument("--robot")
    parser.add_argument("--out", type=Path)
    args = parser.parse_args()
    data, robot = open_dataset(args.dataset, args.robot, None)
    parts = split_entries(data)
    train = data.sequences(parts["train"])
    val = data.sequences(parts["val"])
    began = time.monotonic()
    found = plain_fit(train, robot)
    seconds = time.monotonic() - began
    for name, spec in (("as it is", robot), ("plain fit", found)):
        errors = []
        for log, simulated in zip(val, replay(val, spec), strict=True):
            errors.append(np.abs(simulated.qpos - log.qpos)[1:, robot.operated_index].mean())
        print(f"{name}: {1e3 * np.mean(errors):.3f} mrad over {len(val)} validation motions")
    print(f"{seconds:.0f} s")
    if args.out:
        save_robot(found, args.out)


if __name__ == "__main__":
    main()
