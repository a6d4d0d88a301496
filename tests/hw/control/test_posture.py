"""A planned run of an H1-2 whose legs, which are not commanded, leave the posture of the plan."""

from __future__ import annotations

import os
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from hw.control.loopback import living, received

from gaponet.hw.control.controller import Controller
from gaponet.hw.control.driver import State
from gaponet.hw.control.phases import ControlConfig
from gaponet.hw.control.plan import MAX_POSTURE_DRIFT_RAD, Planner
from gaponet.hw.control.recording import Recording
from gaponet.hw.drivers.unitree import UnitreeDriver
from gaponet.motion.motion import Motion
from gaponet.robot.spec import load_robot
from gaponet.virtual.unitree_virtual import VirtualH12

HIP = "left_hip_pitch_joint"
ELBOW = "left_elbow_joint"
LIFT_RAD_S = 0.5  # of a leg that somebody lifts
CONFIG = ControlConfig(blend=0.5, blend_speed=2.0, settle=0.1, damp=0.2)
ROBOT = load_robot("h1_2")


class LiftedDriver(UnitreeDriver):
    """Reads a hip that is further up than the virtual robot's, by an angle over time.

    Attributes:
        angle: Seconds since the plan was made → rad; None before.
    """

    angle: Callable[[float], float] | None = None
    planned = 0.0

    def read(self) -> State:
        state = super().read()
        if self.angle is None:
            return state
        hip = ROBOT.index([HIP])[0]
        lift = np.zeros(len(state.qpos))
        lift[hip] = self.angle(state.time - self.planned)
        return replace(state, qpos=state.qpos + lift)


def bend_elbow() -> Motion:
    """Bend an elbow by 0.2 rad within 1.2 s."""
    ctrl = np.repeat(ROBOT.qpos_home[None], 60, axis=0)
    share = (1 - np.cos(np.linspace(0, np.pi, 60))) / 2
    ctrl[:, ROBOT.index([ELBOW])[0]] += 0.2 * share
    return Motion("bend", "joint", 0.02, ctrl, (ELBOW,))


def play(
    monkeypatch: pytest.MonkeyPatch, angle: Callable[[float], float]
) -> tuple[Recording, VirtualH12]:
    """Plan and play a motion; the hip moves from the moment at which the plan is shown."""
    clock = living(monkeypatch, ROBOT)
    driver = LiftedDriver(ROBOT, domain=200 + os.getpid() % 30)
    planner = Planner(ROBOT, driver.commanded, CONFIG)

    def show_plan(connected: UnitreeDriver) -> None:
        controller.plan = planner.plan(bend_elbow(), connected.read().qpos)
        driver.planned = clock.now()
        driver.angle = angle

    controller = Controller(
        driver,
        ROBOT,
        config=CONFIG,
        clock=clock,
        planner=planner,
        on_connect=show_plan,
        watchdog=False,
    )
    return controller.run(), clock.robot


def test_a_hip_that_moved_while_the_person_read_the_plan_starts_nothing(monkeypatch):
    recording, robot = play(monkeypatch, lambda seconds: MAX_POSTURE_DRIFT_RAD + 0.01)

    assert recording.fault.kind == "plan"
    assert HIP in recording.fault.text
    assert not robot.heard


def test_a_hip_that_leaves_the_plan_during_the_run_stops_it(monkeypatch):
    lifted_from = 0.5  # s

    def lift(seconds: float) -> float:
        return LIFT_RAD_S * max(seconds - lifted_from, 0.0)

    recording, robot = play(monkeypatch, lift)

    assert recording.fault.kind == "tracking"
    assert HIP in recording.fault.text
    assert received(robot)["kp"][-1][ROBOT.index([ELBOW])[0]] == 0.0


def test_a_hip_that_sways_does_not_stop_a_run(monkeypatch):
    def sway(seconds: float) -> float:
        return 0.05 * np.cos(np.pi * seconds)

    recording, _ = play(monkeypatch, sway)

    assert recording.fault is None


def test_the_plan_depends_on_hips_knees_and_torso_and_not_on_ankles():
    planner = Planner(ROBOT, UnitreeDriver(ROBOT).commanded)

    watched = {ROBOT.joint_names[joint] for joint in planner.idle}

    assert {HIP, "left_knee_joint", "right_hip_roll_joint", "torso_joint"} <= watched
    assert not any("ankle" in name for name in watched)


def test_the_tolerance_during_a_run_is_a_clearance_at_the_thigh():
    hand_below_hip = 0.3  # m
    clearance = Planner(ROBOT, UnitreeDriver(ROBOT).commanded).collision.clearance

    assert hand_below_hip * MAX_POSTURE_DRIFT_RAD <= clearance + 1e-9
