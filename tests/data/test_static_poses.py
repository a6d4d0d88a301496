"""Rests: where a joint stops depends on the side it came from; half way between is where sag alone
would leave it.
"""

import numpy as np
import pytest
from logs import arm_sequence

from gaponet.data.static_poses import StaticPoses

BOTH = np.array([0, 1])


def staircase(levels: list[float], rows: int = 60) -> np.ndarray:
    """Targets for two joints, (T, 2): a ramp of 20 rows to each level, then a hold."""
    steps = [np.linspace(a, b, 20) for a, b in zip([levels[0], *levels], levels, strict=False)]
    one = np.concatenate([np.concatenate([step, np.full(rows, step[-1])]) for step in steps])
    return np.stack([one, one], axis=1)


def sticking(ctrl: np.ndarray, sag: float, band: float) -> np.ndarray:
    """A state that stops `band` short of target + sag, from whichever side it came."""
    qpos = np.empty_like(ctrl)
    qpos[0] = ctrl[0] + sag
    for t in range(1, len(ctrl)):
        qpos[t] = np.clip(qpos[t - 1], ctrl[t] + sag - band, ctrl[t] + sag + band)
    return qpos


def test_each_hold_counts_once_and_remembers_its_approach(arm):
    ctrl = staircase([0.0, 0.5, 0.2])
    holds = StaticPoses.of(arm_sequence(arm, ctrl, sticking(ctrl, 0.0, 0.03)), BOTH)
    assert holds.ctrl[:, 0].tolist() == pytest.approx([0.0, 0.5, 0.2])
    assert holds.qpos[:, 0].tolist() == pytest.approx([0.0, 0.47, 0.23])
    assert holds.approach[:, 0].tolist() == [0, 1, -1]


def test_a_joint_that_rests_through_two_holds_is_counted_once(arm):
    ctrl = staircase([0.0, 0.5, 0.2])
    ctrl[:, 1] = 0.1
    holds = StaticPoses.of(arm_sequence(arm, ctrl, ctrl), BOTH)
    assert holds.distinct.tolist() == [[True, True], [True, False], [True, False]]


def test_a_joint_that_moved_long_ago_and_others_since_remember_their_approach(arm):
    ctrl = staircase(np.random.default_rng(0).uniform(-1, 1, 60).tolist())
    ctrl[:, 1] = np.where(np.arange(len(ctrl)) < 50, 0.3, -0.1)
    sequence = arm_sequence(arm, ctrl, sticking(ctrl, 0.02, 0.03))
    holds = StaticPoses.of(sequence, BOTH)
    assert len(sequence) > 4000
    rest, near = 0, []
    for t in range(
        len(sequence)
    ):  # row by row, what a hold's joint was doing when it was last away from its rest
        if rest < len(holds) and (np.abs(sequence.ctrl[t] - holds.ctrl[rest]) < 1e-6).all():
            near.append(t)
        elif near:
            away = np.abs(sequence.qpos[: near[-1] + 1] - holds.qpos[rest]) > 0.01
            for joint in range(2):
                last = np.flatnonzero(away[:, joint])
                side = (
                    -np.sign(sequence.qpos[last[-1], joint] - holds.qpos[rest, joint])
                    if len(last)
                    else 0
                )
                assert holds.approach[rest, joint] == side
            rest, near = rest + 1, []
    assert rest >= 55
    assert set(holds.approach[5:, 1].tolist()) == {-1}


def test_a_moving_robot_and_a_recording_shorter_than_two_windows_have_no_hold(arm):
    for ctrl in (np.sin(np.arange(300) * 0.02)[:, None] * np.ones((1, 2)), np.zeros((40, 2))):
        assert len(StaticPoses.of(arm_sequence(arm, ctrl, ctrl), BOTH)) == 0


def test_encoder_noise_of_a_milliradian_is_still_a_hold(arm):
    ctrl = staircase([0.0, 0.5, 0.2])
    noise = 1e-3 * np.random.default_rng(0).normal(size=ctrl.shape)
    assert len(StaticPoses.of(arm_sequence(arm, ctrl, ctrl + noise), BOTH)) == 3


def test_sag_lies_half_way_between_both_approaches(arm):
    levels = [0.0, 0.5, 0.1, 0.6, 0.2, 0.7, 0.0, 0.4, 0.3, 0.5, 0.1]
    ctrl = staircase(levels)
    holds = StaticPoses.of(arm_sequence(arm, ctrl, sticking(ctrl, 0.04, 0.03)), BOTH)
    error = holds.static_error(0)
    assert (error.up, error.down) == (5, 5)
    assert error.middle == pytest.approx(0.04, abs=1e-4)
    assert error.half_band == pytest.approx(0.03, abs=1e-4)


def test_one_side_alone_is_not_balanced(arm):
    ctrl = staircase([0.0, 0.1, 0.2, 0.3, 0.4])
    error = StaticPoses.of(arm_sequence(arm, ctrl, sticking(ctrl, 0.04, 0.03)), BOTH).static_error(
        0
    )
    assert not error.balanced
    assert error.middle == pytest.approx(
        0.01, abs=1e-4
    )  # sag less stiction: what was seen, and no more


def test_no_holds_are_no_error():
    nothing = StaticPoses.joined([], 2)
    assert len(nothing) == 0
    assert np.isnan(nothing.static_error(0).middle)
