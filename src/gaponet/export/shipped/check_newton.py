"""Play the motions of check.npz in Newton (MuJoCo-Warp), and print the error beside gaponet's.

The servos are PD servos, or neural drives for actuator networks.

Newton ignores actuators' delays; PD servos get their targets through a buffer here. Neural drives
need onnx and warp-nn.
"""

from pathlib import Path
from typing import Any

import newton
import numpy as np
import warp as wp

from gaponet.export.shipped.mujoco_servos import Check, Motion, delay_weights

HERE = Path(__file__).parent
check = Check(HERE)
facts = check.facts
names = check.names
worlds = check.worlds
networks = "actuator_net" in facts
step = facts["actuator_net"]["step"] if networks else check.step
robot = newton.ModelBuilder()
newton.solvers.SolverMuJoCo.register_custom_attributes(robot)
robot.add_mjcf(str(HERE / facts["file"]), enable_self_collisions=False, parse_mujoco_options=False)
labels = [label.rsplit("/", 1)[-1] for label in robot.joint_label]
joints = [labels.index(name) for name in names]
dof = [robot.joint_qd_start[i] for i in joints]
at = [robot.joint_q_start[i] for i in joints]
if networks:
    for i, k, name in zip(dof, at, names, strict=True):
        robot.add_actuator(
            newton.actuators.DriveNeuralMLP,
            index=i,
            pos_index=k,
            model_path=str(HERE / f"{name}.onnx"),
        )
else:
    import robot_cfg

    for field, values in robot_cfg.SERVOS.items():
        for i, name in zip(dof, names, strict=True):
            getattr(robot, field)[i] = values[name]
    for i in dof:
        robot.joint_target_mode[i] = int(newton.JointTargetMode.POSITION)
scene = newton.ModelBuilder()
newton.solvers.SolverMuJoCo.register_custom_attributes(scene)
scene.replicate(robot, worlds)
model = scene.finalize(device="cpu")
fields = ("integrator", "tolerance", "iterations", "ls_iterations", "jacobian")
options = {field: facts["options"][field] for field in fields}
solver = newton.solvers.SolverMuJoCo(model, disable_contacts=True, **options)
states = [model.state(), model.state()]
control = model.control()


def rows(x: Any) -> Any:
    """Return an array of all worlds, (worlds, numbers of each)."""
    return x.numpy().reshape(worlds, -1)


target = 0.0 * rows(model.joint_q)
histories = (
    [[actuator.state(), actuator.state()] for actuator in model.actuators] if networks else []
)
delay = np.zeros(len(names))
offset = np.zeros(len(names))
if not networks:
    delay = np.array([robot_cfg.DELAYS[name] for name in names])
    offset = np.array([robot_cfg.OFFSETS[name] for name in names])
weights = delay_weights(delay, step)[:, None]
past = np.zeros((len(weights), worlds, len(names)))


def start(motions: dict[int, Motion], ctrl: Any) -> None:
    q = rows(states[0].joint_q).copy()
    v = rows(states[0].joint_qd).copy()
    for world, motion in motions.items():
        q[world, at] = motion["qpos"][0]
        v[world, dof] = motion["qvel"][0]
        past[:, world] = ctrl[world]
    states[0].joint_q.assign(q.ravel())
    states[0].joint_qd.assign(v.ravel())
    newton.eval_fk(model, states[0].joint_q, states[0].joint_qd, states[0])
    target[:, at] = ctrl
    for actuator, (history, _) in zip(model.actuators if networks else [], histories, strict=True):
        errors = history.drive_state.pos_error_history.numpy()
        places = actuator.pos_indices.numpy()
        fresh = [i for i, place in enumerate(places) if place // q.shape[1] in motions]
        # as if the command had always been in force
        errors[:, fresh] = (target.ravel() - q.ravel())[places[fresh]]
        history.drive_state.pos_error_history.assign(errors)


def period(ctrl: Any) -> Any:
    for _ in range(facts["decimation"]):
        past[:] = np.concatenate([ctrl[None], past[:-1]])
        target[:, at] = (weights * past).sum(0) + offset
        control.joint_target_q.assign(target.ravel().astype(np.float32))
        if networks:
            control.joint_f.zero_()
        for actuator, history in zip(model.actuators if networks else [], histories, strict=True):
            actuator.step(states[0], control, *history, step)
            history.reverse()
        solver.step(states[0], states[1], control, None, step)
        states.reverse()
    return rows(states[0].joint_q)[:, at].copy()


form, what = ("actuator networks", "'s neural drives") if networks else ("plain", "")
check.report(
    f"Newton {newton.__version__}{what}, warp {wp.__version__}", check.run(start, period), form
)
