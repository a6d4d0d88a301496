"""Choosing OpenGL happens in the environment, once."""

import os
import subprocess
import sys

import pytest

from gaponet.base.errors import UsageError
from gaponet.report.view import gl


@pytest.fixture
def headless(monkeypatch):
    for name in ("DISPLAY", "WAYLAND_DISPLAY", "MUJOCO_GL"):
        monkeypatch.setenv(name, "")  # as good as unset
    monkeypatch.setattr(sys, "platform", "linux")
    return monkeypatch


def test_without_a_display_egl_is_preferred_and_osmesa_taken(headless):
    headless.setattr(gl, "find_library", lambda name: f"lib{name}.so")
    gl.choose_gl()
    assert os.environ["MUJOCO_GL"] == "egl"
    headless.setenv("MUJOCO_GL", "")
    headless.setattr(gl, "find_library", lambda name: "libOSMesa.so" if name == "OSMesa" else None)
    gl.choose_gl()
    assert os.environ["MUJOCO_GL"] == "osmesa"


def test_without_any_library_it_says_what_to_install(headless):
    headless.setattr(gl, "find_library", lambda name: None)
    with pytest.raises(UsageError, match="libegl1"):
        gl.choose_gl()


def test_the_users_choice_stands(headless):
    headless.setenv("MUJOCO_GL", "osmesa")
    gl.choose_gl()
    assert os.environ["MUJOCO_GL"] == "osmesa"


def test_a_choice_that_mujoco_cannot_use_is_taken_back(headless):
    """Who only wanted a picture goes on without one: mujoco is not imported with it again."""
    headless.setattr(gl, "find_library", lambda name: f"lib{name}.so")
    headless.setitem(sys.modules, "mujoco", None)  # its import fails
    with pytest.raises(UsageError, match="MUJOCO_GL=egl"):
        gl.choose_gl()
    assert "MUJOCO_GL" not in os.environ


def test_commands_that_render_are_imported_without_mujoco():
    """MuJoCo reads MUJOCO_GL once, when it is imported."""
    code = (
        "import sys\nfrom gaponet.cli import demo, report, robot, start, view\nprint('mujoco' in "
        "sys.modules)"
    )
    assert (
        subprocess.run([sys.executable, "-c", code], capture_output=True, text=True).stdout
        == "False\n"
    )
