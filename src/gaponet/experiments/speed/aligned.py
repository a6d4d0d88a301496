"""How much of the simulator's speed is left when every target is corrected: the two take turns in one run."""

from __future__ import annotations

import numpy as np

from gaponet.deploy.aligned_sim import AlignedSim
from gaponet.experiments.speed.turns import take_turns
from gaponet.nn.artifact import GapModel
from gaponet.robot.spec import RobotSpec
from gaponet.sim.batch import BatchSim, Condition
from gaponet.sim.model import idle_joints


def bench_aligned(
    robot: RobotSpec, model: GapModel, num_envs: int = 512, steps: int = 40, rounds: int = 15
) -> dict[str, float]:
    """Control steps per second, nominal and aligned; the fastest turn of each counts. Limbs without an operated joint
    are locked in both.

    Args:
        steps: Control periods per turn.
        rounds: Turns each.
    """
    locked = idle_joints(robot, robot.operated)
    nominal = BatchSim(robot, [Condition(0.0, "both", robot.dt)] * num_envs, 0, locked)
    aligned = AlignedSim(robot, model, 0.0, num_envs=num_envs, locked=locked)
    rng = np.random.default_rng(0)
    phase = rng.uniform(0, 2 * np.pi, (num_envs, nominal.n))
    home = aligned.qpos_home
    targets = [home + 0.3 * np.sin(phase + 2 * np.pi * 0.5 * robot.dt * t) for t in range(steps)]

    def run_nominal() -> None:
        nominal.reset(slice(None), targets[0], 0.0, past=targets[0][:, None])  # type: ignore[arg-type]
        for target in targets:
            nominal.step(target)

    def run_aligned() -> None:
        aligned.reset(targets[0])
        for target in targets:
            aligned.step(target)

    seconds = take_turns({"nominal": run_nominal, "aligned": run_aligned}, rounds)
    return {name: num_envs * steps / best for name, best in seconds.items()}
