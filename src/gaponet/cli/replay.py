"""gaponet replay."""

from __future__ import annotations

from pathlib import Path

from gaponet import api
from gaponet.api.results import ReplayResult
from gaponet.base.errors import UsageError
from gaponet.base.progress import progress_bar
from gaponet.cli.options import Json, Logs, like
from gaponet.cli.out import Out
from gaponet.evaluation.tables import mrad

COLUMNS = [
    "joint",
    "behind target",
    "robot behind",
    "apart",
    "in the first s",
    "band ±",
    "in band",
    "worst",
]


@like(api.replay)
def replay(
    logs: Logs,
    robot: Path,
    data: str | None = None,
    described: Path | None = None,
    payload_mass: float = 0.0,
    out: Path | None = None,
    json: Json = False,
) -> None:
    """Will a policy transfer? Predict the robot in its rollout.

    The rollout is a log of your simulator (targets as commands, and states) in any format that
    gaponet import reads. Its targets are played unchanged, although a policy would react to a
    different state. The band contains nine tenths of every validation motion of the robot, and the
    effect of uncertain servo parameters on this motion.

    Args:
        out: .npz to write: target, rollout, robot, low and high (T, joints), rad, and dt, s, of
            each rollout.
    """
    screen = Out(json)
    if out is not None and out.suffix != ".npz":
        raise UsageError(f"--out {out}: give the name of an .npz file")
    if out is not None and not out.parent.is_dir():
        raise UsageError(f"--out {out}: there is no folder {out.parent}; make it first")
    with progress_bar("replaying") as update:
        made = api.replay(
            logs,
            robot=robot,
            data=data,
            described=described,
            payload_mass=payload_mass,
            progress=update,
        )
    if not made.band_from_recordings:
        screen.say(
            "  its recordings are gone: the band is from the robot folder; or give --data",
            "note",
            "cyan",
        )
    _show_joints(screen, made)
    if made.differ:
        screen.say(
            f"The robot would not do what the simulator did: {', '.join(made.differ)}. Train in "
            f"the identified robot (gaponet export {robot} --to …), or compensate on the robot "
            "(gaponet run --compensate)"
        )
    else:
        screen.say(
            "The robot would do what the simulator did, as far as it is known: every joint stays "
            "in its band"
        )
    if out is not None:
        made.save(out)
    screen.result(made.to_dict())


def _show_joints(screen: Out, made: ReplayResult) -> None:
    """Print how far rollout and robot are from the targets and from each other."""
    rows = []
    for joint, errors in made.joints.items():
        row = [joint, mrad(errors["rollout_behind"]), mrad(errors["robot_behind"])]
        row += [mrad(errors["apart"]), mrad(errors["apart_first_second"]), mrad(errors["band"])]
        row += [f"{errors['inside']:.0%}"]
        row += [f"{mrad(errors['worst'])} at {errors['worst_at']:.1f} s"]
        rows.append(row)
    count = len(made.rollouts)
    title = f"Simulator and robot under the targets of {count} rollout(s), mrad"
    screen.table(title, COLUMNS, rows)
