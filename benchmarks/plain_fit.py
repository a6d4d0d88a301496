"""Plain alternative to gaponet identify: least squares of scipy over rollouts of the whole robot in MuJoCo.

    python benchmarks/plain_fit.py DATASET [--robot ROBOT] [--out FOLDER]

It fits kp, total damping, dry friction, armature, delay and offset of each joint, by finite differences over windows of
the training motions, starting from the robot's file. The error is that of whole validation motions.

    python benchmarks/compare_methods.py --method benchmarks/plain_fit.py:equal_windows

is the same with the windows and bounds of gaponet identify, fitted to all recordings that a question gives to methods.
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path

import mujoco
import numpy as np
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

WINDOW, COUNT, SETTLE = 5.0, 8, 0.1  # length of a window, s; number of windows; ignored start, s
LOW, HIGH, STEP = (0.1, 0.0, 0.0, 0.0, 0.0, -10.0), (10.0, 10.0, 50.0, 50.0, 5.0, 10.0), 0.02
EVALUATIONS = 25
LOSS = {"x_scale": "jac", "loss": "soft_l1", "f_scale": 0.01}  # of errors, rad


class Problem:
    """Windows of recordings, and the scaled parameters of n operated joints, (6 n,).

    Attributes:
        cuts: Windows.
        specs: Simulator of each window; limbs that no command moves are locked.
        states: Start of each window: time, positions, velocities.
        op: Operated joints among those that are not locked.
        start, low, high: Start and bounds: kp, total damping, friction, armature, delay, offset of each joint.
    """

    def __init__(
        self,
        sequences: list[Sequence],
        robot: RobotSpec,
        window: float = 8.0,
        count: int = 40,
        friction: float = 200.0,
    ) -> None:
        """Take `count` windows of so many seconds; `friction` bounds dry friction in thousandths of kp."""
        lengths = [round(window / s.dt) for s in sequences]
        cuts = [
            s.rows(slice(a, a + k))
            for s, k in zip(sequences, lengths, strict=True)
            for a in range(0, len(s), k)
        ]
        cuts = [c for c in cuts if c.duration > 0.9 * window] or list(sequences)
        self.cuts = cuts = [
            cuts[i * len(cuts) // min(count, len(cuts))] for i in range(min(count, len(cuts)))
        ]
        self.robot, self.steps = robot, [robot.steps_per(c.dt) for c in cuts]
        locked = idle_limbs(cuts, robot)
        free = [j for j in robot.joint_names if j not in locked]
        self.free, self.op = robot.index(free), np.array([free.index(j) for j in robot.operated])
        self.specs = [
            build_spec(
                robot, c.meta.payload_mass, c.meta.payload_side, c.dt, locked, physics_only=True
            )
            for c in cuts
        ]
        of = robot.operated_index
        self.gains = np.array(
            [
                [r.servo.kp[of], r.servo.kd[of]]
                for r in (robot.with_gains(*c.meta.recorded_gains) for c in cuts)
            ]
        )
        self.states = np.array(
            [[0.0, *c.qpos[0, self.free], *c.qvel[0, self.free]] for c in cuts], float
        )
        self.ticks = np.arange(max((len(c) - 1) * k for c, k in zip(cuts, self.steps, strict=True)))
        own, n = self.specs[0].compile(), len(of)
        self.kp, self.kd, damping = (
            robot.servo.kp[of],
            robot.servo.kd[of],
            own.dof_damping[self.op] + robot.servo.kd[of],
        )
        # Stiff joints are unstable with less armature at this step.
        armature, late = np.maximum(own.dof_armature[self.op], 2.5e-5 * self.kp), np.full(n, 0.02)
        slow = np.maximum(damping, 0.05 * self.kp)
        self.scale = np.stack([self.kp, slow, 1e-3 * self.kp, armature, late, late / 2])
        self.low, self.high = np.repeat(LOW, n), np.repeat((*HIGH[:2], friction, *HIGH[3:]), n)
        start = (
            np.stack([self.kp, damping, own.dof_frictionloss[self.op], armature, late, 0 * late])
            / self.scale
        )
        self.start = np.clip(
            start.ravel(), self.low + 0.2, self.high - 0.2
        )  # the trust region is slow at bounds

    def servos(self, x: np.ndarray, window: int) -> dict[str, np.ndarray]:
        """Return kp, kd, damping, frictionloss, armature, delay and offset, (n,) each, in a window with its gains."""
        kp, total, friction, armature, delay, offset = np.reshape(x, (6, -1)) * self.scale
        given_kp, given_kd = self.gains[window]
        return {"kp": kp * given_kp / self.kp, "kd": np.maximum(given_kd - np.maximum(self.kd - total, 0), 0),
                "damping": np.maximum(total - self.kd, 0), "frictionloss": friction, "armature": armature,
                "delay": delay, "offset": offset}  # fmt: skip

    def controls(self, delay: np.ndarray, window: int) -> np.ndarray:
        """Return late commands by physics step; linear between commands, so that a delay has a gradient."""
        cut, times = self.cuts[window], self.ticks * self.specs[window].option.timestep
        ctrl = cut.ctrl[np.minimum(self.ticks // self.steps[window], len(cut) - 1)][
            :, self.free
        ].astype(float)
        for late, j in zip(delay, self.op, strict=True):
            ctrl[:, j] = np.interp(times - late, times, ctrl[:, j])
        return ctrl

    def changed(self, x: np.ndarray, window: int, model: mujoco.MjModel) -> mujoco.MjModel:
        """Return a copy of a window's model with these parameters."""
        v, one, op = self.servos(x, window), mujoco.MjModel.__copy__(model), self.op
        one.actuator_gainprm[op, 0], one.actuator_biasprm[op, 0] = v["kp"], v["kp"] * v["offset"]
        one.actuator_biasprm[op, 1], one.actuator_biasprm[op, 2] = -v["kp"], -v["kd"]
        one.dof_damping[op], one.dof_frictionloss[op] = v["damping"], v["frictionloss"]
        one.dof_armature[op] = v["armature"]
        return one

    def errors(self, states: np.ndarray, window: int) -> np.ndarray:
        """Return q_sim − q_real of the joints that were recorded, (rows, n) rad, of a rollout's states."""
        cut, steps = self.cuts[window], self.steps[window]
        qpos = states[steps - 1 :: steps, 1 + self.op][: len(cut) - 1]
        error = np.clip(qpos - cut.qpos[1:, self.robot.operated_index], -1, 1)
        recorded = [j not in cut.meta.unrecorded for j in self.robot.operated]
        return np.where(np.isfinite(error), error, 1.0)[round(SETTLE / cut.dt) :] * recorded

    def robot_with(self, x: np.ndarray) -> RobotSpec:
        """Return the robot with fitted parameters."""
        kp, total, friction, armature, delay, offset = np.reshape(x, (6, -1)) * self.scale
        servo = {"kp": kp, "damping": total - self.kd, "frictionloss": friction, "armature": armature, "delay": delay,
                 "offset": offset}  # fmt: skip
        names = self.robot.operated
        return self.robot.with_identified(
            {j: {f: float(v[i]) for f, v in servo.items()} for i, j in enumerate(names)}
        )


def equal_problem(question: Question) -> Problem:
    """Return 40 windows of 8 s and friction up to kp / 5, as gaponet identify has them."""
    gains = {s.meta.recorded_gains for s in question.fitted}
    return Problem(
        question.fitted,
        question.robot.with_gains(*gains.pop()) if len(gains) == 1 else question.robot,
    )


def equal_windows(question: Question) -> FittedSim:
    """Fit with the windows and bounds of gaponet identify."""
    return FittedSim(fit(equal_problem(question)))


def plain_fit(sequences: list[Sequence], robot: RobotSpec) -> RobotSpec:
    """Fit the robot to eight windows of 5 s."""
    return fit(Problem(sequences, robot, WINDOW, COUNT, 50.0))


def fit(problem: Problem, threads: int = 2) -> RobotSpec:
    """Fit a robot by least squares."""
    windows = range(len(problem.cuts))
    models = [spec.compile() for spec in problem.specs]
    for model in models:
        stiffen_friction(model)
    engines, pool = [mujoco.MjData(models[0]) for _ in range(threads)], Rollout(nthread=threads)

    def errors(x: np.ndarray) -> np.ndarray:
        changed = [problem.changed(x, w, model) for w, model in enumerate(models)]
        controls = [problem.controls(problem.servos(x, w)["delay"], w) for w in windows]
        states, _ = pool.rollout(changed, engines, problem.states, np.stack(controls))
        return np.concatenate([problem.errors(states[w], w).ravel() for w in windows])

    def slopes(x: np.ndarray) -> np.ndarray:
        here, by = errors(x), np.where(x + STEP > problem.high, -STEP, STEP)
        return np.stack(
            [(errors(x + row) - here) / by[i] for i, row in enumerate(np.diag(by))], axis=1
        )

    box = problem.low, problem.high
    return problem.robot_with(
        least_squares(errors, problem.start, slopes, box, max_nfev=EVALUATIONS, **LOSS).x
    )


def main() -> None:
    """Fit on training motions, measure on whole validation motions."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("dataset")
    parser.add_argument("--robot")
    parser.add_argument("--out", type=Path)
    args = parser.parse_args()
    data, robot = open_dataset(args.dataset, args.robot, None)
    parts = {k: data.sequences(v) for k, v in split_entries(data).items()}
    began = time.monotonic()
    found = plain_fit(parts["train"], robot)
    seconds, op = time.monotonic() - began, robot.operated_index
    for name, spec in (("as it is", robot), ("plain fit", found)):
        replays = replay(parts["val"], spec)
        error = np.mean(
            [
                np.abs(t.qpos - s.qpos)[1:, op].mean()
                for s, t in zip(parts["val"], replays, strict=True)
            ]
        )
        print(f"{name}: {1e3 * error:.3f} mrad over {len(replays)} validation motions")
    print(f"{seconds:.0f} s")
    if args.out:
        save_robot(found, args.out)


if __name__ == "__main__":
    main()
