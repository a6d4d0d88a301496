"""LeRobot on a VIRTUAL SO-101 behind a servo bus: python benchmarks/lerobot_so101.py WORK.

`make lerobot` creates an environment with LeRobot and the plug-in, and runs this script. LeRobot's
own so101_follower, with Feetech's SDK, and its record() play excitation. gaponet imports the
recordings, identifies and trains; LeRobot opens the exported dataset. Then record() plays test
motions, uncorrected and corrected by the processor step gaponet_correct. The bus advances one frame
per goal, so that the load of the machine has no effect. The error is |observation − action of the
frame before| of the joints that move, after the move to the start. Existing results are kept.
"""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pyarrow.parquet as pq
import tyro

from gaponet.robot.spec import load_robot

GAPONET = [sys.executable, "-m", "gaponet"]
WAYS: dict[str, dict[str, bool] | None] = {
    "uncorrected": None,
    "corrected": {},
    "dynamics": {"dynamics": True},
}
MOTIONS = (
    "tour-all-20",
    "tour-all-21",
    "limber-all-20",
    "limber-all-21",
)  # of the test; excitation has other ones
MINUTES, FPS, UNIT = 8, 25, "1"  # excitation, LeRobot's rate, unit of the fleet `hard`
LEAD = 5.0  # s of a test motion that are not judged: the way to its start, and the correction's blending in


def main(work: tyro.conf.Positional[Path]) -> None:
    """Print errors as JSON, rad; work is the folder for everything that is made."""
    work = work.resolve()
    work.mkdir(parents=True, exist_ok=True)
    os.environ |= {"HF_LEROBOT_HOME": str(work / "lerobot"), "HF_HUB_OFFLINE": "1"}
    from lerobot.utils.import_utils import register_third_party_plugins

    register_third_party_plugins()
    wait_longer()
    count_frames()
    tell_where_it_is()
    excitation, data, arm, run, out = (
        work / x for x in ("excitation", "data", "identified", "run", "exported")
    )
    if not excitation.is_dir():
        call("excite", "--robot", "so101", "--minutes", MINUTES, "--out", excitation)
    with served(work):
        sets = work / "lerobot" / "me"
        record(sets / "excitation", work, str(excitation), 2 * MINUTES, 30.0)
        if not (data / "dataset.json").is_file():
            words = [
                "--position-unit",
                "deg",
                "--unit-id",
                f"virtual-{UNIT}",
                "--payload-mass",
                "0",
            ]
            call(
                "import",
                sets / "excitation",
                "--robot",
                softer(work / "so101_p16"),
                *words,
                "--out",
                data,
            )
        if not (arm / "robot.toml").is_file():
            call("identify", data, "--out", arm, "--windows", 12, "--no-table", "--terms")
        if not (run / "model" / "card.json").is_file():
            call("train", data, "--robot", arm, "--out", run, "--budget", "10m")
        if not out.is_dir():
            call("data", "export", data, "--out", out)
        errors = {}
        for motion in MOTIONS:
            for how, given in WAYS.items():
                step = {"model": str(run), **given} if given is not None else None
                record(sets / f"{motion}-{how}", work, motion, 1, LEAD + 8.0, step)
                errors[f"{motion} {how}"] = error(sets / f"{motion}-{how}")
    ratios = {
        how: [errors[f"{motion} {how}"] / errors[f"{motion} uncorrected"] for motion in MOTIONS]
        for how in WAYS
    }
    nominal = json.loads(call("gap", data, "--json"))["methods"]["nominal"]["mpjae"]
    print(json.dumps({
        "virtual": True, "unit": UNIT, "fps": FPS, "gap_rad": nominal, "opened_by_lerobot": opened(out),
        "error_rad": errors, "ratio": ratios, "mean": {how: float(np.mean(each)) for how, each in ratios.items()},
    }, indent=1))  # fmt: skip


def wait_longer() -> None:
    """Replies of a servo bus on a busy machine take longer than the SDK waits: its patience, 50 ms,
    becomes 10 s.
    """
    from lerobot.motors.feetech import feetech

    given = feetech.patch_setPacketTimeout

    def patient(self, length):  # type: ignore[no-untyped-def]
        given(self, length)
        self.packet_timeout += 10_000

    feetech.patch_setPacketTimeout = patient


def tell_where_it_is() -> None:
    """gaponet_motion plans from where the arm is; LeRobot's own robot tells it."""
    from lerobot.robots.so_follower import SO101Follower
    from lerobot_robot_gaponet import set_observation

    observe = SO101Follower.get_observation

    def observed(self):  # type: ignore[no-untyped-def]
        found = observe(self)
        set_observation(found)
        return found

    SO101Follower.get_observation = observed


def softer(folder: Path) -> Path:
    """The packaged robot with the P of 16 that LeRobot writes into the servos, instead of 32."""
    if not folder.is_dir():
        shutil.copytree(load_robot("so101").folder, folder)
        toml = (folder / "robot.toml").read_text(encoding="utf-8")
        (folder / "robot.toml").write_text(toml.replace("kp = 17.8", "kp = 8.9"), encoding="utf-8")
    return folder


def count_frames() -> None:
    """LeRobot's loop asks the clock how long an episode has been; now that is its frames, as on the
    bus.
    """
    from lerobot.scripts import lerobot_record

    passed = 0.0

    def sleep(seconds: float) -> None:
        nonlocal passed
        passed += seconds

    lerobot_record.time = SimpleNamespace(perf_counter=lambda: passed)
    lerobot_record.precise_sleep = sleep


def call(*words: object) -> str:
    """Run a command of gaponet; what it printed."""
    return subprocess.run(
        [*GAPONET, *map(str, words)], check=True, stdout=subprocess.PIPE, text=True
    ).stdout


@contextmanager
def served(work: Path) -> Iterator[None]:
    """A VIRTUAL arm on the pseudo-terminal WORK/so101, its calibration in WORK/virtual.json."""
    words = [
        "--robot",
        "so101",
        "--unit",
        UNIT,
        "--link",
        work / "so101",
        "--calibration",
        work / "virtual.json",
    ]
    (work / "virtual.json").unlink(missing_ok=True)
    process = subprocess.Popen(
        [*GAPONET, "virtual", "serve", *map(str, words), "--frame", str(1 / FPS)]
    )
    try:
        while not (work / "virtual.json").exists():
            if process.poll() is not None:
                raise SystemExit("gaponet virtual serve has ended")
            time.sleep(0.1)
        yield
    finally:
        process.terminate()
        process.wait()


def record(
    out: Path,
    work: Path,
    motions: str,
    episodes: int,
    seconds: float,
    step: dict[str, object] | None = None,
) -> None:
    """LeRobot's record() with its own SO-101 and our motions, through the processor step where it
    is configured.
    """
    if (out / "meta" / "stats.json").is_file():
        return
    from lerobot.configs.dataset import DatasetRecordConfig
    from lerobot.processor import ProcessorStepRegistry, RobotProcessorPipeline
    from lerobot.processor.converters import (
        robot_action_observation_to_transition,
        transition_to_robot_action,
    )
    from lerobot.robots.so_follower import SO101FollowerConfig
    from lerobot.scripts.lerobot_record import RecordConfig
    from lerobot.scripts.lerobot_record import record as play
    from lerobot.teleoperators import TeleoperatorConfig

    steps = [ProcessorStepRegistry.get("gaponet_correct")(**step)] if step else []
    processor = RobotProcessorPipeline(
        steps=steps,
        to_transition=robot_action_observation_to_transition,
        to_output=transition_to_robot_action,
    )
    teleop = TeleoperatorConfig.get_choice_class("gaponet_motion")(motions=motions, fps=FPS)
    robot = SO101FollowerConfig(port=str(work / "so101"), id="virtual", calibration_dir=work)
    dataset = DatasetRecordConfig(
        repo_id=f"me/{out.name}", root=out, fps=FPS, single_task=out.name, num_episodes=episodes, reset_time_s=0,
        episode_time_s=seconds, video=False, push_to_hub=False, no_stamp=True,
    )  # fmt: skip
    play(RecordConfig(robot, dataset, teleop, play_sounds=False), robot_action_processor=processor)


def opened(folder: Path) -> list[int]:
    """Episodes, frames and joints that LeRobot finds in what gaponet exported."""
    from lerobot.datasets import LeRobotDataset

    found = LeRobotDataset("me/exported", root=folder)
    return [found.num_episodes, found.num_frames, len(found[0]["action"])]


def error(recorded: Path) -> float:
    """Mean |observation − action of the frame before| over the joints that move, rad."""
    table = pq.read_table(recorded / "data", columns=["action", "observation.state"])
    asked, seen = (
        np.array(table[name].to_pylist())[round(LEAD * FPS) :, :5] for name in table.column_names
    )
    moves = np.ptp(asked, axis=0) > 1.0  # degrees
    return float(np.deg2rad(np.abs(seen[1:] - asked[:-1])[:, moves]).mean())


if __name__ == "__main__":
    tyro.cli(main)
