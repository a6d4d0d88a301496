"""gaponet attach."""

from __future__ import annotations

import json as text
from pathlib import Path
from typing import Annotated

import tyro

from gaponet.base.errors import UsageError
from gaponet.base.files import write_text
from gaponet.cli.options import Flag, Folder, Json
from gaponet.cli.out import Out
from gaponet.robot.spec import load_robot

FILE, STEP = "policy_postprocessor.json", "gaponet_correct"


def attach(
    policy: Annotated[Folder, tyro.conf.arg(metavar="POLICY")],
    holder: tyro.conf.Positional[Path | None] = None,
    payload_mass: float = 0.0,
    dynamics: Flag = False,
    off: Flag = False,
    json: Json = False,
) -> None:
    """Put the correction behind a LeRobot policy.

    What it had before is replaced. LeRobot's commands find the step through the plug-in lerobot_robot_gaponet.

    Args:
        policy: Folder of a policy (pretrained_model) that holds policy_postprocessor.json.
        holder: Robot folder of gaponet identify, or run folder of gaponet train.
        payload_mass: kg in each hand.
        dynamics: Feed forward what moving asks for: for smooth targets alone.
        off: Take the step away.
    """
    file = policy / FILE
    if not file.is_file():
        raise UsageError(f"{policy}: has no {FILE}; give the folder that holds a LeRobot policy and its processors")
    if off == (holder is not None):
        raise UsageError("give a robot folder or a run to attach, or --off")
    try:
        told = text.loads(file.read_text(encoding="utf-8"))
        steps = [step for step in told["steps"] if step.get("registry_name") != STEP]
    except (ValueError, KeyError, TypeError, AttributeError):
        raise UsageError(f"{file}: is no processor of LeRobot") from None
    config: dict[str, object] = {}
    if holder is not None:
        known = (holder / "robot.toml").is_file()
        if known:
            load_robot(holder)
        elif not (holder / "model").is_dir():
            raise UsageError(f"{holder}: is neither a robot folder of gaponet identify nor a run of gaponet train")
        config = {
            "known" if known else "model": str(holder.resolve()),
            "payload_mass": payload_mass,
            "dynamics": dynamics,
        }
        steps.append({"registry_name": STEP, "config": config})
    write_text(file, text.dumps(told | {"steps": steps}, indent=2) + "\n")
    names = [step.get("registry_name", step.get("class", "?")) for step in steps]
    screen = Out(json)
    screen.say(f"{file}: {' → '.join(names) or 'no steps'}")
    screen.result({"file": str(file), "steps": names, "config": config})
