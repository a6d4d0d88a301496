"""Transfer of a policy trained in the nominal simulator, the identified one, and the identified one
with drawn units.

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
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
import tyro
from finetune_policy import Task, TrackingEnv, Unit, follow, make_runner, motions, train
from tensordict import TensorDict

from gaponet.cli.main import main as gaponet
from gaponet.deploy.aligned_sim import AlignedSim, AlignedSimOptions
from gaponet.deploy.compensator import Compensator
from gaponet.export.drawn_robots import robots_of
from gaponet.robot.spec import RobotSpec, load_robot

Array = np.ndarray
RECORDED_SEED, LEARN_SEED, TRY_SEED = 0, 101, 202  # different motions
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
        self.sims = [
            AlignedSim(robot, num_envs=len(ids), options=options)
            for robot, ids in zip(robots, self.ids, strict=True)
        ]
        self.num_envs, self.dt, self.payload_mass = num_envs, self.sims[0].dt, np.zeros(num_envs)

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
        self.plant, self.payload_mass = plant, plant.payload_mass
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
        state = self.compensator.observe(self.plant.all_joints(self.plant.qpos))
        positions, velocities = (values[:, self.plant.free] for values in state)
        return positions, velocities

    @property
    def qpos(self) -> Array:
        """Measured positions, rad."""
        return self.plant.qpos


def make_plant(trial: Trial, spec: RobotSpec, task: Task, fleet: str) -> Unit:
    """Return copies of a trial's unit, one per motion."""
    empty = np.zeros(len(task.first))
    plant = Unit(spec, task, trial.unit, empty, fleet, trial.extra_delay)
    if trial.torque is not None:
        limits = np.full(len(spec.joint_names), trial.torque)
        plant.robots.set_gains(spec.servo.kp, spec.servo.kd, limits)
    return plant


def identified(work: Path, robot: str, fleet: str, unit: str, quick: bool) -> Path:
    """Record the VIRTUAL unit and identify a robot folder; existing ones are kept."""
    recipe, data, known = work / "recipe.toml", work / "data", work / "identified"
    work.mkdir(parents=True, exist_ok=True)
    names = ["tour-all-0", "tour-all-1", "limber-all-0", "limber-all-1"] if quick else ["*"]
    kept = {
        "motions": names,
        "payloads": [0.0],
        "units": [unit],
        "rates": [50],
        "repetitions": 1,
        "variants": 3,
    }
    recipe.write_text("".join(f"{name} = {json.dumps(value)}\n" for name, value in kept.items()))
    said = [
        "--robot",
        robot,
        "--fleet",
        fleet,
        "--recipe",
        str(recipe),
        "--seed",
        str(RECORDED_SEED),
        "--nproc",
        "1",
    ]
    if gaponet(["collect", "--out", str(data), *said]):
        raise SystemExit(2)
    budget = ["--budget", "2s", "--terms", "--windows", "6"] if quick else ["--budget", "5m"]
    if not (known / "robot.toml").is_file() and gaponet(
        ["identify", str(data), "--out", str(known), *budget]
    ):
        raise SystemExit(2)
    return known


def drawn(known: Path, work: Path) -> list[RobotSpec]:
    """Return DRAWS of the units that gaponet exports for randomisation."""
    if gaponet(
        ["export", str(known), "--to", "randomization", "--out", str(work / "randomization")]
    ):
        raise SystemExit(2)
    units = json.loads((work / "randomization" / "randomization.json").read_text(encoding="utf-8"))[
        "units"
    ]
    return robots_of(
        load_robot(known), {field: np.array(rows)[:DRAWS] for field, rows in units.items()}
    )


def rollout(task: Task, robot: RobotSpec, policy: Any, file: Path) -> Array:
    """Simulate the first motion with the policy and write it as a log; returns its targets, (T,
    free) rad.
    """
    sim = AlignedSim(robot, num_envs=1, options=AlignedSimOptions(locked=task.locked))
    actor = policy.get_inference_policy()
    row, last, action = task.first[:1].copy(), task.last[:1], np.zeros((1, task.n))
    sim.reset(task.reference[row])
    states, targets = [], []
    while row[0] < last[0]:
        seen = task.observe(
            sim.qpos[:, task.op], sim.qvel[:, task.op], row, last, np.zeros(1), action
        )
        with torch.inference_mode():
            action = (
                actor(TensorDict({"policy": torch.from_numpy(seen)}, batch_size=[1]))
                .numpy()
                .astype(float)
            )
        targets.append(task.target(row, last, action)[0])
        states.append(sim.qpos[0].copy())
        sim.step(targets[-1][None])
        row += 1
    time, names = robot.dt * np.arange(len(targets)), np.array(task.joints)
    np.savez(file, time=time, target=np.array(targets), q=np.array(states), joint_names=names)
    file.with_name("logs.toml").write_text(
        'ctrl = "target"\nqpos = "q"\ntime_unit = "s"\nposition_unit = "rad"\n', encoding="utf-8"
    )
    return np.array(targets)


def forecast(work: Path, known: Path, task: Task, plant: Unit, targets: Array) -> str:
    """Compare the prediction of gaponet replay for WORK/rollout with the VIRTUAL robot under the
    same targets.
    """
    answer = work / "answer.npz"
    asked = ["replay", str(work / "rollout"), "--robot", str(known), "--out", str(answer), "--json"]
    with contextlib.redirect_stdout(out := io.StringIO()):
        if gaponet(asked):
            raise SystemExit(2)
    said, held = json.loads(out.getvalue()), np.load(answer)
    plant.reset(np.tile(task.reference[task.first[0]], (len(plant.payload_mass), 1)))
    found = []
    for target in targets:
        found.append(plant.qpos[0, task.op])
        plant.step(np.tile(target, (len(plant.payload_mass), 1)))
    real, low, high = np.array(found), held["low_0"], held["high_0"]
    rows = min(len(real), len(low))
    real, error = real[:rows], np.abs(real[:rows] - held["robot_0"][:rows])
    apart = np.abs(real - held["rollout_0"][:rows])
    inside = ((real >= low[:rows]) & (real <= high[:rows])).mean()
    return (
        f"Under the nominal policy's targets the VIRTUAL robot is {1e3 * apart.mean():.1f} mrad from the rollout; "
        f"gaponet replay said so to {1e3 * error.mean():.1f} mrad, {inside:.0%} of the time within its band of "
        f"± {1e3 * np.mean([s['band'] for s in said['joints'].values()]):.1f} mrad; of the simulator it said "
        f"{'that joints differ: ' + ', '.join(said['differ']) if said['differ'] else 'that no joint differs'}."
    )


def main(
    work: tyro.conf.Positional[Path],
    robot: str = "so101",
    fleet: str = "hard",
    unit: str = "virtual-1",
    updates: int = 150,
    num_envs: int = 128,
    seeds: tuple[int, ...] = (0, 1, 2),
    quick: bool = False,
) -> None:
    """Record, identify, train and test on the VIRTUAL robot; print the mean |error| to the
    reference in mrad.

    Args:
        work: Output folder.
        robot: Name or folder.
        fleet: Fleet of the VIRTUAL robot.
        unit: Unit of the fleet.
        updates: Updates of PPO, 16 periods each.
        num_envs: Parallel simulations.
        seeds: Seeds of training.
        quick: Test run with a few steps.
    """
    torch.set_num_threads(1)
    updates, num_envs, seeds = (2, 16, (0,)) if quick else (updates, num_envs, seeds)
    known = identified(work, robot, fleet, unit, quick)
    spec, found = load_robot(robot), load_robot(known)
    kinds = ("tour", "limber")
    names = [f"{kind}-all-{v}" for kind in kinds for v in range(1 if quick else 8)]
    task, unseen = (
        Task(spec, motions(spec, 0.0, seed, names), 1.0) for seed in (LEARN_SEED, TRY_SEED)
    )
    tried = np.zeros(len(unseen.first))
    robots = {
        "nominal": [spec], "identified": [found], "identified + units": drawn(known, work),
    }  # fmt: skip
    trials = (
        Trial("the robot that was identified", unit),
        Trial(f"another unit, {OTHER_UNIT}", OTHER_UNIT),
        Trial(f"commands {1e3 * EXTRA_DELAY_S:.0f} ms later", unit, EXTRA_DELAY_S),
        Trial(f"motors of {WEAK_TORQUE:g} N·m", unit, torque=WEAK_TORQUE),
    )
    errors: dict[str, list[Array]] = {}
    tried_on: dict[str, dict[str, list[Array]]] = {}  # trial → way → errors of each seed
    for seed in seeds:
        for name, mine in robots.items():
            torch.manual_seed(seed)
            env = TrackingEnv(task, Several(mine, num_envs, task.locked), seed)  # type: ignore[arg-type]
            policy = train(name, make_runner(env), env, updates)
            own = Several(mine if len(mine) == 1 else [found], len(tried), unseen.locked)
            plants = [own, Unit(spec, unseen, unit, tried, fleet)]
            errors.setdefault(name, []).append(
                1e3 * np.array([follow(unseen, p, policy) for p in plants])
            )
            if len(mine) == 1:
                for trial in trials:
                    ways = try_policy(name, policy, trial, (spec, found), unseen, fleet)
                    for way, error in ways.items():
                        tried_on.setdefault(trial.name, {}).setdefault(way, []).append(error)
            if name == "nominal" and seed == seeds[0]:
                (work / "rollout").mkdir(exist_ok=True)
                targets = rollout(unseen, spec, policy, work / "rollout" / "policy.npz")
    alone = np.array([follow(unseen, p, None) for p in (Several([spec], len(tried), unseen.locked),
                                                        Unit(spec, unseen, unit, tried, fleet))])  # fmt: skip
    print(table({"reference as target": [1e3 * alone]} | errors))
    print(trial_table(tried_on))
    print(forecast(work, known, unseen, Unit(spec, unseen, unit, tried, fleet), targets))


def try_policy(
    name: str,
    policy: Any,
    trial: Trial,
    robots: tuple[RobotSpec, RobotSpec],
    task: Task,
    fleet: str,
) -> dict[str, Array]:
    """Return the error of each motion, mrad, by the way in which the policy was used.

    Args:
        name: Where the policy was trained: "nominal" or "identified".
        robots: The nominal robot and the identified one.
    """
    spec, found = robots
    plant = make_plant(trial, spec, task, fleet)
    if name != "nominal":
        return {IDENTIFIED: 1e3 * follow(task, plant, policy)}
    followed = Followed(make_plant(trial, spec, task, fleet), found)
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
    """Return a Markdown table: mean over motions, ± over seeds, and the paired difference to the
    nominal policy.
    """
    head = "| trained in | in its own simulator, mrad | on the VIRTUAL robot, mrad | to nominal, paired over motions |"
    lines = [head, "| --- | ---: | ---: | ---: |"]
    for name, runs in errors.items():
        each = np.array(runs)  # (seeds, 2, motions)
        cells = [
            f"{m:.1f} ± {s:.1f}"
            for m, s in zip(each.mean(axis=(0, 2)), each.mean(axis=2).std(axis=0), strict=True)
        ]
        apart = each[:, 1].mean(axis=0) - np.array(errors["nominal"])[:, 1].mean(axis=0)
        error = apart.std(ddof=1) / np.sqrt(len(apart)) if len(apart) > 1 else np.nan
        lines.append(f"| {name} | {cells[0]} | {cells[1]} | {apart.mean():+.1f} ± {error:.1f} |")
    return "\n".join(lines)


if __name__ == "__main__":
    tyro.cli(main)
