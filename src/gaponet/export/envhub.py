"""What an environment of LeRobot's EnvHub has beside the MJCF.

Units of the robot to draw, LeRobot's units of joints, and a model card.
"""

from __future__ import annotations

from collections.abc import Sequence as ListOf
from pathlib import Path
from typing import Any

from gaponet.base.files import write_text
from gaponet.base.progress import Progress
from gaponet.data.sequence import Sequence
from gaponet.export.randomization import (
    FILE,
    MUJOCO_FILE,
    judge_units,
    sample_units,
    write_files,
)
from gaponet.robot.spec import RobotSpec
from gaponet.sysid.uncertainty import ParameterUncertainty

SAMPLED_UNITS = 128
README = """---
license: apache-2.0
library_name: lerobot
tags: [lerobot, robotics, simulation, mujoco]
---

# {robot} with {kind} servos, in MuJoCo

An environment of LeRobot's EnvHub. {origin}
Mean |error| of the joints on the {motions} of `check.npz`: {error:.2f} mrad.{meaning}

```console
hf upload USER/NAME . --repo-type model     # in this folder
```

```python
from lerobot.envs.factory import make_env

envs = make_env("USER/NAME", n_envs=4, trust_remote_code=True)
```

| what | value |
| --- | --- |
| action, `agent_pos` | targets and positions in LeRobot's values: degrees, 0..100 for {percent} |
| `environment_state` | the goal, in the same values |
| rate | {rate:.4g} Hz |
| success | every operated joint within 0.05 rad of the goal for 10 control periods |
| servos | {kind}; {drawn} |

`env.py` needs gymnasium, MuJoCo 3.5 or newer and numpy; it fetches the other files of this
repository. `python check.py` plays the motions of `check.npz` and prints the error.
"""
IDENTIFIED = "Friction, delay, offset and gains of its servos were identified from logs by gaponet."
NOMINAL = "Its servos are nominal: nothing was identified from logs."
OF_VIRTUAL = (
    " No real robot made them: the error shows that the files are complete, not how near they are "
    "to a robot."
)


def lerobot_units(robot: RobotSpec) -> dict[str, str]:
    """Return the unit of each joint in LeRobot: deg, or percent of its range."""
    named = zip(robot.joint_names, robot.log_joints.units, strict=True)
    units = {}
    for name, unit in named:
        units[name] = "percent" if unit == "fraction" else "deg"
    return units


def write_units(
    robot: RobotSpec,
    folder: Path,
    recordings: tuple[ListOf[Sequence], ListOf[Sequence]] | None,
    progress: Progress,
) -> str:
    """Write units drawn from the robot's uncertainty, and remove those of an earlier export.

    env.py plays units with the servo model, so these are judged.

    Args:
        recordings: Training and validation motions that choose the units; None: they are taken as
            drawn.

    Returns:
        Why there are none; "" if they are written.
    """
    for name in (FILE, MUJOCO_FILE):
        (folder / name).unlink(missing_ok=True)
    if ParameterUncertainty.load(robot) is None:
        return "their uncertainty is not known"
    drawn = sample_units(robot, samples=SAMPLED_UNITS)
    made = judge_units(drawn, robot, recordings, progress)
    why_refused = made.judged.why_refused() if made.judged is not None else ""
    if not why_refused:
        write_files(made, "mujoco", folder)
    return why_refused


def write_readme(robot: RobotSpec, facts: dict[str, Any], why_no_units: str, folder: Path) -> None:
    """Write the model card.

    Args:
        facts: facts.json.
        why_no_units: Result of `write_units`.
    """
    units = lerobot_units(robot)
    percent = [name for name in robot.joint_names if units[name] == "percent"]
    drawn = 'drawn from their uncertainty with `make_env(..., servos="drawn")`, or `cfg.task`'
    if why_no_units:
        drawn = f"none are drawn: {why_no_units}"
    text = README.format(
        robot=robot.name,
        kind="identified" if robot.is_identified else "nominal",
        origin=IDENTIFIED if robot.is_identified else NOMINAL,
        motions="VIRTUAL motions" if facts["virtual"] else "recorded motions",
        meaning=OF_VIRTUAL if facts["virtual"] else "",
        error=facts["error_mrad"]["joints"],
        percent=", ".join(percent) or "no joint",
        rate=1 / facts["dt"],
        drawn=drawn,
    )
    write_text(folder / "README.md", text)
