"""Figures of the doctor's findings: command, state and torque of the joint concerned."""

from __future__ import annotations

import re
from pathlib import Path
from textwrap import fill

import numpy as np
from matplotlib.figure import Figure

from gaponet.base.arrays import Array
from gaponet.data.sequence import Sequence
from gaponet.data.store import Dataset, Entry
from gaponet.report.figures.style import figure, joint_label, legend, save, styled
from gaponet.robot.finding import Finding
from gaponet.robot.spec import RobotSpec

SHOWN_S = 8.0
MAX_JOINTS = 3  # of a figure
TORQUE_CHECKS = ("torque", "saturation", "gravity")
COMMAND_COLOUR, STATE_COLOUR, TORQUE_COLOUR = "#222222", "#d9662b", "#3b7dd8"


def draw_findings(dataset: Dataset, robot: RobotSpec, findings: list[Finding], out: Path) -> list[Path]:
    """Write a figure (SVG, PNG) for each warning, error, and note about a joint. Return the files."""
    shown = [f for f in findings if f.level in ("warning", "error") or (f.level == "note" and f.joints)]
    written = []
    for number, finding in enumerate(shown, 1):
        sequence = dataset.read(_entry(dataset.entries, finding))
        joints = [j for j in finding.joints or robot.operated if j in robot.joint_names][:MAX_JOINTS]
        fig = _draw(finding, sequence, robot.index(joints))
        written += save(fig, out / f"{number:02d}-{finding.check}")
    return written


def _entry(entries: list[Entry], finding: Finding) -> Entry:
    """Return the recording that the message names first, else the first recording."""
    words = re.split(r"[\s,;:()]+", finding.message)
    named = {e.meta.motion: e for e in reversed(entries)}
    return next((named[word] for word in words if word in named), entries[0])


@styled
def _draw(finding: Finding, sequence: Sequence, joints: Array) -> Figure:
    torque = sequence.tau if finding.check in TORQUE_CHECKS else None
    rows = _window(finding, sequence, joints, torque)
    time = np.arange(len(sequence))[rows] * sequence.dt
    fig = figure(7.0, 1.3 + 1.5 * len(joints))
    axes = np.atleast_1d(fig.subplots(len(joints), sharex=True))
    for ax, j in zip(axes, joints, strict=True):
        if torque is not None:
            ax.plot(time, torque[rows, j], color=TORQUE_COLOUR, label="torque")
        else:
            ax.plot(time, sequence.ctrl[rows, j], color=COMMAND_COLOUR, label="command")
            ax.plot(time, sequence.qpos[rows, j], color=STATE_COLOUR, label="state")
        unit = "rad" if torque is None else "N·m"
        ax.set_ylabel(f"{joint_label(sequence.joint_names[j])}, {unit}")
    axes[-1].set_xlabel(f"time in {sequence.meta.motion}, s")
    legend(fig)
    axes[0].set_title(fill(f"{finding.level}, {finding.check}: {finding.message}", 105), fontsize=8, weight="normal")
    return fig


def _window(finding: Finding, sequence: Sequence, joints: Array, torque: Array | None) -> slice:
    """Return the rows around the largest error, jump or torque."""
    ctrl, qpos = sequence.ctrl[:, joints], sequence.qpos[:, joints]
    worst = np.abs(torque[:, joints]) if torque is not None else np.abs(ctrl - qpos)
    if finding.check == "jumps":
        worst = np.abs(np.diff(qpos, n=2, axis=0, prepend=qpos[:1], append=qpos[-1:]))
    middle, half = int(worst.max(axis=1).argmax()), round(SHOWN_S / 2 / sequence.dt)
    start = min(max(0, middle - half), max(0, len(qpos) - 2 * half))
    return slice(start, start + 2 * half)
