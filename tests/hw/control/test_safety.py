"""Limits hold for every state and target, have the promised values, and every check of states
gives its reason.
"""

from importlib import import_module

import numpy as np
import pytest

from gaponet.base.errors import UsageError
from gaponet.hw.control.driver import State
from gaponet.hw.control.safety import (
    FAULT_KINDS,
    Limits,
    SafetyConfig,
    StateMonitor,
    damping_gains,
    limit_command,
    limit_delta,
)
from gaponet.robot.spec import RobotSpec

DT = 0.02
MILLION = 1_000_000
DEFAULTS = {  # of docs/deploy-safety.md, which is changed with them
    "margin": 0.02,
    "speed": 5.0,
    "torque_share": 0.95,
    "acceleration": 50.0,
    "delta": 0.5,
    "delta_rate": 2.0,
    "stale": 2.0,
    "frozen": 2,
    "frozen_travel": 0.3,
    "frozen_joint": 0.1,
    "joint_speed": 12.0,
    "jump": 0.05,
    "temperature": 85.0,
    "tilt": 0.7,
    "tracking": 0.6,
    "tracking_time": 0.25,
    "following": 0.25,
    "overrun": 2.0,
    "refused": 20,
}
CONSTANTS = {
    "control.output": {
        "MAX_BEYOND_RANGE_RAD": 0.05,
        "MAX_SEND_DELAY_S": 0.001,
        "MAX_SUSPENDED_S": 0.05,
    },
    "control.target": {
        "MIN_GOOD_STATES": 5,
        "MAX_WAIT_S": 5.0,
        "SEARCH_SHARE": 0.3,
        "MAX_UNPROVEN_WEIGHT": 0.3,
        "FAR_RAD": 0.4,
    },
    "control.following": {
        "STRIDE_RAD": 0.05,
        "MAX_UNFOLLOWED_RAD": 0.25,
        "MIN_PUSH_SHARE": 0.5,
        "MIN_LOAD_SHARE": 0.5,
    },
    "control.plan": {
        "MAX_START_DRIFT_RAD": 0.02,
        "MAX_APPROACH_M": 0.001,
        "MAX_START_OVERLAP_M": 0.03,
        "APPROACH_TIME_S": 0.1,
        "MAX_SAG_M": 0.05,
        "COMMAND_CLEARANCE_SHARE": 0.5,
    },
    "control.hardware": {
        "MAX_OFFSET_RAD": 0.1,
        "KP_RATIO_BOUNDS": (0.25, 4.0),
        "MAX_KP": 300.0,
        "MAX_KD": 10.0,
        "MAX_BEYOND_RANGE_RAD": 0.051,
    },
    "control.watchdog": {"MAX_RETRY_S": 600.0},
    "targets.message": {"MAX_MESSAGE_BYTES": 1 << 14},
    "targets.accepted_target": {
        "MAX_BEYOND_RANGE_RAD": 0.2,
        "MAX_CATCH_UP_PERIODS": 5,
    },
}


def test_limits_have_the_values_that_are_promised():
    assert vars(SafetyConfig()) == DEFAULTS
    for module, constants in CONSTANTS.items():
        found = vars(import_module(f"gaponet.hw.{module}"))
        assert {name: found[name] for name in constants} == constants


@pytest.fixture
def limits(arm: RobotSpec) -> Limits:
    return Limits.from_robot(arm, arm.joint_names, SafetyConfig())


def drawn(rng: np.random.Generator, scale: float, rows: int) -> np.ndarray:
    """Mostly of a sensible size, some enormous, some not numbers."""
    values = (
        scale
        * rng.standard_normal((rows, 2))
        * rng.choice([0.1, 1.0, 30.0], (rows, 1), p=[0.45, 0.45, 0.1])
    )
    values[rng.random((rows, 2)) < 1e-3] = rng.choice([np.nan, np.inf, -np.inf, 1e300])
    return values


def test_no_command_ever_leaves_range_rate_or_torque(arm):
    rng = np.random.default_rng(0)
    gains = np.array([20.0, 3.0]), np.array([0.0, 1.5])
    limits = Limits.from_robot(arm, arm.joint_names, SafetyConfig(), gains=gains)
    for _ in range(4):
        rows = MILLION // 4
        target, previous, qpos, qvel = (drawn(rng, s, rows) for s in (2.0, 1.5, 1.5, 3.0))
        age = 0.04 * rng.random((rows, 1)) ** 2
        out = limit_command(target, previous, qpos, qvel, DT, limits, age)
        sent = out.feasible.all(axis=1)
        u = out.ctrl[sent]
        q = qpos[sent]
        v = qvel[sent]
        assert 0.1 < sent.mean() < 0.99
        assert (u >= limits.low).all()
        assert (u <= limits.high).all()
        before = np.clip(previous[sent], limits.low, limits.high)
        assert (np.abs(u - before) <= limits.speed * DT).all()
        assert (np.abs(limits.kp * (u - q) - limits.kd * v) <= limits.effort).all()
        # Where the joint really is by then, after any acceleration up to the stated one.
        pushed = limits.acceleration * rng.uniform(-1, 1, v.shape).round(rng.integers(3))
        q = q + v * age[sent] + pushed * age[sent] ** 2 / 2
        v = v + pushed * age[sent]
        assert (np.abs(limits.kp * (u - q) - limits.kd * v) <= limits.effort * (1 + 1e-9)).all()


def test_a_command_is_refused_only_where_the_three_intervals_do_not_meet(limits):
    rng = np.random.default_rng(1)
    target, previous, qpos = (s * rng.standard_normal((3000, 2)) for s in (1.0, 0.8, 0.8))
    qvel = rng.standard_normal(qpos.shape)
    out = limit_command(target, previous, qpos, qvel, DT, limits)
    # Try commands all over the range-and-rate interval.
    grid = np.linspace(0, 1, 401)[:, None, None]
    before = np.clip(previous, limits.low, limits.high)
    low = np.maximum(limits.low, before - 0.1)
    high = np.minimum(limits.high, before + 0.1)
    for part in np.array_split(np.arange(len(qpos)), 6):
        u = low[part] + grid * (high - low)[part]
        possible = (
            np.abs(limits.kp * (u - qpos[part]) - limits.kd * qvel[part]) <= limits.effort
        ).any(axis=0)
        assert not (possible & ~out.feasible[part]).any()


def test_identified_gains_are_not_those_of_the_real_servo(arm):
    identified = arm.with_identified({"elbow": {"kp": 3.0}})
    assert Limits.from_robot(identified, arm.joint_names, SafetyConfig()).kp.tolist() == [
        20.0,
        20.0,
    ]


def test_a_harmless_command_passes_unchanged(limits):
    q = np.array([0.2, -0.3])
    out = limit_command(q + 0.05, q, q, np.zeros(2), DT, limits)
    np.testing.assert_array_equal(out.ctrl, q + 0.05)


def test_a_joint_pushed_away_faster_than_the_rate_leaves_no_command(limits):
    # kp 20, 0.95 · 5 N·m: the torque interval is q ± 0.2375; the rate interval is 0 ± 0.1
    assert limit_command(
        *np.zeros((2, 2)), np.array([0.33, 0.0]), np.zeros(2), DT, limits
    ).feasible.all()
    assert not limit_command(
        *np.zeros((2, 2)), np.array([0.34, 0.0]), np.zeros(2), DT, limits
    ).feasible[0]


def test_nan_is_never_sent(limits):
    q = np.zeros(2)
    nan = np.array([np.nan, 0.0])
    for arguments in ((nan, q, q, q), (q, nan, q, q), (q, q, nan, q), (q, q, q, nan)):
        assert not limit_command(*arguments, DT, limits).feasible[0]


def test_a_correction_is_bounded_in_size_and_rate(limits):
    first = limit_delta(np.array([1.0, -1.0]), np.zeros(2), DT, limits)
    np.testing.assert_allclose(first, [0.04, -0.04])
    delta = first
    for _ in range(20):
        delta = limit_delta(np.array([1.0, np.nan]), delta, DT, limits)
    np.testing.assert_allclose(delta, [0.5, -0.04])


def test_damping_stays_within_the_effort_limit_at_every_speed_that_is_believed():
    kd = damping_gains(np.full(3, 8.0), np.array([1.0, 100.0, np.nan]), np.full(3, 20.0))
    np.testing.assert_allclose(kd, [8.0, 20.0 / 12.0, 8.0])  # 100 rad/s is a wrong reading


def test_limits_that_leave_nothing_or_more_than_there_is_are_refused(arm):
    with pytest.raises(UsageError, match="torque_share"):
        SafetyConfig(torque_share=1.5)
    with pytest.raises(UsageError, match="tilt"):
        SafetyConfig(tilt=40)
    with pytest.raises(UsageError, match="jump"):
        SafetyConfig(jump=1000)
    with pytest.raises(UsageError, match="tracking_time"):
        SafetyConfig(tracking_time=250)
    with pytest.raises(UsageError, match="shoulder"):
        Limits.from_robot(arm, arm.joint_names, SafetyConfig(margin=2.0))


def watched(change: dict[str, object], noisy: bool = True, periods: int = 80) -> tuple[str, int]:
    """Kind of the first fault and its period, of a state that moves gently until period 10 and is
    then changed.
    """
    rng = np.random.default_rng(0)
    watch = StateMonitor(("shoulder", "elbow"), np.arange(2), DT, SafetyConfig(), noisy)
    good = None
    for k in range(periods):
        now = k * DT
        wrong = k >= 10
        fields = {
            "time": now,
            "qpos": 0.01 * k + 1e-4 * rng.standard_normal(2),
            "qvel": 0.5 + 1e-2 * rng.standard_normal(2),
            "tau": rng.standard_normal(2),
            "temperature": np.full(2, 40.0),
        }
        ctrl = np.full(2, 0.01 * k)
        if wrong:
            fields |= {
                n: v(k, fields, good) if callable(v) else v
                for n, v in change.items()
                if n != "late"
            }
        else:
            good = fields
        fault = watch.check(now, State(**fields), ctrl, change.get("late", 0.0) if wrong else 0.0)
        if fault:
            assert fault.kind in FAULT_KINDS
            return fault.kind, k
    return "none", periods


def keep(name):
    return lambda k, fields, good: good[name]


@pytest.mark.parametrize(
    ("change", "kind", "period"),
    [
        ({}, "none", 80),
        ({name: keep(name) for name in ("time", "qpos", "qvel", "tau")}, "stale", 12),
        ({"time": lambda k, *_: k * DT - 0.05}, "stale", 10),  # late packets: they come, but old
        ({name: keep(name) for name in ("qpos", "qvel", "tau")}, "frozen", 11),
        ({"qvel": np.array([np.nan, 0.0])}, "nan", 10),
        ({"qpos": lambda k, f, _: f["qpos"] + [0.4, 0.0]}, "jump", 10),
        ({"temperature": np.array([40.0, 90.0])}, "temperature", 10),
        ({"temperature": np.full(2, np.nan)}, "none", 80),
        ({"qpos": lambda k, f, _: f["qpos"] - 0.051 * np.minimum(k - 9, 16)}, "tracking", 33),
        ({"refused": lambda k, *_: 3 * (k - 9)}, "checksum", 16),
        ({"refused": lambda k, *_: (k - 9) // 3}, "none", 80),  # seventeen a second
        ({"late": 0.041}, "overrun", 10),
        ({"late": 0.039}, "none", 80),
        ({"tilt": 0.71}, "tilt", 10),
        ({"tilt": 0.69}, "none", 80),
        ({"tilt": np.nan}, "tilt", 10),  # an IMU that gives no attitude
    ],
)
def test_each_watchdog_speaks_in_time(change, kind, period):
    assert watched(change) == (kind, period)


def test_a_coarse_encoder_may_rest_but_not_while_the_command_moves_on():
    change = {name: keep(name) for name in ("qpos", "qvel", "tau")}
    kind, period = watched(change, noisy=False)
    assert kind == "frozen"
    assert period in (39, 40)  # 0.3 rad at 0.01 rad a period


def test_where_the_real_joints_end_earlier_commands_do(arm):
    real = np.array([[-0.5, 9.0], [-9.0, 0.4]])
    limits = Limits.from_robot(arm, arm.joint_names, SafetyConfig(margin=0.1), qpos_range=real)
    mjcf = arm.qpos_range
    np.testing.assert_allclose(limits.low, [-0.4, mjcf[1, 0] + 0.1])
    np.testing.assert_allclose(limits.high, [mjcf[0, 1] - 0.1, 0.3])


def test_a_joint_that_comes_nearer_between_slow_readings_is_tracked():
    """At 4 Hz each command is reached before the next reading, which sees the joint stand."""
    period = 0.25
    monitor = StateMonitor(("elbow",), np.array([0]), period, SafetyConfig())
    faults = []
    for k in range(8):
        qpos = np.array([0.1 * k])
        state = State(k * period, qpos, np.zeros(1), np.full(1, 0.1 * k), np.full(1, 30.0), 0)
        requested = qpos + 0.75
        faults.append(monitor.check(k * period, state, qpos + 0.1, requested=requested))
    assert faults == [None] * 8
