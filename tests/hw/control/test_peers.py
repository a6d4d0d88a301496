"""Programs on Unitree's IDL and DDS version at the other end: make peers.

Two environments, two processes, one bus.

cyclonedds 0.10.2, which Unitree's SDK pins, ends with a null pointer when it meets a type object
that it cannot read.
"""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("cyclonedds", reason="pip install 'gaponet[dds]'")

from environments import environment
from motion_files import write_motion

from gaponet.motion.motion import Motion
from gaponet.robot.spec import load_robot

pytestmark = pytest.mark.peers

DOMAIN = 20 + os.getpid() % 150
SECONDS = float(os.environ.get("GAPONET_PEER_SECONDS", "60"))
GAPONET = [sys.executable, "-m", "gaponet"]
RATE = 50.0  # targets per second
PINNED = "cyclonedds==0.10.2"


@pytest.fixture(scope="module")
def python() -> str:
    """A Python 3.10 with the SDK's cyclonedds, made once in the user's cache folder."""
    return environment("peers-0.10.2", "3.10", (PINNED,))  # newer ones have no wheel


@pytest.fixture
def start(python: str) -> Iterator:
    processes: list[subprocess.Popen[str]] = []

    def begin(command: list[str]) -> subprocess.Popen[str]:
        processes.append(subprocess.Popen(command, stdout=subprocess.PIPE, text=True))
        return processes[-1]

    begin.peer = lambda *arguments: begin(
        [python, str(Path(__file__).parent / "peer.py"), *map(str, arguments)]
    )  # type: ignore[attr-defined]
    yield begin
    for process in processes:
        process.kill()
        process.wait()


def told(process: subprocess.Popen[str], seconds: float) -> dict:
    """Its last line; it must have ended by itself and well."""
    out, _ = process.communicate(timeout=seconds)
    assert process.returncode == 0, (
        f"ended with {process.returncode} ({-signal.SIGSEGV} is a crash): {out}"
    )
    return json.loads(out.strip().splitlines()[-1])


def sway(folder: Path, seconds: float) -> Path:
    """A motion file in which the left elbow sways."""
    robot = load_robot("h1_2")
    rows = int(seconds * RATE)
    ctrl = np.repeat(robot.qpos_home[None], rows, axis=0)
    ctrl[:, robot.index(["left_elbow_joint"])] += 0.3 * np.sin(np.arange(rows) / RATE)[:, None]
    write_motion(folder / "sway.npz", Motion("sway", "joint", 1 / RATE, ctrl), robot)
    return folder / "sway.npz"


def run_command(domain: int, motion: Path) -> list[str]:
    bus = ["--driver", "unitree", "--domain", str(domain)]
    return [*GAPONET, "run", *bus, "--motion", str(motion), "--yes", "--json"]


def test_gaponet_run_moves_a_robot_on_the_sdks_dds_and_leaves_it_alive(start, tmp_path):
    seconds = SECONDS - 12
    motion = sway(tmp_path, seconds)
    peer = start.peer("robot", DOMAIN, SECONDS + 15)
    time.sleep(2.0)
    began = time.monotonic()
    said = told(start(run_command(DOMAIN, motion)), SECONDS + 60)
    assert peer.poll() is None, "the robot's program ended when gaponet connected"
    assert time.monotonic() - began > SECONDS - 10
    assert [e[1] for e in said["events"]] == [
        "idle",
        "blend_in",
        "run",
        "blend_out",
        "release",
        "stopped",
    ]
    assert said["mode_machine"] == 6
    heard = told(peer, SECONDS + 60)
    print(f"\n{SECONDS:g} s: {heard}")
    assert heard["commands"] > 0.9 * seconds * RATE
    assert heard["wrong_crc"] == 0
    assert heard["last_weight"] == 0.0
    # The torso is held as well.
    assert heard["largest_kp"] == load_robot("h1_2").servo.kp[12:].max()


def test_a_program_of_the_sdk_that_begins_to_command_the_robot_ends_the_run(start, tmp_path):
    start.peer("robot", DOMAIN + 2, 60.0)
    time.sleep(2.0)
    control = start(run_command(DOMAIN + 2, sway(tmp_path, 40.0)))
    time.sleep(12.0)  # from start-up to the middle of the motion
    start.peer("client", DOMAIN + 2, 10.0)

    out, _ = control.communicate(timeout=60)

    kinds = [kind for _, _, kind, _ in json.loads(out.strip().splitlines()[-1])["events"]]
    assert "source" in kinds
    assert control.returncode == 3


def test_a_client_of_the_sdk_finds_virtual_serve_on_loopback_and_moves_it(start):
    served = start([*GAPONET, "virtual", "serve", "--domain", str(DOMAIN + 1), "--rate", "200"])
    assert served.stdout
    served.stdout.readline()
    heard = told(start.peer("client", DOMAIN + 1, SECONDS), SECONDS + 60)
    print(f"\n{SECONDS:g} s: {heard}")
    assert served.poll() is None
    assert heard["states"] > 10 * SECONDS
    assert heard["wrong_crc"] == 0
    assert heard["moved"] > 0.15
    served.send_signal(signal.SIGINT)
    assert served.wait(20) == 0
