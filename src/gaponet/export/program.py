"""The step of a model as a torch.export program (.pt2), which plain torch loads; the past goes in and comes out.

step = torch.export.load("delta.pt2").module()
delta, frames = step(qpos, qvel, ctrl, payload_mass, frames, fresh)   # export/step.py says what they are
"""

from __future__ import annotations

import io
import warnings
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from gaponet.base.files import atomic_write
from gaponet.export.action_term import PROGRAM, Past
from gaponet.export.step import DeltaStep, delta_step, require_parity
from gaponet.nn.artifact import GapModel


def export_program(model: GapModel, run: Path, folder: Path) -> float:
    """Write delta.pt2, load it back and compare it with the artifact over some control periods.

    Returns:
        Largest difference, rad.

    Raises:
        ModelError: It is above 1e-5 rad, or the model is one that DeltaStep is not for; nothing is written.
    """
    step, path = delta_step(model, run), folder / PROGRAM
    content = io.BytesIO()  # torch ends the process when it meets a full disk itself
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of torch about its own storages
        torch.export.save(program(step), content)
    with atomic_write(path) as temporary:
        temporary.write_bytes(content.getvalue())
        content.seek(0)
        return require_parity(_Stepped(torch.export.load(content).module(), step), model, "torch.export", path)


def program(step: DeltaStep) -> torch.export.ExportedProgram:
    """Any number of worlds, B ≥ 1."""
    worlds = torch.export.Dim("worlds", min=1, max=2**31)  # torch 2.7 asks for an end
    rows = [torch.zeros(2, step.n) for _ in range(3)]
    past = [torch.zeros(2, step.depth, 3 * step.n), torch.ones(2, dtype=torch.bool)]
    with torch.no_grad():
        return torch.export.export(step, (*rows, torch.zeros(2), *past), dynamic_shapes=({0: worlds},) * 6)


class _Stepped:
    """A program with a past, to be compared."""

    def __init__(self, program: Any, step: DeltaStep) -> None:
        self.program, self.step = program, step

    def reset(self, ids: Tensor | None) -> None:
        if ids is None:
            self.past: Past | None = None
        elif self.past is not None:
            self.past.reset(ids)

    def __call__(self, qpos: Tensor, qvel: Tensor, ctrl: Tensor, payload_mass: Tensor) -> Tensor:
        self.past = self.past or Past(self.program, len(qpos), self.step.depth, self.step.n, qpos.device)
        return self.past.delta(qpos, qvel, ctrl, payload_mass)
