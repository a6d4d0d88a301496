"""Live targets for minutes over loopback, from a sender that stalls, floods and dies; what the robot hears is judged.

    python tests/hw/control/live.py --minutes 10 [--model RUN]

Four processes: a VIRTUAL H1-2 on DDS, `gaponet run --driver unitree --targets zmq` with its watchdog, and a sender that
does something wrong every few seconds, for less than the robot waits, until it is killed. Prints JSON; exit code 1 if
the run ended otherwise than docs/deploy-safety.md says, or if a command was outside the limits. `make faults` plays
half a minute of it. tests/hw/targets/test_live.py has each way to go wrong for good, in simulated time.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import math
import os
import select
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np

GAPONET = [sys.executable, "-m", "gaponet"]
RATE, HOLD = 50.0, 0.5  # Hz, s
JOINTS = ("left_shoulder_pitch_joint", "left_elbow_joint", "right_shoulder_pitch_joint", "right_elbow_joint")
SHORT = 0.3  # s of a way to go wrong that a run survives; a flood goes on longer
WAYS = ("stall", "flood", "nan", "joints", "jump", "range", "again", "backwards", "large", "garbage")


def wave(t: float) -> dict[str, float]:
    """Both arms swing gently, rad."""
    return dict.fromkeys(JOINTS, 0.25 * math.sin(0.5 * math.pi * t))


def send(address: str) -> None:
    """The sender: 50 targets a second; a line on stdin says how it goes wrong from now on, `good` that it does not."""
    import zmq

    socket = zmq.Context().socket(zmq.DEALER)
    socket.sndhwm = 1000
    socket.connect(address)
    way, began, k, kept = "good", time.monotonic(), 0, 0.0
    while True:
        if select.select([sys.stdin], [], [], 0)[0]:
            way, kept = sys.stdin.readline().strip(), time.monotonic()
        for _ in range(60 if way == "flood" else 1):  # 3,000 a second
            now = time.monotonic()
            message: Any = {"time": now, "target": wave(now - began)}
            if way == "again":
                message["time"] = kept
            if way == "backwards":
                message["time"] = 2 * kept - now
            message["target"] |= {
                "nan": {JOINTS[0]: math.nan}, "joints": {"tail_joint": 0.0}, "range": {JOINTS[0]: 30.0},
                "jump": {JOINTS[0]: -1.5},
            }.get(way, {})  # fmt: skip
            data = {"garbage": os.urandom(200), "large": b" " * 20000}.get(way) or json.dumps(message).encode()
            if way not in ("stall", "large"):
                with contextlib.suppress(zmq.Again):
                    socket.send(data, zmq.NOBLOCK)
        if way == "large":  # who says this is cut off, so it is said by another connection
            stranger = zmq.Context.instance().socket(zmq.DEALER)
            stranger.connect(address)
            stranger.send(data)
            stranger.close(linger=100)
            socket.send(json.dumps(message).encode())
        k += 1
        time.sleep(max(0.0, began + k / RATE - time.monotonic()))


def started(command: list[str], **pipes: Any) -> subprocess.Popen[str]:
    return subprocess.Popen(command, text=True, **pipes)


def tell(process: subprocess.Popen[str], way: str) -> None:
    assert process.stdin
    process.stdin.write(way + "\n")
    process.stdin.flush()


def stream(seconds: float, domain: int, model: str | None = None) -> dict[str, Any]:
    """Stream for `seconds` of the run, wrong for a moment every 4 s, until the sender is killed."""
    with tempfile.TemporaryDirectory() as folder:
        heard, address = Path(folder) / "heard.npz", f"ipc://{folder}/targets"
        bus, payload = ["--domain", str(domain)], ["--payload-mass", "1"]
        robot = started([*GAPONET, "virtual", "serve", "--robot", "h1_2", *bus, *payload, "--rate", "100", "--fleet",
                         "easy", "--heard", str(heard)], stdout=subprocess.PIPE)  # fmt: skip
        assert robot.stdout
        robot.stdout.readline()
        options = ["--targets", "zmq", "--live.address", address, "--live.hold", str(HOLD), "--yes", "--json"]
        options += ["--model", model] if model else []
        control = started([*GAPONET, "run", "--driver", "unitree", *bus, *payload, *options], stdout=subprocess.PIPE)
        from_whom = started([sys.executable, __file__, "--send", address], stdin=subprocess.PIPE)
        try:
            wait_for_run(address, control, from_whom)
            done, survived = time.monotonic() + seconds, 0
            while time.monotonic() < done - 4 and control.poll() is None:
                time.sleep(4 - SHORT)
                tell(from_whom, WAYS[survived % len(WAYS)])
                time.sleep(1.0 if WAYS[survived % len(WAYS)] == "flood" else SHORT)
                tell(from_whom, "good")
                survived += 1
            time.sleep(max(0.0, done - time.monotonic()))
            early = control.poll() is not None
            wrong = time.monotonic()
            from_whom.kill()
            said = control.communicate(timeout=120)[0]
        finally:
            for process in (from_whom, control):
                process.kill()
                process.wait()
            robot.send_signal(signal.SIGINT)
            robot.wait()
        result = json.loads(said) | {"survived": survived, "early": early, "wrong": wrong, "code": control.returncode}
        return result | judged(heard, result)


def wait_for_run(address: str, control: subprocess.Popen[str], from_whom: subprocess.Popen[str]) -> None:
    """Until blending in is over, roughly: 2.5 s after the connection, which takes about as long."""
    deadline = time.monotonic() + 60
    while not Path(address.removeprefix("ipc://")).exists() and time.monotonic() < deadline and control.poll() is None:
        time.sleep(0.1)
    time.sleep(8.0)
    assert from_whom.poll() is None


def judged(path: Path, result: dict[str, Any]) -> dict[str, Any]:
    """What the robot heard: commands, those outside range or rate, and position commands after damping."""
    from gaponet.hw.control.safety import Limits, SafetyConfig
    from gaponet.hw.drivers.unitree import MOTOR_NAMES
    from gaponet.robot.spec import load_robot

    robot, at = load_robot("h1_2"), np.arange(13, 27)
    limits = Limits.from_robot(robot, tuple(MOTOR_NAMES[13:]), SafetyConfig())
    with np.load(path) as heard:
        ctrl, kp, when = heard["ctrl"][:, at], heard["kp"][:, at], heard["time"]
    stiff = (kp > 0).all(axis=1)
    out = ((ctrl < limits.low - 1e-6) | (ctrl > limits.high + 1e-6))[stiff].any(axis=1).sum()
    fast = (np.abs(np.diff(ctrl[stiff], axis=0)) > limits.speed / RATE + 1e-6).any(axis=1).sum()
    last = int(np.flatnonzero(stiff)[-1]) if stiff.any() else -1
    return {
        "commands": int(stiff.sum()),
        "outside": int(out + fast),
        "after_damping": int((np.diff(stiff.astype(int)) > 0).sum()),
        "damped": bool(len(stiff) and not stiff[-1]),
        "to_damping_s": round(float(when[last + 1] - result["wrong"]), 3) if last + 1 < len(when) else None,
    }


def wrongs(result: dict[str, Any]) -> list[str]:
    """Return what docs/deploy-safety.md does not say."""
    kind, text = result["events"][-2][2:] if len(result["events"]) > 1 else ("", "")
    checks = {
        f"it ended too early: {kind}, {text}": result["early"],
        f"it ended with {kind}, {text}": kind != "silence" or result["code"] != 3,
        f"{result['outside']} commands outside the limits": result["outside"] > 0,
        "a position command after damping": result["after_damping"] > 0 or not result["damped"],
        f"damped after {result['to_damping_s']} s": not 0 < (result["to_damping_s"] or 0) < HOLD + 0.2,
    }
    return [what for what, is_so in checks.items() if is_so]


def play(minutes: float, domain: int, model: str | None = None) -> dict[str, Any]:
    """Stream; the result, and what is wrong with it."""
    result = stream(60 * minutes, domain, model)
    return result | {"wrong": wrongs(result)}


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--minutes", type=float, default=10.0)
    parser.add_argument("--domain", type=int, default=44)
    parser.add_argument("--model")
    parser.add_argument("--send")
    asked = parser.parse_args()
    if asked.send:
        send(asked.send)
    result = play(asked.minutes, asked.domain, asked.model)
    print(json.dumps({k: v for k, v in result.items() if k not in ("kp", "kd")}, indent=1))
    sys.exit(bool(result["wrong"]))


if __name__ == "__main__":
    main()
