"""The card of a trained network: what it was trained on, how, and how well it does."""

from __future__ import annotations

import platform
from importlib.metadata import version
from typing import Any

from gaponet.data.sequence import SequenceMeta
from gaponet.data.store import dataset_hash
from gaponet.nn.artifact import KnownSimulators, make_card
from gaponet.nn.training.checkpoint import Checkpoint
from gaponet.nn.training.config import TrainConfig
from gaponet.nn.training.run_folder import TrainingData
from gaponet.robot.spec import RobotSpec
from gaponet.sim.batch import Condition
from gaponet.sim.context import contexts


def run_card(
    config: TrainConfig, data: TrainingData, state: Checkpoint, **facts: Any
) -> dict[str, Any]:
    """Return the card of a run's best network.

    facts: Further fields, which only the trainer knows.
    """
    metas = [s.meta for s in data.recorded]
    motions = {}
    for part, entries in data.splits.items():
        motions[part] = sorted({entry.meta.motion for entry in entries})
    versions = {name: version(name) for name in ("gaponet", "mujoco", "numpy", "torch")}
    versions["python"] = platform.python_version()
    return make_card(
        config.model,
        data.robot,
        dt=sorted({s.dt for s in data.recorded}),
        payload_seen=sorted({m.payload_mass for m in metas}),
        units=sorted({m.unit_id for m in metas}),
        recorded=_recorded_gains(metas, data.robot),
        virtual=any(m.virtual for m in metas),
        dataset_hash=dataset_hash(data.dataset.entries),
        hours=round(sum(s.duration for s in data.recorded) / 3600, 3),
        motions=motions,
        sensor_r2=state.sensor_r2,
        seed=config.seed,
        gain=state.best.weights["bounded.gain"].item(),
        steps=state.steps,
        stages={
            "pretraining_rounds": [state.pretraining_rounds, config.pretraining.rounds],
            "ppo_updates": state.ppo_updates,
            "ppo_from_untrained": state.ppo_from_untrained,
        },
        versions=versions,
        **_known_simulators(config, data),
        **facts,
    )


def _known_simulators(config: TrainConfig, data: TrainingData) -> dict[str, Any]:
    """Return the card's range of contexts, if the network is told its simulator's."""
    if not config.model.context:
        return {}
    loaded = config.model.context_is_loaded
    nominal = Condition.of(data.recorded[0], data.robot)
    conditions = sorted(data.conditions, key=repr)
    trained = contexts(data.robot, conditions, config.threads, loaded=loaded)
    known = KnownSimulators.of(contexts(data.robot, [nominal], loaded=loaded)[0], trained)
    return {"context": known.to_card()}


def _recorded_gains(metas: list[SequenceMeta], robot: RobotSpec) -> dict[str, list[float] | None]:
    """Return kp and kd of the real servos in the training recordings.

    None where unknown or not the same in all. "kp" and "kd" of the card are the simulator's.
    """
    recorded: dict[str, list[float] | None] = {}
    for name in ("kp", "kd"):
        different = set()
        for meta in metas:
            gains = getattr(meta, name)
            if gains:
                different.add(tuple(round(gains[i], 9) for i in robot.operated_index))
        recorded[name] = list(different.pop()) if len(different) == 1 else None
    return recorded
