"""Plays the motions of check.npz in MJX, which drops actuators' delays: they are a buffer here. python check_mjx.py"""

from pathlib import Path
from typing import Any

import jax
import jax.numpy as jp
import mujoco
import numpy as np
from mujoco import mjx

from gaponet_interop.engine.mujoco_servos import delay_weights, motions, read

jax.config.update("jax_enable_x64", True)  # in single precision friction does not hold as it should
HERE = Path(__file__).parent
facts, errors = read(HERE / "facts.json"), []
names = [facts["prefix"] + name for name in facts["plain"]]
columns = [list(facts["plain"]).index(name) for name in facts["corrected"]]
for motion in motions(HERE / "check.npz"):
    spec = mujoco.MjSpec.from_file(str(HERE / facts["file"]))
    for servo in spec.actuators:
        servo.delay = servo.nsample = 0
    model, dt = spec.compile(), float(motion["dt"])
    steps = round(dt / model.opt.timestep)
    model.opt.timestep = dt / steps
    at = np.array([model.joint(name).qposadr[0] for name in names])
    dof = np.array([model.joint(name).dofadr[0] for name in names])
    servo = np.array([np.flatnonzero(model.actuator_trnid[:, 0] == model.joint(name).id)[0] for name in names])
    weights = jp.array(delay_weights([joint["delay"] for joint in facts["plain"].values()], model.opt.timestep))
    device = mjx.put_model(model)
    data = mjx.make_data(model)
    data = data.replace(qpos=data.qpos.at[at].set(motion["qpos"][0]), qvel=data.qvel.at[dof].set(motion["qvel"][0]))

    def step(carry: Any, _: Any, servo: Any = servo, weights: Any = weights, device: Any = device) -> Any:
        data, past, ctrl = carry
        past = jp.concatenate([ctrl[None], past[:-1]])
        data = mjx.step(device, data.replace(ctrl=data.ctrl.at[servo].set((weights * past).sum(0))))
        return (data, past, ctrl), None

    def period(carry: Any, ctrl: Any, step: Any = step, steps: int = steps, at: Any = at) -> Any:
        (data, past, _), _ = jax.lax.scan(step, (*carry, ctrl), None, steps)
        return (data, past), data.qpos[at]

    start = (data, jp.repeat(jp.array(motion["ctrl"][:1], float), len(weights), axis=0))
    played = jax.jit(lambda c, t, p=period: jax.lax.scan(p, c, t)[1])(start, jp.array(motion["ctrl"][:-1], float))
    errors.append(np.abs(np.asarray(played) - motion["qpos"][1:])[:, columns].mean())
print(f"MJX: {1e3 * np.mean(errors):.2f} mrad; in gaponet {facts['left_mrad']['plain']:.2f}")
