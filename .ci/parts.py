"""The core alone, each other part on it, and all: wheels of their own, in clean environments, with their tests.

    python .ci/parts.py [core] [robots] [interop] [lab] [all]      default: all five; needs uv and the package index

Prints of each, before its tests, its lines, its wheel, what the environment takes on disk, and how long its import and
--version take.
"""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import tempfile
import time
import tomllib
from pathlib import Path

ROOT = Path(__file__).parents[1]
NEEDS = {  # packages of the wheel, extras, tests
    "core": (["gaponet"], "train,deploy", []),
    "robots": (["gaponet", "gaponet_robots"], "train,deploy,zmq,so101", ["tests/robots/motion"]),
    "interop": (["gaponet", "gaponet_interop"], "train,deploy,ros,hdf5,hub", ["tests/interop/formats"]),
    "lab": (["gaponet", "gaponet_robots", "gaponet_lab"], "train,report", ["tests/lab/plot", "tests/lab/report"]),
    "all": (["gaponet", "gaponet_robots", "gaponet_interop", "gaponet_lab"], "dev", ["tests/test_imports.py"]),
}


def run(*words: object, folder: Path) -> None:
    """A command that must succeed, far from the checkout's own modules."""
    environment = {k: v for k, v in os.environ.items() if k not in ("PYTHONPATH", "VIRTUAL_ENV")}
    subprocess.run([str(w) for w in words], cwd=folder, env=environment | {"OMP_NUM_THREADS": "1"}, check=True)


def tree(packages: list[str], folder: Path) -> Path:
    """A checkout that holds these packages alone, and offers only their parts."""
    for name in ("README.md", "LICENSE", "NOTICE", "CHANGELOG.md", "constraints.txt"):
        if (ROOT / name).is_file():
            shutil.copy(ROOT / name, folder)
    for name in packages:
        shutil.copytree(ROOT / "src" / name, folder / "src" / name, ignore=shutil.ignore_patterns("__pycache__"))
    text = (ROOT / "pyproject.toml").read_text()
    for part in tomllib.loads(text)["project"]["entry-points"]["gaponet.parts"].values():
        if part not in packages:
            text = text.replace(f'{part.removeprefix("gaponet_")} = "{part}"\n', "").replace(f', "src/{part}"', "")
    (folder / "pyproject.toml").write_text(text)
    return folder


def seconds(*words: object, folder: Path) -> float:
    """The shortest of three."""
    times = []
    for _ in range(3):
        began = time.monotonic()
        run(*words, folder=folder)
        times.append(time.monotonic() - began)
    return min(times)


def main(wanted: list[str]) -> None:
    for name, (packages, extras, tests) in NEEDS.items():
        if wanted and name not in wanted:
            continue
        with tempfile.TemporaryDirectory() as place:
            folder = Path(place)
            (folder / "tree").mkdir()
            where = tree(packages, folder / "tree")
            run("uv", "build", "--quiet", "--wheel", "--out-dir", folder / "dist", folder=where)
            (wheel,) = (folder / "dist").glob("*.whl")
            run("uv", "venv", "--quiet", "--python", sys.executable, folder / "env", folder=folder)
            bin = folder / "env" / ("Scripts" if os.name == "nt" else "bin")
            pip = ["uv", "pip", "install", "--quiet", "--python", folder / "env"]
            run(*pip, f"gaponet @ {wheel.as_uri()}", folder=folder)
            size = sum(f.stat().st_size for f in (folder / "env").rglob("*") if f.is_file())
            load = seconds(bin / "python", "-c", "import gaponet", folder=folder)
            empty = seconds(bin / "python", "-c", "pass", folder=folder)
            helped = seconds(bin / "gaponet", "--version", folder=folder)
            lines = sum(len(f.read_text().splitlines()) for p in packages for f in (ROOT / "src" / p).rglob("*.py"))
            print(
                f"{name}: {', '.join(packages)}; {lines:,} lines, wheel {wheel.stat().st_size / 1e6:.2f} MB, "
                f"environment {size / 1e6:.0f} MB without extras, import {1e3 * (load - empty):.0f} ms, "
                f"--version {1e3 * helped:.0f} ms",
                flush=True,
            )
            run(*pip, f"gaponet[{extras}] @ {wheel.as_uri()}", "pytest", folder=folder)
            shutil.copytree(ROOT / "tests", folder / "tests", ignore=shutil.ignore_patterns("__pycache__"))
            for other in ("pyproject.toml", "docs", "examples", "benchmarks"):
                link = ROOT / other
                (shutil.copytree if link.is_dir() else shutil.copy)(link, folder / other)
            checkout = "--ignore=tests/test_package.py"  # it is about the repository
            run(bin / "python", "-m", "pytest", "-q", "-p", "no:cacheprovider", checkout, *(tests or ["tests"]),
                folder=folder)  # fmt: skip


if __name__ == "__main__":
    main(sys.argv[1:])
