"""Wheel and sdist, tried as a user would: a clean environment for each extra, away from the checkout, real commands.

Every try goes on with what those before it made. The wheel is built from the sdist. Needs uv and the package index:
make wheels
"""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

ROOT = Path(__file__).parents[1]
RECIPE = """motions = ["tour-all-*", "multisine-*"]
payloads = [0.0]
units = ["virtual-1"]
rates = [50]
repetitions = 1
variants = 3
"""
SMALL = "--pretraining.rounds 2 --pretraining.num-envs 16 --pretraining.steps 60 --pretraining.sensor-states 64"
GYM = """
import gaponet as gp, numpy as np
from gaponet.deploy.gym import TrackingEnv
env = TrackingEnv(gp.AlignedSim(gp.load_robot("so101"), gp.GapModel.load("run")), [np.zeros((50, 6))])
env.reset(seed=0)
print("reward", env.step(env.action_space.sample())[1])
"""
TRIES = {
    "": ["--version", "import --formats", "robot check so101",
         "collect --robot so101 --recipe recipe.toml --out data --nproc 1", "doctor data", "gap data"],
    "train": [f"train data --out run --budget 1920 {SMALL}", "export run --to torch"],
    "deploy": ["eval run data", "report run"],
    "deploy,gym": [GYM],
    "ros": ["data export data --to mcap --out bags", "import bags --robot so101 --out again"],
    "hdf5": ["import --formats"],
    "deploy,film": ["view data --model run --duration 1 --render film.gif"],
}  # fmt: skip


def run(*words: object, folder: Path) -> None:
    """A command that must succeed."""
    print("$", *words, flush=True)
    environment = {k: v for k, v in os.environ.items() if k not in ("PYTHONPATH", "VIRTUAL_ENV")}
    subprocess.run([str(w) for w in words], cwd=folder, env=environment, check=True)


def main(wanted: list[str]) -> None:
    """Build into dist/, then try all extras, or those named."""
    shutil.rmtree(ROOT / "dist", ignore_errors=True)
    run("uv", "build", "--quiet", "--out-dir", ROOT / "dist", folder=ROOT)
    (wheel,) = (ROOT / "dist").glob("*.whl")
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        (folder / "recipe.toml").write_text(RECIPE)
        for extra, commands in TRIES.items():
            if wanted and extra and extra not in wanted:
                continue
            place = folder / "env"
            run("uv", "venv", "--quiet", "--python", sys.executable, place, folder=folder)
            bin = place / ("Scripts" if os.name == "nt" else "bin")
            what = f"gaponet[{extra}] @ {wheel.as_uri()}"
            run("uv", "pip", "install", "--quiet", "--python", place, what, folder=folder)
            for command in commands:
                words = (
                    [bin / "python", "-c", command]
                    if command is GYM
                    else [bin / "gaponet", *command.split()]
                )
                run(*words, folder=folder)
            shutil.rmtree(place)
    print(f"{wheel.name}: {len(TRIES)} clean environments")


if __name__ == "__main__":
    main(sys.argv[1:])
