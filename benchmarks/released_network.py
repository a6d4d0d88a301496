"""Compare the network that the paper's authors published with `--model paper`, output by output.

    python benchmarks/released_network.py FOLDER

FOLDER holds weights.npz (their state dict by its names) and pairs.npz (model_obs, action, and
delta, the outputs of their code). Exit code 1 above 1e-6.
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from gaponet.base.arrays import Array
from gaponet.nn.config import ModelConfig
from gaponet.nn.paper import PaperNet

LIMIT = 1e-6  # rad
RELEASED_EPSILON = 0.01  # in the published network's normaliser, (x − mean) / (std + ε)


def released_network(weights: dict[str, Array]) -> PaperNet:
    """Return the network of ten joints that the authors published.

    It is in isaac-sim2real/sage, feature/add-plug-in. Their observation has no present velocities:
    these columns get weight zero. Their predictor has no variance. Their normaliser of [S | A] only
    divides by 1 + ε.

    Args:
        weights: Arrays of their state dict.
    """
    net = PaperNet(ModelConfig(kind="paper", payload_input=False, delta_max=10.0), 10).eval()
    state = net.state_dict()
    published = {
        "predictor.net": "sensor_model",
        "trunk": "trunk_net.net",
        "branch": "branch_net.branches.0",
    }
    for own, name in published.items():
        for layer in (0, 2, 4, 6):
            source = f"{name}.{layer}"
            if own == "branch" and layer == 6:
                source = "branch_net.fusion.0"
            for part in ("weight", "bias"):
                if f"{source}.{part}" in weights:
                    state[f"{own}.{layer}.{part}"] = torch.from_numpy(weights[f"{source}.{part}"])
    n = net.n
    first = state["predictor.net.0.weight"]
    state["predictor.net.0.weight"] = torch.cat(
        [first[:, :n], torch.zeros(len(first), n), first[:, n:]], dim=1
    )
    for part in ("weight", "bias"):
        mean = state[f"predictor.net.4.{part}"]
        state[f"predictor.net.4.{part}"] = torch.cat([mean, torch.zeros_like(mean)])
    state["branch.0.weight"] = state["branch.0.weight"] / (1 + RELEASED_EPSILON)
    state["query_scale.std"] = state["query_scale.std"] * (1 + RELEASED_EPSILON)
    net.load_state_dict(state)
    return net


def released_inputs(observation: Array, action: Array) -> Tensor:
    """Convert the published observation (B, 130) and action (B, 10) to x = [o_t | a_t]."""
    observed = torch.from_numpy(observation)
    sent = torch.from_numpy(action)
    no_velocities = torch.zeros_like(sent)
    return torch.cat([observed[:, :10], no_velocities, observed[:, 10:], sent], dim=1)


def difference(folder: Path) -> float:
    """Largest |module − published output| over the pairs, rad."""
    net = released_network(dict(np.load(folder / "weights.npz")))
    pairs = np.load(folder / "pairs.npz")
    with torch.inference_mode():
        delta = net(released_inputs(pairs["model_obs"], pairs["action"])).numpy()
    return float(np.abs(delta - pairs["delta"]).max())


if __name__ == "__main__":
    largest = difference(Path(sys.argv[1]))
    print(f"max |difference| {largest:.2e} rad")
    sys.exit(largest > LIMIT)
