"""Servos in Isaac Lab's own configuration classes, and what these cannot hold, in mrad.

Isaac Lab 3 runs the classes as native Newton actuators, its default: a PD servo with a torque limit
and a delay in whole physics steps, or a DC motor without a delay.
"""

from __future__ import annotations

from collections.abc import Sequence as ListOf
from dataclasses import dataclass
from typing import Any

import numpy as np

from gaponet.data.sequence import Sequence
from gaponet.export.plain_servos import rollout_error
from gaponet.export.simulator_facts import servo_facts
from gaponet.robot.spec import RobotSpec
from gaponet.sim.model import build_model

# Field of Isaac Lab's classes → key of a servo in facts.json.
FIELDS = {
    "stiffness": "kp",
    "damping": "kd",
    "actuator_effort_limit": "effort_limit",
    "armature": "armature",
    "friction": "frictionloss",
    "viscous_friction": "damping",
}
HEAD = '''"""Servos of {robot} as identified, in the configuration classes of Isaac Lab 3; SI units.

The file needs no other one. Mean |error| of the joints in gaponet, on the {motions}:
{errors}
"""

from isaaclab.actuators import DCMotorCfg, DelayedPDActuatorCfg, IdealPDActuatorCfg

PHYSICS_STEP = {step!r}  # s; delays are in whole steps of it
HOME = {home}
# A servo aims at its target plus this, rad: JointPositionActionCfg(offset=OFFSETS,
# use_default_offset=False, ...)
OFFSETS = {offsets}
'''
README = """# {robot} for Isaac Lab 3

The same servos in two forms. The errors are means over the joints on the motions of `check.npz`,
which are {motions}, in gaponet, without a table.

| form | files | mrad |
| --- | --- | --: |
| Isaac Lab's own classes | `robot_cfg.py` | {native:.2f} |
| action term | `gaponet_action.py`, `facts.json` | {action:.2f} |

**Isaac Lab's own classes** run as native Newton actuators, the default of Isaac Lab 3. Take them
unless you need the other form.

**The action term** has delays in parts of a physics step and drawn units, and it carries a network.
It needs `use_newton_actuators=False`, which Isaac Lab calls deprecated.

From the identified robot to Isaac Lab's own classes, one loss after the other, on all {motions}:

{errors}

```console
python make_usd.py         # usd/ from robot.xml; usd_servos/ with servos as NewtonActuator prims
python check.py            # plays check.npz with robot_cfg.py, and prints the error
python check.py action     # the same with the action term
```
"""


@dataclass(frozen=True)
class NativeForm:
    """A robot as far as Isaac Lab's own classes hold it.

    Attributes:
        robot: Without servo model, table, and limits of the speed of targets; delays in whole
            physics steps.
        delay_steps: Delay of each servo, (n) physics steps.
        losses: What is lost, one after the other, and the mean |error| then, rad; the first is the
            whole robot.
    """

    robot: RobotSpec
    delay_steps: ListOf[int]
    losses: dict[str, float]

    def servos(self, payload_mass: float, dt: float) -> dict[str, dict[str, Any]]:
        """Return the servos by joint, as in facts.json, with delay_steps."""
        model = build_model(self.robot, payload_mass, dt=dt)
        servos = {}
        for i, name in enumerate(self.robot.joint_names):
            own = servo_facts(self.robot, model, i)
            servos[name] = own | {"delay_steps": self.delay_steps[i]}
        return servos

    def lines(self, indent: str = "") -> str:
        """Return the losses as lines of text."""
        return "\n".join(
            f"{indent}{1e3 * error:6.2f} mrad {what}" for what, error in self.losses.items()
        )


def native_form(
    robot: RobotSpec, plain: RobotSpec, step: float, motions: ListOf[Sequence]
) -> NativeForm:
    """Return what Isaac Lab's own classes hold of a robot, and the cost of what they lack.

    Args:
        robot: Identified.
        plain: The robot fitted without the servo model, but for torque-speed lines.
        step: Physics step, s.
        motions: Validation motions, on which the errors are measured.
    """
    delay = plain.servo.delay
    steps = np.rint(delay / step).astype(int)
    rounded = plain.with_servo(delay=steps * step)
    # A DCMotorCfg has no delay, and a DelayedPDActuatorCfg no torque-speed line.
    no_load_speed = np.where(steps > 0, 0.0, plain.servo.no_load_speed)
    one_class = rounded.with_servo(no_load_speed=no_load_speed)
    without_table = one_class.with_table(None)
    native = without_table.with_servo(target_speed=0.0)

    losses = {"as identified": rollout_error(motions, robot)}

    def lose(what: str, form: RobotSpec, is_less: bool) -> None:
        if is_less:
            losses[what] = rollout_error(motions, form)

    lose("without the servo model, fitted again", plain, robot.servo.has_terms)
    is_rounded = not np.allclose(delay, rounded.servo.delay)
    lose("with delays in whole physics steps", rounded, is_rounded)
    has_line = bool((plain.servo.no_load_speed > 0).any())
    lose("without torque-speed lines of late servos", one_class, has_line)
    lose("without the table", without_table, robot.scene.table is not None)
    lose("without the limits of the speed of targets", native, bool(robot.servo.target_speed.any()))
    return NativeForm(native, steps.tolist(), losses)


def robot_config(
    robot: str, servos: dict[str, dict[str, Any]], step: float, errors: str, motions: str
) -> str:
    """Return robot_cfg.py.

    Args:
        robot: Name of the robot.
        servos: Servos of `NativeForm.servos`.
        step: Physics step, s.
        errors: Text of `NativeForm.lines`.
        motions: What kind of motions the errors are measured on.
    """
    head = HEAD.format(
        robot=robot,
        errors=errors,
        motions=motions,
        step=step,
        home=_column(servos, "home"),
        offsets=_column(servos, "offset"),
    )
    actuators = [_actuator(name, servo) for name, servo in servos.items()]
    return head + "ACTUATORS = {\n" + "".join(actuators) + "}\n"


def _column(servos: dict[str, dict[str, Any]], field: str) -> str:
    """Return one number of each servo, as the text of a dict."""
    lines = [f'    "{name}": {servo[field]!r},\n' for name, servo in servos.items()]
    return "{\n" + "".join(lines) + "}"


def _actuator(joint: str, servo: dict[str, Any]) -> str:
    """Return an entry of ACTUATORS."""
    kind = "IdealPDActuatorCfg"
    fields = {field: servo[key] for field, key in FIELDS.items()}
    if servo["delay_steps"] > 0:
        kind = "DelayedPDActuatorCfg"
        fields |= {"min_delay": servo["delay_steps"], "max_delay": servo["delay_steps"]}
    elif servo.get("no_load_speed"):
        kind = "DCMotorCfg"
        fields |= {"saturation_effort": servo["effort_limit"]}
        fields |= {"actuator_velocity_limit": servo["no_load_speed"]}
    lines = [f"        {field}={value!r},\n" for field, value in fields.items()]
    opening = f'    "{joint}": {kind}(\n        joint_names_expr=["{joint}"],\n'
    return opening + "".join(lines) + "    ),\n"


def readme(robot: str, form: NativeForm, errors_mrad: dict[str, float], motions: str) -> str:
    """Return the README of the export.

    Args:
        errors_mrad: Form of the robot → error on the motions of check.npz.
    """
    return README.format(
        robot=robot,
        native=errors_mrad["native"],
        action=errors_mrad["plain"],
        motions=motions,
        errors="\n".join(f"- {line.strip()}" for line in form.lines().splitlines()),
    )
