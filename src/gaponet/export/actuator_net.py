"""Actuator networks, one of each joint, from a run: the past of target − position and of speed in, torque out.

The form is Hwangbo et al. 2019 (Science Robotics 4, eaau5872), which mjlab, Newton and Isaac Lab load. The servo as
identified is in it exactly, since a late target less today's position is the error of then less the way since. What the
run's network adds, kp · Δa, is fitted to such a past by a small network, on free runs that the run's network corrects.
Engines tell a joint's network neither posture nor payload: what goes by these is lost (docs/results/unnamed.md).
"""

from __future__ import annotations

import json
import warnings
from collections.abc import Callable
from collections.abc import Sequence as ListOf
from itertools import pairwise
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import torch
from torch import Tensor, nn

from gaponet.base.errors import UsageError
from gaponet.base.files import atomic_write
from gaponet.data.sequence import Sequence
from gaponet.data.split import spread
from gaponet.export.forms import comparable, mean_error
from gaponet.export.mujoco_servos import delay_weights
from gaponet.report.candidate import split_of_run
from gaponet.report.run_files import read_config
from gaponet.robot.spec import RobotSpec
from gaponet.share.reading import load_dataset
from gaponet.sim.replay import Corrector, replay

PAST, HIDDEN, CLAMP = 0.1, (32, 32), 5.0  # s beyond the longest delay, widths, standard deviations
MOST = 40  # recordings of each part
ROWS, STEPS, BATCH, RATE, DECAY, NOISE = 60_000, 2000, 512, 2e-3, 1.0, 0.4  # of the fit, as in supervised pre-training
GAINS = (1.0, 0.5, 0.0)  # how much of kp · Δa: the least error on validation motions


class ActuatorNet(nn.Module):
    """One joint: [e_t … e_{t-L+1} | q̇_t … q̇_{t-L+1}], (B, 2L), → torque (B, 1) N·m; e = target − q, rad, rad/s."""

    servo: Tensor
    mean: Tensor
    std: Tensor

    def __init__(self, joint: dict[str, Any], step: float, length: int) -> None:
        """joint: the servo's numbers, as facts.json has them."""
        super().__init__()
        kp, late = joint["kp"], np.zeros(length)
        weights = delay_weights(np.array([joint["delay"]]), step)[:, 0]
        late[: len(weights)] = weights
        way = kp * step * (np.cumsum(late[::-1])[::-1] - late)  # q_t − q_{t-k} = step · (q̇_t + … + q̇_{t-k+1})
        way[0] += joint["kd"]
        self.register_buffer("servo", torch.tensor(np.concatenate([kp * late, -way])[:, None], dtype=torch.float32))
        self.register_buffer("mean", torch.zeros(2 * length))
        self.register_buffer("std", torch.ones(2 * length))
        self.rest, self.limit, self.scale, self.gain = kp * joint["offset"], joint["effort_limit"], kp, 1.0
        widths = (2 * length, *HIDDEN)
        layers = [layer for a, b in pairwise(widths) for layer in (nn.Linear(a, b), nn.ELU())]
        self.net = nn.Sequential(*layers, head := nn.Linear(HIDDEN[-1], 1))
        nn.init.zeros_(head.weight)
        nn.init.zeros_(head.bias)

    def seen(self, x: Tensor) -> Tensor:
        """Standardised and kept within ±5."""
        return ((x - self.mean) / self.std).clamp(-CLAMP, CLAMP)

    def forward(self, x: Tensor) -> Tensor:
        torque = x @ self.servo + self.rest + (self.gain * self.scale) * self.net(self.seen(x))
        return torque.clamp(-self.limit, self.limit)


def recordings(run: Path, data: str | None, robot: RobotSpec, payload_mass: float) -> list[list[Sequence]]:
    """Training and validation motions of a run that were made with this payload and the robot's own gains.

    Raises:
        UsageError: There is none.
    """
    there = data or read_config(run)["dataset"]
    dataset = load_dataset(there if data or "://" in there else run / there)
    made = [e for e in dataset.entries if e.meta.payload_mass == payload_mass]
    held = split_of_run(run)
    parts = [spread([e for e in made if e.hash in held[part].values()], MOST) for part in ("train", "val")]
    found = [comparable(dataset.sequences(part), robot, payload_mass) for part in parts]
    if not all(found):
        raise UsageError(f"no recording of {run} was made with {payload_mass:g} kg and the robot's own gains")
    return found


def write_networks(
    sequences: ListOf[Sequence], motions: ListOf[Sequence], corrector: Corrector, robot: RobotSpec, folder: Path,
    facts: dict[str, Any],
) -> dict[str, float]:  # fmt: skip
    """Fit the networks to free runs of sequences, judge them on motions, write them, and say so in facts.

    Returns:
        What is left of the motions, rad, by form.
    """
    nets = _fitted(sequences, replay(sequences, robot, corrector, lock_idle=True), robot, facts)
    op = robot.operated_index
    aligned = zip(motions, replay(motions, robot, corrector, lock_idle=True), strict=True)
    tried = {gain: _played(folder / facts["file"], motions, robot, nets, facts, gain) for gain in GAINS}
    gain = min(tried, key=lambda g: tried[g])
    told = {"length": _length(facts), "step": facts["options"]["timestep"], "gain": gain, "input_order": "pos_vel"}
    for name, net in nets.items():
        net.gain = gain
        _write(net, folder, name, told | {"joint": name, "robot": robot.name})
    facts["actuator_net"] = told
    run = float(np.mean([mean_error(s.qpos[:, op], t.qpos[:, op]) for s, t in aligned]))
    return {"the run, in gaponet": run, "actuator networks": tried[gain], "of these the servo alone": tried[0.0]}


def _length(facts: dict[str, Any]) -> int:
    """Physics steps of the past: the longest delay, and PAST."""
    longest = max(joint["delay"] for joint in facts["joints"].values())
    return int(np.ceil((longest + PAST) / facts["options"]["timestep"])) + 1


def _fitted(
    sequences: ListOf[Sequence], twins: ListOf[Any], robot: RobotSpec, facts: dict[str, Any]
) -> dict[str, ActuatorNet]:
    """A network of each joint; those that are not operated have the servo alone."""
    step, length = facts["options"]["timestep"], _length(facts)
    nets = {name: ActuatorNet(joint, step, length) for name, joint in facts["joints"].items()}
    rng = np.random.default_rng(0)
    torch.manual_seed(0)
    for name in robot.joint_names:
        i, net, rows = robot.joint_names.index(name), nets[name], ROWS // len(sequences) + 1
        if name in robot.operated:
            parts = [_pasts(s, t, i, net, facts, rng, rows) for s, t in zip(sequences, twins, strict=True)]
            x, y = (torch.tensor(np.concatenate(p), dtype=torch.float32) for p in zip(*parts, strict=True))
            _fit(net, x, y)
    return {name: net.eval().requires_grad_(False) for name, net in nets.items()}


def _pasts(
    s: Sequence, twin: Any, i: int, net: ActuatorNet, facts: dict[str, Any], rng: np.random.Generator, rows: int
) -> tuple[np.ndarray, np.ndarray]:
    """Some physics steps of joint i in a free run: what its network is shown, and Δa as it arrives, (k, 1) rad."""
    count, length = facts["decimation"], len(net.mean) // 2
    q, v = (_between(twin.qpos[:, i], twin.qvel[:, i], s.dt, count, which) for which in (0, 1))
    asked = np.repeat(s.ctrl[:-1, i], count)
    added = np.repeat(twin.ctrl[:-1, i] - s.ctrl[:-1, i], count)
    picked = rng.integers(0, len(asked), rows)
    past = np.maximum(picked[:, None] - np.arange(length), 0)
    late = net.servo[:length, 0].numpy() / facts["joints"][s.joint_names[i]]["kp"]
    shown = np.concatenate([asked[past] - q[past], v[past]], axis=1)
    return shown, (added[past] @ late)[:, None]


def _between(q: np.ndarray, v: np.ndarray, dt: float, count: int, which: int) -> np.ndarray:
    """Position (which 0) or speed at every physics step, from rows dt apart: the cubic through both."""
    u = (np.arange(count) / count)[None]
    a, b, va, vb = (x[:, None] for x in (q[:-1], q[1:], dt * v[:-1], dt * v[1:]))
    if which:
        found = (6 * u**2 - 6 * u) * (a - b) + (3 * u**2 - 4 * u + 1) * va + (3 * u**2 - 2 * u) * vb
        return (found / dt).ravel()
    found = (2 * u**3 - 3 * u**2 + 1) * a + (3 * u**2 - 2 * u**3) * b + (u**3 - 2 * u**2 + u) * va + (u**3 - u**2) * vb
    return found.ravel()


def _fit(net: ActuatorNet, x: Tensor, y: Tensor) -> None:
    """Regress Δa under noise on the past, as in supervised pre-training: else a network reads what Δa did before."""
    net.mean.copy_(x.mean(0))
    net.std.copy_(x.std(0).clamp_min(1e-4))
    z, unit = net.seen(x), float(y.square().mean().sqrt()) or 1.0
    optimiser = torch.optim.AdamW(net.net.parameters(), lr=RATE, weight_decay=DECAY)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimiser, STEPS)
    for _ in range(STEPS):
        batch = torch.randint(0, len(z), (BATCH,))
        found = net.net(z[batch] + NOISE * torch.randn(BATCH, z.shape[1]))
        loss = (found - y[batch] / unit).square().mean()
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
        schedule.step()
    net.scale *= unit


def _beside(nets: ListOf[ActuatorNet]) -> Callable[[np.ndarray], np.ndarray]:
    """The networks of all joints at once: pasts (n, 2L) → torque (n,), numpy."""
    side = lambda get: np.stack([get(net).detach().numpy() for net in nets])  # noqa: E731
    servo, mean, std = (side(lambda net, f=f: getattr(net, f)) for f in ("servo", "mean", "std"))
    rest, limit, scale = np.array([(net.rest, net.limit, net.gain * net.scale) for net in nets]).T
    layers = [(side(lambda net, k=k: net.net[k].weight), side(lambda net, k=k: net.net[k].bias)) for k in (0, 2, 4)]

    def torque(past: np.ndarray) -> np.ndarray:
        z = np.clip((past - mean) / std, -CLAMP, CLAMP)
        for k, (weight, bias) in enumerate(layers):
            z = np.einsum("noi,ni->no", weight, z) + bias
            z = np.where(z > 0, z, np.expm1(np.minimum(z, 0))) if k < len(layers) - 1 else z
        return np.clip((past * servo[:, :, 0]).sum(1) + rest + scale * z[:, 0], -limit, limit)

    return torque


def _played(
    file: Path,
    motions: ListOf[Sequence],
    robot: RobotSpec,
    nets: dict[str, ActuatorNet],
    facts: dict[str, Any],
    gain: float,
) -> float:
    """What the networks leave in plain MuJoCo, rad; the scene has no servos."""
    model, op, errors = mujoco.MjModel.from_xml_path(str(file)), robot.operated_index, []
    ids = [model.joint(name).id for name in robot.joint_names]
    at, dof = model.jnt_qposadr[ids], model.jnt_dofadr[ids]
    model.dof_invweight0[dof] *= facts["dof_invweight0_factor"]
    for net in nets.values():
        net.gain = gain
    data, torque, length = mujoco.MjData(model), _beside(list(nets.values())), _length(facts)
    for s in motions:
        mujoco.mj_resetData(model, data)
        data.qpos[at], data.qvel[dof], found = s.qpos[0], s.qvel[0], [s.qpos[0]]
        past = np.zeros((len(ids), 2, length))
        past[:, 0] = (s.ctrl[0] - s.qpos[0])[:, None]
        for target in s.ctrl[:-1]:
            for _ in range(facts["decimation"]):
                past[:, :, 1:] = past[:, :, :-1].copy()
                past[:, 0, 0], past[:, 1, 0] = target - data.qpos[at], data.qvel[dof]
                data.qfrc_applied[dof] = torque(past.reshape(len(ids), -1))
                mujoco.mj_step(model, data)
            found.append(data.qpos[at].copy())
        errors.append(mean_error(s.qpos[:, op], np.array(found)[:, op]))
    return float(np.mean(errors))


def _write(net: ActuatorNet, folder: Path, name: str, told: dict[str, Any]) -> None:
    """The three files of a joint; what they say of themselves is Newton's metadata as well."""
    import onnx

    told |= {"input_idx": list(range(told["length"])), "pos_scale": 1.0, "vel_scale": 1.0, "effort_scale": 1.0}
    told |= {"units": "rad, rad/s in, N·m out", "newest": "first"}
    x = torch.zeros(2, 2 * told["length"])
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        with atomic_write(folder / f"{name}.onnx") as path:
            torch.onnx.export(net, (x,), path, input_names=["past"], output_names=["torque"], dynamo=False,
                              dynamic_axes={"past": {0: "batch"}, "torque": {0: "batch"}})  # fmt: skip
            graph = onnx.load(path)
            onnx.helper.set_model_props(graph, {"metadata": json.dumps(told)})
            onnx.save(graph, path)
        with atomic_write(folder / f"{name}.pt2") as path, path.open("wb") as file:
            batch = ({0: torch.export.Dim("batch", min=1, max=2**31)},)
            torch.export.save(torch.export.export(net, (x,), dynamic_shapes=batch), file,
                              extra_files={"metadata.json": json.dumps(told)})  # fmt: skip
        with atomic_write(folder / f"{name}.pt") as path:
            torch.jit.save(torch.jit.trace(net, x), path)
