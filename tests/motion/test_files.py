import numpy as np
import pytest

from gaponet.base.errors import JointMismatchError, LogError
from gaponet.motion.files import read_motion
from gaponet.robot.spec import load_robot


def test_sage_names_may_be_paths_and_missing_joints_stay_at_home(tmp_path):
    robot = load_robot("h1_2")
    file = tmp_path / "stir.txt"
    head = " /h1_2/torso_link/left_shoulder_pitch_joint, /h1_2/x/left_elbow_joint\n"
    file.write_text(head + "0.1, 0.2\n0.3, 0.4\n")
    motion = read_motion(file, robot)
    columns = robot.index(["left_shoulder_pitch_joint", "left_elbow_joint"])
    assert motion.ctrl[:, columns].tolist() == [[0.1, 0.2], [0.3, 0.4]]
    assert motion.moved(robot) == ("left_shoulder_pitch_joint", "left_elbow_joint")
    assert motion.level == "upper_body"
    assert motion.dt == 0.02


def test_a_public_sage_motion_is_read_and_can_be_fitted():
    from conftest import SHARED

    from gaponet.motion.feasible import Feasibility

    file = SHARED / "sage_motions/motion_files/h1_2/amass/0-Subject_4_F_5_poses_action_sequence.txt"
    if not file.is_file():
        pytest.skip(f"no public motions at {file}")
    robot = load_robot("h1_2")
    motion = read_motion(file, robot)
    limits = Feasibility(robot)
    assert len(motion.ctrl) == 91
    assert limits.demand(limits.fit(motion).ctrl, motion.dt).met


@pytest.mark.parametrize(
    ("name", "text", "message"),
    [
        ("bad.txt", "shoulder,elbow\n0,0\n0,x\n", r"bad\.txt:3: .*0,x"),
        ("bad.txt", "shoulder,elbow\n0,0\n0\n", r"bad\.txt:3: 1"),
        ("bad.txt", "shoulder,elbow\n0,0\n", "rows"),
        ("bad.txt", "shoulder,shoulder\n0,0\n0,0\n", "same"),
        ("bad.csv", "shoulder\n0\n0\n", r"bad\.csv:1:"),
        ("bad.csv", "time,shoulder\n0,0\n0.02,0\n0.05,0\n", "evenly"),
        ("bad.txt", "shoulder,elbow\n0,0\n45,0\n", r"45\.000"),
        ("bad.txt", "knee\n0\n1\n", "'knee'"),
    ],
)
def test_a_bad_file_is_an_error_that_says_what_is_wrong(arm, tmp_path, name, text, message):
    (tmp_path / name).write_text(text)
    with pytest.raises((LogError, JointMismatchError), match=message):
        read_motion(tmp_path / name, arm)


@pytest.mark.parametrize(
    ("arrays", "message"),
    [
        ({"joint_names": np.array("shoulder")}, ".*'joint_names'"),
        ({"joint_names": np.array(["shoulder"], object)}, ".*readable"),
        ({"ctrl": np.array([["x"], ["y"]])}, ".*'ctrl'"),
        ({"ctrl": np.full((3, 1), np.nan)}, "ctrl"),
        ({"ctrl": np.full((3, 1), 1e9)}, ".*radians"),
        ({"dt": None}, ".*'dt'"),
        ({"dt": [1, 2]}, ".*'dt'"),
        ({"dt": 0.0}, ".*period is 0 s"),
        ({"dt": 1e-30}, ".*1e-30"),
        ({"dt": np.nan}, ".*nan"),
    ],
)
def test_arrays_that_are_no_motion_are_refused(arm, tmp_path, arrays, message):
    good = {"joint_names": np.array(["shoulder"]), "ctrl": np.zeros((3, 1)), "dt": 0.02}
    stored = {name: array for name, array in (good | arrays).items() if array is not None}
    np.savez(tmp_path / "bad.npz", **stored)
    with pytest.raises(LogError, match=rf"bad\.npz: {message}"):
        read_motion(tmp_path / "bad.npz", arm)


def test_an_archive_that_unpacks_to_gigabytes_is_refused_unread(arm, tmp_path):
    import zipfile

    with zipfile.ZipFile(tmp_path / "bomb.npz", "w", zipfile.ZIP_DEFLATED) as file:
        file.writestr("ctrl.npy", bytes(80 << 20))
    with pytest.raises(LogError, match="64"):
        read_motion(tmp_path / "bomb.npz", arm)
    (tmp_path / "bad.npz").write_bytes(b"PK\x03\x04nothing")
    with pytest.raises(LogError, match=r"bad\.npz"):
        read_motion(tmp_path / "bad.npz", arm)
