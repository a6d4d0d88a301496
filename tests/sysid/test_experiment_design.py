"""gaponet excite --for: the motions that tell most of a robot that is known in part."""

import contextlib
import io
import json
from dataclasses import replace

import numpy as np
import pytest
from arm import TOML, XML, commands, record, write_arm

from gaponet.cli.main import main
from gaponet.motion.feasible import Feasibility
from gaponet.motion.files import read_motion
from gaponet.motion.library import Library
from gaponet.robot.folder import save_robot
from gaponet.robot.spec import load_robot
from gaponet.sysid.evidence import experiment_design
from gaponet.sysid.evidence.evidence import estimate_uncertainty
from gaponet.sysid.evidence.experiment_design import (
    ExperimentDesign,
    candidate_motions,
    simulated_recordings,
    undetermined_gains,
)
from gaponet.sysid.uncertainty import ParameterUncertainty

HELD = 0.3  # kg


def identified(place, xml=XML):
    """As if two short motions had identified it."""
    robot = write_arm(place / "arm", TOML, xml)
    rng = np.random.default_rng(0)
    logs = []
    for seed in range(2):
        s = record(robot, commands(400, seed), f"m{seed}", kp=0.8, delay=1)
        noise = 4e-4 * rng.standard_normal(s.qpos.shape).astype(np.float32)
        logs.append(replace(s, qpos=s.qpos + noise))
    servos = {joint: {"kp": 16.0, "delay": 0.02} for joint in robot.operated}
    save_robot(robot.with_identified(servos), place / "known")
    estimate_uncertainty(load_robot(place / "known"), logs, [], nthread=1).save(place / "known")
    return load_robot(place / "known")


@pytest.fixture(scope="module")
def robot(tmp_path_factory):
    return identified(tmp_path_factory.mktemp("loaded"))


@pytest.fixture(scope="module")
def pool(robot):
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(experiment_design, "MOTIONS_OF_ALL_JOINTS", 8)
        return candidate_motions(Library(robot, 3, HELD))[::2]


@pytest.fixture(scope="module")
def told(robot, pool):
    expected = simulated_recordings(robot, pool, 0.0)
    return ExperimentDesign.from_recordings(robot, ParameterUncertainty.load(robot), expected)


def errors(covariance):
    return np.sqrt(np.einsum("nii->ni", covariance))


def test_every_candidate_is_within_the_limits(robot, pool):
    limits = Feasibility(robot, HELD)
    assert all(limits.demand(m.ctrl, m.dt).met for m in pool)


def test_expected_information_is_that_of_a_recording(robot, pool, told):
    """Played on another arm than the identified one."""
    mine = ParameterUncertainty.load(robot)
    nominal = load_robot(robot.folder.parent / "arm")
    played = []
    for k, motion in enumerate(pool[:4]):
        played.append(record(nominal, motion.sample(nominal.dt), f"n{k}", kp=0.84, delay=1))
    there = ExperimentDesign.from_recordings(robot, mine, played)
    expected = errors(told.after(range(4)))
    np.testing.assert_allclose(expected, errors(there.after(range(4))), rtol=0.5)


def test_more_recordings_never_increase_standard_errors(told):
    now = errors(told.after([]))
    for more in ([0], [0, 5], range(len(told.seconds))):
        then = errors(told.after(more))
        assert (then <= now * (1 + 1e-9)).all()
        now = then


def test_the_design_fits_the_time_and_beats_nine_of_ten_random_sets(told):
    picks = told.choose(24.0)
    assert len(set(picks)) == len(picks)
    assert told.seconds[picks].sum() <= 24.0
    rng = np.random.default_rng(1)
    random = []
    for _ in range(40):
        order = rng.permutation(len(told.seconds))
        fits = order[np.cumsum(told.seconds[order]) <= 24.0]
        random.append(np.log(errors(told.after(fits))).mean())
    assert np.log(errors(told.after(picks))).mean() < np.quantile(random, 0.1)


def test_a_well_identified_robot_needs_no_more_motions(told):
    surer = replace(told, covariance=told.after(range(len(told.seconds))) / 100)
    assert surer.worth() < told.worth()
    assert surer.worth() == 0


def test_kp_of_unloaded_joints_is_reported_as_undetermined(tmp_path, robot, pool, told):
    """Its joints turn about upright axes, and no log has shown what moves: friction over kp is
    seen, kp is not.
    """
    assert undetermined_gains(ParameterUncertainty.load(robot), told) == {}
    free = identified(tmp_path, XML.replace('axis="0 1 0"', 'axis="0 0 1"'))
    mine = ParameterUncertainty.load(free)
    motions = [m for m in candidate_motions(Library(free, 3, HELD)) if m.name.startswith("creep")]
    slow = ExperimentDesign.from_recordings(free, mine, simulated_recordings(free, motions, 0.0))
    added = np.zeros((6, 6))
    added[0, 0] = 0.25
    said = undetermined_gains(mine, replace(slow, covariance=slow.covariance + added))
    assert set(said) == {"shoulder", "elbow"}
    sentence = "so no motion separates kp from friction and damping"
    assert all(sentence in why for why in said.values())


@pytest.fixture(scope="module")
def excited(robot, tmp_path_factory):
    """Where excite has written motions for the robot, and what it said."""
    out = tmp_path_factory.mktemp("excite") / "next"
    words = ["excite", "--for", str(robot.folder), "--out", str(out), "--seed", "3", "--json"]
    said = io.StringIO()
    with contextlib.redirect_stdout(said):
        assert main(words) == 0
    return out, json.loads(said.getvalue())


def test_excite_says_how_long_motions_take_and_whether_they_are_worth_it(excited):
    _, said = excited
    assert 60 * said["minutes"] <= 30
    assert said["worth_seconds"] >= 0


def test_excite_expects_smaller_errors_than_before(excited):
    _, said = excited
    for joint, before in said["errors"].items():
        for field, error in before.items():
            assert said["errors_then"][joint][field] <= error


def test_excite_writes_motions_and_a_sheet(robot, excited):
    out, said = excited
    for file in said["motions"]:
        assert read_motion(out / file, robot).duration > 1
    assert f"gaponet adapt {robot.folder} data --out ROBOT_2" in (out / "sheet.md").read_text()


def test_a_robot_without_uncertainty_and_two_robots_are_refused(robot, tmp_path, capsys):
    plain = robot.folder.parent / "arm"
    assert main(["excite", "--for", str(plain), "--out", str(tmp_path / "a")]) == 2
    assert "keeps only values" in capsys.readouterr().err
    two = ["excite", "--for", str(plain), "--robot", "so101", "--out", str(tmp_path / "b")]
    assert main(two) == 2
    assert "--robot NAME" in capsys.readouterr().err
