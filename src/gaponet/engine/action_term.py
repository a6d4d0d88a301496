"""An action term that aligns, for mjlab and Isaac Lab: copied beside an export, it needs torch, not gaponet.

gaponet export RUN --to torch --out FOLDER     # FOLDER: gaponet_action.py (this file), delta.pt2, facts.json, robot.xml

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
import json
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

PROGRAM, FACTS, ROBOT = "delta.pt2", "facts.json", "robot.xml"
CLOSE = 1e-5  # relative: facts of a scene that are the same
OWN_FLAGS = {"contact", "island"}  # what a scene of your own may decide
FIELDS = (
    "dof_armature", "dof_damping", "dof_frictionloss", "dof_solref", "dof_solimp", "jnt_range", "jnt_stiffness",
    "actuator_gainprm", "actuator_biasprm", "actuator_forcerange", "actuator_delay", "actuator_history",
)  # fmt: skip
LAW = ("stribeck", "stribeck_speed", "friction_motor", "friction_external", "min_torque", "encoder_step")
OPTIONS = (
    "timestep", "gravity", "impratio", "iterations", "tolerance", "ls_iterations", "ls_tolerance", "ccd_iterations",
    "noslip_iterations", "density", "viscosity", "wind",
)  # fmt: skip


def read_facts(folder: str | Path) -> dict[str, Any]:
    """What gaponet wrote of the simulator."""
    facts: dict[str, Any] = json.loads((Path(folder) / FACTS).read_text(encoding="utf-8"))
    if facts["format"] != 1:
        raise ValueError(f"{folder}/{FACTS}: of another version of gaponet; export the run again")
    return facts


class Past:
    """The past of num_envs worlds, and the program (engine/step.py) that corrects their commands."""

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
        delta: Tensor
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
        try:
            program = torch.export.load(str(Path(folder) / PROGRAM))
        except KeyError as error:
            raise RuntimeError(f"{folder}/{PROGRAM}: torch {torch.__version__} is too old for it; 2.11 does") from error
        module = move_to_device_pass(program, str(device)).module()
        self.past = Past(module, num_envs, facts["model"]["depth"], len(corrected), device)
        mass = facts["payload_mass"] if payload_mass is None else payload_mass
        self.payload_mass = torch.full((num_envs,), float(mass), device=device)

    @torch.no_grad()
    def __call__(self, qpos: Tensor, qvel: Tensor, target: Tensor) -> Tensor:
        """State and targets now, (num_envs, joints) rad, rad/s, rad → what to send for this control period."""
        q, v, a = (x[:, self.columns].float() for x in (qpos, qvel, target))
        out = target.clone()
        out[:, self.columns] = (a + self.past.delta(q, v, a, self.payload_mass)).to(out.dtype)
        return torch.minimum(torch.maximum(out, self.low), self.high)


class AlignedAction:
    """What JointPositionAction of both engines becomes: before it among the base classes."""

    folder: Path
    payload_mass: float | None
    _processed_actions: Tensor

    def align(self, entity: Any, ids: Any, names: list[str], offset: float = 0.0) -> None:
        """Begin; offset: share of the servos' own offsets that the engine's actuators do not have."""
        me: Any = self
        facts = read_facts(self.folder)
        dt = me._env.step_dt
        if abs(dt / facts["dt"] - 1) > 0.02:
            raise ValueError(f"{self.folder}: a control period is {facts['dt']} s, here it is {dt} s")
        self.aligner = Aligner(self.folder, list(names), me.num_envs, me.device, self.payload_mass)
        self.servo_offset = offset * torch.tensor([facts["joints"][name]["offset"] for name in names], device=me.device)
        self._aligned, self._columns = entity, ids

    def process_actions(self, actions: Tensor) -> None:
        super().process_actions(actions)  # type: ignore[misc]
        data, ids = self._aligned.data, self._columns
        q, v = (getattr(x, "torch", x)[:, ids] for x in (data.joint_pos, data.joint_vel))  # Isaac Lab 3 wraps tensors
        bias = data.encoder_bias[:, ids] if hasattr(data, "encoder_bias") else 0.0  # mjlab takes it off again
        self.begin(q)
        self._processed_actions = self.aligner(q, v, self._processed_actions - bias) + bias + self.servo_offset

    def begin(self, qpos: Tensor) -> None:
        """Worlds that are fresh now begin in this state."""

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

        def begin(self, qpos: Tensor) -> None:
            self.late.begin(self.aligner.past.fresh, qpos)
            self.law.begin(self.aligner.past.fresh)

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


def require_scene(model: Any, prefix: str, folder: str | Path) -> None:
    """Refuse a compiled MjModel in which the robot's joints and servos are not those of training.

    Raises:
        ValueError: Names what differs.
    """
    facts, wrong = read_facts(folder), []
    for name, joint in facts["joints"].items():
        for field, value in joint_fields(model, prefix + name).items():
            wrong += _differs(f"{field} of {name}", value, joint["mujoco"][field])
    here = solver_options(model)
    for field, value in facts["options"].items():
        if field.endswith("flags"):
            now, then = sorted(set(here[field]) - OWN_FLAGS), sorted(set(value) - OWN_FLAGS)
            wrong += [] if now == then else [f"{field} {now} instead of {then}"]
        elif isinstance(value, str):
            wrong += [] if here[field] == value else [f"{field} {here[field]} instead of {value}"]
        else:
            wrong += _differs(field, here[field], value)
    if wrong:
        raise ValueError(
            f"{folder}: was trained in simulator {facts['simulator']}; here {'; '.join(wrong[:5])}"
            f"{' and more' * (len(wrong) > 5)}. Take mjlab_entity and mjlab_options, or check=False"
        )


def _differs(what: str, now: Any, wanted: Any) -> list[str]:
    a, b = (torch.tensor(x, dtype=torch.float64) for x in (now, wanted))
    same = a.shape == b.shape and torch.allclose(a, b, rtol=CLOSE, atol=1e-12)
    return [] if same else [f"{what} {now} instead of {wanted}"]


def joint_fields(model: Any, name: str) -> dict[str, Any]:
    """What an MjModel has of a joint and of the servo with its name; only the first three of a servo's parameters."""
    row = {"jnt": model.joint(name).id, "dof": model.joint(name).dofadr[0], "actuator": model.actuator(name).id}
    values = {field: getattr(model, field)[row[field.split("_")[0]]] for field in FIELDS}
    return {field: (x[:3] if field.endswith("prm") else x).tolist() for field, x in values.items()}


def solver_options(model: Any) -> dict[str, Any]:
    """The options of an MjModel that decide how it moves, with the names of MuJoCo and of mjlab's MujocoCfg."""
    import mujoco

    found = {name: getattr(model.opt, name) for name in OPTIONS}
    found = {name: x.tolist() if hasattr(x, "tolist") else x for name, x in found.items()}
    for name, kind in (("integrator", "Integrator"), ("cone", "Cone"), ("jacobian", "Jacobian"), ("solver", "Solver")):
        found[name] = getattr(mujoco, f"mjt{kind}")(getattr(model.opt, name)).name.split("_", 1)[1].lower()
    for name, kind in (("disableflags", "Disable"), ("enableflags", "Enable")):
        bits = getattr(mujoco, f"mjt{kind}Bit").__members__.items()
        known = {key.split("BL_")[1].lower(): bit.value for key, bit in bits if "BL_" in key}
        found[name] = sorted(key for key, bit in known.items() if getattr(model.opt, name) & bit)
    return found


def hold_friction(sim: Any, entity: str, folder: str | Path) -> None:
    """Make joint friction hold as in training, which no MJCF can say; again after events that recompute constants."""
    facts = read_facts(folder)
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

    def begin(self, fresh: Tensor, qpos: Tensor) -> None:
        """The command under way in fresh worlds is to stay at qpos, (num_envs, names) rad."""
        if self.any:
            history, time = self.sim.data.history, self.sim.data.time
            begun = self.base + self.timed * time[:, None] + self.held * qpos[:, self.source]
            history[:] = torch.where(fresh[:, None] & self.mine, begun, history[:])


class ServoLaw:
    """What servos do beyond PD, before every physics step: gaponet's sim/servo.py in torch."""

    def __init__(self, sim: Any, entity: Any, name: str, joints: list[str], facts: dict[str, Any]) -> None:
        self.sim, self.any, model, of = sim, bool(facts["law"]), sim.mj_model, facts["joints"]
        if not self.any:
            return
        sim.expand_model_fields(("dof_frictionloss", "actuator_biasprm"))
        self.dof = torch.tensor([model.joint(f"{name}/{j}").dofadr[0] for j in joints], device=sim.device)
        self.at = torch.tensor([model.joint(f"{name}/{j}").qposadr[0] for j in joints], device=sim.device)
        self.servo = torch.tensor([model.actuator(f"{name}/{j}").id for j in joints], device=sim.device)
        fields = ("kp", "offset", "frictionloss", *LAW)
        self.law = law = {f: torch.tensor([of[j][f] for j in joints], device=sim.device) for f in fields}
        self.kp, self.bias = law["kp"], law["kp"] * law["offset"]
        self.torque = torch.zeros(sim.num_envs, len(joints), device=sim.device)
        self.load, update = torch.zeros_like(self.torque), entity.update

        def updated(dt: float) -> None:  # after each physics step, before forward() renews what it was
            update(dt)
            self.torque, self.load = sim.data.actuator_force[:, self.servo], sim.data.qfrc_bias[:, self.dof]

        entity.update = updated

    def begin(self, fresh: Tensor) -> None:
        """Fresh worlds stand where they are."""
        if self.any:
            self.torque = torch.where(fresh[:, None], self.bias, self.torque)
            self.load = torch.where(fresh[:, None], self.sim.data.qfrc_bias[:, self.dof], self.load)

    def before(self, ctrl: Tensor) -> None:
        """Set friction and bias for the next physics step, under targets (num_envs, joints) rad."""
        if not self.any:
            return
        law, q, v = self.law, self.sim.data.qpos[:, self.at], self.sim.data.qvel[:, self.dof]
        limit = law["frictionloss"] + (law["friction_motor"] * self.torque + law["friction_external"] * self.load).abs()
        limit = limit + law["stribeck"] * torch.exp(-v.abs() / law["stribeck_speed"].clamp(min=1e-3))
        self.sim.model.dof_frictionloss[:, self.dof] = limit
        step, fine, least = law["encoder_step"], law["encoder_step"].clamp(min=1e-9), law["min_torque"]
        torque = self.kp * (ctrl + self.bias / self.kp - torch.where(step > 0, (q / fine).round() * fine, q))
        pushed = torch.copysign(torch.maximum(torque.abs(), least), torque) * (torque.abs() > 0.5 * step * self.kp)
        torque = torch.where((least > 0).any(), pushed, torque)
        self.sim.model.actuator_biasprm[:, self.servo, 0] = torque - self.kp * (ctrl - q)


# ---- Isaac Lab; written against its published source (3.0), never run


def isaaclab_action(folder: str | Path, payload_mass: float | None = None, check: bool = True, **options: Any) -> Any:
    """A JointPositionActionCfg that aligns; check refuses servos that Isaac Lab does not have."""
    from isaaclab.envs.mdp import JointPositionActionCfg
    from isaaclab.envs.mdp.actions.joint_actions import JointPositionAction

    class Term(AlignedAction, JointPositionAction):
        def __init__(self, cfg: Any, env: Any) -> None:
            super().__init__(cfg, env)
            self.folder, self.payload_mass = Path(folder), payload_mass
            if check and (law := read_facts(folder)["law"]):
                raise ValueError(
                    f"{folder}: trained with servos whose law ({', '.join(law)}) is not here; or check=False"
                )
            self.align(self._asset, self._joint_ids, self._joint_names, offset=1.0)

    return JointPositionActionCfg(**{"class_type": Term, "use_default_offset": False} | options)


def isaaclab_actuators(folder: str | Path) -> dict[str, Any]:
    """A DelayedPDActuatorCfg for the servos of each delay, in whole physics steps."""
    from isaaclab.actuators import DelayedPDActuatorCfg

    facts = read_facts(folder)
    groups: dict[int, dict[str, Any]] = {}
    for name, joint in facts["joints"].items():
        groups.setdefault(round(joint["delay"] / facts["options"]["timestep"]), {})[name] = joint
    return {
        f"servos_{lag}": DelayedPDActuatorCfg(
            joint_names_expr=list(joints),
            min_delay=lag,
            max_delay=lag,
            stiffness={name: joint["kp"] for name, joint in joints.items()},
            damping={name: joint["kd"] for name, joint in joints.items()},
            effort_limit={name: joint["effort_limit"] for name, joint in joints.items()},
            armature={name: joint["armature"] for name, joint in joints.items()},
            friction={name: joint["frictionloss"] for name, joint in joints.items()},
            viscous_friction={name: joint["damping"] for name, joint in joints.items()},
        )
        for lag, joints in groups.items()
    }
