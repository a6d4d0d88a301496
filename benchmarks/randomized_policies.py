"""Do ranges of what is known train a better policy? Learnt in seven sets of robots, played on VIRTUAL units never seen.

    python benchmarks/randomized_policies.py WORK [--quick]    saves each training; the same command goes on

Four units of a VIRTUAL fleet (hard) are recorded and identified, each from its own logs; twelve others are never
recorded. A network learns by PPO (rsl_rl) to make the arm follow motions (examples/policy_transfer.py), with as many
updates everywhere. Success is a motion with a mean |error| below 10 mrad, set before anything was played.
"""

from __future__ import annotations

import json
import sys
import time
from pathlib import Path

import numpy as np
import torch
import tyro

sys.path.insert(0, str(Path(__file__).parents[1] / "examples"))
from finetune_policy import Task, TrackingEnv, Unit, follow, make_runner, motions, train
from policy_transfer import LEARN_SEED, TRY_SEED, Several

from gaponet.cli.main import main as gaponet
from gaponet.export import ranges as drawing
from gaponet.export.ranges import ranges
from gaponet.robot.spec import RobotSpec, load_robot
from gaponet.sysid.axes import first_values
from gaponet.testing.fleet import draw, load_fleet
from gaponet.testing.unit import VirtualRobot

KNOWN, UNSEEN, DRAWS, GOOD = 4, 12, 16, 0.01  # units, units, robots to learn in, rad
WIDE = {"kp": (0.7, 1.3), "damping": (0.5, 2.0), "frictionloss": (0.5, 2.0), "armature": (0.5, 2.0)}  # of nominal
LATE, TURNED = 0.04, 0.02  # s, rad: of the hand-made ranges too


class Units(Unit):
    """Several units, each on every motion, behind the calls of one."""

    def __init__(self, robot: RobotSpec, task: Task, units: list[int], fleet: str) -> None:
        drawn = load_fleet(fleet, robot)
        physics = [draw(robot, drawn.distributions, drawn.seed, k) for k in units for _ in task.first]
        self.payload_mass, self.free, self.home = np.zeros(len(physics)), robot.index(task.joints), robot.qpos_home
        held = [(0.0, "both")] * len(physics)
        self.robots = VirtualRobot(robot, physics, held, robot.dt, locked=task.locked, nthread=1)


def identified(work: Path, robot: str, fleet: str, quick: bool) -> list[Path]:
    """Robot folders of the first units; what is there stays."""
    recipe, data = work / "recipe.toml", work / "data"
    units = [f"virtual-{k}" for k in range(1, KNOWN + 1)]
    names = ["tour-all-*", "limber-all-*"] if quick else ["tour-all-*", "limber-all-*", "steps-*", "holds-*", "chirp-*"]
    kept = {"motions": names, "payloads": [0.0], "units": units, "rates": [50], "repetitions": 1, "variants": 6}
    recipe.write_text("".join(f"{name} = {json.dumps(value)}\n" for name, value in kept.items()))
    said = ["--robot", robot, "--fleet", fleet, "--recipe", str(recipe), "--nproc", "1"]
    if not (data / "dataset.json").is_file() and gaponet(["collect", "--out", str(data), *said]):
        raise SystemExit(2)
    budget = ["--budget", "2s", "--terms", "--windows", "6"] if quick else ["--budget", "90s"]
    for unit in units:
        asked = ["identify", str(data), "--units", unit, "--threads", "1", "--out", str(work / unit), *budget]
        if not (work / unit / "uncertainty.json").is_file() and gaponet(asked):
            raise SystemExit(2)
    return [work / unit for unit in units]


def by_hand(robot: RobotSpec, seed: int) -> list[RobotSpec]:
    """Every number of every joint by itself, around the file's."""
    rng, first = np.random.default_rng(seed), first_values(robot)
    found = []
    for _ in range(DRAWS):
        shares = {f: np.exp(rng.uniform(*np.log(ends), len(robot.operated))) * first[f] for f, ends in WIDE.items()}
        shares |= {"delay": rng.uniform(0, LATE, len(robot.operated)),
                   "offset": rng.uniform(-TURNED, TURNED, len(robot.operated))}  # fmt: skip
        found.append(_of(robot, shares, ...))
    return found


def ours(robot: RobotSpec, units: dict[str, np.ndarray], seed: int | None = None) -> list[RobotSpec]:
    """Drawn units; with a seed what goes together is torn apart, every number keeps its own range."""
    if seed is not None:
        rng = np.random.default_rng(seed)
        units = {f: rng.permuted(v, axis=0) for f, v in units.items()}
    return [_of(robot, units, k) for k in range(DRAWS)]


def _of(robot: RobotSpec, values: dict[str, np.ndarray], row: object) -> RobotSpec:
    return robot.with_servos({
        j: {f: float(v[row][i]) for f, v in values.items()} for i, j in enumerate(robot.operated)  # type: ignore[index]
    })  # fmt: skip


def main(
    work: tyro.conf.Positional[Path],
    robot: str = "so101",
    fleet: str = "hard",
    updates: int = 150,
    num_envs: int = 128,
    seeds: tuple[int, ...] = (0, 1, 2),
    quick: bool = False,
) -> None:
    """Record, identify, learn, play; a table in Markdown."""
    torch.set_num_threads(1)
    work.mkdir(parents=True, exist_ok=True)
    updates, num_envs, seeds = (2, 16, (0,)) if quick else (updates, num_envs, seeds)
    folders = identified(work, robot, fleet, quick)
    spec, found = load_robot(robot), load_robot(folders[0])
    today = ranges(found, samples=DRAWS).units
    any_robot = ranges(found, "any-robot", folders[1:], samples=DRAWS).units
    drawing._alone = lambda apart: 0.0  # what goes together in four units, taken at its word
    together = ranges(found, "any-robot", folders[1:], samples=DRAWS).units
    sets = {
        "nominal": [spec], "wide by hand, around nominal": by_hand(spec, 0), "one unit identified": [found],
        "that unit, ranges of today": ours(found, today), "four units, any robot": ours(found, together),
        "the same, uncorrelated": ours(found, together, 0), "the same, shrunk": ours(found, any_robot),
    }  # fmt: skip
    names = [f"{kind}-all-{v}" for kind in ("tour", "limber") for v in range(1 if quick else 8)]
    task, unseen = (Task(spec, motions(spec, 0.0, seed, names), 1.0) for seed in (LEARN_SEED, TRY_SEED))
    first = KNOWN + 1 + np.arange(UNSEEN)
    plants = {"seen": [1], "unseen": first.tolist(), "fresh": (first + UNSEEN).tolist()}
    file = work / "policies.json"
    kept = json.loads(file.read_text()) if file.is_file() else {}

    def play(policy: object) -> dict[str, list[list[float]]]:
        return {
            p: follow(unseen, Units(spec, unseen, units, fleet), policy).reshape(len(units), -1).tolist()
            for p, units in plants.items()
        }

    for seed in seeds:
        for name, robots in sets.items():
            if f"{name}|{seed}" in kept:
                continue
            began = time.monotonic()
            torch.manual_seed(seed)
            env = TrackingEnv(task, Several(robots, num_envs, task.locked), seed)  # type: ignore[arg-type]
            policy = train(name, make_runner(env), env, updates)
            kept[f"{name}|{seed}"] = play(policy) | {"seconds": time.monotonic() - began}
            file.write_text(json.dumps(kept))
    if "nothing|0" not in kept:
        kept["nothing|0"] = play(None)
        file.write_text(json.dumps(kept))
    print(table(kept, ["nothing", *sets]))


def table(kept: dict[str, dict[str, list[list[float]]]], names: list[str]) -> str:
    """Mean |error| and success: ± over seeds; to one unit: paired over unseen units, ± standard error."""
    lines = [
        "| learnt in | seen, mrad | 12 unseen | worst of them | success, % | 12 others | success, % | to one unit |",
        "| --- | ---: | ---: | ---: | ---: | ---: | ---: | ---: |",
    ]
    runs = {n: [v for k, v in kept.items() if k.startswith(f"{n}|")] for n in names}
    of = lambda n, p: 1e3 * np.array([r[p] for r in runs[n] if p in r])  # noqa: E731  (seeds, units, motions), mrad
    good = lambda x: 100 * (x < 1e3 * GOOD).mean(axis=(1, 2))  # noqa: E731
    for n in (n for n in names if runs[n]):
        seen, new, more = (of(n, p) for p in ("seen", "unseen", "fresh"))
        each = [seen.mean(axis=(1, 2)), new.mean(axis=(1, 2)), new.mean(axis=2).max(axis=1), good(new)]
        each += [more.mean(axis=(1, 2)), good(more)] if len(more) else [np.array([np.nan])] * 2
        cells = [f"{x.mean():.1f} ± {x.std(ddof=1):.1f}" if len(x) > 1 else f"{x.mean():.1f}" for x in each]
        apart = (new.mean(axis=0) - of("one unit identified", "unseen").mean(axis=0)).mean(axis=1)
        cells.append(f"{apart.mean():+.1f} ± {apart.std(ddof=1) / len(apart) ** 0.5:.1f}")
        lines.append(f"| {n} | {' | '.join(cells)} |")
    return "\n".join(lines)


if __name__ == "__main__":
    tyro.cli(main)
