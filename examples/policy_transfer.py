"""Transfer of policies that were trained in the nominal simulator or in an identified one.

    pip install "rsl-rl-lib>=5.4.2,<6"
    python examples/policy_transfer.py WORK        # a VIRTUAL SO-101; minutes on two cores

A VIRTUAL robot plays excitation, and `gaponet identify` writes a robot folder from the recordings.
PPO trains a small network to follow motions in three simulators: the nominal one, the identified
one, and sixteen of the units that `gaponet export --to randomization` draws from its uncertainty
and chooses. All policies are tested on the VIRTUAL robot with other motions. Finally, `gaponet
replay` predicts the robot's motion under the targets of the nominal policy's own rollout.

The nominal policies are also played with `gp.Compensator(identified, follow="nominal")`, under
which the robot moves as the nominal simulator does, so that nothing is trained again. This is tried
where it should be difficult, too: with the identified robot of another unit, with commands that are
later by 40 ms, and with motors that are too weak.
"""

from __future__ import annotations

import contextlib
import io
import json
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
import tyro
from finetune_policy import Task, TrackingEnv, Unit, act, follow, make_runner, motions, train
from rsl_rl.runners import OnPolicyRunner

from gaponet.cli.main import main as gaponet
from gaponet.deploy.aligned_sim import AlignedSim, AlignedSimOptions
from gaponet.deploy.compensator import Compensator
from gaponet.export.drawn_robots import robots_of
from gaponet.robot.spec import RobotSpec, load_robot
from gaponet.virtual.fleet import load_fleet

Array = np.ndarray
# Different motions.
RECORDED_SEED = 0
LEARN_SEED = 101
TRY_SEED = 202
KINDS = ("tour", "limber")  # of motions
VARIANTS = 8
DRAWS = 16
NOMINAL = "nominal policy"
FOLLOWED = "nominal policy, follow"
IDENTIFIED = "policy trained in the identified simulator"
OTHER_UNIT = "virtual-2"
EXTRA_DELAY_S = 0.04
WEAK_TORQUE = 1.3  # N·m; at times the motions need more


class Several:
    """Simulations of several robots, equally many of each, with the methods of one AlignedSim."""

    def __init__(self, robots: list[RobotSpec], num_envs: int, locked: tuple[str, ...]) -> None:
        self.ids = np.array_split(np.arange(num_envs), len(robots))
        options = AlignedSimOptions(locked=locked)
        self.sims = []
        for robot, ids in zip(robots, self.ids, strict=True):
            self.sims.append(AlignedSim(robot, num_envs=len(ids), options=options))
        self.num_envs = num_envs
        self.dt = self.sims[0].dt
        self.payload_mass = np.zeros(num_envs)

    def reset(self, qpos: Array, qvel: Array | float = 0.0, ids: Array | None = None) -> None:
        """Reset the simulations `ids` to the rows of qpos and qvel."""
        ids = np.arange(self.num_envs) if ids is None else ids
        qvel = np.broadcast_to(qvel, qpos.shape)
        for sim, mine in zip(self.sims, self.ids, strict=True):
            at = np.isin(ids, mine)
            if at.any():
                sim.reset(qpos[at], qvel[at], ids=ids[at] - mine[0])

    def step(self, target: Array) -> None:
        """Step all simulations by one control period."""
        for sim, mine in zip(self.sims, self.ids, strict=True):
            sim.step(target[mine])

    @property
    def qpos(self) -> Array:
        """Positions, (num_envs, n) rad."""
        return np.concatenate([sim.qpos for sim in self.sims])

    @property
    def qvel(self) -> Array:
        """Velocities, (num_envs, n) rad/s."""
        return np.concatenate([sim.qvel for sim in self.sims])


@dataclass(frozen=True)
class Trial:
    """A VIRTUAL robot on which policies are tried."""

    name: str
    unit: str
    extra_delay: float = 0.0
    """s by which commands arrive later than they did when the robot was recorded."""
    torque: float | None = None
    """Torque limit of all motors, N·m; None: the robot's own."""


class Followed:
    """A unit that is commanded to move as the nominal simulator does, with the methods of Unit."""

    def __init__(self, plant: Unit, known: RobotSpec) -> None:
        self.plant = plant
        self.payload_mass = plant.payload_mass
        self.compensator = Compensator(known, num_envs=len(plant.payload_mass), follow="nominal")

    def reset(self, qpos: Array) -> None:
        """Put the units at rest."""
        self.plant.reset(qpos)
        self.compensator.reset(self.plant.all_joints(qpos), self.payload_mass)

    def step(self, target: Array) -> None:
        """Step all units by one control period."""
        measured = self.plant.all_joints(self.plant.qpos)
        commands = self.compensator.step(self.plant.all_joints(target), measured)
        self.plant.step(commands[:, self.plant.free])

    def observe(self) -> tuple[Array, Array]:
        """Return what the policy sees, (N, free) rad and rad/s."""
        measured = self.plant.all_joints(self.plant.qpos)
        positions, velocities = self.compensator.observe(measured)
        return positions[:, self.plant.free], velocities[:, self.plant.free]

    @property
    def qpos(self) -> Array:
        """Measured positions, rad."""
        return self.plant.qpos


def make_plant(trial: Trial, spec: RobotSpec, task: Task, fleet: str) -> Unit:
    """Return copies of a trial's unit, one per motion."""
    empty = np.zeros(len(task.first))
    physics = load_fleet(fleet, spec).unit(trial.unit)
    physics = replace(physics, delay=physics.delay + trial.extra_delay)
    plant = Unit(spec, task, physics, empty)
    if trial.torque is not None:
        limits = np.full(len(spec.joint_names), trial.torque)
        plant.robots.set_gains(spec.servo.kp, spec.servo.kd, limits)
    return plant


def identified(options: Options) -> Path:
    """Record the VIRTUAL unit and identify a robot folder; existing ones are kept."""
    work = options.work
    recipe = work / "recipe.toml"
    data = work / "data"
    known = work / "identified"
    work.mkdir(parents=True, exist_ok=True)
    names = ["*"]
    budget = ["--budget", "5m"]
    if options.quick:
        names = ["tour-all-0", "tour-all-1", "limber-all-0", "limber-all-1"]
        budget = ["--budget", "2s", "--terms", "--windows", "6"]
    kept = {
        "motions": names,
        "payloads": [0.0],
        "units": [options.unit],
        "rates": [50],
        "repetitions": 1,
        "variants": 3,
    }
    recipe.write_text("".join(f"{name} = {json.dumps(value)}\n" for name, value in kept.items()))
    who = ["--robot", options.robot, "--fleet", options.fleet, "--recipe", recipe]
    run("collect", "--out", data, *who, "--seed", RECORDED_SEED, "--nproc", 1)
    if not (known / "robot.toml").is_file():
        run("identify", data, "--out", known, *budget)
    return known


def run(*words: object) -> None:
    """Run a command of gaponet; end with it where it fails."""
    if gaponet(list(map(str, words))):
        raise SystemExit(2)


def drawn(known: Path, work: Path) -> list[RobotSpec]:
    """Return DRAWS of the units that gaponet exports for randomisation."""
    folder = work / "randomization"
    run("export", known, "--to", "randomization", "--out", folder)
    exported = json.loads((folder / "randomization.json").read_text(encoding="utf-8"))
    units = {field: np.array(rows)[:DRAWS] for field, rows in exported["units"].items()}
    return robots_of(load_robot(known), units)


def rollout(task: Task, robot: RobotSpec, policy: Any, file: Path) -> Array:
    """Simulate the first motion with the policy and write it as a log.

    Returns:
        Its targets, (T, free) rad.
    """
    sim = AlignedSim(robot, num_envs=1, options=AlignedSimOptions(locked=task.locked))
    actor = policy.get_inference_policy()
    row = task.first[:1].copy()
    last = task.last[:1]
    action = np.zeros((1, task.n))
    empty = np.zeros(1)
    sim.reset(task.reference[row])
    states = []
    targets = []
    while row[0] < last[0]:
        q = sim.qpos[:, task.op]
        v = sim.qvel[:, task.op]
        action = act(actor, task.observe(q, v, row, last, empty, action))
        target = task.target(row, last, action)
        targets.append(target[0])
        states.append(sim.qpos[0].copy())
        sim.step(target)
        row += 1
    np.savez(
        file,
        time=robot.dt * np.arange(len(targets)),
        target=np.array(targets),
        q=np.array(states),
        joint_names=np.array(task.joints),
    )
    file.with_name("logs.toml").write_text(
        'ctrl = "target"\nqpos = "q"\ntime_unit = "s"\nposition_unit = "rad"\n', encoding="utf-8"
    )
    return np.array(targets)


def forecast(work: Path, known: Path, task: Task, plant: Unit, targets: Array) -> str:
    """Compare the prediction of gaponet replay for WORK/rollout with the VIRTUAL robot.

    Args:
        targets: Of the rollout, (T, free) rad.
    """
    answer = work / "answer.npz"
    with contextlib.redirect_stdout(io.StringIO()) as out:
        run("replay", work / "rollout", "--robot", known, "--out", answer, "--json")
    said = json.loads(out.getvalue())
    held = np.load(answer)
    count = len(plant.payload_mass)
    plant.reset(np.tile(task.reference[task.first[0]], (count, 1)))
    found = []
    for target in targets:
        found.append(plant.qpos[0, task.op])
        plant.step(np.tile(target, (count, 1)))
    rows = min(len(found), len(held["low_0"]))
    real = np.array(found[:rows])
    apart = np.abs(real - held["rollout_0"][:rows])
    error = np.abs(real - held["robot_0"][:rows])
    inside = (real >= held["low_0"][:rows]) & (real <= held["high_0"][:rows])
    band = np.mean([joint["band"] for joint in said["joints"].values()])
    differ = "that no joint differs"
    if said["differ"]:
        differ = f"that joints differ: {', '.join(said['differ'])}"
    return (
        f"Under the nominal policy's targets the VIRTUAL robot is {1e3 * apart.mean():.1f} mrad "
        f"from the rollout; gaponet replay said so to {1e3 * error.mean():.1f} mrad, "
        f"{inside.mean():.0%} of the time within its band of ± {1e3 * band:.1f} mrad; of the "
        f"simulator it said {differ}."
    )


@dataclass(frozen=True)
class Robots:
    """The nominal robot, the identified one, and drawn units of the latter."""

    nominal: RobotSpec
    identified: RobotSpec
    units: list[RobotSpec]
    fleet: str
    unit: str


@dataclass(frozen=True)
class Options:
    """Record, identify, train and test on the VIRTUAL robot; print the mean |error| in mrad."""

    work: tyro.conf.Positional[Path]
    """Output folder."""
    robot: str = "so101"
    """Name or folder."""
    fleet: str = "hard"
    """Fleet of the VIRTUAL robot."""
    unit: str = "virtual-1"
    """Unit of the fleet."""
    updates: int = 150
    """Updates of PPO, 16 periods each."""
    num_envs: int = 128
    """Parallel simulations."""
    seeds: tuple[int, ...] = (0, 1, 2)
    """Seeds of training."""
    quick: bool = False
    """Test run with a few steps."""


def main(options: Options) -> None:
    """Record, identify, train and test."""
    torch.set_num_threads(1)
    variants = VARIANTS
    if options.quick:
        options = replace(options, updates=2, num_envs=16, seeds=(0,))
        variants = 1
    work = options.work
    known = identified(options)
    spec = load_robot(options.robot)
    robots = Robots(
        nominal=spec,
        identified=load_robot(known),
        units=drawn(known, work),
        fleet=options.fleet,
        unit=options.unit,
    )
    names = []
    for kind in KINDS:
        names += [f"{kind}-all-{variant}" for variant in range(variants)]
    task = Task(spec, motions(spec, 0.0, LEARN_SEED, names), 1.0)
    unseen = Task(spec, motions(spec, 0.0, TRY_SEED, names), 1.0)
    errors: dict[str, list[Array]] = {"reference as target": [try_alone(robots, unseen)]}
    tried: dict[str, dict[str, list[Array]]] = {}  # trial → way → errors of each seed
    rollout_targets = None
    for seed in options.seeds:
        for name in ("nominal", "identified", "identified + units"):
            policy = trained(name, robots, task, seed, options)
            errors.setdefault(name, []).append(try_at_home(name, policy, robots, unseen))
            if name != "identified + units":
                for trial in trials(options.unit):
                    ways = try_policy(name, policy, trial, robots, unseen)
                    for way, error in ways.items():
                        tried.setdefault(trial.name, {}).setdefault(way, []).append(error)
            if rollout_targets is None:  # of the first nominal policy
                (work / "rollout").mkdir(exist_ok=True)
                rollout_targets = rollout(unseen, spec, policy, work / "rollout" / "policy.npz")
    print(table(errors))
    print(trial_table(tried))
    plant = make_plant(Trial("", options.unit), spec, unseen, options.fleet)
    assert rollout_targets is not None
    print(forecast(work, known, unseen, plant, rollout_targets))


def trials(unit: str) -> tuple[Trial, ...]:
    """Return the VIRTUAL robots on which policies are tried."""
    return (
        Trial("the robot that was identified", unit),
        Trial(f"another unit, {OTHER_UNIT}", OTHER_UNIT),
        Trial(f"commands {1e3 * EXTRA_DELAY_S:.0f} ms later", unit, EXTRA_DELAY_S),
        Trial(f"motors of {WEAK_TORQUE:g} N·m", unit, torque=WEAK_TORQUE),
    )


def trained(name: str, robots: Robots, task: Task, seed: int, options: Options) -> OnPolicyRunner:
    """Train a policy in the nominal simulator, the identified one, or those of drawn units."""
    torch.manual_seed(seed)
    simulated = {
        "nominal": [robots.nominal],
        "identified": [robots.identified],
        "identified + units": robots.units,
    }
    sim = Several(simulated[name], options.num_envs, task.locked)
    env = TrackingEnv(task, sim, seed)  # type: ignore[arg-type]
    return train(name, make_runner(env), env, options.updates)


def try_at_home(name: str, policy: Any, robots: Robots, task: Task) -> Array:
    """Return the errors in the policy's own simulator and on the VIRTUAL robot, (2, motions)
    mrad.
    """
    own = robots.nominal if name == "nominal" else robots.identified
    return _errors(task, policy, own, robots)


def try_alone(robots: Robots, task: Task) -> Array:
    """Return the same without a policy, in the nominal simulator."""
    return _errors(task, None, robots.nominal, robots)


def _errors(task: Task, policy: Any, simulated: RobotSpec, robots: Robots) -> Array:
    sim = Several([simulated], len(task.first), task.locked)
    plant = make_plant(Trial("", robots.unit), robots.nominal, task, robots.fleet)
    own = follow(task, sim, policy)  # type: ignore[arg-type]
    return 1e3 * np.array([own, follow(task, plant, policy)])


def try_policy(
    name: str, policy: Any, trial: Trial, robots: Robots, task: Task
) -> dict[str, Array]:
    """Return the error of each motion, mrad, by the way in which the policy was used.

    Args:
        name: Where the policy was trained: "nominal" or "identified".
    """
    plant = make_plant(trial, robots.nominal, task, robots.fleet)
    if name != "nominal":
        return {IDENTIFIED: 1e3 * follow(task, plant, policy)}
    another = make_plant(trial, robots.nominal, task, robots.fleet)
    followed = Followed(another, robots.identified)
    errors = {NOMINAL: 1e3 * follow(task, plant, policy)}
    errors[FOLLOWED] = 1e3 * follow(task, followed, policy, Followed.observe)
    limited = followed.compensator.limited_shares
    if limited:
        shares = ", ".join(f"{joint} {share:.0%}" for joint, share in limited.items())
        print(f"{trial.name}: at a limit of torque or correction: {shares} of the time")
    return errors


def trial_table(errors: dict[str, dict[str, list[Array]]]) -> str:
    """Return a Markdown table: trials × ways, mean ± over seeds and the worst motion, mrad."""
    ways = (NOMINAL, FOLLOWED, IDENTIFIED)
    lines = [f"| VIRTUAL robot | {' | '.join(ways)} |", "| --- | ---: | ---: | ---: |"]
    for trial, by_way in errors.items():
        cells = []
        for way in ways:
            each = np.array(by_way[way])  # (seeds, motions)
            mean = each.mean(axis=1)
            cells.append(f"{mean.mean():.1f} ± {mean.std():.1f} ({each.max():.1f})")
        lines.append(f"| {trial} | {' | '.join(cells)} |")
    return "\n".join(lines)


def table(errors: dict[str, list[Array]]) -> str:
    """Return a Markdown table: mean over motions, ± over seeds, and differences to the nominal
    policy.

    These are paired over motions.
    """
    head = (
        "trained in",
        "in its own simulator, mrad",
        "on the VIRTUAL robot, mrad",
        "to nominal, paired over motions",
    )
    lines = [f"| {' | '.join(head)} |", "| --- | ---: | ---: | ---: |"]
    nominal = np.array(errors["nominal"])[:, 1].mean(axis=0)
    for name, runs in errors.items():
        each = np.array(runs)  # (seeds, 2, motions)
        mean = each.mean(axis=(0, 2))
        std = each.mean(axis=2).std(axis=0)
        cells = [f"{m:.1f} ± {s:.1f}" for m, s in zip(mean, std, strict=True)]
        apart = each[:, 1].mean(axis=0) - nominal
        error = apart.std(ddof=1) / np.sqrt(len(apart)) if len(apart) > 1 else np.nan
        cells.append(f"{apart.mean():+.1f} ± {error:.1f}")
        lines.append(f"| {name} | {' | '.join(cells)} |")
    return "\n".join(lines)


if __name__ == "__main__":
    main(tyro.cli(Options))
