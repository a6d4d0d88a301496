"""Servos in the classes of Newton, as robot_cfg.py.

The numbers are those of facts["plain"], fitted without a servo model, which Newton does not have.
"""

from __future__ import annotations

from string import Template
from typing import Any

NEWTON = Template('''"""Servos of $robot as identified, for Newton; SI units.$note"""

# Fields of a ModelBuilder, by joint. robot.xml has armature, damping and friction as well.
SERVOS = {
    "joint_target_ke": $kp,
    "joint_target_kd": $kd,
    "joint_effort_limit": $effort_limit,
    "joint_armature": $armature,
    "joint_friction": $frictionloss,
}
# A servo aims at its target plus this, rad.
OFFSETS = $offset
# s. Newton's servos have no delay: targets go through mujoco_servos.delay_weights, as in check.py.
DELAYS = $delay
''')


def newton_config(robot: str, facts: dict[str, Any]) -> str:
    """Return robot_cfg.py of Newton for a robot's name and facts.json."""
    joints = facts["plain"]
    law = ", ".join(facts["law"])
    fields = ("kp", "kd", "effort_limit", "armature", "damping", "frictionloss", "offset", "delay")
    columns = {}
    for field in fields:
        columns[field] = {name: servo[field] for name, servo in joints.items()}
    note = ""
    if law:
        note = f" They lack the servo model ({law}); these numbers were fitted without it."
    return NEWTON.substitute(columns, robot=robot, note=note)
