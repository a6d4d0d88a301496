"""A MuJoCo loop of one's own becomes an aligned one: look the joints up once, correct ctrl before mj_step."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from gaponet.arrays import Array
from gaponet.errors import ModelError
from gaponet.model.artifact import GapModel

if TYPE_CHECKING:
    import mujoco

GAIN_TOLERANCE = 1e-3  # of kp and kd


class MujocoAligner:
    """ctrl → ctrl + Δa for a model with a position actuator on each operated joint; one MjData, one control period.

    align = MujocoAligner(GapModel.load("run"), mj_model, dt=0.02, payload_mass=3.0)
    data.ctrl[:] = align(data, target)                    # once per control period
    mujoco.mj_step(mj_model, data, round(0.02 / mj_model.opt.timestep))
    """

    def __init__(
        self,
        model: GapModel,
        mj_model: mujoco.MjModel,
        dt: float,
        payload_mass: float,
        prefix: str = "",
        extrapolate: bool = False,
    ) -> None:
        """Refuse a scene in which a joint, its actuator or its gains are not those trained on; another rate or payload.

        Args:
            model: What training made.
            mj_model: The compiled scene.
            dt: Control period, s.
            payload_mass: kg in each hand. Give the scene that mass as well.
            prefix: What stands before the robot's names in the scene ("left/").
            extrapolate: Take a payload beyond those trained on.
        """
        model.require_rate(dt)
        model.require_payload(payload_mass, extrapolate)
        self.loop, self.payload_mass = model.loop(), payload_mass
        card, names = model.card, [prefix + name for name in model.card["joint_names"]]
        known = [mj_model.joint(j).name for j in range(mj_model.njnt)]
        for name in names:
            if name not in known:
                raise ModelError(
                    f"{model.path}: corrects joint '{name}', the scene has {', '.join(known)}; give prefix"
                )
        self.qpos = np.array([mj_model.joint(name).qposadr[0] for name in names])
        self.qvel = np.array([mj_model.joint(name).dofadr[0] for name in names])
        joint_of = mj_model.actuator_trnid[:, 0]
        self.actuator = np.zeros(len(names), int)
        for k, name in enumerate(names):
            mine = np.flatnonzero(joint_of == mj_model.joint(name).id)
            if len(mine) != 1:
                raise ModelError(
                    f"joint '{name}' has {len(mine)} actuators in the scene; the model needs one, position"
                )
            self.actuator[k] = mine[0]
            kp, kd = mj_model.actuator_gainprm[mine[0], 0], -mj_model.actuator_biasprm[mine[0], 2]
            for what, is_, was in (("kp", kp, card["kp"][k]), ("kd", kd, card["kd"][k])):
                if abs(is_ - was) > GAIN_TOLERANCE * max(abs(was), 1.0):
                    raise ModelError(
                        f"joint '{name}': {what} is {is_:g} in the scene, the model was trained with {was:g}; "
                        "set the gains trained with (card.json), or train again"
                    )

    def reset(self) -> None:
        """Forget the past, because another motion begins."""
        self.loop.reset()

    def __call__(self, data: mujoco.MjData, ctrl: Array) -> Array:
        """Targets to apply, (nu,) rad, given those asked for; once per control period."""
        out = np.array(ctrl, float)
        a = out[self.actuator]
        self.loop.delta(data.qpos[self.qpos], data.qvel[self.qvel], a, self.payload_mass)
        out[self.actuator] = self.loop.applied[0]
        return out
