"""Deadlines over real DDS on loopback: a virtual H1-2 (500 Hz) and a controller in two processes.

    python benchmarks/loopback.py --minutes 10 --rate 50

Prints the fraction of control periods that started more than one period late or never, and the age
of states. Watchdogs are on. With --no-stop, a stalled machine is counted and does not stop the
robot.
"""

from __future__ import annotations

import json
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import tyro

from gaponet.hw.control.controller import Controller
from gaponet.hw.control.phases import ControlConfig
from gaponet.hw.control.safety import SafetyConfig
from gaponet.hw.drivers.unitree import UnitreeDriver
from gaponet.robot.spec import load_robot


def main(
    minutes: float = 10.0,
    rate: float = 50.0,
    state_rate: float = 500.0,
    payload_mass: float = 1.0,
    domain: int = 42,
    no_stop: bool = False,
) -> None:
    """Swing both arms slowly and count late periods.

    Args:
        minutes: Duration of the run.
        rate: Commands per second.
        state_rate: States per second.
        payload_mass: Payload per hand, kg; with 3 kg the elbows overheat within two minutes.
        domain: DDS domain.
        no_stop: Count late periods and old states instead of stopping.
    """
    robot = load_robot("h1_2")
    command = [sys.executable, "-m", "gaponet", "virtual", "serve"]
    command += ["--payload-mass", str(payload_mass)]
    command += ["--domain", str(domain), "--rate", str(state_rate)]
    served = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
    try:
        assert served.stdout is not None
        print(served.stdout.readline().strip(), flush=True)
        time.sleep(0.5)
        safety = SafetyConfig()
        if no_stop:
            safety = replace(safety, stale=1e6, overrun=1e6)
        driver = UnitreeDriver(robot, domain=domain)
        controller = Controller(driver, robot, config=ControlConfig(rate=rate), safety=safety)
        recording = controller.run(swing(robot.qpos_home, minutes * 60, rate))
    finally:
        served.terminate()
        served.wait()
    late = np.array(recording.late) * rate
    periods = len(late) + recording.missed
    result = recording.summary() | {
        "virtual": True,
        "periods_due": periods,
        "late_by_a_period_or_missed": float(((late > 1).sum() + recording.missed) / periods),
    }
    print(json.dumps({k: v for k, v in result.items() if k not in ("kp", "kd")}, indent=1))


def swing(
    home: np.ndarray, seconds: float, rate: float
) -> Callable[[int, object], np.ndarray | None]:
    """Return a policy that moves elbows and shoulder pitch at 0.25 Hz."""

    def policy(k: int, state: object) -> np.ndarray | None:
        if k >= seconds * rate:
            return None
        target = home.copy()
        target[[13, 16, 20, 23]] += 0.25 * np.sin(2 * np.pi * 0.25 * k / rate)
        return target

    return policy


if __name__ == "__main__":
    tyro.cli(main)
