"""An action term that aligns, for mjlab and Isaac Lab: copied beside an export, it needs torch, not gaponet.

gaponet export RUN --to torch --out FOLDER     # FOLDER: gaponet_action.py (this file), delta.pt2, facts.json, …
gaponet export ROBOT --to mjlab --out FOLDER   # the identified servos without a network (and --to isaaclab)

mjlab:      cfg.scene.entities["robot"] = mjlab_entity(FOLDER)
            cfg.sim.mujoco, cfg.decimation = mjlab_options(FOLDER)
            cfg.actions["joint_pos"] = mjlab_action(FOLDER, entity_name="robot", actuator_names=(".*",))
Isaac Lab:  cfg.scene.robot.actuators = isaaclab_actuators(FOLDER)
            cfg.actions.joint_pos = isaaclab_action(FOLDER, asset_name="robot", joint_names=[".*"])

Both call process_actions once per control period: what the policy asks for becomes what makes the simulator move like
the robot. Options are those of JointPositionActionCfg.
"""

from __future__ import annotations

import dataclasses
import sys
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from gaponet.export.mujoco_servos import LAW, delay_weights, read
from gaponet.export.scene_facts import require_scene
from gaponet.sim.servo import friction_limit, present, servo_torque

PROGRAM, FACTS, ROBOT = "delta.pt2", "facts.json", "robot.xml"
CLOSE = 1e-5  # relative: facts of a scene that are the same
OWN_FLAGS = {"contact", "island"}  # what a scene of your own may decide


def read_facts(folder: str | Path) -> dict[str, Any]:
    """What gaponet wrote of the simulator."""
    return read(Path(folder) / FACTS)


class Past:
    """The past of num_envs worlds, and the program (export/step.py) that corrects their commands, if there is one."""

    def __init__(self, program: Any, num_envs: int, depth: int, n: int, device: Any) -> None:
        self.program = program
        self.frames = torch.zeros(num_envs, depth, 3 * n, device=device)
        self.fresh = torch.ones(num_envs, dtype=torch.bool, device=device)

    def reset(self, ids: Any = None) -> None:
        """These worlds (indices, a mask, a slice; None for all) begin anew with the next state."""
        self.fresh = self.fresh.clone()  # what inference_mode made is not written to outside it
        self.fresh[slice(None) if ids is None else ids] = True

    def delta(self, qpos: Tensor, qvel: Tensor, ctrl: Tensor, payload_mass: Tensor) -> Tensor:
        """Δa, (num_envs, n) rad; once per control period."""
        delta = torch.zeros_like(ctrl)
        if self.program is not None:
            delta, self.frames = self.program(qpos, qvel, ctrl, payload_mass, self.frames, self.fresh)
        self.fresh = torch.zeros_like(self.fresh)
        return delta


class Aligner:
    """Targets of `joint_names`, in any order, → targets that make the simulator move like the robot.

    Attributes:
        payload_mass: kg in each hand, (num_envs,); may be written.
    """

    def __init__(
        self, folder: str | Path, joint_names: list[str], num_envs: int, device: Any, payload_mass: float | None = None
    ) -> None:
        from torch.export.passes import move_to_device_pass

        facts = read_facts(folder)
        corrected = facts["corrected"]
        if missing := [name for name in corrected if name not in joint_names]:
            raise ValueError(f"{folder}: corrects '{missing[0]}', which is not among {', '.join(joint_names)}")
        self.columns = torch.tensor([joint_names.index(name) for name in corrected], device=device)
        ranges = [facts["joints"].get(name, {}).get("range") or (-torch.inf, torch.inf) for name in joint_names]
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
        self.past = Past(module, num_envs, facts.get("model", {}).get("depth", 1), len(corrected), device)
        mass = facts["payload_mass"] if payload_mass is None else payload_mass
        self.payload_mass = torch.full((num_envs,), float(mass), device=device)
        self.sent = torch.zeros(num_envs, len(joint_names), device=device)

    @torch.no_grad()
    def __call__(self, qpos: Tensor, qvel: Tensor, target: Tensor) -> Tensor:
        """State and targets now, (num_envs, joints) rad, rad/s, rad → what to send for this control period.

        A target that is no finite number counts as what was sent last; in worlds that begin anew, as the state.
        """
        last = torch.where(self.past.fresh[:, None], qpos, self.sent)
        target = torch.where(torch.isfinite(target), target, last)
        q, v, a = (x[:, self.columns].float() for x in (qpos, qvel, target))
        out = target.clone()
        out[:, self.columns] = (a + self.past.delta(q, v, a, self.payload_mass)).to(out.dtype)
        self.sent = torch.minimum(torch.maximum(out, self.low), self.high)
        return self.sent


class AlignedAction:
    """What JointPositionAction of both engines becomes: before it among the base classes.

    Attributes:
        told: What servos of worlds that begin anew were told until then, (num_envs, joints) rad; None: to stay there.
    """

    folder: Path
    payload_mass: float | None
    told: Tensor | None = None
    _processed_actions: Tensor

    def align(self, entity: Any, ids: Any, names: list[str], offset: float = 0.0, form: str = "joints") -> None:
        """Begin; offset: share of the servos' own offsets that the engine's actuators do not have."""
        me: Any = self
        facts = read_facts(self.folder)
        dt = me._env.step_dt
        if abs(dt / facts["dt"] - 1) > 0.02:
            raise ValueError(f"{self.folder}: a control period is {facts['dt']} s, here it is {dt} s")
        self.aligner = Aligner(self.folder, list(names), me.num_envs, me.device, self.payload_mass)
        self.servo_offset = offset * torch.tensor([facts[form][name]["offset"] for name in names], device=me.device)
        self._aligned, self._columns = entity, ids

    def process_actions(self, actions: Tensor) -> None:
        super().process_actions(actions)  # type: ignore[misc]
        data, ids = self._aligned.data, self._columns
        q, v = (getattr(x, "torch", x)[:, ids] for x in (data.joint_pos, data.joint_vel))  # Isaac Lab 3 wraps tensors
        bias = data.encoder_bias[:, ids] if hasattr(data, "encoder_bias") else 0.0  # mjlab takes it off again
        self.begin(q, q if self.told is None else self.told)
        self._processed_actions = self.aligner(q, v, self._processed_actions - bias) + bias + self.servo_offset

    def begin(self, qpos: Tensor, told: Tensor) -> None:
        """Worlds that are fresh now begin in this state, under this command."""

    def reset(self, env_ids: Any = None, **other: Any) -> None:
        super().reset(env_ids, **other)  # type: ignore[misc]
        self.aligner.past.reset(env_ids)


# ---- mjlab


def mjlab_action(folder: str | Path, payload_mass: float | None = None, check: bool = True, **options: Any) -> Any:
    """A JointPositionActionCfg that aligns; check refuses a scene that is not the simulator of training."""
    from mjlab.envs.mdp.actions import JointPositionAction, JointPositionActionCfg

    class Term(AlignedAction, JointPositionAction):
        def __init__(self, cfg: Any, env: Any) -> None:
            super().__init__(cfg, env)
            self.folder, self.payload_mass = Path(folder), payload_mass
            self.align(self._entity, self._target_ids, self._target_names)
            if check:
                require_scene(env.sim.mj_model, f"{cfg.entity_name}/", self.folder)
            names = list(self._target_names)
            self.late = LateServos(env.sim, cfg.entity_name, names)
            self.law = ServoLaw(env.sim, self._entity, cfg.entity_name, names, read_facts(self.folder))
            hold_friction(env.sim, cfg.entity_name, self.folder)

        def begin(self, qpos: Tensor, told: Tensor) -> None:
            self.late.begin(self.aligner.past.fresh, told)
            self.law.begin(self.aligner.past.fresh, told - qpos)

        def apply_actions(self) -> None:
            super().apply_actions()
            self.law.before(self._processed_actions - self._entity.data.encoder_bias[:, self._target_ids])

    class Cfg(JointPositionActionCfg):
        def build(self, env: Any) -> Any:
            return Term(self, env)

    return Cfg(**{"use_default_offset": False} | options)


def mjlab_entity(folder: str | Path, **options: Any) -> Any:
    """The robot with its servos, as trained in, at its home; options are those of EntityCfg."""
    import mujoco
    from mjlab.actuator import XmlActuatorCfg
    from mjlab.entity import EntityArticulationInfoCfg, EntityCfg

    home = {name: joint["home"] for name, joint in read_facts(folder)["joints"].items()}
    servos = EntityArticulationInfoCfg(actuators=(XmlActuatorCfg(target_names_expr=(".*",), command_field="position"),))
    own = {"articulation": servos, "init_state": EntityCfg.InitialStateCfg(joint_pos=home)} | options
    return EntityCfg(spec_fn=lambda: mujoco.MjSpec.from_file(str(Path(folder) / ROBOT)), **own)


def mjlab_options(folder: str | Path) -> tuple[Any, int]:
    """MujocoCfg and decimation of the simulator trained in. Where links touched nothing in training, take "contact" out
    of its disableflags for a scene with a floor; robot.xml says which geoms touch.
    """
    from mjlab.sim import MujocoCfg

    facts = read_facts(folder)
    known = {field.name for field in dataclasses.fields(MujocoCfg)}
    return MujocoCfg(**{k: v for k, v in facts["options"].items() if k in known}), facts["decimation"]


def hold_friction(sim: Any, entity: str, folder: str | Path) -> None:
    """Make joint friction hold as in training, which no MJCF can say; again after events that recompute constants."""
    facts = read_facts(folder)
    sim.expand_model_fields(("dof_invweight0",))  # of its own in every world; before, all share one
    for name in facts["joints"]:
        dof = sim.mj_model.joint(f"{entity}/{name}").dofadr[0]
        sim.model.dof_invweight0[:, dof] = float(sim.mj_model.dof_invweight0[dof]) * facts["dof_invweight0_factor"]


class LateServos:
    """MuJoCo's buffers of commands under way to servos with a delay, which a reset leaves as they were."""

    def __init__(self, sim: Any, entity: str, names: list[str]) -> None:
        self.sim, model = sim, sim.mj_model
        size = model.nhistory
        self.mine, self.timed, self.held = (torch.zeros(size, dtype=torch.bool) for _ in range(3))
        self.base, self.source = torch.zeros(size), torch.zeros(size, dtype=torch.long)
        for column, name in enumerate(names):
            servo = model.actuator(f"{entity}/{name}").id
            start, count = int(model.actuator_historyadr[servo]), int(model.actuator_history[servo, 0])
            if start < 0 or not count:
                continue
            times, values = slice(start + 2, start + 2 + count), slice(start + 2 + count, start + 2 + 2 * count)
            self.mine[start : values.stop] = self.timed[times] = self.held[values] = True
            self.base[start + 1] = count - 1  # the newest sample's place; user data stand before it
            self.base[times] = -model.opt.timestep * torch.arange(count, 0, -1)
            self.source[values] = column
        self.any = bool(self.mine.any())
        vars(self).update({k: x.to(sim.device) for k, x in vars(self).items() if isinstance(x, Tensor)})

    def begin(self, fresh: Tensor, told: Tensor) -> None:
        """The command under way in fresh worlds, (num_envs, names) rad."""
        if self.any:
            history, time = self.sim.data.history, self.sim.data.time
            begun = self.base + self.timed * time[:, None] + self.held * told[:, self.source]
            history[:] = torch.where(fresh[:, None] & self.mine, begun, history[:])


class ServoLaw:
    """What servos do beyond PD, before every physics step of mjlab."""

    def __init__(self, sim: Any, entity: Any, name: str, joints: list[str], facts: dict[str, Any]) -> None:
        of = {f: torch.tensor([facts["joints"][j].get(f, 0.0) for j in joints], device=sim.device)
              for f in ("kp", "offset", "frictionloss", *LAW)}  # fmt: skip
        self.sim, self.law, model = sim, present({f: of[f] for f in LAW}), sim.mj_model
        if not self.law:
            return
        sim.expand_model_fields(("dof_frictionloss", "actuator_biasprm"))
        self.dof = torch.tensor([model.joint(f"{name}/{j}").dofadr[0] for j in joints], device=sim.device)
        self.at = torch.tensor([model.joint(f"{name}/{j}").qposadr[0] for j in joints], device=sim.device)
        self.servo = torch.tensor([model.actuator(f"{name}/{j}").id for j in joints], device=sim.device)
        self.kp, self.frictionloss, self.bias = of["kp"], of["frictionloss"], of["kp"] * of["offset"]
        self.torque = torch.zeros(sim.num_envs, len(joints), device=sim.device)
        self.load, update = torch.zeros_like(self.torque), entity.update

        def updated(dt: float) -> None:  # after each physics step, before forward() renews what it was
            update(dt)
            self.torque, self.load = sim.data.actuator_force[:, self.servo], sim.data.qfrc_bias[:, self.dof]

        entity.update = updated

    def begin(self, fresh: Tensor, apart: Tensor) -> None:
        """Fresh worlds stand so far from what they were told, (num_envs, joints) rad."""
        if self.law:
            self.torque = torch.where(fresh[:, None], self.bias + self.kp * apart, self.torque)
            self.load = torch.where(fresh[:, None], self.sim.data.qfrc_bias[:, self.dof], self.load)

    def before(self, ctrl: Tensor) -> None:
        """Set friction and bias for the next physics step, under targets (num_envs, joints) rad."""
        if not self.law:
            return
        q, v = self.sim.data.qpos[:, self.at], self.sim.data.qvel[:, self.dof]
        limit = friction_limit(self.law, self.frictionloss, v, self.torque, self.load)
        self.sim.model.dof_frictionloss[:, self.dof] = limit
        asked = servo_torque(self.law, self.kp, ctrl + self.bias / self.kp, q)
        self.sim.model.actuator_biasprm[:, self.servo, 0] = asked - self.kp * (ctrl - q)


# ---- Isaac Lab


class DelayedAction:
    """Commands on their way to late servos, in the term: worlds begin at rest, and no delay is rounded to a step."""

    def late(self, delay: list[float], step: float) -> None:
        """Delays of the term's joints, s, at the length of a physics step, s."""
        me: Any = self
        self.share = torch.tensor(delay_weights(delay, step), device=me.device, dtype=torch.float)[:, None]
        self.under_way = torch.zeros(len(self.share), me.num_envs, len(delay), device=me.device)

    def begin(self, qpos: Tensor, told: Tensor) -> None:
        """What is under way in fresh worlds."""
        me: Any = self
        self.under_way = torch.where(me.aligner.past.fresh[:, None], told + me.servo_offset, self.under_way)

    def apply_actions(self) -> None:
        me: Any = self
        asked = me._processed_actions
        self.under_way = torch.cat([asked[None], self.under_way[:-1]])
        me._processed_actions = (self.share * self.under_way).sum(0)
        super().apply_actions()  # type: ignore[misc]
        me._processed_actions = asked


def isaaclab_action(folder: str | Path, payload_mass: float | None = None, check: bool = True, **options: Any) -> Any:
    """A JointPositionActionCfg that aligns; check refuses a network trained with servos that are not here."""
    here: Any = sys.modules[__name__]
    own = {"class_type": here.IsaacLabTerm, "folder": str(folder), "payload_mass": payload_mass, "check": check}
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
            self.folder, self.payload_mass = Path(cfg.folder), cfg.payload_mass
            facts = read_facts(self.folder)
            if cfg.check and facts["law"] and "model" in facts:
                law = ", ".join(facts["law"])
                raise ValueError(f"{cfg.folder}: trained with servos whose law ({law}) is not here; or check=False")
            self.align(self._asset, self._joint_ids, self._joint_names, offset=1.0, form=_isaaclab_form(facts))
            servos = facts[_isaaclab_form(facts)]
            self.late([servos[name]["delay"] for name in self._joint_names], env.physics_dt)
            if len(self.share) > 1 and getattr(env, "_physics_handles_decimation", False):
                raise ValueError("servos are late by parts of a control period: cfg.sim.use_newton_actuators = False")

    return IsaacLabTerm


def _isaaclab_form(facts: dict[str, Any]) -> str:
    """Isaac Lab has no servo law: of a robot without a network the numbers that were fitted without it."""
    return "joints" if "model" in facts else "plain"


def isaaclab_actuators(folder: str | Path) -> dict[str, Any]:
    """An IdealPDActuatorCfg of the servos; their delays and offsets are the action term's (isaaclab_action)."""
    from isaaclab.actuators import IdealPDActuatorCfg

    facts = read_facts(folder)
    joints = facts[_isaaclab_form(facts)]
    of = lambda field: {name: joint[field] for name, joint in joints.items()}  # noqa: E731
    known = {field.name for field in dataclasses.fields(IdealPDActuatorCfg)}
    limit = "actuator_effort_limit" if "actuator_effort_limit" in known else "effort_limit"  # Isaac Lab 3 renamed it
    return {
        "servos": IdealPDActuatorCfg(
            joint_names_expr=list(joints), stiffness=of("kp"), damping=of("kd"), armature=of("armature"),
            friction=of("frictionloss"), viscous_friction=of("damping"), **{limit: of("effort_limit")},
        )
    }  # fmt: skip


def __getattr__(name: str) -> Any:
    """Classes of Isaac Lab, which is imported when they are asked for: hydra looks them up here by name."""
    made = {"IsaacLabTerm": _isaaclab_term, "IsaacLabActionCfg": _isaaclab_cfg}
    if name not in made:
        raise AttributeError(f"module '{__name__}' has no attribute '{name}'")
    found = globals()[name] = made[name]()
    found.__module__, found.__qualname__ = __name__, name
    return found
