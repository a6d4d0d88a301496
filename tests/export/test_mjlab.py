"""mjlab in an environment of its own plays what AlignedSim plays: make engines."""

from __future__ import annotations

import subprocess
from pathlib import Path
from typing import NamedTuple

import mujoco
import numpy as np
import pytest
import torch
from environments import environment
from late_servos import with_late_servos
from runs import random_run

from gaponet.deploy.aligned_sim import AlignedSim
from gaponet.export.export_folder import export_model
from gaponet.nn.artifact import GapModel
from gaponet.robot.spec import RobotSpec, load_robot
from gaponet.sim.model import build_model

pytestmark = pytest.mark.peers

MJLAB = "mjlab==1.6.*"
PEER = Path(__file__).parent / "mjlab_peer.py"
PERIODS = 50
RESET_AT = PERIODS // 2  # period
WORLDS = 8
RESET_WORLDS = np.arange(0, WORLDS, 2)
TOLERANCE_RAD = 1e-4
SINGLE = 1e-6  # relative: the device has single precision
KINDS = {
    "jnt": mujoco.mjtObj.mjOBJ_JOINT,
    "dof": mujoco.mjtObj.mjOBJ_JOINT,
    "body": mujoco.mjtObj.mjOBJ_BODY,
    "actuator": mujoco.mjtObj.mjOBJ_ACTUATOR,
}


class Task(NamedTuple):
    """What both simulators are told; half of the worlds begin anew elsewhere half-way."""

    start: np.ndarray  # at first and at the reset, (2, WORLDS, n) rad
    targets: np.ndarray  # (PERIODS, WORLDS, n) rad


class Motion(NamedTuple):
    """What a simulator made of them, (PERIODS, WORLDS, n) rad each."""

    qpos: np.ndarray
    sent: np.ndarray  # corrected targets


def sines(robot: RobotSpec) -> Task:
    """Sines of 0.3 to 1.5 Hz about random postures near home."""
    rng = np.random.default_rng(0)
    n = len(robot.joint_names)
    home = robot.qpos_home
    low, high = np.clip(robot.qpos_range.T, home - 0.8, home + 0.8)
    start = np.clip(home + rng.uniform(-0.2, 0.2, (2, WORLDS, n)), low, high)
    turn = 2 * np.pi * rng.uniform(0.3, 1.5, (WORLDS, n)) * robot.dt  # rad per period
    size = rng.uniform(-0.3, 0.3, (WORLDS, n))
    swing = size * np.sin(turn * np.arange(PERIODS)[:, None, None])
    targets = start[0] + swing
    restarted = start[1] + swing[: PERIODS - RESET_AT]
    targets[RESET_AT:, RESET_WORLDS] = restarted[:, RESET_WORLDS]
    return Task(start, np.clip(targets, low, high))


def play_here(model: GapModel, task: Task) -> Motion:
    """Play in AlignedSim."""
    sim = AlignedSim(model.simulator(), model, num_envs=WORLDS)
    sim.reset(task.start[0])
    qpos = []
    sent = []
    for t, target in enumerate(task.targets):
        if t == RESET_AT:
            sim.reset(task.start[1][RESET_WORLDS], ids=RESET_WORLDS)
        sim.step(target)
        qpos.append(sim.qpos.copy())
        sent.append(sim.target.copy())
    return Motion(np.array(qpos), np.array(sent))


def play_in_mjlab(model: GapModel, task: Task, folder: Path) -> dict[str, np.ndarray]:
    """Export the model and play there; what mjlab_peer.py writes."""
    python = environment("mjlab-1.6", "3.11", (f"torch=={torch.__version__}",), (MJLAB,))
    export = folder / "torch"
    export_model(model, model.path.parent, export, payload_mass=0.0)
    given = folder / "in.npz"
    written = folder / "out.npz"
    np.savez(
        given,
        names=np.array(model.simulator().joint_names),
        targets=task.targets,
        start=task.start,
        reset_ids=RESET_WORLDS,
        reset_at=RESET_AT,
    )
    command = [python, PEER, export, given, written]
    subprocess.run(list(map(str, command)), check=True)
    return dict(np.load(written))


class Comparison(NamedTuple):
    """The SO-101 with late servos, a law of friction and a random network."""

    model: GapModel
    task: Task
    here: Motion
    there: Motion
    beside: np.ndarray  # positions of the other robot of the scene, as `there.qpos`
    fields: dict[str, np.ndarray]  # of the model that is simulated there, "FIELD NAME" → numbers


@pytest.fixture(scope="module")
def comparison(tmp_path_factory: pytest.TempPathFactory) -> Comparison:
    folder = tmp_path_factory.mktemp("mjlab")
    model = random_run(folder / "run", with_late_servos(load_robot("so101")))
    task = sines(model.simulator())
    fields = play_in_mjlab(model, task, folder)
    there = Motion(fields.pop("qpos"), fields.pop("sent"))
    beside = fields.pop("beside")
    return Comparison(model, task, play_here(model, task), there, beside, fields)


def test_identified_servos_move_in_mjlab_as_here(comparison: Comparison) -> None:
    here = comparison.here
    there = comparison.there
    apart = np.abs(there.qpos - here.qpos).max()
    sent_apart = np.abs(there.sent - here.sent).max()
    print(f"\nmjlab and AlignedSim: {apart:.1e} rad apart, their targets {sent_apart:.1e} rad")
    assert apart < TOLERANCE_RAD


def test_the_network_corrects_the_targets_that_are_compared(comparison: Comparison) -> None:
    corrections = np.abs(comparison.here.sent - comparison.task.targets)
    corrected = comparison.model.simulator().operated_index
    mean = corrections[..., corrected].mean()
    print(f"\ncorrected by {1e3 * mean:.1f} mrad on average")
    assert mean > 1e-4


def test_two_robots_of_a_scene_move_apart_from_each_other(comparison: Comparison) -> None:
    assert np.abs(comparison.beside - comparison.here.qpos).max() < TOLERANCE_RAD


def differs(model: mujoco.MjModel, key: str, there: np.ndarray) -> bool:
    """Whether a field of the scene is not the model's; mjlab's own bodies are none of it."""
    field, name = key.split(" ", 1)
    if field == "opt":
        here = np.asarray(getattr(model.opt, name), float).ravel()
    else:
        row = mujoco.mj_name2id(model, KINDS[field.split("_")[0]], name)
        if row < 0:
            return False
        here = np.asarray(getattr(model, field)[row], float).ravel()
    there = there.ravel()
    # MuJoCo's versions differ in how many zeros end a field.
    count = min(here.size, there.size)
    if here[count:].any() or there[count:].any():
        return True
    return not np.allclose(here[:count], there[:count], rtol=SINGLE, atol=1e-9)


def test_the_model_that_mjlab_simulates_is_the_model_here(comparison: Comparison) -> None:
    model = build_model(comparison.model.simulator())
    other = {}
    for key, values in comparison.fields.items():
        if differs(model, key, values):
            other[key] = values
    print(f"\nof {len(comparison.fields)} fields {len(other)} differ: {other}")
    assert len(comparison.fields) > 400
    assert other == {}
