"""From what came off the wire to rows at a fixed period."""

from dataclasses import replace

import numpy as np
import pytest
from arm import TOML, write_arm

from gaponet.base.errors import LogError, UsageError
from gaponet.data.log import Channel, Log
from gaponet.data.sequence import Sequence, SequenceMeta, require_same_gains, to_sequence

META = SequenceMeta("arm", "a", "wave", 0.0, source="wave.csv")
ROWS = 50
AHEAD = 0.005  # rad, of the command before the state


def arm_log(time: np.ndarray, ctrl_time: np.ndarray | None = None, **meta: object) -> Log:
    ctrl_time = time if ctrl_time is None else ctrl_time
    both = lambda t: np.stack([t, 2 * t], axis=1)  # noqa: E731
    channels = {
        "ctrl": Channel(ctrl_time, AHEAD + both(ctrl_time)),
        "qpos": Channel(time, both(time)),
    }
    return Log("arm", ("shoulder", "elbow"), channels, "wave.csv", dict(meta))


def test_even_rows_are_kept_as_recorded_at_their_own_rate(arm):
    time = 0.02006 * np.arange(ROWS) + 1e-4 * np.sin(np.arange(ROWS))
    sequence = to_sequence(arm_log(time), arm, META)
    assert sequence.meta.notes["rows"] == "as recorded"
    assert sequence.dt == pytest.approx(0.02006, abs=2e-5)
    assert len(sequence) == ROWS
    assert np.array_equal(sequence.qpos[:, 0], time.astype(np.float32))


def test_a_missing_sample_puts_the_log_on_a_grid(arm):
    time = np.delete(0.02 * np.arange(ROWS), 20)
    sequence = to_sequence(arm_log(time), arm, META)
    assert (
        sequence.meta.notes["rows"] == "resampled to 50.00 Hz: commands held, states interpolated"
    )
    assert sequence.meta.notes["longest_gap_ms"] == pytest.approx(40)
    assert len(sequence) == ROWS
    assert sequence.qpos[20, 0] == pytest.approx(0.4)  # on the line between its neighbours
    assert sequence.ctrl[20, 0] == pytest.approx(AHEAD + 0.38)  # the command of row 19 still stands


def test_commands_and_states_on_different_clocks_meet_where_they_overlap(arm):
    time = 0.02 * np.arange(ROWS)
    sequence = to_sequence(arm_log(time, ctrl_time=time + 0.25), arm, META)
    assert sequence.qpos[0, 0] == pytest.approx(0.25)
    assert len(sequence) == 37  # (0.98 − 0.25) / 0.02 periods and the first row


def test_channels_that_do_not_overlap_are_refused(arm):
    time = 0.02 * np.arange(ROWS)
    with pytest.raises(LogError, match="overlap"):
        to_sequence(arm_log(time, ctrl_time=time + 10), arm, META)


JUMPED = np.r_[
    0.02 * np.arange(25), 3600 + 0.02 * np.arange(25)
]  # an hour, twice the samples of a second
BURSTS = (
    0.1 * np.arange(10)[:, None] + 2e-4 * np.arange(5)
).ravel()  # five samples at once, ten times a second


@pytest.mark.parametrize(
    ("time", "complaint"),
    [
        (JUMPED, r"wave\.csv:26: 3600"),
        (BURSTS, "bursts"),
        (2e-8 * np.arange(ROWS), "2e-08"),
        (5.0 * np.arange(ROWS), "period is 5"),
        (np.r_[0.02 * np.arange(49), 1e13], r"wave\.csv:50:"),
    ],
    ids=["clock jumps an hour", "bursts", "seconds read as microseconds", "too slow", "633 GiB"],
)
def test_a_clock_that_cannot_be_right_is_refused_before_rows_are_made(arm, time, complaint):
    with pytest.raises(LogError, match=complaint):
        to_sequence(arm_log(time), arm, META)


def test_half_a_second_without_samples_is_still_filled(arm):
    time = np.delete(0.02 * np.arange(100), slice(40, 65))
    assert len(to_sequence(arm_log(time), arm, META)) == 100


def test_a_stated_period_that_the_timestamps_contradict_is_refused(arm):
    with pytest.raises(
        LogError,
        match=r"0\.02",
    ):
        to_sequence(arm_log(0.02 * np.arange(ROWS), dt=1 / 30), arm, META)


def test_joints_go_into_the_robots_order_and_absent_ones_stand_at_home(arm):
    log = arm_log(0.02 * np.arange(ROWS))
    one = Log(
        "arm",
        ("elbow",),
        {k: Channel(c.time, c.values[:, 1:]) for k, c in log.channels.items()},
        "wave.csv",
    )
    sequence = to_sequence(one, arm, META)
    assert sequence.joint_names == ("shoulder", "elbow")
    assert not sequence.qpos[:, 0].any()
    assert sequence.qpos[10, 1] == pytest.approx(0.4)
    assert sequence.meta.notes["held_at_home"] == ["shoulder"]


def test_velocity_is_computed_where_the_log_has_none(arm):
    sequence = to_sequence(arm_log(0.02 * np.arange(ROWS)), arm, META)
    assert np.allclose(sequence.qvel, [1.0, 2.0], atol=1e-4)
    assert sequence.meta.notes["qvel"] == "central differences of qpos"


def test_velocity_of_a_joint_logged_as_a_fraction_is_computed_too(arm):
    log = arm_log(0.02 * np.arange(ROWS), converted_from={"elbow": "fraction"})
    log.channels["qvel"] = Channel(log.channels["qpos"].time, np.full((ROWS, 2), 7.0))
    assert np.allclose(to_sequence(log, arm, META).qvel, [7.0, 2.0], atol=1e-4)


@pytest.mark.parametrize(
    ("field", "value", "message"),
    [
        *(("payload_mass", mass, "payload_mass") for mass in (-0.1, np.nan, 1000.0)),
        ("level", "legs", "'legs'"),
    ],
)
def test_labels_that_make_no_sense_are_refused(field, value, message):
    with pytest.raises(LogError, match=message):
        replace(META, **{field: value})


def test_samples_that_are_not_numbers_are_refused(arm):
    bad = np.full((5, 2), np.nan)
    with pytest.raises(LogError, match="ctrl"):
        Sequence(META, arm.joint_names, 0.02, bad, bad, bad)


def test_identity_is_samples_unit_and_payload_and_not_the_name(arm):
    sequence = to_sequence(arm_log(0.02 * np.arange(ROWS)), arm, META)
    assert (
        replace(sequence, meta=replace(META, motion="other")).content_hash()
        == sequence.content_hash()
    )
    assert (
        replace(sequence, meta=replace(META, payload_mass=1.0)).content_hash()
        != sequence.content_hash()
    )
    assert replace(sequence, qpos=sequence.qpos + 0.001).content_hash() != sequence.content_hash()


def test_a_recording_keeps_the_gains_that_are_stated_else_the_logs_else_the_robots(arm):
    time = 0.02 * np.arange(ROWS)
    robots = to_sequence(arm_log(time), arm, META).meta
    assert (robots.kp, robots.notes["gains"]) == (tuple(arm.servo.kp), "of robot.toml")
    logged = to_sequence(arm_log(time, kp=[7, 8], kd=[0.5, 0.6]), arm, META).meta
    assert (logged.kp, logged.kd, logged.notes["gains"]) == ((7.0, 8.0), (0.5, 0.6), "as recorded")
    stated = to_sequence(arm_log(time, kp=[7, 8]), arm, replace(META, kp=(9.0, 9.5))).meta
    assert (stated.kp, stated.notes["gains"]) == ((9.0, 9.5), "kp as stated, kd of robot.toml")


@pytest.mark.parametrize("kp", [(1.0, np.nan), (1.0, -2.0), ("stiff", 2.0), (1.0,)])
def test_gains_that_are_none_are_refused(arm, kp):
    with pytest.raises(LogError, match="kp"):
        to_sequence(arm_log(0.02 * np.arange(ROWS)), arm, replace(META, kp=kp))


def test_recordings_with_different_gains_are_not_taken_together_unless_they_do_not_say():
    soft, stiff = (
        replace(META, kp=(5.0, 5.0)),
        replace(META, kp=(5.0, 10.0), motion="stiff", unit_id="b"),
    )
    joints = ("shoulder", "elbow")
    require_same_gains([soft, META, replace(soft, kp=(5.0, 5.0 * (1 + 1e-5)))], joints, joints)
    require_same_gains([soft, stiff], joints, ("shoulder",))
    with pytest.raises(UsageError, match="--mixed-gains"):
        require_same_gains([soft, stiff], joints, joints)


@pytest.mark.parametrize("short", [0.0, 0.0008, 0.0019])
def test_time_is_never_stretched(arm, short):
    """Two in three periods are 20 ms, one is a little shorter: the median is no clock."""
    time = np.concatenate([[0.0], np.cumsum(np.where(np.arange(1499) % 3, 0.02, 0.02 - short))])
    truth = lambda t: np.stack([np.sin(t), np.cos(2 * t)], axis=1)  # noqa: E731
    log = Log(
        "arm", ("shoulder", "elbow"), {n: Channel(time, truth(time)) for n in ("ctrl", "qpos")}, "x"
    )
    sequence = to_sequence(log, arm, SequenceMeta("arm", "a", "m", 0.0))
    rows = sequence.dt * np.arange(len(sequence))
    assert rows[-1] == pytest.approx(time[-1], abs=sequence.dt)
    assert (
        np.abs(sequence.qpos - truth(rows)).max() < 0.5 * sequence.dt * 2 + 1e-3
    )  # half a period at 2 rad/s
    assert sequence.dt == pytest.approx(0.02 - short / 3 if short else 0.02, abs=2e-5)


@pytest.mark.parametrize("lost", [0, 15])
def test_rows_that_a_loop_stamps_unevenly_are_of_its_periods(arm, lost):
    """Each row's command is of the period that the row is nearest to, whatever the stamps' jitter
    and lost rows.
    """
    rng, period = np.random.default_rng(lost), 1 / 30
    stamp = 7.0 + period * (np.arange(600) + np.clip(rng.normal(0, 0.15, 600), -0.3, 0.3))
    kept = np.sort(np.r_[0, rng.permutation(np.arange(1, 600))[: 599 - lost]])
    sent = np.stack([np.arange(600.0), np.arange(600.0)], axis=1)[kept]
    log = arm_log(stamp[kept])
    log.channels["ctrl"] = Channel(stamp[kept], sent)
    sequence = to_sequence(log, arm, META)
    assert sequence.dt == pytest.approx(period, rel=3e-4)
    rows = np.arange(len(sequence))
    late = rows - sequence.ctrl[:, 0]
    assert np.array_equal(late[np.isin(rows, kept)], np.zeros(len(kept)))
    assert sequence.qpos[:, 0] == pytest.approx(7.0 + period * rows, abs=5e-3)


def test_rows_without_a_period_begin_where_they_begin(arm):
    time = np.cumsum(np.random.default_rng(0).exponential(0.02, 400))
    sequence = to_sequence(arm_log(time), arm, META)
    assert sequence.qpos[0, 0] == pytest.approx(time[0], rel=1e-6)


@pytest.mark.parametrize("field", ["unit_id", "motion"])
def test_a_recording_without_a_name_of_its_unit_or_motion_is_refused(field):
    with pytest.raises(LogError, match="named"):
        replace(META, **{field: ""})


@pytest.mark.parametrize("dt", [5e-5, 1.5, np.nan])
def test_a_period_that_no_controller_has_is_refused(arm, dt):
    zeros = np.zeros((5, 2))
    with pytest.raises(LogError, match="dt"):
        Sequence(META, arm.joint_names, dt, zeros, zeros, zeros)


def test_even_rows_that_drift_off_their_stated_period_are_put_on_a_grid(arm):
    """200 rows of 20.2 ms, said to be 20 ms apart: the last is two periods off."""
    time = 0.0202 * np.arange(200)
    sequence = to_sequence(arm_log(time, dt=0.02), arm, META)
    assert "fits" in sequence.meta.notes["why_resampled"]
    assert sequence.dt * (len(sequence) - 1) == pytest.approx(time[-1], abs=sequence.dt)
    assert sequence.qpos[-1, 0] == pytest.approx(time[-1], abs=sequence.dt)


def test_a_loop_whose_period_has_no_few_digits_keeps_all_of_them(arm):
    """5000 rows of a 30th of a second, unevenly stamped: at 33.33 ms the last would be half a
    period late.
    """
    rng = np.random.default_rng(0)
    time = (np.arange(5000) + np.clip(rng.normal(0, 0.15, 5000), -0.3, 0.3)) / 30
    sequence = to_sequence(arm_log(time), arm, META)
    assert sequence.dt == pytest.approx(1 / 30, rel=1e-5)
    assert sequence.dt != round(sequence.dt, 5)


def test_a_mimic_joint_that_a_log_lacks_follows_its_leader(tmp_path):
    """The elbow turns by −½ of the shoulder, from 0.3 rad."""
    led = 'name = "elbow"\nfollows = "shoulder"\nratio = -0.5\nat_zero = 0.3\noperated = false\n'
    arm = write_arm(tmp_path / "arm", TOML.replace('name = "elbow"\n', led))
    log = arm_log(0.02 * np.arange(ROWS))
    channels = {name: Channel(c.time, c.values[:, :1]) for name, c in log.channels.items()}
    sequence = to_sequence(Log("arm", ("shoulder",), channels, "wave.csv"), arm, META)
    assert np.allclose(sequence.qpos[:, 1], 0.3 - 0.5 * sequence.qpos[:, 0])
    assert np.allclose(sequence.qvel[:, 1], -0.5 * sequence.qvel[:, 0])
    assert "held_at_home" not in sequence.meta.notes
