"""How large the gap of the hard fleet is."""

from dataclasses import replace

import numpy as np
import pytest

from gaponet.motion.library import Library
from gaponet.motion.motion import Motion
from gaponet.motion.recipe import Recipe, takes
from gaponet.robot.spec import load_robot
from gaponet.sim.replay import replay
from gaponet.virtual.fleet import load_fleet
from gaponet.virtual.play import Job, play

PLAYED_S = 5.0  # of each motion
MOTIONS = ("reach-both-0", "pick_and_place-both-0", "sweep-left_shoulder_roll")


@pytest.fixture
def short_motions(monkeypatch):
    """Motions that end after some seconds."""
    whole = Library.make

    def beginning(library: Library, name: str) -> Motion:
        motion = whole(library, name)
        return replace(motion, ctrl=motion.ctrl[: round(PLAYED_S / motion.dt)])

    monkeypatch.setattr(Library, "make", beginning)


def test_four_numbers_leave_of_the_hard_fleet_what_real_arms_leave(short_motions):
    """Gap and rest are of the size of a real SO-101's (19 and 4.4 mrad) and of the paper's H1-2
    (12 to 15 left).
    """
    robot = load_robot("h1_2")
    recipe = Recipe("test", (0.0, 3.0), ("virtual-4",), MOTIONS)
    wanted = tuple(takes(recipe, list(MOTIONS)))
    recorded = play(Job(robot, load_fleet("hard", robot), recipe, (), 0, wanted))
    fitted = {"frictionloss": 1.74, "damping": 1.007, "delay": 0.011}
    servos = {}
    for joint, kp in zip(robot.operated, robot.servo.kp[robot.operated_index], strict=True):
        servos[joint] = fitted | {"kp": 0.79 * kp}
    four_numbers = robot.with_identified(servos)
    for simulator, least, most in ((robot, 0.010, 0.030), (four_numbers, 0.004, 0.015)):
        rollouts = replay(recorded, simulator, lock_idle=True)
        pairs = list(zip(recorded, rollouts, strict=True))
        for payload in recipe.payloads:
            errors = [np.abs(s.qpos - r.qpos) for s, r in pairs if s.meta.payload_mass == payload]
            assert least < np.mean(np.concatenate(errors)[:, robot.operated_index]) < most, payload
