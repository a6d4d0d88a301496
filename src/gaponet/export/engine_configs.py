"""Servos in the classes of other engines, as robot_cfg.py: one template per engine.

The numbers are those of facts["plain"], fitted without a servo model, which these classes do not have.
"""

from __future__ import annotations

from string import Template
from typing import Any

MJLAB = Template('''"""Servos of $robot as identified, for mjlab; SI units.$note"""

from mjlab.actuator import BuiltinPositionActuatorCfg

ACTUATORS = (  # EntityArticulationInfoCfg(actuators=ACTUATORS); $rounding
$servos)
# A servo aims at its target plus this, rad: add it to targets (JointPositionActionCfg has `offset`).
OFFSETS = $offset
TIMESTEP, DECIMATION = $timestep, $decimation
''')
MJLAB_SERVO = Template("""\
    BuiltinPositionActuatorCfg(
        target_names_expr=("$name",), stiffness=$kp, damping=$kd, effort_limit=$effort_limit,
        armature=$armature, frictionloss=$frictionloss, viscous_damping=$damping,
        delay_min_lag=$lag, delay_max_lag=$lag,
    ),
""")
ISAACLAB = Template('''"""Servos of $robot as identified, for Isaac Lab; SI units.$note"""

from isaaclab.actuators import DelayedPDActuatorCfg

ACTUATORS = {  # of ArticulationCfg, on a USD without drives; $rounding
$servos}
# A servo aims at its target plus this, rad: add it to targets (JointPositionActionCfg has `offset`).
OFFSETS = $offset
''')
ISAACLAB_SERVOS = Template("""\
    "servos_$lag": DelayedPDActuatorCfg(
        joint_names_expr=$names,
        min_delay=$lag, max_delay=$lag,
        stiffness=$kp,
        damping=$kd,
        actuator_effort_limit=$effort_limit,
        armature=$armature,
        friction=$frictionloss,
        viscous_friction=$damping,
    ),
""")
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
TEMPLATES = {"mjlab": MJLAB, "isaaclab": ISAACLAB, "newton": NEWTON, "drake": DRAKE}


def engine_config(engine: str, robot: str, facts: dict[str, Any]) -> str:
    """Return robot_cfg.py of an engine, one of TEMPLATES, for a robot's name and facts.json."""
    step, joints = facts["options"]["timestep"], facts["plain"]
    lags = {name: round(s["delay"] / step) for name, s in joints.items()}
    rounded = max(abs(s["delay"] - step * lags[name]) for name, s in joints.items())
    law = ", ".join(facts["law"])
    servos = ""
    if engine == "mjlab":
        servos = "".join(MJLAB_SERVO.substitute(s, name=name, lag=lags[name]) for name, s in joints.items())
    if engine == "isaaclab":
        for lag in dict.fromkeys(lags.values()):
            group = {name: s for name, s in joints.items() if lags[name] == lag}
            servos += ISAACLAB_SERVOS.substitute(_columns(group), lag=lag, names=list(group))
    if engine == "drake":
        fields = ("kp", "kd", "effort_limit", "armature", "damping", "frictionloss")
        servos = "".join(f"    {name!r}: { {f: s[f] for f in fields} },\n" for name, s in joints.items())
    return TEMPLATES[engine].substitute(
        _columns(joints), robot=robot, servos=servos, timestep=step, decimation=facts["decimation"],
        note=f" They lack the servo model ({law}); these numbers were fitted without it." if law else "",
        rounding=f"delays are whole steps of {1e3 * step:g} ms, by at most {1e3 * rounded:.1f} ms off",
    )  # fmt: skip


def _columns(joints: dict[str, dict[str, Any]]) -> dict[str, dict[str, Any]]:
    """Return the values of each field by joint."""
    return {field: {name: s[field] for name, s in joints.items()} for field in next(iter(joints.values()))}
