"""Importing: nothing of a bad source, whatever is missing of a good one, into a new dataset or
behind what is there.
"""

import errno
import hashlib
import itertools
import json
import os
import shutil
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest
from logs import arm_columns, late, table_text, wave, write_sage, write_so101

from gaponet.base.errors import DatasetError, FolderError, LogError, UsageError
from gaponet.data.importer import ImportRequest, import_logs
from gaponet.data.offsets import FILE
from gaponet.data.store import Dataset

SI = {"position_unit": "rad", "time_unit": "s"}

LAB = ImportRequest(unit_id="lab", payload_mass=0.0)


def write_two_motions(folder):
    """Write two SO-101 motions, 2 periods late."""
    for i, name in enumerate(("up", "down")):
        ctrl = wave(200, 6, hertz=0.5 + 0.2 * i)
        write_sage(folder / "real" / "so101" / "custom" / name, ctrl, late(ctrl, 2))
    return folder


@pytest.fixture
def logs(tmp_path):
    return write_two_motions(tmp_path / "logs")


def test_every_motion_becomes_a_sequence_with_its_origin(logs, so101, tmp_path):
    seen = []
    report = import_logs(
        logs,
        so101,
        tmp_path / "data",
        ImportRequest(unit_id="lab", payload_mass=0.0, level="joint"),
        progress=lambda *what: seen.append(what),
    )
    assert seen == [(1, 2, "down"), (2, 2, "up")]
    assert [e.meta.motion for e in report.entries] == ["down", "up"]
    assert report.entries[0].findings["delay_s"]["elbow_flex"] == pytest.approx(
        2 * 0.02006, abs=0.003
    )
    for file in (tmp_path / "data").glob("*.json*"):
        assert str(tmp_path) not in file.read_text()  # no absolute path enters a dataset
    assert len(Dataset(tmp_path / "data")) == 2
    meta = report.entries[0].meta
    assert (meta.unit_id, meta.payload_mass, meta.level, meta.virtual) == (
        "lab",
        0.0,
        "joint",
        False,
    )
    assert meta.source == "logs/real/so101/custom/down"
    folder = logs / "real" / "so101" / "custom" / "down"
    both = (folder / "control.csv").read_bytes() + (folder / "state_motor.csv").read_bytes()
    assert meta.source_sha256 == hashlib.sha256(both).hexdigest()


def test_what_is_there_is_counted_and_the_rest_is_added(logs, so101, tmp_path):
    first = import_logs(logs, so101, tmp_path / "data", LAB)
    write_so101(logs / "real" / "so101" / "custom" / "new")
    second = import_logs(logs, so101, tmp_path / "data", LAB)
    assert [e.meta.motion for e in second.entries] == ["new"]
    assert second.present == first.entries
    assert len(Dataset(tmp_path / "data")) == 3


def test_one_recording_twice_in_the_source_is_refused(logs, so101, tmp_path):
    custom = logs / "real" / "so101" / "custom"
    shutil.copytree(custom / "up", custom / "up_again")
    with pytest.raises(DatasetError, match="up_again"):
        import_logs(logs, so101, tmp_path / "data", LAB)
    assert not (tmp_path / "data").exists()


def test_other_payloads_and_units_are_appended(logs, so101, tmp_path):
    import_logs(logs, so101, tmp_path / "data", LAB)
    for lag, unit, mass, side in ((3, "lab", 0.2, "hand"), (4, "roof", 0.0, None)):
        ctrl = wave(200, 6)
        write_sage(tmp_path / unit / "up", ctrl, late(ctrl, lag))
        report = import_logs(
            tmp_path / unit,
            so101,
            tmp_path / "data",
            ImportRequest(unit_id=unit, payload_mass=mass, payload_side=side),
        )
    assert [(e.meta.unit_id, e.meta.payload_mass) for e in report.dataset.entries[1:]] == [
        ("lab", 0.0),
        ("lab", 0.2),
        ("roof", 0.0),
    ]


@pytest.mark.parametrize(("unit", "mass"), [("lab", 0.2), ("roof", 0.0)])
def test_known_samples_under_new_labels_are_refused_and_can_be_had_once_the_old_ones_are_gone(
    logs, so101, tmp_path, unit, mass
):
    dataset = import_logs(logs, so101, tmp_path / "data", LAB).dataset
    write_so101(logs / "real" / "so101" / "custom" / "new")
    with pytest.raises(
        DatasetError,
        match="down-lab",
    ):
        import_logs(logs, so101, tmp_path / "data", ImportRequest(unit_id=unit, payload_mass=mass))
    assert len(Dataset(tmp_path / "data")) == 2
    assert [e.meta.motion for e in dataset.remove(("*-lab-0kg-*",))] == ["down", "up"]
    assert (
        len(
            import_logs(
                logs, so101, tmp_path / "data", ImportRequest(unit_id=unit, payload_mass=mass)
            ).dataset
        )
        == 3
    )


def test_a_second_take_of_a_motion_is_its_next_repetition(logs, so101, tmp_path):
    import_logs(logs, so101, tmp_path / "data", LAB)
    again = wave(150, 6)
    write_sage(tmp_path / "later" / "up", again, late(again, 2))
    report = import_logs(tmp_path / "later", so101, tmp_path / "data", LAB)
    assert [e.meta.repetition for e in report.entries] == [1]


@pytest.mark.parametrize("mass", [0, np.float32(0.0), "0", -0.0])
def test_a_payload_is_the_same_whatever_its_type(logs, so101, tmp_path, mass):
    first = import_logs(logs, so101, tmp_path / "data", LAB)
    again = import_logs(logs, so101, tmp_path / "data", replace(LAB, payload_mass=mass))
    assert (again.added, again.present) == ((), first.entries)


def test_a_payload_has_the_digits_that_were_given(logs, so101, tmp_path):
    light = replace(LAB, payload_mass=np.float32(0.1))
    entries = import_logs(logs, so101, tmp_path / "data", light).entries
    assert {entry.meta.payload_mass for entry in entries} == {0.1}
    with pytest.raises(LogError, match="heavy"):
        import_logs(logs, so101, tmp_path / "other", replace(LAB, payload_mass="heavy"))


@pytest.mark.parametrize("name", ["kp", "kd"])
def test_gains_that_are_stated_later_are_refused_until_the_old_recordings_are_gone(
    logs, so101, tmp_path, name
):
    dataset = import_logs(logs, so101, tmp_path / "data", LAB).dataset
    stated = replace(LAB, **{name: ("5",)})
    with pytest.raises(DatasetError, match=f"another {name}.*gaponet data remove"):
        import_logs(logs, so101, tmp_path / "data", stated)
    dataset.remove(("*",))
    for entry in import_logs(logs, so101, tmp_path / "data", stated).added:
        assert set(getattr(entry.meta, name)) == {5.0}


def test_a_log_that_is_there_is_not_read_in_another_way_beside_it(logs, so101, tmp_path):
    import_logs(logs, so101, tmp_path / "data", LAB)
    with pytest.raises(DatasetError, match="in another way"):
        import_logs(logs, so101, tmp_path / "data", replace(LAB, cut=1.0))
    assert len(Dataset(tmp_path / "data")) == 2
    import_logs(logs, so101, tmp_path / "pieces", replace(LAB, cut=1.0))


def test_a_repetition_has_a_number_of_its_own_where_another_was_removed(so101, tmp_path):
    for take in range(3):
        ctrl = wave(200, 6)
        write_sage(tmp_path / str(take) / "up", ctrl, late(ctrl, 2 + take))
        dataset = import_logs(tmp_path / str(take), so101, tmp_path / "data", LAB).dataset
        if take == 1:
            dataset.remove(("*r0*",))
    assert [entry.meta.repetition for entry in Dataset(tmp_path / "data").entries] == [1, 2]


def test_one_bad_file_leaves_nothing_behind(logs, so101, tmp_path):
    state = logs / "real" / "so101" / "custom" / "up" / "state_motor.csv"
    state.write_text(state.read_text()[:-100])
    with pytest.raises(LogError, match=r"up/state_motor\.csv:201"):
        import_logs(logs, so101, tmp_path / "data", LAB)
    assert not (tmp_path / "data").exists()


class FailingDisk:
    """Makes one operation on the disk fail as on a full disk, the one after `before_failure` - 1
    others.
    """

    def __init__(self, patch):
        self.before_failure = 0
        for name in ("replace", "fsync", "pwrite", "mkdir"):
            patch.setattr(os, name, self.counted(getattr(os, name)))

    def counted(self, operation):
        def call(*args, **more):
            self.before_failure -= 1
            if self.before_failure == 0:
                raise OSError(errno.ENOSPC, "No space left on device")
            return operation(*args, **more)

        return call

    @property
    def has_failed(self):
        return self.before_failure <= 0


def import_without_gravity(logs, robot, out):
    no_load = lambda qpos, mass, side: 0 * qpos  # noqa: E731
    return import_logs(logs, robot, out, LAB, gravity=no_load)


def import_cut_short(disk, operations, logs, robot, out):
    """Import, and return True if the disk failed: at this of the import's operations."""
    disk.before_failure = operations
    try:
        import_without_gravity(logs, robot, out)
    except OSError:
        assert disk.has_failed
    return disk.has_failed


class CutImports(NamedTuple):
    logs: Path
    folders: list[Path]  # one for each operation on the disk that can fail


@pytest.fixture(scope="module")
def cut_imports(so101, tmp_path_factory):
    """What imports of two motions leave behind, each cut short at another operation."""
    place = tmp_path_factory.mktemp("cut_imports")
    logs = write_two_motions(place / "logs")
    folders = []
    with pytest.MonkeyPatch.context() as patch:
        disk = FailingDisk(patch)
        for operations in itertools.count(1):
            out = place / f"cut{operations}"
            if not import_cut_short(disk, operations, logs, so101, out):
                break
            folders.append(out)
    assert len(folders) > 20
    return CutImports(logs, folders)


def test_an_import_cut_short_at_any_write_leaves_whole_sequences_or_nothing(cut_imports):
    for folder in cut_imports.folders:
        if not (folder / "dataset.json").exists():
            assert not folder.exists()
            continue
        dataset = Dataset(folder)
        files = {file.stem for file in folder.glob("sequences/*")}
        assert files == {entry.id for entry in dataset.entries}
        dataset.sequences()  # reads each


def test_an_import_cut_short_at_any_write_is_finished_by_the_same_call(
    cut_imports, so101, tmp_path
):
    whole = import_without_gravity(cut_imports.logs, so101, tmp_path / "whole").dataset
    names = sorted(file.name for file in whole.path.rglob("*"))
    for folder in cut_imports.folders:
        out = tmp_path / folder.name
        if folder.exists():
            shutil.copytree(folder, out)
        import_without_gravity(cut_imports.logs, so101, out)
        assert Dataset(out).entries == whole.entries
        assert sorted(file.name for file in out.rglob("*")) == names


def test_a_folder_with_something_else_in_it_is_left_as_it_is(logs, so101, tmp_path):
    (tmp_path / "proj" / ".git").mkdir(parents=True)
    (tmp_path / "proj" / ".env").write_text("mine")
    with pytest.raises(FolderError, match=r"\.env"):
        import_logs(logs, so101, tmp_path / "proj", LAB)
    assert sorted(f.name for f in (tmp_path / "proj").iterdir()) == [".env", ".git"]


def test_what_a_person_added_to_a_dataset_stays(logs, so101, tmp_path, monkeypatch):
    import_logs(logs, so101, tmp_path / "data", LAB)
    (tmp_path / "data" / "NOTES").write_text("mine")
    write_so101(logs / "real" / "so101" / "custom" / "new")
    monkeypatch.setattr(Dataset, "append", lambda *_: 1 / 0)
    with pytest.raises(ZeroDivisionError):
        import_logs(logs, so101, tmp_path / "data", LAB)
    assert (tmp_path / "data" / "NOTES").read_text() == "mine"
    assert len(Dataset(tmp_path / "data")) == 2


def test_another_robots_dataset_is_refused_before_anything_is_read(logs, so101, arm, tmp_path):
    Dataset.create(tmp_path / "data", arm)
    shutil.rmtree(logs)
    with pytest.raises(DatasetError, match="'arm'"):
        import_logs(logs, so101, tmp_path / "data", LAB)


def test_a_hand_the_robot_does_not_have_is_refused(logs, so101, tmp_path):
    with pytest.raises(UsageError, match="'left'"):
        import_logs(
            logs,
            so101,
            tmp_path / "data",
            ImportRequest(unit_id="lab", payload_mass=0.2, payload_side="left"),
        )


def test_offsets_are_fitted_where_a_gravity_is_given(logs, so101, tmp_path):
    asked = []

    def weightless(qpos, payload_mass, payload_side):
        asked.append((payload_mass, payload_side))
        return np.zeros_like(qpos)

    report = import_logs(
        logs,
        so101,
        tmp_path / "data",
        ImportRequest(unit_id="lab", payload_mass=0.2),
        gravity=weightless,
        simulator="abc",
    )
    assert asked[0] == (0.2, "both")
    assert list(report.offsets) == list(so101.operated)
    assert json.loads((tmp_path / "data" / FILE).read_text())["units"]["lab"]["simulator"] == "abc"


def test_the_40_real_motions_come_in_as_recorded(real_dataset):
    assert len(real_dataset) == 40
    assert real_dataset.hours() * 60 == pytest.approx(59.3, abs=0.1)
    assert {e.dt for e in real_dataset.entries} == {0.02006}
    assert all(e.meta.notes["rows"] == "as recorded" for e in real_dataset.entries)


def test_a_source_named_by_a_dot_is_known_by_its_folder(so101, tmp_path, monkeypatch):
    monkeypatch.chdir(write_so101(tmp_path / "wave"))
    meta = import_logs(".", so101, tmp_path / "data", LAB).entries[0].meta
    assert (meta.motion, meta.source) == ("wave", "wave")


def test_gains_are_the_robots_unless_said_by_joint_or_for_all(logs, so101, tmp_path):
    first = import_logs(logs, so101, tmp_path / "a", LAB).entries[0].meta
    assert first.kp == tuple(so101.servo.kp)
    said = import_logs(
        logs,
        so101,
        tmp_path / "b",
        ImportRequest(
            unit_id="lab", payload_mass=0.0, kp=("elbow_flex=9", "gripper=4"), kd=("0.1",)
        ),
    )
    meta = Dataset(tmp_path / "b").entries[0].meta
    assert meta == said.entries[0].meta
    assert dict(zip(so101.joint_names, meta.kp, strict=True)) == (
        dict(zip(so101.joint_names, so101.servo.kp, strict=True))
        | {"elbow_flex": 9.0, "gripper": 4.0}
    )
    assert meta.kd == (0.1,) * 6


def test_of_gains_that_the_logs_state_those_of_named_joints_are_replaced(tmp_path, arm):
    (tmp_path / "logs").mkdir()
    (tmp_path / "logs" / "m.csv").write_text(table_text(arm_columns()))
    (tmp_path / "logs" / "logs.toml").write_text(
        'kp = 40.0\nposition_unit = "rad"\ntime_unit = "s"\n'
    )
    request = ImportRequest(unit_id="lab", payload_mass=0.0, kp=("elbow=15",))
    (entry,) = import_logs(tmp_path / "logs", arm, tmp_path / "data", request).entries
    assert entry.meta.kp == (40.0, 15.0)


@pytest.mark.parametrize("words", [("stiff",), ("-1",), ("5", "6"), ("elbow_flex=nan",)])
def test_gains_that_make_no_sense_are_refused(logs, so101, tmp_path, words):
    with pytest.raises(UsageError, match="number"):
        import_logs(
            logs, so101, tmp_path / "data", ImportRequest(unit_id="lab", payload_mass=0.0, kp=words)
        )
    with pytest.raises(UsageError, match="twice"):
        import_logs(
            logs,
            so101,
            tmp_path / "data",
            ImportRequest(unit_id="lab", payload_mass=0.0, kp=("elbow_flex=9", "elbow_flex=5")),
        )


def test_a_journal_from_before_gains_were_kept_still_opens(logs, so101, tmp_path):
    import_logs(logs, so101, tmp_path / "data", LAB)
    journal = tmp_path / "data" / "sequences.jsonl"
    old = [json.loads(line) for line in journal.read_text().splitlines()]
    for line in old:
        del line["meta"]["kp"], line["meta"]["kd"]
    journal.write_text("".join(json.dumps(line) + "\n" for line in old))
    data = Dataset(tmp_path / "data")
    assert data.read(data.entries[0]).meta.kp is None


def test_a_motion_with_a_name_of_many_letters_is_stored(arm, tmp_path):
    file = tmp_path / ("a" * 240 + ".csv")
    file.write_text(table_text(arm_columns()))
    data = import_logs(
        file,
        arm,
        tmp_path / "out",
        ImportRequest(unit_id="b" * 300, payload_mass=0.0, position_unit="rad", time_unit="s"),
    ).dataset
    assert len(data.read(data.entries[0])) == 60
    assert data.entries[0].meta.motion == "a" * 240


def test_pieces_below_a_second_have_names_of_their_own(arm, tmp_path):
    (tmp_path / "swing.csv").write_text(table_text(arm_columns(rows=160)))
    request = ImportRequest(unit_id="lab", payload_mass=0.0, cut=0.8, **SI)
    pieces = import_logs(tmp_path / "swing.csv", arm, tmp_path / "data", request).entries
    names = {piece.meta.motion for piece in pieces}
    assert names == {"swing@0.0s", "swing@0.8s", "swing@1.6s", "swing@2.4s"}


@pytest.mark.parametrize("cut", [0.0, 0.5, float("nan")])
def test_pieces_that_are_too_short_are_refused(logs, so101, tmp_path, cut):
    with pytest.raises(UsageError, match="--cut"):
        import_logs(
            logs, so101, tmp_path / "data", ImportRequest(unit_id="lab", payload_mass=0.0, cut=cut)
        )


@pytest.mark.parametrize(
    ("labels", "word"), [({"payload_mass": 0.0}, "--unit-id"), ({"unit_id": "a"}, "--payload-mass")]
)
def test_a_label_that_nobody_stated_is_asked_for(logs, so101, tmp_path, labels, word):
    with pytest.raises(UsageError, match=word):
        import_logs(logs, so101, tmp_path / "data", ImportRequest(**labels))
    assert not (tmp_path / "data").exists()


def test_logs_of_which_all_are_left_out_are_refused_with_the_first_reason(logs, so101, tmp_path):
    for state in logs.rglob("state_motor.csv"):
        state.unlink()
    with pytest.raises(LogError, match="down"):
        import_logs(
            logs,
            so101,
            tmp_path / "data",
            ImportRequest(unit_id="lab", payload_mass=0.0, skip_bad=True),
        )


def test_logs_of_which_a_sheet_leaves_all_out_are_refused(arm, tmp_path):
    (tmp_path / "logs").mkdir()
    (tmp_path / "logs" / "m.csv").write_text(table_text(arm_columns()))
    (tmp_path / "logs" / "logs.toml").write_text('manifest = "sheet.csv"\n')
    (tmp_path / "logs" / "sheet.csv").write_text("file,leave_out\nm,yes\n")
    with pytest.raises(LogError, match="recording"):
        import_logs(
            tmp_path / "logs",
            arm,
            tmp_path / "data",
            ImportRequest(unit_id="lab", payload_mass=0.0, **SI),
        )
