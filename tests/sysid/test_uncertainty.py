"""What is known of a robot: how sure its values are, from which logs, and whether later logs are
still of it.
"""

import json
import shutil
from dataclasses import replace

import numpy as np
import pytest
from arm import TOML, XML, commands, record, write_arm

from gaponet import api
from gaponet.base.errors import RobotError, UsageError
from gaponet.cli.main import main
from gaponet.data.store import Dataset
from gaponet.robot.folder import save_robot
from gaponet.robot.spec import load_robot
from gaponet.sim.replay import replay
from gaponet.sysid.acceptance import HeldOut
from gaponet.sysid.axes import CLASSIC
from gaponet.sysid.evidence.drift import drift
from gaponet.sysid.evidence.evidence import estimate_uncertainty
from gaponet.sysid.uncertainty import OLD_KEYS, JointSummary, ParameterUncertainty, from_axes

TRUE = {
    "kp": 16.0,
    "damping": 0.5,
    "frictionloss": 0.05,
    "armature": 0.02,
    "offset": 0.0,
    "delay": 0.02,
}


def played(robot, first=0, count=6, seconds=8, noise=4e-4, **how):
    """Motions of an arm whose servos are softer and late, seen through a noisy encoder."""
    found = []
    for seed in range(first, first + count):
        rows = round(seconds / robot.dt)
        servo = {"kp": 0.8, "delay": 1} | how
        one = record(robot, commands(rows, seed), f"m{seed}", **servo)
        spread = noise * np.random.default_rng(seed).standard_normal(one.qpos.shape)
        found.append(replace(one, qpos=one.qpos + spread))
    return found


def shifted(sequences, by):
    """The recordings read elsewhere, by (n,) rad."""
    return [replace(s, qpos=s.qpos + by) for s in sequences]


def held(sequences, *joints):
    """The recordings, said to hold these joints at home."""
    made = []
    for s in sequences:
        meta = replace(s.meta, notes={"held_at_home": joints})
        made.append(replace(s, meta=meta))
    return made


@pytest.fixture(scope="module")
def arm(tmp_path_factory):
    return write_arm(tmp_path_factory.mktemp("know") / "arm")


@pytest.fixture(scope="module")
def folder(arm, tmp_path_factory):
    """As if it had been identified."""
    right = arm.with_identified(dict.fromkeys(arm.joint_names, TRUE))
    place = tmp_path_factory.mktemp("know") / "right"
    save_robot(right, place)
    estimate_uncertainty(load_robot(place), played(arm), played(arm, 20, 3), nthread=1).save(place)
    return place


def dataset(arm, place, sequences):
    data = Dataset.create(place, arm)
    for one in sequences:
        data.append(one)
    return place


def checked(capsys, *words):
    code = 0
    try:
        code = main(["check", *map(str, words), "--threads", "1", "--json"])
    except SystemExit as end:
        code = end.code
    return code, json.loads(capsys.readouterr().out)


@pytest.fixture
def mine(folder):
    return ParameterUncertainty.load(load_robot(folder))


def test_uncertainty_lists_its_sources(mine):
    (source,) = mine.sources
    assert source["logs"].keys() == {f"m{seed}" for seed in range(6)}
    assert source["seconds"] == pytest.approx(48.0)


@pytest.mark.parametrize("joint", ["shoulder", "elbow"])
def test_uncertainty_has_the_values_of_the_robot(mine, joint):
    values, _ = mine.si(joint)
    assert values == pytest.approx({field: TRUE[field] for field in mine.fields}, abs=1e-5)
    assert mine.joints[joint].residual_rms < 2e-3


@pytest.mark.parametrize("joint", ["shoulder", "elbow"])
def test_a_covariance_is_that_of_draws_on_the_axes(mine, joint):
    _, covariance = mine.si(joint)
    centre = mine.array(joint, "values")
    rng = np.random.default_rng(0)
    drawn = rng.multivariate_normal(centre, mine.array(joint, "covariance"), 20_000)
    found = from_axes(mine.fields, drawn)
    spread = [found[field].std() for field in mine.fields]
    np.testing.assert_allclose(spread, np.sqrt(np.diag(covariance)), rtol=0.1)


def test_a_value_is_shown_without_its_error_where_no_log_shows_it():
    def cell(value, error):
        return JointSummary({"kp": value}, {"kp": error}).cell("kp")

    assert cell(16.0, 40.0) == "16 ± 40"
    assert cell(16.0, 50.0) == "16 (no log shows it)"
    assert cell(0.0, 50.0) == "none seen"


def test_a_value_that_ended_at_zero_is_shown_as_an_upper_bound():
    def cell(field, value):
        return JointSummary({field: value}, {field: 0.0029}).cell(field)

    assert cell("delay", 0.0) == "at most 5.8"
    assert cell("delay", 0.001) == "1.0 ± 2.9"
    assert cell("offset", 0.0) == "0.0 ± 2.9"


def test_a_parameter_without_information_keeps_its_prior_std(arm):
    """A joint that nothing loads and that hardly moves shows no gain: kp is believed to a factor,
    not to the moon.
    """
    share = np.array([0.02, 1])
    still = [replace(s, ctrl=s.ctrl * share, qpos=s.qpos * share) for s in played(arm, 0, 3)]
    mine = estimate_uncertainty(arm, still, [], nthread=1)
    assert np.sqrt(np.diag(mine.array("shoulder", "covariance"))[0]) <= 0.5


@pytest.mark.parametrize(("fitted", "stated"), [(0.5, 0.5), (0.1, 0.1), (1e3, 0.5)])
def test_the_prior_of_kp_counts_once(arm, fitted, stated):
    """A fit has counted it, except for a joint of which neither file nor logs say anything."""
    std = np.full(len(CLASSIC), 1e-3)
    std[CLASSIC.index("kp")] = fitted
    covariances = {"shoulder": (list(CLASSIC), np.diag(std**2))}
    mine = estimate_uncertainty(arm, played(arm, 0, 2), [], covariances, nthread=1)
    found = np.sqrt(np.diag(mine.array("shoulder", "covariance")))[CLASSIC.index("kp")]
    assert found == pytest.approx(stated, rel=1e-3)


@pytest.fixture(scope="module")
def judges(arm):
    """Two recordings that judge."""
    return played(arm, 20, 2)


@pytest.fixture(scope="module")
def both(folder, judges):
    """The uncertainty of each joint where both recordings judge it."""
    return estimate_uncertainty(load_robot(folder), judges, judges, nthread=1).joints


def test_residuals_use_recordings_that_hold_the_joint(folder, judges, both):
    robot = load_robot(folder)
    some = [judges[0], *held(judges[1:], "elbow")]
    one = estimate_uncertainty(robot, judges, some, nthread=1).joints["elbow"]
    first = estimate_uncertainty(robot, judges, judges[:1], nthread=1).joints["elbow"]
    assert one.residual_rms == pytest.approx(first.residual_rms, rel=0.2)
    # Rows that do not hold it are no zeros.
    assert one.residual_rms > 0.5 * both["elbow"].residual_rms


def test_a_joint_that_no_recording_holds_has_the_residual_of_the_others(folder, judges):
    alone = held(judges, "elbow")
    none = estimate_uncertainty(load_robot(folder), judges, alone, nthread=1).joints
    assert none["elbow"].residual_p90 == none["shoulder"].residual_p90 > 0.0


def test_residuals_are_those_of_the_robot_that_was_judged(folder, judges, both):
    robot = load_robot(folder)
    off = HeldOut(judges, robot.with_identified({"elbow": {"offset": 0.05}}))
    found = estimate_uncertainty(robot, judges, judges, held_out=[off], nthread=1)
    judged = found.joints["elbow"]
    assert judged.residual_rms > 10 * both["elbow"].residual_rms
    assert judged.values == both["elbow"].values


def test_the_error_bound_is_wider_if_few_motions_differ(arm, folder):
    robot = load_robot(folder)
    judges = played(arm, 20, 4)
    apart = [*shifted(judges[:1], np.float32(0.05)), *judges[1:]]
    errors = []
    for s, t in zip(apart, replay(apart, robot, nthread=1, lock_idle=True), strict=True):
        errors.append(np.abs(t.qpos - s.qpos)[1:, robot.index(["elbow"])])
    pooled = np.quantile(np.concatenate(errors), 0.9)
    alike = estimate_uncertainty(robot, judges, judges, nthread=1).joints["elbow"].residual_p90
    wide = estimate_uncertainty(robot, judges, apart, nthread=1).joints["elbow"].residual_p90
    assert wide > 1.5 * pooled > alike


def test_the_error_bound_of_one_motion_is_finite(folder, judges):
    robot = load_robot(folder)
    one = estimate_uncertainty(robot, judges, judges[:1], nthread=1).joints["elbow"]
    assert np.isfinite(one.residual_p90)


def test_more_recordings_reduce_the_variance_and_are_listed(arm, folder):
    robot = load_robot(folder)
    mine = ParameterUncertainty.load(robot)
    more = estimate_uncertainty(robot, played(arm, 40, 4), [], before=mine, nthread=1)
    assert len(more.sources) == 2
    for joint in arm.operated:
        before = np.diag(mine.array(joint, "covariance"))
        after = np.diag(more.array(joint, "covariance"))
        assert (after < before).all()


def test_a_change_by_adaptation_increases_the_variance(arm, folder):
    robot = load_robot(folder)
    mine = ParameterUncertainty.load(robot)
    column = mine.fields.index("offset")
    variances = []
    for by in (0.0, -0.05):
        there = robot.with_identified({"elbow": {"offset": by}})
        seen = shifted(played(arm, 40, 2), np.array([0.0, by]))
        found = estimate_uncertainty(there, seen, [], before=mine, nthread=1)
        variances.append(found.array("elbow", "covariance")[column, column])
    same, moved = variances
    assert moved > 1.1 * same


def test_an_edited_folder_is_refused(folder, tmp_path):
    robot = load_robot(folder)
    save_robot(robot.with_identified({"elbow": {"kp": 30.0}}), tmp_path / "edited")
    with pytest.raises(RobotError, match="elbow"):
        ParameterUncertainty.load(load_robot(tmp_path / "edited"))


def test_a_folder_of_an_older_version_loads(folder, tmp_path):
    save_robot(load_robot(folder), tmp_path / "old")
    new = tmp_path / "old" / "uncertainty.json"
    text = new.read_text()
    for old, key in OLD_KEYS.items():
        text = text.replace(f'"{key}"', f'"{old}"')
    (tmp_path / "old" / "known.json").write_text(text)
    new.unlink()
    today = ParameterUncertainty.load(load_robot(folder))
    assert ParameterUncertainty.load(load_robot(tmp_path / "old")) == today


def test_a_folder_without_uncertainty_loads_and_show_refuses_it(arm, capsys):
    assert ParameterUncertainty.load(arm) is None
    assert main(["robot", "show", str(arm.folder)]) == 2
    assert "keeps only values" in capsys.readouterr().err


def test_an_adaptation_writes_its_sources(arm, folder, tmp_path):
    data = dataset(arm, tmp_path / "data", played(arm, 60, 2, kp=0.7))
    api.adapt_robot(load_robot(folder), data, out=tmp_path / "today", seconds=16.0)
    mine = ParameterUncertainty.load(load_robot(tmp_path / "today"))
    assert [s["made_by"] for s in mine.sources] == ["identify", "adapt"]
    assert mine.sources[1]["logs"].keys() == {"m60", "m61"}


def test_show_prints_and_draws(folder, tmp_path, capsys):
    sentence = "elbow: backlash 6.0 ± 1.0 mrad (probability 0.93)"
    folder = shutil.copytree(folder, tmp_path / "robot")
    origin = {
        "dataset": "data",
        "parts": {"train": {}, "val": {}, "test": {}},
        "motions": {},
        "val_mpjae": {},
        "findings": [sentence],
    }
    (folder / "identified.json").write_text(json.dumps(origin))
    assert main(["robot", "show", str(folder), "--out", str(tmp_path / "known.svg"), "--json"]) == 0
    said = capsys.readouterr()
    found = json.loads(said.out)
    assert found["joints"]["elbow"]["standard_errors"]["kp"] > 0
    assert "± standard error" in said.err
    assert sentence in said.err
    assert "elbow" in (tmp_path / "known.svg").read_text()
    assert main(["robot", "show", str(folder), "--out", str(tmp_path / "known.pdf")]) == 2


def test_check_reports_a_changed_kp(arm, folder, tmp_path, capsys):
    data = dataset(arm, tmp_path / "data", played(arm, 70, 6, kp=0.7))
    code, said = checked(capsys, folder, data)
    assert (code, said["verdict"]) == (1, "drifted")
    assert "kp" in {change["field"] for change in said["moved"]}


@pytest.mark.parametrize(
    ("how", "shift", "changes"),
    [
        ({}, 0.0, {}),
        ({"kp": 0.7}, 0.0, dict.fromkeys([("shoulder", "kp"), ("elbow", "kp")], np.log(0.7 / 0.8))),
        ({}, 0.005, {("elbow", "offset"): 0.005}),
        ({"delay": 2}, 0.0, {("every joint", "delay"): 0.02}),
    ],
)
def test_drift_names_what_changed_and_by_how_much(arm, folder, how, shift, changes):
    robot = load_robot(folder)
    logs = shifted(played(arm, 70, 6, **how), np.array([0.0, shift]))
    found = drift(robot, ParameterUncertainty.load(robot), logs, nthread=1)
    moved = {}
    for change in found.moved:
        if not how or change.field in ("kp", "delay"):
            moved[change.joint, change.field] = change.by
    assert moved == pytest.approx(changes, rel=0.35)
    assert found.verdict == ("drifted" if changes else "same")


def test_a_contradicting_recording_is_set_aside_and_half_of_them_are_a_contradiction(arm, folder):
    robot = load_robot(folder)
    logs = played(arm, 70, 6)
    verdicts = []
    for odd in (2, 3, 4):
        logs[odd] = replace(logs[odd], qpos=logs[odd].qpos + np.array([0.03, 0.0]))
        found = drift(robot, ParameterUncertainty.load(robot), logs, nthread=1)
        verdicts.append((found.verdict, found.against[0].recording, found.against[0].joint))
    assert verdicts[0] == ("same", "m72", "shoulder")
    assert verdicts[-1][0] == "contradictory"


def test_another_arm_that_no_parameter_explains_has_drifted(arm, folder, monkeypatch, tmp_path):
    """Its links are twice as heavy; even where no change of a number counts it is not called the
    same.
    """
    xml = XML.replace('mass="0.3"', 'mass="0.6"').replace('mass="0.2"', 'mass="0.4"')
    heavy = write_arm(tmp_path / "heavy", TOML, xml)
    robot = load_robot(folder)
    mine = ParameterUncertainty.load(robot)
    fresh = drift(robot, mine, played(arm, 70, 6), 1)
    assert (fresh.verdict, fresh.far) == ("same", {})
    monkeypatch.setattr("gaponet.sysid.evidence.drift.MIN_EFFECT_RATIO", 1e9)
    found = drift(robot, mine, played(heavy, 70, 6), 1)
    assert found.verdict == "drifted"
    assert "no number explains how far these logs are from the model" in found.advice
    assert set(found.far) <= set(arm.operated)


def test_a_change_smaller_than_the_difference_between_repetitions_is_no_drift(
    arm, folder, tmp_path
):
    """A robot that stands 4 mrad elsewhere each time it plays a command: 3 mrad today are
    nothing.
    """
    robot = load_robot(folder)
    rng = np.random.default_rng(0)
    today = shifted(played(arm, 50, 6), np.float32([0.003, 0.0]))
    judges = played(arm, 20, 3)
    once = played(arm)
    thrice = []
    for s in once:
        for _ in range(3):
            thrice.append(replace(s, qpos=s.qpos + np.float32(0.004 * rng.standard_normal(2))))
    precise = estimate_uncertainty(robot, once, judges, nthread=1)
    assert precise.joints["shoulder"].repeatability == 0.0
    assert drift(robot, precise, today, 1).verdict == "drifted"
    loose = estimate_uncertainty(robot, thrice, judges, nthread=1)
    difference = loose.joints["shoulder"].repeatability
    assert difference == pytest.approx(0.004 * 2**0.5, rel=0.5)
    found = drift(robot, loose, today, 1)
    assert found.verdict == "same"
    assert found.min_effect["shoulder"] == difference > found.largest["shoulder"].moves


def test_recordings_of_joints_that_were_never_identified_are_not_called_the_same(arm, folder):
    robot = load_robot(folder)
    servo = {}
    for field in TRUE:
        servo[field] = np.where([True, False], robot.servo[field], arm.servo[field])
    half = robot.with_servo(**servo)
    logs = held(played(arm, 70, 2), "shoulder")
    with pytest.raises(UsageError, match="elbow"):
        drift(half, ParameterUncertainty.load(robot), logs, 1)
