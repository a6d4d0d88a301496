"""Whether gaponet with its extras can be installed beside the tools its users have: uv resolves, nothing is installed.

A cell is a platform and a Python version: the newest versions that suit both; "not offered" where the other tool cannot
be resolved by itself; "without X" where that extra has no wheel. Exit code 1 where anything else is missing.
Needs the package index: make resolve
"""

from __future__ import annotations

import os
import re
import subprocess
import sys
import tomllib
from concurrent.futures import ThreadPoolExecutor
from itertools import product
from pathlib import Path

ROOT = Path(__file__).parents[1]
BESIDE = {
    "alone": "",
    "LeRobot": "lerobot>=0.6,<0.7",
    "mjlab": "mjlab>=1.6,<1.7",
    "Isaac Lab": "isaaclab>=3,<4",
}
PLATFORMS = {
    "Linux x86_64": "x86_64-manylinux_2_35",
    "Linux aarch64": "aarch64-manylinux_2_35",
    "macOS 14 arm64": "aarch64-apple-darwin",
    "Windows": "x86_64-pc-windows-msvc",
}
PYTHONS = ("3.11", "3.12", "3.13", "3.14")
SHOWN = ("torch", "mujoco")
UNTIL = {"mjlab": "3.13"}  # an upper bound of Requires-Python, at which uv does not look


def extras() -> list[str]:
    """Those for users."""
    known = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"][
        "optional-dependencies"
    ]
    return sorted(set(known) - {"dev", "docs"})


def missing(name: str, where: str, python: str) -> list[str]:
    """Extras that are known not to go: cyclonedds has no wheel (docs/install.md), mujoco-warp is MuJoCo 4's."""
    return ["dds"] * (where == "Linux aarch64" or python == "3.14") + ["warp"] * (
        name in ("mjlab", "Isaac Lab")
    )


def resolve(wanted: list[str], beside: str, where: str, python: str) -> dict[str, str] | None:
    """Package → version; None where there is no solution. Nothing wanted: the other tool by itself; nothing beside it:
    every package must have a wheel."""
    lines = [beside] * bool(beside) + (
        [f"gaponet[{','.join(wanted)}] @ {ROOT.as_uri()}"] if wanted else []
    )
    words = [
        "uv",
        "pip",
        "compile",
        "-",
        "--quiet",
        "--no-header",
        "--no-annotate",
        "--python-version",
        python,
    ]
    words += ["--python-platform", PLATFORMS[where]]
    words += [] if beside else ["--only-binary", ":all:", "--no-binary", "gaponet"]
    system = os.environ | {"MACOSX_DEPLOYMENT_TARGET": "14.0"}
    done = subprocess.run(words, input="\n".join(lines), capture_output=True, text=True, env=system)
    if done.returncode and "No solution found" not in done.stderr:
        raise SystemExit(f"{' '.join(words)}\n{done.stderr}")
    return (
        None
        if done.returncode
        else dict(re.findall(r"^([a-z0-9-]+)==(\S+)", done.stdout, re.MULTILINE))
    )


def cell(name: str, where: str, python: str) -> tuple[str, list[str]]:
    """What stands in the table, and what is missing though it should not be."""
    beside = BESIDE[name]
    known = missing(name, where, python)
    found = resolve([extra for extra in extras() if extra not in known], beside, where, python)
    if python > UNTIL.get(name, python) or (
        found is None and beside and resolve([], beside, where, python) is None
    ):
        return "not offered", []
    if found is None:
        alone = [
            extra or "base"
            for extra in ["", *extras()]
            if resolve([extra], beside, where, python) is None
        ]
        return "no", [
            f"{name}, {where}, Python {python}: {', '.join(alone) or 'each extra, but not all together'}"
        ]
    text = ", ".join(f"{package} {found[package]}" for package in SHOWN)
    return text + "".join(f", without {extra}" for extra in known), []


def main() -> int:
    """Print the table and what is wrong."""
    places = list(product(BESIDE, PLATFORMS))
    with ThreadPoolExecutor(8) as pool:
        cells = {key: pool.submit(cell, *key) for key in product(BESIDE, PLATFORMS, PYTHONS)}
    print("| beside | platform |" + "".join(f" Python {p} |" for p in PYTHONS))
    print("| --- | --- |" + " --- |" * len(PYTHONS))
    for place in places:
        print(
            f"| {' | '.join(place)} |"
            + "".join(f" {cells[*place, p].result()[0]} |" for p in PYTHONS)
        )
    wrong = [line for found in cells.values() for line in found.result()[1]]
    print("\n".join(wrong), file=sys.stderr)
    return bool(wrong)


if __name__ == "__main__":
    sys.exit(main())
