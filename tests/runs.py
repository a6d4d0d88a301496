"""A run folder without training: an operator that corrects nothing yet, a split, a robot."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import torch

from gaponet.data.store import Dataset
from gaponet.nn.artifact import GapModel, KnownSimulators, make_card
from gaponet.nn.config import ModelConfig
from gaponet.nn.networks import build_network
from gaponet.nn.onnx_export import export, sample_inputs
from gaponet.nn.training.config import PPOConfig, PretrainingConfig, TrainConfig
from gaponet.robot.folder import save_robot
from gaponet.robot.spec import RobotSpec
from gaponet.sim.batch import Condition
from gaponet.sim.context import contexts

TINY_TRAINING = TrainConfig(
    model=ModelConfig(
        history=2, num_probes=4, branch_hidden=(16,), trunk_hidden=(16,), sensor_hidden=(16,)
    ),
    pretraining=PretrainingConfig(
        rounds=2, num_envs=8, steps=30, gradient_steps=10, batch_size=64, sensor_states=64
    ),
    ppo=PPOConfig(
        num_envs=8, num_steps=8, epochs=1, mini_batches=2, critic_warmup=1, explained=-1e9
    ),
    episode_s=0.5,
    validate_every=2,
)


def read_checkpoint(run: Path) -> dict[str, Any]:
    """The state that a run stored last."""
    return torch.load(run / "checkpoint.pt", weights_only=True)


def differences(a: Any, b: Any, where: str = "") -> list[str]:
    """Paths at which two nested states differ, times in seconds aside."""
    if isinstance(a, (list, tuple)):
        assert len(a) == len(b)
        a = dict(enumerate(a))
        b = dict(enumerate(b))
    if not isinstance(a, dict):
        return [] if where.endswith("/seconds") or same(a, b) else [where]
    assert a.keys() == b.keys()
    found = []
    for key in a:
        found += differences(a[key], b[key], f"{where}/{key}")
    return found


def same(a: Any, b: Any) -> bool:
    """Whether two values are equal, or both NaN."""
    if isinstance(a, torch.Tensor):
        return torch.equal(a, b)
    return a == b or (a != a and b != b)


def untrained(
    folder: Path, robot: RobotSpec, data: Dataset, kind: str = "gaponet", **parts: tuple[str, ...]
) -> Path:
    """A run that was trained, validated and tested on these motions of a dataset."""
    config = ModelConfig(kind=kind, history=2, num_probes=2)  # type: ignore[arg-type]
    net = build_network(config, len(robot.operated)).eval()
    motions = {part: sorted(parts.get(part, ())) for part in ("train", "val", "test")}
    card = make_card(
        config, robot, dt=[robot.dt], motions=motions, payload_seen=[0.0, 0.2], units=["a"], seed=0
    )
    export(net, folder / "model", card, np.zeros((4, net.features.dim), np.float32))
    split = {
        part: {e.id: e.hash for e in data.entries if e.meta.motion in names}
        for part, names in motions.items()
    }
    (folder / "split.json").write_text(json.dumps(split))
    (folder / "delay_offset.json").write_text(
        json.dumps(
            {
                "delay": dict.fromkeys(robot.operated, 0.0),
                "offset": dict.fromkeys(robot.operated, 0.0),
            }
        )
    )
    save_robot(robot, folder / "robot")
    return folder


def corrects_by(delta: float, robot: RobotSpec, folder: Path) -> GapModel:
    """A run whose operator adds the same to every target, rad: what it is told makes no
    difference.
    """
    config = ModelConfig(
        history=2, num_probes=2, branch_hidden=(8,), trunk_hidden=(8,), sensor_hidden=(8,)
    )
    net = build_network(config, len(robot.operated)).eval()
    torch.nn.init.zeros_(net.trunk[-1].weight)
    torch.nn.init.zeros_(net.trunk[-1].bias)
    torch.nn.init.constant_(net.bias, delta)
    export(
        net,
        folder / "model",
        make_card(config, robot, dt=[robot.dt], payload_seen=[0.0, 0.2]),
        sample_inputs(net),
    )
    save_robot(robot, folder / "robot")
    return GapModel.load(folder)


def random_run(
    folder: Path,
    robot: RobotSpec,
    payload_seen: tuple[float, ...] = (0.0, 0.2),
    periods: tuple[float, ...] = (),
    **how: Any,
) -> GapModel:
    """A run whose operator answers anything, up to some 0.1 rad: whatever it is told makes a
    difference. Without control periods (s) it has the robot's.
    """
    small: dict[str, Any] = {"history": 2, "stride": 2, "num_probes": 4}
    small |= dict.fromkeys(("branch_hidden", "trunk_hidden", "sensor_hidden"), (8,))
    torch.manual_seed(0)
    net = build_network(ModelConfig(**small | how), len(robot.operated)).eval()
    with torch.no_grad():
        for p in net.parameters():
            p.add_(0.1 * torch.randn_like(p))
    net.features.standardise.std.fill_(0.3)
    dt = list(periods) or [robot.dt]
    card = make_card(net.config, robot, dt=dt, payload_seen=list(payload_seen))
    if net.config.context:
        loads = [Condition(mass, "both", robot.dt) for mass in payload_seen]
        answers = contexts(robot, loads, loaded=net.config.context_is_loaded)
        card["context"] = KnownSimulators.of(answers[0], answers).to_card()
    export(
        net,
        folder / "model",
        card,
        torch.randn(20, net.config.input_dim(len(robot.operated))).numpy(),
    )
    torch.save({"best_state": net.state_dict()}, folder / "checkpoint.pt")
    save_robot(robot, folder / "robot")
    return GapModel.load(folder)


SMALL = ModelConfig(
    history=2, num_probes=4, branch_hidden=(16,), trunk_hidden=(16,), sensor_hidden=(16,)
)


def small_model(robot: RobotSpec, folder: Path) -> GapModel:
    """A model that corrects by some ten mrad."""
    torch.manual_seed(0)
    net = build_network(SMALL, len(robot.operated))
    torch.nn.init.normal_(net.trunk[-1].weight, std=0.03)
    export(net, folder, make_card(SMALL, robot, dt=[robot.dt]), sample_inputs(net))
    return GapModel.load(folder)
