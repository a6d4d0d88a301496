"""Proposed commands install from where this gaponet came."""

import json
import shlex
import sys
import tomllib
from pathlib import Path

import pytest

from gaponet.base.installation import EXTRAS, SCRIPT, install_command, missing_package, pip

ROOT = Path(__file__).parents[2]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]


@pytest.fixture
def installed(monkeypatch, tmp_path):
    """Install a distribution that brings the command gaponet, before all others on the path."""

    def install(origin=None, name="some-name", installer="pip"):
        place = tmp_path / "some_name-1.0.dist-info"
        place.mkdir()
        (place / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {name}\nVersion: 1.0\n")
        (place / "entry_points.txt").write_text(f"[console_scripts]\n{SCRIPT[0]} = {SCRIPT[1]}\n")
        (place / "INSTALLER").write_text(f"{installer}\n")
        if origin is not None:
            (place / "direct_url.json").write_text(json.dumps(origin))
        monkeypatch.syspath_prepend(str(tmp_path))

    return install


def test_from_an_index_by_the_name_of_the_distribution(installed):
    installed()
    assert install_command("train") == "pip install 'some-name[train]'"


def test_from_git_at_the_commit_that_is_installed(installed):
    vcs = {"vcs": "git", "commit_id": "0123abcd", "requested_revision": "main"}
    installed({"url": "https://example.org/robots.git", "vcs_info": vcs})
    requirement = "some-name[train] @ git+https://example.org/robots.git@0123abcd"
    assert shlex.split(install_command("train")) == ["pip", "install", requirement]


def test_from_a_checkout_that_is_installed_editable(installed):
    installed({"url": "file:///home/me/my%20robots", "dir_info": {"editable": True}})
    words = shlex.split(install_command("train", "warp"))
    assert words == ["pip", "install", "-e", "/home/me/my robots[train,warp]"]


def test_from_a_wheel_file(installed):
    installed({"url": "file:///tmp/some_name-1.0.whl", "archive_info": {}})
    assert install_command("hub") == "pip install 'some-name[hub] @ file:///tmp/some_name-1.0.whl'"


def test_an_environment_of_uv_has_no_pip_of_its_own(installed):
    installed(installer="uv")
    assert pip() == f"uv pip install --python {sys.executable}"


def test_an_environment_of_uvx_is_made_again_with_the_extra(installed, monkeypatch):
    installed(installer="uv")
    monkeypatch.setattr(sys, "prefix", "/home/me/.cache/uv/archive-v0/Xy12")
    assert install_command("train") == "uvx --from 'some-name[train]' gaponet …"


def test_the_command_is_that_of_pyproject():
    assert PROJECT["scripts"] == dict([SCRIPT])


def test_every_extra_of_a_message_is_there():
    assert set(EXTRAS.values()) <= PROJECT["optional-dependencies"].keys()


def test_the_name_of_the_distribution_stands_in_one_place():
    for lines in (PROJECT["dependencies"], *PROJECT["optional-dependencies"].values()):
        assert not [line for line in lines if line.startswith(PROJECT["name"])]


@pytest.mark.parametrize("module", ["numba", "viser", "matplotlib", "ray"])
def test_another_package_is_proposed_by_its_own_name(installed, module):
    installed()
    error = ModuleNotFoundError(name=f"{module}.part")
    assert missing_package(error) == f"{module} is not installed; run: pip install {module}"
