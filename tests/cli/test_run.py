"""gaponet run and record on a virtual robot in this process, as fast as it goes."""

import errno
import io
import json
import os
import re
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from arm import TOML, commands, write_arm
from motion_files import write_motion
from runs import untrained

from gaponet.api.run_options import Connection, LiveOptions, RunOptions
from gaponet.api.run_robot import RunRequest, listen
from gaponet.cli.main import main
from gaponet.data.store import Dataset
from gaponet.hw.control.clock import SimulatedClock
from gaponet.hw.control.driver import State
from gaponet.hw.targets.policy import NotYet
from gaponet.motion.motion import Motion
from gaponet.robot.folder import save_robot

FAST = [
    "--fast",
    "--yes",
    "--json",
    "--blend",
    "0.2",
    "--blend-speed",
    "4",
    "--settle",
    "0.1",
    "--damp",
    "0.1",
]

WRITTEN_BYTES = 10_000  # of a recording, before its disk is full: about a second


@pytest.fixture
def motion(arm, tmp_path):
    path = tmp_path / "sway.npz"
    write_motion(path, Motion("sway", "whole_body", 0.02, commands(30, seed=1)), arm)
    return str(path)


def test_record_makes_a_dataset_with_unit_payload_and_gains(arm, motion, tmp_path, capsys):
    out = tmp_path / "set"
    command = [
        "record",
        "--motion",
        motion,
        "--out",
        str(out),
        "--unit-id",
        "4",
        "--payload-mass",
        "0.1",
    ]
    command += [
        "--robot",
        str(arm.mjcf.parent),
        "--payload-side",
        "hand",
        "--repetitions",
        "2",
        *FAST,
    ]
    assert main(command) == 0
    result = json.loads(capsys.readouterr().out)
    data = Dataset(out)
    assert len(data) == 2
    assert result["written"] == [e.id for e in data.entries]
    first, second = data.entries
    assert (first.meta.unit_id, first.meta.payload_mass, first.meta.virtual) == (
        "virtual-4",
        0.1,
        True,
    )
    assert (first.meta.repetition, second.meta.repetition) == (0, 1)
    assert first.meta.notes["controller"]["kp"] == arm.servo.kp.tolist()
    sequence = data.read(first)
    assert sequence.dt == 0.02
    assert np.abs(sequence.qpos - sequence.ctrl).max() < 0.3
    assert (out / first.meta.source).is_file()


def test_a_stopped_run_says_so_and_is_not_added(arm, motion, tmp_path, capsys):
    out = tmp_path / "set"
    command = [
        "record",
        "--motion",
        motion,
        "--out",
        str(out),
        "--unit-id",
        "4",
        "--payload-mass",
        "0",
    ]
    command += ["--robot", str(arm.mjcf.parent), *FAST, "--safety.temperature", "20"]
    assert main(command) == 2
    said = capsys.readouterr().err
    assert "it was not added" in said
    assert "age of state" in said, "what the run measured is shown before the error"
    assert not (out / "dataset.json").exists()
    assert main([*command[:-2]]) == 0, "the next one makes it"
    assert len(Dataset(out)) == 1


def test_a_refused_plan_leaves_nothing_behind(tmp_path, capsys):
    (tmp_path / "down.csv").write_text("time,shoulder_lift,elbow_flex\n0,1.7,0.3\n0.5,1.7,0.3\n")
    command = [
        "record",
        "--robot",
        "so101",
        "--motion",
        str(tmp_path / "down.csv"),
        "--payload-mass",
        "0",
        *FAST,
    ]
    assert main([*command, "--out", str(tmp_path / "set"), "--unit", "1"]) == 2
    assert "'down' begins with" in " ".join(capsys.readouterr().err.split())
    assert not (tmp_path / "set").exists()


def test_a_run_whose_recording_met_a_full_disk_ends_with_status_3(
    arm, motion, tmp_path, monkeypatch
):
    write = os.pwrite

    def fill(descriptor: int, data: bytes, at: int) -> int:
        if at > WRITTEN_BYTES:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        return write(descriptor, data, at)

    monkeypatch.setattr("gaponet.hw.control.rows.os.pwrite", fill)
    out = tmp_path / "recordings"
    command = ["run", "--robot", str(arm.folder), "--motion", motion, "--out", str(out), *FAST]
    with pytest.raises(SystemExit, match="3"):
        main(command)
    assert json.loads((out / "sway.json").read_text())["not_whole"] == "No space left on device"


@pytest.fixture
def full_at_the_end(monkeypatch) -> None:
    """The disk takes the rows of a run, and no file after it."""

    def fill(path: Path, text: str) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(path))

    monkeypatch.setattr("gaponet.hw.control.recording.write_text", fill)


@pytest.mark.usefixtures("full_at_the_end")
def test_a_run_that_cannot_be_saved_ends_with_3_and_says_that_the_robot_moved(
    arm, motion, tmp_path, capsys
):
    out = tmp_path / "recordings"
    command = ["run", "--robot", str(arm.folder), "--motion", motion, "--out", str(out), *FAST]

    assert main(command) == 3

    said = " ".join(capsys.readouterr().err.split())
    assert "the robot has moved" in said
    assert "No space left on device" in said
    assert str(out / "sway.cycles.npy") in said


@pytest.mark.usefixtures("full_at_the_end")
def test_a_recorded_motion_that_cannot_be_saved_ends_with_3(arm, motion, tmp_path):
    out = str(tmp_path / "set")
    where = ["--robot", str(arm.folder), "--motion", motion, "--out", out, "--unit", "1"]

    assert main(["record", *where, "--payload-mass", "0", *FAST]) == 3


def test_the_plan_says_the_payload_that_it_is_for_and_how_a_stop_ends(capsys):
    """And a motion of the library is for that payload, not for the 3 kg that an SO-101 cannot
    hold.
    """
    command = [
        "run",
        "--robot",
        "so101",
        "--motion",
        "tour-all-0",
        "--unit",
        "1",
        "--payload-mass",
        "0.1",
        *FAST,
    ]
    assert main([x for x in command if x != "--json"]) == 0
    said = " ".join(capsys.readouterr().out.split())
    share = re.search(r"most torque, [^:]*0\.1 kg[^:]*: \w+, (\d\.\d\d) of what may be used", said)
    assert share, said
    assert 0 < float(share[1]) <= 1.1
    assert "is held; a stop damps it" in said


def test_a_motion_of_legs_is_refused_before_anything_is_opened(tmp_path, capsys):
    from gaponet.robot.spec import load_robot

    robot = load_robot("h1_2")
    ctrl = np.repeat(robot.qpos_home[None], 20, axis=0)
    ctrl[:, robot.index(["left_knee_joint"])] = np.linspace(0, 0.1, 20)[:, None]
    write_motion(tmp_path / "knee.npz", Motion("knee", "joint", 0.02, ctrl), robot)
    assert (
        main(["run", "--driver", "unitree", "--motion", str(tmp_path / "knee.npz"), "--yes"]) == 2
    )
    assert "moves left_knee_joint, which unitree dds domain 0 does not command" in " ".join(
        capsys.readouterr().err.split()
    )


def test_a_real_robot_is_not_moved_without_asking(arm, tmp_path, capsys, monkeypatch):
    from gaponet.robot.spec import load_robot

    robot = load_robot("h1_2")
    ctrl = np.repeat(robot.qpos_home[None], 20, axis=0)
    write_motion(tmp_path / "still.npz", Motion("still", "joint", 0.02, ctrl), robot)
    monkeypatch.setattr("sys.stdin", io.StringIO("yes\n"))
    for words in (["--motion", str(tmp_path / "still.npz")], ["--targets", "stdin"]):
        assert main(["run", "--driver", "unitree", *words]) == 2
        assert "no terminal to ask on" in capsys.readouterr().err


def test_a_model_runs_on_the_robot_that_its_run_keeps_and_on_no_other(
    arm, motion, tmp_path, capsys
):
    model = untrained(tmp_path / "run", arm, Dataset.create(tmp_path / "set", arm))
    write_arm(tmp_path / "stiffer", TOML.replace("kp = 20.0", "kp = 40.0"))
    for place in (model, model / "model"):
        words = ["run", "--motion", motion, "--model", str(place), *FAST]
        assert main(words) == 0
        assert json.loads(capsys.readouterr().out)["robot"] == arm.name
        assert main([*words, "--robot", str(tmp_path / "stiffer")]) == 2
        assert "another robot, or other gains or inertias" in " ".join(
            capsys.readouterr().err.split()
        )


def test_compensation_needs_a_robot_folder_and_no_model(arm, motion, tmp_path, capsys):
    soft = arm.with_identified({joint: {"kp": 10.0} for joint in arm.joint_names})
    save_robot(soft, tmp_path / "soft")
    missed = {}
    for name, words in (("raw", []), ("compensated", ["--compensate"])):
        assert (
            main(["run", "--motion", motion, "--robot", str(tmp_path / "soft"), *words, *FAST]) == 0
        )
        result = json.loads(capsys.readouterr().out)
        assert (
            result["kp"] == arm.servo.kp.tolist()
        )  # the servos are told their own gains, not what was identified
        missed[name] = result["tracking_error_rad"]["mean"]
    assert missed["compensated"] < 0.7 * missed["raw"]
    assert result["compensated_by"] == str(tmp_path / "soft")


def test_a_motion_or_live_targets_and_not_faster_than_time(arm, motion, capsys, monkeypatch):
    robot = ["--robot", str(arm.mjcf.parent)]
    for words in ([], ["--motion", motion, "--targets", "zmq"]):
        assert main(["run", *robot, *words]) == 2
        assert "give either --motion, what to play, or --targets" in " ".join(
            capsys.readouterr().err.split()
        )
    assert main(["run", *robot, "--targets", "zmq", "--fast"]) == 2
    assert "live targets come in real time" in capsys.readouterr().err
    monkeypatch.setattr("sys.stdin.isatty", lambda: True, raising=False)
    assert main(["run", *robot, "--targets", "stdin"]) == 2
    assert "PROGRAM | gaponet run --targets stdin" in " ".join(capsys.readouterr().err.split())
    assert main(["run", *robot, "--targets", "zmq", "--live.hold", "-1"]) == 2
    assert "hold is -1.0 s; give a positive number" in " ".join(capsys.readouterr().err.split())


def test_options_that_would_do_nothing_are_refused(arm, motion, tmp_path, capsys):
    run = ["run", "--motion", motion, "--robot", str(arm.mjcf.parent), *FAST]
    record = ["record", *run[1:], "--payload-mass", "0", "--out", str(tmp_path / "set")]
    for words, message in (
        (
            [*run, "--compensation.dynamics"],
            "settings of the compensation are given, and it is off; add --compensate",
        ),
        ([*run, "--live.hold", "2"], "settings of live targets are given, and this is a motion"),
        ([*record, "--repetitions", "0"], "--repetitions 0: give 1 or more"),
        ([*record, "--unit-id", "2"], "--unit-id 2: a virtual robot is chosen by --unit 4"),
    ):
        assert main(words) == 2
        assert message in " ".join(capsys.readouterr().err.split())


@pytest.mark.parametrize(("kind", "needs"), [("zmq", "zmq"), ("dds", "cyclonedds")])
def test_live_targets_are_listened_for_where_it_says(arm, kind, needs, tmp_path):
    pytest.importorskip(needs)
    options = RunOptions(
        targets=kind,
        live=LiveOptions(address=f"ipc://{tmp_path}/targets"),
        connection=Connection(domain=29),
    )
    driver = SimpleNamespace(commanded=arm.joint_names)
    targets = listen(RunRequest(options=options), arm, driver, SimulatedClock())
    said = targets(0, State(0.0, *np.zeros((4, 2))))
    assert isinstance(said, NotYet)
    assert targets.transport.address in said.text
    targets.close("over")
