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
from common import print_table

from gaponet.robot.spec import load_robot

GAPONET = [sys.executable, "-m", "gaponet"]
WAYS: dict[str, dict[str, bool] | None] = {
    "uncorrected": None,
    "corrected": {},
    "dynamics": {"dynamics": True},
}
# Of the test; excitation has other ones.
MOTIONS = ("tour-all-20", "tour-all-21", "limber-all-20", "limber-all-21")
EXCITATION_MINUTES = 8
STEPS = 2_000_000  # control steps of training: unlike a time, they do not depend on the machine
EPISODE_S = 30.0  # of excitation
FPS = 25  # LeRobot's rate
UNIT = "1"  # of the fleet `hard`
# Of a test motion, not judged: the way to its start, and the correction's blending in.
LEAD_S = 5.0
JUDGED_S = 8.0


def main(work: tyro.conf.Positional[Path]) -> None:
    """Print the errors; work is the folder for everything that is made."""
    work = work.resolve()
    work.mkdir(parents=True, exist_ok=True)
    os.environ |= {"HF_LEROBOT_HOME": str(work / "lerobot"), "HF_HUB_OFFLINE": "1"}
    from lerobot.utils.import_utils import register_third_party_plugins

    register_third_party_plugins()
    wait_longer()
    count_frames()
    tell_where_it_is()
    sets = work / "lerobot" / "me"
    learn(work, sets)
    errors = play_test_motions(work, sets)
    gap = json.loads(call("gap", work / "data", "--json"))
    nominal = 1000 * gap["methods"]["nominal"]["mpjae"]
    episodes, frames, joints = opened(work / "exported")
    print(f"VIRTUAL so101, fleet hard, unit virtual-{UNIT}, {FPS} Hz")
    print(f"The nominal simulator is {nominal:.1f} mrad away from the recordings.")
    print(f"LeRobot opens the export: {episodes} episodes, {frames} frames, {joints} joints.")
    print_errors(errors)


def learn(work: Path, sets: Path) -> None:
    """Record excitation, import, identify, train and export; what is there is kept."""
    excitation = work / "excitation"
    data = work / "data"
    arm = work / "identified"
    run = work / "run"
    if not excitation.is_dir():
        minutes = ["--minutes", EXCITATION_MINUTES]
        call("excite", "--robot", "so101", *minutes, "--out", excitation)
    episodes = round(60 * EXCITATION_MINUTES / EPISODE_S)
    record(sets / "excitation", work, str(excitation), episodes, EPISODE_S)
    if not (data / "dataset.json").is_file():
        robot = ["--robot", softer(work / "so101_p16")]
        labels = ["--unit-id", f"virtual-{UNIT}", "--payload-mass", "0"]
        logs = [sets / "excitation", "--position-unit", "deg"]
        call("import", *logs, *robot, *labels, "--out", data)
    if not (arm / "robot.toml").is_file():
        call("identify", data, "--out", arm, "--windows", 12, "--no-table", "--terms")
    if not (run / "model" / "card.json").is_file():
        call("train", data, "--robot", arm, "--out", run, "--budget", STEPS)
    if not (work / "exported").is_dir():
        call("data", "export", data, "--out", work / "exported")


def play_test_motions(work: Path, sets: Path) -> dict[str, float]:
    """Record each test motion in all WAYS; return the errors by "motion way", rad."""
    errors = {}
    for motion in MOTIONS:
        for how, given in WAYS.items():
            step = None
            if given is not None:
                step = {"model": str(work / "run"), "fps": FPS, **given}
            out = sets / f"{motion}-{how}"
            record(out, work, motion, 1, LEAD_S + JUDGED_S, step)
            errors[f"{motion} {how}"] = error(out)
    return errors


def print_errors(errors: dict[str, float]) -> None:
    """Print the errors, mrad, and their mean share of the uncorrected ones; `errors` is in rad."""
    lines = []
    shares = []
    for motion in MOTIONS:
        of_motion = np.array([errors[f"{motion} {how}"] for how in WAYS])
        lines.append([motion, *(f"{1000 * error:.1f}" for error in of_motion)])
        shares.append(of_motion / errors[f"{motion} uncorrected"])
    lines.append(["of uncorrected", *(f"{share:.2f}" for share in np.mean(shares, axis=0))])
    print_table(["mrad", *WAYS], lines)


def wait_longer() -> None:
    """Let the SDK wait 10 s for replies, not 50 ms: a busy machine's servo bus needs longer."""
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
    """Let LeRobot's loop measure an episode in its frames, as the bus does, not by the clock."""
    from lerobot.scripts import lerobot_record

    passed = 0.0

    def sleep(seconds: float) -> None:
        nonlocal passed
        passed += seconds

    lerobot_record.time = SimpleNamespace(perf_counter=lambda: passed)
    lerobot_record.precise_sleep = sleep


def call(*words: object) -> str:
    """Run a command of gaponet; what it printed."""
    command = [*GAPONET, *map(str, words)]
    return subprocess.run(command, check=True, stdout=subprocess.PIPE, text=True).stdout


@contextmanager
def served(work: Path) -> Iterator[None]:
    """A VIRTUAL arm on the pseudo-terminal WORK/so101, its calibration in WORK/virtual.json."""
    calibration = work / "virtual.json"
    calibration.unlink(missing_ok=True)
    robot = ["--robot", "so101", "--unit", UNIT, "--frame", str(1 / FPS)]
    places = ["--link", str(work / "so101"), "--calibration", str(calibration)]
    process = subprocess.Popen([*GAPONET, "virtual", "serve", *robot, *places])
    try:
        while not calibration.exists():
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
    """Run LeRobot's record() with its own SO-101 and our motions.

    The arm has just been switched on, so that its motors are equally warm however often the script
    was interrupted.

    Args:
        step: Options of the processor step, through which actions go.
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
        repo_id=f"me/{out.name}",
        root=out,
        fps=FPS,
        single_task=out.name,
        num_episodes=episodes,
        reset_time_s=0,
        episode_time_s=seconds,
        video=False,
        push_to_hub=False,
        no_stamp=True,
    )
    config = RecordConfig(robot, dataset, teleop, play_sounds=False)
    with served(work):
        play(config, robot_action_processor=processor)


def opened(folder: Path) -> list[int]:
    """Episodes, frames and joints that LeRobot finds in what gaponet exported."""
    from lerobot.datasets import LeRobotDataset

    found = LeRobotDataset("me/exported", root=folder)
    return [found.num_episodes, found.num_frames, len(found[0]["action"])]


def error(recorded: Path) -> float:
    """Mean |observation − action of the frame before| over the joints that move, rad."""
    table = pq.read_table(recorded / "data", columns=["action", "observation.state"])
    first = round(LEAD_S * FPS)
    asked = np.array(table["action"].to_pylist())[first:, :5]
    seen = np.array(table["observation.state"].to_pylist())[first:, :5]
    moves = np.ptp(asked, axis=0) > 1.0  # degrees
    return float(np.deg2rad(np.abs(seen[1:] - asked[:-1])[:, moves]).mean())


if __name__ == "__main__":
    tyro.cli(main)
