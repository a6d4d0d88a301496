"""A network that answers in one go what the compensator solves for: u − a′ with u + G(u) = a′.

It is fitted to the fixed point, iterated until it stands still, on the states that shadows pass through while they play
the robot's library of motions at all payloads. Input and artifact are those of any correction, x = [o_t | a′_t] →
u − a′, so it runs as a GapModel does; the compensator looks for it beside the model (INVERSE).
"""

from __future__ import annotations

from dataclasses import asdict, replace

import numpy as np
import torch

from gaponet.arrays import Array
from gaponet.deploy.compensator import INVERSE, Compensator, CompensatorConfig
from gaponet.model.artifact import GapModel
from gaponet.model.deeponet import build_network
from gaponet.model.export import export
from gaponet.model.layers import DeltaNet
from gaponet.robot import RobotSpec

HIDDEN = (256, 128)
CONVERGED = CompensatorConfig(iterations=8, feedback=0.0, blend=0.0)  # 0.5⁸ of an error that is small to begin with
HELD_OUT = 0.1  # share of the motions that only judge


def visit(robot: RobotSpec, model: GapModel, targets: list[Array], masses: Array) -> tuple[Array, Array]:
    """What N shadows pass through: x (T, N, dim) float32 and u − a′ (T, N, n) rad.

    Args:
        targets: N motions, (T, n) rad each, cut to the shortest.
        masses: (N,) kg.
    """
    compensator = Compensator(robot, model, CONVERGED, num_envs=len(targets))
    rows = min(len(target) for target in targets)
    played = np.stack([target[:rows] for target in targets], axis=1)
    compensator.reset(played[0], masses)
    loop, x, offset = compensator.loop, [], []
    run, seen = loop.bound.run, np.zeros_like(loop.x)

    def noted() -> None:  # what the network sees; once the period is over, that period is the newest frame of its past
        seen[:] = loop.x
        run()

    loop.bound = replace(loop.bound, run=noted)
    for target in played:
        compensator.step(target, None)
        seen[:, loop.layout.action] = compensator.wanted
        x.append(seen.copy())
        offset.append(compensator.offset.astype(np.float32))
    return np.stack(x), np.stack(offset)


def fit_inverse(net: DeltaNet, x: Array, offset: Array, steps: int, batch: int = 512, seed: int = 0) -> None:
    """Least squares, Adam with a falling step size; x (k, dim), offset (k, n) rad."""
    inputs, labels = torch.from_numpy(x), torch.from_numpy(offset)
    net.fit_inputs(inputs)
    optimiser = torch.optim.Adam(net.parameters(), lr=2e-3)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimiser, steps)
    generator = torch.Generator().manual_seed(seed)
    for _ in range(steps):
        rows = torch.randint(len(inputs), (batch,), generator=generator)
        loss = (net(inputs[rows]) - labels[rows]).square().mean()
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
        schedule.step()


def learn_inverse(
    robot: RobotSpec, model: GapModel, motions: list[Array], steps: int = 2000, seed: int = 0
) -> dict[str, float]:
    """Fit and write the inverse of a model, beside it.

    Args:
        motions: Targets at the control period, (T, n) rad each.
        seed: Seed of the network, of the payloads and which motions judge.

    Returns:
        rms, rad: of u − a′ itself and of what the network misses of it, on motions that were held out.
    """
    torch.manual_seed(seed)
    rng = np.random.default_rng(seed)
    seen = model.card.get("payload_seen") or [0.0, model.config.payload_max]
    masses = rng.uniform(min(seen), max(seen), len(motions))  # beyond them the model itself is a guess
    x, offset = visit(robot, model, motions, masses)
    judged = rng.permutation(len(motions)) < max(1, round(HELD_OUT * len(motions)))
    flat = lambda values, which: values[:, which].reshape(-1, values.shape[2])  # noqa: E731
    config = replace(model.config, kind="mlp", mlp_hidden=HIDDEN, mlp_match=False, delta_max=CONVERGED.limit)
    net = build_network(config, len(robot.operated))
    fit_inverse(net, flat(x, ~judged), flat(offset, ~judged), steps, seed=seed)
    net.eval()
    samples, truth = flat(x, judged), flat(offset, judged)
    with torch.inference_mode():
        missed = net(torch.from_numpy(samples)).numpy() - truth
    facts = {"rms_offset": _rms(truth), "rms_missed": _rms(missed)}
    card = model.card | {"model": asdict(config), "inverse_of": model.weights_hash(), "inverse": facts}
    export(net, model.path / INVERSE, card, samples[:256])
    return facts


def _rms(values: Array) -> float:
    return float(np.sqrt(np.mean(np.square(values, dtype=float))))
