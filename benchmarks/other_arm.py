"""The right arm of the real H1-2 from the servos of the left: no fit, few windows, all windows; docs/results/real.md.

    python benchmarks/other_arm.py LEFT_ROBOT RIGHT_DATASET

LEFT_ROBOT is a folder of gaponet identify. Three folds leave one command of each joint out, as gaponet experiment real.
"""

import sys
from pathlib import Path

import numpy as np

from gaponet.data.store import Dataset
from gaponet.experiments.real.questions import questions, train_val
from gaponet.robot.spec import load_robot
from gaponet.sim.metrics import standard_error
from gaponet.sim.replay import motion_errors
from gaponet.sysid.identify import identify
from gaponet.sysid.servo_types import servos_like

WINDOWS = (9, 36, 0)  # that are fitted; 0 for all
VALIDATION_SHARE = 1 / 3


def spread(sequences: list, count: int) -> list:
    """Return so many recordings, evenly; all for 0."""
    every = np.linspace(0, len(sequences) - 1, count or len(sequences))
    return [sequences[i] for i in np.unique(every.astype(int))]


def main(left: Path, right: Path) -> None:
    """Print the mean error of each start and number of windows over the commands that were not fitted."""
    data, nominal = Dataset(right), load_robot("h1_2")
    starts = {"the file": nominal, "the left arm": servos_like(nominal, load_robot(left))[0]}
    errors: dict[str, list[float]] = {}
    for question in questions("new commands", data, nominal, None):
        train, val = train_val(question)
        for name, start in starts.items():
            errors.setdefault(f"{name} | none", []).extend(motion_errors(question.test, start))
            for count in WINDOWS:
                few = round(VALIDATION_SHARE * count)
                robot = identify(spread(train, count - few), start, spread(val, few)).robot
                errors.setdefault(f"{name} | {count or 'all'}", []).extend(motion_errors(question.test, robot))
    print("| start | windows fitted | error, mrad |\n| --- | ---: | ---: |")
    for name, each in errors.items():
        x = 1e3 * np.array(each)
        print(f"| {name} | {x.mean():.2f} ± {standard_error(x):.2f} |")


if __name__ == "__main__":
    main(*map(Path, sys.argv[1:3]))
