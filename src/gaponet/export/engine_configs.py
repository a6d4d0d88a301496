"""Servos in the classes of other engines, as robot_cfg.py: one template per engine without an action term.

The numbers are those of facts["plain"], fitted without a servo model, which these classes do not have.
"""

from __future__ import annotations

from string import Template
from typing import Any

NEWTON = Template('''"""Servos of $robot as identified, for Newton; SI units.$note"""

SERVOS = {  # fields of a ModelBuilder, by joint; robot.xml has armature, damping and friction as well
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
DRAKE = Template('''"""Servos of $robot as identified, for Drake; SI units.$note"""

import numpy as np
from pydrake.multibody.tree import PdControllerGains

SERVOS = {
$servos}
# A servo aims at its target plus this, rad.
OFFSETS = $offset
# s. Drake's actuators have no delay: targets go through mujoco_servos.delay_weights, as in check.py.
DELAYS = $delay


def add_servos(plant):
    """Add the actuators, before plant.Finalize(). Drake's gains act implicitly in a discrete plant, which adds
    kp * step of damping; it is subtracted here."""
    for name, s in SERVOS.items():
        joint, d = plant.GetJointByName(name), s["kd"] - s["kp"] * plant.time_step()
        actuator = plant.AddJointActuator(name, joint, s["effort_limit"])
        actuator.set_default_gear_ratio(1.0)
        actuator.set_default_rotor_inertia(s["armature"])
        actuator.set_controller_gains(PdControllerGains(p=s["kp"], d=max(d, 0.0)))
        joint.set_default_damping(max(s["damping"] + min(d, 0.0), 0.0))


def friction(plant, context, target, sweeps=10):
    """Return the friction of the joints, N m, for the input of applied generalized forces; Drake's joints have none.

    Each joint gets as much friction as brings it to rest in this step, up to its limit (Gauss-Seidel).
    target: rad, in the order of SERVOS."""
    servos, step = SERVOS.values(), plant.time_step()
    column = {field: np.array([s[field] for s in servos]) for field in next(iter(servos))}
    joints = [plant.GetJointByName(name) for name in SERVOS]
    at, dof = [j.position_start() for j in joints], [j.velocity_start() for j in joints]
    inertia, speed = plant.CalcMassMatrix(context), plant.GetVelocities(context)
    force = plant.CalcGravityGeneralizedForces(context) - plant.CalcBiasTerm(context)
    torque = column["kp"] * (target - plant.GetPositions(context)[at])
    force[dof] += np.clip(torque, -column["effort_limit"], column["effort_limit"])
    damped = inertia.copy()
    damped[dof, dof] += step * (column["damping"] + column["kd"])
    mobility = np.linalg.inv(damped)
    after, torques = mobility @ (inertia @ speed + step * force), np.zeros(len(speed))
    for _ in range(sweeps):
        for i, loss in zip(dof, column["frictionloss"]):
            new = np.clip(torques[i] - after[i] / (step * mobility[i, i]), -loss, loss)
            after += step * mobility[:, i] * (new - torques[i])
            torques[i] = new
    return torques
''')
TEMPLATES = {"newton": NEWTON, "drake": DRAKE}


def engine_config(engine: str, robot: str, facts: dict[str, Any]) -> str:
    """Return robot_cfg.py of an engine, one of TEMPLATES, for a robot's name and facts.json."""
    joints, law = facts["plain"], ", ".join(facts["law"])
    fields = ("kp", "kd", "effort_limit", "armature", "damping", "frictionloss")
    columns = {
        field: {name: s[field] for name, s in joints.items()}
        for field in (*fields, "offset", "delay")
    }
    return TEMPLATES[engine].substitute(
        columns, robot=robot,
        servos="".join(f"    {name!r}: { {f: s[f] for f in fields} },\n" for name, s in joints.items()),
        note=f" They lack the servo model ({law}); these numbers were fitted without it." if law else "",
    )  # fmt: skip
