"""The virtual robot in this process: its time is the clock's from the first command on, and stands
before it.
"""

import numpy as np
import pytest
from arm import write_arm

from gaponet.hw.control.clock import SimulatedClock
from gaponet.hw.control.driver import DriverError
from gaponet.virtual.fleet import load_fleet
from gaponet.virtual.virtual_driver import VirtualDriver

LONG_PLANNING_S = 30.0
START_S = 12_345.0  # of the clock: absolute times must not matter


@pytest.fixture
def clock():
    return SimulatedClock(START_S)


@pytest.fixture
def driver(tmp_path, clock):
    robot = write_arm(tmp_path)
    driver = VirtualDriver(robot, load_fleet("easy", robot).unit("virtual-1"), clock)
    driver.connect()
    return driver


def test_time_for_planning_and_consent_is_not_simulated(driver, clock):
    before = driver.read()
    clock.wait_until(START_S + LONG_PLANNING_S)
    after = driver.read()
    np.testing.assert_allclose(after.qpos, before.qpos, atol=0.01)


def test_after_planning_the_state_is_as_new_as_the_clock(driver, clock):
    clock.wait_until(START_S + LONG_PLANNING_S)
    state = driver.read()
    assert clock.now() - state.time < 2 * driver.unit.live.period


def test_after_planning_the_robot_obeys_in_simulated_time(driver, clock):
    clock.wait_until(START_S + LONG_PLANNING_S)
    target = driver.read().qpos + 0.2
    driver.write(target)
    for _ in range(50):
        clock.wait_until(clock.now() + 0.02)
        state = driver.read()
    assert np.abs(state.qpos - target).max() < 0.15
    assert clock.now() - state.time < 2 * driver.unit.live.period


def test_a_commanded_robot_that_falls_behind_the_clock_is_an_error(driver, clock):
    driver.write(driver.read().qpos)
    clock.wait_until(clock.now() + 1.0)
    with pytest.raises(DriverError, match="real"):
        driver.read()
