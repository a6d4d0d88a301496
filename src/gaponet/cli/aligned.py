"""gaponet bench aligned."""

from __future__ import annotations

from pathlib import Path

from gaponet.cli.out import Out


def aligned(run: Path, out: Out, num_envs: int, rounds: int) -> None:
    """Print control steps per second of the aligned and the nominal simulator, side by side."""
    from gaponet.deploy.throughput import bench_aligned
    from gaponet.model.artifact import GapModel
    from gaponet.robot import load_robot

    model = GapModel.load(run, threads=0)
    kept = run / "robot"
    robot = load_robot(kept if (kept / "robot.toml").is_file() else model.card["robot"])
    speed = bench_aligned(robot, model, num_envs, rounds=rounds)
    ratio = speed["aligned"] / speed["nominal"]
    out.table(f"{robot.name}, {num_envs} simulations", ["", "control steps/s", "of nominal"], [
        [name, f"{v:,.0f}", f"{v / speed['nominal'] * 100:.0f} %"] for name, v in speed.items()
    ])  # fmt: skip
    out.result({"run": str(run), "num_envs": num_envs, "control_steps_per_s": speed, "ratio": ratio})
