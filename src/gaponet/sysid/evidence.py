"""What recordings say near a robot's values, and what is known of it then."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from collections.abc import Sequence as ListOf
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.special import stdtrit

from gaponet.base.arrays import Array
from gaponet.data.sequence import Sequence
from gaponet.robot.spec import SERVO_TERMS, RobotSpec
from gaponet.sim.metrics import standard_error
from gaponet.sim.replay import replay
from gaponet.sysid.axes import CLASSIC, Axes, Bounds, first_values
from gaponet.sysid.fit import SURE
from gaponet.sysid.joint_rollouts import SOFT, JointRollouts
from gaponet.sysid.least_squares import slopes
from gaponet.sysid.robot_rollouts import cut
from gaponet.sysid.table_contact import tip_heights, touching_below
from gaponet.sysid.uncertainty import JointUncertainty, ParameterUncertainty, Provenance, prior_std, to_axes

WINDOWS, CLUSTERS = (
    40,
    24,
)  # windows of 8 s; parts of the recordings that are thought independent of each other, at least
SLACK = 0.002  # rad of a servo's error at which play has changed sides
SMALL = 1e-6  # of a parameter's own information: less is none
BAND = 0.9  # of all samples
PLAY = "play"  # of gear or motor, rad: no parameter of the simulator, but what later recordings may show


@dataclass(frozen=True)
class Evidence:
    """What recordings say near a robot's values, of n joints, C clusters, Q fields and play: pulls (n, C, Q) and slopes
    squared (n, C, Q, Q) on the axes; rows that count (n); of which recording a cluster is (C), and their names; the RMS
    error of each of W windows (n, W), rad."""

    pulls: Array
    normals: Array
    rows: Array
    recording: Array
    names: tuple[str, ...]
    left: Array

    def by_recording(self) -> Evidence:
        """The same with one cluster of each recording."""
        order = np.arange(len(self.names))
        pick = (self.recording == order[:, None]).astype(float)
        pulls, normals = np.einsum("rc,ncq->nrq", pick, self.pulls), np.einsum("rc,ncqp->nrqp", pick, self.normals)
        return Evidence(pulls, normals, self.rows, order, self.names, self.left)

    def without(self, names: Collection[str]) -> Evidence:
        """The same without these recordings."""
        if not names:
            return self
        keep = np.array([self.names[r] not in names for r in self.recording])
        left = tuple(name for name in self.names if name not in names)
        order = np.array([left.index(self.names[r]) for r in self.recording[keep]])
        rows = self.rows * keep.mean()  # windows are as long as each other
        return Evidence(self.pulls[:, keep], self.normals[:, keep], rows, order, left, self.left)

    def scatter(self) -> Array:
        """Variance of the clusters' sum of pulls over that of independent rows, (n, Q)."""
        own = np.einsum("nckk->nk", self.normals)
        spread = np.einsum("nkk->nk", spread_of(self.pulls))
        return np.asarray(np.divide(spread, own, out=np.zeros_like(own), where=own > 0))

    def step(self, scatter: Array) -> tuple[Array, Array]:
        """How far these recordings move the values by themselves, (n, Q), and the covariance of that."""
        normal = self.normals.sum(axis=1)
        inverse = inverted(normal)
        root = np.sqrt(scatter)
        spread = root[:, :, None] * normal * root[:, None, :]
        return -(inverse @ self.pulls.sum(axis=1)[..., None])[..., 0], inverse @ spread @ inverse


def clustered(pull: Array, window: Array) -> tuple[Array, Array]:
    """Sums over clusters of rows (n, rows, …) → (n, C, …), and the window of each: windows, or parts of few."""
    parts = max(1, -(-CLUSTERS // (int(window.max()) + 1)))
    order, turn = np.argsort(window, kind="stable"), np.zeros(len(window), int)
    count = np.diff(np.append(np.flatnonzero(np.diff(window[order], prepend=-1)), len(window)))
    turn[order] = np.concatenate([np.arange(c) * parts // c for c in count])
    cluster = window * parts + turn
    each = np.zeros((len(pull), int(cluster.max()) + 1, *pull.shape[2:]))
    np.add.at(each, (slice(None), cluster), pull)  # type: ignore[arg-type]
    return each, np.arange(each.shape[1]) // parts


def spread_of(pulls: Array) -> Array:
    """Covariance of the sum of clusters' pulls (n, C, Q), from how far they are apart, (n, Q, Q)."""
    each = pulls - pulls.mean(axis=1, keepdims=True)
    return np.asarray(np.swapaxes(each, -1, -2) @ each * (pulls.shape[1] / max(pulls.shape[1] - 1, 1)))


def inverted(normal: Array) -> Array:
    """Inverse of (n, Q, Q), directions without information held."""
    size = np.sqrt(np.maximum(np.einsum("...kk->...k", normal), 1e-12))
    both = size[..., :, None] * size[..., None, :]
    return np.asarray(np.linalg.inv(normal / both + SMALL * np.eye(normal.shape[-1])) / both)


def evidence(
    robot: RobotSpec, sequences: ListOf[Sequence], fields: ListOf[str], windows: int = WINDOWS, nthread: int = 0
) -> Evidence:
    """Free runs of windows of recordings, every joint on its own beside them, at the robot's own values."""
    below = touching_below(robot, tip_heights(sequences, robot))
    parts = cut(sequences, windows)
    runs, bounds = JointRollouts(parts, robot, below, nthread), Bounds(robot, sequences)
    axes = Axes(bounds, fields, bounds.first)
    x = axes.of(bounds.first)
    flat = lambda xs: runs.errors(axes.values(xs)).reshape(len(xs), bounds.n, -1) / np.float32(SOFT)  # noqa: E731
    here, jac = (y[0] for y in slopes(x[None], axes.high, flat))
    jac = jac / axes.unit[:, None] * (axes.low < axes.high)[:, None]
    ends = slice(None, None, runs.thin)
    late = np.round(bounds.first["delay"][:, None] / runs.periods).astype(int)
    aim = np.array([[np.roll(c, d) for c, d in zip(*j, strict=True)] for j in zip(runs.ctrl, late, strict=True)])
    asked = aim + bounds.first["offset"][:, None, None].astype(np.float32) - runs.qpos
    play = 0.5 / SOFT * np.tanh(asked / SLACK)[..., ends] * (runs.counted & runs.recorded[..., None])
    jac = np.concatenate([jac, play.reshape(bounds.n, -1, 1)], axis=-1)
    weight = 1 / np.sqrt(1 + here**2)
    pulls, window = clustered(jac * (weight * here)[..., None], runs.window)
    each = ((j[None, :, :, None], (w[:, None] * j)[None, :, None, :]) for j, w in zip(jac, weight, strict=True))
    normals = np.concatenate([clustered(a * b, runs.window)[0] for a, b in each])  # a joint at a time, for memory
    names = [f"{p.meta.motion}{f' ({p.meta.repetition})' * bool(p.meta.repetition)}" for p in parts]
    own = dict.fromkeys(names)
    of = np.array([list(own).index(name) for name in names])
    error = SOFT * here.reshape(bounds.n, *runs.counted.shape)
    far = np.sqrt(np.square(error).sum(axis=-1) / np.maximum(runs.counted.sum(axis=-1), 1))
    return Evidence(pulls, normals, runs.rows, of[window], tuple(own), far)


def estimate_uncertainty(
    robot: RobotSpec,
    sequences: ListOf[Sequence],
    judges: ListOf[Sequence],
    covariances: Mapping[str, tuple[list[str], Array]] = {},
    before: ParameterUncertainty | None = None,
    judged: RobotSpec | None = None,
    nthread: int = 0,
) -> ParameterUncertainty:
    """What is known of a robot after it was fitted to recordings.

    Args:
        robot: The robot with the fitted values.
        sequences: Recordings of one robot that it was fitted to.
        judges: Recordings that were not; without any those that were.
        covariances: Joint → fields and their covariance on the axes; where one is not given, recordings and what was
            known before give it.
        before: What was known of the robot that the fit began from. What these recordings deny of it is forgotten: its
            variance grows by how far the values moved beyond their own.
        judged: The robot that the judges say something of, where `robot` was fitted to them, too, afterwards.
        nthread: Threads, 0 for all cores.
    """
    first = first_values(robot)
    fields = before.fields if before else (*CLASSIC, *(f for f in SERVO_TERMS[:-1] if first[f].any()))
    says, values = evidence(robot, sequences, fields, nthread=nthread), to_axes(robot, fields)
    grouped = says.by_recording() if len(says.names) >= CLUSTERS // 4 else says
    scatter, clusters = grouped.scatter(), grouped.pulls.shape[1]
    if before:
        old = np.stack([before.array(j, "overdispersion") for j in robot.operated])
        scatter = (before.clusters * old + clusters * scatter) / (before.clusters + clusters)
    step, step_covariance = says.step(np.maximum(scatter, 1.0))
    left, joints = _left(judges or sequences, judged or robot, nthread), {}
    for i, joint in enumerate(robot.operated):
        own = step_covariance[i, :-1, :-1]
        if before:
            was, at = before.array(joint, "covariance"), before.array(joint, "values")
            moved = np.square(values[joint] - at) - np.diag(own) - np.diag(was)
            own = inverted(inverted(was + np.diag(np.maximum(moved, 0.0))) + inverted(own))
        if joint in covariances:
            names, whole = covariances[joint]
            at = np.array([names.index(f) for f in fields])
            own = whole[np.ix_(at, at)]
        if not before:
            own = inverted(inverted(own) + np.diag(prior_std(fields, values[joint]) ** -2))
        normal = says.normals[i].sum(axis=0)[:-1, :-1]
        predicted = SOFT * float(np.sqrt(max(np.trace(own @ normal), 0.0) / max(says.rows[i], 1)))
        error = np.concatenate(left[joint])
        rest = before and not judges and before.joints[joint]
        joints[joint] = JointUncertainty(
            _plain(values[joint]), _plain(own), _plain(step[i]), _plain(step_covariance[i]), _plain(scatter[i]),
            predicted, max(float(np.sqrt(np.mean(error**2))), rest.residual_rms if rest else 0.0),
            max(_band(left[joint]), rest.residual_p90 if rest else 0.0),
        )  # fmt: skip
    source: Provenance = {
        "made_by": "identify" if judges or covariances else "adapt",
        "days": tuple(sorted({s.meta.recorded_at[:10] for s in sequences} - {""})),
        "unit": ", ".join(sorted({s.meta.unit_id for s in sequences})),
        "logs": {f"{s.meta.motion} {s.meta.repetition}".removesuffix(" 0"): s.content_hash() for s in sequences},
        "seconds": float(sum(s.duration for s in sequences)),
        "values": {j: joints[j].values for j in joints}, "covariance": {j: joints[j].covariance for j in joints},
    }  # fmt: skip
    return ParameterUncertainty(fields, joints, (*(before.sources if before else ()), source), clusters, bool(judges))


def _left(sequences: ListOf[Sequence], robot: RobotSpec, nthread: int) -> dict[str, list[Array]]:
    """Joint → |error| of every motion that holds it, in free run, rad; where none does, the worst joint's."""
    twins = replay(sequences, robot, nthread=nthread, lock_idle=True)
    pairs = [(s.meta.unrecorded, np.abs(t.qpos - s.qpos)[1:]) for s, t in zip(sequences, twins, strict=True)]
    found = {}
    for j, i in zip(robot.operated, robot.operated_index, strict=True):
        if mine := [error[:, i] for silent, error in pairs if j not in silent]:
            found[j] = mine
    worst = max(found.values(), key=lambda each: float(np.square(np.concatenate(each)).mean()), default=[np.zeros(1)])
    return {j: found.get(j, worst) for j in robot.operated}


def _band(motions: ListOf[Array]) -> float:
    """What 9 of 10 samples of other motions should be within, from |error| of some: wider than of these by one standard
    error (Student's) of the mean of their RMS."""
    rms, few = np.array([np.sqrt(np.square(error).mean()) for error in motions]), len(motions) - 1
    wider = float(stdtrit(few, SURE)) * standard_error(rms) / max(float(rms.mean()), 1e-12) if few else 0.0
    return float(np.quantile(np.concatenate(motions), BAND)) * (1 + wider)


def _plain(x: Array) -> Any:
    """An array as nested tuples."""
    return tuple(_plain(y) for y in x) if x.ndim else float(x)
