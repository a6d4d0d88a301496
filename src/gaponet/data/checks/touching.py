"""Does the robot press on something? Where it does, more force moves it no further, and no servo parameter says why.

Seen in rows in which the arm stands and a tip is low: a joint is further from its command than gravity and stiction
leave it where tips are high, and the servos draw more current.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass

import numpy as np

from gaponet.base.arrays import Array
from gaponet.data.offsets import Gravity
from gaponet.data.sequence import Sequence
from gaponet.robot.finding import Finding, abbreviate
from gaponet.robot.spec import RobotSpec

Heights = Callable[[Array], Array]  # lowest tip in postures (k, n), (k,) m

LOW, HIGH = 0.03, 0.05  # m above the lowest tip of all
STANDS = 0.05  # rad/s
RATE, ROWS = 10.0, 5  # Hz at which recordings are looked at, and rows that must show it
MORE, CURRENT = 1.5, 1.2  # times what 19 rows in 20 show, and the usual torque, where tips are high


@dataclass(frozen=True)
class Standing:
    """Rows of a motion in which the arm stands: tip height (k,) m, command − state and gravity's torque (k, n) rad and
    N·m of the operated joints, largest |torque| (k,) N·m."""

    motion: str
    height: Array
    error: Array
    load: Array
    torque: Array

    @classmethod
    def of(cls, sequence: Sequence, robot: RobotSpec, heights: Heights, gravity: Gravity) -> Standing:
        """What a sequence says about it."""
        op, meta = robot.operated_index, sequence.meta
        sequence = sequence.rows(slice(None, None, max(1, round(1 / (RATE * sequence.dt)))))
        still = np.flatnonzero(np.abs(sequence.qvel[:, op]).max(axis=1) < STANDS)
        qpos = sequence.qpos[still]
        load = gravity(qpos.astype(float), meta.payload_mass, meta.payload_side)[:, op].astype(np.float32)
        torque = np.zeros(len(still)) if sequence.tau is None else np.abs(sequence.tau)[still][:, op].max(axis=1)
        return Standing(meta.motion, heights(qpos), (sequence.ctrl[still] - qpos)[:, op], load, torque)

    def every(self, step: int) -> Standing:
        """One row in so many, and the lowest, in memory of their own."""
        rows = np.arange(0, len(self.height), step)
        rows = np.union1d(rows, self.height.argmin()) if len(rows) else rows
        return Standing(self.motion, self.height[rows], self.error[rows], self.load[rows], self.torque[rows])


def touching(found: list[Standing], every: Callable[[], Iterable[Standing]]) -> Iterator[Finding]:
    """Which motions press on something? What is usual is told from a sample, and then each of `every` is looked at."""
    if not found:
        return
    height, error, load, torque = (
        np.concatenate([getattr(s, f) for s in found]) for f in ("height", "error", "load", "torque")
    )
    high = height > height.min(initial=np.inf) + HIGH
    if high.sum() < ROWS:
        return
    lowest, drawn = float(height.min()), np.median(torque[high])
    e, g = (x[high] - x[high].mean(axis=0) for x in (error, load))
    sag = (e * g).sum(axis=0) / np.maximum((g * g).sum(axis=0), 1e-9)  # rad per N·m of gravity
    rest = (error[high] - sag * load[high]).mean(axis=0)
    beyond = lambda e, g: np.abs(e - sag * g - rest)  # noqa: E731
    usual = np.percentile(beyond(error[high], load[high]), 95, axis=0)
    pressed: dict[str, int] = {}
    for s in every():
        further = (beyond(s.error, s.load) > MORE * usual).any(axis=1)
        hit = (s.height < lowest + LOW) & further & (s.torque >= CURRENT * drawn)
        if hit.sum() >= ROWS:
            pressed[s.motion] = pressed.get(s.motion, 0) + int(hit.sum())
    if not pressed:
        yield Finding("ok", "touching", f"no motion presses a tip on something below; lowest tip {lowest:.3f} m")
        return
    worst = sorted(pressed, key=lambda motion: -pressed[motion])
    text = (
        f"{len(pressed)} motion(s) press a tip on something about {lowest + LOW / 2:.2f} m high ({abbreviate(worst)}): "
        "standing arms are further from their commands there than they sag, and draw more current; gaponet identify "
        "looks for a table"
    )
    yield Finding("note", "touching", text, values={"lowest": lowest, "rows": pressed})
