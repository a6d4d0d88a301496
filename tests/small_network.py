"""A small network of the SO-101, from a run with recordings to a folder of the package."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from arm import record

from gaponet.data.store import Dataset
from gaponet.nn import packaged_networks
from gaponet.nn.artifact import GapModel, make_card
from gaponet.nn.config import ModelConfig
from gaponet.nn.networks import build_network
from gaponet.nn.onnx_export import export, sample_inputs
from gaponet.robot.folder import save_robot
from gaponet.robot.spec import RobotSpec, load_robot

NAME = "so101-small"
ROWS = 60  # of a recording
PARTS = {"train": ("motion0", "motion1"), "val": ("motion2",), "test": ("motion3", "motion4")}
SMALL = ModelConfig(history=2, branch_hidden=(16,), trunk_hidden=(16,))


@dataclass(frozen=True)
class SmallNetwork:
    """A run and its dataset, and the folder of the package that was made from them."""

    run: Path
    data: Dataset
    folder: Path


def make_dataset(folder: Path, robot: RobotSpec) -> Dataset:
    """Return a dataset of five motions of a robot with weaker servos."""
    data = Dataset.create(folder, robot)
    for seed in range(5):
        rng = np.random.default_rng(seed)
        t = np.arange(ROWS)[:, None] * robot.dt
        ctrl = robot.qpos_home + 0.3 * np.sin(
            2 * np.pi * rng.uniform(0.2, 0.6, len(robot.joint_names)) * t
        )
        data.append(record(robot, ctrl, f"motion{seed}", kp=0.7))
    return data


def make_run(
    folder: Path, robot: RobotSpec, data: Dataset, config: ModelConfig = SMALL, **facts: object
) -> Path:
    """Return a run folder, without training, whose network corrects by some mrad."""
    torch.manual_seed(0)
    net = build_network(config, len(robot.operated)).eval()
    net.bounded.scale.fill_(0.01)
    for weights in net.parameters():
        torch.nn.init.normal_(weights, std=0.1)
    card = (
        make_card(
            config,
            robot,
            dt=[robot.dt],
            payload_seen=[0.0],
            units=["a"],
            seed=0,
            steps=1000,
            virtual=True,
            motions=PARTS,
            versions={"gaponet": "0.1.0"},
        )
        | facts
    )
    export(net, folder / "model", card, sample_inputs(net))
    split = {
        part: {entry.id: entry.hash for entry in data.entries if entry.meta.motion in motions}
        for part, motions in PARTS.items()
    }
    (folder / "split.json").write_text(json.dumps(split))
    zero = dict.fromkeys(robot.operated, 0.0)
    (folder / "delay_offset.json").write_text(json.dumps({"delay": zero, "offset": zero}))
    save_robot(robot, folder / "robot")
    return folder


def use_package_folder(monkeypatch, folder: Path) -> None:
    """Make a folder that of the package's networks, for this test."""
    monkeypatch.setattr(packaged_networks, "PACKAGE_FOLDER", folder)


def ship(run: Path, data: Dataset, package: Path, name: str = NAME) -> Path:
    """Return the folder that benchmarks/ship_networks.py makes of a run; benchmarks must be
    importable.
    """
    import ship_networks

    folder = package / name
    folder.mkdir(parents=True)
    source = ship_networks.Source(
        title="five motions",
        address="tests/small_network.py",
        data_licence="Apache-2.0",
        limits="Made for tests.",
    )
    ship_networks.write_network(run, folder, str(data.path), source)
    return folder


def make_small_network(place: Path, gain_scale: float = 1.0) -> SmallNetwork:
    """Return a network in place/package, for use_package_folder."""
    robot = load_robot("so101").with_gain_scale(gain_scale)
    data = make_dataset(place / "data", robot)
    run = make_run(place / "run", robot, data)
    return SmallNetwork(run, data, ship(run, data, place / "package"))


def outputs(model: GapModel, count: int = 16) -> np.ndarray:
    """Return Δa for random inputs, (count, n) rad."""
    inputs = model.config.input_dim(len(model.card["joint_names"]))
    x = np.random.default_rng(0).normal(size=(count, inputs)).astype(np.float32)
    return model.infer(x)
