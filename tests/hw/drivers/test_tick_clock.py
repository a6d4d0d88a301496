"""The robot's tick as a clock: a message that was long under way is seen to be old."""

import pytest

from gaponet.hw.drivers.unitree_states import TickClock

FOUND_S = 0.4  # for which messages are heard before the first reading, one every 2 ms
START_S = 50.0  # arrival of the first message, on this machine's clock


def found(first: int = 7000, ticks_per_s: float = 1000.0) -> TickClock:
    """A clock of messages that all arrive at once; the first one has tick `first`."""
    times = [0.002 * i for i in range(round(FOUND_S / 0.002) + 1)]
    ticks = [(first + round(ticks_per_s * time)) % 2**32 for time in times]
    return TickClock([START_S + time for time in times], ticks)


def test_a_message_that_is_late_has_the_time_at_which_it_was_measured():
    clock = found()
    assert clock.time(7500, START_S + 0.5) == pytest.approx(START_S + 0.5, abs=1e-3)
    assert clock.time(7520, START_S + 0.82) == pytest.approx(START_S + 0.52, abs=1e-3)


def test_the_same_message_has_the_same_time_whenever_it_is_read():
    clock = found()
    first = clock.time(7500, START_S + 0.5)
    assert clock.time(7500, START_S + 0.9) == first


def test_a_tick_may_count_two_milliseconds():
    clock = found(ticks_per_s=500.0)
    assert clock.time(7250, START_S + 0.8) == pytest.approx(START_S + 0.5, abs=3e-3)


@pytest.mark.parametrize("ticks_per_s", [0.0, 1.0, 50.0, 10_000.0])
def test_a_tick_that_is_no_clock_leaves_the_time_of_arrival(ticks_per_s):
    clock = found(ticks_per_s=ticks_per_s)
    tick = 7000 + round(0.5 * ticks_per_s)
    assert clock.time(tick, START_S + 0.8) == START_S + 0.8
    assert clock.time(tick, START_S + 0.9) == START_S + 0.9, "the tick may stand still"


def test_after_its_largest_number_a_tick_goes_on_from_zero():
    clock = found(first=2**32 - 450)
    assert clock.time(70, START_S + 0.9) == pytest.approx(START_S + 0.52, abs=1e-3)


def test_a_robot_that_has_restarted_begins_a_new_clock():
    clock = found()
    assert clock.time(3, START_S + 9.0) == pytest.approx(START_S + 9.0)
    assert clock.time(23, START_S + 9.5) == pytest.approx(START_S + 9.02, abs=1e-3)


def test_a_robots_clock_that_is_slower_is_followed():
    clock = found()
    for second in range(1, 200):
        arrival = START_S + second
        assert clock.time(7000 + round(999.9 * second), arrival) > arrival - 5e-3


def test_old_messages_that_are_repeated_become_old():
    clock = found()
    ages = []
    for period in range(1, 1500):
        arrival = START_S + FOUND_S + 0.02 * period
        tick = 7300 + 20 * period % 100  # of the last 0.1 s, again and again
        ages.append(arrival - clock.time(tick, arrival))

    assert min(ages[5:]) > 0.1
    assert ages[-1] == pytest.approx(30.0, abs=0.2)


def test_messages_from_before_the_first_one_that_are_repeated_become_old():
    clock = found()
    ages = []
    for period in range(1, 500):
        arrival = START_S + FOUND_S + 0.02 * period
        tick = 3000 + 20 * period % 100
        ages.append(arrival - clock.time(tick, arrival))

    assert ages[-1] > 9.0
    assert ages[0] < 1e-3, "the first one looks like a restart"


def test_one_old_message_after_newer_ones_is_as_old_as_its_tick_says():
    clock = found()
    assert clock.time(7100, START_S + 0.4) == pytest.approx(START_S + 0.1, abs=1e-3)
    assert clock.time(7420, START_S + 0.42) == pytest.approx(START_S + 0.42, abs=1e-3)


def test_an_old_message_is_old_although_the_tick_has_passed_its_largest_number():
    clock = found(first=2**32 - 200)
    assert clock.time(2**32 - 100, START_S + 0.4) == pytest.approx(START_S + 0.1, abs=1e-3)


def test_a_clock_that_restarts_twice_in_ten_seconds_gives_old_states():
    clock = found()
    assert clock.time(1003, START_S + 9.0) == pytest.approx(START_S + 9.0)
    assert clock.time(3, START_S + 12.0) < START_S + 9.0


def test_a_clock_may_restart_again_after_ten_seconds():
    clock = found()
    clock.time(1003, START_S + 9.0)
    assert clock.time(3, START_S + 20.0) == pytest.approx(START_S + 20.0)
