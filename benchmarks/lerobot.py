"""LeRobot's own commands on a VIRTUAL SO-101 behind a servo bus: python benchmarks/lerobot.py LEROBOT WORK

LEROBOT is the folder of a virtual environment with lerobot and plugins/lerobot_robot_gaponet (make lerobot makes one).
lerobot-record records excitation through the plug-in, gaponet imports it, identifies and trains, LeRobot opens what
gaponet exports, and lerobot-record plays motions that nothing was trained on, uncorrected and corrected in turn. Errors
are of what LeRobot recorded: |observation of a frame − action of the frame before|, joints that move, after the start.
What is there already is not made again.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import tyro

GAPONET = [sys.executable, "-m", "gaponet"]
LEAD = 8.0  # s of a test motion that are not judged: the way to its start
OPENS = """
import sys
from lerobot.datasets import LeRobotDataset
found = LeRobotDataset("me/exported", root=sys.argv[1])
print(found.num_episodes, found.num_frames, found[0]["action"].shape[0])
"""


def main(
    lerobot: tyro.conf.Positional[Path],
    work: tyro.conf.Positional[Path],
    motions: tuple[str, ...] = ("wander-all-7", "reach-all-7", "limber-all-7", "stir-all-7"),
    minutes: float = 8.0,
    seconds: float = 30.0,
    fps: int = 30,
    unit: str = "1",
    budget: str = "10m",
    repeats: int = 2,
) -> None:
    """Print errors as JSON, rad.

    Args:
        lerobot: Virtual environment.
        work: Folder for everything that is made.
        motions: For the test, by the names of gaponet's library.
        minutes: Of excitation.
        seconds: Of an episode of it.
        fps: Rate of LeRobot's loop and of the controller, Hz.
        unit: Of the fleet `hard`.
        budget: Of training.
        repeats: How often each test motion is played each way.
    """
    work = work.resolve()
    work.mkdir(parents=True, exist_ok=True)
    os.environ |= {"HF_LEROBOT_HOME": str(work / "lerobot"), "HF_HUB_OFFLINE": "1"}
    record = Recorder(lerobot.absolute() / "bin", work, fps)
    if not (work / "excitation").is_dir():
        call([*GAPONET, "excite", "--robot", "so101", "--minutes", f"{minutes:g}", "--out", str(work / "excitation")])
    with served(unit, work / "so101"):
        record("excitation", int(60 * minutes / seconds), seconds, work / "excitation")
        data, arm, run = (work / name for name in ("data", "identified", "run"))
        if not (data / "dataset.json").is_file():
            call([*GAPONET, "import", str(record.home / "excitation"), "--robot", "so101", "--position-unit", "deg",
                  "--unit-id", f"virtual-{unit}", "--payload-mass", "0", "--out", str(data)])  # fmt: skip
        if not (arm / "robot.toml").is_file():
            call([*GAPONET, "identify", str(data), "--out", str(arm)])
        if not (run / "model" / "card.json").is_file():
            call([*GAPONET, "train", str(data), "--robot", str(arm), "--out", str(run), "--budget", budget])
        exported = opened(record.bin / "python", data, work / "exported")
        errors: dict[str, dict[str, list[float]]] = {}
        for repeat in range(repeats):
            for motion in motions:
                for how, model in (("uncorrected", None), ("corrected", run)):
                    name = f"{motion}-{how}-{repeat}"
                    record(name, 1, LEAD + 20.0, motion, model)
                    found = errors.setdefault(motion, {"uncorrected": [], "corrected": []})
                    found[how].append(error(record.home / name, fps))
    ratios = [np.mean(e["corrected"]) / np.mean(e["uncorrected"]) for e in errors.values()]
    nominal = json.loads(call([*GAPONET, "gap", str(data), "--json"]))["methods"]["nominal"]["mpjae"]
    print(json.dumps({"virtual": True, "unit": unit, "fps": fps, "gap_rad": nominal, "opened_by_lerobot": exported,
                      "error_rad": errors, "ratio": float(np.mean(ratios)), "ratios": ratios}, indent=1))  # fmt: skip


def call(command: list[str]) -> str:
    """Run a command; what it printed."""
    return subprocess.run(command, check=True, stdout=subprocess.PIPE, text=True).stdout


@contextmanager
def served(unit: str, link: Path) -> Iterator[None]:
    """A VIRTUAL arm on a pseudo-terminal of this name."""
    process = subprocess.Popen([*GAPONET, "virtual", "serve", "--robot", "so101", "--unit", unit, "--link", str(link)])
    try:
        while not link.exists():
            if process.poll() is not None:
                raise SystemExit("gaponet virtual serve has ended")
            time.sleep(0.1)
        yield
    finally:
        process.terminate()
        process.wait()


class Recorder:
    """lerobot-record with our robot and our teleoperator."""

    def __init__(self, folder: Path, work: Path, fps: int) -> None:
        self.bin, self.work, self.fps, self.home = folder, work, fps, work / "lerobot" / "me"

    def __call__(
        self, name: str, episodes: int, seconds: float, motions: Path | str, model: Path | None = None
    ) -> None:
        """Record a set, unless it is there."""
        if (self.home / name / "meta" / "stats.json").is_file():
            return
        call([
            str(self.bin / "lerobot-record"), "--robot.type=gaponet_so101", f"--robot.port={self.work / 'so101'}",
            f"--robot.fps={self.fps}", *([f"--robot.model={model}"] if model else []),
            "--teleop.type=gaponet_motion", f"--teleop.motions={motions}", f"--teleop.fps={self.fps}",
            f"--dataset.repo_id=me/{name}", f"--dataset.root={self.home / name}", f"--dataset.fps={self.fps}",
            f"--dataset.num_episodes={episodes}", f"--dataset.episode_time_s={seconds}", "--dataset.reset_time_s=0",
            f"--dataset.single_task={name}", "--dataset.video=false", "--dataset.push_to_hub=false",
            "--play_sounds=false",
        ])  # fmt: skip


def opened(python: Path, data: Path, out: Path) -> list[int]:
    """Episodes, frames and joints that LeRobot finds in what gaponet exports."""
    if not out.is_dir():
        call([*GAPONET, "data", "export", str(data), "--out", str(out), "--to", "lerobot"])
    return [int(word) for word in call([str(python), "-c", OPENS, str(out)]).split()]


def error(recorded: Path, fps: int) -> float:
    """Mean |observation − action of the frame before| over the joints that move, rad."""
    table = pq.read_table(recorded / "data", columns=["action", "observation.state"])
    asked, seen = (np.array(table[name].to_pylist())[round(LEAD * fps) :, :5] for name in table.column_names)
    moves = np.ptp(asked, axis=0) > 1.0  # degrees
    return float(np.deg2rad(np.abs(seen[1:] - asked[:-1])[:, moves]).mean())


if __name__ == "__main__":
    tyro.cli(main)
