"""Picture of a robot with the trajectories of an evaluation, for the report."""

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
    """Choose the OpenGL backend before anything imports mujoco; without one, portrait raises the error."""
    with suppress(UsageError):
        choose_gl()


def portrait(robot: RobotSpec, meta: SequenceMeta, dt: float, qpos: Mapping[str, Array]) -> bytes:
    """Return a PNG of the copies of a robot side by side at the largest nominal error.

    Args:
        robot: Joints that are not operated are drawn at home.
        dt: Period of the rows, s.
        qpos: Positions by method, "recorded" among them, (T, n operated) rad.

    Raises:
        UsageError: Nothing can be rendered here; the message says what to install.
    """
    choose_gl()
    from gaponet.report.view.picture import Camera
    from gaponet.report.view.scene import Scene
    from gaponet.report.view.side_by_side import Clip, Copy, SideBySide, largest_error_time

    whole = {}
    for method, q in qpos.items():
        whole[method] = np.tile(robot.qpos_home, (len(q), 1))
        whole[method][:, robot.operated_index] = q
    base = whole["recorded"]
    motions = tuple(Copy(m, q, np.abs(qpos[m] - qpos["recorded"]).mean(axis=1)) for m, q in whole.items())
    shown = SideBySide(Sequence(meta, robot.joint_names, dt, base, base, 0 * base), robot, motions, None)
    clip = Clip.from_start(shown, None, 8.0)
    moment = largest_error_time(shown, clip)
    row = min(round(moment / dt), len(base) - 2)
    scene = Scene(shown, rows=slice(row, row + 2), flat=True, closeup=True)
    with Camera(scene, clip, 840) as camera:
        file = io.BytesIO()
        camera.picture(moment).save(file, "PNG", optimize=True)
    return file.getvalue()
