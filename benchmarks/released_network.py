"""Compare the network that the paper's authors published with `--model paper`, output by output, and on real logs.

    python benchmarks/released_network.py FOLDER [--logs H1_2_REAL]

FOLDER holds weights.npz (their state dict by its names) and pairs.npz (model_obs, action, and delta, the outputs of
their code). Exit code 1 above 1e-6.

With --logs, the network corrects the targets of the nominal H1-2 over the recordings in that folder (the set h1_2 of
`gaponet experiment real`). Nothing is fitted to them, so every recording is a test. ± is the standard error over
commands.
Differences to the nominal simulator are paired.

pairs.npz does not show what the inputs mean: they are independent normal numbers (correlation between blocks of ten
columns at most 0.11). The weights show it. The sensor predictor must repeat the simulator's answers to the probes of
the authors' public configuration (PROBES). MuJoCo answers the same probes in random states. Its motors have no inertia,
damping or friction of their own there, and 30 N·m, as in the authors' public model. Numbers below are correlations of
the predictor's answers with MuJoCo's. The score of a reading on the logs did not choose it.

| question | inferred | evidence |
|---|---|---|
| joints | pitch, yaw, roll, elbow: left, then right; both wrists | mean answers 0.93 to 0.99, another joint's ≤ 0.75 |
| frames | newest first | 0.85, oldest first 0.26 |
| a frame | (q, q̇, target) | (q, target, q̇) 0.08; (target, q̇, q) 0.84 is undecided: the authors' public code |
| units | rad, rad/s | degrees 0.23; rad per period 0.87 is undecided: the authors' public code |
| control rate | 50 Hz | a wrist answers 0.26 rad to 0.5; kp / kd = 50/s allows 0.20 in 10 ms, 0.32 in 20 ms |
| Δ | added to the target | the authors' public description alone |
"""

from __future__ import annotations

import argparse
import sys
import tempfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np
import torch
from scipy.optimize import linear_sum_assignment
from torch import Tensor

from gaponet.base.arrays import Array
from gaponet.data.split import canonical_motions
from gaponet.experiments.real.cards import prepare, read_cards
from gaponet.experiments.real.methods import FittedSim
from gaponet.nn.config import ModelConfig
from gaponet.nn.loop import DeltaCorrector, DeltaLoop
from gaponet.nn.paper import PaperNet
from gaponet.nn.sensor import ProbeOracle
from gaponet.robot.spec import RobotSpec
from gaponet.sim.batch import BatchSim, Condition
from gaponet.sim.metrics import standard_error

LIMIT = 1e-6  # rad
RELEASED_EPSILON = 0.01  # in the published network's normaliser, (x − mean) / (std + ε)
STATES, JOINTS = 300, 10
# Offsets of ± 0.5 rad from the present position: shoulder pitch, roll, yaw, elbow, wrist roll; left arm, right arm.
PROBES = """
    +0000+0000 00+0000+00 0+0000+000 +++00+++00 000+0000+0 0000+0000+ 0000000000 0000000000 --00000000 00-+000000
    -000-00000 00-0000000 00000--000 0000000--0 00000-000- 0000000-00 -00+--00+- +00+++00++ 00-0000-00 00+0000+00
"""


@dataclass(frozen=True)
class Reading:
    """A way to feed the network from x = [q | q̇ | 4 × (q, q̇, target), newest first | a], joints as in robot.toml."""

    name: str
    order: Array  # joint of each of the network's columns
    blocks: tuple[int, ...] = tuple(range(15))  # of x, ten columns each, in the network's order
    angle: float = 1.0  # unit of the network per rad
    speed: float = 1.0  # the same per rad/s, beyond that of angles
    sign: float = 1.0  # of Δ
    dt: float = 0.02  # s

    def outputs(self, network: Callable[[torch.Tensor], torch.Tensor], x: Array) -> Array:
        """Feed x, (B, 150), and return the outputs, joints as in robot.toml, (B, numbers per joint, 10), rad."""
        unit = np.full((15, 1), self.angle, np.float32)
        unit[[1, 3, 6, 9, 12]] *= self.speed
        blocks = (x.reshape(-1, 15, JOINTS) * unit)[:, self.blocks][:, :, self.order]
        with torch.inference_mode():
            out = network(torch.from_numpy(blocks.reshape(x.shape))).numpy().reshape(len(x), -1, JOINTS)
        return np.asarray(out[:, :, np.argsort(self.order)] / self.angle)

    def corrector(self, net: PaperNet, robot: RobotSpec) -> DeltaCorrector:
        return DeltaCorrector(lambda x: self.sign * self.outputs(net, x)[:, 0], net.config, robot)


def predicted_sensors(net: PaperNet, x: torch.Tensor) -> torch.Tensor:
    """The sensor values that the network's predictor gives, (B, 400)."""
    return net.sensors(x, net.sensor_inputs(x))


def readings(order: Array) -> list[Reading]:
    """Return the inferred reading and what else was plausible."""
    left_right, newest = np.arange(JOINTS), (2, 5, 8, 11)  # first blocks of the frames

    def blocks(frames: Sequence[int], frame: Sequence[int] = (0, 1, 2)) -> tuple[int, ...]:
        return (0, 1, *(k + i for k in frames for i in frame), 14)

    return [
        Reading("as inferred", order),
        Reading("left arm, then right", left_right),
        Reading("left and right in turn", left_right.reshape(2, 5).T.ravel()),
        Reading("oldest frame first", order, blocks(newest[::-1])),
        Reading("frame (target, q̇, q)", order, blocks(newest, (2, 1, 0))),
        Reading("frame (q, target, q̇)", order, blocks(newest, (0, 2, 1))),
        Reading("speeds in rad per period", order, speed=0.02),
        Reading("degrees", order, angle=180 / np.pi),
        Reading("−Δ", order, sign=-1.0),
        Reading("100 Hz", order, dt=0.01),
    ]


def released_network(weights: dict[str, Array]) -> PaperNet:
    """Return the network that the authors published (isaac-sim2real/sage, feature/add-plug-in), ten joints.

    Their observation has no present velocities: these columns get weight zero. Their predictor has no variance. Their
    normaliser of [S | A] only divides by 1 + ε.

    Args:
        weights: Arrays of their state dict.
    """
    net = PaperNet(ModelConfig(kind="paper", payload_input=False, delta_max=10.0), 10).eval()
    state = net.state_dict()
    published = {"predictor.net": "sensor_model", "trunk": "trunk_net.net", "branch": "branch_net.branches.0"}
    for own, name in published.items():
        for layer in (0, 2, 4, 6):
            fusion = own == "branch" and layer == 6
            source = "branch_net.fusion.0" if fusion else f"{name}.{layer}"
            for part in ("weight", "bias"):
                if f"{source}.{part}" in weights:
                    state[f"{own}.{layer}.{part}"] = torch.from_numpy(weights[f"{source}.{part}"])
    first, n = state["predictor.net.0.weight"], net.n
    state["predictor.net.0.weight"] = torch.cat([first[:, :n], torch.zeros(len(first), n), first[:, n:]], dim=1)
    for part in ("weight", "bias"):
        mean = state[f"predictor.net.4.{part}"]
        state[f"predictor.net.4.{part}"] = torch.cat([mean, torch.zeros_like(mean)])
    state["branch.0.weight"] = state["branch.0.weight"] / (1 + RELEASED_EPSILON)
    state["query_scale.std"] = state["query_scale.std"] * (1 + RELEASED_EPSILON)
    net.load_state_dict(state)
    return net


def released_inputs(observation: Array, action: Array) -> Tensor:
    """Convert the published network's observation (B, 130) and action (B, 10) to x = [o_t | a_t]."""
    o, a = torch.from_numpy(observation), torch.from_numpy(action)
    return torch.cat([o[:, :10], torch.zeros_like(a), o[:, 10:], a], dim=1)


def difference(folder: Path) -> float:
    """Largest |module − published output| over the pairs, rad."""
    net, pairs = released_network(dict(np.load(folder / "weights.npz"))), np.load(folder / "pairs.npz")
    with torch.inference_mode():
        delta = net(released_inputs(pairs["model_obs"], pairs["action"])).numpy()
    return float(np.abs(delta - pairs["delta"]).max())


def random_states(net: PaperNet, nominal: RobotSpec, dt: float) -> tuple[Array, Array]:
    """Return x, (STATES, 150), after four random targets, and the simulator's answers there, (STATES, 40, 10), rad."""
    rng, op, zero = np.random.default_rng(0), nominal.operated_index, np.zeros(len(nominal.joint_names))
    robot = replace(nominal, damping=zero, frictionloss=zero, armature=zero + 1e-3, effort_limit=zero + 30)
    limits = nominal.qpos_range[op]

    def positions() -> Array:
        drawn = np.zeros((STATES, len(zero)))
        drawn[:, op] = 0.8 * (limits.mean(1) + 0.45 * np.ptp(limits, axis=1) * rng.uniform(-1, 1, (STATES, JOINTS)))
        return drawn

    conditions = [Condition(rng.uniform(0, 3), ("left", "right")[i % 2], dt) for i in range(STATES)]
    sim, loop = BatchSim(robot, conditions), DeltaLoop(net.config, limits, STATES)
    q, v = positions(), np.zeros(sim.qvel.shape)
    v[:, op] = rng.uniform(0, 10, (STATES, JOINTS))
    sim.reset(slice(None), q, v)
    loop.observe(q[:, op], v[:, op], q[:, op], 0.0)
    for _ in range(4):
        target = positions()
        loop.history.push(sim.qpos[:, op], sim.qvel[:, op], target[:, op])
        sim.step(target)
    oracle = ProbeOracle(robot, net.config, conditions)
    oracle.offsets = np.array([[0.5 * ("-0+".index(c) - 1) for c in probe] for probe in PROBES.split()])
    answers = oracle(sim.qpos, np.zeros_like(v)).reshape(STATES, -1, JOINTS)
    return loop.observe(sim.qpos[:, op], sim.qvel[:, op], sim.qpos[:, op], 0.0), answers


def inferred_order(net: PaperNet, x: Array, answers: Array) -> tuple[Array, Array]:
    """Joint of each column, by its mean answers to the probes, and their correlations (column, joint)."""
    order = np.arange(JOINTS)
    for _ in range(JOINTS):  # the answers also depend on the order of the inputs
        columns = (
            Reading("", order).outputs(partial(predicted_sensors, net), x).mean(0)[::2, order]
        )  # positions, of all probes
        match = np.corrcoef(columns.T, answers.mean(0)[::2].T)[:JOINTS, JOINTS:]
        order = linear_sum_assignment(-match)[1]
    return order, match


def shown(values: Array) -> str:
    """Mean ± standard error over commands."""
    return f"{values.mean():.2f} ± {standard_error(values):.2f}"


def on_logs(net: PaperNet, logs: Path) -> None:
    """Print how well each reading explains the predictor, and its MPJAE on the logs."""
    card = next(c for c in read_cards().set if c.name == "h1_2")
    with tempfile.TemporaryDirectory() as work:
        dataset, robot, _ = prepare(replace(card, folder=str(logs.resolve())), Path(), Path(work))
        recordings, lead = dataset.sequences(dataset.entries), canonical_motions(dataset)
        command = np.array([lead[e.meta.motion] for e in dataset.entries])

    def errors(answer: FittedSim) -> Array:
        each = 1e3 * np.array(answer.errors(recordings))
        return np.array([each[command == c].mean() for c in np.unique(command)])

    states = {dt: random_states(net, robot, dt) for dt in (0.02, 0.01)}
    order, match = inferred_order(net, *states[0.02])
    for j, each in zip(order, match, strict=True):
        print(f"{robot.operated[j]}: correlation {each[j]:.2f}, with another joint {np.delete(each, j).max():.2f}")
    nominal = errors(FittedSim(robot))
    print(f"{len(recordings)} recordings of {len(nominal)} commands\n")
    print("| reading | predictor, correlation | RMS, mrad | MPJAE, mrad | more than nominal | commands improved |")
    print(f"|---|---|---|---|---|---|\n| nominal | – | – | {shown(nominal)} | – | – |")
    for reading in readings(order):
        x, answers = states[reading.dt]
        predicted, score = reading.outputs(partial(predicted_sensors, net), x), "– | – | –"
        if reading.dt == robot.dt:
            error = errors(FittedSim(robot, reading.corrector(net, robot)))
            score = f"{shown(error)} | {shown(error - nominal)} | {(error < nominal).sum()}"
        share, rms = np.corrcoef(predicted.ravel(), answers.ravel())[0, 1], np.sqrt(((predicted - answers) ** 2).mean())
        print(f"| {reading.name} | {share:.2f} | {1e3 * rms:.0f} | {score} |", flush=True)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--logs", type=Path)
    args = parser.parse_args()
    largest = difference(args.folder)
    print(f"max |difference| {largest:.2e} rad")
    if args.logs:
        on_logs(released_network(dict(np.load(args.folder / "weights.npz"))), args.logs)
    sys.exit(largest > LIMIT)
