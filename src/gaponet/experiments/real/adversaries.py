"""Adversaries: what is done to recordings so that what rests on them must vanish, or must stay."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from gaponet.data.sequence import ARRAYS, Sequence
from gaponet.experiments.real.questions import Question

LATE = 0.04  # s
ONE_IN = 10  # recordings that are late

Adversary = Callable[[Question], Question]


def labels(question: Question) -> Question:
    """Payload and unit dealt out anew among what is learned from of a joint: what rests on them must vanish."""
    rng, known = np.random.default_rng(0), question.known
    metas = [s.meta for s in known]
    for joints in {m.unrecorded for m in metas}:
        mine = [i for i, m in enumerate(metas) if m.unrecorded == joints]
        for i, j in zip(mine, rng.permutation(mine), strict=True):
            metas[i] = replace(known[i].meta, payload_mass=known[j].meta.payload_mass, unit_id=known[j].meta.unit_id)
    return _learned(question, [replace(s, meta=m) for s, m in zip(known, metas, strict=True)])


def asked_labels(question: Question) -> Question:
    """Payload dealt out anew among what is asked of a joint: what a payload's label is worth must be lost."""
    rng, metas = np.random.default_rng(0), [s.meta for s in question.test]
    for joints in {m.unrecorded for m in metas}:
        mine = [i for i, m in enumerate(metas) if m.unrecorded == joints]
        for i, j in zip(mine, rng.permutation(mine), strict=True):
            metas[i] = replace(metas[i], payload_mass=question.test[j].meta.payload_mass)
    return replace(question, test=[replace(s, meta=m) for s, m in zip(question.test, metas, strict=True)])


def late(question: Question) -> Question:
    """40 ms of delay added to one recording in ten of those that are learned from: nothing may follow them."""
    return _learned(question, [_later(s) if i % ONE_IN == 0 else s for i, s in enumerate(question.known)])


def all_late(question: Question) -> Question:
    """40 ms of delay added to every recording: what knows of delays must not mind."""
    changed = _learned(question, [_later(s) for s in question.known])
    return replace(changed, test=[_later(s) for s in question.test], few=[_later(s) for s in question.few])


def joints(question: Question) -> Question:
    """Joints of what is learned from in another order: whoever fits them must do worse than who does not."""
    op = question.robot.operated_index
    order = np.arange(len(question.robot.joint_names))
    order[op] = np.roll(op, 1)
    return _learned(question, [_ordered(s, order) for s in question.known])


ADVERSARIES: dict[str, Adversary] = {f.__name__: f for f in (labels, asked_labels, late, all_late, joints)}


def _learned(question: Question, known: list[Sequence]) -> Question:
    count = len(question.train)
    return replace(question, train=known[:count], val=known[count:], made={})


def _later(s: Sequence) -> Sequence:
    """The robot does everything 40 ms later."""
    rows = max(1, round(LATE / s.dt))
    states = {c: x[:-rows] for c in ARRAYS if (x := getattr(s, c)) is not None}
    return replace(s, **states | {"ctrl": s.ctrl[rows:]})


def _ordered(s: Sequence, order: np.ndarray) -> Sequence:
    return replace(s, **{c: x[:, order] for c in ARRAYS if (x := getattr(s, c)) is not None})
