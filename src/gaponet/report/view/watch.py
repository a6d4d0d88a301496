"""A scene in MuJoCo's window: the mouse moves the camera, space pauses, arrow keys move in time."""

from __future__ import annotations

import time
from dataclasses import dataclass

import mujoco
import numpy as np

from gaponet.base.errors import UsageError
from gaponet.report.view.film import Clip
from gaponet.report.view.scene import Scene

SPACE, RIGHT, LEFT = 32, 262, 263  # GLFW key codes
JUMP_S = 1.0  # of the recording, by an arrow key
FRAME_S = 1 / 60


@dataclass
class Playback:
    """Position in a clip, which repeats."""

    clip: Clip
    time: float
    paused: bool = False

    def advance(self, elapsed: float) -> None:
        """Advance by `elapsed` s of wall time."""
        if not self.paused:
            self.move(elapsed * self.clip.speed)

    def move(self, by: float) -> None:
        """Move by `by` s of the recording; the clip repeats."""
        self.time = self.clip.start + (self.time + by - self.clip.start) % self.clip.duration

    def key(self, code: int) -> None:
        """Handle a key press."""
        if code == SPACE:
            self.paused = not self.paused
        elif code in (RIGHT, LEFT):
            self.move(JUMP_S if code == RIGHT else -JUMP_S)


def watch(scene: Scene, clip: Clip, magnify: float = 1.0) -> None:
    """Play until the window is closed."""
    import mujoco.viewer

    play = Playback(clip, clip.start)
    scene.pose(play.time)
    try:
        window = mujoco.viewer.launch_passive(
            scene.model, scene.data, key_callback=play.key, show_left_ui=False, show_right_ui=False
        )
    except RuntimeError as error:  # macOS: the window belongs to the main thread
        raise UsageError(f"{error}. Run: mjpython -m gaponet view …, or use --render or --web") from None
    with window:
        with window.lock():
            window.cam.azimuth, window.cam.elevation = scene.view.azimuth, scene.view.elevation
            window.cam.lookat[:] = scene.middle
            window.cam.distance = 1.7 * scene.extent
        before = time.monotonic()
        while window.is_running():
            now = time.monotonic()
            play.advance(now - before)
            before = now
            with window.lock():
                scene.pose(play.time)
                _label(window.user_scn, scene, play.time)
            window.set_texts((None, mujoco.mjtGridPos.mjGRID_TOPLEFT, *_texts(scene, play, magnify)))
            window.sync()
            time.sleep(max(0.0, FRAME_S - (time.monotonic() - now)))


def _label(extra: mujoco.MjvScene, scene: Scene, now: float) -> None:
    """Write method and present error above each copy."""
    row = scene.row(now)
    above = scene.view.axes[1] * scene.box[3] + np.array([0, 0, 0.06 * (scene.box[3] - scene.box[2])])
    extra.ngeom = 0
    for motion, base in zip(scene.shown.motions, scene.base, strict=True):
        error = "" if motion.method == "recorded" else f" {motion.error[row] * 1e3:.1f} mrad"
        mujoco.mjv_initGeom(
            extra.geoms[extra.ngeom], mujoco.mjtGeom.mjGEOM_LABEL, np.zeros(3), base + above, np.eye(3).ravel(),
            np.array([0.1, 0.1, 0.1, 1.0], np.float32),
        )  # fmt: skip
        extra.geoms[extra.ngeom].label = motion.name.removesuffix(" simulator") + error
        extra.ngeom += 1


def _texts(scene: Scene, play: Playback, magnify: float) -> tuple[str, str]:
    """Return two columns for the window's corner."""
    meta = scene.shown.real.meta
    rows = [("VIRTUAL ROBOT", "")] if meta.virtual else []
    rows += [
        ("motion", meta.motion), ("unit", meta.unit_id), ("payload", f"{meta.payload_mass:g} kg"),
        ("time", f"{play.time:.2f} s" + (" (paused)" if play.paused else "")), ("speed", f"{play.clip.speed:g}x"),
    ]  # fmt: skip
    rows += [("differences drawn", f"{magnify:g}x")] if magnify != 1 else []
    return "\n".join(r[0] for r in rows), "\n".join(r[1] for r in rows)
