"""Servos in other engines' own classes, as text to be pasted: numbers that were fitted without a servo law."""

from __future__ import annotations

from typing import Any

OFFSETS = "# A servo aims at its target plus this, rad: add it to targets (JointPositionActionCfg has `offset`).\n"


def mjlab_config(robot: str, facts: dict[str, Any]) -> str:
    """For mjlab 1.6."""
    step, servos = facts["options"]["timestep"], ""
    for name, s in facts["plain"].items():
        lag = round(s["delay"] / step)
        late = f" delay_min_lag={lag}, delay_max_lag={lag}," if lag else ""
        servos += (
            f'    BuiltinPositionActuatorCfg(\n        target_names_expr=("{name}",), stiffness={s["kp"]!r}, '
            f"damping={s['kd']!r}, effort_limit={s['effort_limit']!r},\n        armature={s['armature']!r}, "
            f"frictionloss={s['frictionloss']!r}, viscous_damping={s['damping']!r},{late}\n    ),\n"
        )
    return (
        f"{_head(robot, 'mjlab', facts)}from mjlab.actuator import BuiltinPositionActuatorCfg\n\n"
        f"ACTUATORS = (  # EntityArticulationInfoCfg(actuators=ACTUATORS); {_rounded(facts)}\n{servos})\n"
        f"{OFFSETS}OFFSETS = {_column(facts, 'offset')}\nTIMESTEP, DECIMATION = {step!r}, {facts['decimation']}\n"
    )


def isaaclab_config(robot: str, facts: dict[str, Any]) -> str:
    """For Isaac Lab 3, on a USD without drives."""
    step, groups = facts["options"]["timestep"], dict[int, list[str]]()
    for name, s in facts["plain"].items():
        groups.setdefault(round(s["delay"] / step), []).append(name)
    fields = {"stiffness": "kp", "damping": "kd", "actuator_effort_limit": "effort_limit", "armature": "armature",
              "friction": "frictionloss", "viscous_friction": "damping"}  # fmt: skip
    servos = ""
    for lag, names in groups.items():
        servos += f'    "servos_{lag}": DelayedPDActuatorCfg(\n        joint_names_expr={names!r},\n'
        servos += f"        min_delay={lag}, max_delay={lag},\n"
        for theirs, ours in fields.items():
            servos += f"        {theirs}={_column(facts, ours, names)},\n"
        servos += "    ),\n"
    return (
        f"{_head(robot, 'Isaac Lab', facts)}from isaaclab.actuators import DelayedPDActuatorCfg\n\n"
        f"ACTUATORS = {{  # of ArticulationCfg; {_rounded(facts)}\n{servos}}}\n"
        f"{OFFSETS}OFFSETS = {_column(facts, 'offset')}\n"
    )


def newton_config(robot: str, facts: dict[str, Any]) -> str:
    """For Newton's ModelBuilder."""
    fields = {"joint_target_ke": "kp", "joint_target_kd": "kd", "joint_effort_limit": "effort_limit",
              "joint_armature": "armature", "joint_friction": "frictionloss"}  # fmt: skip
    numbers = "".join(f'    "{theirs}": {_column(facts, ours)},\n' for theirs, ours in fields.items())
    return (
        f"{_head(robot, 'Newton', facts)}SERVOS = {{  # of a ModelBuilder, by joint; robot.xml has "
        f"armature, damping and friction as well\n{numbers}}}\n{OFFSETS}OFFSETS = {_column(facts, 'offset')}\n"
        "# Newton's servos are not late: targets go through mujoco_servos.delay_weights, as in check.py.\n"
        f"DELAYS = {_column(facts, 'delay')}\n"
    )


DRAKE = '''def add_servos(plant):
    """Actuators, before plant.Finalize(). Drake's gains act implicitly in a discrete plant, which adds kp * step of
    damping: that much is taken off."""
    for name, s in SERVOS.items():
        joint, d = plant.GetJointByName(name), s["kd"] - s["kp"] * plant.time_step()
        actuator = plant.AddJointActuator(name, joint, s["effort_limit"])
        actuator.set_default_gear_ratio(1.0)
        actuator.set_default_rotor_inertia(s["armature"])
        actuator.set_controller_gains(PdControllerGains(p=s["kp"], d=max(d, 0.0)))
        joint.set_default_damping(max(s["damping"] + min(d, 0.0), 0.0))


def friction(plant, context, target, sweeps=10):
    """What Drake's joints lack, for the input of applied generalized forces, N m: as much of each joint's friction as
    brings it to rest in this step, by Gauss and Seidel; target: rad, of SERVOS in their order."""
    servos, step = SERVOS.values(), plant.time_step()
    column = {field: np.array([s[field] for s in servos]) for field in next(iter(servos))}
    joints = [plant.GetJointByName(name) for name in SERVOS]
    at, dof = [j.position_start() for j in joints], [j.velocity_start() for j in joints]
    inertia, speed = plant.CalcMassMatrix(context), plant.GetVelocities(context)
    force = plant.CalcGravityGeneralizedForces(context) - plant.CalcBiasTerm(context)
    asked = column["kp"] * (target - plant.GetPositions(context)[at])
    force[dof] += np.clip(asked, -column["effort_limit"], column["effort_limit"])
    held = inertia.copy()
    held[dof, dof] += step * (column["damping"] + column["kd"])
    moved = np.linalg.inv(held)
    after, told = moved @ (inertia @ speed + step * force), np.zeros(len(speed))
    for _ in range(sweeps):
        for i, loss in zip(dof, column["frictionloss"]):
            now = np.clip(told[i] - after[i] / (step * moved[i, i]), -loss, loss)
            after += step * moved[:, i] * (now - told[i])
            told[i] = now
    return told
'''


def drake_config(robot: str, facts: dict[str, Any]) -> str:
    """For Drake's MultibodyPlant."""
    fields = ("kp", "kd", "effort_limit", "armature", "damping", "frictionloss")
    numbers = {name: {f: s[f] for f in fields} for name, s in facts["plain"].items()}
    servos = "".join(f"    {name!r}: {told!r},\n" for name, told in numbers.items())
    return (
        f"{_head(robot, 'Drake', facts)}import numpy as np\nfrom pydrake.multibody.tree import PdControllerGains\n\n"
        f"SERVOS = {{\n{servos}}}\n"
        f"# A servo aims at its target plus this, rad.\nOFFSETS = {_column(facts, 'offset')}\n"
        "# Drake's actuators are not late: targets go through mujoco_servos.delay_weights, as in check.py.\n"
        f"DELAYS = {_column(facts, 'delay')}\n\n\n{DRAKE}"
    )


def _head(robot: str, engine: str, facts: dict[str, Any]) -> str:
    law = ", ".join(facts["law"])
    lost = f" Its law ({law}) is not here; these numbers were fitted without it." if law else ""
    return f'"""Servos of {robot} as identified, for {engine}; SI units.{lost}"""\n\n'


def _rounded(facts: dict[str, Any]) -> str:
    step = facts["options"]["timestep"]
    most = max(abs(s["delay"] - step * round(s["delay"] / step)) for s in facts["plain"].values())
    return f"delays are whole steps of {1e3 * step:g} ms, by at most {1e3 * most:.1f} ms off"


def _column(facts: dict[str, Any], field: str, names: list[str] | None = None) -> str:
    return repr({name: s[field] for name, s in facts["plain"].items() if names is None or name in names})


CONFIGS = {"mjlab": mjlab_config, "isaaclab": isaaclab_config, "newton": newton_config, "drake": drake_config}
