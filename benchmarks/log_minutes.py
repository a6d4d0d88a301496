"""Error of an identified robot on new motions, by the minutes of log that it was identified from.

    python benchmarks/log_minutes.py DATASET OUT.jsonl     # resumes

Draws some of the motions that are not for the test, identifies the robot from them, and measures it
on all test motions. docs/doctor.md has the real SO-101's.
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
from common import append_row, command_line, drop_cut_line, read_rows

from gaponet.data.sequence import Sequence
from gaponet.data.split import split_entries
from gaponet.sim.dataset_robot import open_dataset
from gaponet.sim.replay import rollout_errors
from gaponet.sysid.identify import identify

VAL_SHARE = 1 / 6  # of drawn motions, as of all; at least one


def drawn(motions: list[Sequence], count: int, draw: int) -> tuple[list[Sequence], list[Sequence]]:
    """Return motions to fit and to validate: `count` of them in all."""
    order = np.random.default_rng(draw).permutation(len(motions))[:count]
    chosen = [motions[i] for i in order]
    validation = max(1, round(VAL_SHARE * count))
    return chosen[validation:], chosen[:validation]


def measure(dataset: str, out: Path, counts: list[int], draws: int) -> None:
    """Identify from each draw that `out` does not have yet.

    Args:
        out: File with a line for each fit.
        counts: Numbers of motions; all that are not for the test are drawn once.
        draws: Of each number.
    """
    data, robot = open_dataset(dataset)
    split = split_entries(data)
    motions = data.sequences(split["train"]) + data.sequences(split["val"])
    test = data.sequences(split["test"])
    jobs = []
    for count in counts:
        jobs += [(count, draw) for draw in range(draws if count < len(motions) else 1)]
    drop_cut_line(out)
    done = {(row["motions"], row["draw"]) for row in read_rows(out)}
    for count, draw in jobs:
        if (count, draw) in done:
            continue
        fitted, validation = drawn(motions, count, draw)
        found = identify(fitted, robot, validation)
        seconds = sum(motion.duration for motion in fitted + validation)
        error = 1e3 * rollout_errors(test, found.robot).mean()
        row = {"motions": count, "draw": draw, "minutes": seconds / 60, "error_mrad": error}
        append_row(out, row)
        print(f"{count} motions, draw {draw}: {error:.2f} mrad", file=sys.stderr, flush=True)


def show(out: Path) -> None:
    """Print the error by number of motions, ± the standard deviation over draws."""
    rows = read_rows(out)
    print("| motions | minutes | draws | error, mrad | worst draw |")
    print("| ---: | ---: | ---: | ---: | ---: |")
    for count in sorted({row["motions"] for row in rows}):
        same = [row for row in rows if row["motions"] == count]
        minutes = np.mean([row["minutes"] for row in same])
        errors = np.array([row["error_mrad"] for row in same])
        mean = f"{errors.mean():.2f}"
        if len(errors) > 1:
            mean += f" ± {errors.std(ddof=1):.2f}"
        print(f"| {count} | {minutes:.0f} | {len(same)} | {mean} | {errors.max():.2f} |")


if __name__ == "__main__":
    parser = command_line(__doc__)
    parser.add_argument("dataset")
    parser.add_argument("out", type=Path)
    parser.add_argument("--motions", type=int, nargs="+", default=[2, 4, 8, 30])
    parser.add_argument("--draws", type=int, default=5)
    options = parser.parse_args()
    measure(options.dataset, options.out, options.motions, options.draws)
    show(options.out)
