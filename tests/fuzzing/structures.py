"""Which of gaponet's own files are changed, and how they are used: datasets, robots, models, runs,
fleets.
"""

from __future__ import annotations

import functools
import json
from dataclasses import asdict
from pathlib import Path

import numpy as np
from arm import write_arm
from logs import arm_sequence, late, wave

from fuzzing.harness import AbsurdError, Target
from fuzzing.mutate import Files
from fuzzing.readers import ROWS, arm, written
from gaponet.data.card import card_markdown, make_card
from gaponet.data.offsets import read_offsets
from gaponet.data.pair import SimulatedReplay
from gaponet.data.split import make_split, read_split, write_split
from gaponet.data.store import Dataset
from gaponet.evaluation import run_files
from gaponet.evaluation.candidate import split_of_run as read_run_split
from gaponet.nn.adaptation import Adaptation
from gaponet.nn.artifact import GapModel
from gaponet.nn.delay_offset import DelayOffset
from gaponet.robot.collision import Collision
from gaponet.robot.spec import load_robot
from gaponet.sim.model import build_model
from gaponet.virtual.fleet import FLEETS, load_fleet

COLLISION = """same_limb = ["upper fore"]
[[capsule]]
body = "upper"
from = [0.0, 0.0, 0.0]
to = [0.2, 0.0, 0.0]
radius = 0.02
[[capsule]]
body = "fore"
from = [0.0, 0.0, 0.0]
to = [0.2, 0.0, 0.0]
radius = 0.02
"""
IDENTIFIED = "[identified.elbow]\nkp = 18.0\ndelay = 0.01\noffset = 0.01\n"


def _dataset(folder: Path) -> None:
    data = Dataset.create(folder, arm())
    for i in range(4):
        ctrl = wave(ROWS, 2, hertz=0.4 + 0.1 * i)
        entry = data.append(arm_sequence(arm(), ctrl, late(ctrl, 2), f"m{i}", 0.1, tau=ctrl))
        data.write_replay(entry, SimulatedReplay("0123456789ab", ctrl, ctrl, ctrl))
    data.set_provenance(licence="CC0-1.0")
    write_split(data, make_split(data, "motion"), "motion")
    (folder / "offsets.json").write_text(json.dumps({"applied": False, "unit": "rad", "units": {}}))
    (folder / "collect.json").write_text(json.dumps({"fleet": "easy", "seed": 0}))


def _open_dataset(source: Path, out: Path) -> None:
    data = Dataset(source)
    data.sequences()
    data.require_robot(arm())
    for entry in data.entries:
        pair = data.pair(entry, "0123456789ab")
        if not np.isfinite(pair.gap).all():
            raise AbsurdError(f"{entry.id}: gap holds NaN")
    card_markdown(make_card(data))
    read_offsets(data)
    read_split(source / "splits" / "motion.json", data)


def _robot(folder: Path) -> None:
    write_arm(folder)
    toml = folder / "robot.toml"
    toml.write_text(toml.read_text() + IDENTIFIED)
    (folder / "collision.toml").write_text(COLLISION)


def _use_robot(source: Path, out: Path) -> None:
    robot = load_robot(source)
    model = build_model(robot, 0.5)
    Collision(robot, model).distance(np.zeros((1, model.nq)))
    numbers = [
        robot.servo.kp,
        robot.servo.kd,
        robot.servo.effort_limit,
        robot.qpos_home,
        robot.servo.delay,
        robot.servo.offset,
    ]
    if (
        not all(np.isfinite(x).all() and (np.abs(x) <= 1e6).all() for x in numbers)
        or np.isnan(robot.qpos_range).any()
    ):
        raise AbsurdError("a robot of numbers that are none")


@functools.cache
def _fitted() -> Files:
    """A run folder with its model, adaptation and evaluation."""
    import torch

    from gaponet.nn.artifact import make_card
    from gaponet.nn.config import ModelConfig
    from gaponet.nn.networks import build_network
    from gaponet.nn.onnx_export import export

    def write(folder: Path) -> None:
        torch.manual_seed(0)
        config = ModelConfig(
            history=2, num_probes=2, branch_hidden=(8,), trunk_hidden=(8,), sensor_hidden=(8,)
        )
        net = build_network(config, 2).eval()
        torch.nn.init.normal_(net.trunk[-1].weight, std=0.1)
        card = make_card(
            config,
            arm(),
            dt=[0.02],
            payload_seen=[0.0, 0.5],
            units=["a"],
            virtual=False,
            dataset_hash="0123",
            hours=0.1,
            motions={"train": ["m0"], "val": ["m1"], "test": ["m2"]},
            seed=0,
            excess_delay=0.02,
            steps=1,
            val_mpjae={"model": 0.01, "nominal": 0.02},
            sensor_r2=None,
            seconds=1.0,
            interrupted=False,
            versions={"gaponet": "0"},
        )
        export(net, folder / "model", card, np.zeros((4, net.features.dim), np.float32))
        weights = GapModel.load(folder).weights_hash()
        found = Adaptation("a", weights, {"elbow": {"kp": 1.0}}, ("0123456789",), 8.0, 0.1, 0.05)
        (folder / "adaptation").mkdir()
        (folder / "adaptation" / "a.json").write_text(json.dumps(asdict(found)))
        _evaluation(folder)

    return written(write)()


def _evaluation(folder: Path) -> None:
    from evaluation.test_run_files import METRICS

    parts = {"left": {"nominal": 0.02, "gaponet": 0.01}, "floor": {"both": 0.001}}
    gap = parts | {
        "by_joint": {"elbow": parts},
        "virtual": False,
        "unseen": True,
        "sequences": 1,
        "robot": "arm",
    }
    config = {
        "model": {"kind": "gaponet"},
        "ppo": {"num_envs": 1, "epochs": 1, "std": 0.1},
        "seed": 0,
        "robot": "arm",
        "dataset": "../set",
        "dataset_hash": "0123",
    }
    line = {
        "stage": "ppo",
        "steps": 1,
        "seconds": 0.5,
        "reward": None,
        "val_mpjae": 0.1,
        "nominal_mpjae": 0.2,
    }
    delays = {"delay": {"shoulder": 0.02, "elbow": 0.02}, "offset": {"shoulder": 0.0, "elbow": 0.0}}
    for name, content in (
        ("metrics", METRICS),
        ("gap", gap),
        ("config", config),
        ("delay_offset", delays),
        ("split", {"train": {"a": "0"}, "val": {"b": "1"}, "test": {"c": "2"}}),
    ):
        (folder / f"{name}.json").write_text(json.dumps(content, indent=1))
    (folder / "progress.jsonl").write_text(2 * (json.dumps(line) + "\n"))
    arrays = {
        f"0/{m}": np.zeros((5, 2), np.float32)
        for m in ("recorded", "command", "nominal", "gaponet")
    }
    np.savez(folder / "trajectories.npz", **arrays)


def _use_model(source: Path, out: Path) -> None:
    model = GapModel.load(source)
    n = len(model.card["joint_names"])
    loop = model.loop()
    for _ in range(3):
        delta = loop.delta(np.zeros(n), np.zeros(n), np.full(n, 0.1), 0.2)
        if not np.isfinite(delta).all() or np.abs(delta).max() > 20:
            raise AbsurdError(f"a correction of {delta}")
    Adaptation.load(source, model.weights_hash())


def _use_run(source: Path, out: Path) -> None:
    metrics = run_files.read_metrics(source)
    run_files.read_trajectories(source, metrics, 2)
    for read in (
        run_files.read_config,
        run_files.read_progress,
        run_files.read_gap,
        read_run_split,
    ):
        read(source)
    fitted = DelayOffset.read(source).corrector(arm())
    if not np.isfinite(fitted.delay).all() or (fitted.delay < 0).any() or (fitted.delay > 1).any():
        raise AbsurdError(f"delays {fitted.delay}")


def _fleet(folder: Path) -> None:
    (folder / "mine.toml").write_text(
        (FLEETS / "easy.toml").read_text(encoding="utf-8"), encoding="utf-8"
    )


def _use_fleet(source: Path, out: Path) -> None:
    for name, unit in load_fleet(source / "mine.toml", arm()).units.items():
        for field, value in vars(unit).items():
            if np.isnan(value).any() or (
                np.isinf(value).any()
                and field not in ("motor_constant", "supply_voltage", "no_load_speed")
            ):
                raise AbsurdError(f"{name}: {field} is {value}")


MODEL = ("card.json", "model.onnx", "a.json")
SAMPLES = (".parquet", "motion.json", "offsets.json", "collect.json")
RUN = (
    "metrics.json",
    "gap.json",
    "config.json",
    "delay_offset.json",
    "split.json",
    "progress.jsonl",
    ".npz",
)
TARGETS = (
    Target("journal", written(_dataset), _open_dataset, 2.5, ("sequences.jsonl", "dataset.json")),
    Target("samples", written(_dataset), _open_dataset, 1.0, SAMPLES),
    Target("robot", written(_robot), _use_robot, 2.5),
    Target("model", _fitted, _use_model, 2.0, MODEL),
    Target("run", _fitted, _use_run, 2.0, RUN),
    Target("fleet", written(_fleet), _use_fleet, 0.7),
)
