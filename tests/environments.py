"""Environments for other people's programs, made once in the user's cache folder: make peers, make
engines.
"""

from __future__ import annotations

import os
import shutil
import subprocess
from pathlib import Path

import pytest


def runs(python: str) -> bool:
    return subprocess.run([python, "-c", ""], capture_output=True).returncode == 0


def environment(name: str, version: str, *installs: tuple[str, ...]) -> str:
    """The Python of an environment; skips the test where it cannot be made, and fails it where CI
    asked for it.

    Args:
        name: Of the folder.
        version: Of Python, e.g. "3.10".
        installs: Arguments of pip install, one after the other.
    """
    cache = Path(os.environ.get("XDG_CACHE_HOME", Path.home() / ".cache")) / "gaponet" / name
    made = cache / "bin" / "python"
    give_up = pytest.fail if os.environ.get("CI") else pytest.skip
    if not (cache / "done").is_file():
        pyenv = Path(os.environ.get("PYENV_ROOT", Path.home() / ".pyenv"))
        named = [
            shutil.which(f"python{version}"),
            *map(str, pyenv.glob(f"versions/{version}.*/bin/python")),
        ]
        found = next((path for path in named if path and runs(path)), None)
        if found is None:
            give_up(f"no Python {version} here")
        subprocess.run([found, "-m", "venv", "--clear", cache], check=True)
        plain = {k: v for k, v in os.environ.items() if k not in ("PIP_CONSTRAINT", "PYTHONPATH")}
        for arguments in installs:
            if subprocess.run(
                [made, "-m", "pip", "install", "-q", *arguments], env=plain
            ).returncode:
                give_up(f"{' '.join(arguments)} cannot be installed here")
        (cache / "done").touch()
    return str(made)
