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
BAG = """
from pathlib import Path
import numpy as np
from rosbags.rosbag2 import Writer
from rosbags.typesys import Stores, get_typestore
from gaponet.robot.spec import load_robot

robot = load_robot("so101")
types = get_typestore(Stores.ROS2_JAZZY)
JointState, Header, Time = (
    types.types[name] for name in ("sensor_msgs/msg/JointState", "std_msgs/msg/Header", "builtin_interfaces/msg/Time")
)
names, none = list(robot.joint_names), np.zeros(0)
with Writer(Path("bags/wave"), version=9) as bag:
    topics = {}
    for topic in ("/joint_states", "/joint_commands"):
        topics[topic] = bag.add_connection(topic, JointState.__msgtype__, typestore=types)
    for row in range(200):
        stamp = int(2e7 * row)
        angle = robot.qpos_home + 0.1 * np.sin(0.05 * row)
        for late, connection in enumerate(topics.values()):
            time = Time(sec=stamp // 10**9, nanosec=stamp % 10**9)
            position = angle - 0.01 * (1 - late)
            message = JointState(Header(time, ""), names, position, none, none)
            bag.write(connection, stamp, types.serialize_cdr(message, JointState.__msgtype__))
"""
TRIES: dict[str, list[str]] = {
    "": [
        "gaponet --version",
        "gaponet import --formats",
        "gaponet robot check so101",
        "gaponet collect --robot so101 --recipe recipe.toml --out data --nproc 1",
        "gaponet doctor data",
        "gaponet gap data",
    ],
    "train": [
        f"gaponet train data --out run --budget 1920 {SMALL}",
        "gaponet export run --to torch",
    ],
    "deploy": ["gaponet eval run data", "gaponet report run"],
    "deploy,gym": [GYM],
    "ros": [
        BAG,
        "gaponet import bags --robot so101 --unit-id a --payload-mass 0 --out again",
    ],
    "hdf5": ["gaponet import --formats"],
    "so101": ["gaponet virtual serve --robot so101 --seconds 1"],
    "dds": ["gaponet virtual serve --robot h1_2 --seconds 1"],
    "deploy,film": ["gaponet view data --model run --duration 1 --render film.gif"],
}


def run(*words: object, folder: Path) -> None:
    """A command that must succeed."""
    print("$", *words, flush=True)
    environment = {k: v for k, v in os.environ.items() if k not in ("PYTHONPATH", "VIRTUAL_ENV")}
    subprocess.run([str(w) for w in words], cwd=folder, env=environment, check=True)


def words_of(command: str, bin: Path) -> list[object]:
    """Return the words of a command of gaponet, or of a script for Python."""
    if not command.startswith("gaponet "):
        return [bin / "python", "-c", command]
    program, *words = command.split()
    return [bin / program, *words]


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
                run(*words_of(command, bin), folder=folder)
            shutil.rmtree(place)
    print(f"{wheel.name}: {len(TRIES)} clean environments")


if __name__ == "__main__":
    main(sys.argv[1:])
