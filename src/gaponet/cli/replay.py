"""gaponet replay."""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from gaponet import api
from gaponet.base.errors import UsageError
from gaponet.base.files import atomic_write, write_text
from gaponet.cli.options import Json, Logs
from gaponet.cli.out import Out
from gaponet.report.tables import mrad
from gaponet.robot.spec import RobotSpec, load_robot
from gaponet.sysid.uncertainty import ParameterUncertainty

if TYPE_CHECKING:
    from gaponet.export.rollout import Answer


def replay(
    logs: Logs,
    robot: Path,
    data: str | None = None,
    described: Path | None = None,
    payload_mass: float = 0.0,
    out: Path | None = None,
    figure: Path | None = None,
    json: Json = False,
) -> None:
    """Will a policy transfer? What the robot would do in its rollout.

    The rollout is a log of your simulator, targets as commands, and states, in any format that gaponet import reads.
    Its targets are played as they stand; a policy that looks at the state would have answered what differs. The band
    holds nine tenths of every validation motion of the robot, and what is not known of its servos does to this motion.

    Args:
        logs: File or folder of rollouts.
        robot: Folder that gaponet identify wrote.
        data: Dataset whose validation motions say how far the robot is known; default that of identification.
        described: A logs.toml that says what the rollouts' columns mean.
        payload_mass: kg in each hand.
        out: .npz to write: target, rollout, robot, low and high (T, joints), rad, and dt, s, of each rollout.
        figure: .png and .svg to draw, of the first rollout.
    """
    from gaponet.data.reading import read_first
    from gaponet.export.rollout import SHARE, answers, summary

    screen, spec = Out(json), load_robot(robot)
    known, drawn = _known(screen, robot, data, spec)
    with tempfile.TemporaryDirectory() as place:
        _, _, guessed = read_first(logs, spec, described)
        if guessed:
            write_text(described := Path(place) / "logs.toml", guessed)
        report = api.import_logs(logs, spec, Path(place) / "data", "rollout", payload_mass, logs=described)
        rollouts = report.dataset.sequences(report.entries)
    found = answers(spec, rollouts, known, drawn)
    joints = summary(found, spec.operated)
    differ = sorted((j for j, s in joints.items() if s["inside"] < SHARE), key=lambda j: joints[j]["inside"])
    _tell(screen, robot, len(found), joints, differ)
    if out is not None:
        _keep(out, found, spec)
    if figure:
        from gaponet.report.figures import replay_figure

        replay_figure.write(found, spec.operated, figure)
    screen.result({"robot": spec.name, "rollouts": [a.name for a in found], "joints": joints, "differ": differ,
                   "band": {"share": SHARE, "drawn": len(drawn)}})  # fmt: skip


def _known(screen: Out, folder: Path, data: str | None, robot: RobotSpec) -> tuple[np.ndarray, list[RobotSpec]]:
    """How far the robot is from its recordings, (n,) rad, and robots that it may be as well where that is kept."""
    from gaponet.export.forms import recordings_of
    from gaponet.export.rollout import drawn_robots, validation_error

    kept, recordings = ParameterUncertainty.load(robot), recordings_of(folder, data, robot)
    drawn = drawn_robots(robot) if kept is not None else []
    if recordings is not None:
        return validation_error(robot, recordings[1]), drawn
    if kept is None:
        raise UsageError(f"{folder}: nothing says how far it is from its robot; give --data, or what identify wrote")
    screen.say(
        "  its recordings are gone: the band is what they left when it was identified; or --data", "note", "cyan"
    )
    return np.array([kept.joints[j].residual_p90 for j in robot.operated]), drawn


def _tell(screen: Out, robot: Path, count: int, joints: dict[str, dict[str, Any]], differ: list[str]) -> None:
    columns = ["joint", "behind target", "robot behind", "apart", "in the first s", "band ±", "in band", "worst"]
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
        screen.say("The robot would do what the simulator did, as far as it is known: every joint stays in its band")


def _keep(out: Path, found: list[Answer], robot: RobotSpec) -> None:
    held: dict[str, Any] = {"names": np.array([a.name for a in found]), "joints": np.array(robot.operated)}
    for k, a in enumerate(found):
        series = {"target": a.target, "rollout": a.rollout, "robot": a.robot}
        series |= {"low": a.robot - a.half, "high": a.robot + a.half, "dt": np.array(a.dt)}
        held |= {f"{name}_{k}": values for name, values in series.items()}
    with atomic_write(out) as temporary, temporary.open("wb") as file:
        np.savez_compressed(file, **held)
