"""gaponet identify."""

from __future__ import annotations

from pathlib import Path
from shlex import quote
from typing import Annotated

import tyro

from gaponet import api
from gaponet.api.opening import driven_by_torque, open_dataset, require_torque_for_current
from gaponet.api.options import IdentifyOptions
from gaponet.api.results import IdentifyResult, TorqueResult
from gaponet.base.progress import progress_bar
from gaponet.cli.options import Data, Flag, Json, Robot
from gaponet.cli.out import Out, writes
from gaponet.cli.show_identified import show_identified, show_torque_driven
from gaponet.robot.spec import robot_argument


@writes("robot")
def identify(
    dataset: Data,
    out: Path,
    options: Annotated[IdentifyOptions, tyro.conf.arg(name="")] = IdentifyOptions(),  # noqa: B008
    current: Flag = False,
    details: Flag = False,
    robot: Robot = None,
    json: Json = False,
) -> None:
    """Fit the simulator's servos to logs and write a robot folder.

    Gains, damping, friction, armature, offsets and delays are fitted to the training motions. For a
    robot that is driven by torque (no position was commanded), armature, damping, friction and
    delay are fitted.

    Use the result with --robot and a slash: gaponet gap DATASET --robot ./OUT. The fit starts from
    the gains in the robot's file. kp is fitted too; if the recordings state it, it stays near that
    value. If no fit is better than the given robot, nothing is written and the exit status is 2.

    Args:
        out: Robot folder to write.
        options: What is fitted.
        current: For robots driven by torque: the recorded torque is a current, or its unit is
            unknown. The torque constant is fitted too.
        details: List, for each joint, the parameters that these logs do not determine.
    """
    screen = Out(json)
    data, spec = open_dataset(dataset, robot)
    made: IdentifyResult | TorqueResult
    if current:
        require_torque_for_current(data)
    if current or driven_by_torque(data):
        options.require_none_for_torque(str(dataset))
        with progress_bar("identifying"):
            made = api.identify_torque(
                data,
                out=out,
                current=current,
                robot=spec,
                despite_errors=options.despite_errors,
            )
        show_torque_driven(screen, made, current)
    else:
        with progress_bar("identifying") as update:
            made = api.identify(data, out=out, robot=spec, options=options, progress=update)
        show_identified(screen, made, options, details)
        screen.say(f"robot folder: {out}, after {made.seconds:.0f} s")
        screen.next(f"gaponet gap {quote(str(dataset))} --robot {quote(robot_argument(out))}")
    screen.result(made.to_dict())
