"""gaponet replay: what a robot would have done under a rollout's targets, and how sure that is."""

import json

import numpy as np
import pytest
from arm import commands, record, recordings, write_arm

from gaponet.cli.main import main
from gaponet.export.rollout import predict, summary, validation_error
from gaponet.robot.folder import save_robot

REAL = {"kp": 0.7, "delay": 2}  # of nominal, control periods
FOUND = {"kp": 14.0, "delay": 0.04}


def write_rollout(path, sequence):
    """As a simulator's script leaves it."""
    time = sequence.dt * np.arange(len(sequence))
    np.savez(
        path,
        time=time,
        target=sequence.ctrl,
        q=sequence.qpos,
        joint_names=np.array(sequence.joint_names),
    )


@pytest.fixture(scope="module")
def place(tmp_path_factory):
    """A robot that was identified rightly, a dataset of it, and two rollouts: the nominal
    simulator's, the robot's.
    """
    folder = tmp_path_factory.mktemp("replay")
    robot = write_arm(folder / "arm")
    save_robot(robot.with_identified(dict.fromkeys(robot.operated, FOUND)), folder / "found")
    (folder / "logs").mkdir()
    for seed in range(4):
        write_rollout(
            folder / f"logs/m{seed}.npz", record(robot, commands(200, seed), f"m{seed}", **REAL)
        )
    (folder / "logs.toml").write_text(
        'ctrl = "target"\nqpos = "q"\ntime_unit = "s"\nposition_unit = "rad"\n'
    )
    words = ["--unit-id", "a", "--payload-mass", "0", "--logs", str(folder / "logs.toml")]
    assert (
        main(
            [
                "import",
                str(folder / "logs"),
                "--robot",
                str(folder / "arm"),
                "--out",
                str(folder / "data"),
                *words,
            ]
        )
        == 0
    )
    for name, how in (("simulator", {}), ("robot", REAL)):
        (folder / name).mkdir()
        write_rollout(
            folder / name / "policy.npz", record(robot, commands(250, 9), "policy", **how)
        )
    return folder


def asked(place, rollout, capsys, *words):
    found = [
        "--robot",
        str(place / "found"),
        "--data",
        str(place / "data"),
        "--described",
        str(place / "logs.toml"),
    ]
    capsys.readouterr()
    assert main(["replay", str(place / rollout), *found, "--json", *words]) == 0
    return json.loads(capsys.readouterr().out)


def test_a_simulator_that_is_not_the_robot_is_told_joint_by_joint(place, capsys):
    said = asked(place, "simulator", capsys)
    assert said["differ"] == ["shoulder", "elbow"] or said["differ"] == ["elbow", "shoulder"]
    assert said["joints"]["elbow"]["apart"] > 0.01
    assert said["joints"]["elbow"]["robot_behind"] > said["joints"]["elbow"]["rollout_behind"]
    assert asked(place, "robot", capsys)["differ"] == []


def test_what_the_robot_would_do_can_be_kept(place, capsys, tmp_path):
    asked(place, "simulator", capsys, "--out", str(tmp_path / "a.npz"))
    held = np.load(tmp_path / "a.npz")
    assert held["robot_0"].shape == held["low_0"].shape == (250, 2)
    assert (held["low_0"] < held["robot_0"]).all()


@pytest.mark.parametrize("out", ["bands.csv", "no_such_folder/bands.npz"])
def test_an_out_that_is_no_npz_or_has_no_folder_is_refused_before_anything_is_read(
    tmp_path, capsys, out
):
    place = str(tmp_path / out)
    assert main(["replay", "no_rollout", "--robot", "no_robot", "--out", place]) == 2
    assert "--out" in capsys.readouterr().err


def test_a_band_holds_nine_tenths_of_what_a_robot_does_that_was_identified_a_little_wrong(arm):
    wrong = arm.with_identified(
        {j: {"kp": 14.5, "delay": 0.038, "frictionloss": 0.06} for j in arm.operated}
    )
    known = validation_error(
        wrong, [s for s in recordings(arm, 8, **REAL) if not s.meta.payload_mass]
    )
    fresh = [record(arm, commands(300, seed), f"new{seed}", **REAL) for seed in range(20, 26)]
    found = summary(predict(wrong, fresh, known), arm.operated)
    assert all(0.8 < s["inside"] <= 1.0 for s in found.values())
    assert all(1e-4 < s["band"] < 0.01 for s in found.values())


def test_what_is_not_known_widens_a_band_where_motion_shows_it(arm):
    still, moving = (record(arm, ctrl, "x") for ctrl in (np.zeros((100, 2)), commands(100, 1)))
    known = 1e-3
    robot = arm.with_identified({"elbow": {"delay": 0.02}})
    drawn = [robot.with_identified({"elbow": {"delay": delay}}) for delay in (0.01, 0.03)]
    first, second = predict(robot, [still, moving], np.full(2, known), drawn)
    assert first.half_width.max() < 1.5 * known
    assert second.half_width[:, 1].max() > 3 * known
    assert second.half_width[:, 0].max() < 1.5 * known
