"""Gradient-boosted trees as a network: one ensemble per joint, on q, q̇ and a − q of all joints
and the payload.

scikit-learn fits the trees (Friedman 2001; histograms as in Ke et al. 2017). Their nodes are
tensors, so that checkpoints, ONNX files and torch programs of trees are like those of other
networks and need no scikit-learn.
"""

from __future__ import annotations

from importlib.util import find_spec
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from gaponet.base.arrays import Array
from gaponet.base.errors import ModelError, UsageError
from gaponet.base.installation import install_command
from gaponet.nn.config import ModelConfig
from gaponet.nn.layers import DeltaNet

TREES = 120  # of each joint
LEAVES = 31  # of a tree
MAX_DEPTH = 8
NODES = 2 * LEAVES - 1  # of a tree
MIN_LEAF_ROWS = 60
MAX_ROWS = 60_000  # from which the trees of a joint are fitted
MEASURED_ROWS = 2_000  # from which the error of a fit is measured
# Between scikit-learn and the stored trees, in units of the RMS of the labels
MAX_DIFFERENCE = 1e-4


def trees_available() -> bool:
    """Return true if scikit-learn is installed, which fits trees."""
    return find_spec("sklearn") is not None


class TreesNet(DeltaNet):
    """Δa_j = c_j + the sum of the leaves that x falls into, clipped to ±Δ_max.

    Attributes:
        feature, threshold: Input and limit of each node, (n · TREES · NODES,).
        child: Nodes for inputs up to the limit and above, (2 · n · TREES · NODES,); a leaf is its
            own child.
        value, base: Δa of each leaf, and c_j, (n,), in units of bounded.scale.
    """

    columns: Tensor
    roots: Tensor
    feature: Tensor
    threshold: Tensor
    child: Tensor

    def __init__(self, config: ModelConfig, n: int) -> None:
        super().__init__(config, n)
        layout = self.features.layout
        nodes = n * TREES * NODES
        parts = (layout.q, layout.v, layout.action, layout.payload)
        columns = np.concatenate([np.arange(part.start, part.stop) for part in parts])
        self.register_buffer("columns", torch.from_numpy(columns), persistent=False)
        self.register_buffer("roots", torch.arange(0, nodes, NODES), persistent=False)
        self.register_buffer("feature", torch.zeros(nodes, dtype=torch.long))
        self.register_buffer("threshold", torch.zeros(nodes))
        self.register_buffer("child", torch.arange(nodes).repeat_interleave(2))
        self.value = nn.Parameter(torch.zeros(nodes))
        self.base = nn.Parameter(torch.zeros(n))

    def prepare(self, x: Tensor) -> Tensor:
        """x → [q | q̇ | a − q | payload], (B, 3n + 1)."""
        return self.features.relative(x)[:, self.columns]

    def correct(self, prepared: Tensor) -> Tensor:
        result: Tensor = self.bounded(self._sums(prepared))
        return result

    def _sums(self, prepared: Tensor) -> Tensor:
        """Output of `prepare` → sums of leaves and c, in units of bounded.scale, (B, n)."""
        node = self.roots.expand(prepared.shape[0], -1)
        for _ in range(MAX_DEPTH):
            above = prepared.gather(1, self.feature[node]) > self.threshold[node]
            node = self.child[2 * node + above.long()]
        return self.value[node].reshape(-1, self.n, TREES).sum(-1) + self.base

    @torch.no_grad()
    def fit(self, x: Tensor, labels: Tensor, seed: int) -> Array:
        """Fit the trees to visited inputs x and labels, (rows, n) rad; NaN is no label.

        Returns:
            Mean squared error of a part of the labels, (1,) rad².

        Raises:
            UsageError: scikit-learn is not installed.
            ModelError: It stores trees in another form than the versions that gaponet knows.
        """
        if not trees_available():
            raise UsageError(
                f"--model trees: scikit-learn is not installed; run: {install_command('train')}"
            )
        from sklearn.ensemble import HistGradientBoostingRegressor as Ensemble

        rows = np.random.default_rng(seed).permutation(len(x))[: self.n * MAX_ROWS]
        inputs = self.prepare(x[rows]).cpu().numpy()
        targets = labels[rows].cpu().numpy()
        for j, column in enumerate(targets.T / self.bounded.scale.item()):
            labelled = np.flatnonzero(np.isfinite(column))[:MAX_ROWS]
            if not labelled.size:
                continue
            ensemble = Ensemble(
                max_iter=TREES,
                max_leaf_nodes=LEAVES,
                max_depth=MAX_DEPTH,
                min_samples_leaf=MIN_LEAF_ROWS,
                early_stopping=False,
            ).fit(inputs[labelled], column[labelled])
            self.store(j, ensemble)
            some = inputs[labelled[:MIN_LEAF_ROWS]]
            stored = self._sums(torch.from_numpy(some).to(x.device))[:, j].cpu().numpy()
            difference = np.abs(stored - ensemble.predict(some)).max()
            if not difference < MAX_DIFFERENCE:
                raise ModelError(
                    "this scikit-learn stores trees in an unknown form; install 1.5 to 1.9"
                )
        error = self(x[rows[:MEASURED_ROWS]]).cpu().numpy() - targets[:MEASURED_ROWS]
        return np.array([np.nanmean(error**2)])

    def store(self, j: int, ensemble: Any) -> None:
        """Copy the trees of joint j; scikit-learn has no public access to them."""
        for t, (tree,) in enumerate(ensemble._predictors):
            nodes = tree.nodes
            start = (j * TREES + t) * NODES
            leaf = nodes["is_leaf"].astype(bool)
            own = np.arange(len(nodes))
            part = slice(start, start + len(nodes))
            children = [start + np.where(leaf, own, nodes[side]) for side in ("left", "right")]
            limits = np.where(leaf, 0.0, nodes["num_threshold"])
            # Rounded down: float32 inputs then fall on the same side.
            near = limits.astype(np.float32)
            lower = np.where(near > limits, np.nextafter(near, np.float32(-np.inf)), near)
            self.feature[part] = torch.from_numpy(np.where(leaf, 0, nodes["feature_idx"]))
            self.threshold[part] = torch.from_numpy(lower)
            self.child[2 * part.start : 2 * part.stop] = torch.from_numpy(
                np.stack(children, axis=1).ravel()
            )
            self.value[part] = torch.from_numpy(
                np.where(leaf, nodes["value"], 0.0).astype(np.float32)
            )
        self.base[j] = ensemble._baseline_prediction.item()
