"""What an export for each program consists of, and what that program lacks."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from gaponet.robot.spec import RobotSpec

NEWTON_CHECK = "check_newton.py"


@dataclass(frozen=True)
class Target:
    """A target of `gaponet export --to`.

    Attributes:
        files: Name in the export folder → file in SHIPPED; beside the helper file.
        checked_in: Program in which check.py runs; "" if the target has its name.
        edits_mjcf: The export is an edited copy of a MuJoCo file.
        needs_torch: The helper file needs torch.
        has_table: robot.xml's table is in the program's scenes.
        has_servo_model: The program simulates the servo model.
        own_terms: Terms of the servo model that the program's own servos have.
        delay_note: What a user of late servos must know; "" for nothing.
    """

    files: dict[str, str] = field(default_factory=dict)
    checked_in: str = ""
    edits_mjcf: bool = False
    needs_torch: bool = False
    has_table: bool = True
    has_servo_model: bool = True
    own_terms: tuple[str, ...] = ()
    delay_note: str = ""


TARGETS = {
    "mjcf": Target(
        {"check.py": "check_mjcf.py"},
        checked_in="MuJoCo",
        edits_mjcf=True,
        delay_note="delays need MuJoCo 3.5, and after each reset fill_delays of mujoco_servos.py; "
        "MJX ignores them without a message",
    ),
    "envhub": Target(
        {"check.py": "check_mjcf.py", "env.py": "env.py"}, checked_in="MuJoCo", edits_mjcf=True
    ),
    "urdf": Target(has_servo_model=False),
    "mjlab": Target({"check.py": "check_mjlab.py"}, needs_torch=True),
    "isaaclab": Target(
        {"check.py": "check_isaaclab.py", "make_usd.py": "make_usd.py"},
        needs_torch=True,
        has_table=False,
        has_servo_model=False,
        own_terms=("no_load_speed",),
    ),
    "newton": Target(
        {"check.py": NEWTON_CHECK},
        has_table=False,
        has_servo_model=False,
        delay_note="Newton's joint targets have no delay: check.py has a buffer of five lines",
    ),
    "json": Target(),
    "torch": Target(needs_torch=True),
    "actuator-net": Target(
        {
            "check.py": "check_mjlab.py",
            "check_newton.py": NEWTON_CHECK,
            "actuators.py": "actuators.py",
        },
        checked_in="mjlab",
        needs_torch=True,
    ),
}


def own_terms(program: str) -> tuple[str, ...]:
    """Return the terms of the servo model that a program's own servos have."""
    target = TARGETS.get(program, Target())
    return target.own_terms


def temperature_note(robot: RobotSpec) -> str:
    """Return at which temperatures friction and damping are those of an export or a scene."""
    warm = ", ".join(f"{t:.0f}" for t in robot.servo.friction_temperature[robot.operated_index])
    return f"friction and damping are those at {warm} °C: no engine has a temperature"
