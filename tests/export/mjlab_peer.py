"""In an environment with mjlab: play targets on an export under its servos and its action term;
hand back the motion.

Two of the robot stand in one scene; the other one is told the targets of another world, its joints
in another order.

python mjlab_peer.py EXPORT IN.npz OUT.npz     # IN: test_mjlab.py writes it
"""

from __future__ import annotations

import sys

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


def of_another_world(values: torch.Tensor) -> torch.Tensor:
    """Rows of worlds as the other robot in each world gets them: those of two worlds before."""
    return values.roll(2, 0)


def of_own_world(values: torch.Tensor) -> torch.Tensor:
    """Undo `of_another_world`."""
    return values.roll(-2, 0)


def environment(
    folder: str, num_envs: int, start: torch.Tensor, names: list[str]
) -> ManagerBasedRlEnv:
    """Worlds with two of the robot each.

    Args:
        folder: Of the export.
        start: Positions at which worlds begin, (worlds, n) rad; read at each reset.
        names: Joints in the order of `start`.
    """
    sys.path.insert(0, folder)
    import gaponet_action as gaponet

    def begin(env, env_ids):
        for entity, positions in (("robot", start), ("other", of_another_world(start))):
            robot = env.scene[entity]
            order = [names.index(joint) for joint in robot.joint_names]
            at_rest = torch.zeros_like(positions[env_ids])
            robot.write_joint_state_to_sim(positions[env_ids][:, order], at_rest, env_ids=env_ids)

    options, decimation = gaponet.mjlab_options(folder)
    entities = {}
    for entity in ("robot", "other"):
        entities[entity] = gaponet.mjlab_entity(folder)
    actions = {
        "joint_pos": gaponet.mjlab_action(
            folder, entity_name="robot", actuator_names=tuple(reversed(names))
        ),
        "other": gaponet.mjlab_action(
            folder, entity_name="other", actuator_names=tuple(sorted(names))
        ),
    }
    events = {
        "begin": EventTermCfg(func=begin, mode="reset"),
        **gaponet.mjlab_events(folder, "robot"),
        **gaponet.mjlab_events(folder, "other"),
    }
    cfg = ManagerBasedRlEnvCfg(
        decimation=decimation,
        scene=SceneCfg(num_envs=num_envs, entities=entities),
        actions=actions,
        events=events,
        sim=SimulationCfg(mujoco=options),
    )
    return ManagerBasedRlEnv(cfg, device="cpu")


def is_compared(field: str, compiled: object) -> bool:
    """Whether a field of MuJoCo's model is an array that says how joints, bodies or actuators
    move.
    """
    is_of_kind = field.split("_")[0] in KINDS
    return is_of_kind and not field.endswith(NOT_COMPARED) and isinstance(compiled, np.ndarray)


def simulated_values(env: ManagerBasedRlEnv, field: str) -> np.ndarray:
    """A field of the model on the device, of one world; as compiled where the device has none."""
    compiled = getattr(env.sim.mj_model, field)
    if not hasattr(env.sim.wp_model, field):
        return compiled
    values = getattr(env.sim.wp_model, field).numpy()
    has_worlds = values.ndim > compiled.ndim or len(values) != len(compiled)
    return values[0] if has_worlds else values


def name_of_row(model: mujoco.MjModel, field: str, row: int) -> str:
    """The name of the joint, body or actuator in a row of a field; "" if it has none."""
    number = int(model.dof_jntid[row]) if field.startswith("dof_") else row
    return mujoco.mj_id2name(model, KINDS[field.split("_")[0]], number) or ""


def model_fields(env: ManagerBasedRlEnv) -> dict[str, np.ndarray]:
    """Numbers of the robot that are simulated, "FIELD NAME" → numbers."""
    model = env.sim.mj_model
    found = {}
    for field in dir(model):
        if not is_compared(field, getattr(model, field)):
            continue
        for row, values in enumerate(simulated_values(env, field)):
            name = name_of_row(model, field, row)
            if name.startswith("robot/"):
                found[f"{field} {name.removeprefix('robot/')}"] = np.array(values, float)
    return found


def option_fields(model: mujoco.MjModel) -> dict[str, np.ndarray]:
    """Numbers of MuJoCo's options, "opt FIELD" → numbers."""
    found = {}
    for name in dir(model.opt):
        value = getattr(model.opt, name)
        is_number = np.asarray(value).dtype.kind in "fiu"
        if is_number and not name.startswith("_"):
            found[f"opt {name}"] = np.array(value, float)
    return found


def columns_of(env: ManagerBasedRlEnv, term: str, names: list[str]) -> list[int]:
    """Where an action term's targets are in `names`."""
    return [names.index(name) for name in env.action_manager.get_term(term).target_names]


def main(folder: str, given: str, out: str) -> None:
    data = np.load(given)
    names = data["names"].tolist()
    targets = torch.from_numpy(data["targets"]).float()  # (T, worlds, n) rad
    starts = torch.from_numpy(data["start"]).float()  # at first and after the reset, as targets
    reset_at = int(data["reset_at"])
    reset_ids = torch.from_numpy(data["reset_ids"])
    start = starts[0].clone()  # what the worlds begin at
    env = environment(folder, targets.shape[1], start, names)
    simulated = model_fields(env) | option_fields(env.sim.mj_model)
    # A servo's law changes the fields from step to step, so they were read before the first.
    env.reset()
    robot = env.scene["robot"]
    other = env.scene["other"]
    robot_columns = columns_of(env, "joint_pos", names)
    other_columns = columns_of(env, "other", names)
    robot_order = [list(robot.joint_names).index(name) for name in names]
    other_order = [list(other.joint_names).index(name) for name in names]
    qpos = []
    sent = []
    beside = []
    for t, target in enumerate(targets):
        if t == reset_at:
            start[:] = starts[1]
            env.reset(env_ids=reset_ids)
        other_target = of_another_world(target)
        env.step(torch.cat([target[:, robot_columns], other_target[:, other_columns]], dim=1))
        qpos.append(robot.data.joint_pos[:, robot_order].clone())
        sent.append(robot.data.joint_pos_target[:, robot_order].clone())
        beside.append(of_own_world(other.data.joint_pos[:, other_order]).clone())
    motion = {"qpos": torch.stack(qpos), "beside": torch.stack(beside), "sent": torch.stack(sent)}
    np.savez(out, **motion, **simulated)


if __name__ == "__main__":
    main(*sys.argv[1:])
