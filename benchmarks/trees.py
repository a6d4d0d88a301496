"""Gradient-boosted trees as a rival of networks: one ensemble per joint, fitted to the same labels.

    gaponet experiment real --method benchmarks/trees.py:on_identified        needs scikit-learn

Inputs are position, velocity and a − q of all operated joints, and the payload. The training states come from rollouts
with the labels, then also from rollouts with the trees. On real robots, the trees correct the identified simulator; as
with networks, they are left out if validation shows no improvement.
"""

from __future__ import annotations

from collections.abc import Sequence as ListOf
from dataclasses import replace
from itertools import pairwise

import numpy as np

from gaponet.base.arrays import Array
from gaponet.data.sequence import Sequence
from gaponet.experiments.real.methods import LEFT_OUT, FittedSim, identified
from gaponet.experiments.real.questions import Question, train_val
from gaponet.nn.training.pretraining import trajectory_labels
from gaponet.nn.training.validation import error_reduction
from gaponet.report.verdict import NetworkGain
from gaponet.robot.spec import RobotSpec
from gaponet.sim.replay import replay

LIMIT, ROUNDS, TREES, LEAF, MOST = 0.3, 1, 120, 60, 60_000  # rad, rounds of DAgger, of each joint, rows, rows fitted


class Trees:
    """Corrector with one ensemble per operated joint; implements sim.replay.Corrector."""

    def __init__(self, robot: RobotSpec) -> None:
        self.robot, self.op, self.models, self.payload = robot, robot.operated_index, [], np.zeros(0)

    @classmethod
    def trained(cls, sequences: ListOf[Sequence], robot: RobotSpec, labels: Array, seed: int) -> Trees:
        """Fit the labels of recordings, (rows of all, n) rad."""
        model, ends = cls(robot), np.cumsum([0, *map(len, sequences)])
        deltas = [np.nan_to_num(labels[start:end]) for start, end in pairwise(ends)]
        told = [s.ctrl.copy() for s in sequences]
        for ctrl, delta in zip(told, deltas, strict=True):
            ctrl[:, model.op] += delta
        led = [replace(s, ctrl=ctrl) for s, ctrl in zip(sequences, told, strict=True)]
        runs, x = replay(led, robot, lock_idle=True), []
        for again in range(ROUNDS + 1):
            x += [
                cls.inputs(t.qpos[:, model.op], t.qvel[:, model.op], s.ctrl[:, model.op], s.meta.payload_mass)
                for s, t in zip(sequences, runs, strict=True)
            ]
            model.fit(np.concatenate(x), np.concatenate([labels] * (again + 1)), seed)
            if again < ROUNDS:
                runs = replay(sequences, robot, model, lock_idle=True)
        return model

    def fit(self, x: Array, y: Array, seed: int) -> None:
        """Fit inputs (N, 3n + 1) to labels (N, n) rad; NaN is no label, and a joint without labels is not corrected."""
        from sklearn.ensemble import HistGradientBoostingRegressor

        rows, self.models = np.random.default_rng(seed).permutation(len(x)), []
        for column in y.T:
            some = rows[np.isfinite(column[rows])][:MOST]
            model = HistGradientBoostingRegressor(max_iter=TREES, min_samples_leaf=LEAF, early_stopping=False)
            self.models.append(model.fit(x[some], column[some]) if len(some) else None)

    @staticmethod
    def inputs(qpos: Array, qvel: Array, ctrl: Array, payload: Array | float) -> Array:
        """Return the inputs (k, 3n + 1) of operated joints; payload in kg, of each row or of all."""
        return np.concatenate([qpos, qvel, ctrl - qpos, np.broadcast_to(payload, len(qpos))[:, None]], axis=1)

    def reset(self, start: ListOf[Sequence]) -> None:
        self.payload = np.array([s.meta.payload_mass for s in start])

    def correct(self, t: int, target: Array, qpos: Array, qvel: Array) -> Array:
        x, out = self.inputs(qpos[:, self.op], qvel[:, self.op], target[:, self.op], self.payload), np.array(target)
        for joint, model in zip(self.op, self.models, strict=True):
            out[:, joint] += 0.0 if model is None else model.predict(x)
        return np.clip(out, *self.robot.qpos_range.T)


def on_identified(question: Question) -> FittedSim:
    """Correct the identified robot by trees, unless validation shows no improvement."""
    start, (train, val) = identified(question), train_val(question)
    labels = trajectory_labels(train, start.robot, LIMIT)
    answer = replace(start, corrector=Trees.trained(train, start.robot, labels, 0))
    before, after = (np.array(one.errors(val)) for one in (start, answer))
    less, error = error_reduction(val, before, after)
    gain = NetworkGain("identification", less, error, float(before.mean()))
    told = f"{100 * gain.reduction / gain.base_error:.0f} % less on validation"
    return replace(answer, note=told) if gain.helps else replace(start, note=f"{LEFT_OUT}: {told}")
