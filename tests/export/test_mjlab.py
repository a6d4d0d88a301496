"""mjlab in an environment of its own plays what AlignedSim plays: make engines."""

from __future__ import annotations

import subprocess
from pathlib import Path

import mujoco
import numpy as np
import pytest
import torch
from environments import environment
from runs import random_run

from gaponet.deploy.aligned_sim import AlignedSim
from gaponet.export.export_folder import export_model
from gaponet.nn.artifact import GapModel
from gaponet.robot.spec import load_robot
from gaponet.sim.model import build_model

pytestmark = pytest.mark.peers

MJLAB = "mjlab==1.6.*"
PERIODS, WORLDS, TOLERANCE = 50, 8, 1e-4  # rad
SINGLE = 1e-6  # relative: the device has single precision
KINDS = {
    "jnt": mujoco.mjtObj.mjOBJ_JOINT,
    "dof": mujoco.mjtObj.mjOBJ_JOINT,
    "body": mujoco.mjtObj.mjOBJ_BODY,
    "actuator": mujoco.mjtObj.mjOBJ_ACTUATOR,
}


@pytest.fixture(scope="module")
def python() -> str:
    return environment("mjlab-1.6", "3.11", (f"torch=={torch.__version__}",), (MJLAB,))


def play(model: GapModel, payload_mass: float, folder: Path) -> dict[str, np.ndarray]:
    """Half of the worlds begin anew elsewhere half-way; what went into AlignedSim and came out."""
    robot, rng = model.simulator(), np.random.default_rng(0)
    n, home, half = len(robot.joint_names), robot.qpos_home, np.arange(0, WORLDS, 2)
    low, high = np.clip(robot.qpos_range.T, home - 0.8, home + 0.8)
    start = np.clip(home + rng.uniform(-0.2, 0.2, (2, WORLDS, n)), low, high)
    turn = 2 * np.pi * rng.uniform(0.3, 1.5, (WORLDS, n)) * robot.dt
    swing = rng.uniform(-0.3, 0.3, (WORLDS, n)) * np.sin(turn * np.arange(PERIODS)[:, None, None])
    targets = start[0] + swing
    targets[PERIODS // 2 :, half] = (start[1] + swing[: PERIODS // 2])[:, half]
    targets = np.clip(targets, low, high)
    sim = AlignedSim(robot, model, payload_mass, num_envs=WORLDS)
    sim.reset(start[0])
    qpos, sent = [], []
    for t, target in enumerate(targets):
        if t == PERIODS // 2:
            sim.reset(start[1][half], ids=half)
        sim.step(target)
        qpos.append(sim.qpos.copy())
        sent.append(sim.target.copy())
    given = {
        "names": np.array(robot.joint_names),
        "targets": targets,
        "start": start,
        "reset_ids": half,
    }
    np.savez(folder / "in.npz", **given, reset_at=PERIODS // 2)
    return {"qpos": np.array(qpos), "sent": np.array(sent), "targets": targets}


def compare(python: str, model: GapModel, payload_mass: float, folder: Path, what: str) -> None:
    """Motion and model, here and there."""
    export_model(model, model.path.parent, folder / "torch", payload_mass)
    own = play(model, payload_mass, folder)
    peer = str(Path(__file__).parent / "mjlab_peer.py")
    subprocess.run(
        [python, peer, *(str(folder / name) for name in ("torch", "in.npz", "out.npz"))], check=True
    )
    there = dict(np.load(folder / "out.npz"))
    apart, corrected = np.abs(there.pop("qpos") - own["qpos"]), model.simulator().operated_index
    beside = np.abs(there.pop("beside") - own["qpos"]).max()
    sent = np.abs(there.pop("sent") - own["sent"]).max()
    moved = np.abs(own["sent"] - own["targets"])[..., corrected].mean()
    compiled = build_model(model.simulator(), payload_mass)
    other = [text for key, value in there.items() if (text := differs(compiled, key, value))]
    print(
        f"\n{what}: corrected by {1e3 * moved:.1f} mrad on average; mjlab and AlignedSim {apart.max():.1e} rad apart"
    )
    print(
        f"over {PERIODS} periods of {WORLDS} worlds (targets {sent:.1e}); of {len(there)} fields {len(other)} differ"
    )
    assert moved > 1e-4
    assert apart.max() < TOLERANCE
    assert beside < TOLERANCE  # the other robot of the scene
    assert len(there) > 400
    assert other == []


def differs(model: mujoco.MjModel, key: str, value: np.ndarray) -> str:
    """A field of the scene that is not the model's, in words; mjlab's own bodies are none of it."""
    field, name = key.split(" ", 1)
    if field == "opt":
        own = np.asarray(getattr(model.opt, name), float)
    else:
        row = mujoco.mj_name2id(model, KINDS[field.split("_")[0]], name)
        if row < 0:
            return ""
        own = np.asarray(getattr(model, field)[row], float)
    count = min(own.size, value.size)  # MuJoCo's versions differ in how many zeros end a field
    pairs = own.ravel(), value.ravel()
    same = np.allclose(pairs[0][:count], pairs[1][:count], rtol=SINGLE, atol=1e-9)
    return (
        ""
        if same and not any(x[count:].any() for x in pairs)
        else f"{key}: {value} there, {own} here"
    )


def test_identified_servos_move_in_mjlab_as_here(python, tmp_path):
    robot = load_robot("so101")
    law = {
        "stribeck": 0.03,
        "stribeck_speed": 0.05,
        "friction_motor": 0.08,
        "friction_external": 0.15,
    }
    found = {
        j: {"delay": 0.006 * i, "offset": 0.01 * i} | law for i, j in enumerate(robot.operated, 1)
    }
    model = random_run(tmp_path / "run", robot.with_identified(found))
    compare(
        python,
        model,
        0.0,
        tmp_path,
        "SO-101, servos late by 6 to 30 ms with a law of friction, random network",
    )
