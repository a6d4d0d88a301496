"""Conclusions from the errors of methods: the remaining error, the gain of a network, the next
command.
"""

from __future__ import annotations

import shlex
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple, get_args

import numpy as np

from gaponet.evaluation.methods import IDENTIFIED, title
from gaponet.evaluation.tables import mrad, mrad_with_error
from gaponet.nn.config import ModelKind
from gaponet.nn.packaged_networks import is_packaged, named_folder
from gaponet.robot.folder import STORED_ROBOT
from gaponet.sim.metrics import standard_error

LEARNED: tuple[str, ...] = get_args(ModelKind)[::-1]
WITHOUT_NETWORK = ("nominal", "delay_offset", "identified")
MIN_RELATIVE_REDUCTION = 0.02  # of the base's error, by a network that is worth having

Scores = dict[str, Any]  # method → its metrics (metrics.summary)


class NetworkGain(NamedTuple):
    """Reduction of the error by a network, rad."""

    base: str  # the best method without a network
    reduction: float  # mean over recordings; negative if the network is worse
    standard_error: float  # of the reduction over independent motions (paired); NaN for one motion
    base_error: float

    @property
    def text(self) -> str:
        """The reduction and its standard error, mrad."""
        return mrad_with_error(self.reduction, self.standard_error)

    @property
    def helps(self) -> bool:
        """True if the reduction exceeds its standard error and MIN_RELATIVE_REDUCTION."""
        result: bool = self.reduction > max(
            np.nan_to_num(self.standard_error), MIN_RELATIVE_REDUCTION * self.base_error
        )
        return result


def network_gain(methods: Scores, own: str) -> NetworkGain:
    """Return the gain of the network of method `own`."""
    base = "identified"
    if not own.startswith(IDENTIFIED):
        available = [name for name in WITHOUT_NETWORK if name in methods]
        base = min(available, key=lambda name: methods[name]["mpjae"])
    before = methods[base]
    after = methods[own]
    paired = []
    for motion, errors in before["by_independent_motion"].items():
        paired.append(errors["mpjae"] - after["by_independent_motion"][motion]["mpjae"])
    reduction = before["mpjae"] - after["mpjae"]
    return NetworkGain(base, reduction, standard_error(paired), before["mpjae"])


def verdict(methods: Scores, baselines: Mapping[str, float] | None = None) -> list[str]:
    """Return sentences: the nominal error, the error after identification, and the gain of each
    network.

    Args:
        methods: Method → its metrics.
        baselines: As of `evaluation.baselines.baseline_errors`; without them nothing is said of the
            command itself.
    """
    sentences = [_about_nominal(methods["nominal"])]
    if "identified" in methods:
        sentences.append(_about_identified(methods))
    for own in _networks(methods):
        sentences.append(_about_network(methods, own))
    best = min(scores["mpjae"] for scores in methods.values())
    if baselines is not None and baselines["command"] <= best:
        sentences.append(
            f"The command itself, delayed and offset, is {mrad(baselines['command'])} mrad from "
            f"the robot. No simulator here is closer ({mrad(best)}), so for motions like these a "
            "simulator adds nothing."
        )
    return sentences


def _networks(methods: Scores) -> list[str]:
    """Return the methods that are networks."""
    return [own for own in methods if own.removeprefix(IDENTIFIED) in LEARNED]


def _about_nominal(nominal: Scores) -> str:
    error = nominal["mpjae"]
    by_joint = nominal["by_joint"]
    worst = max(by_joint, key=lambda joint: by_joint[joint]["mpjae"])
    return (
        f"The nominal simulator is {mrad(error)} mrad ({np.degrees(error):.2f}°) from the robot, "
        f"most at {worst} ({mrad(by_joint[worst]['mpjae'])})."
    )


def _about_identified(methods: Scores) -> str:
    nominal = methods["nominal"]["mpjae"]
    error = methods["identified"]["mpjae"]
    percent = f"{100 * abs(1 - error / nominal):.0f} %"
    change = f"{percent} less" if error <= nominal else f"{percent} MORE"
    motions = len(methods["identified"]["by_independent_motion"])
    count = "1 independent motion" if motions == 1 else f"{motions} independent motions"
    end = "." if error < nominal else ": identify again, on logs like these."
    return f"After identification the error is {mrad(error)} mrad, {change}, on {count}{end}"


def _about_network(methods: Scores, own: str) -> str:
    gain = network_gain(methods, own)
    end = ": leave the network out."
    if gain.helps:
        end = f", {100 * gain.reduction / gain.base_error:.0f} %."
    return (
        f"With {title(own)} the error is {mrad(methods[own]['mpjae'])} mrad: the correction "
        f"reduces the error of {title(gain.base)} by {gain.text}{end}"
    )


def next_step(
    methods: Scores, dataset: str, folder: Path | None = None, reported: bool = False
) -> str:
    """Return the next command for a person.

    If a network helps, that is its report, and once that exists its export; a network of the
    package has no report. Without a useful network it is the export of the identified robot, or its
    identification.

    Args:
        methods: Method → its metrics.
        dataset: Dataset, as the command line names it.
        folder: Folder of the identified robot or of the run, or a network of the package by name or
            folder; None for the nominal simulator alone.
        reported: The report exists.
    """
    identify = shlex.join(["gaponet", "identify", dataset, "--out", "my_robot"])
    if folder is None:
        return identify
    networks = _networks(methods)
    is_in_package = is_packaged(named_folder(folder))
    if any(network_gain(methods, own).helps for own in networks):
        if is_in_package:
            return f"gaponet export {folder.name} --to torch --out {folder.name}-torch"
        if reported:
            return shlex.join(["gaponet", "export", str(folder), "--to", "torch"])
        return shlex.join(["gaponet", "report", str(folder)])
    if is_in_package or "identified" not in methods:
        return identify
    robot = folder / STORED_ROBOT if networks else folder
    return shlex.join(["gaponet", "export", str(robot), "--to", "mjcf"])
