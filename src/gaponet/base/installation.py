"""How this gaponet was installed, and the commands that add an optional package to it.

The distribution's name stands in pyproject.toml alone. Here it is read from the metadata of the
distribution that brings the command `gaponet`, because another distribution on the package index
may have the package's name.
"""

from __future__ import annotations

import json
import sys
from importlib.metadata import Distribution, entry_points
from pathlib import Path
from typing import Any

SCRIPT = ("gaponet", "gaponet.__main__:entry")  # name and target of the command in pyproject.toml
SOURCE_TREE = Path(__file__).parents[3]  # with pyproject.toml, if nothing was installed
UVX_FOLDERS = ("archive-v0", "environments-v2")  # of uv's cache, which holds environments of uvx
# Modules of optional dependencies → the extra that brings them.
EXTRAS = {
    "torch": "train",
    "onnx": "train",
    "sklearn": "train",
    "onnxruntime": "deploy",
    "cyclonedds": "dds",
    "serial": "so101",
    "gymnasium": "gym",
    "imageio_ffmpeg": "film",
    "rosbags": "ros",
    "h5py": "hdf5",
    "huggingface_hub": "hub",
    "zmq": "zmq",
    "warp": "warp",
    "mujoco_warp": "warp",
}
# Modules of packages that gaponet itself needs, and of packages that people choose by themselves →
# what to install.
PACKAGES = {
    "numba": "numba",
    "matplotlib": "matplotlib",
    "jinja2": "jinja2",
    "markupsafe": "jinja2",
    "PIL": "pillow",
    "viser": "viser",
    "trimesh": "trimesh",
    "tensorboard": "tensorboard",
    "wandb": "wandb",
    "ray": "ray",
}


def missing_package(error: ModuleNotFoundError) -> str | None:
    """Return a sentence with the command that installs a missing dependency.

    None for any other module.
    """
    module = (error.name or "").split(".")[0]
    if module in EXTRAS:
        return f"{module} is not installed; run: {install_command(EXTRAS[module])}"
    if module in PACKAGES:
        return f"{module} is not installed; run: {pip()} {PACKAGES[module]}"
    return None


def install_command(*extras: str) -> str:
    """Return the command for a shell that adds extras to the gaponet at hand, from where that came
    from.
    """
    return _command(_distribution(), extras)


def pip() -> str:
    """Return the start of a command that installs into this environment, such as "pip install"."""
    distribution = _distribution()
    installer = "" if distribution is None else distribution.read_text("INSTALLER") or ""
    if installer.strip() == "uv":  # whose environments have no pip
        return f"uv pip install --python {sys.executable}"
    return "pip install"


def _distribution() -> Distribution | None:
    """Return the distribution that brings the command `gaponet` of this package.

    None if it was not installed.
    """
    name, target = SCRIPT
    for point in entry_points(group="console_scripts", name=name):
        if point.value == target:
            return point.dist
    return None


def _command(distribution: Distribution | None, extras: tuple[str, ...]) -> str:
    suffix = f"[{','.join(extras)}]"
    if distribution is None:
        return f"{pip()} -e '{SOURCE_TREE}{suffix}'"
    requirement, option = _requirement(distribution, suffix)
    if any(folder in Path(sys.prefix).parts for folder in UVX_FOLDERS):
        return f"uvx --from '{requirement}' {SCRIPT[0]} …"
    return f"{pip()} {option}'{requirement}'"


def _requirement(distribution: Distribution, suffix: str) -> tuple[str, str]:
    """Return the requirement with extras for an installed distribution, and the option before it.

    PEP 610: direct_url.json says from where a distribution came, and is absent if that was an
    index.
    """
    name = distribution.name
    text = distribution.read_text("direct_url.json")
    if text is None:
        return f"{name}{suffix}", ""
    origin: dict[str, Any] = json.loads(text)
    url = str(origin["url"])
    if "dir_info" in origin:
        option = "-e " if origin["dir_info"].get("editable") else ""
        return f"{_folder(url)}{suffix}", option
    if "vcs_info" in origin:
        vcs = origin["vcs_info"]
        return f"{name}{suffix} @ {vcs['vcs']}+{url}@{vcs['commit_id']}", ""
    return f"{name}{suffix} @ {url}", ""


def _folder(url: str) -> str:
    """Return the path of a file:// address."""
    from urllib.parse import urlsplit
    from urllib.request import url2pathname

    return url2pathname(urlsplit(url).path)
