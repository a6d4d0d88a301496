"""A picture of a robot with the positions that an evaluation kept."""

from __future__ import annotations

import io
from collections.abc import Mapping
from contextlib import suppress

import numpy as np

from gaponet.base.arrays import Array
from gaponet.base.errors import UsageError
from gaponet.data.sequence import Sequence, SequenceMeta
from gaponet.report.view.gl import choose_gl
from gaponet.robot.spec import RobotSpec


def prepare() -> None:
    """Settle which OpenGL is used, before anything imports mujoco; where there is none, portrait says so."""
    with suppress(UsageError):
        choose_gl()


def portrait(robot: RobotSpec, meta: SequenceMeta, dt: float, qpos: Mapping[str, Array]) -> bytes:
    """The copies of a robot side by side when the nominal one is furthest off, as PNG.

    Args:
        robot: Joints that are not operated stand at home.
        dt: Period of the rows, s.
        qpos: The positions by method, "recorded" among them, (T, n operated) rad.

    Raises:
        UsageError: Nothing can be rendered here; says what is missing.
    """
    choose_gl()
    from gaponet.report.view.film import Clip, furthest
    from gaponet.report.view.picture import Camera
    from gaponet.report.view.scene import Scene
    from gaponet.report.view.side_by_side import Copy, SideBySide

    whole = {}
    for method, q in qpos.items():
        whole[method] = np.tile(robot.qpos_home, (len(q), 1))
        whole[method][:, robot.operated_index] = q
    base = whole["recorded"]
    motions = tuple(Copy(m, q, np.abs(qpos[m] - qpos["recorded"]).mean(axis=1)) for m, q in whole.items())
    shown = SideBySide(Sequence(meta, robot.joint_names, dt, base, base, 0 * base), robot, motions, None)
    clip = Clip.of(shown, None, 8.0)
    moment = furthest(shown, clip)
    row = min(round(moment / dt), len(base) - 2)
    scene = Scene(shown, rows=slice(row, row + 2), flat=True, closeup=True)
    with Camera(scene, 840, span=(clip.start, clip.stop)) as camera:
        file = io.BytesIO()
        camera.picture(moment).save(file, "PNG", optimize=True)
    return file.getvalue()
