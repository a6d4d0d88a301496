"""Plays the motions of check.npz in Newton under its neural drives (needs onnx and warp-nn): python check_newton.py"""

from pathlib import Path

import newton
import numpy as np
import warp as wp

from gaponet.export.mujoco_servos import Turns, motions, read

HERE = Path(__file__).parent
facts, played = read(HERE / "facts.json"), motions(HERE / "check.npz")
names, step = list(facts["joints"]), facts["actuator_net"]["step"]
robot = newton.ModelBuilder()
newton.solvers.SolverMuJoCo.register_custom_attributes(robot)
robot.add_mjcf(str(HERE / facts["file"]), enable_self_collisions=False, parse_mujoco_options=False)
labels = [label.rsplit("/", 1)[-1] for label in robot.joint_label]
dof = [robot.joint_qd_start[labels.index(name)] for name in names]
at = [robot.joint_q_start[labels.index(name)] for name in names]
for i, k, name in zip(dof, at, names, strict=True):
    robot.add_actuator(newton.actuators.DriveNeuralMLP, index=i, pos_index=k, model_path=str(HERE / f"{name}.onnx"))
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
pasts = [[actuator.state(), actuator.state()] for actuator in model.actuators]
found, target = [], 0.0 * rows(model.joint_q)
for row, asked in enumerate(turns.ctrl):
    target[:, at] = asked
    if begun := turns.begins.get(row):
        q, v = rows(state.joint_q).copy(), rows(state.joint_qd).copy()
        for world, motion in begun.items():
            q[world, at], v[world, dof] = played[motion]["qpos"][0], played[motion]["qvel"][0]
        state.joint_q.assign(q.ravel())
        state.joint_qd.assign(v.ravel())
        newton.eval_fk(model, state.joint_q, state.joint_qd, state)
        for actuator, (past, _) in zip(model.actuators, pasts, strict=True):  # as if it had stood so for ever
            held, places = past.drive_state.pos_error_history.numpy(), actuator.pos_indices.numpy()
            fresh = [i for i, place in enumerate(places) if place // q.shape[1] in begun]
            held[:, fresh] = (target.ravel() - q.ravel())[places[fresh]]
            past.drive_state.pos_error_history.assign(held)
    control.joint_target_q.assign(target.ravel().astype(np.float32))
    for _ in range(facts["decimation"]):
        control.joint_f.zero_()
        for actuator, both in zip(model.actuators, pasts, strict=True):
            actuator.step(state, control, *both, step)
            both.reverse()
        solver.step(state, after, control, None, step)
        state, after = after, state
    found.append(rows(state.joint_q)[:, at].copy())
error = turns.error(found, [names.index(name) for name in facts["corrected"]])
print(f"Newton {newton.__version__}'s neural drives, warp {wp.__version__}, {turns.worlds} worlds: "
      f"{1e3 * error:.2f} mrad; in gaponet {facts['left_mrad']['actuator networks']:.2f}")  # fmt: skip
