"""What gaponet data export writes comes back: nothing is lost that the format can hold."""

import json
import pickle
from dataclasses import replace

import numpy as np
import pytest
from logs import arm_sequence, late, wave, write_so101

from gaponet.base.errors import LogError, UsageError
from gaponet.cli.main import main
from gaponet.data.formats import detect
from gaponet.data.importer import import_logs
from gaponet.data.sequence import ARRAYS
from gaponet.data.store import Dataset
from gaponet.data.writers import WRITERS, export

HOLDS = {  # channels beside command, position and velocity
    "lerobot": set(ARRAYS), "npz": set(ARRAYS), "asap": set(ARRAYS), "sage": {"tau"}, "mcap": {"tau"},
}  # fmt: skip
ALWAYS = {"ctrl", "qpos", "qvel"}
SAID = (
    "motion",
    "unit_id",
    "payload_mass",
    "payload_side",
    "level",
    "repetition",
    "virtual",
    "kp",
    "kd",
)


@pytest.fixture
def dataset(arm, tmp_path):
    """Two motions, one with a payload and other gains, of a virtual robot, at a rate that is no whole number."""
    data = Dataset.create(tmp_path / "data", arm)
    for i, gains in enumerate(((20.0, 20.0), (12.5, 0.1))):
        ctrl = wave(50, 2, hertz=0.4 + 0.13 * i) + 0.1 * i
        more = (
            {"tau": 2 * ctrl, "qacc": 3 * ctrl, "tau_eq": ctrl, "temperature": 30 + ctrl}
            if i
            else {"tau": ctrl}
        )
        sequence = arm_sequence(
            arm, ctrl, late(ctrl, 2), f"wave {i}", 0.1 * i, unit=f"u{i}", **more
        )
        meta = {
            "kp": gains,
            "kd": (0.0, 1 / 3),
            "virtual": bool(i),
            "level": "joint",
            "repetition": 4,
        }
        data.append(
            replace(sequence, dt=1 / 30 if i else 0.02006, meta=replace(sequence.meta, **meta))
        )
    return data


@pytest.mark.parametrize("to", WRITERS)
def test_what_is_written_is_read_back_without_a_word(dataset, arm, tmp_path, to):
    export(dataset, arm, tmp_path / "out", to)
    fmt = {"mcap": "rosbag"}.get(to, to)
    assert detect(tmp_path / "out") == fmt
    import_logs(tmp_path / "out", arm, None, None, tmp_path / "again", allow_pickle=to == "asap")
    again = {e.meta.motion: e for e in Dataset(tmp_path / "again").entries}
    for entry in dataset.entries:
        back = again[entry.meta.motion]
        assert back.hash == entry.hash
        assert back.dt == pytest.approx(entry.dt, abs=5e-8)
        assert set(back.channels) == set(entry.channels) & (ALWAYS | HOLDS[to])
        assert {n: getattr(back.meta, n) for n in SAID} == {n: getattr(entry.meta, n) for n in SAID}
        one, other = dataset.read(entry), Dataset(tmp_path / "again").read(back)
        for name in back.channels:
            assert np.array_equal(getattr(one, name), getattr(other, name)), name


def test_a_gripper_goes_out_and_comes_back_as_a_share_of_its_range(so101, tmp_path):
    write_so101(tmp_path / "logs" / "wave")
    import_logs(tmp_path / "logs", so101, "a", 0.0, tmp_path / "data")
    export(Dataset(tmp_path / "data"), so101, tmp_path / "out", "sage")
    import_logs(tmp_path / "out", so101, None, None, tmp_path / "again")
    one, other = (Dataset(tmp_path / d) for d in ("data", "again"))
    assert one.entries[0].hash == other.entries[0].hash
    assert np.allclose(
        one.read(one.entries[0]).qvel, other.read(other.entries[0]).qvel, atol=1e-5
    )  # derived again


def test_asap_finds_its_fields_and_the_targets_that_its_action_means(dataset, arm, tmp_path):
    export(dataset, arm, tmp_path / "out", "asap")
    entry = dataset.entries[1]
    ((name, motion),) = pickle.loads((tmp_path / "out" / f"{entry.id}.pkl").read_bytes()).items()
    assert name == entry.id
    shapes = {
        "dof": (50, 2),
        "action": (50, 2),
        "pose_aa": (50, 3, 3),
        "root_rot": (50, 4),
        "root_trans_offset": (50, 3),
    }
    assert {k: motion[k].shape for k in shapes} == shapes
    assert motion["fps"] == pytest.approx(30)
    targets = motion["default_dof_pos"] + motion["action_scale"] * motion["action"]
    assert np.allclose(targets, dataset.read(entry).ctrl, atol=1e-6)
    assert np.allclose(motion["pose_aa"][:, 1:, 1], motion["dof"])  # both joints turn about y


def test_the_command_says_how_to_come_back_and_overwrites_nothing(dataset, tmp_path, capsys):
    assert (
        main(["data", "export", str(dataset.path), "--out", str(tmp_path / "npz"), "--to", "npz"])
        == 0
    )
    assert f"gaponetimport{tmp_path / 'npz'}" in "".join(capsys.readouterr().out.split())
    assert (
        main(["data", "export", str(dataset.path), "--out", str(tmp_path / "npz"), "--to", "npz"])
        == 2
    )
    assert "exists and is not an empty folder" in capsys.readouterr().err


def test_no_such_writer(dataset, arm, tmp_path):
    with pytest.raises(UsageError, match="no writer 'xml'; use one of sage, npz"):
        export(dataset, arm, tmp_path / "out", "xml")
    assert not (tmp_path / "out").exists()


def test_what_an_export_says_of_a_recording_is_checked(dataset, arm, tmp_path):
    export(dataset, arm, tmp_path / "out", "npz")
    file = tmp_path / "out" / f"{dataset.entries[0].id}.npz"
    with np.load(file) as arrays:
        held = dict(arrays)
    told = json.loads(str(held["gaponet"]))
    told["stated"]["payload_mass"] = "heavy"
    np.savez(file, **held | {"gaponet": np.array(json.dumps(told))})
    with pytest.raises(
        LogError, match=r"payload_mass: should be a valid number, not 'heavy'; export it again"
    ):
        import_logs(tmp_path / "out", arm, None, None, tmp_path / "again")
