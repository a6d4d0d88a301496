"""Draw one recording and its simulation at the lightest and the heaviest payload.

    gaponet collect --recipe demo --fleet firm --units virtual-1 --out DATASET
    python benchmarks/simlifter_pair.py DATASET docs/assets/simlifter_pair

The picture is in docs/simlifter.md. The robot of this dataset is VIRTUAL. The second argument is
the name of the pictures without its ending.
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from gaponet.data.pair import Pair
from gaponet.data.store import Dataset
from gaponet.report.figures.style import DASHED, figure, legend, save, styled
from gaponet.robot.folder import load_stored_robot
from gaponet.sim.model import model_hash

MOTION = "steps-right_elbow"
JOINT = "right_elbow_joint"
# One step of a quarter radian, and the rests around it.
BEGIN_S = 2.2
END_S = 3.0


def pairs(dataset: Dataset) -> list[Pair]:
    """Return the recordings with the lightest and the heaviest payload and their simulations."""
    simulator = model_hash(load_stored_robot(dataset.path, dataset.robot_name))
    entries = sorted(dataset.select(motions=(MOTION,)), key=lambda e: e.meta.payload_mass)
    return [dataset.pair(entry, simulator) for entry in (entries[0], entries[-1])]


@styled
def draw(shown: list[Pair]) -> Figure:
    """Draw command, recorded and simulated position of the joint over time, one panel per
    payload.
    """
    fig = figure(7.0, 2.9)
    axes = fig.subplots(1, len(shown), sharex=True, sharey=True)
    for ax, pair in zip(axes, shown, strict=True):
        _panel(ax, pair)
    axes[0].set_ylabel("right elbow, rad")
    legend(fig, "VIRTUAL H1-2, unit 1: the same command with two payloads")
    return fig


def _panel(ax: Axes, pair: Pair) -> None:
    real = pair.real
    joint = real.joint_names.index(JOINT)
    rows = slice(round(BEGIN_S / real.dt), round(END_S / real.dt))
    time = np.arange(len(real))[rows] * real.dt
    ax.step(time, real.ctrl[rows, joint], where="post", color="#000000", lw=0.9, label="command")
    ax.plot(time, real.qpos[rows, joint], color="#c8501e", lw=2.0, label="recorded")
    ax.plot(time, pair.sim.qpos[rows, joint], color="#3b7dd8", ls=DASHED, lw=1.4, label="simulated")
    ax.set_title(f"{real.meta.payload_mass:g} kg in each hand")
    ax.set_xlabel("time, s")


def main() -> None:
    """Write the pictures as SVG and PNG."""
    dataset = Dataset(sys.argv[1])
    for file in save(draw(pairs(dataset)), Path(sys.argv[2])):
        print(file)


if __name__ == "__main__":
    main()
