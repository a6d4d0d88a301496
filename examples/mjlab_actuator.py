"""An mjlab actuator that aligns: position servos with the gains trained on, their targets corrected once per period.

    gaponet export RUN --to torchscript          # RUN/model/delta.pt, card.json beside it
    EntityArticulationInfoCfg(actuators=(AlignedActuatorCfg(run="RUN/model", decimation=4, payload_mass=3.0),))

Written against mjlab's published Actuator interface (edit_spec, initialize, compute, reset). NOT RUN: mjlab was not
installed where this was written. The TorchScript file it loads is tested (tests/model/test_runtime.py).
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import mujoco
import torch
from mjlab.actuator import Actuator, ActuatorCfg, ActuatorCmd


@dataclass(kw_only=True)
class AlignedActuatorCfg(ActuatorCfg):
    """All joints that the model corrects, and no others."""

    target_names_expr: tuple[str, ...] = ()
    run: str
    decimation: int
    payload_mass: float = 0.0

    def __post_init__(self) -> None:
        self.card = json.loads((Path(self.run) / "card.json").read_text(encoding="utf-8"))
        self.target_names_expr = tuple(self.card["joint_names"])
        super().__post_init__()

    def build(self, entity: Any, target_ids: list[int], target_names: list[str]) -> AlignedActuator:
        return AlignedActuator(self, entity, target_ids, target_names)


class AlignedActuator(Actuator[AlignedActuatorCfg]):
    """target → target + Δa, held for `decimation` physics steps."""

    def edit_spec(self, spec: mujoco.MjSpec, target_names: list[str]) -> None:
        card = self.cfg.card
        for name in target_names:
            k = card["joint_names"].index(name)
            actuator = spec.add_actuator(name=name, target=name, trntype=mujoco.mjtTrn.mjTRN_JOINT)
            actuator.set_to_position(kp=card["kp"][k], kv=card["kd"][k])
            self._mjs_actuators.append(actuator)

    def initialize(self, mj_model: mujoco.MjModel, model: Any, data: Any, device: str) -> None:
        super().initialize(mj_model, model, data, device)
        period = self.cfg.decimation * mj_model.opt.timestep
        if min(abs(period / dt - 1) for dt in self.cfg.card["dt"]) > 0.02:
            raise ValueError(f"one period is {period} s here, the model was trained with {self.cfg.card['dt']}")
        self.delta = torch.jit.load(str(Path(self.cfg.run) / "delta.pt")).to(device)
        self.order = [self.target_names.index(name) for name in self.cfg.card["joint_names"]]
        self.payload = torch.full((data.nworld,), self.cfg.payload_mass, device=device)
        self.target = torch.zeros(data.nworld, len(self.order), device=device)
        self.count = 0

    def compute(self, cmd: ActuatorCmd) -> torch.Tensor:
        if self.count % self.cfg.decimation == 0:
            q, v, a = (x[:, self.order] for x in (cmd.pos, cmd.vel, cmd.position_target))
            self.target[:, self.order] = a + self.delta(q, v, a, self.payload)
        self.count += 1
        return self.target

    def reset(self, env_ids: torch.Tensor | slice | None = None) -> None:
        super().reset(env_ids)
        ids = torch.arange(len(self.target), device=self.target.device)
        self.delta.reset(None if env_ids is None else ids[env_ids])
