"""Plays the motions of check.npz in MJX, which drops actuators' delays: they are a buffer here. python check_mjx.py"""

from pathlib import Path
from typing import Any

import jax
import jax.numpy as jp
import mujoco
import numpy as np
from mujoco import mjx

from gaponet.export.mujoco_servos import Turns, delay_weights, motions, read

jax.config.update("jax_enable_x64", True)  # in single precision friction does not hold as it should
HERE = Path(__file__).parent
facts, played = read(HERE / "facts.json"), motions(HERE / "check.npz")
names, turns = [facts["prefix"] + name for name in facts["plain"]], Turns(played)
spec = mujoco.MjSpec.from_file(str(HERE / facts["file"]))
for servo in spec.actuators:
    servo.delay = servo.nsample = 0
model, dt = spec.compile(), float(np.median([m["dt"] for m in played]))
steps = round(dt / model.opt.timestep)
model.opt.timestep = dt / steps
at = np.array([model.joint(name).qposadr[0] for name in names])
dof = np.array([model.joint(name).dofadr[0] for name in names])
servo = np.array([np.flatnonzero(model.actuator_trnid[:, 0] == model.joint(name).id)[0] for name in names])
weights = jp.array(delay_weights([joint["delay"] for joint in facts["plain"].values()], model.opt.timestep))
device = mjx.put_model(model)
home = mjx.make_data(model)
begins, start = np.zeros(turns.ctrl.shape[:2], bool), np.zeros((2, *turns.ctrl.shape))
for row, begun in turns.begins.items():
    for world, motion in begun.items():
        begins[row, world], start[:, row, world] = True, [played[motion][field][0] for field in ("qpos", "qvel")]


def step(carry: Any, _: Any) -> Any:
    data, past, ctrl = carry
    past = jp.concatenate([ctrl[None], past[:-1]])
    data = mjx.step(device, data.replace(ctrl=data.ctrl.at[servo].set((weights * past).sum(0))))
    return (data, past, ctrl), None


def period(carry: Any, asked: Any) -> Any:
    ctrl, fresh, qpos, qvel = asked
    new = (
        home.replace(qpos=home.qpos.at[at].set(qpos), qvel=home.qvel.at[dof].set(qvel)),
        jp.tile(ctrl, (len(weights), 1)),
    )
    carry = jax.tree.map(lambda a, b: jp.where(fresh, a, b), new, carry)
    (data, past, _), _ = jax.lax.scan(step, (*carry, ctrl), None, steps)
    return (data, past), data.qpos[at]


first = jax.tree.map(lambda x: jp.stack([x] * turns.worlds), (home, jp.zeros((len(weights), len(names)))))
asked = tuple(map(jp.array, (turns.ctrl, begins, *start)))
found = jax.jit(lambda c, x: jax.lax.scan(jax.vmap(period), c, x)[1])(first, asked)
error = turns.error(found, [list(facts["plain"]).index(name) for name in facts["corrected"]])
print(f"MJX, {turns.worlds} worlds: {1e3 * error:.2f} mrad; in gaponet {facts['left_mrad']['plain']:.2f}")
