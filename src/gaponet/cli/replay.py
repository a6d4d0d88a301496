"""gaponet replay."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from gaponet import api
from gaponet.base.progress import progress_bar
from gaponet.cli.options import Json, Logs, like
from gaponet.cli.out import Out
from gaponet.evaluation.tables import mrad


@like(api.replay)
def replay(
    logs: Logs, robot: Path, data: str | None = None, described: Path | None = None, payload_mass: float = 0.0,
    out: Path | None = None, json: Json = False,
) -> None:  # fmt: skip
    """Will a policy transfer? Predict the robot in its rollout.

    The rollout is a log of your simulator (targets as commands, and states) in any format that gaponet import reads.
    Its targets are played unchanged, although a policy would react to a different state. The band contains nine tenths
    of every validation motion of the robot, and the effect of uncertain servo parameters on this motion.

    Args:
        out: .npz to write: target, rollout, robot, low and high (T, joints), rad, and dt, s, of each rollout.
    """
    screen = Out(json)
    with progress_bar("replaying") as update:
        made = api.replay(
            logs, robot=robot, data=data, described=described, payload_mass=payload_mass, progress=update
        )  # fmt: skip
    if not made.band_from_recordings:
        screen.say(
            "  its recordings are gone: the band is from the robot folder; or give --data",
            "note",
            "cyan",
        )
    _tell(screen, robot, len(made.rollouts), made.joints, list(made.differ))
    if out is not None:
        made.save(out)
    screen.result(made.to_dict())


def _tell(
    screen: Out, robot: Path, count: int, joints: Mapping[str, Mapping[str, Any]], differ: list[str]
) -> None:
    columns = [
        "joint",
        "behind target",
        "robot behind",
        "apart",
        "in the first s",
        "band ±",
        "in band",
        "worst",
    ]
    screen.table(f"Simulator and robot under the targets of {count} rollout(s), mrad", columns, [
        [j, mrad(s["rollout_behind"]), mrad(s["robot_behind"]), mrad(s["apart"]), mrad(s["apart_first_second"]),
         mrad(s["band"]), f"{s['inside']:.0%}", f"{mrad(s['worst'])} at {s['worst_at']:.1f} s"]
        for j, s in joints.items()
    ])  # fmt: skip
    if differ:
        screen.say(
            f"The robot would not do what the simulator did: {', '.join(differ)}. Train in the identified robot "
            f"(gaponet export {robot} --to …), or compensate on the robot (gaponet run --compensate)"
        )
    else:
        screen.say(
            "The robot would do what the simulator did, as far as it is known: every joint stays in its band"
        )
