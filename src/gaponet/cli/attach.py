"""The processor of a LeRobot policy, for gaponet export --to lerobot."""

from __future__ import annotations

import json
from pathlib import Path

from gaponet.base.errors import UsageError
from gaponet.base.files import write_text
from gaponet.cli.out import Out
from gaponet.robot.spec import load_robot

FILE, STEP = "policy_postprocessor.json", "gaponet_correct"


def attach(screen: Out, policy: Path, holder: Path | None, payload_mass: float, dynamics: bool) -> None:
    """Put the correction of a robot or a run behind a LeRobot policy, in place of an earlier one; None removes it."""
    file = policy / FILE
    if not file.is_file():
        raise UsageError(f"{policy}: has no {FILE}; give the folder that holds a LeRobot policy and its processors")
    try:
        told = json.loads(file.read_text(encoding="utf-8"))
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
    write_text(file, json.dumps(told | {"steps": steps}, indent=2) + "\n")
    names = [step.get("registry_name", step.get("class", "?")) for step in steps]
    screen.say(f"{file}: {' → '.join(names) or 'no steps'}")
    screen.result({"file": str(file), "steps": names, "config": config})
