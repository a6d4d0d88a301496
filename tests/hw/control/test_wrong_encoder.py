"""H1-2 whose elbow encoder drifts, freezes or jumps: how far the true joints go after the fault,
in simulated time.
"""

from __future__ import annotations

import os
from collections.abc import Iterator

import numpy as np
import pytest
from hw.control.loopback import RobotClock, living

from gaponet.hw.control.controller import Controller
from gaponet.hw.control.phases import ControlConfig
from gaponet.hw.control.recording import Recording
from gaponet.hw.drivers.unitree import UnitreeDriver
from gaponet.robot.spec import RobotSpec, load_robot

WRONG_FROM_S = 2.5  # after the first command
FIRST_S = 0.5  # in which our share of rt/arm_sdk is at least three quarters (--damp 2)
MAX_MOTION_RAD = 0.15  # of a true joint in that time: it comes to rest, and sinks
ELBOW_MOTOR = 16
KINDS = {  # way in which the robot is wrong → faults that may end the run
    "drifts": ("obedience", "tracking"),
    "encoder": ("frozen",),
    "jump": ("jump",),
}


class Swaying:
    """Plays each fault once: both elbows go up and sway, and the left one's reading becomes
    wrong.
    """

    def __init__(self, robot: RobotSpec, monkeypatch: pytest.MonkeyPatch) -> None:
        self.robot = robot
        self.monkeypatch = monkeypatch
        self.played: dict[tuple[str, str, float], tuple[Recording, RobotClock]] = {}

    def play(self, wrong: str, topic: str, swing: float = 0.5) -> tuple[Recording, RobotClock]:
        """Recording of a run with this fault, and the clock by which the robot lived."""
        key = (wrong, topic, swing)
        if key not in self.played:
            self.played[key] = self._run(*key)
        return self.played[key]

    def _run(self, wrong: str, topic: str, swing: float) -> tuple[Recording, RobotClock]:
        robot = self.robot
        clock = living(self.monkeypatch, robot)
        clock.robot.at = WRONG_FROM_S
        if wrong == "drifts":
            clock.robot.way = wrong
        else:
            clock.robot.inject(wrong, WRONG_FROM_S)  # type: ignore[arg-type]
        elbows = robot.index(["left_elbow_joint", "right_elbow_joint"])

        def policy(k: int, state: object) -> np.ndarray | None:
            target = robot.qpos_home.copy()
            target[elbows] += 0.5 + swing * np.array([1, -1]) * np.sin(0.06 * k)
            return target if k < 250 else None

        config = ControlConfig(blend=1.5, settle=0.1, damp=2.0)
        driver = UnitreeDriver(robot, topic, domain=200 + os.getpid() % 30)
        controller = Controller(driver, robot, config=config, clock=clock, watchdog=False)
        return controller.run(policy), clock


@pytest.fixture(scope="module")
def swaying() -> Iterator[Swaying]:
    with pytest.MonkeyPatch.context() as monkeypatch:
        yield Swaying(load_robot("h1_2"), monkeypatch)


def true_motion(clock: RobotClock, start: float, seconds: float) -> float:
    """Largest distance of a true joint from where it was at `start`, within some seconds, rad."""
    times = np.array([time for time, _ in clock.truth])
    qpos = np.array([qpos for _, qpos in clock.truth])
    during = qpos[(times >= start) & (times <= start + seconds)]
    return float(np.abs(during - during[0]).max())


@pytest.mark.parametrize("topic", ["arm_sdk", "lowcmd"])
@pytest.mark.parametrize("wrong", KINDS)
def test_after_a_fault_of_an_encoder_no_true_joint_moves_far(swaying, wrong, topic):
    recording, clock = swaying.play(wrong, topic)

    assert recording.fault.kind in KINDS[wrong]
    moved = true_motion(clock, recording.fault.time, FIRST_S)
    print(f"{wrong} on {topic}: {moved:.3f} rad in {FIRST_S} s after {recording.fault.kind}")
    assert moved <= MAX_MOTION_RAD


@pytest.mark.parametrize("wrong", KINDS)
def test_after_a_fault_of_an_encoder_no_stiff_position_is_sent(swaying, wrong):
    recording, clock = swaying.play(wrong, "arm_sdk")

    after = [row for row in clock.robot.heard if row["time"] > recording.fault.time + 0.02]
    assert after
    assert {row["kp"][ELBOW_MOTOR] for row in after} == {0.0}


def test_a_drifting_encoder_does_not_carry_a_joint_away_before_it_is_noticed(swaying):
    """The torque limit keeps the command near the reading, so that the joint runs after it: once
    by 2.4 rad.
    """
    recording, clock = swaying.play("drifts", "arm_sdk", swing=0.0)

    elbow = swaying.robot.index(["left_elbow_joint"])[0]
    wrong_from = clock.robot.first_command + WRONG_FROM_S
    until = recording.fault.time
    qpos = np.array([qpos[elbow] for time, qpos in clock.truth if wrong_from <= time <= until])
    assert recording.fault.kind == "tracking"
    print(f"the elbow went {np.ptp(qpos):.2f} rad before the fault")
    assert np.ptp(qpos) < 1.2
