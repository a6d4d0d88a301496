"""Compare the network that the paper's authors published with `--model paper`, output by output.

    python benchmarks/released_network.py FOLDER

FOLDER holds weights.npz (their state dict by its names) and pairs.npz (model_obs, action, and delta, the outputs of
their code). Exit code 1 above 1e-6.
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import torch

from gaponet.nn.paper import released_inputs, released_network

LIMIT = 1e-6  # rad


def difference(folder: Path) -> float:
    """Largest |module − published output| over the pairs, rad."""
    net, pairs = released_network(dict(np.load(folder / "weights.npz"))), np.load(folder / "pairs.npz")
    with torch.inference_mode():
        delta = net(released_inputs(pairs["model_obs"], pairs["action"])).numpy()
    return float(np.abs(delta - pairs["delta"]).max())


if __name__ == "__main__":
    largest = difference(Path(sys.argv[1]))
    print(f"max |difference| {largest:.2e} rad")
    sys.exit(largest > LIMIT)
