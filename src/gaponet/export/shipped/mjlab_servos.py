"""Identified servos as an actuator of mjlab.

This file is copied into exports; it needs torch, not gaponet.

    EntityArticulationInfoCfg(actuators=(mjlab_servos(FOLDER),))

It also needs the events of mjlab_events(FOLDER) of gaponet_action.py.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from gaponet.export.shipped.mujoco_servos import (
    Addresses,
    ServoNumbers,
    delay_weights,
    read,
)
from gaponet.export.shipped.unit_events import columns_of, write_model
from gaponet.robot.servo_fields import SERVO_TERMS
from gaponet.sim.servo import present

# Fields of the model that each world needs for itself.
SERVO_FIELDS = ("dof_frictionloss", "actuator_biasprm", "actuator_forcerange")
FRICTION_FIELDS = ("dof_invweight0",)


def servo_addresses(mj_model: Any, servos: Tensor) -> Addresses:
    """Return the places of actuators and of the joints that they move, tensors (n)."""
    joints = mj_model.actuator_trnid[servos.cpu().numpy(), 0]
    dof = torch.as_tensor(mj_model.jnt_dofadr[joints], device=servos.device).long()
    qpos = torch.as_tensor(mj_model.jnt_qposadr[joints], device=servos.device).long()
    return Addresses(dof, qpos, servos)


class WorldServos:
    """Delays and the servo model beyond PD of some joints, in all worlds.

    mjlab's own delay fields count how often a target is written, and it writes once more whenever a
    world begins anew; these delays count physics steps, and may be parts of one.

    Attributes:
        starts_under_command: How a world begins: as if its first target had been in force for long;
            False: as if its first position had been.
    """

    def __init__(
        self,
        facts: dict[str, Any],
        joints: list[str],
        addresses: Addresses,
        num_envs: int,
        step: float,
    ) -> None:
        """
        Args:
            facts: facts.json.
            step: Physics step, s.
        """
        device = addresses.servo.device

        def column(field: str) -> Tensor:
            values = [facts["joints"][joint].get(field, 0.0) for joint in joints]
            return torch.tensor(values, device=device)

        self.joints = joints
        self.addresses = addresses
        self.numbers = ServoNumbers(
            kp=column("kp"),
            bias=column("kp") * column("offset"),
            frictionloss=column("frictionloss"),
            effort=column("effort_limit"),
            terms=present({name: column(name) for name in SERVO_TERMS}),
        )
        weights = delay_weights(column("delay").cpu().numpy(), step)
        self.weights = torch.tensor(weights, dtype=torch.float, device=device)[:, None]
        self.targets = torch.zeros(len(weights), num_envs, len(joints), device=device)
        self.torque = torch.zeros(num_envs, len(joints), device=device)
        self.load = torch.zeros_like(self.torque)
        self.fresh = torch.ones(num_envs, dtype=torch.bool, device=device)
        self.starts_under_command = False

    def restart(self, env_ids: Any = None) -> None:
        """Let worlds (indices, a mask, a slice; None for all) begin anew at the next step."""
        self.fresh = self.fresh.clone()
        self.fresh[slice(None) if env_ids is None else env_ids] = True

    def before_step(self, model: Any, data: Any, target: Tensor) -> Tensor:
        """Write the servo model for the next physics step, and return ctrl, (num_envs, n) rad.

        mjlab calls it once a step, and again when a world begins anew: only `after_step` moves the
        delays on.
        """
        qpos = data.qpos[:, self.addresses.qpos]
        qvel = data.qvel[:, self.addresses.dof]
        if self.fresh.any():
            self._start(data, qpos, target)
        # Not in place: tensors of inference mode cannot be written to outside of it.
        self.targets = torch.cat([target[None], self.targets[1:]])
        if self.numbers.terms:
            self._write_servo_model(model, qpos, qvel, target)
        return (self.weights * self.targets).sum(0)

    def after_step(self, data: Any) -> None:
        """Note torque and load of the physics step, and move the delays on."""
        self.torque = data.actuator_force[:, self.addresses.servo]
        self.load = data.qfrc_bias[:, self.addresses.dof]
        self.targets = torch.cat([self.targets[:1], self.targets[:-1]])
        self.fresh = torch.zeros_like(self.fresh)

    def _start(self, data: Any, qpos: Tensor, target: Tensor) -> None:
        """Put fresh worlds under a target that has been in force for long."""
        fresh = self.fresh[:, None]
        held = target if self.starts_under_command else qpos
        self.targets = torch.where(fresh, held, self.targets)
        requested = self.numbers.bias + self.numbers.kp * (held - qpos)
        self.torque = torch.where(fresh, requested, self.torque)
        self.load = torch.where(fresh, data.qfrc_bias[:, self.addresses.dof], self.load)

    def _write_servo_model(self, model: Any, qpos: Tensor, qvel: Tensor, target: Tensor) -> None:
        """Write friction, torque limits and bias."""
        if len(self.fresh) > 1 and model.dof_frictionloss.stride(0) == 0:
            raise ValueError(
                "all worlds share one friction: cfg.events.update(mjlab_events(FOLDER)) gives "
                "each its own"
            )
        numbers = self.numbers
        dof, _, servo = self.addresses
        model.dof_frictionloss[:, dof] = numbers.friction(qvel, self.torque, self.load)
        if "no_load_speed" in numbers.terms:
            limits = numbers.torque_limits(qvel)
            model.actuator_forcerange[:, servo] = torch.stack(limits, dim=-1)
        model.actuator_biasprm[:, servo, 0] = numbers.step_bias(target, qpos)

    def set_units(
        self, model: Any, env_ids: Tensor, joints: list[str], units: dict[str, Tensor]
    ) -> None:
        """Give worlds the numbers of units: field → (len(env_ids), joints).

        Delays stay as exported.
        """
        columns = torch.tensor(
            columns_of(joints, self.joints, "the actuators"), device=env_ids.device
        )
        dof = self.addresses.dof[columns]
        servo = self.addresses.servo[columns]
        write_model(model, env_ids, dof, servo, units)
        rows = env_ids[:, None]

        def of_worlds(column: Tensor, values: Tensor) -> Tensor:
            column = column.expand(len(self.fresh), -1).clone()
            column[rows, columns] = values.to(column.dtype)
            return column

        old = self.numbers
        # What the file has no spread of, such as encoder_step, is the same in all worlds.
        terms = dict(old.terms)
        for name in terms.keys() & units.keys():
            terms[name] = of_worlds(terms[name], units[name])
        if "no_load_speed" in terms:
            speed = terms["no_load_speed"]
            terms["no_load_speed"] = torch.where(speed > 0, speed, torch.inf)  # 0 is no limit
        self.numbers = ServoNumbers(
            kp=of_worlds(old.kp, units["kp"]),
            bias=of_worlds(old.bias, units["kp"] * units["offset"]),
            frictionloss=of_worlds(old.frictionloss, units["frictionloss"]),
            effort=of_worlds(old.effort, units["effort_limit"]),
            terms=terms,
        )


def mjlab_servos(folder: str | Path, **options: Any) -> Any:
    """Return the ActuatorCfg of the servos in robot.xml, for EntityArticulationInfoCfg.

    Options are its fields.
    """
    own = {"target_names_expr": (".*",), "command_field": "position", "folder": str(folder)}
    return _servo_cfg_class()(**own | options)


@cache
def _servo_cfg_class() -> Any:
    """Return the configuration class; it needs mjlab."""
    from mjlab.actuator import XmlActuatorCfg

    @dataclass(kw_only=True)
    class IdentifiedServoCfg(XmlActuatorCfg):
        """Servos of robot.xml with their identified delays and servo model."""

        folder: str
        """Export of gaponet, with facts.json."""

        def build(self, entity: Any, target_ids: list[int], target_names: list[str]) -> Any:
            return _servo_class()(self, entity, target_ids, target_names)

    return IdentifiedServoCfg


@cache
def _servo_class() -> Any:
    """Return the actuator class; it needs mjlab."""
    from mjlab.actuator.xml_actuator import XmlActuator

    class IdentifiedServo(XmlActuator):
        """Actuator of mjlab: `servos` computes its delays and its servo model."""

        servos: WorldServos

        def edit_spec(self, spec: Any, target_names: list[str]) -> None:
            super().edit_spec(spec, target_names)
            # `servos` has the delays; mjlab's reset keeps MuJoCo's
            for servo in self._mjs_actuators:
                servo.nsample = 0
                servo.delay = 0.0

        def initialize(self, mj_model: Any, model: Any, data: Any, device: str) -> None:
            super().initialize(mj_model, model, data, device)
            self.model = model
            self.data = data
            facts = read(Path(self.cfg.folder) / "facts.json")
            addresses = servo_addresses(mj_model, self.global_ctrl_ids)
            step = float(mj_model.opt.timestep)
            self.servos = WorldServos(facts, list(self.target_names), addresses, data.nworld, step)

        def reset(self, env_ids: Any = None) -> None:
            super().reset(env_ids)
            self.servos.restart(env_ids)

        def compute(self, cmd: Any) -> Tensor:
            return self.servos.before_step(self.model, self.data, cmd.position_target)

        def update(self, dt: float) -> None:
            super().update(dt)
            self.servos.after_step(self.data)

    return IdentifiedServo
