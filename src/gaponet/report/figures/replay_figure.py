"""What a policy asked for, what its simulator did and what the robot would do, joint by joint."""

from __future__ import annotations

from collections.abc import Sequence as ListOf
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from gaponet.report.figures.style import figure, joint_label, legend, save, styled
from gaponet.report.methods import colour


def write(answers: ListOf[Any], joints: ListOf[str], path: Path) -> None:
    """The first rollout, as SVG and PNG; answers are those of gaponet.export.rollout."""
    save(_draw(answers[0], joints), path.with_suffix(""))


@styled
def _draw(answer: Any, joints: ListOf[str]) -> Figure:
    time = np.arange(len(answer.target)) * answer.dt
    fig = figure(7.0, 1.0 + 1.1 * len(joints))
    axes = np.atleast_1d(fig.subplots(len(joints), sharex=True))
    for j, (ax, joint) in enumerate(zip(axes, joints, strict=True)):
        low, high = (answer.robot[:, j] + sign * answer.half[:, j] for sign in (-1, 1))
        ax.fill_between(time, low, high, color=colour("identified"), alpha=0.25, lw=0, label="its band")
        ax.plot(time, answer.robot[:, j], color=colour("identified"), label="robot would do")
        ax.plot(time, answer.rollout[:, j], color=colour("nominal"), label="simulator did")
        ax.plot(time, answer.target[:, j], color="#222222", lw=0.7, ls=":", label="target")
        ax.set_ylabel(f"{joint_label(joint)}, rad")
    axes[-1].set_xlabel(f"time in {answer.name}, s")
    legend(fig)
    return fig
