"""Errors of an identified robot in other physics engines, beside those in gaponet: docs/results/engines.md.

    make engines                                         # once: environments of their own in ~/.cache/gaponet
    python benchmarks/engines.py ROBOT WORK [--data DATASET] [--test]

Exports the robot for each engine, also with a fit without servo terms, and runs the check.py of each export in that
engine's environment, without gaponet. Prints a row per engine: mean |error| on the exported validation motions (at
most five of 30 s), there and in gaponet, and what the export omits. --test adds the error of the MJCF on whole test
motions. Existing results in WORK are kept.
"""

from __future__ import annotations

import json
import re
import subprocess
import time
from pathlib import Path

import tyro

from gaponet.base.files import write_text
from gaponet.export import export_folder as exporting
from gaponet.export.plain_servos import comparable, fit_plain_servos, read_recordings, rollout_error
from gaponet.export.shipped.mujoco_servos import read
from gaponet.report.candidate import read_origin
from gaponet.robot.folder import save_robot
from gaponet.robot.spec import RobotSpec, load_robot
from gaponet.share.reading import load_dataset

CACHE = Path.home() / ".cache" / "gaponet"
CHECKS = {  # environment → export, check, what runs in it
    "mujoco": ("mjcf", "check.py", "mujoco"), "mjx": ("mjcf", "check_mjx.py", "mujoco-mjx"),
    "mjlab-1.6": ("mjlab", "check.py", "mjlab"), "isaaclab-3": ("isaaclab", "check.py", "isaaclab"),
    "newton": ("newton", "check.py", "newton"), "drake": ("drake", "check.py", "drake"),
}  # fmt: skip
VERSION = "import sys, importlib.metadata as m; print(m.version(sys.argv[1]))"


def nearest(robot: RobotSpec, train: list, folder: Path) -> RobotSpec:
    """Fit the robot without servo terms, unless the folder holds it."""
    if not (folder / "robot.toml").is_file():
        save_robot(fit_plain_servos(robot, train), folder)
    return load_robot(folder)


def checked(python: Path, check: str, package: str, folder: Path) -> dict[str, str | float]:
    """Run a check, unless its result is stored; returns its output, version and duration."""
    kept = folder / f"{python.parents[1].name}.json"
    if not kept.is_file():
        start = time.monotonic()
        version = subprocess.run([python, "-c", VERSION, package], capture_output=True, text=True, check=True).stdout
        done = subprocess.run([python, check], cwd=folder, capture_output=True, text=True)
        if done.returncode:
            return {"said": "", "failed": done.stderr.strip()[-200:], "version": version.strip(), "s": 0.0}
        seconds = round(time.monotonic() - start)
        write_text(kept, json.dumps({"said": done.stdout, "version": version.strip(), "s": seconds}))
    return json.loads(kept.read_text())


def tested(spec: RobotSpec, plain: RobotSpec, robot: Path, exported: Path) -> None:
    """Print the error of each form on the test motions that the robot's folder names."""
    origin = read_origin(robot)
    assert origin is not None
    dataset = load_dataset(str(robot / origin["dataset"]))
    hashes = set(origin["parts"]["test"].values())
    motions = comparable(dataset.sequences([e for e in dataset.entries if e.hash in hashes]), spec, 0.0)
    facts = read(exported / "facts.json")
    forms = {"in gaponet": rollout_error(motions, spec), "in gaponet, without the law": rollout_error(motions, plain)}
    for form, what in (("joints", "MJCF with servo_law.py"), ("plain", "MJCF alone")):
        forms[what] = exporting._error_in_mujoco(exported / facts["file"], facts, motions, spec, form)
    print(f"\n{len(motions)} test motions: " + ", ".join(f"{k} {1e3 * x:.2f} mrad" for k, x in forms.items()))


def main(
    robot: tyro.conf.Positional[Path],
    work: tyro.conf.Positional[Path],
    data: str | None = None,
    environments: Path = CACHE,
    test: bool = False,
) -> None:
    """Print a table in Markdown.

    Args:
        robot: Folder that gaponet identify wrote.
        work: Folder for the exports.
        data: Dataset; default: that of the identification.
        environments: Folder of the engines' environments.
        test: Also measure the test motions.
    """
    spec, recordings = load_robot(robot), read_recordings(robot, data, load_robot(robot))
    assert recordings is not None, "no recordings: give --data"
    mass = min(s.meta.payload_mass for s in recordings[1])
    plain = nearest(spec, recordings[0], work / "plain")
    exporting.fit_plain_servos = lambda *_, **__: plain  # type: ignore[assignment]
    print("| engine | form | there, mrad | in gaponet | s | left out |\n| --- | --- | ---: | ---: | ---: | --- |")
    for to in dict.fromkeys(to for to, *_ in CHECKS.values()):
        notes_file = work / f"{to}.json"
        if not notes_file.is_file():
            made = exporting.export_robot(spec, to, work / to, recordings, payload_mass=mass)
            write_text(notes_file, json.dumps({"notes": made.notes}))
        notes = [n for n in json.loads(notes_file.read_text())["notes"] if "met something" not in n]
        for name, (_, check, package) in ((n, c) for n, c in CHECKS.items() if c[0] == to):
            got = checked(environments / name / "bin" / "python", check, package, work / to)
            found = re.findall(r"^(.*?): ([\d.]+) mrad; in gaponet ([\d.]+)", got["said"], re.MULTILINE)
            for form, there, here in found or [(got.get("failed", got["said"][-200:]), "–", "–")]:
                left_out = "; ".join(note.split(":")[0] for note in notes)
                print(
                    f"| {package} {got['version']} | {form} | {there} | {here} | {got['s']} | {left_out} |", flush=True
                )
    if test:
        tested(spec, plain, robot, work / "mjcf")


if __name__ == "__main__":
    tyro.cli(main)
