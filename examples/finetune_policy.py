"""Fine-tune a policy in the aligned simulator, then test it on unseen robots, as ASAP does.

    pip install "rsl-rl-lib>=5.4.2,<6"
    gaponet demo
    python examples/finetune_policy.py demo_run/experiment/trainings/labels-GAPONet-0 \\
        --identified demo_run/experiment/identified

RUN is a run of gaponet train on VIRTUAL H1-2 units 1 to 3; gaponet demo makes one.

PPO trains a small network in the nominal simulator to follow arm motions with 0 to 3 kg in each
hand. Training then continues in the aligned simulator and, for comparison, equally long in the
nominal one and in that of an identified robot. All policies are tested on eight other VIRTUAL units
with other motions. Neither the gap model nor a policy was trained on these units.

The policy observes the measured state, the reference up to 0.2 s ahead, the payload, its last
action, and the torque of the reference by nominal inverse dynamics, divided by kp. Its output is
added to the reference. On the robot, the policy runs without the gap model.

Half of the simulations of training receive each target one control period later. Without this
(--no-late) a policy learns feedback that is too strong for the delay of a robot, and oscillates
there.
"""

from __future__ import annotations

import contextlib
import copy
import io
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
import tyro
from rsl_rl.env import VecEnv
from rsl_rl.runners import OnPolicyRunner
from tensordict import TensorDict

from gaponet.deploy.aligned_sim import AlignedSim, AlignedSimOptions
from gaponet.motion.library import Library
from gaponet.nn.artifact import GapModel
from gaponet.robot.spec import RobotSpec, load_robot
from gaponet.sim.dynamics import inverse_dynamics
from gaponet.sim.model import build_model, idle_joints
from gaponet.virtual.fleet import load_fleet, sample_unit
from gaponet.virtual.physics import Physics
from gaponet.virtual.virtual_robot import VirtualRobot

Array = np.ndarray

KINDS = ("reach", "pick_and_place", "lift", "wave", "stir", "mirror", "carry", "wander")
LEARN = [
    f"{kind}-{variant}" for kind in KINDS for variant in ("both-0", "both-1", "left-0", "right-0")
]
TRY = [f"{kind}-both-0" for kind in KINDS]
# Different motions; the package's recipes use seed 0.
LEARN_SEED = 101
TRY_SEED = 202
AHEAD = (2, 3, 5, 8, 11)  # observed rows of the reference, beside the next one
REACH_RAD = 0.1  # effect of an action of 1
LIMIT_RAD = 0.4  # largest effect of an action
POSITION_NOISE = 0.0005  # rad, of observations in training
VELOCITY_NOISE = 0.02  # rad/s
EPISODE = 200  # control periods
WARMTH = 12.0  # K above ambient, of the motors
NUM_ENVS = 256  # simulations side by side
UNSEEN_UNITS = range(4, 12)  # numbers of the units of the test
OSCILLATION_HZ = 3.0  # faster errors count as oscillation
SKIP = 50  # control periods at the start of a motion without effect on the score

PPO: dict[str, Any] = {
    "num_steps_per_env": 16,
    "save_interval": 10**9,
    "obs_groups": {"actor": ["policy"], "critic": ["policy"]},
    "actor": {
        "class_name": "MLPModel",
        "hidden_dims": [128, 128],
        "activation": "elu",
        "distribution_cfg": {
            "class_name": "GaussianDistribution",
            "init_std": 0.2,
            "std_type": "log",
        },
    },
    "critic": {"class_name": "MLPModel", "hidden_dims": [128, 128], "activation": "elu"},
    "algorithm": {
        "class_name": "PPO",
        "num_learning_epochs": 4,
        "num_mini_batches": 4,
        "learning_rate": 1e-3,
        "desired_kl": 0.02,
        "gamma": 0.9,
        "lam": 0.9,
        "clip_param": 0.2,
        "entropy_coef": 0.0,
        "max_grad_norm": 1.0,
        "schedule": "adaptive",
    },
}


class Task:
    """Motions to follow and their observations; the rows of all motions are concatenated.

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
        free = robot.index(self.joints)
        operated = robot.operated_index
        self.op = np.searchsorted(free, operated)
        self.reference = np.concatenate(ctrls)[:, free]
        self.last = np.cumsum([len(c) for c in ctrls]) - 1
        self.first = np.append(0, self.last[:-1] + 1)
        self.heaviest = heaviest
        self.n = len(operated)
        loads = []
        for mass in (0.0, heaviest):
            model = build_model(robot, mass)
            torques = []
            for ctrl in ctrls:
                velocity = np.gradient(ctrl, robot.dt, axis=0)
                acceleration = np.gradient(velocity, robot.dt, axis=0)
                torque = inverse_dynamics(model, ctrl, velocity, acceleration)
                # The servo damps its own motion.
                torques.append(torque + robot.servo.kd * velocity)
            loads.append((np.concatenate(torques) / robot.servo.kp)[:, operated])
        self.load = np.array(loads)

    def observe(
        self, q: Array, v: Array, row: Array, last: Array, mass: Array, action: Array
    ) -> Array:
        """Return the observation, (N, 5 n + n len(AHEAD) + 1) float32.

        Args:
            q, v: Measured state of the operated joints, (N, n) rad, rad/s.
            row, last: Present and last row of the motion, (N,).
            mass: Payload, kg, (N,).
            action: Last action, (N, n).
        """
        at = np.minimum(row + 1, last)
        then = self.reference[at][:, self.op]
        ahead = [self.reference[np.minimum(row + k, last)][:, self.op] - then for k in AHEAD]
        share = (mass / self.heaviest)[:, None]
        load = (1 - share) * self.load[0, at] + share * self.load[1, at]
        parts = [
            then,
            (q - then) / REACH_RAD,
            0.3 * v,
            load / REACH_RAD,
            action,
            share,
            *[way / REACH_RAD for way in ahead],
        ]
        return np.concatenate(parts, axis=1).astype(np.float32)

    def target(self, row: Array, last: Array, action: Array) -> Array:
        """Return the next row of the reference plus the action on operated joints, (N, free)
        rad.
        """
        out = self.reference[np.minimum(row + 1, last)]
        out[:, self.op] += np.clip(REACH_RAD * action, -LIMIT_RAD, LIMIT_RAD)
        return out


class TrackingEnv(VecEnv):
    """Environment of rsl_rl: simulations that follow motions from a random row on."""

    def __init__(self, task: Task, sim: AlignedSim, seed: int, late: Array | None = None) -> None:
        """late: Simulations that receive each target one control period later, (num_envs,) bool;
        default none.
        """
        self.task = task
        self.sim = sim
        self.rng = np.random.default_rng(seed)
        self.cfg: dict[str, Any] = {}
        self.device = "cpu"
        self.num_envs = sim.num_envs
        self.num_actions = task.n
        self.max_episode_length = EPISODE
        self.episode_length_buf = torch.zeros(sim.num_envs, dtype=torch.long)
        self.row = np.zeros(sim.num_envs, int)
        self.last = np.zeros(sim.num_envs, int)
        self.action = np.zeros((sim.num_envs, task.n))
        self.late = np.zeros(sim.num_envs, bool) if late is None else late
        self.last_target = np.zeros((sim.num_envs, len(task.joints)))  # rad
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
        self.last_target[ids] = reference[self.row[ids]]
        self.episode_length_buf[torch.from_numpy(ids)] = 0

    def get_observations(self) -> TensorDict:
        """Observe the state with noise."""
        shape = (self.num_envs, self.task.n)
        q = self.sim.qpos[:, self.task.op] + POSITION_NOISE * self.rng.standard_normal(shape)
        v = self.sim.qvel[:, self.task.op] + VELOCITY_NOISE * self.rng.standard_normal(shape)
        seen = self.task.observe(q, v, self.row, self.last, self.sim.payload_mass, self.action)
        return TensorDict({"policy": torch.from_numpy(seen)}, batch_size=[self.num_envs])

    def step(
        self, actions: torch.Tensor
    ) -> tuple[TensorDict, torch.Tensor, torch.Tensor, dict[str, Any]]:
        """Step all simulations.

        The reward is minus the mean error in units of 20 mrad, minus a penalty for changes of the
        action.
        """
        action = actions.numpy().astype(float)
        target = self.task.target(self.row, self.last, action)
        self.sim.step(np.where(self.late[:, None], self.last_target, target))
        self.last_target = target
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


class Unit:
    """Copies of a virtual unit, one per payload and motion, with the methods of AlignedSim.

    Its positions and velocities are sensor readings.
    """

    def __init__(self, robot: RobotSpec, task: Task, physics: Physics, payload_mass: Array) -> None:
        payloads = [(float(mass), "both") for mass in payload_mass]
        self.robots = VirtualRobot(
            robot, [physics] * len(payloads), payloads, robot.dt, locked=task.locked, nthread=0
        )
        self.payload_mass = payload_mass
        self.free = robot.index(task.joints)
        self.home = robot.qpos_home

    def reset(self, qpos: Array) -> None:
        self.robots.reset(self.all_joints(qpos), list(range(len(qpos))), WARMTH)

    def step(self, ctrl: Array) -> None:
        self.robots.step(self.all_joints(ctrl))

    def all_joints(self, values: Array) -> Array:
        """Return values of the free joints with those of home for the others, (N, n) rad."""
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
    """Create PPO on an environment, from scratch or with the state of another runner."""
    with contextlib.redirect_stdout(io.StringIO()):  # rsl_rl prints the networks
        runner = OnPolicyRunner(env, copy.deepcopy(PPO), log_dir=None, device="cpu")
    if start is not None:
        runner.alg.actor.load_state_dict(start.alg.actor.state_dict())
        runner.alg.critic.load_state_dict(start.alg.critic.state_dict())
        runner.alg.learning_rate = start.alg.learning_rate
    return runner


def train(name: str, runner: OnPolicyRunner, env: TrackingEnv, updates: int) -> OnPolicyRunner:
    """Train and print the error of the exploring policy."""
    start = time.perf_counter()
    for k in range(1, updates + 1):
        runner.learn(1)
        if k % max(updates // 4, 1) == 0:
            error = 1e3 * float(np.mean(env.error))
            env.error = []
            seconds = time.perf_counter() - start
            line = f"{name}: {k} of {updates} updates, {seconds:.0f} s, {error:.1f} mrad"
            print(line, file=sys.stderr, flush=True)
    return runner


def measured(plant: Any) -> tuple[Array, Array]:
    """Return measured positions and velocities of simulations, (N, free) rad and rad/s."""
    return plant.qpos, plant.qvel


def follow(
    task: Task,
    plant: AlignedSim | Unit,
    policy: OnPolicyRunner | None,
    observe: Callable[[Any], tuple[Array, Array]] = measured,
) -> Array:
    """Return the mean |q − reference| of every simulation or unit, (N,) rad.

    Each plays one motion to its end.
    """
    return mean_size(play(task, plant, policy, observe))


def play(
    task: Task,
    plant: AlignedSim | Unit,
    policy: OnPolicyRunner | None,
    observe: Callable[[Any], tuple[Array, Array]] = measured,
) -> Array:
    """Return q − reference of every simulation or unit, (rows, N, n) rad; NaN after its motion.

    Args:
        observe: Returns the positions and velocities of `plant` that the policy sees, (N, free) rad
            and rad/s.
    """
    count = len(plant.payload_mass)
    motion = np.arange(count) % len(task.first)
    row = task.first[motion].copy()
    last = task.last[motion]
    action = np.zeros((count, task.n))
    plant.reset(task.reference[row])
    actor = None if policy is None else policy.get_inference_policy()
    errors = np.full((int((last - row).max()), count, task.n), np.nan)
    for t in range(len(errors)):
        if actor is not None:
            q, v = observe(plant)
            seen = task.observe(q[:, task.op], v[:, task.op], row, last, plant.payload_mass, action)
            action = act(actor, seen)
        plant.step(task.target(row, last, action))
        going = row < last
        row = np.minimum(row + 1, last)
        error = (plant.qpos - task.reference[row])[:, task.op]
        errors[t, going] = error[going]
    return errors


def mean_size(errors: Array) -> Array:
    """Return the mean |error| of every simulation or unit, (N,) rad; of play()."""
    size: Array = np.nanmean(np.abs(errors[SKIP:]), axis=(0, 2))
    return size


def oscillating_share(errors: Array, dt: float) -> Array:
    """Return the share of the squared error that is faster than OSCILLATION_HZ, (N,); of play().

    Motions of arms are slower than that, and so are the errors of a policy that follows them.
    """
    shares = []
    for error in errors[SKIP:].transpose(1, 0, 2):  # (rows, n) of one simulation
        whole = error[~np.isnan(error[:, 0])]
        power = np.square(np.abs(np.fft.rfft(whole - whole.mean(axis=0), axis=0))).sum(axis=1)
        fast = np.fft.rfftfreq(len(whole), dt) > OSCILLATION_HZ
        shares.append(power[fast].sum() / power.sum())
    return np.array(shares)


def act(actor: Any, seen: Array) -> Array:
    """Return a policy's actions, (N, n), for observations (N, dim)."""
    observation = TensorDict({"policy": torch.from_numpy(seen)}, batch_size=[len(seen)])
    with torch.inference_mode():
        actions: Array = actor(observation).numpy().astype(float)
    return actions


def motions(robot: RobotSpec, heaviest: float, seed: int, names: list[str]) -> list[Array]:
    """Generate upper-body motions from a seed, at the control period, (T, n) rad each."""
    library = Library(robot, seed, heaviest)
    return [library.make(name).sample(robot.dt) for name in names]


@dataclass(frozen=True)
class Options:
    """Options of the command line."""

    run: tyro.conf.Positional[Path]
    """Folder of gaponet train, H1-2."""
    first: int = 150
    """PPO updates in the nominal simulator."""
    more: int = 80
    """Further updates, in the nominal, the aligned and the identified simulator each."""
    seeds: tuple[int, ...] = (0,)
    """Seeds of training."""
    identified: Path | None = None
    """Folder of gaponet identify; without it, nothing is trained in its simulator."""
    fleet: str = "firm"
    """VIRTUAL fleet of whose units 1 to 3 RUN was trained."""
    late: bool = True
    """Half of the simulations of training receive each target one control period later."""
    opposite: bool = False
    """A control: the corrections of the model have the wrong sign."""
    quick: bool = False
    """Test run with a few steps."""

    @property
    def num_envs(self) -> int:
        return 16 if self.quick else NUM_ENVS

    @property
    def updates(self) -> tuple[int, int]:
        """First and further updates."""
        return (2, 1) if self.quick else (self.first, self.more)

    @property
    def names(self) -> tuple[list[str], list[str]]:
        """Motions to learn from and to try."""
        return (LEARN[:2], TRY[:2]) if self.quick else (LEARN, TRY)


class Experiment:
    """Simulators, motions and unseen units.

    Attributes:
        simulators: Name → robot, and the model that corrects it.
        task, unseen: Motions to learn from, and to try.
        heaviest: Largest payload, kg.
        dt: Control period, s.
        plants: What policies are tried on: the simulators and then the units; each plays every
            motion with an empty hand and with the largest payload.
    """

    def __init__(self, options: Options) -> None:
        model = GapModel.load(options.run, threads=0)
        if options.opposite:
            infer = model.infer
            model = replace(model, infer=lambda inputs: -np.asarray(infer(inputs)))
        # The simulator that the model corrects: nominal, or identified.
        corrected = load_robot(options.run / "robot")
        robot = corrected.nominal or corrected
        self.simulators: dict[str, tuple[RobotSpec, GapModel | None]] = {
            "nominal": (robot, None),
            "aligned": (corrected, model),
        }
        if options.identified is not None:
            self.simulators["identified"] = (load_robot(options.identified), None)
        heaviest = float(max(model.card["payload_seen"])) or model.config.payload_max
        learn, attempt = options.names
        self.task = Task(robot, motions(robot, heaviest, LEARN_SEED, learn), heaviest)
        self.unseen = Task(robot, motions(robot, heaviest, TRY_SEED, attempt), heaviest)
        self.heaviest = heaviest
        self.dt = robot.dt
        masses = np.linspace(0, heaviest, 4)
        self.mass = np.resize(masses, options.num_envs)
        # Each payload is late in half of its simulations.
        turn = np.arange(options.num_envs) // len(masses)
        self.late = (turn % 2 == 1) & options.late
        tried = np.repeat([0.0, heaviest], len(self.unseen.first))
        self.plants: list[AlignedSim | Unit] = [self.simulator(of, tried) for of in self.simulators]
        fleet = load_fleet(options.fleet, robot)
        for number in UNSEEN_UNITS:
            physics = sample_unit(robot, fleet.distributions, fleet.seed, number)
            self.plants.append(Unit(robot, self.unseen, physics, tried))

    def simulator(self, of: str, payload_mass: Array) -> AlignedSim:
        """Return simulations of the nominal robot, the aligned or the identified one."""
        spec, corrector = self.simulators[of]
        options = AlignedSimOptions(locked=self.task.locked)
        count = len(payload_mass)
        return AlignedSim(spec, corrector, payload_mass, num_envs=count, options=options)

    def environment(self, of: str, seed: int) -> TrackingEnv:
        return TrackingEnv(self.task, self.simulator(of, self.mass), seed, self.late)

    def measure(self, policy: OnPolicyRunner | None) -> Array:
        """Return what a policy reaches on all plants, (plants, 2 quantities, 2 payloads): the error
        in mrad, and the share of its square that is an oscillation, in per cent.
        """
        rows = []
        for plant in self.plants:
            errors = play(self.unseen, plant, policy)
            quantities = (1e3 * mean_size(errors), 100 * oscillating_share(errors, self.dt))
            rows.append([of_all.reshape(2, -1).mean(axis=1) for of_all in quantities])
        return np.array(rows)


def main(options: Options) -> None:
    """Train, fine-tune and test on unseen units; print the mean |error| in mrad."""
    begin = time.perf_counter()
    torch.set_num_threads(1)  # the simulators take the other cores
    experiment = Experiment(options)
    first, more = options.updates
    print(
        f"{len(experiment.task.first)} motions to learn from, {len(experiment.unseen.first)} to "
        f"try on {len(UNSEEN_UNITS)} unseen units; {time.perf_counter() - begin:.0f} s"
    )
    results: dict[str, list[Array]] = {"reference as target": [experiment.measure(None)]}
    for seed in options.seeds:
        torch.manual_seed(seed)
        nominal = experiment.environment("nominal", seed)
        policy = train("nominal", make_runner(nominal), nominal, first)
        results.setdefault("before fine-tuning", []).append(experiment.measure(policy))
        nominal.error = []
        for of in experiment.simulators:
            there = nominal if of == "nominal" else experiment.environment(of, seed)
            tuned = train(f"{of}, fine-tuning", make_runner(there, policy), there, more)
            results.setdefault(f"fine-tuned in {of}", []).append(experiment.measure(tuned))
    stacked = {name: np.array(errors) for name, errors in results.items()}
    print(simulator_table(stacked, list(experiment.simulators), experiment.heaviest))
    print(unit_table(stacked, len(experiment.simulators), experiment.heaviest))
    print(f"{time.perf_counter() - begin:.0f} s in all")


def simulator_table(results: dict[str, Array], simulators: list[str], heaviest: float) -> str:
    """Return a Markdown table of the errors in simulators, mrad.

    Args:
        results: Policy → measure() of each seed, simulators first.
    """
    columns = []
    for of in simulators:
        columns += [f"{of} simulator, 0 kg", f"{of} simulator, {heaviest:g} kg"]
    lines = [f"| mean abs error, mrad | {' | '.join(columns)} |"]
    lines.append("| --- |" + " ---: |" * len(columns))
    for name, errors in results.items():
        of_seeds = errors[:, : len(simulators), 0].reshape(len(errors), -1)
        cells = [spread(column) for column in of_seeds.T]
        lines.append(f"| {name} | {' | '.join(cells)} |")
    return "\n".join(lines)


def unit_table(results: dict[str, Array], first_unit: int, heaviest: float) -> str:
    """Return a Markdown table of the errors on the unseen units, mrad.

    The differences are to the policy fine-tuned in the nominal simulator, in per cent, paired over
    units; ± is the standard error over units. The last columns have the share of the squared error
    that is an oscillation.

    Args:
        results: Policy → measure() of each seed; the units begin with plant `first_unit`.
    """
    loads = ("0 kg", f"{heaviest:g} kg")
    columns = [f"VIRTUAL units, {load}" for load in loads]
    columns += [f"worst unit, {load}" for load in loads]
    columns += [f"to nominal, {load}, %" for load in loads]
    columns += [f"above {OSCILLATION_HZ:g} Hz, {load}, %" for load in loads]
    lines = [f"| mean abs error, mrad | {' | '.join(columns)} |"]
    lines.append("| --- |" + " ---: |" * len(columns))
    nominal = results["fine-tuned in nominal"][:, first_unit:, 0].mean(axis=0)  # (units, 2)
    for name, measured_values in results.items():
        of_units = measured_values[:, first_unit:, 0]  # (seeds, units, 2)
        shares = measured_values[:, first_unit:, 1].mean(axis=1)  # (seeds, 2)
        cells = [spread(column) for column in of_units.mean(axis=1).T]
        cells += [spread(column) for column in of_units.max(axis=1).T]
        change = 100 * (of_units.mean(axis=0) / nominal - 1)
        error = change.std(axis=0, ddof=1) / np.sqrt(len(change))
        for mean, standard_error in zip(change.mean(axis=0), error, strict=True):
            cells.append(f"{mean:+.0f} ± {standard_error:.0f}")
        cells += [f"{share:.0f}" for share in shares.mean(axis=0)]
        lines.append(f"| {name} | {' | '.join(cells)} |")
    return "\n".join(lines)


def spread(values: Array) -> str:
    """Return the mean over seeds, and ± the standard deviation if there are several; (seeds,)."""
    if len(values) == 1:
        return f"{values[0]:.1f}"
    return f"{values.mean():.1f} ± {values.std():.1f}"


if __name__ == "__main__":
    main(tyro.cli(Options, description=__doc__))
