"""What errors by method say in a sentence or two: what is left, what a network adds, and which command comes next."""

from __future__ import annotations

import shlex
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from gaponet.report.methods import IDENTIFIED, title
from gaponet.robot.folder import STORED_ROBOT
from gaponet.sim.metrics import standard_error

LEARNED = ("inverse", "mlp", "shared_mlp", "paper", "gaponet")  # kinds of model
ALONE = ("nominal", "delay_offset", "identified")  # methods without a network
WORTH = 0.02  # share of what is left that a network must remove, besides its standard error

Scores = dict[str, Any]  # method → its metrics (metrics.summary)


class Added(NamedTuple):
    """What a network removes of the error of the best method without one, rad.

    Attributes:
        base: That method.
        less: Mean over motions, negative where the network is worse.
        error: Its standard error over motions (paired); NaN of one motion.
        left: What the base leaves.
    """

    base: str
    less: float
    error: float
    left: float

    @property
    def helps(self) -> bool:
        """Whether it is worth having: more than its standard error and than WORTH."""
        return self.less > max(np.nan_to_num(self.error), WORTH * self.left)


def added(methods: Scores, own: str) -> Added:
    """What the network of method `own` adds."""
    base = "identified" if own.startswith(IDENTIFIED) else min(
        (name for name in ALONE if name in methods), key=lambda name: methods[name]["mpjae"]
    )  # fmt: skip
    before, after = (methods[name] for name in (base, own))
    apart = [before["by_motion"][m]["mpjae"] - after["by_motion"][m]["mpjae"] for m in before["by_motion"]]
    return Added(base, before["mpjae"] - after["mpjae"], standard_error(np.array(apart)), before["mpjae"])


def verdict(methods: Scores) -> list[str]:
    """Sentences: the nominal error, what identification leaves of it, and what each network adds, be it 0.00."""
    nominal = methods["nominal"]["mpjae"]
    by_joint = methods["nominal"]["by_joint"]
    worst = max(by_joint, key=lambda joint: by_joint[joint]["mpjae"])
    said = [
        f"The nominal simulator is {_mrad(nominal)} mrad ({np.degrees(nominal):.2f}°) from the robot, most at {worst} "
        f"({_mrad(by_joint[worst]['mpjae'])})."
    ]
    if "identified" in methods:
        left = methods["identified"]["mpjae"]
        said.append(
            f"Identification leaves {_mrad(left)} mrad, {_change(left, nominal)}"
            + ("." if left < nominal else ": identify again, on logs like these.")
        )
    for own in methods:
        if own.removeprefix(IDENTIFIED) in LEARNED:
            said.append(_network(methods, own))
    return said


def _network(methods: Scores, own: str) -> str:
    more, left = added(methods, own), methods[own]["mpjae"]
    error = "" if np.isnan(more.error) else f" ± {_mrad(more.error)}"
    what = (
        f"{title(own)} leaves {_mrad(left)} mrad: its network adds {_mrad(more.less)}{error} mrad to {title(more.base)}"
    )
    if more.helps:
        return f"{what}, {100 * more.less / more.left:.0f} % of what that leaves."
    return f"{what}: leave it out."


def next_step(methods: Scores, dataset: str, folder: Path | None = None, reported: bool = False) -> str:
    """The command that fits: identify where nothing was identified, export where a network adds nothing, else report.

    Args:
        folder: The identified robot's, or the run's.
        reported: The report is there; a run's model is exported.
    """
    networks = [own for own in methods if own.removeprefix(IDENTIFIED) in LEARNED]
    if any(added(methods, own).helps for own in networks):
        return shlex.join(
            ["gaponet", *(["export", str(folder), "--to", "torch"] if reported else ["report", str(folder)])]
        )
    if "identified" not in methods or folder is None:
        return shlex.join(["gaponet", "identify", dataset, "--out", "my_robot"])
    return shlex.join(["gaponet", "export", str(folder / STORED_ROBOT if networks else folder), "--to", "mjcf"])


def _mrad(value: float) -> str:
    return f"{round(1e3 * value, 2) + 0.0:.2f}"  # no −0.00


def _change(left: float, before: float) -> str:
    return f"{100 * abs(1 - left / before):.0f} % {'less' if left <= before else 'MORE'}"
