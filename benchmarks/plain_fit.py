"""Plain alternative to gaponet identify: least squares of scipy over rollouts of the whole robot in MuJoCo.

    python benchmarks/plain_fit.py DATASET [--robot ROBOT] [--out FOLDER]

It fits kp, total damping, dry friction, armature, delay and offset of each joint, by finite differences over windows of
the training motions, starting from the robot's file. The error is that of whole validation motions.

    gaponet experiment real --method benchmarks/plain_fit.py:equal_windows

is the same with the windows and bounds of gaponet identify, fitted to all recordings that a question gives to methods.
"""

from __future__ import annotations

import argparse
import time
from collections import Counter
from dataclasses import replace
from pathlib import Path

import mujoco
import numpy as np
from mujoco.rollout import Rollout
from scipy.optimize import least_squares

from gaponet.data.sequence import Sequence
from gaponet.data.split import split_entries
from gaponet.experiments.real.methods import FittedSim
from gaponet.experiments.real.questions import Question
from gaponet.robot.folder import save_robot
from gaponet.robot.spec import RobotSpec
from gaponet.share.reading import open_dataset
from gaponet.sim.model import build_model
from gaponet.sim.replay import replay

WINDOW, COUNT, SETTLE = 5.0, 8, 0.1  # length of a window, s; number of windows; ignored start, s
LOW, HIGH, STEP = (0.1, 0.0, 0.0, 0.0, 0.0, -10.0), (10.0, 10.0, 50.0, 50.0, 5.0, 10.0), 0.02


def equal_windows(question: Question) -> FittedSim:
    """Fit with 40 windows of 8 s and friction up to kp / 5, as gaponet identify does."""
    period = Counter(s.dt for s in question.fitted).most_common(1)[0][0]
    sequences = [s for s in question.fitted if s.dt == period]
    gains = {s.meta.recorded_gains for s in sequences}
    robot = question.robot.with_gains(*gains.pop()) if len(gains) == 1 else question.robot
    return FittedSim(plain_fit(sequences, robot, window=8.0, count=40, friction=200.0))


def plain_fit(
    sequences: list[Sequence],
    robot: RobotSpec,
    nthread: int = 0,
    evaluations: int = 25,
    window: float = WINDOW,
    count: int = COUNT,
    friction: float = 50.0,
) -> RobotSpec:
    """Fit the robot to windows of recordings with one control period and the gains of robot.toml.

    Args:
        window: Length of a window, s.
        count: Number of windows.
        friction: Largest dry friction, thousandths of kp.
    """
    length = round(window / sequences[0].dt)
    cuts = [s.rows(slice(a, a + length)) for s in sequences for a in range(0, len(s), length)]
    cuts = [c for c in cuts if c.duration > 0.9 * window] or list(sequences)
    cuts = [cuts[i * len(cuts) // min(count, len(cuts))] for i in range(min(count, len(cuts)))]
    rows, op = min(map(len, cuts)), robot.operated_index
    n, kd = len(op), robot.kd[robot.operated_index]
    models = [build_model(robot, c.meta.payload_mass, c.meta.payload_side, c.dt, physics_only=True) for c in cuts]
    own, h, steps = models[0], models[0].opt.timestep, robot.steps_per(cuts[0].dt)
    damping = own.dof_damping[op] + kd
    armature = np.maximum(
        own.dof_armature[op], 2.5e-5 * robot.kp[op]
    )  # stiff joints are unstable with less at this step
    late, zero = np.full(n, 0.02), np.zeros(n)
    scale = np.stack(
        [robot.kp[op], np.maximum(damping, 0.05 * robot.kp[op]), 1e-3 * robot.kp[op], armature, late, late / 2]
    )
    low, high = np.repeat(LOW, n), np.repeat((*HIGH[:2], friction, *HIGH[3:]), n)
    start = np.stack([robot.kp[op], damping, own.dof_frictionloss[op], armature, late, zero]) / scale
    start = np.clip(start.ravel(), low + 0.2, high - 0.2)  # the trust region is slow at bounds
    state = np.concatenate([[[0.0, *c.qpos[0], *c.qvel[0]]] for c in cuts]).astype(float)
    real = np.stack([c.qpos[1:rows, op] for c in cuts])
    time_of = np.arange((rows - 1) * steps) * h
    engines = [mujoco.MjData(models[0]) for _ in range(nthread or 2)]
    pool = Rollout(nthread=len(engines))

    def errors(x: np.ndarray) -> np.ndarray:
        kp, total, friction, armature, delay, offset = np.reshape(x, (6, n)) * scale
        late, controls = [], []
        for c, model in zip(cuts, models, strict=True):
            one = mujoco.MjModel.__copy__(model)
            one.actuator_gainprm[op, 0], one.actuator_biasprm[op, 0] = kp, kp * offset
            one.actuator_biasprm[op, 1], one.actuator_biasprm[op, 2] = -kp, -np.minimum(kd, total)
            one.dof_damping[op], one.dof_frictionloss[op] = np.maximum(total - kd, 0), friction
            one.dof_armature[op] = armature
            ctrl = c.ctrl[np.arange(len(time_of)) // steps].astype(float)
            for i, j in enumerate(op):  # linear between commands, so that a delay has a gradient
                ctrl[:, j] = np.interp(time_of - delay[i], time_of, ctrl[:, j])
            late.append(one)
            controls.append(ctrl)
        found, _ = pool.rollout(late, engines, state, np.stack(controls))
        qpos = found[:, steps - 1 :: steps, 1 + op]
        return np.where(np.isfinite(qpos), np.clip(qpos - real, -1, 1), 1.0)[:, round(SETTLE / cuts[0].dt) :].ravel()

    def slopes(x: np.ndarray) -> np.ndarray:
        here, by = errors(x), np.where(x + STEP > high, -STEP, STEP)
        return np.stack([(errors(x + row) - here) / by[i] for i, row in enumerate(np.diag(by))], axis=1)

    fit = least_squares(
        errors, start, slopes, (low, high), x_scale="jac", loss="soft_l1", f_scale=0.01, max_nfev=evaluations
    )
    kp, total, friction, armature, delay, offset = np.reshape(fit.x, (6, n)) * scale
    servo = {"kp": kp, "damping": np.maximum(total - kd, 0), "frictionloss": friction, "armature": armature,
             "delay": delay, "offset": offset}  # fmt: skip
    found = robot.with_servos({j: {f: float(v[i]) for f, v in servo.items()} for i, j in enumerate(robot.operated)})
    less = np.array(robot.kd)
    less[op] = np.minimum(kd, total)
    return replace(found, kd=less)


def main() -> None:
    """Fit on training motions, measure on whole validation motions."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
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
        error = np.mean([np.abs(t.qpos - s.qpos)[1:, op].mean() for s, t in zip(parts["val"], replays, strict=True)])
        print(f"{name}: {1e3 * error:.3f} mrad over {len(replays)} validation motions")
    print(f"{seconds:.0f} s")
    if args.out:
        save_robot(found, args.out)


if __name__ == "__main__":
    main()
