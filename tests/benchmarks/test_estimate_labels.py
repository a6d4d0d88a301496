"""Payload and unit of recordings that say neither, from held torque at equal commands."""

import numpy as np
import pytest
from estimate_labels import estimate

from gaponet.base.errors import LogError
from gaponet.data.log import Channel, Log

MASSES = (0.0, 1.0, 2.0)
UNITS = 2


def windows(lever: float, rng: np.random.Generator, apart: float = 0.7) -> list[tuple[str, Log]]:
    """Two commands, two units and three payloads, each three times, in a random order of threes."""
    made = []
    for end in (0.5, 0.9):
        for unit, own in enumerate((0.0, apart)):
            for mass in MASSES:
                made.append((end, unit, mass, -4.0 - own - lever * (1.0 + end) * mass))
    order = rng.permutation(len(made))
    logs = []
    for i in order:
        end, unit, mass, torque = made[i]
        for take in range(3):
            time = 0.02 * np.arange(50)
            ctrl = np.linspace(-0.3, end, 50)[:, None]
            tau = torque + 0.1 * rng.standard_normal(50)[:, None] + 0.05 * rng.standard_normal()
            channels = {
                "ctrl": Channel(time, ctrl),
                "qpos": Channel(time, ctrl - 0.1 - 1e-3 * len(logs)),
                "tau": Channel(time, tau),
            }
            suffix = "_0kg" if mass == 0.0 else ""
            source = f"motor{suffix}.npz#{len(logs)}"
            logs.append((f"{unit} {mass} {take}", Log("arm", ("elbow",), channels, source)))
    return logs


def test_payload_and_unit_are_estimated_if_the_payload_loads_the_joint():
    found = estimate(windows(1.5, np.random.default_rng(0)), MASSES, UNITS, {})
    first, second = found.groups
    assert first.determined
    assert second.determined
    assert first.slope == pytest.approx(-2.25, rel=0.1)
    assert second.slope == pytest.approx(-2.85, rel=0.1)
    for r in found.recordings:
        unit, mass, _ = r.name.split()
        assert r.payload == float(mass)
        assert r.unit == int(unit)  # the one that holds more is the later one
    assert found.agreement.within == 1.0
    assert found.agreement.taken == 0.0
    assert (
        "torque alone, without the unit, gives 36 of 36 payloads within 0.5 kg of their label"
        in found.remarks
    )


def test_no_payload_is_estimated_from_a_joint_that_it_does_not_load():
    found = estimate(windows(0.02, np.random.default_rng(0), 0.3), MASSES, UNITS, {})
    assert [c.determined for c in found.groups] == [False, False]
    assert not found.agreement


def test_copies_of_a_recording_are_found_and_two_moving_joints_are_refused():
    logs = windows(1.5, np.random.default_rng(0))
    again = estimate([*logs, ("again", logs[4][1])], MASSES, UNITS, {})
    assert again.recordings[-1].copy_of == logs[4][0]
    time = logs[0][1].channels["ctrl"].time
    two = np.tile(logs[0][1].channels["ctrl"].values, 2)
    both = Log(
        "arm", ("elbow", "wrist"), {"ctrl": Channel(time, two), "qpos": Channel(time, two)}, "both"
    )
    with pytest.raises(LogError, match="joints"):
        estimate([("both", both)], MASSES, UNITS, {})


def held_by_a_pd_servo() -> list[tuple[str, Log]]:
    """Recordings of a servo with kp 40, kd 1.5 and a delay of 20 ms, with noise of its torque."""
    rng = np.random.default_rng(1)
    logs = []
    for i in range(16):
        time = 0.02 * np.arange(60)
        ctrl = np.clip(0.5 + 0.2 * (i % 2) * np.sin(9 * time) - 1.0 + 1.2 * time, -0.5, 0.9)
        qpos = np.interp(time - 0.06, time, ctrl) - 0.02 * (i % 4) - 1e-3 * i
        qvel = np.gradient(qpos, time)
        tau = (
            40.0 * (np.interp(time - 0.02, time, ctrl) - qpos)
            - 1.5 * qvel
            + 0.05 * rng.standard_normal(60)
        )
        state = {"ctrl": ctrl, "qpos": qpos, "qvel": qvel, "tau": tau}
        channels = {c: Channel(time, x[:, None]) for c, x in state.items()}
        logs.append((f"take {i}", Log("arm", ("elbow",), channels, f"motor.npz#{i}")))
    return logs


def test_gains_are_estimated_from_torque_of_a_pd_servo():
    found = estimate(held_by_a_pd_servo(), MASSES, UNITS, {})
    assert [line.partition(":")[0] for line in found.remarks] == ["elbow"]
    gains, held = found.gains["elbow"]
    assert gains.kp == pytest.approx(40.0, rel=0.02)
    assert gains.kd == pytest.approx(1.5, rel=0.1)
    assert held.kp == pytest.approx(40.0, abs=3 * held.error)


def test_no_gains_are_estimated_from_torque_of_something_else():
    rng = np.random.default_rng(2)
    logs = held_by_a_pd_servo()
    for _, log in logs:
        time = log.channels["tau"].time
        log.channels["tau"] = Channel(time, rng.standard_normal((len(time), 1)))
    assert not estimate(logs, MASSES, UNITS, {}).remarks
