"""Which OpenGL MuJoCo renders with. To be settled before mujoco is imported: it reads MUJOCO_GL once."""

from __future__ import annotations

import os
import sys
from ctypes.util import find_library

from gaponet.base.errors import UsageError

CURE = (
    "On Linux without a display install EGL (libegl1 libgl1-mesa-dri) and set MUJOCO_GL=egl, "
    "or OSMesa (libosmesa6) and set MUJOCO_GL=osmesa"
)


def has_display() -> bool:
    """Whether a window can be opened, as far as the environment tells."""
    return not sys.platform.startswith("linux") or any(os.environ.get(k) for k in ("DISPLAY", "WAYLAND_DISPLAY"))


def choose_gl() -> None:
    """EGL, else OSMesa, where there is no display and nobody has chosen; then import mujoco with it.

    Raises:
        UsageError: With what to install.
    """
    ours = not has_display() and not os.environ.get("MUJOCO_GL")
    if ours:
        found = [name for name, library in (("egl", "EGL"), ("osmesa", "OSMesa")) if find_library(library)]
        if not found:
            raise UsageError(f"no display and no OpenGL library for rendering off screen. {CURE}")
        os.environ["MUJOCO_GL"] = found[0]
    try:
        import mujoco  # noqa: F401
    except Exception as error:  # a chosen backend that is not installed fails in ways of its own
        chosen = os.environ.pop("MUJOCO_GL") if ours else os.environ.get("MUJOCO_GL")
        raise UsageError(f"MUJOCO_GL={chosen}: {error}. {CURE}") from None
