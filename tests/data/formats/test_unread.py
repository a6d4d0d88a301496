"""Files that are no log as they lie there: the message says what to do with them."""

from pathlib import Path

import numpy as np
import pytest
from logs import arm_columns, table_text

from gaponet.base.errors import LogError
from gaponet.data.describe.guess import guess_logs
from gaponet.data.formats import ReadOptions, detect, look, read_logs
from gaponet.data.importer import ImportRequest, import_logs

SI = ReadOptions(position_unit="rad", time_unit="s")
POINTER = "version https://git-lfs.github.com/spec/v1\noid sha256:00\nsize 1\n"
JOINTS = ("shoulder", "elbow")


@pytest.mark.parametrize(
    ("name", "word"),
    [
        ("logs.zip", "unpack"),
        ("m.csv.gz", "unpack"),
        ("m.xlsx", "CSV"),
        ("m.npy", "savez"),
        ("m.txt", "--format"),
    ],
)
def test_what_is_no_log_yet_is_named_with_what_to_do(tmp_path, name, word):
    (tmp_path / name).write_bytes(b"PK\x03\x04 0 0\n")
    with pytest.raises(LogError, match=word):
        detect(tmp_path)


@pytest.mark.parametrize("suffix", ["csv", "txt", "json", "npz", "mat", "h5", "parquet", "tsv"])
def test_a_git_lfs_pointer_is_named_whatever_its_suffix(tmp_path, arm, suffix):
    (tmp_path / f"m.{suffix}").write_text(POINTER)
    with pytest.raises(LogError, match="LFS"):
        list(read_logs(tmp_path, arm, SI))


@pytest.mark.parametrize("address", ["user/set", "datasets/user/set/data/file.parquet"])
def test_an_address_that_was_not_downloaded_names_the_command_that_does_it(arm, address):
    with pytest.raises(LogError, match="hf://user/set "):
        list(read_logs(Path(f"hf://{address}"), arm, SI))


def test_tables_in_folders_below_are_recordings_with_names_of_their_own(tmp_path, arm):
    columns = arm_columns()
    for day in ("monday", "tuesday"):
        (tmp_path / day).mkdir()
        (tmp_path / day / "run.csv").write_text(table_text(columns))
    assert [name for name, _ in read_logs(tmp_path, arm, SI)] == ["monday-run", "tuesday-run"]


def test_recordings_of_a_dataset_are_no_tables(tmp_path, arm):
    (tmp_path / "logs").mkdir()
    (tmp_path / "logs" / "m.csv").write_text(table_text(arm_columns()))
    units = {"position_unit": "rad", "time_unit": "s"}
    import_logs(
        tmp_path / "logs",
        arm,
        tmp_path / "data",
        ImportRequest(unit_id="u", payload_mass=0.0, **units),
    )
    with pytest.raises(LogError, match="dataset"):
        detect(tmp_path / "data")


@pytest.mark.parametrize("pattern", ["{name}/{kind}.csv", "{kind}/{name}.csv"])
def test_files_that_belong_together_may_lie_in_folders(tmp_path, arm, pattern):
    columns = arm_columns()
    arrays = {
        "time": columns["time"],
        "desired": np.stack([columns[f"ctrl.{joint}"] for joint in JOINTS], axis=1),
        "measured": np.stack([columns[f"qpos.{joint}"] for joint in JOINTS], axis=1),
    }
    for name in ("run0", "run1"):
        for kind, values in arrays.items():
            file = tmp_path / "logs" / pattern.format(name=name, kind=kind)
            file.parent.mkdir(parents=True, exist_ok=True)
            np.savetxt(file, values, delimiter=",")
    kind, known, found = look(tmp_path / "logs")
    (tmp_path / "logs.toml").write_text(guess_logs(found, arm, kind, dict(known)))
    logs = dict(read_logs(tmp_path / "logs", arm, ReadOptions(logs=tmp_path / "logs.toml")))
    assert list(logs) == ["run0", "run1"]
    assert np.array_equal(logs["run1"].channels["ctrl"].values, arrays["desired"])


def test_a_command_and_a_state_file_may_have_clocks_of_different_rates(tmp_path, arm):
    columns = arm_columns()
    for kind, channel, every in (("des", "ctrl", 2), ("meas", "qpos", 1)):
        one = {"t": columns["time"]} | {joint: columns[f"{channel}.{joint}"] for joint in JOINTS}
        (tmp_path / f"q_{kind}_01.csv").write_text(
            table_text({name: values[::every] for name, values in one.items()})
        )
    kind, known, found = look(tmp_path)
    (tmp_path / "logs.toml").write_text(guess_logs(found, arm, kind, dict(known)))
    ((_, log),) = read_logs(tmp_path, arm)
    assert np.array_equal(log.channels["ctrl"].time, columns["time"][::2])
    assert np.array_equal(log.channels["qpos"].time, columns["time"])


def test_a_file_per_joint_is_refused(tmp_path, arm):
    columns = arm_columns()
    for joint in JOINTS:
        one = {"t": columns["time"]}
        one |= {"cmd": columns[f"ctrl.{joint}"], "pos": columns[f"qpos.{joint}"]}
        (tmp_path / f"{joint}.csv").write_text(table_text(one))
    kind, known, found = look(tmp_path)
    with pytest.raises(LogError, match="joint"):
        guess_logs(found, arm, kind, dict(known))


def test_several_recordings_in_one_array_are_named(tmp_path, arm):
    np.savez(tmp_path / "m.npz", cmd=np.zeros((3, 50, 2)), pos=np.zeros((3, 50, 2)))
    with pytest.raises(LogError, match="axes"):
        look(tmp_path)


def test_logs_may_lie_in_folders_inside_a_dataset(tmp_path, arm):
    (tmp_path / "dataset.json").write_text("{}")
    day = tmp_path / "raw" / "monday"
    day.mkdir(parents=True)
    (day / "m.csv").write_text(table_text(arm_columns()))
    assert len(list(read_logs(tmp_path / "raw", arm, SI))) == 1


def test_arrays_in_files_of_commands_and_states_are_guessed_as_families(tmp_path, arm):
    positions = 0.1 * np.ones((50, 2))
    for name in ("walk_q", "walk_cmd", "jump_q", "jump_cmd"):
        np.savez(tmp_path / f"{name}.npz", positions)
    kind, known, found = look(tmp_path)
    assert 'command_file = "{name}_cmd.npz"' in guess_logs(found, arm, kind, dict(known))


def test_an_address_of_another_store_is_to_be_downloaded(arm):
    with pytest.raises(LogError, match="download"):
        list(read_logs(Path("s3://bucket/logs"), arm, SI))


def test_a_folder_of_nothing_that_could_be_a_log_names_the_formats(tmp_path):
    (tmp_path / "robot.stl").write_bytes(b"solid")
    with pytest.raises(LogError, match="--formats") as refused:
        detect(tmp_path)
    assert "--format table" not in str(refused.value)
