"""In an environment with mjlab: play targets on an export under its servos and its action term;
hand back the motion.

Two of the robot stand in one scene; the other one is told the targets of another world, its joints
in another order.

python mjlab_peer.py EXPORT IN.npz OUT.npz     # IN: test_mjlab.py writes it
"""

from __future__ import annotations

import sys
from pathlib import Path

import mujoco
import numpy as np
import torch
from mjlab.envs import ManagerBasedRlEnv, ManagerBasedRlEnvCfg
from mjlab.managers.event_manager import EventTermCfg
from mjlab.scene import SceneCfg
from mjlab.sim import SimulationCfg

KINDS = {
    "jnt": mujoco.mjtObj.mjOBJ_JOINT,
    "dof": mujoco.mjtObj.mjOBJ_JOINT,
    "body": mujoco.mjtObj.mjOBJ_BODY,
    "actuator": mujoco.mjtObj.mjOBJ_ACTUATOR,
}
NOT_COMPARED = (
    "id",
    "adr",
    "num",
    "group",
    "user",
    "plugin",
    "sameframe",
    "simple",
    "sensor",
    "ctrlspec",
    "delay",  # of MuJoCo: the actuators compute theirs
    "history",
)


def environment(
    folder: str, num_envs: int, start: torch.Tensor, names: list[str]
) -> ManagerBasedRlEnv:
    sys.path.insert(0, folder)
    import gaponet_action as gaponet

    options, decimation = gaponet.mjlab_options(folder)

    def begin(env, env_ids):
        for name, where in (("robot", start), ("other", start.roll(2, 0))):
            robot = env.scene[name]
            order = [names.index(name) for name in robot.joint_names]
            robot.write_joint_state_to_sim(
                where[env_ids][:, order], 0.0 * where[env_ids], env_ids=env_ids
            )

    cfg = ManagerBasedRlEnvCfg(
        decimation=decimation,
        scene=SceneCfg(
            num_envs=num_envs,
            entities={name: gaponet.mjlab_entity(folder) for name in ("robot", "other")},
        ),
        actions={
            "joint_pos": gaponet.mjlab_action(
                folder, entity_name="robot", actuator_names=tuple(reversed(names))
            ),
            "other": gaponet.mjlab_action(
                folder, entity_name="other", actuator_names=tuple(sorted(names))
            ),
        },
        events={
            "begin": EventTermCfg(func=begin, mode="reset"),
            **gaponet.mjlab_events(folder, "robot"),
            **gaponet.mjlab_events(folder, "other"),
        },
        sim=SimulationCfg(mujoco=options),
    )
    return ManagerBasedRlEnv(cfg, device="cpu")


def fields(env: ManagerBasedRlEnv) -> dict[str, np.ndarray]:
    """What is simulated, "FIELD NAME" → numbers: of the model on the device, or as compiled."""
    model, device, found = env.sim.mj_model, env.sim.wp_model, {}
    for field, compiled in ((f, getattr(model, f)) for f in dir(model)):
        kind = KINDS.get(field.split("_")[0])
        if kind is None or field.endswith(NOT_COMPARED) or not isinstance(compiled, np.ndarray):
            continue
        values = getattr(device, field).numpy() if hasattr(device, field) else compiled
        values = (
            values[0] if values.ndim > compiled.ndim or len(values) != len(compiled) else values
        )  # of one world
        for i in range(len(values)):
            name = mujoco.mj_id2name(
                model, kind, int(model.dof_jntid[i]) if field.startswith("dof_") else i
            )
            if name and name.startswith("robot/"):
                found[f"{field} {name.removeprefix('robot/')}"] = np.array(values[i], float)
    for name in dir(model.opt):
        value = getattr(model.opt, name)
        if not name.startswith("_") and np.asarray(value).dtype.kind in "fiu":
            found[f"opt {name}"] = np.array(value, float)
    return found


def main(folder: str, given: str, out: str) -> None:
    data = np.load(given)
    names, targets = data["names"].tolist(), torch.from_numpy(data["targets"]).float()
    start = torch.from_numpy(data["start"]).float()
    env = environment(folder, targets.shape[1], start[0], names)
    simulated = fields(env)  # a servo's law changes them from step to step
    env.reset()
    robot, other = env.scene["robot"], env.scene["other"]
    asked, theirs = (
        [names.index(name) for name in env.action_manager.get_term(term).target_names]
        for term in ("joint_pos", "other")
    )
    order = [list(robot.joint_names).index(name) for name in names]
    qpos, sent, beside = [], [], []
    for t, target in enumerate(targets):
        if t == int(data["reset_at"]):
            start[0] = start[1]  # what `begin` writes
            env.reset(env_ids=torch.from_numpy(data["reset_ids"]))
        env.step(torch.cat([target[:, asked], target.roll(2, 0)[:, theirs]], dim=1))
        beside.append(other.data.joint_pos[:, order].roll(-2, 0).clone())
        qpos.append(robot.data.joint_pos[:, order].clone())
        sent.append(robot.data.joint_pos_target[:, order].clone())
    np.savez(
        out, qpos=torch.stack(qpos), beside=torch.stack(beside), sent=torch.stack(sent), **simulated
    )


if __name__ == "__main__":
    main(*map(str, map(Path, sys.argv[1:])))
