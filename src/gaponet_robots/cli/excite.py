"""`gaponet excite`: what to play on a robot of which there is no data yet."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

from gaponet.cli.options import Json
from gaponet.cli.out import Out, writes


@writes("motions")
def excite(
    robot: str,
    out: Path,
    minutes: float = 10.0,
    payloads: tuple[float, ...] = (0.0,),
    rate: float = 50.0,
    format: Literal["txt", "csv", "npz"] = "txt",
    seed: int = 0,
    json: Json = False,
) -> None:
    """No data yet? Write motions to play on a robot, and how.

    Args:
        robot: Robot name or folder; its range, torque and payload limits bound the motions.
        out: Folder for the motion files and sheet.md.
        minutes: How long all motions are together. 10 identify gains, friction and delay, 40 make a good model.
        payloads: kg in each hand; every motion is played with each.
        rate: How many commands a second, Hz.
        format: txt (SAGE, 50 Hz), csv (with time) or npz; gaponet run and record play each.
        seed: What the drawing of motions starts from.
    """
    from gaponet.files import write_text
    from gaponet.robot import load_robot
    from gaponet_robots.motion.files import write_motion
    from gaponet_robots.motion.plan import make_plan, sheet

    screen, spec = Out(json), load_robot(robot)
    plan = make_plan(spec, minutes, tuple(sorted(set(payloads))), seed)
    files = [f"{i:02d}_{motion.name}.{format}" for i, motion in enumerate(plan.motions, 1)]
    for file, motion in zip(files, plan.motions, strict=True):
        write_motion(out / file, motion, spec, rate)
    write_text(out / "sheet.md", sheet(spec, plan, files, rate))
    masses = ", ".join(f"{p:g}" for p in plan.payloads)
    screen.say(f"{len(files)} motions, {plan.minutes:.1f} min at {masses} kg for {spec.name}: {out!s}")
    screen.say(f"Next: print {out / 'sheet.md'}; play them (gaponet run or record --motion FILE, or your own player)")
    screen.result(
        {"motions": files, "minutes": plan.minutes, "payloads": plan.payloads, "sheet": str(out / "sheet.md")}
    )
