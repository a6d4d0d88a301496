"""Servos and action terms for mjlab and Isaac Lab that align the simulation with the robot.

This file is copied into exports; it needs torch, not gaponet.

    gaponet export RUN --to torch --out FOLDER       # a network, with the servos of its simulator
    gaponet export ROBOT --to mjlab --out FOLDER     # identified servos without a network
    gaponet export ROBOT --to isaaclab --out FOLDER  # the same for Isaac Lab

FOLDER then holds this file, facts.json and, of a run, delta.pt2. In mjlab:

    cfg.scene.entities["robot"] = mjlab_entity(FOLDER)
    cfg.sim.mujoco, cfg.decimation = mjlab_options(FOLDER)
    cfg.events |= mjlab_events(FOLDER)
    # and of a run, for its network:
    joints = {"entity_name": "robot", "actuator_names": (".*",)}
    cfg.actions["joint_pos"] = mjlab_action(FOLDER, **joints)

In Isaac Lab:

    cfg.scene.robot.actuators = isaaclab_actuators(FOLDER)
    cfg.actions.joint_pos = isaaclab_action(FOLDER, asset_name="robot", joint_names=[".*"])

Both action terms call process_actions once per control period. It replaces the targets of the
policy by targets that make the simulator move like the robot. Options are those of
JointPositionActionCfg.
"""

from __future__ import annotations

import dataclasses
import sys
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from gaponet.export.shipped.mjlab_servos import (
    FRICTION_FIELDS,
    SERVO_FIELDS,
    mjlab_servos,
)
from gaponet.export.shipped.mujoco_servos import Check, read
from gaponet.export.shipped.scene_facts import require_scene
from gaponet.export.shipped.unit_events import columns_of
from gaponet.export.shipped.unit_events import mjlab_units as mjlab_units

PROGRAM = "delta.pt2"
FACTS = "facts.json"
ROBOT = "robot.xml"


def read_facts(folder: str | Path) -> dict[str, Any]:
    """Read the facts.json of an export."""
    return read(Path(folder) / FACTS)


def _of_joints(servos: dict[str, Any], field: str, names: list[str]) -> list[float]:
    """Return a field of the joints `names`; 0 for joints that the export does not have."""
    return [servos.get(name, {}).get(field, 0.0) for name in names]


def tensor(values: Any) -> Tensor:
    """Return a tensor of joint data; Isaac Lab 3 wraps tensors."""
    wrapped: Tensor = getattr(values, "torch", values)
    return wrapped


class Past:
    """History of num_envs worlds, and the program that corrects their commands, if any.

    The program is that of export/torch_program.py.
    """

    def __init__(self, program: Any, num_envs: int, depth: int, n: int, device: Any) -> None:
        self.program = program
        self.frames = torch.zeros(num_envs, depth, 3 * n, device=device)
        self.fresh = torch.ones(num_envs, dtype=torch.bool, device=device)

    def reset(self, ids: Any = None) -> None:
        """Restart worlds (indices, a mask, a slice; None for all) with the next state."""
        # inference tensors cannot be written to outside inference mode
        self.fresh = self.fresh.clone()
        self.fresh[slice(None) if ids is None else ids] = True

    def delta(self, qpos: Tensor, qvel: Tensor, ctrl: Tensor, payload_mass: Tensor) -> Tensor:
        """Δa, (num_envs, n) rad; once per control period."""
        delta = torch.zeros_like(ctrl)
        if self.program is not None:
            delta, self.frames = self.program(
                qpos, qvel, ctrl, payload_mass, self.frames, self.fresh
            )
        self.fresh = torch.zeros_like(self.fresh)
        return delta


class Aligner:
    """Replaces targets by targets that make the simulator move like the robot.

    The targets are of `joint_names`, in any order.

    Attributes:
        payload_mass: kg in each hand, (num_envs,); may be written.
    """

    def __init__(
        self,
        folder: str | Path,
        joint_names: list[str],
        num_envs: int,
        device: Any,
        payload_mass: float | None = None,
    ) -> None:
        from torch.export.passes import move_to_device_pass

        facts = read_facts(folder)
        corrected = facts["corrected"]
        for name in corrected:
            if name not in joint_names:
                raise ValueError(
                    f"{folder}: corrects '{name}', which is not among {', '.join(joint_names)}"
                )
        self.columns = torch.tensor([joint_names.index(name) for name in corrected], device=device)
        ranges = []
        for name in joint_names:
            own = facts["joints"].get(name, {}).get("range")
            ranges.append(own or (-torch.inf, torch.inf))
        self.low, self.high = torch.tensor(ranges, device=device).T
        module = None
        if "model" in facts:
            try:
                program = torch.export.load(str(Path(folder) / PROGRAM))
            except KeyError as error:
                raise RuntimeError(
                    f"{folder}/{PROGRAM}: torch {torch.__version__} is too old for it; 2.11 does"
                ) from error
            module = move_to_device_pass(program, str(device)).module()
        self.past = Past(
            module, num_envs, facts.get("model", {}).get("depth", 1), len(corrected), device
        )
        mass = facts["payload_mass"] if payload_mass is None else payload_mass
        self.payload_mass = torch.full((num_envs,), float(mass), device=device)
        self.sent = torch.zeros(num_envs, len(joint_names), device=device)

    @property
    def refused_answers(self) -> int:
        """Number of the network's answers that were not finite, one per world and period.

        There it corrects nothing.
        """
        return 0 if self.past.program is None else int(self.past.program.refused)

    @torch.no_grad()
    def __call__(self, qpos: Tensor, qvel: Tensor, target: Tensor) -> Tensor:
        """Return the targets to send for this control period, (num_envs, joints) rad.

        Args:
            qpos, qvel: Present state, (num_envs, joints) rad and rad/s.
            target: (num_envs, joints) rad. A target that is not finite counts as the one sent last,
                and in worlds that restart as the present position.
        """
        last = torch.where(self.past.fresh[:, None], qpos, self.sent)
        target = torch.where(torch.isfinite(target), target, last)
        q = qpos[:, self.columns].float()
        v = qvel[:, self.columns].float()
        a = target[:, self.columns].float()
        out = target.clone()
        out[:, self.columns] = (a + self.past.delta(q, v, a, self.payload_mass)).to(out.dtype)
        self.sent = torch.minimum(torch.maximum(out, self.low), self.high)
        return self.sent


class AlignedAction:
    """Mix-in for JointPositionAction of both engines.

    It comes before that class among the base classes.

    Attributes:
        standing_command: Command in force before a world restarts, (num_envs, joints) rad; None for
            its position.
    """

    folder: Path
    payload_mass: float | None
    standing_command: Tensor | None = None
    _processed_actions: Tensor

    def align(
        self, entity: Any, ids: Any, names: list[str], offset: float = 0.0, form: str = "joints"
    ) -> None:
        """Load the export for the joints `names` of an entity, at its columns `ids`.

        Args:
            offset: Share of the servos' own offsets that the engine's actuators lack.
            form: Key of facts.json with the servos' numbers.
        """
        me: Any = self
        facts = read_facts(self.folder)
        if "model" in facts:
            dt = me._env.step_dt
            if abs(dt / facts["dt"] - 1) > 0.02:
                raise ValueError(
                    f"{self.folder}: its network has a control period of {facts['dt']} s, not "
                    f"{dt} s"
                )
        self.aligner = Aligner(self.folder, list(names), me.num_envs, me.device, self.payload_mass)
        offsets = _of_joints(facts[form], "offset", names)
        self.servo_offset = offset * torch.tensor(offsets, device=me.device)
        self._aligned = entity
        self._columns = ids

    def process_actions(self, actions: Tensor) -> None:
        super().process_actions(actions)  # type: ignore[misc]
        data = self._aligned.data
        ids = self._columns
        q = tensor(data.joint_pos)[:, ids]
        v = tensor(data.joint_vel)[:, ids]
        # mjlab subtracts it again
        bias = data.encoder_bias[:, ids] if hasattr(data, "encoder_bias") else 0.0
        self.restart(q, q if self.standing_command is None else self.standing_command)
        self._processed_actions = (
            self.aligner(q, v, self._processed_actions - bias) + bias + self.servo_offset
        )

    def restart(self, qpos: Tensor, command: Tensor) -> None:
        """Restart fresh worlds at a position, under a command that has been in force for long."""

    def reset(self, env_ids: Any = None, **other: Any) -> None:
        super().reset(env_ids, **other)  # type: ignore[misc]
        self.aligner.past.reset(env_ids)


class CheckPlayer:
    """Plays the motions of a `Check` in an environment of mjlab or Isaac Lab.

    It has one robot, "robot".
    """

    def __init__(self, check: Check) -> None:
        self.check = check
        # qpos and qvel in which worlds start
        self.start = torch.zeros(2, check.worlds, len(check.names))

    def reset_event(self) -> Any:
        """Return the function of an event term in mode "reset".

        A copy of it still reads this object.
        """

        def reset(env: Any, env_ids: Any) -> None:
            robot = env.scene["robot"]
            order = [self.check.names.index(name) for name in robot.joint_names]
            position = self.start[0][env_ids][:, order]
            velocity = self.start[1][env_ids][:, order]
            if hasattr(robot, "write_joint_state_to_sim_index"):  # Isaac Lab 3
                robot.write_joint_state_to_sim_index(
                    position=position, velocity=velocity, env_ids=env_ids
                )
            else:
                robot.write_joint_state_to_sim(position, velocity, env_ids=env_ids)

        return reset

    def run(self, env: Any, action_joints: list[str]) -> Any:
        """Play all motions with action term "joint_pos"; return positions, (T, worlds, n) rad."""
        robot = env.scene["robot"]
        term = env.action_manager.get_term("joint_pos")
        columns = [self.check.names.index(name) for name in action_joints]
        for actuator in robot.actuators:
            if hasattr(actuator, "servos"):  # of mjlab
                actuator.servos.starts_under_command = True
        order = [list(robot.joint_names).index(name) for name in self.check.names]

        def start(motions: dict[int, Any], ctrl: Any) -> None:
            for world, motion in motions.items():
                self.start[:, world] = torch.tensor([motion["qpos"][0], motion["qvel"][0]])
            env.reset(env_ids=torch.tensor(list(motions)))

        def step(ctrl: Any) -> Any:
            target = torch.tensor(ctrl, dtype=torch.float)[:, columns]
            # check motions start under a command that has been in force for long
            term.standing_command = target
            env.step(target)
            return tensor(robot.data.joint_pos)[:, order].clone().numpy()

        return self.check.run(start, step)


# ---- mjlab


def mjlab_action(
    folder: str | Path, payload_mass: float | None = None, check: bool = True, **options: Any
) -> Any:
    """Return a JointPositionActionCfg whose targets the network of a run corrects.

    `check` refuses a scene that is not the simulator of training. Without a network, mjlab's own
    class does.
    """
    from mjlab.envs.mdp.actions import JointPositionAction, JointPositionActionCfg

    class Term(AlignedAction, JointPositionAction):
        def __init__(self, cfg: Any, env: Any) -> None:
            super().__init__(cfg, env)
            self.folder = Path(folder)
            self.payload_mass = payload_mass
            self.align(self._entity, self._target_ids, self._target_names)
            if check:
                delays = ("actuator_delay", "actuator_history")  # are computed in IdentifiedServo
                require_scene(env.sim.mj_model, f"{cfg.entity_name}/", self.folder, delays)

    class Cfg(JointPositionActionCfg):
        def build(self, env: Any) -> Any:
            return Term(self, env)

    return Cfg(**{"use_default_offset": False} | options)


def mjlab_entity(folder: str | Path, **options: Any) -> Any:
    """Return the robot with its servos, at its home position; options are those of EntityCfg."""
    import mujoco
    from mjlab.entity import EntityArticulationInfoCfg, EntityCfg

    home = {name: joint["home"] for name, joint in read_facts(folder)["joints"].items()}
    own = {
        "articulation": EntityArticulationInfoCfg(actuators=(mjlab_servos(folder),)),
        "init_state": EntityCfg.InitialStateCfg(joint_pos=home),
    } | options
    return EntityCfg(spec_fn=lambda: mujoco.MjSpec.from_file(str(Path(folder) / ROBOT)), **own)


def mjlab_events(folder: str | Path, entity: str = "robot") -> dict[str, Any]:
    """Return the event by which each world has friction of its own, as stiff as in training."""
    from mjlab.managers.event_manager import EventTermCfg, requires_model_fields

    @requires_model_fields(*FRICTION_FIELDS, *SERVO_FIELDS)
    def stiffen(env: Any, env_ids: Any) -> None:
        hold_friction(env.sim, entity, folder)

    return {f"{entity}_servos": EventTermCfg(func=stiffen, mode="startup")}


def mjlab_options(folder: str | Path) -> tuple[Any, int]:
    """Return MujocoCfg and decimation of the simulator of training.

    If links touched nothing in training, remove "contact" from its disableflags for a scene with a
    floor; robot.xml says which geoms touch.
    """
    from mjlab.sim import MujocoCfg

    facts = read_facts(folder)
    fields = {field.name for field in dataclasses.fields(MujocoCfg)}
    options = {name: value for name, value in facts["options"].items() if name in fields}
    return MujocoCfg(**options), facts["decimation"]


def hold_friction(sim: Any, entity: str, folder: str | Path) -> None:
    """Make joint friction as stiff as in training, which no MJCF can express.

    Call it again after events that recompute the constants of the model.
    """
    facts = read_facts(folder)
    for name in facts["joints"]:
        dof = sim.mj_model.joint(f"{entity}/{name}").dofadr[0]
        stiff = float(sim.mj_model.dof_invweight0[dof]) * facts["dof_invweight0_factor"]
        sim.model.dof_invweight0[:, dof] = stiff


# ---- Isaac Lab


class DelayedAction:
    """Mix-in that delays commands in the action term.

    Worlds start at rest, and no delay is rounded to a step.
    """

    def set_delays(self, delay: Any) -> None:
        """Set the delays of the term's joints, s, (num_envs, n) or (1, n)."""
        me: Any = self
        self.delay = torch.as_tensor(delay, device=me.device, dtype=torch.float)
        steps = self.delay / me._env.physics_dt
        age = torch.arange(int(torch.ceil(steps.max() - 1e-5)) + 1, device=me.device)[:, None, None]
        if len(age) > 1 and getattr(me._env, "_physics_handles_decimation", False):
            raise ValueError(
                "servos are late by parts of a control period: cfg.sim.use_newton_actuators = False"
            )
        self.weights = (1 - (age - steps).abs()).clamp(min=0)
        past = getattr(
            self, "commands", torch.zeros(1, me.num_envs, self.delay.shape[1], device=me.device)
        )
        self.commands = past[age[:, 0, 0].clamp(max=len(past) - 1)]  # newest first

    def set_units(self, env_ids: Tensor, joints: list[str], units: dict[str, Tensor]) -> None:
        """Give worlds the delays and offsets of units: field → (len(env_ids), joints)."""
        me: Any = self
        columns = torch.tensor(
            columns_of(joints, me._joint_names, "the action term"), device=me.device
        )
        delay = self.delay.expand(me.num_envs, -1).clone()
        me.servo_offset = me.servo_offset.expand(me.num_envs, -1).clone()
        delay[env_ids[:, None], columns] = units["delay"]
        me.servo_offset[env_ids[:, None], columns] = units["offset"]
        self.set_delays(delay)

    def restart(self, qpos: Tensor, command: Tensor) -> None:
        """Fill the buffers of fresh worlds with a command, (num_envs, joints) rad."""
        me: Any = self
        self.commands = torch.where(
            me.aligner.past.fresh[:, None], command + me.servo_offset, self.commands
        )

    def apply_actions(self) -> None:
        me: Any = self
        newest = me._processed_actions
        self.commands = torch.cat([newest[None], self.commands[:-1]])
        me._processed_actions = (self.weights * self.commands).sum(0)
        super().apply_actions()  # type: ignore[misc]
        me._processed_actions = newest


def isaaclab_action(
    folder: str | Path, payload_mass: float | None = None, check: bool = True, **options: Any
) -> Any:
    """Return a JointPositionActionCfg that aligns.

    `check` refuses a network trained with a servo model.
    """
    here: Any = sys.modules[__name__]
    own = {
        "class_type": here.IsaacLabTerm,
        "folder": str(folder),
        "payload_mass": payload_mass,
        "check": check,
    }
    return here.IsaacLabActionCfg(**{"use_default_offset": False} | own | options)


def _isaaclab_cfg() -> Any:
    from isaaclab.envs.mdp import JointPositionActionCfg
    from isaaclab.utils import configclass

    class IsaacLabActionCfg(JointPositionActionCfg):
        """JointPositionActionCfg of an action that aligns."""

        folder: str = ""
        payload_mass: float | None = None
        check: bool = True

    return configclass(IsaacLabActionCfg)


def _isaaclab_term() -> Any:
    from isaaclab.envs.mdp.actions.joint_actions import JointPositionAction

    class IsaacLabTerm(DelayedAction, AlignedAction, JointPositionAction):
        """Joint position targets that move the simulated robot like the real one."""

        def __init__(self, cfg: Any, env: Any) -> None:
            super().__init__(cfg, env)
            self.folder = Path(cfg.folder)
            self.payload_mass = cfg.payload_mass
            facts = read_facts(self.folder)
            law = ", ".join(term for term in facts["law"] if term != "no_load_speed")
            if cfg.check and law and "model" in facts:
                raise ValueError(
                    f"{cfg.folder}: trained with a servo model ({law}), which Isaac Lab lacks; or "
                    "give check=False"
                )
            self.align(
                self._asset,
                self._joint_ids,
                self._joint_names,
                offset=1.0,
                form=_isaaclab_form(facts),
            )
            servos = facts[_isaaclab_form(facts)]
            self.set_delays([_of_joints(servos, "delay", self._joint_names)])

    return IsaacLabTerm


def _isaaclab_form(facts: dict[str, Any]) -> str:
    """Return the key of facts.json for Isaac Lab, which has no servo model.

    A robot without a network is "plain".
    """
    return "joints" if "model" in facts else "plain"


def isaaclab_actuators(folder: str | Path) -> dict[str, Any]:
    """Return an IdealPDActuatorCfg of the servos, or a DCMotorCfg with a no-load speed.

    `isaaclab_action` has their delays and offsets.
    """
    from isaaclab.actuators import DCMotorCfg, IdealPDActuatorCfg

    facts = read_facts(folder)
    joints = facts[_isaaclab_form(facts)]
    fields = {field.name for field in dataclasses.fields(IdealPDActuatorCfg)}
    own = "actuator_" if "actuator_effort_limit" in fields else ""  # Isaac Lab 3 renamed the limits

    def group(kind: Any, names: list[str], **more: float) -> Any:
        def column(field: str) -> dict[str, float]:
            return {name: joints[name][field] for name in names}

        return kind(
            joint_names_expr=names,
            stiffness=column("kp"),
            damping=column("kd"),
            armature=column("armature"),
            friction=column("frictionloss"),
            viscous_friction=column("damping"),
            **{f"{own}effort_limit": column("effort_limit")},
            **more,
        )

    motors = [name for name, joint in joints.items() if joint.get("no_load_speed")]
    plain = [name for name in joints if name not in motors]
    groups = {}
    if plain:
        groups["servos"] = group(IdealPDActuatorCfg, plain)
    for name in motors:
        line = {
            "saturation_effort": joints[name]["effort_limit"],
            f"{own}velocity_limit": joints[name]["no_load_speed"],
        }
        groups[name] = group(DCMotorCfg, [name], **line)
    return groups


def __getattr__(name: str) -> Any:
    """Make the classes for Isaac Lab on first use; hydra finds them here by name."""
    makers = {
        "IsaacLabTerm": _isaaclab_term,
        "IsaacLabActionCfg": _isaaclab_cfg,
    }
    if name not in makers:
        raise AttributeError(f"module '{__name__}' has no attribute '{name}'")
    new = makers[name]()
    globals()[name] = new
    new.__module__ = __name__
    new.__qualname__ = name
    return new
