"""An identified robot in other people's engines: what its exports leave there, beside what it leaves here.

    make engines                                         # once: environments of their own in ~/.cache/gaponet
    python benchmarks/engines.py ROBOT WORK [--data DATASET]

Exports the robot for MuJoCo, MJX, mjlab and Newton, once fitted without its law, and runs the check.py beside each
export in that engine's environment, without gaponet. Prints a row per engine: mean |error| on the validation motions
that travel (five of 30 s at most), there and in gaponet, and what the export says that it leaves out.
"""

from __future__ import annotations

import re
import subprocess
from pathlib import Path

import tyro

from gaponet.robot import load_robot
from gaponet_interop.engine import folder as exporting
from gaponet_interop.engine.forms import plain_form, recordings_of

CACHE = Path.home() / ".cache" / "gaponet"
CHECKS = {  # environment → export, check
    "mujoco": ("mjcf", "check.py"), "mjx": ("mjcf", "check_mjx.py"),
    "mjlab-1.6": ("mjlab", "check.py"), "newton": ("newton", "check.py"),
}  # fmt: skip


def main(
    robot: tyro.conf.Positional[Path],
    work: tyro.conf.Positional[Path],
    data: str | None = None,
    environments: Path = CACHE,
) -> None:
    """Print a table in Markdown.

    Args:
        robot: Folder that gaponet identify wrote.
        work: Folder for the exports.
        data: Dataset; default the one that the robot was identified from.
        environments: Where each engine's environment lies.
    """
    spec, recordings = load_robot(robot), recordings_of(robot, data, load_robot(robot))
    assert recordings is not None, "no recordings: give --data"
    mass = min(s.meta.payload_mass for s in recordings[1])
    plain = plain_form(spec, recordings[0])
    exporting.plain_form = lambda *_, **__: plain  # type: ignore[assignment]
    print("| engine | form | there, mrad | in gaponet | left out |\n| --- | --- | ---: | ---: | --- |")
    for to in dict.fromkeys(to for to, _ in CHECKS.values()):
        made = exporting.export_robot(spec, to, work / to, recordings, payload_mass=mass)
        for name, (_, check) in ((n, c) for n, c in CHECKS.items() if c[0] == to):
            python = environments / name / "bin" / "python"
            done = subprocess.run([python, check], cwd=work / to, capture_output=True, text=True)
            found = re.findall(r"^(.*?): ([\d.]+) mrad; in gaponet ([\d.]+)", done.stdout, re.MULTILINE)
            for form, there, here in found or [(done.stderr.strip()[-200:], "–", "–")]:
                notes = [note.split(":")[0] for note in made.notes if "met something" not in note]
                print(f"| {name} | {form} | {there} | {here} | {'; '.join(notes)} |", flush=True)


if __name__ == "__main__":
    tyro.cli(main)
