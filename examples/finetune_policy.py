"""Fine-tune a policy in the aligned simulator, and see what it does on a robot it has never met: ASAP's use of a gap model.

    gaponet demo                                         # or any run of gaponet train on H1-2, virtual units 1 to 3
    python examples/finetune_policy.py RUN               # RUN: folder of that run

A small network learns by PPO, in the nominal simulator, to make the arms follow motions with 0 to 3 kg in each hand. It
is then trained on in the aligned simulator, and, to be fair, as long again in the nominal one. All three are played on
VIRTUAL unit 4, which neither the model nor a policy has seen, with motions that neither has seen.

What the policy is told: state, the reference now and up to 0.2 s ahead, the payload, its last action, and the torque
that the nominal model says the reference takes (by inverse dynamics, over kp): a feed-forward that it may use as it likes.
Its action is added to the reference. It is not told that anything differs from nominal, and runs alone on the robot:
the model is used in training only.
"""

from __future__ import annotations

import contextlib
import copy
import io
import time
from pathlib import Path
from typing import Any

import numpy as np
import torch
import tyro
from rich.console import Console
from rich.table import Table
from rsl_rl.env import VecEnv
from rsl_rl.runners import OnPolicyRunner
from tensordict import TensorDict

from gaponet.deploy.aligned_sim import AlignedSim
from gaponet.model.artifact import GapModel
from gaponet.motion.library import Library
from gaponet.robot import RobotSpec, load_robot
from gaponet.sim.dynamics import inverse_dynamics
from gaponet.sim.model import build_model, idle_joints
from gaponet.virtual.fleet import load_fleet
from gaponet.virtual.unit import VirtualRobot

Array = np.ndarray

AHEAD = (2, 3, 5, 8, 11)  # rows of the reference that are seen beside the next one
REACH, LIMIT = 0.1, 0.4  # rad that an action of 1 adds to the reference, and the most that any may
NOISE = (0.0005, 0.02)  # rad, rad/s: of what the policy is told while it trains
EPISODE = 200  # control periods
WARMTH = 12.0  # K above ambient
SKIP = 50  # control periods at the start that are not counted


class Task:
    """Motions to follow and what a policy is told of them: rows of all motions one after another.

    Attributes:
        joints: Free joints, as in AlignedSim.
        op: The operated ones among them.
        reference: (rows, free) rad.
        load: Nominal torque over kp at no payload and at the heaviest, (2, rows, n) rad.
        first, last: Rows of each motion.
    """

    def __init__(self, robot: RobotSpec, ctrls: list[Array], heaviest: float) -> None:
        self.locked = idle_joints(robot, robot.operated)
        self.joints = tuple(name for name in robot.joint_names if name not in self.locked)
        free, operated = robot.index(self.joints), robot.operated_index
        self.op = np.searchsorted(free, operated)
        self.reference = np.concatenate(ctrls)[:, free]
        self.last = np.cumsum([len(c) for c in ctrls]) - 1
        self.first = np.append(0, self.last[:-1] + 1)
        self.heaviest, self.n = heaviest, len(operated)
        loads = []
        for mass in (0.0, heaviest):
            model = build_model(robot, mass)
            moves = [[c, v := np.gradient(c, robot.dt, axis=0), np.gradient(v, robot.dt, axis=0)] for c in ctrls]
            torque = np.concatenate([inverse_dynamics(model, *move) for move in moves])
            damped = robot.kd * np.concatenate([move[1] for move in moves])  # the servo brakes what it drives
            loads.append(((torque + damped) / robot.kp)[:, operated])
        self.load = np.array(loads)

    def observe(self, q: Array, v: Array, row: Array, last: Array, mass: Array, action: Array) -> Array:
        """What a policy is told, (N, 5 n + n len(AHEAD) + 1) float32.

        Args:
            q, v: Measured now, operated joints, (N, n) rad, rad/s.
            row, last: Where the motion stands, and its last row, (N,).
            mass: kg, (N,).
            action: The last one, (N, n).
        """
        at = np.minimum(row + 1, last)
        then = self.reference[at][:, self.op]
        ahead = [self.reference[np.minimum(row + k, last)][:, self.op] - then for k in AHEAD]
        share = (mass / self.heaviest)[:, None]
        load = (1 - share) * self.load[0, at] + share * self.load[1, at]
        parts = [then, (q - then) / REACH, 0.3 * v, load / REACH, action, share, *[a / REACH for a in ahead]]
        return np.concatenate(parts, axis=1).astype(np.float32)

    def target(self, row: Array, last: Array, action: Array) -> Array:
        """What is sent, (N, free) rad: the next row of the reference, and the action on the operated joints."""
        out = self.reference[np.minimum(row + 1, last)]
        out[:, self.op] += np.clip(REACH * action, -LIMIT, LIMIT)
        return out


class TrackingEnv(VecEnv):
    """num_envs simulations that follow motions from a random row on; rsl_rl's interface."""

    def __init__(self, task: Task, sim: AlignedSim, seed: int) -> None:
        self.task, self.sim, self.rng = task, sim, np.random.default_rng(seed)
        self.cfg: dict[str, Any] = {}
        self.device, self.num_envs, self.num_actions = "cpu", sim.num_envs, task.n
        self.max_episode_length = EPISODE
        self.episode_length_buf = torch.zeros(sim.num_envs, dtype=torch.long)
        self.row, self.last = np.zeros((2, sim.num_envs), int)
        self.action = np.zeros((sim.num_envs, task.n))
        self.error: list[float] = []
        self._begin(np.arange(sim.num_envs))

    def _begin(self, ids: Array) -> None:
        motion = self.rng.integers(len(self.task.first), size=len(ids))
        self.row[ids] = self.rng.integers(self.task.first[motion], self.task.last[motion] - 20)
        self.last[ids] = self.task.last[motion]
        reference = self.task.reference
        speed = (reference[self.row[ids] + 1] - reference[self.row[ids]]) / self.sim.dt
        self.sim.reset(reference[self.row[ids]], speed, ids=ids)
        self.action[ids] = 0.0
        self.episode_length_buf[torch.from_numpy(ids)] = 0

    def get_observations(self) -> TensorDict:
        """Of a noisy state."""
        shape = (self.num_envs, self.task.n)
        q, v = (x[:, self.task.op] + s * self.rng.standard_normal(shape) for x, s in zip(
            (self.sim.qpos, self.sim.qvel), NOISE, strict=True))  # fmt: skip
        seen = self.task.observe(q, v, self.row, self.last, self.sim.payload_mass, self.action)
        return TensorDict({"policy": torch.from_numpy(seen)}, batch_size=[self.num_envs])

    def step(self, actions: torch.Tensor) -> tuple[TensorDict, torch.Tensor, torch.Tensor, dict[str, Any]]:
        """Reward: minus the mean error in units of 20 mrad, and a little for calm actions."""
        action = actions.numpy().astype(float)
        self.sim.step(self.task.target(self.row, self.last, action))
        self.row += 1
        error = np.abs(self.sim.qpos - self.task.reference[self.row])[:, self.task.op].mean(axis=1)
        rough = np.square(action - self.action).mean(axis=1)
        self.action[:] = action
        self.error.append(float(error.mean()))
        self.episode_length_buf += 1
        done = (self.row >= self.last) | (self.episode_length_buf.numpy() >= EPISODE)
        if done.any():
            self._begin(np.flatnonzero(done))
        dones = torch.from_numpy(done)
        reward = torch.from_numpy((-error / 0.02 - 0.02 * rough).astype(np.float32))
        return self.get_observations(), reward, dones, {"time_outs": dones}


PPO: dict[str, Any] = {
    "num_steps_per_env": 16, "save_interval": 10**9, "obs_groups": {"actor": ["policy"], "critic": ["policy"]},
    "actor": {
        "class_name": "MLPModel", "hidden_dims": [128, 128], "activation": "elu", "obs_normalization": False,
        "distribution_cfg": {"class_name": "GaussianDistribution", "init_std": 0.3, "std_type": "log"},
    },
    "critic": {"class_name": "MLPModel", "hidden_dims": [128, 128], "activation": "elu", "obs_normalization": False},
    "algorithm": {
        "class_name": "PPO", "num_learning_epochs": 4, "num_mini_batches": 4, "learning_rate": 1e-3,
        "desired_kl": 0.01, "gamma": 0.9, "lam": 0.9, "clip_param": 0.2, "entropy_coef": 0.0, "max_grad_norm": 1.0,
        "schedule": "adaptive",
    },
}  # fmt: skip


class Unit:
    """One virtual unit, once per payload and motion, behind the calls of AlignedSim; its sensors are all one sees."""

    def __init__(self, robot: RobotSpec, task: Task, name: str, payload_mass: Array) -> None:
        physics = load_fleet("default", robot).unit(name)
        payloads = [(float(mass), "both") for mass in payload_mass]
        self.robots = VirtualRobot(robot, [physics] * len(payloads), payloads, robot.dt, locked=task.locked, nthread=0)
        self.payload_mass, self.free, self.home = payload_mass, robot.index(task.joints), robot.qpos_home

    def reset(self, qpos: Array) -> None:
        self.robots.reset(self._full(qpos), list(range(len(qpos))), WARMTH)

    def step(self, ctrl: Array) -> None:
        self.robots.step(self._full(ctrl))

    def _full(self, values: Array) -> Array:
        out = np.tile(self.home, (len(values), 1))
        out[:, self.free] = values
        return out

    @property
    def qpos(self) -> Array:
        return self.robots.read().qpos[:, self.free]

    @property
    def qvel(self) -> Array:
        return self.robots.read().qvel[:, self.free]


def make_runner(env: TrackingEnv, start: OnPolicyRunner | None = None) -> OnPolicyRunner:
    """PPO on an environment, from scratch or from where another runner stands."""
    with contextlib.redirect_stdout(io.StringIO()):  # rsl_rl prints the networks
        runner = OnPolicyRunner(env, copy.deepcopy(PPO), log_dir=None, device="cpu")
    if start is not None:
        runner.alg.actor.load_state_dict(start.alg.actor.state_dict())
        runner.alg.critic.load_state_dict(start.alg.critic.state_dict())
        runner.alg.learning_rate = start.alg.learning_rate
    return runner


def train(name: str, runner: OnPolicyRunner, env: TrackingEnv, iterations: int) -> OnPolicyRunner:
    """Learn; the error it says is that of the policy as it explores."""
    start = time.perf_counter()
    for k in range(1, iterations + 1):
        runner.learn(1)
        if k % max(iterations // 5, 1) == 0 or k == 1:
            error, env.error = 1e3 * float(np.mean(env.error)), []
            std = float(runner.alg.actor.distribution.std_param.exp().mean()) if hasattr(runner.alg.actor.distribution, "std_param") else 0
            print(f"{name}: {k} of {iterations} updates, {time.perf_counter() - start:.0f} s, {error:.1f} mrad {std:.3f} {runner.alg.learning_rate:.1e}", flush=True)
    return runner


def follow(task: Task, plant: AlignedSim | Unit, policy: OnPolicyRunner | None) -> Array:
    """Mean |q − reference| of every simulation or unit, (N,) rad: one motion of the task each, in turn, to its end."""
    count = len(plant.payload_mass)
    motion = np.arange(count) % len(task.first)
    row, last, action = task.first[motion].copy(), task.last[motion], np.zeros((count, task.n))
    plant.reset(task.reference[row])
    actor = None if policy is None else policy.get_inference_policy()
    total, rows = np.zeros(count), np.zeros(count)
    for t in range(int((last - row).max())):
        if actor is not None:
            q, v = plant.qpos[:, task.op], plant.qvel[:, task.op]
            seen = torch.from_numpy(task.observe(q, v, row, last, plant.payload_mass, action))
            with torch.inference_mode():
                action = actor(TensorDict({"policy": seen}, batch_size=[count])).numpy().astype(float)
        plant.step(task.target(row, last, action))
        going = row < last
        row = np.minimum(row + 1, last)
        error = np.abs(plant.qpos - task.reference[row])[:, task.op].mean(axis=1)
        if t >= SKIP:
            total, rows = total + going * error, rows + going
    return total / rows


def motions(robot: RobotSpec, heaviest: float, seed: int, names: list[str]) -> list[Array]:
    """Upper-body motions that a seed makes, at the control period, (T, n) rad each."""
    library = Library(robot, seed, heaviest)
    return [library.make(name).sample(robot.dt) for name in names]


KINDS = ("reach", "pick_and_place", "lift", "wave", "stir", "mirror", "carry", "wander")


def main(
    run: tyro.conf.Positional[Path],
    nominal_updates: int = 150,
    updates: int = 100,
    num_envs: int = 256,
    seeds: int = 1,
    unit: str = "virtual-4",
) -> None:
    """Train, fine-tune, play on the unseen unit, and print mean |error| in mrad.

    Args:
        run: Folder of gaponet train (H1-2).
        nominal_updates: PPO updates in the nominal simulator.
        updates: Further updates, once in the aligned and once in the nominal simulator.
        num_envs: Simulations side by side.
        seeds: Trainings.
        unit: Of the default fleet.
    """
    torch.set_num_threads(1)
    begin = time.perf_counter()
    model = GapModel.load(run, threads=0)
    corrected = load_robot(run / "robot")
    robot = corrected.nominal or corrected
    heaviest = max(model.card["payload_seen"])
    train_names = [f"{kind}-{side}-{v}" for kind in KINDS for side, v in (("both", 0), ("both", 1), ("left", 0), ("right", 0))]
    task = Task(robot, motions(robot, heaviest, 101, train_names), heaviest)
    unseen = Task(robot, motions(robot, heaviest, 202, [f"{kind}-both-0" for kind in KINDS]), heaviest)
    print(f"{len(task.first)} motions to learn from, {len(unseen.first)} to try on, {time.perf_counter() - begin:.0f} s")
    mass = np.resize(np.linspace(0, heaviest, 4), num_envs)
    tried = np.repeat([0.0, heaviest], len(unseen.first))
    plants = {
        "nominal": AlignedSim(robot, None, tried, num_envs=len(tried), locked=task.locked),
        "aligned": AlignedSim(corrected, model, tried, num_envs=len(tried), locked=task.locked),
        unit: Unit(robot, unseen, unit, tried),
    }
    found = {}

    def judge(name, policy):
        e = {p: 1e3 * follow(unseen, plant, policy).reshape(2, -1).mean(axis=1) for p, plant in plants.items()}
        found[name] = e
        print(name, {p: np.round(x, 1).tolist() for p, x in e.items()}, flush=True)

    judge("no policy", None)
    for seed in range(seeds):
        torch.manual_seed(seed)
        nominal_sim = lambda: AlignedSim(robot, None, mass, num_envs=num_envs, locked=task.locked)
        aligned_sim = AlignedSim(corrected, model, mass, num_envs=num_envs, locked=task.locked)
        env = TrackingEnv(task, nominal_sim(), seed)
        first = train("nominal", make_runner(env), env, nominal_updates)
        judge("nominal", first)
        env = TrackingEnv(task, aligned_sim, seed + 100)
        judge("fine-tuned", train("aligned", make_runner(env, first), env, updates))
        env = TrackingEnv(task, nominal_sim(), seed + 100)
        judge("as long", train("nominal on", make_runner(env, first), env, updates))
    print(f"{time.perf_counter() - begin:.0f} s")


if __name__ == "__main__":
    tyro.cli(main)
