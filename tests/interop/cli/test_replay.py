"""gaponet replay: what a robot would have done under a rollout's targets, and how sure that is."""

import json

import numpy as np
import pytest
from arm import commands, record, recordings, write_arm

from gaponet.cli.main import main
from gaponet.robot_folder import save_robot
from gaponet.sim.replay import replay
from gaponet_interop.engine.rollout import answers, drawn_robots, summary, validation_error

REAL = {"kp": 0.7, "delay": 2}  # of nominal, control periods
FOUND = {"kp": 14.0, "delay": 0.04}


def write_rollout(path, sequence):
    """As a simulator's script leaves it."""
    time = sequence.dt * np.arange(len(sequence))
    np.savez(path, time=time, target=sequence.ctrl, q=sequence.qpos, joint_names=np.array(sequence.joint_names))


@pytest.fixture(scope="module")
def place(tmp_path_factory):
    """A robot that was identified rightly, a dataset of it, and two rollouts: the nominal simulator's, the robot's."""
    folder = tmp_path_factory.mktemp("replay")
    robot = write_arm(folder / "arm")
    save_robot(robot.with_servos(dict.fromkeys(robot.operated, FOUND)), folder / "found")
    (folder / "logs").mkdir()
    for seed in range(4):
        write_rollout(folder / f"logs/m{seed}.npz", record(robot, commands(200, seed), f"m{seed}", **REAL))
    (folder / "logs.toml").write_text('ctrl = "target"\nqpos = "q"\ntime_unit = "s"\nposition_unit = "rad"\n')
    words = ["--unit-id", "a", "--payload-mass", "0", "--logs", str(folder / "logs.toml")]
    assert (
        main(["import", str(folder / "logs"), "--robot", str(folder / "arm"), "--out", str(folder / "data"), *words])
        == 0
    )
    for name, how in (("simulator", {}), ("robot", REAL)):
        (folder / name).mkdir()
        write_rollout(folder / name / "policy.npz", record(robot, commands(250, 9), "policy", **how))
    return folder


def asked(place, rollout, capsys, *words):
    found = ["--robot", str(place / "found"), "--data", str(place / "data"), "--described", str(place / "logs.toml")]
    capsys.readouterr()
    assert main(["replay", str(place / rollout), *found, "--json", *words]) == 0
    return json.loads(capsys.readouterr().out)


def test_a_simulator_that_is_not_the_robot_is_told_joint_by_joint(place, capsys):
    said = asked(place, "simulator", capsys)
    assert said["differ"] == ["shoulder", "elbow"] or said["differ"] == ["elbow", "shoulder"]
    assert said["joints"]["elbow"]["apart"] > 0.01
    assert said["joints"]["elbow"]["robot_behind"] > said["joints"]["elbow"]["rollout_behind"]
    assert asked(place, "robot", capsys)["differ"] == []


def test_what_the_robot_would_do_can_be_kept_and_drawn(place, capsys, tmp_path):
    asked(place, "simulator", capsys, "--out", str(tmp_path / "a.npz"), "--figure", str(tmp_path / "a.png"))
    held = np.load(tmp_path / "a.npz")
    assert held["robot_0"].shape == held["low_0"].shape == (250, 2)
    assert (held["low_0"] < held["robot_0"]).all()
    assert (tmp_path / "a.png").stat().st_size > 10_000


def test_a_band_holds_nine_tenths_of_what_a_robot_does_that_was_identified_a_little_wrong(arm):
    wrong = arm.with_servos({j: {"kp": 14.5, "delay": 0.038, "frictionloss": 0.06} for j in arm.operated})
    known = validation_error(wrong, [s for s in recordings(arm, 8, **REAL) if not s.meta.payload_mass])
    fresh = [record(arm, commands(300, seed), f"new{seed}", **REAL) for seed in range(20, 26)]
    found = summary(answers(wrong, fresh, known), arm.operated)
    assert all(0.8 < s["inside"] <= 1.0 for s in found.values())
    assert all(1e-4 < s["band"] < 0.01 for s in found.values())


def test_standard_errors_widen_a_band_where_motion_shows_them(arm):
    still, moving = (record(arm, ctrl, "x") for ctrl in (np.zeros((100, 2)), commands(100, 1)))
    std = {"elbow": {"delay": 0.01, "kp": 0.0}}
    known, robot = 1e-3, arm.with_servos({"elbow": {"delay": 0.02}})
    first, second = answers(robot, [still, moving], np.full(2, known), std)
    assert first.half.max() < 1.5 * known
    assert second.half[:, 1].max() > 3 * known
    assert second.half[:, 0].max() < 1.5 * known


def test_drawn_robots_differ_by_their_errors_and_stay_possible(arm):
    robot = arm.with_servos({"elbow": {"delay": 0.01, "offset": 0.02}})
    made = drawn_robots(robot, {"elbow": {"kp": 2.0, "delay": 9.0, "offset": 0.05, "armature": None}}, 200)
    kp, delay, offset = (np.array([getattr(r, f)[1] for r in made]) for f in ("kp", "delay", "offset"))
    assert kp.std() == pytest.approx(2.0, rel=0.2)
    assert (delay > 0).all()
    assert offset.mean() == pytest.approx(0.02, abs=0.015)
    assert all(r.kp[0] == 20.0 for r in made)
    assert len(replay([record(arm, commands(20, 0), "x")], made[0])) == 1
