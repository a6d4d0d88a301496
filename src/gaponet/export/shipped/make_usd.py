"""Make two USDs of robot.xml by mujoco-usd-converter.

    python make_usd.py

usd/ holds the robot without servos, for a scene that configures actuators (robot_cfg.py, or the
action term). In usd_servos/ each servo is a NewtonActuator prim too, for programs that read these:
Newton, and Isaac Lab for joints without a configuration.
"""

import json
from pathlib import Path
from typing import Any

import mujoco_usd_converter
from pxr import Sdf, Usd

HERE = Path(__file__).parent
JOINTS = ("PhysicsRevoluteJoint", "PhysicsPrismaticJoint")


def convert(folder: Path) -> str:
    """Return the path of the USD without servos."""
    asset = mujoco_usd_converter.Converter().convert(str(HERE / "robot.xml"), str(folder))
    return str(asset.path)


def add_servos(path: str, servos: dict[str, Any]) -> None:
    """Add a NewtonActuator prim for each joint; servos as in facts.json, native."""
    stage = Usd.Stage.Open(path)
    root = stage.GetDefaultPrim()
    joints = {}
    for prim in Usd.PrimRange(root):
        if prim.GetTypeName() in JOINTS:
            joints[prim.GetName()] = prim.GetPath()
    for name, servo in servos.items():
        prim = stage.DefinePrim(root.GetPath().AppendChild(f"servo_{name}"), "NewtonActuator")
        prim.CreateRelationship("newton:targets").SetTargets([joints[name]])
        schemas = ["NewtonPDControlAPI", "NewtonMaxEffortClampingAPI"]
        values = {
            "newton:kp": servo["kp"],
            "newton:kd": servo["kd"],
            "newton:constEffort": servo["kp"] * servo["offset"],
            "newton:maxEffort": servo["effort_limit"],
        }
        for attribute, value in values.items():
            prim.CreateAttribute(attribute, Sdf.ValueTypeNames.Float).Set(value)
        if servo["delay_steps"] > 0:
            schemas.append("NewtonActuatorDelayAPI")
            steps = prim.CreateAttribute("newton:delaySteps", Sdf.ValueTypeNames.Int)
            steps.Set(servo["delay_steps"])
        for schema in schemas:
            prim.AddAppliedSchema(schema)
    stage.Save()


if __name__ == "__main__":
    facts = json.loads((HERE / "facts.json").read_text(encoding="utf-8"))
    print(convert(HERE / "usd"))
    with_servos = convert(HERE / "usd_servos")
    add_servos(with_servos, facts["native"])
    print(with_servos)
