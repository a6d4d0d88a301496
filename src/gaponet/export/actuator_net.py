"""Actuator networks of a run, one per joint: past errors of the target and past velocities go in,
the torque comes out.

mjlab, Newton and Isaac Lab load this form (Hwangbo et al. 2019, Science Robotics 4, eaau5872). It
contains the identified servo exactly: a delayed target minus the present position is the error at
that time minus the motion since. A small network is fitted to the torque that the run's network
adds, kp · Δa, on rollouts that the run's network corrects. Its inputs are clipped and its torque is
at most kp times the run's delta_max, so it is finite wherever the engine's state is. Engines give a
joint's network neither posture nor payload, so effects of these are lost.
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
from scipy.interpolate import CubicHermiteSpline
from torch import Tensor, nn

from gaponet.base.errors import UsageError
from gaponet.base.files import atomic_write
from gaponet.data.sequence import Sequence
from gaponet.data.split import stratified_subset
from gaponet.data.store import Dataset
from gaponet.evaluation.candidate import split_of_run
from gaponet.evaluation.run_files import read_config
from gaponet.export.plain_servos import comparable, mean_error
from gaponet.export.shipped.mujoco_servos import delay_weights
from gaponet.robot.spec import RobotSpec
from gaponet.sim.replay import Corrector, replay

PAST_S = 0.1  # beyond the longest delay
HIDDEN = (32, 32)
MAX_INPUT_STD = 5.0
MAX_RECORDINGS = 40  # of each split
# Of the fit of a joint's network, as in supervised pre-training.
ROWS = 60_000  # of all recordings
STEPS = 2000
BATCH = 512
RATE = 2e-3
DECAY = 1.0
NOISE = 0.4  # standard deviations of the inputs
GAINS = (1.0, 0.5, 0.0)  # factors of kp · Δa that are tried on validation motions


class ActuatorNet(nn.Module):
    """Network of one joint: [e_t … e_{t-L+1} | q̇_t … q̇_{t-L+1}], (B, 2L) → torque, (B, 1) N·m.

    e = target − q, rad; q̇ in rad/s. The torque is that of the identified servo, which is linear in
    these, and kp · Δa, which the small network adds.

    Attributes:
        servo: Torque of the servo for one of each input, (2L, 1).
        mean, std: Of the inputs, (2L,).
        offset_torque: kp · offset, N·m.
        limit: Torque limit, N·m.
        net: The small network, (B, 2L) → (B, 1).
        scale: Torque that is added for an output of 1, N·m: kp · the RMS of Δa in the fit.
        gain: Factor on what is added, one of GAINS; chosen after the fit.
        most_added: kp · delta_max, N·m.
    """

    servo: Tensor
    mean: Tensor
    std: Tensor

    def __init__(
        self, joint: dict[str, Any], step: float, length: int, delta_max: float = np.inf
    ) -> None:
        """
        Args:
            joint: The servo, as in facts.json.
            step: Physics step, s.
            length: Physics steps of the past, L.
            delta_max: Largest correction of the run's network, rad; kp times it bounds the torque
                that is added.
        """
        super().__init__()
        kp = joint["kp"]
        weights = delay_weights(np.array([joint["delay"]]), step)[:, 0]
        delayed = np.zeros(length)
        delayed[: len(weights)] = weights
        # q_t − q_{t-k} = step · (q̇_t + … + q̇_{t-k+1})
        damping = kp * step * (np.cumsum(delayed[::-1])[::-1] - delayed)
        damping[0] += joint["kd"]
        servo = np.concatenate([kp * delayed, -damping])[:, None]
        self.register_buffer("servo", torch.tensor(servo, dtype=torch.float32))
        self.register_buffer("mean", torch.zeros(2 * length))
        self.register_buffer("std", torch.ones(2 * length))
        self.offset_torque = kp * joint["offset"]
        self.limit = joint["effort_limit"]
        self.scale = kp  # until the fit
        self.gain = 1.0
        self.most_added = kp * delta_max
        layers: list[nn.Module] = []
        for inputs, outputs in pairwise((2 * length, *HIDDEN)):
            layers += [nn.Linear(inputs, outputs), nn.ELU()]
        head = nn.Linear(HIDDEN[-1], 1)
        self.net = nn.Sequential(*layers, head)
        nn.init.zeros_(head.weight)
        nn.init.zeros_(head.bias)

    def standardised(self, x: Tensor) -> Tensor:
        """Return standardised inputs, limited to ± MAX_INPUT_STD."""
        return ((x - self.mean) / self.std).clamp(-MAX_INPUT_STD, MAX_INPUT_STD)

    def forward(self, x: Tensor) -> Tensor:
        added = (self.gain * self.scale) * self.net(self.standardised(x))
        added = added.clamp(-self.most_added, self.most_added)
        torque: Tensor = x @ self.servo + self.offset_torque + added
        return torque.clamp(-self.limit, self.limit)


def read_run_recordings(
    run: Path, data: str | None, robot: RobotSpec, payload_mass: float
) -> list[list[Sequence]]:
    """Read training and validation motions of a run.

    Only those that were made with this payload and the robot's own gains.

    Raises:
        UsageError: There is none.
    """
    place = data or read_config(run)["dataset"]
    dataset = Dataset(place if data else run / place)
    entries = [e for e in dataset.entries if e.meta.payload_mass == payload_mass]
    recordings = []
    for split in ("train", "val"):
        hashes = set(split_of_run(run)[split].values())
        of_split = [entry for entry in entries if entry.hash in hashes]
        chosen = stratified_subset(of_split, MAX_RECORDINGS)
        recordings.append(comparable(dataset.sequences(chosen), robot, payload_mass))
    if not all(recordings):
        raise UsageError(
            f"no recording of {run} was made with {payload_mass:g} kg and the robot's own gains"
        )
    return recordings


def write_networks(
    sequences: ListOf[Sequence],
    motions: ListOf[Sequence],
    corrector: Corrector,
    robot: RobotSpec,
    folder: Path,
    facts: dict[str, Any],
) -> dict[str, float]:
    """Fit the networks to rollouts, choose their gain, and write them and their facts.

    Returns:
        Mean |error| on the motions by form, rad.
    """
    rollouts = replay(sequences, robot, corrector, lock_idle=True)
    nets = _fit_networks(sequences, rollouts, robot, facts)
    errors = {}  # gain → mean |error|, rad
    for tried in GAINS:
        _set_gain(nets, tried)
        errors[tried] = _error_in_mujoco(folder / facts["file"], motions, robot, nets, facts)
    gain = min(errors, key=errors.__getitem__)
    _set_gain(nets, gain)
    info = {
        "length": _length(facts),
        "step": facts["options"]["timestep"],
        "gain": gain,
        "input_order": "pos_vel",
    }
    for name, net in nets.items():
        _write(net, folder, name, info | {"joint": name, "robot": robot.name})
    facts["actuator_net"] = info
    op = robot.operated_index
    errors_of_run = []
    corrected = replay(motions, robot, corrector, lock_idle=True)
    for motion, played in zip(motions, corrected, strict=True):
        errors_of_run.append(mean_error(motion.qpos[:, op], played.qpos[:, op]))
    return {
        "the run, in gaponet": float(np.mean(errors_of_run)),
        "actuator networks": errors[gain],
        "of these the servo alone": errors[0.0],
    }


def _set_gain(nets: dict[str, ActuatorNet], gain: float) -> None:
    """Multiply what the networks add by a gain."""
    for net in nets.values():
        net.gain = gain


def _length(facts: dict[str, Any]) -> int:
    """Return the length of the past: the longest delay and PAST_S, in physics steps."""
    longest = max(joint["delay"] for joint in facts["joints"].values())
    return int(np.ceil((longest + PAST_S) / facts["options"]["timestep"])) + 1


def _fit_networks(
    sequences: ListOf[Sequence], rollouts: ListOf[Any], robot: RobotSpec, facts: dict[str, Any]
) -> dict[str, ActuatorNet]:
    """Return a network for each joint; joints that are not operated have the servo alone."""
    step = facts["options"]["timestep"]
    length = _length(facts)
    delta_max = facts["delta_max"]
    nets = {}
    for name, joint in facts["joints"].items():
        nets[name] = ActuatorNet(joint, step, length, delta_max)
    rng = np.random.default_rng(0)
    torch.manual_seed(0)
    rows = ROWS // len(sequences) + 1
    for i, name in enumerate(robot.joint_names):
        if name not in robot.operated:
            continue
        inputs = []
        outputs = []
        for sequence, rollout in zip(sequences, rollouts, strict=True):
            x, y = _samples(sequence, rollout, i, nets[name], facts, rng, rows)
            inputs.append(x)
            outputs.append(y)
        _fit(nets[name], _tensor(inputs), _tensor(outputs))
    return {name: net.eval().requires_grad_(False) for name, net in nets.items()}


def _samples(
    s: Sequence,
    rollout: Any,
    i: int,
    net: ActuatorNet,
    facts: dict[str, Any],
    rng: np.random.Generator,
    rows: int,
) -> tuple[np.ndarray, np.ndarray]:
    """Return inputs of joint i in random physics steps, (rows, 2L), and delayed Δa, (rows, 1) rad.

    Args:
        s: Recording, with the targets.
        rollout: What the run's network makes of it, with the corrected targets.
    """
    count = facts["decimation"]
    length = len(net.mean) // 2
    path = CubicHermiteSpline(np.arange(len(s)) * s.dt, rollout.qpos[:, i], rollout.qvel[:, i])
    time = np.arange((len(s) - 1) * count) * (s.dt / count)
    q = path(time)
    v = path(time, 1)
    target = np.repeat(s.ctrl[:-1, i], count)
    delta = np.repeat(rollout.ctrl[:-1, i] - s.ctrl[:-1, i], count)
    chosen = rng.integers(0, len(target), rows)
    past = np.maximum(chosen[:, None] - np.arange(length), 0)
    weights = net.servo[:length, 0].numpy() / facts["joints"][s.joint_names[i]]["kp"]
    inputs = np.concatenate([target[past] - q[past], v[past]], axis=1)
    delayed = delta[past] @ weights
    return inputs, delayed[:, None]


def _tensor(parts: ListOf[np.ndarray]) -> Tensor:
    """Return the rows of all parts as float32."""
    return torch.tensor(np.concatenate(parts), dtype=torch.float32)


def _fit(net: ActuatorNet, x: Tensor, y: Tensor) -> None:
    """Fit Δa to the past with noise on the inputs, as in supervised pre-training.

    Without noise the network would predict Δa from earlier Δa, which the past contains.
    """
    net.mean.copy_(x.mean(0))
    net.std.copy_(x.std(0).clamp_min(1e-4))
    z = net.standardised(x)
    unit = float(y.square().mean().sqrt()) or 1.0
    optimiser = torch.optim.AdamW(net.net.parameters(), lr=RATE, weight_decay=DECAY)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimiser, STEPS)
    for _ in range(STEPS):
        batch = torch.randint(0, len(z), (BATCH,))
        output = net.net(z[batch] + NOISE * torch.randn(BATCH, z.shape[1]))
        loss = (output - y[batch] / unit).square().mean()
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
        schedule.step()
    net.scale *= unit  # since the output is Δa over its RMS


def _stack(tensors: ListOf[Tensor]) -> np.ndarray:
    """Return tensors as one numpy array, (n, …)."""
    return np.stack([tensor.detach().numpy() for tensor in tensors])


def _stacked_layer(nets: ListOf[ActuatorNet], k: int) -> tuple[np.ndarray, np.ndarray]:
    """Return weights (n, outputs, inputs) and biases (n, outputs) of module k of n networks."""
    linear: list[Any] = [net.net[k] for net in nets]
    weights = _stack([layer.weight for layer in linear])
    biases = _stack([layer.bias for layer in linear])
    return weights, biases


def _stacked(nets: ListOf[ActuatorNet]) -> Callable[[np.ndarray], np.ndarray]:
    """Return the networks of n joints as one numpy function, `ActuatorNet.forward` of each: pasts
    (n, 2L) → torques (n,) N·m.

    A later change of a network, such as of its gain, does not change the function.
    """
    servo = _stack([net.servo[:, 0] for net in nets])  # (n, 2L)
    mean = _stack([net.mean for net in nets])  # (n, 2L)
    std = _stack([net.std for net in nets])
    offset_torque = np.array([net.offset_torque for net in nets])  # (n,), as all that follow
    limit = np.array([net.limit for net in nets])
    scale = np.array([net.gain * net.scale for net in nets])
    most_added = np.array([net.most_added for net in nets])
    # Linear modules, with an ELU between each two.
    *hidden, head = [_stacked_layer(nets, k) for k in range(0, len(nets[0].net), 2)]

    def torques(past: np.ndarray) -> np.ndarray:
        x = np.clip((past - mean) / std, -MAX_INPUT_STD, MAX_INPUT_STD)
        for weight, bias in hidden:
            x = _elu(np.einsum("noi,ni->no", weight, x) + bias)
        weight, bias = head
        output = np.einsum("noi,ni->no", weight, x) + bias  # (n, 1)
        added = np.clip(scale * output[:, 0], -most_added, most_added)
        asked = (past * servo).sum(axis=1) + offset_torque + added
        return np.asarray(np.clip(asked, -limit, limit))

    return torques


def _elu(x: np.ndarray) -> np.ndarray:
    """Return what torch's ELU does."""
    return np.where(x > 0, x, np.expm1(np.minimum(x, 0)))


def _error_in_mujoco(
    file: Path,
    motions: ListOf[Sequence],
    robot: RobotSpec,
    nets: dict[str, ActuatorNet],
    facts: dict[str, Any],
) -> float:
    """Return the mean |error| of the networks in plain MuJoCo, rad; the scene has no servos."""
    model = mujoco.MjModel.from_xml_path(str(file))
    op = robot.operated_index
    errors = []
    ids = [model.joint(name).id for name in robot.joint_names]
    at = model.jnt_qposadr[ids]
    dof = model.jnt_dofadr[ids]
    model.dof_invweight0[dof] *= facts["dof_invweight0_factor"]
    data = mujoco.MjData(model)
    torques = _stacked(list(nets.values()))
    length = _length(facts)
    for s in motions:
        mujoco.mj_resetData(model, data)
        data.qpos[at] = s.qpos[0]
        data.qvel[dof] = s.qvel[0]
        path = [s.qpos[0]]
        past = np.zeros((len(ids), 2, length))  # errors and velocities, newest first
        past[:, 0] = (s.ctrl[0] - s.qpos[0])[:, None]
        for target in s.ctrl[:-1]:
            for _ in range(facts["decimation"]):
                past[:, :, 1:] = past[:, :, :-1].copy()
                past[:, 0, 0] = target - data.qpos[at]
                past[:, 1, 0] = data.qvel[dof]
                data.qfrc_applied[dof] = torques(past.reshape(len(ids), -1))
                mujoco.mj_step(model, data)
            path.append(data.qpos[at].copy())
        errors.append(mean_error(s.qpos[:, op], np.array(path)[:, op]))
    return float(np.mean(errors))


def _write(net: ActuatorNet, folder: Path, name: str, info: dict[str, Any]) -> None:
    """Write the three files of a joint, with metadata in Newton's form."""
    import onnx

    info |= {
        "input_idx": list(range(info["length"])),
        "pos_scale": 1.0,
        "vel_scale": 1.0,
        "effort_scale": 1.0,
    }
    info |= {"units": "rad, rad/s in, N·m out", "newest": "first"}
    x = torch.zeros(2, 2 * info["length"])
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        with atomic_write(folder / f"{name}.onnx") as path:
            torch.onnx.export(
                net,
                (x,),
                path,
                input_names=["past"],
                output_names=["torque"],
                dynamo=False,
                dynamic_axes={"past": {0: "batch"}, "torque": {0: "batch"}},
            )
            graph = onnx.load(path)
            onnx.helper.set_model_props(graph, {"metadata": json.dumps(info)})
            onnx.save(graph, path)
        with atomic_write(folder / f"{name}.pt2") as path, path.open("wb") as file:
            batch = ({0: torch.export.Dim("batch", min=1, max=2**31)},)
            program = torch.export.export(net, (x,), dynamic_shapes=batch)
            torch.export.save(program, file, extra_files={"metadata.json": json.dumps(info)})
        with atomic_write(folder / f"{name}.pt") as path:
            trace: Any = torch.jit.trace  # has no types
            torch.jit.save(trace(net, x), path)
