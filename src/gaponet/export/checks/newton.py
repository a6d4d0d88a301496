"""Plays the motions of check.npz in Newton (MuJoCo-Warp), which drops actuators' delays: python check.py"""

from pathlib import Path

import newton
import numpy as np
import robot_cfg
import warp as wp

from gaponet.export.mujoco_servos import Turns, delay_weights, motions, read

HERE = Path(__file__).parent
facts, played = read(HERE / "facts.json"), motions(HERE / "check.npz")
names = list(facts["plain"])
step = float(np.median([m["dt"] for m in played])) / facts["decimation"]
robot = newton.ModelBuilder()
newton.solvers.SolverMuJoCo.register_custom_attributes(robot)
robot.add_mjcf(str(HERE / facts["file"]), enable_self_collisions=False, parse_mujoco_options=False)
labels = [label.rsplit("/", 1)[-1] for label in robot.joint_label]
dof = [robot.joint_qd_start[labels.index(name)] for name in names]
for field, of in robot_cfg.SERVOS.items():
    for i, name in zip(dof, names, strict=True):
        getattr(robot, field)[i] = of[name]
for i in dof:
    robot.joint_target_mode[i] = int(newton.JointTargetMode.POSITION)
turns, scene = Turns(played), newton.ModelBuilder()
newton.solvers.SolverMuJoCo.register_custom_attributes(scene)
scene.replicate(robot, turns.worlds)
model = scene.finalize(device="cpu")
options = facts["options"]
solver = newton.solvers.SolverMuJoCo(
    model, disable_contacts=True, integrator=options["integrator"], tolerance=options["tolerance"],
    iterations=options["iterations"], ls_iterations=options["ls_iterations"], jacobian=options["jacobian"],
)  # fmt: skip
state, after, control = model.state(), model.state(), model.control()
rows = lambda x: x.numpy().reshape(turns.worlds, -1)  # noqa: E731
weights = delay_weights([robot_cfg.DELAYS[name] for name in names], step)[:, None]
offset = np.array([robot_cfg.OFFSETS[name] for name in names])
past, found, target = np.zeros((len(weights), turns.worlds, len(names))), [], 0.0 * rows(model.joint_q)
for row, asked in enumerate(turns.ctrl):
    if begun := turns.begins.get(row):
        q, v = rows(state.joint_q).copy(), rows(state.joint_qd).copy()
        for world, motion in begun.items():
            q[world, dof], v[world, dof] = played[motion]["qpos"][0], played[motion]["qvel"][0]
            past[:, world] = asked[world]
        state.joint_q.assign(q.ravel())
        state.joint_qd.assign(v.ravel())
        newton.eval_fk(model, state.joint_q, state.joint_qd, state)
    for _ in range(facts["decimation"]):
        past = np.concatenate([asked[None], past[:-1]])
        target[:, dof] = (weights * past).sum(0) + offset
        control.joint_target_q.assign(target.ravel().astype(np.float32))
        solver.step(state, after, control, None, step)
        state, after = after, state
    found.append(rows(state.joint_q)[:, dof].copy())
error = turns.error(found, [names.index(name) for name in facts["corrected"]])
print(f"Newton {newton.__version__}, warp {wp.__version__}, {turns.worlds} worlds: {1e3 * error:.2f} mrad; "
      f"in gaponet {facts['left_mrad']['plain']:.2f}")  # fmt: skip
