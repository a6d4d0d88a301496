"""npz, HDF5, .mat, .pt and ASAP's pickle: the same motion in each, and what may not be opened."""

import os
import pickle
import subprocess
import zipfile
from pathlib import Path

import numpy as np
import pytest
import strange_logs
from logs import arm_columns, table_text
from strange_logs import motion, write_bag

from gaponet.base.errors import LogError, UsageError
from gaponet.cli.main import main
from gaponet.data.formats import ReadOptions, about, detect, pickles, read_logs
from gaponet.data.sequence import SequenceMeta, to_sequence

WRITERS = {
    "npz": strange_logs.write_npz,
    "hdf5": strange_logs.write_aloha,
    "mat": strange_logs.write_mat,
    "pace": strange_logs.write_pace,
    "asap": strange_logs.write_asap,
}


PAGE = (Path(__file__).parents[3] / "docs" / "logs.md").read_text(encoding="utf-8")
HEADINGS = {
    "hdf5": "### HDF5",
    "npz": "### NumPy",
    "mat": "### MATLAB",
    "pace": "### PACE",
    "asap": "### ASAP",
}


def documented(heading):
    """The logs.toml below a heading of docs/logs.md."""
    return PAGE.split(heading)[1].split("```toml\n")[1].split("```")[0]


def test_a_description_of_two_lines_is_shown_whole():
    assert about("npz").endswith("arrays of one row per sample")


@pytest.mark.parametrize("fmt", WRITERS)
def test_the_same_motion_comes_out_of_each_also_by_the_lines_of_the_docs(tmp_path, arm, fmt):
    WRITERS[fmt](tmp_path)
    assert detect(tmp_path) == fmt
    ((name, log),) = read_logs(tmp_path, arm, ReadOptions(allow_pickle=True))
    ctrl, qpos = motion()
    assert name == {"hdf5": "episode_0", "asap": "walk"}.get(fmt, "a")
    assert log.joint_names == ("shoulder", "elbow")
    assert np.allclose(log.channels["qpos"].values, qpos)
    assert np.allclose(log.channels["qpos"].time, 0.02 * np.arange(len(qpos)), atol=1e-6)
    assert (log.meta.get("kp"), log.meta.get("kd")) == (
        ([20.0, 30.0], [1.0, 1.5]) if fmt == "pace" else (None, None)
    )
    (tmp_path / "logs.toml").write_text(documented(HEADINGS[fmt]))
    for by in (log, next(read_logs(tmp_path, arm, ReadOptions(allow_pickle=True)))[1]):
        assert np.allclose(by.channels["ctrl"].values, ctrl)


def test_the_lines_that_the_docs_give_for_tables_and_bags_work(tmp_path, arm):
    columns = dict(
        zip(
            ["t", "shoulder_des", "elbow_des", "shoulder_pos", "elbow_pos"],
            arm_columns().values(),
            strict=True,
        )
    )
    write_bag(tmp_path / "bag" / "wave", command="array")
    (tmp_path / "table").mkdir()
    (tmp_path / "table" / "wave.csv").write_text(table_text(columns))
    for folder, heading in (("bag", "### ROS bags"), ("table", "### Tables")):
        (tmp_path / folder / "logs.toml").write_text(documented(heading))
        ((_, log),) = read_logs(tmp_path / folder, arm)
        assert log.joint_names == ("shoulder", "elbow")


@pytest.mark.parametrize("fmt", WRITERS)
def test_half_a_file_is_one_clear_error(tmp_path, arm, fmt):
    WRITERS[fmt](tmp_path)
    file = next(f for f in tmp_path.iterdir() if f.suffix != ".toml")
    file.write_bytes(file.read_bytes()[: file.stat().st_size // 2])
    with pytest.raises(LogError, match=file.name):
        list(read_logs(tmp_path, arm, ReadOptions(fmt, allow_pickle=True)))
    if file.suffix in (".pt", ".npz"):  # which say where they end
        with pytest.raises(LogError, match="short"):
            list(read_logs(tmp_path, arm, ReadOptions(fmt)))
        file.write_bytes(b"not a zip file at all")
        with pytest.raises(LogError, match="readable"):
            list(read_logs(tmp_path, arm, ReadOptions(fmt)))


def test_gains_of_another_number_of_joints_are_one_clear_error(tmp_path, arm):
    import torch

    WRITERS["pace"](tmp_path)
    file = tmp_path / "a.pt"
    torch.save(torch.load(file, weights_only=False) | {"kp": np.array([20.0, 30.0, 40.0])}, file)
    with pytest.raises(LogError, match="kp"):
        list(read_logs(tmp_path, arm))


def test_gains_of_some_joints_in_logs_toml_leave_the_others_as_recorded(tmp_path, arm):
    WRITERS["pace"](tmp_path)
    with (tmp_path / "logs.toml").open("a") as toml:
        toml.write("kp = { shoulder = 12.0 }\n")
    ((_, log),) = read_logs(tmp_path, arm)
    assert log.meta["kp"] == [12.0, 30.0]


@pytest.mark.parametrize("fmt", ["pace", "hdf5", "mat"])
def test_an_array_without_names_asks_for_them(tmp_path, arm, fmt):
    WRITERS[fmt](tmp_path)
    toml = tmp_path / "logs.toml"
    toml.write_text(toml.read_text().replace('joints = ["shoulder", "elbow"]\n', ""))
    with pytest.raises(LogError, match="joints"):
        list(read_logs(tmp_path, arm))
    toml.write_text('joints = ["shoulder"]\n' + toml.read_text())
    with pytest.raises(LogError, match="joints"):
        list(read_logs(tmp_path, arm))


@pytest.mark.parametrize("objects", [True, False])
def test_gaponets_motion_file_holds_several_with_their_payloads(tmp_path, arm, objects):
    strange_logs.write_gaponet(tmp_path, objects=objects)
    found = list(read_logs(tmp_path, arm))
    assert [name for name, _ in found] == ["a-0000", "a-0001"]
    assert [log.meta["stated"]["payload_mass"] for _, log in found] == [0.0, 0.2]
    assert [len(log.channels["qpos"].time) for _, log in found] == [40, 37 if objects else 40]
    assert np.allclose(found[0][1].channels["ctrl"].values, motion()[0])


def test_windows_in_which_one_joint_moves_are_recordings_of_that_joint(tmp_path, arm):
    """The others stand where logs.toml says, or at home, and both is noted."""
    ctrl, qpos = motion()
    columns = {
        "positions": qpos,
        "positions_cmd": ctrl,
        "velocities": 0 * qpos,
        "torques": 0 * qpos,
    }
    np.savez(
        tmp_path / "motor.npz",
        joint_sequence=np.array(["elbow", "shoulder"]),
        **{f"real_dof_{name}": x.T[::-1] for name, x in columns.items()},
    )
    with pytest.raises(LogError, match="rate"):
        list(read_logs(tmp_path, arm))
    (tmp_path / "logs.toml").write_text("[posture]\nshoulder = 0.3\n")
    (_, elbow), (name, shoulder) = read_logs(tmp_path, arm, ReadOptions(rate=50.0))
    assert (name, elbow.joint_names, shoulder.joint_names) == (
        "motor-0001",
        ("elbow",),
        ("shoulder",),
    )
    assert np.allclose(elbow.channels["ctrl"].values[:, 0], ctrl[:, 1])
    made = [to_sequence(log, arm, SequenceMeta("arm", "a", "m", 0.0)) for log in (elbow, shoulder)]
    assert [s.meta.unrecorded for s in made] == [("shoulder",), ("elbow",)]
    assert [s.meta.notes.get("held_at_home") for s in made] == [None, ["elbow"]]
    assert (made[0].qpos[:, 0] == np.float32(0.3)).all()
    assert (made[0].qvel[:, 0] == 0).all()


@pytest.mark.parametrize("turned", [False, True])
def test_a_list_of_gains_turns_no_table_and_keeps_none_from_turning(tmp_path, arm, turned):
    ctrl, qpos = motion()
    tables = {"target": ctrl, "q": qpos}
    if turned:
        tables = {name: table.T for name, table in tables.items()}
    np.savez(tmp_path / "m.npz", **tables, kp=np.array([20.0, 20.0]))
    (tmp_path / "logs.toml").write_text(
        strange_logs.sheet(
            ctrl="target", qpos="q", joints=arm.joint_names, rate=50.0, position_unit="rad"
        )
    )
    ((_, log),) = read_logs(tmp_path, arm)
    assert np.array_equal(log.channels["qpos"].values, qpos)


def test_every_demonstration_of_robomimic_is_a_recording(tmp_path, arm):
    h5py = pytest.importorskip("h5py")
    ctrl, qpos = motion()
    with h5py.File(tmp_path / "low_dim.hdf5", "w") as file:
        for i in (10, 2, 1):
            file[f"data/demo_{i}/obs/robot0_joint_pos"] = qpos
            file[f"data/demo_{i}/targets"] = ctrl + 0.01 * i
            file[f"data/demo_{i}/actions"] = np.zeros((40, 7))
    with pytest.raises(LogError, match=r"actions\[7\]"):
        list(read_logs(tmp_path, arm))
    (tmp_path / "logs.toml").write_text(
        strange_logs.sheet(
            ctrl="targets",
            qpos="obs/robot0_joint_pos",
            joints=arm.joint_names,
            rate=20.0,
            position_unit="rad",
        )
    )
    found = list(read_logs(tmp_path, arm))
    assert [name for name, _ in found] == ["low_dim-demo_1", "low_dim-demo_2", "low_dim-demo_10"]
    assert np.allclose(found[2][1].channels["ctrl"].values, ctrl + 0.1)


@pytest.mark.parametrize("below", ["", "/position"])
def test_arrays_in_a_group_called_data_are_no_demonstrations(tmp_path, arm, below):
    h5py = pytest.importorskip("h5py")
    ctrl, qpos = motion()
    with h5py.File(tmp_path / "wave.hdf5", "w") as file:
        file[f"data/ctrl{below}"] = ctrl
        file[f"data/qpos{below}"] = qpos
    (tmp_path / "logs.toml").write_text(
        strange_logs.sheet(
            ctrl=f"data/ctrl{below}",
            qpos=f"data/qpos{below}",
            joints=arm.joint_names,
            rate=50.0,
            position_unit="rad",
        )
    )
    ((name, log),) = read_logs(tmp_path, arm)
    assert name == "wave"
    assert np.allclose(log.channels["qpos"].values, qpos)


def test_links_in_an_hdf5_file_are_not_followed(tmp_path, arm):
    h5py = pytest.importorskip("h5py")
    strange_logs.write_aloha(tmp_path)
    with h5py.File(tmp_path / "episode_0.hdf5", "a") as file:
        del file["action"]
        file["action"] = h5py.ExternalLink(str(tmp_path / "other.hdf5"), "/action")
        file["observations/loop"] = h5py.SoftLink("/observations")
    with pytest.raises(
        LogError,
        match=r"observations/qvel\[2\]",
    ):
        list(read_logs(tmp_path, arm))


def test_a_pickle_is_opened_only_where_that_was_allowed(tmp_path, arm, capsys):
    strange_logs.write_asap(tmp_path)
    with pytest.raises(UsageError, match="--allow-pickle"):
        list(read_logs(tmp_path, arm))
    told = [
        "import",
        str(tmp_path),
        "--robot",
        str(arm.mjcf.parent),
        "--unit-id",
        "a",
        "--payload-mass",
        "0",
    ]
    assert main([*told, "--out", str(tmp_path / "data")]) == 2
    assert main([*told, "--out", str(tmp_path / "data"), "--allow-pickle"]) == 0


class Evil:
    """Says to a pickle what to call."""

    def __init__(self, *call):
        self.call = call

    def __reduce__(self):
        return self.call


def evil(mark):
    """Objects that make the file `mark` or ask for terabytes when they are unpickled as usual."""
    yield from (Evil(os.system, (f"touch {mark}",)), Evil(subprocess.call, (["touch", mark],)))
    yield from (Evil(eval, (f"open({mark!r}, 'w')",)), Evil(np.load, (mark,)))
    yield from (
        Evil(np.fromfile, (mark,)),
        Evil(np.ndarray, ((1 << 40,),)),
        Evil(bytearray, (1 << 60,)),
    )


def write_evil_npz(folder, thing):
    np.savez(
        folder / "a.npz",
        real_dof_positions=np.array([thing], object),
        real_dof_positions_cmd=np.zeros(1),
    )


def write_evil_pt(folder, thing):
    import torch

    torch.save({"time": thing}, folder / "a.pt")


def write_evil_pickle(folder, thing):
    (folder / "a.pkl").write_bytes(
        pickle.dumps({"walk": {"dof": np.array([thing], object), "fps": 50}})
    )


@pytest.mark.parametrize("write", [write_evil_npz, write_evil_pt, write_evil_pickle])
def test_hostile_objects_in_a_file_run_nothing(tmp_path, arm, write):
    for thing in evil(str(tmp_path / "ran")):
        write(tmp_path, thing)
        with pytest.raises(LogError, match="run"):
            list(read_logs(tmp_path, arm, ReadOptions(allow_pickle=True)))
    assert not (tmp_path / "ran").exists()


def test_a_hostile_pickle_runs_nothing_and_a_good_one_of_any_protocol_is_read(tmp_path):
    for thing in evil(str(tmp_path / "ran")):
        for data in ({"walk": {"dof": thing}}, [thing]):
            with pytest.raises(LogError, match="run"):
                pickles.load(pickle.dumps(data), "x")
    assert not (tmp_path / "ran").exists()
    for protocol in range(6):
        found = pickles.load(
            pickle.dumps({"a": np.arange(6.0).reshape(2, 3), "b": [1, "x", None]}, protocol), "x"
        )
        assert np.array_equal(found["a"], np.arange(6.0).reshape(2, 3))
        assert found["b"] == [1, "x", None]


def test_a_tensor_that_repeats_one_number_a_trillion_times_is_left_alone(tmp_path, arm):
    import torch

    big = torch.zeros(1).expand(1 << 40)
    torch.save({"time": big, "dof_pos": big, "des_dof_pos": big}, tmp_path / "a.pt")
    with pytest.raises(LogError, match="ctrl"):
        list(read_logs(tmp_path, arm))


def test_an_array_that_says_it_is_huge_is_refused(tmp_path, arm):
    strange_logs.write_npz(tmp_path)
    huge = tmp_path / "a.npz"
    with zipfile.ZipFile(huge, "w", zipfile.ZIP_DEFLATED) as packed:
        packed.writestr("q.npy", b"")
        packed.infolist()[0].file_size = 600 << 20
    with pytest.raises(LogError, match="512"):
        list(read_logs(tmp_path, arm))
