"""Play the motions of check.npz in MJX. MJX ignores actuators' delays; a buffer is used here. python check_mjx.py"""

from pathlib import Path
from typing import Any

import jax
import jax.numpy as jp
import mujoco
import numpy as np
from mujoco import mjx

from gaponet.export.shipped.mujoco_servos import Check, addresses, delay_weights

jax.config.update("jax_enable_x64", True)  # in single precision friction does not hold as it should
HERE = Path(__file__).parent
check = Check(HERE)
spec = mujoco.MjSpec.from_file(str(HERE / check.facts["file"]))
for servo in spec.actuators:
    servo.delay = servo.nsample = 0
model, dt = spec.compile(), check.step * check.facts["decimation"]
steps = round(dt / model.opt.timestep)
model.opt.timestep = dt / steps
dof, at, servo = addresses(model, check.names, check.facts["prefix"])
weights = jp.array(
    delay_weights([joint["delay"] for joint in check.facts["plain"].values()], model.opt.timestep)
)
device = mjx.put_model(model)
home = mjx.make_data(model)
fresh, start = np.zeros(check.ctrl.shape[:2], bool), np.zeros((2, *check.ctrl.shape))
for row, motions in check.starts.items():
    for world, motion in motions.items():
        fresh[row, world], start[:, row, world] = (
            True,
            [motion[field][0] for field in ("qpos", "qvel")],
        )


def step(carry: Any, _: Any) -> Any:
    data, past, ctrl = carry
    past = jp.concatenate([ctrl[None], past[:-1]])
    data = mjx.step(device, data.replace(ctrl=data.ctrl.at[servo].set((weights * past).sum(0))))
    return (data, past, ctrl), None


def period(carry: Any, row: Any) -> Any:
    ctrl, fresh, qpos, qvel = row
    new = (
        home.replace(qpos=home.qpos.at[at].set(qpos), qvel=home.qvel.at[dof].set(qvel)),
        jp.tile(ctrl, (len(weights), 1)),
    )
    carry = jax.tree.map(lambda a, b: jp.where(fresh, a, b), new, carry)
    (data, past, _), _ = jax.lax.scan(step, (*carry, ctrl), None, steps)
    return (data, past), data.qpos[at]


first = jax.tree.map(
    lambda x: jp.stack([x] * check.worlds), (home, jp.zeros((len(weights), len(check.names))))
)
rows = tuple(map(jp.array, (check.ctrl, fresh, *start)))
check.report("MJX", jax.jit(lambda c, x: jax.lax.scan(jax.vmap(period), c, x)[1])(first, rows))
