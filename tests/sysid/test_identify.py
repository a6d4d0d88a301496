"""Identification finds the servo that made the recordings."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from arm import TOML, commands, record, recordings, write_arm

from gaponet.base.errors import UsageError
from gaponet.base.progress import no_progress
from gaponet.robot.spec import load_robot
from gaponet.sim.metrics import Comparison
from gaponet.sim.replay import motion_errors
from gaponet.sysid.acceptance import Judge, cross_validation
from gaponet.sysid.axes import Bounds
from gaponet.sysid.identify import identify
from gaponet.sysid.motion_limits import with_stops
from gaponet.sysid.options import IdentifyOptions
from gaponet.sysid.problem import KinematicChains
from gaponet.sysid.robot_rollouts import cut
from gaponet.sysid.search_progress import (
    FIRST_ROBOT_ITERATIONS,
    ROBOT_ITERATIONS,
    SearchProgress,
)
from gaponet.sysid.standard_errors import contradicted_gains
from gaponet.sysid.steps.classic import robot_candidates
from gaponet.sysid.steps.step import Fits


@pytest.fixture(scope="module")
def found(tmp_path_factory):
    """A file that claims twice the damping that the servo has, as kd."""
    sequences = recordings(write_arm(tmp_path_factory.mktemp("real")), 4, rows=160, kp=0.6, delay=2)
    robot = write_arm(
        tmp_path_factory.mktemp("arm"), TOML.replace("kp = 20.0", "kp = 20.0\nkd = 0.5")
    )
    return robot, identify(sequences, robot, options=IdentifyOptions(windows=4))


def test_gain_and_delay_are_found(found):
    robot, fit = found
    np.testing.assert_allclose(fit.robot.servo.kp, 0.6 * robot.servo.kp, rtol=0.03)
    np.testing.assert_allclose(fit.robot.servo.delay, 0.04, atol=0.004)
    np.testing.assert_allclose(fit.robot.servo.offset, 0.0, atol=0.002)
    assert fit.after < 0.05 * fit.before


def test_damping_below_zero_is_fitted_if_no_recording_states_kd_and_the_nominal_kd_stays(found):
    robot, fit = found
    damping = np.nan_to_num(fit.robot.servo.damping)
    np.testing.assert_allclose(fit.robot.servo.kd + damping, 0.5, rtol=0.05)
    np.testing.assert_array_equal(fit.robot.nominal.servo.kd, robot.servo.kd)
    assert fit.improved


def test_recordings_of_the_nominal_robot_change_nothing(tmp_path):
    robot = write_arm(tmp_path)
    fit = identify(recordings(robot, 3, rows=80), robot, options=IdentifyOptions(windows=3))
    assert fit.robot is robot
    assert not fit.improved


def test_a_joint_that_never_moves_is_reported_as_undetermined(tmp_path):
    robot = write_arm(tmp_path)
    still = [replace(s, ctrl=np.zeros_like(s.ctrl)) for s in recordings(robot, 2, rows=100)]
    still = [replace(s, qpos=np.zeros_like(s.qpos), qvel=np.zeros_like(s.qvel)) for s in still]
    fit = identify(still, robot, options=IdentifyOptions(windows=2))
    assert any("not determined" in text for text in fit.warnings)


STRIBECK = {"stribeck": 0.05, "stribeck_speed": 0.1}


@pytest.mark.parametrize("terms", [STRIBECK, {"friction_per_kelvin": -0.01}], ids=min)
def test_terms_of_the_robot_are_part_of_the_start(tmp_path, terms):
    robot = write_arm(tmp_path)
    given = robot.with_identified(dict.fromkeys(robot.operated, terms))
    start = Bounds(given, recordings(robot, 1)).start
    for field, value in terms.items():
        np.testing.assert_array_equal(start[field], [value, value])


def test_a_term_that_the_robot_has_and_the_recordings_lack_is_fitted_away(tmp_path):
    robot = write_arm(tmp_path)
    given = robot.with_identified(dict.fromkeys(robot.operated, STRIBECK))
    options = IdentifyOptions(windows=2, terms=(), seconds=1e-6)
    fit = identify(recordings(robot, 3, rows=100), given, options=options)
    assert fit.robot.servo.stribeck.max() < 0.5 * STRIBECK["stribeck"]


def test_no_term_is_tried_after_the_time_limit(tmp_path):
    robot = write_arm(tmp_path)
    fit = identify(
        recordings(robot, 3, rows=100),
        robot,
        options=IdentifyOptions(windows=2, terms=("stribeck", "load"), seconds=1e-6),
    )
    assert fit.comparisons == ()
    assert any("the time was over before stribeck, load" in w for w in fit.warnings)


def test_windows_cover_all_recordings(tmp_path):
    robot = write_arm(tmp_path)
    sequences = recordings(robot, 5, rows=900)
    parts = cut(sequences, 5)
    assert len(parts) == 5
    assert {p.meta.motion for p in parts} == {s.meta.motion for s in sequences}
    with pytest.raises(UsageError, match="--windows"):
        cut(sequences, 0)
    with pytest.raises(UsageError, match="longer"):
        identify([s.rows(slice(0, 20)) for s in sequences], robot)


def test_windows_are_of_all_payloads_and_of_different_motions(tmp_path):
    """Four payloads of one motion are stored after the other: every fourth would have one."""
    robot = write_arm(tmp_path)
    sequences = []
    for s in recordings(robot, 10, rows=900):
        for kg in (0.0, 0.1, 0.2, 0.3):
            sequences.append(replace(s, meta=replace(s.meta, payload_mass=kg)))
    parts = cut(sequences, 10)
    payloads = [part.meta.payload_mass for part in parts]
    assert len(parts) == 10
    assert min(payloads.count(kg) for kg in (0.0, 0.1, 0.2, 0.3)) >= 2
    assert len({part.meta.motion for part in parts}) >= 7


def test_a_joint_behind_one_command_has_no_stop_and_one_behind_several_has(tmp_path):
    robot = write_arm(tmp_path)
    s = recordings(robot, 1, rows=200)[0]
    ctrl = np.zeros_like(s.ctrl)
    ctrl[:, 0] = 0.8 * (1 - np.cos(np.linspace(0, 4 * np.pi, len(ctrl)))) / 2  # against it twice
    ctrl[100:, 1] = 0.5
    qpos = np.minimum(ctrl, 0.3)
    found = with_stops(robot, [replace(s, ctrl=ctrl, qpos=qpos.astype(s.qpos.dtype))])
    assert found.qpos_range[0, 1] == pytest.approx(0.3, abs=1e-3)
    np.testing.assert_array_equal(found.qpos_range[1], robot.qpos_range[1])


def test_a_soft_joint_that_sticks_has_no_stop(tmp_path):
    robot = write_arm(tmp_path)
    s = recordings(robot, 1, rows=400)[0]
    ctrl = np.zeros_like(s.ctrl)
    ctrl[:, 0] = 0.9 * np.sin(np.linspace(0, 6 * np.pi, len(ctrl)))
    qpos = np.zeros_like(ctrl)
    # A spring to the command that is as soft as friction is strong: 0.4 rad of play.
    for t in range(1, len(ctrl)):
        qpos[t, 0] = np.clip(qpos[t - 1, 0], ctrl[t, 0] - 0.4, ctrl[t, 0] + 0.4)
    pressed = (ctrl[:, 0] > qpos[:, 0].max() + 0.1) & (qpos[:, 0] > qpos[:, 0].max() - 0.005)
    assert pressed.sum() >= 50  # as long as against a stop
    found = with_stops(robot, [replace(s, ctrl=ctrl, qpos=qpos.astype(s.qpos.dtype))])
    assert found.qpos_range[0, 1] == 1.5


def test_packing_by_kinematic_chain_is_undone():
    limbs = KinematicChains(load_robot("so101"))
    assert limbs.joints.tolist() == [[0, 1, 2, 3, 4]]
    limbs.joints = np.array([[0, 2, 4], [1, 3, -1]])  # of two limbs, one shorter
    x = np.arange(30.0).reshape(2, 5, 3)
    assert limbs.pack(x).shape == (2, 2, 9)
    np.testing.assert_array_equal(limbs.unpack(limbs.pack(x)), x)


def test_cross_validation_ignores_one_short_motion_without_information(tmp_path):
    robot = write_arm(tmp_path)
    logs = recordings(robot, 4, rows=100, kp=0.6)
    still = [record(robot, commands(10, 4), "still", kp=1.0)]
    options = IdentifyOptions(windows=4, terms=(), table=False, joints_alone=True, folds=1)
    alone = identify(logs, robot, still, options=options)
    folds = identify(logs, robot, still, options=replace(options, folds=2))
    assert alone.chosen == "given"
    assert folds.chosen != "given"


def motions(sequences):
    """The motion of each sequence."""
    return [s.meta.motion for s in sequences]


@pytest.fixture
def logs(arm):
    """Of five motions; the last one moves the shoulder alone."""
    made = recordings(arm, 5)
    meta = replace(made[4].meta, notes={"held_at_home": ("elbow",)})
    made[4] = replace(made[4], meta=meta)
    return made


def test_folds_share_no_motion(logs):
    folds = cross_validation(logs[:3], logs[3:], 3)
    held_out = []
    for train, out in folds:
        assert not set(motions(train)) & set(motions(out))
        held_out += motions(out)
    assert sorted(held_out) == sorted(motions(logs[:4]))


def test_a_set_of_joints_with_one_motion_is_always_fitted(logs):
    for train, _ in cross_validation(logs[:3], logs[3:], 3):
        assert logs[4] in train


def test_three_validation_motions_need_no_folds(logs):
    assert cross_validation(logs[:1], logs[1:4], 3) == [(logs[:1], logs[1:4])]


@pytest.mark.parametrize(
    ("falls", "accepted"),
    [
        ((0.09,), False),  # of one motion, of an error of 1
        ((0.12,), True),
        ((0.005,) * 12, False),  # sure, and nothing
        ((0.01, 0.05), False),  # two that disagree so much say little
        ((0.03, 0.04), True),
        ((0.9, 0.95), True),
        ((0.3, -0.05, 0.05, 0.02, 0.01, 0.06), True),
        ((0.3, -0.2, 0.05, 0.02, -0.1, 0.06), False),
    ],
)
def test_a_candidate_is_accepted_if_the_gain_is_significant_and_large_enough(falls, accepted):
    before = np.arange(len(falls)) ** 2 + 1.0  # some motions are followed worse than others by far
    assert Comparison("load", before, before * (1 - np.array(falls))).accepted is accepted


def test_repetitions_and_gains_of_one_motion_judge_as_one(tmp_path):
    robot = write_arm(tmp_path)
    logs = recordings(load_robot(tmp_path))[:3]
    again = [*logs, replace(logs[0], meta=replace(logs[0].meta, repetition=1, kp=(18.0, 18.0)))]
    values = Bounds(robot, logs).first
    once = Judge([logs], robot, -np.inf, 1).errors([values])
    twice = Judge([again], robot, -np.inf, 1).errors([values])
    assert len(once) == len(twice) == 3
    np.testing.assert_allclose(twice[1:], once[1:])


def test_a_joint_that_is_lost_in_the_fit_to_all_recordings_has_the_values_of_a_fold(arm):
    logs = recordings(arm, 4)
    judge = Judge([logs[:2], logs[2:]], arm, -np.inf, 1)
    right = Bounds(arm, logs).first
    friction = np.array([right["frictionloss"][0], 1e3])  # holds the elbow wherever it is
    lost = right | {"frictionloss": friction}

    *folds, last = judge.without_lost_joints([right, right, lost])
    assert folds == [right, right]
    np.testing.assert_array_equal(last["frictionloss"], right["frictionloss"])


def test_a_fit_to_all_recordings_stays_where_a_fold_has_more_than_half_its_error(arm):
    logs = recordings(arm, 4)
    judge = Judge([logs[:2], logs[2:]], arm, -np.inf, 1)
    right = Bounds(arm, logs).first
    worse = right | {"offset": right["offset"] + 0.1}
    worst = right | {"offset": right["offset"] + 0.15}

    *_, last = judge.without_lost_joints([worse, worse, worst])
    np.testing.assert_array_equal(last["offset"], worst["offset"])


def test_pieces_of_one_recording_are_one_motion(arm):
    pieces = []
    for i, s in enumerate(recordings(arm, 10, rows=40)):
        start = 4 * (i % 2)
        notes = {"from_s": float(start)}
        meta = replace(s.meta, motion=f"m{i // 2}@{start}s", notes=notes)
        pieces.append(replace(s, meta=meta))
    for train, held_out in cross_validation(pieces[:8], pieces[8:], 3):
        recorded = {motion[:2] for motion in motions(train)}
        assert not recorded & {motion[:2] for motion in motions(held_out)}
    assert len(motion_errors(pieces, arm)) == 5


def test_a_joint_takes_a_fit_only_if_its_own_motions_accept_it():
    """Payloads of one motion are one vote: the first joint follows one motion of three better, with
    both payloads.
    """
    errors = {
        1.0: np.full((4, 2), 10.0),
        2.0: np.array([[4.0, 8.0], [4.0, 8.1], [11.0, 7.9], [11.5, 8.2]]),
    }

    class Payloads(Judge):
        names = np.array(["a", "a", "b", "c"])

        def __init__(self):
            pass

        def _sums(self, candidate):
            return errors[candidate[0]["kp"][0]], np.ones((4, 2))

    given = {"kp": np.full(2, 1.0)}
    fit = {"kp": np.full(2, 2.0)}
    name, (chosen,) = Payloads().best_by_joint({"given": [given], "limbs": [fit]})
    assert (name, chosen["kp"].tolist()) == ("mixed", [1.0, 2.0])
    worse = {"kp": np.full(2, 3.0)}
    errors[3.0] = errors[1.0] + 1.0
    assert Payloads().best_by_joint({"given": [given], "limbs": [worse]}) == ("given", [given])


@pytest.mark.parametrize(
    ("damping", "kp", "doubted"),
    [
        (1.0, 20.0, ""),  # kd and damping of the file, N·m·s/rad
        (4.5, 20.0, "kd"),
        (0.05, 20.0, "kd"),
        (1.0, 80.0, "kp"),
    ],
)
def test_a_gain_of_the_file_from_which_recordings_are_far_is_doubted(
    tmp_path, damping, kp, doubted
):
    robot = write_arm(tmp_path, TOML.replace("kp = 20.0", "kp = 20.0\nkd = 0.5"))
    bounds = Bounds(robot, recordings(robot, 1, rows=60))
    found = {"damping": np.full(2, damping - 0.5), "kp": np.full(2, kp)}
    sure = {joint: {"kp": 0.5, "damping": 0.01} for joint in robot.operated}
    unsure = {joint: {"kp": 100.0, "damping": 10.0} for joint in robot.operated}
    said = contradicted_gains(bounds, found, sure)
    assert len(said) == (2 if doubted else 0)
    assert all(f" {doubted}" in text for text in said)
    assert contradicted_gains(bounds, found, unsure) == []


@pytest.mark.parametrize(
    ("error_together", "kept"),
    [(0.9, {"whole", "limbs"}), (1.01, {"whole", "limbs"}), (1.1, set())],
)
def test_all_joints_are_fitted_together_unless_the_first_iterations_lose_much(error_together, kept):
    """Three motions judge. Fits of single joints have an error of 1."""
    alone = [{"kp": np.array([20.0])}]
    together = [{"kp": np.array([21.0])}]
    error = {20.0: 1.0, 21.0: error_together}
    judge = SimpleNamespace(
        names=np.array(["a", "b", "c"]),
        errors=lambda values: np.full(3, error[float(values[0]["kp"][0])]),
    )
    asked = []
    robot = robot_fit(together[0], asked)
    progress = SearchProgress(None, 0, 1, no_progress)
    fits = Fits([], None, [], judge, progress, 1)
    assert set(robot_candidates(fits, [robot], alone)) == kept
    iterations = [FIRST_ROBOT_ITERATIONS]
    if kept:
        iterations.append(ROBOT_ITERATIONS)
    assert asked == iterations


def test_all_joints_are_not_fitted_together_where_the_time_is_too_short(monkeypatch):
    """The judge simulates 100 rows in a second, so that 176 rollouts of 100 rows do not fit into a
    minute.
    """
    clock = [0.0]
    monkeypatch.setattr("time.monotonic", lambda: clock[0])

    def errors(values):
        clock[0] += 1.0
        return np.ones(1)

    judge = SimpleNamespace(names=np.array(["a"]), rows=100, errors=errors)
    alone = [{"kp": np.array([20.0])}]
    for seconds, count in ((60.0, 0), (6000.0, 2)):
        asked = []
        progress = SearchProgress(seconds, 0, 1, no_progress)
        progress.begin_search()
        progress.begin_search()
        fits = Fits([], None, [], judge, progress, 1)
        robot_candidates(fits, [robot_fit(alone[0], asked)], alone)
        assert len(asked) == count


def robot_fit(values, asked):
    """A fit in the whole robot's simulator that finds values and notes how many iterations were
    asked of it.
    """

    search = SimpleNamespace(
        iterate=lambda count, report: asked.append(count),
        keep_better_starts=lambda: None,
        values=values,
    )
    return SimpleNamespace(
        robot=SimpleNamespace(operated=("elbow",)),
        rollouts=SimpleNamespace(rows=np.ones(1), parts=[range(100)] * 8),
        bounds=SimpleNamespace(start={}),
        search=lambda fields, rest, starts: search,
        descend_chains=lambda values, report: values,
    )
