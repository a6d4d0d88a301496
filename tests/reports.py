"""A run folder as a report needs it, without training: of an operator that corrects nothing yet."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from arm import recordings
from runs import untrained

from gaponet.data.store import Dataset
from gaponet.evaluation.evaluate import evaluate
from gaponet.robot.spec import RobotSpec

FACTS = {
    "hours": 0.1,
    "steps": 10,
    "seconds": 60.0,
    "excess_delay": 0.0,
    "parity_rad": 1e-7,
    "dataset_hash": "0123",
    "versions": {"gaponet": "0"},
    "virtual": True,
}
LINE = {"stage": "ppo", "steps": 1, "seconds": 0.5, "val_mpjae": 0.1, "nominal_mpjae": 0.2}
CONFIG = {
    "model": {"kind": "gaponet"},
    "ppo": {"num_envs": 1, "epochs": 1, "std": 0.1},
    "seed": 0,
    "robot": "arm",
    "dataset": "../data",
    "dataset_hash": "0123",
    "command": "gaponet train data --out run",
}


def evaluated_run(
    arm: RobotSpec, data: Dataset, folder: Path, simulator: RobotSpec | None = None
) -> Path:
    """Evaluated on motions in which only the elbow moves; 3 of 10 rounds of its supervised
    pre-training are done.
    """
    for sequence in recordings(arm, 4, rows=160, kp=0.5):
        ctrl = sequence.ctrl * [0.0, 1.0]
        data.append(replace(sequence, ctrl=ctrl.astype(np.float32)))
    motions = sorted({e.meta.motion for e in data.entries})
    untrained(folder, simulator or arm, data, train=motions[:1], val=motions[1:2], test=motions[2:])
    amend(folder, **FACTS, stages={"pretraining_rounds": [3, 10], "ppo_updates": 0})
    (folder / "config.json").write_text(json.dumps(CONFIG))
    (folder / "progress.jsonl").write_text(json.dumps(LINE) + "\n")
    evaluate([folder], data, arm).save(folder)
    return folder


def amend(folder: Path, **facts: Any) -> None:
    """Change the card."""
    card = folder / "model" / "card.json"
    card.write_text(json.dumps(json.loads(card.read_text()) | facts))
