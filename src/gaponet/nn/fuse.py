"""A trained network as the few products that run; see nn/fused.py."""

from __future__ import annotations

import numpy as np
import torch
from scipy.linalg import block_diag
from torch import Tensor, nn

from gaponet.base.arrays import Array
from gaponet.nn.baselines.mlp import DeltaMLP
from gaponet.nn.deeponet import OperatorNet, SharedMLP
from gaponet.nn.fused import CLAMP, JOINT_WISE, PARTS, Layers


def fuse(net: nn.Module) -> dict[str, Array] | None:
    """Weights of the fused form, float32; None for a kind of network that has none.

    Computed in double precision, so that what is multiplied out here costs no accuracy.
    """
    if type(net) is DeltaMLP:
        weights = _mlp(net)
    elif isinstance(net, OperatorNet) and type(net) in (OperatorNet, SharedMLP) and _plain(net):
        weights = _joint(net)
    else:
        return None
    return {
        k: v if v.dtype.kind == "U" else np.ascontiguousarray(v, np.float32) for k, v in weights.items()
    }  # fmt: skip


def _plain(net: OperatorNet) -> bool:
    """Whether the operator is made of the parts that this file knows, and of nothing else."""
    parts = {name.split(".")[0] for name in net.state_dict()}
    return parts <= {"features", "predictor", "branch", "trunk", "bias", "bounded", "net"}


def _mlp(net: DeltaMLP) -> dict[str, Array]:
    weights = _features(net, np.arange(net.features.dim))
    return weights | _name("trunk", _scaled(_dense_layers(net.net), net)) | {
        "kind": np.array("mlp"), "bias": np.zeros(net.n)
    }  # fmt: skip


def _joint(net: OperatorNet) -> dict[str, Array]:
    n, dim, config = net.n, net.features.dim, net.config
    depth, payload = 2 + 3 * config.history, int(config.payload_input)
    others = [*range(2 * n), *range(dim - n, dim)]
    known = depth + payload + 1 + len(others)
    width, names = known + n, known + np.arange(n)
    own = np.arange(depth) * n  # columns of joint 0; those of joint j are j further on
    columns = np.concatenate(
        [np.concatenate([own + j, np.full(payload, depth * n), [dim - n + j], others]) for j in range(n)]
    ).astype(int)
    weights = _named(_features(net, columns), n)
    alone = isinstance(net, SharedMLP)  # one net is a branch whose trunk answers 1
    branch = _dense_layers(net.net if isinstance(net, SharedMLP) else net.branch)
    trunk = [(np.zeros((1 + payload + n, 1)), np.ones(1))] if alone else _dense_layers(net.trunk)
    predictor: Layers = []
    (w, b), sensed = branch[0], 0
    parts = []
    if net.predictor is not None:
        predictor = _dense_layers(net.predictor.net)
        first = np.zeros((n * width, predictor[0][0].shape[1]))
        at = np.arange(n)[:, None] * width + np.arange(depth)
        first[at.ravel()] = predictor[0][0][columns.reshape(n, known)[:, :depth].ravel()]
        if payload:
            first[depth] = predictor[0][0][depth * n]  # its first copy
        first[known] = predictor[0][1]  # the name of joint 0 is 1 in its place: all first biases are weights of names
        predictor[0] = (first, np.zeros_like(predictor[0][1]))
        sensed = 2 * config.num_probes
        order = (np.arange(sensed)[None, :] * n + np.arange(n)[:, None]).ravel()  # joint by joint
        predictor[-1] = (predictor[-1][0][:, order], predictor[-1][1][order])
        parts.append(w[n : n + sensed])
    told = [*range(depth + payload), *range(depth + payload + 1, known)]
    seen = _rows(w[:n] + b, names, width) + _rows(w[n + sensed : net.branch_inputs], np.array(told), width)
    asked = np.array([depth + payload] + [depth] * payload)
    if alone:
        query = w[net.branch_inputs :]
        seen += _rows(query[:n], names, width) + _rows(query[n:], asked, width)
    branch[0] = (np.concatenate([*parts, seen]), np.zeros_like(b))
    w, b = trunk[0]
    trunk[0] = (_rows(w[:n] + b, names, width) + _rows(w[n:], asked, width), np.zeros_like(b))
    trunk = _scaled(trunk, net)
    weights |= _name("predictor", predictor) | {"bias": np.zeros(n) if alone else _bias(net)}
    if len(branch) != len(trunk):
        return weights | _name("branch", branch) | _name("trunk", trunk) | {"kind": np.array("joint")}
    p = config.num_basis
    quarter = np.repeat([0.25, -0.25], p)[:, None]
    return weights | _name("pair", _paired(branch, trunk, sensed)) | {"quarter": quarter, "kind": np.array("pair")}


def _paired(branch: Layers, trunk: Layers, sensed: int) -> Layers:
    """Both nets as one of the same depth, branch [sensed | rows] and trunk [rows], that ends in b + t and b − t."""
    (w, _), (v, _) = branch[0], trunk[0]
    v = np.concatenate([np.zeros((sensed, v.shape[1])), v])
    middle = [block_diag(a, b) for (a, _), (b, _) in zip(branch[1:-1], trunk[1:-1], strict=True)]
    (b, b0), (t, t0) = branch[-1], trunk[-1]
    weights = [np.concatenate([w, v], axis=1), *middle, np.block([[b, b], [t, -t]])]
    biases = [np.concatenate([x, y]) for (_, x), (_, y) in zip(branch[:-1], trunk[:-1], strict=True)]
    return list(zip(weights, [*biases, np.concatenate([b0 + t0, b0 - t0])], strict=True))


def _named(weights: dict[str, Array], n: int) -> dict[str, Array]:
    """The same with each joint's name, a one-hot constant, behind its features."""
    relative, offset = weights["relative"], weights["offset"].reshape(n, -1)
    relative = relative.reshape(len(relative), n, -1)
    relative = np.concatenate([relative, np.zeros((len(relative), n, n))], axis=2)
    return weights | {
        "relative": relative.reshape(len(relative), -1),
        "offset": np.concatenate([offset, np.eye(n)], axis=1).ravel(),
    }


def _features(net: OperatorNet | DeltaMLP, columns: Array) -> dict[str, Array]:
    """R and offset of the features in the given order, which may name one twice."""
    features = net.features
    relative = features.relative(torch.eye(features.dim)).double().numpy()[:, columns]
    mean, std = (v.double().numpy()[columns] for v in (features.standardise.mean, features.standardise.std))
    return {"relative": relative / std, "offset": -mean / std, "delta_max": np.array(_limit(net))}


def _dense_layers(net: nn.Sequential) -> Layers:
    """Weights (in, out) and biases of Linear layers with ELU between, double precision."""
    linear = [m for m in net if isinstance(m, nn.Linear)]
    return [(m.weight.detach().double().numpy().T, m.bias.detach().double().numpy()) for m in linear]


def _rows(weight: Array, where: Array, rows: int) -> Array:
    """A first layer that is fed all of z but looks at `where` only."""
    out = np.zeros((rows, weight.shape[1]))
    out[where] = weight
    return out


def _limit(net: OperatorNet | DeltaMLP) -> float:
    return float(net.bounded.delta_max)


def _scaled(layers: Layers, net: OperatorNet | DeltaMLP) -> Layers:
    """The last layer in units of Δ_max / gain."""
    weight, bias = layers[-1]
    factor = float(net.bounded.gain * net.bounded.unit) / _limit(net)
    return [*layers[:-1], (weight * factor, bias * factor)]


def _bias(net: OperatorNet) -> Array:
    return net.bias.detach().double().numpy() * float(net.bounded.gain * net.bounded.unit) / _limit(net)


def _name(part: str, layers: Layers) -> dict[str, Array]:
    return {
        f"{part}.{i}.{k}": v for i, pair in enumerate(layers) for k, v in zip(("weight", "bias"), pair, strict=True)
    }


class FusedNet(nn.Module):
    """The fused form in torch, for the exporters: x (B, dim) → Δa (B, n). All shapes but B are constants."""

    relative: Tensor
    offset: Tensor
    bias: Tensor
    total: Tensor
    delta_max: Tensor

    def __init__(self, weights: dict[str, Array]) -> None:
        super().__init__()
        self.kind, self.n = str(weights["kind"]), len(weights["bias"])
        counts = {p: sum(k.startswith(p + ".") for k in weights) // 2 for p in PARTS}
        self.predictor, self.branch, self.trunk, self.pair = (range(counts[p]) for p in PARTS)
        self.width = weights["relative"].shape[1] // (self.n if self.kind in JOINT_WISE else 1)  # of z as rows
        first = weights.get("pair.0.weight", weights.get("branch.0.weight"))
        self.sensed = 0 if first is None else first.shape[0] - self.width
        for name, value in weights.items():
            if name not in ("kind", "quarter"):
                value = value.T if name.endswith(".weight") or name == "relative" else value
                self.register_buffer(name.replace(".", "_"), torch.from_numpy(np.ascontiguousarray(value)))
        last = weights[f"pair.{len(self.pair) - 1}.weight" if self.pair else f"trunk.{len(self.trunk) - 1}.weight"]
        basis = last.shape[1] // (1 if self.kind in JOINT_WISE else self.n)
        each = torch.from_numpy(weights["quarter"]).T if self.pair else torch.ones(1, basis)
        self.register_buffer("total", torch.kron(torch.eye(self.n), each))  # Σ over a joint's basis

    def layers(self, part: str, x: Tensor, sensed: Tensor | None = None) -> Tensor:
        """x W + b with ELU between; of [sensed | x], without putting them side by side."""
        indices = getattr(self, part)
        for i in indices:
            weight, bias = getattr(self, f"{part}_{i}_weight"), getattr(self, f"{part}_{i}_bias")
            if i == 0 and sensed is not None:
                seen = nn.functional.linear(x, weight[:, self.sensed :], bias)
                x = torch.addmm(seen, sensed, weight[:, : self.sensed].T)
            else:
                x = nn.functional.linear(x, weight, bias)
            if i < len(indices) - 1:
                # onnxruntime's Elu takes 6 ns a number, as exp and maximum a fraction of it: worth it for many rows.
                x = torch.maximum(x, x.clamp(max=0).exp() - 1) if part == "pair" else nn.functional.elu(x)
        return x

    def forward(self, x: Tensor) -> Tensor:
        z = nn.functional.linear(x, self.relative, self.offset).clamp(-CLAMP, CLAMP)
        rows = z.reshape(-1, self.width) if self.kind in JOINT_WISE else z
        sensed = None
        if self.predictor:
            sensed = self.layers("predictor", z).reshape(-1, self.sensed)
        if self.pair:
            y = self.layers("pair", rows, sensed)
            y = nn.functional.linear((y * y).reshape(-1, self.total.shape[1]), self.total, self.bias)
        else:
            y = self.layers("trunk", rows)
            if self.branch:
                y = self.layers("branch", rows, sensed) * y
                y = nn.functional.linear(y.reshape(-1, self.total.shape[1]), self.total, self.bias)
        return torch.tanh(y) * self.delta_max
