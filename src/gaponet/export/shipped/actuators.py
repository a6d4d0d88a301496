"""Classes of mjlab and Isaac Lab for the actuator networks beside this file.

robot.xml has no servos.

    # mjlab
    EntityArticulationInfoCfg(actuators=mjlab_actuators(FOLDER))
    # Isaac Lab
    ArticulationCfg(actuators=isaaclab_actuators(FOLDER), …)
    # Newton, joint by joint
    drive = newton.actuators.DriveNeuralMLP
    builder.add_actuator(drive, index=…, pos_index=…, model_path=FOLDER/JOINT.onnx)

Targets are in rad. Each network is evaluated once per physics step; facts.json has its length.
"""

from pathlib import Path
from typing import Any

from gaponet.export.shipped.mujoco_servos import read

NO_LIMIT = 1e6  # N·m, rad/s; the network itself limits its torque


def mjlab_actuators(folder: Path) -> tuple[Any, ...]:
    """Return one LearnedMlpActuatorCfg per joint; the scene has armature, damping and friction."""
    from mjlab.actuator import LearnedMlpActuatorCfg

    facts = read(folder / "facts.json")
    actuators = []
    for name, joint in facts["joints"].items():
        actuator = LearnedMlpActuatorCfg(
            target_names_expr=(name,),
            network_file=str(folder / f"{name}.pt"),
            pos_scale=1.0,
            vel_scale=1.0,
            torque_scale=1.0,
            history_length=facts["actuator_net"]["length"],
            effort_limit=joint["effort_limit"],
            saturation_effort=NO_LIMIT,
            velocity_limit=NO_LIMIT,
        )
        actuators.append(actuator)
    return tuple(actuators)


def isaaclab_actuators(folder: Path) -> dict[str, Any]:
    """Return one ActuatorNetMLPCfg per joint, with armature and friction."""
    from isaaclab.actuators import ActuatorNetMLPCfg

    facts = read(folder / "facts.json")
    fields = ActuatorNetMLPCfg.__dataclass_fields__
    # Isaac Lab 3 renamed it.
    limit = "actuator_effort_limit" if "actuator_effort_limit" in fields else "effort_limit"
    actuators = {}
    for name, joint in facts["joints"].items():
        actuators[name] = ActuatorNetMLPCfg(
            joint_names_expr=[name],
            network_file=str(folder / f"{name}.pt"),
            pos_scale=1.0,
            vel_scale=1.0,
            torque_scale=1.0,
            input_order="pos_vel",
            input_idx=list(range(facts["actuator_net"]["length"])),
            saturation_effort=NO_LIMIT,
            velocity_limit=NO_LIMIT,
            armature=joint["armature"],
            friction=joint["frictionloss"],
            viscous_friction=joint["damping"],
            **{limit: joint["effort_limit"]},
        )
    return actuators
