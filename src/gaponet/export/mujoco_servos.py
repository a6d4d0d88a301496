"""Identified servos in plain MuJoCo; copied beside exports, it needs MuJoCo and numpy, not gaponet.

servos = Servos(model, read("facts.json"))     # once; prefix="left/" where the robot was attached to a scene
data.ctrl[...] = …; servos.before(data); mujoco.mj_step(model, data)     # mj_forward after a change of state
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np

from gaponet.sim.servo import friction_limit, present, servo_torque

LAW = ("stribeck", "stribeck_speed", "friction_motor", "friction_external", "min_torque", "encoder_step")


def read(path: str | Path) -> dict[str, Any]:
    """The facts of an export."""
    facts: dict[str, Any] = json.loads(Path(path).read_text(encoding="utf-8"))
    if facts["format"] != 2:
        raise ValueError(f"{path}: of another version of gaponet; export the robot again")
    return facts


class Servos:
    """The joints of a compiled model as identified: numbers are set at once, the law before each step."""

    def __init__(self, model: Any, facts: dict[str, Any], prefix: str = "", form: str = "joints") -> None:
        """Joints and servos are found by name; form "plain": the numbers that were fitted without the law."""
        import mujoco

        joints = facts[form]
        numbers = [f for f, value in next(iter(joints.values())).items() if isinstance(value, int | float)]
        column = {f: np.array([j.get(f, 0.0) for j in joints.values()]) for f in numbers}
        ids = [model.joint(prefix + name).id for name in joints]
        self.model, self.dof, self.at = model, model.jnt_dofadr[ids], model.jnt_qposadr[ids]
        self.servo = np.array([np.flatnonzero(model.actuator_trnid[:, 0] == j)[0] for j in ids])
        self.kp, self.frictionloss = column["kp"], column["frictionloss"]
        self.bias = self.kp * column["offset"]
        model.dof_armature[self.dof], model.dof_damping[self.dof, ...] = column["armature"], column["damping"]
        model.actuator_gainprm[self.servo, 0], model.actuator_biasprm[self.servo, 0] = self.kp, self.bias
        model.actuator_biasprm[self.servo, 1], model.actuator_biasprm[self.servo, 2] = -self.kp, -column["kd"]
        model.dof_frictionloss[self.dof] = self.frictionloss
        model.qpos0[self.at] += np.array([facts["plain"][name]["zero"] for name in joints]) - column["zero"]
        if model.nhistory:
            model.actuator_delay[self.servo] = column["delay"]
        mujoco.mj_setConst(model, mujoco.MjData(model))
        model.dof_invweight0[self.dof] *= facts["dof_invweight0_factor"]  # friction that holds; no MJCF can say it
        self.law = present({name: column[name] for name in LAW if name in column})

    def before(self, data: Any) -> None:
        """Set bias and friction for the next physics step, under data.ctrl."""
        if not self.law:
            return
        model, torque, load = self.model, data.actuator_force[self.servo], data.qfrc_bias[self.dof]
        model.dof_frictionloss[self.dof] = friction_limit(
            self.law, self.frictionloss, data.qvel[self.dof], torque, load
        )
        if "encoder_step" in self.law or "min_torque" in self.law:
            q, ctrl = data.qpos[self.at], data.ctrl[self.servo]
            asked = servo_torque(self.law, self.kp, ctrl + self.bias / self.kp, q)
            model.actuator_biasprm[self.servo, 0] = asked - self.kp * (ctrl - q)


def begin(model: Any, data: Any, joints: list[str], qpos: Any, qvel: Any, ctrl: Any, prefix: str = "") -> Any:
    """Put joints into a state, under commands that have stood for ever; returns the places of their servos in ctrl."""
    import mujoco

    mujoco.mj_resetData(model, data)
    ids = [model.joint(prefix + name).id for name in joints]
    servo = np.array([np.flatnonzero(model.actuator_trnid[:, 0] == j)[0] for j in ids])
    data.qpos[model.jnt_qposadr[ids]], data.qvel[model.jnt_dofadr[ids]], data.ctrl[servo] = qpos, qvel, ctrl
    for i, value in zip(servo, ctrl, strict=True):
        if model.nhistory and model.actuator_history[i, 0]:
            mujoco.mj_initCtrlHistory(model, data, i, None, np.full(model.actuator_history[i, 0], float(value)))
    mujoco.mj_forward(model, data)
    return servo


def play(model: Any, facts: dict[str, Any], motion: dict[str, Any], prefix: str = "", form: str = "joints") -> Any:
    """Play a recorded motion in plain MuJoCo from its first state; (T, n) rad of the joints that were recorded.

    Args:
        model: Compiled; its physics step is stretched to divide the recording's period.
        facts: The export's facts.
        motion: One of check.npz: ctrl, qpos, qvel (T, n), dt.
        prefix: What the model has before each joint's name.
        form: "joints": with the law; "plain": the model as it is.
    """
    import mujoco

    names, ctrl, qpos = list(facts["joints"]), motion["ctrl"], np.array(motion["qpos"])
    steps = max(1, round(float(motion["dt"]) / model.opt.timestep))
    model.opt.timestep = float(motion["dt"]) / steps
    servos, data = Servos(model, facts, prefix) if form == "joints" else None, mujoco.MjData(model)
    servo = begin(model, data, names, qpos[0], motion["qvel"][0], ctrl[0], prefix)
    at = model.jnt_qposadr[[model.joint(prefix + name).id for name in names]]
    for t in range(len(ctrl) - 1):
        data.ctrl[servo] = ctrl[t]
        for _ in range(steps):
            if servos is not None:
                servos.before(data)
            mujoco.mj_step(model, data)
        qpos[t + 1] = data.qpos[at]
    return qpos


def motions(path: str | Path) -> list[dict[str, Any]]:
    """The motions of check.npz."""
    held = np.load(path)
    return [{name: held[f"{name}_{i}"] for name in ("ctrl", "qpos", "qvel", "dt")} for i in range(int(held["count"]))]


class Turns:
    """Motions one after the other in a few worlds, so that worlds begin anew while others go on.

    Attributes:
        ctrl: (T, worlds, n) rad; where a world has no motion left its last command stands.
        begins: Period → motion that each of some worlds begins there.
    """

    def __init__(self, motions: list[dict[str, Any]], worlds: int = 3) -> None:
        self.motions, self.worlds = motions, min(worlds, len(motions))
        free, played, self.begins = [0] * self.worlds, [], dict[int, dict[int, int]]()
        for i, motion in enumerate(motions):
            world = int(np.argmin(free))
            played.append((free[world], world))
            self.begins.setdefault(free[world], {})[world] = i
            free[world] += len(motion["ctrl"]) - 1
        self.played = played
        self.ctrl = np.zeros((max(free), self.worlds, motions[0]["ctrl"].shape[1]))
        for (row, world), motion in zip(played, motions, strict=True):
            self.ctrl[row:, world] = motion["ctrl"][-1]
            self.ctrl[row : row + len(motion["ctrl"]) - 1, world] = motion["ctrl"][:-1]

    def error(self, found: Any, columns: list[int]) -> float:
        """Mean |error| over the motions, rad; found: joints after each period, (T, worlds, n) rad."""
        errors = []
        for (row, world), motion in zip(self.played, self.motions, strict=True):
            qpos = motion["qpos"][1:]
            errors.append(np.abs(np.asarray(found)[row : row + len(qpos), world] - qpos)[:, columns].mean())
        return float(np.mean(errors))


def delay_weights(delay: Any, step: float) -> Any:
    """For engines whose actuators have no delay: the share of the last physics steps' commands in what servos are told.

    past = np.concatenate([ctrl[None], past[:-1]])   # (depth, n), newest first; at the start the first command repeated
    told = (weights * past).sum(0)                   # as MuJoCo's delay with interp="linear"

    Args:
        delay: (n,) s.
        step: Physics step, s.

    Returns:
        (depth, n), the newest command first.
    """
    steps = np.asarray(delay, float) / step
    age = np.arange(int(np.ceil(steps.max(initial=0.0) - 1e-9)) + 1)[:, None]
    return np.maximum(0.0, 1.0 - abs(age - steps))
