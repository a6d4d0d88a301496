"""Plays the motions of check.npz in Newton (MuJoCo-Warp), which drops actuators' delays: python check.py"""

from pathlib import Path

import newton
import numpy as np
import robot_cfg
import warp as wp

from gaponet_interop.engine.mujoco_servos import delay_weights, motions, read

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
scene, worlds = newton.ModelBuilder(), len(played)
newton.solvers.SolverMuJoCo.register_custom_attributes(scene)
scene.replicate(robot, worlds)
model = scene.finalize(device="cpu")
options = facts["options"]
solver = newton.solvers.SolverMuJoCo(
    model, disable_contacts=True, integrator=options["integrator"], tolerance=options["tolerance"],
    iterations=options["iterations"], ls_iterations=options["ls_iterations"], jacobian=options["jacobian"],
)  # fmt: skip
state, after, control = model.state(), model.state(), model.control()
set_to = lambda x: x.reshape(worlds, -1)[:, dof]  # noqa: E731
q, v = model.joint_q.numpy().reshape(worlds, -1), model.joint_qd.numpy().reshape(worlds, -1)
for world, motion in enumerate(played):
    q[world, dof], v[world, dof] = motion["qpos"][0], motion["qvel"][0]
state.joint_q.assign(q.ravel())
state.joint_qd.assign(v.ravel())
newton.eval_fk(model, state.joint_q, state.joint_qd, state)
weights = delay_weights([robot_cfg.DELAYS[name] for name in names], step)[:, None]
offset = np.array([robot_cfg.OFFSETS[name] for name in names])
rows = max(len(m["ctrl"]) for m in played)
ctrl = np.stack([np.concatenate([m["ctrl"], np.repeat(m["ctrl"][-1:], rows - len(m["ctrl"]), 0)]) for m in played], 1)
past, found, target = np.repeat(ctrl[:1], len(weights), 0), [], np.zeros_like(q)
for asked in ctrl[:-1]:
    for _ in range(facts["decimation"]):
        past = np.concatenate([asked[None], past[:-1]])
        target[:, dof] = (weights * past).sum(0) + offset
        control.joint_target_q.assign(target.ravel().astype(np.float32))
        solver.step(state, after, control, None, step)
        state, after = after, state
    found.append(set_to(state.joint_q.numpy()))
columns = [names.index(name) for name in facts["corrected"]]
errors = [np.abs(np.stack(found)[: len(m["qpos"]) - 1, i][:, columns] - m["qpos"][1:, columns]).mean()
          for i, m in enumerate(played)]  # fmt: skip
print(f"Newton {newton.__version__}, warp {wp.__version__}, {worlds} worlds: {1e3 * np.mean(errors):.2f} mrad; "
      f"in gaponet {facts['left_mrad']['plain']:.2f}")  # fmt: skip
