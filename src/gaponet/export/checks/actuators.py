"""The actuator networks beside this file in other engines' classes; the scene has no servos of its own (robot.xml).

mjlab:      EntityArticulationInfoCfg(actuators=mjlab_actuators(FOLDER))
Isaac Lab:  ArticulationCfg(actuators=isaaclab_actuators(FOLDER), …)
Newton:     builder.add_actuator(newton.actuators.DriveNeuralMLP, index=…, pos_index=…, model_path=FOLDER/JOINT.onnx)

Targets are rad, and go to the actuator as they are. All are asked once per physics step of facts.json's length.
"""

from pathlib import Path
from typing import Any

from gaponet.export.mujoco_servos import read

MOST = 1e6  # N·m, rad/s: torque is limited in the network


def mjlab_actuators(folder: Path) -> tuple[Any, ...]:
    """One LearnedMlpActuatorCfg per joint; armature, damping and friction are the scene's."""
    from mjlab.actuator import LearnedMlpActuatorCfg

    facts = read(folder / "facts.json")
    return tuple(
        LearnedMlpActuatorCfg(
            target_names_expr=(name,), network_file=str(folder / f"{name}.pt"), pos_scale=1.0, vel_scale=1.0,
            torque_scale=1.0, history_length=facts["actuator_net"]["length"], effort_limit=joint["effort_limit"],
            saturation_effort=MOST, velocity_limit=MOST,
        )
        for name, joint in facts["joints"].items()
    )  # fmt: skip


def isaaclab_actuators(folder: Path) -> dict[str, Any]:
    """One ActuatorNetMLPCfg per joint, armature and friction with it."""
    from isaaclab.actuators import ActuatorNetMLPCfg

    facts = read(folder / "facts.json")
    known = ActuatorNetMLPCfg.__dataclass_fields__
    limit = "actuator_effort_limit" if "actuator_effort_limit" in known else "effort_limit"  # Isaac Lab 3 renamed it
    return {
        name: ActuatorNetMLPCfg(
            joint_names_expr=[name], network_file=str(folder / f"{name}.pt"), pos_scale=1.0, vel_scale=1.0,
            torque_scale=1.0, input_order="pos_vel", input_idx=list(range(facts["actuator_net"]["length"])),
            saturation_effort=MOST, velocity_limit=MOST, armature=joint["armature"], friction=joint["frictionloss"],
            viscous_friction=joint["damping"], **{limit: joint["effort_limit"]},
        )
        for name, joint in facts["joints"].items()
    }  # fmt: skip
