"""`gaponet collect`: play a recipe on a virtual fleet and record it."""

from __future__ import annotations

from dataclasses import asdict, replace
from pathlib import Path

from gaponet.base.progress import progress_bar
from gaponet.cli.options import Json
from gaponet.cli.out import Out


def collect(
    out: Path,
    robot: str = "h1_2",
    fleet: str = "hard",
    recipe: str = "small",
    payloads: tuple[float, ...] = (),
    units: tuple[str, ...] = (),
    seed: int = 0,
    nproc: int = 0,
    executor: str = "local",
    json: Json = False,
) -> None:
    """Record motions of VIRTUAL robots into a dataset.

    Run again after an interruption: what is there is kept, what is missing is recorded, and the result is the same.

    Args:
        out: Dataset folder.
        robot: A robot of the package, or a folder with robot.toml.
        fleet: Virtual units: hard, easy, shifted, unnamed, firm (hard at nine times the gains), or a .toml file.
        recipe: demo (under a minute), small (about two), simlifter (30 h: a quarter of an hour), arm (any
            robot), or a .toml file.
        payloads: kg per hand instead of the recipe's.
        units: Units of the fleet instead of the recipe's.
        seed: Seed of motions, noise and start states.
        nproc: Processes, or jobs at a time; 0 for one per core.
        executor: Where it is played: local, ray or ray:ADDRESS (docs/scale.md).
    """
    import gaponet.testing.collect as recording
    from gaponet.robot.spec import load_robot
    from gaponet.testing.fleet import load_fleet

    spec, screen = load_robot(robot), Out(json)
    plan = recording.load_recipe(recipe)
    plan = replace(plan, payloads=payloads or plan.payloads, units=units or plan.units)
    with progress_bar("virtual recordings") as update:
        done = recording.collect(
            spec,
            load_fleet(fleet, spec),
            plan,
            out,
            seed,
            nproc,
            update,
            executor=executor,
        )
    screen.table(
        f"VIRTUAL recordings, fleet {fleet}",
        ["dataset", done.dataset],
        [
            ["sequences written", str(done.written)],
            ["already there", str(done.present)],
            ["recorded time", f"{done.hours:.2f} h"],
            ["wall time", f"{done.wall_s:.0f} s ({done.times_real_time:.0f} × real time)"],
        ],
    )
    screen.result({"virtual": True, "times_real_time": done.times_real_time} | asdict(done))
