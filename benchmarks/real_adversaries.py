"""Control tests of `gaponet experiment real`: changed recordings, after which an effect must vanish or must stay.

    python benchmarks/real_adversaries.py labels --sets h1_2 --questions "3 kg left out"

labels          permute payload and unit among the fitted recordings: effects of the labels must vanish
test_labels     permute the payload among the test recordings: the benefit of the payload label must vanish
late            add 40 ms of delay to one in ten of the fitted recordings: no method may follow them
all_late        add 40 ms of delay to all recordings: methods that fit a delay must not change
joints          rotate the order of the joints in the fitted recordings: every fit must become worse
"""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path

import numpy as np

from gaponet.data.sequence import ARRAYS, Sequence, SequenceMeta
from gaponet.experiments.real.bench import Bench, Change
from gaponet.experiments.real.cards import data_folder, read_cards
from gaponet.experiments.real.methods import METHODS
from gaponet.experiments.real.page import write_page
from gaponet.experiments.real.questions import Question

DELAY_S = 0.04
LATE_STRIDE = 10  # one in so many recordings is late


def labels(question: Question) -> Question:
    permuted = _permuted([s.meta for s in question.fitted], ("payload_mass", "unit_id"))
    return _fitted(question, [replace(s, meta=m) for s, m in zip(question.fitted, permuted, strict=True)])


def test_labels(question: Question) -> Question:
    permuted = _permuted([s.meta for s in question.test], ("payload_mass",))
    return replace(question, test=[replace(s, meta=m) for s, m in zip(question.test, permuted, strict=True)])


def late(question: Question) -> Question:
    return _fitted(question, [_delayed(s) if i % LATE_STRIDE == 0 else s for i, s in enumerate(question.fitted)])


def all_late(question: Question) -> Question:
    changed = _fitted(question, [_delayed(s) for s in question.fitted])
    return replace(changed, test=[_delayed(s) for s in question.test], few=[_delayed(s) for s in question.few])


def joints(question: Question) -> Question:
    op = question.robot.operated_index
    order = np.arange(len(question.robot.joint_names))
    order[op] = np.roll(op, 1)
    return _fitted(question, [
        replace(s, **{c: x[:, order] for c in ARRAYS if (x := getattr(s, c)) is not None}) for s in question.fitted
    ])  # fmt: skip


ADVERSARIES: dict[str, Change] = {f.__name__: f for f in (labels, test_labels, late, all_late, joints)}


def _permuted(metas: list[SequenceMeta], fields: tuple[str, ...]) -> list[SequenceMeta]:
    """Permute fields among recordings of the same joints."""
    rng, changed = np.random.default_rng(0), list(metas)
    for unrecorded in {m.unrecorded for m in metas}:
        rows = [i for i, m in enumerate(metas) if m.unrecorded == unrecorded]
        for i, j in zip(rows, rng.permutation(rows), strict=True):
            changed[i] = replace(metas[i], **{f: getattr(metas[j], f) for f in fields})
    return changed


def _fitted(question: Question, fitted: list[Sequence]) -> Question:
    count = len(question.train)
    return replace(question, train=fitted[:count], val=fitted[count:], shared={})


def _delayed(s: Sequence) -> Sequence:
    """Delay all states against the commands."""
    rows = max(1, round(DELAY_S / s.dt))
    states = {c: x[:-rows] for c in ARRAYS if (x := getattr(s, c)) is not None}
    return replace(s, **states | {"ctrl": s.ctrl[rows:]})


def main() -> None:
    """Run the benchmark on changed recordings and write its page."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("adversary", choices=tuple(ADVERSARIES))
    parser.add_argument("--data", type=Path, help="folder of the public recordings")
    parser.add_argument("--out", type=Path, default=Path("bench_real"))
    parser.add_argument("--sets", nargs="+", default=[])
    parser.add_argument("--questions", nargs="+", default=[])
    args = parser.parse_args()
    bench = Bench(read_cards(), data_folder(args.data), args.out, METHODS, adversary=args.adversary,
                  change=ADVERSARIES[args.adversary])  # fmt: skip
    for path in write_page(bench.run(tuple(args.sets), tuple(args.questions)), args.out):
        print(f"written: {path}")


if __name__ == "__main__":
    main()
