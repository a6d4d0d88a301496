"""Payload and unit of recordings that say neither, from held torque at equal commands."""

import numpy as np
import pytest
from estimate_labels import estimate

from gaponet.base.errors import LogError
from gaponet.data.log import Channel, Log

MASSES, UNITS = (0.0, 1.0, 2.0), 2


def windows(lever: float, rng: np.random.Generator, apart: float = 0.7) -> list[tuple[str, Log]]:
    """Two commands, two units and three payloads, each three times, in a random order of threes."""
    made = []
    for end in (0.5, 0.9):
        for unit, own in enumerate((0.0, apart)):
            for mass in MASSES:
                made.append((end, unit, mass, -4.0 - own - lever * (1.0 + end) * mass))
    order, logs = rng.permutation(len(made)), []
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
            logs.append(
                (
                    f"{unit} {mass} {take}",
                    Log("arm", ("elbow",), channels, f"motor{suffix}.npz#{len(logs)}"),
                )
            )
    return logs


def test_payload_and_unit_are_estimated_if_the_payload_loads_the_joint():
    found = estimate(windows(1.5, np.random.default_rng(0)), MASSES, UNITS, {})
    assert [c.determined for c in found.groups] == [True, True]
    assert [c.slope for c in found.groups] == [
        pytest.approx(-2.25, rel=0.1),
        pytest.approx(-2.85, rel=0.1),
    ]
    for r in found.recordings:
        unit, mass, _ = r.name.split()
        assert (r.payload, r.unit) == (
            float(mass),
            int(unit),
        )  # the one that holds more is the later one
    assert (found.agreement.within, found.agreement.taken) == (1.0, 0.0)
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
    time, two = logs[0][1].channels["ctrl"].time, np.tile(logs[0][1].channels["ctrl"].values, 2)
    both = Log(
        "arm", ("elbow", "wrist"), {"ctrl": Channel(time, two), "qpos": Channel(time, two)}, "both"
    )
    with pytest.raises(LogError, match="joints"):
        estimate([("both", both)], MASSES, UNITS, {})


def test_gains_are_estimated_from_torque_of_a_pd_servo_and_from_no_other():
    rng, logs = np.random.default_rng(1), []
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
    found = estimate(logs, MASSES, UNITS, {})
    assert [line.partition(":")[0] for line in found.remarks] == ["elbow"]
    gains, held = found.gains["elbow"]
    assert (gains.kp, gains.kd) == (pytest.approx(40.0, rel=0.02), pytest.approx(1.5, rel=0.1))
    assert held.kp == pytest.approx(40.0, abs=3 * held.error)
    for _, log in logs:  # where torque is something else, nothing is said
        log.channels["tau"] = Channel(
            log.channels["tau"].time, rng.standard_normal((len(log.channels["tau"].time), 1))
        )
    assert not estimate(logs, MASSES, UNITS, {}).remarks
