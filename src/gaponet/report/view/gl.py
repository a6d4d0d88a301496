"""Choice of the OpenGL backend of MuJoCo, before mujoco is imported: it reads MUJOCO_GL once."""

from __future__ import annotations

import os
import sys
from contextlib import suppress
from ctypes.util import find_library

from gaponet.base.errors import UsageError

INSTALL_HINT = (
    "On Linux without a display install EGL (libegl1 libgl1-mesa-dri) and set MUJOCO_GL=egl, "
    "or OSMesa (libosmesa6) and set MUJOCO_GL=osmesa"
)


def choose_gl() -> None:
    """Choose EGL, else OSMesa, if there is no display and MUJOCO_GL is not set; then import mujoco.

    Raises:
        UsageError: No backend works; the message says what to install.
    """
    ours = not _has_display() and not os.environ.get("MUJOCO_GL")
    if ours:
        if find_library("EGL"):
            os.environ["MUJOCO_GL"] = "egl"
        elif find_library("OSMesa"):
            os.environ["MUJOCO_GL"] = "osmesa"
        else:
            raise UsageError(
                f"no display and no OpenGL library for rendering off screen. {INSTALL_HINT}"
            )
    try:
        import mujoco  # noqa: F401
    except Exception as error:  # each backend that is not installed fails in its own way
        chosen = os.environ.pop("MUJOCO_GL") if ours else os.environ.get("MUJOCO_GL")
        raise UsageError(f"MUJOCO_GL={chosen}: {error}. {INSTALL_HINT}") from None


def _has_display() -> bool:
    if not sys.platform.startswith("linux"):
        return True
    return bool(os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"))


def prepare() -> None:
    """Choose the backend before anything imports mujoco.

    Without one, only pictures are missing later.
    """
    with suppress(UsageError):
        choose_gl()
