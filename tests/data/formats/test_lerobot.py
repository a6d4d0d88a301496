"""LeRobotDataset v3.0: what goes out comes back; stock sets are read with the unit that the user
says.
"""

import json
from dataclasses import replace

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from logs import SO101, arm_sequence, late, stock, wave

from gaponet.base.errors import DatasetError, LogError, UsageError
from gaponet.base.progress import no_progress
from gaponet.data.formats import ReadOptions, detect, read_logs
from gaponet.data.importer import ImportRequest, import_logs
from gaponet.data.store import Dataset
from gaponet.data.writers import export
from gaponet.data.writers import lerobot as lerobot_export


def export_lerobot(dataset, out, progress=no_progress):
    return export(dataset, out, progress)


@pytest.fixture
def dataset(arm, tmp_path):
    """Three motions of two units with all channels; metadata that a round trip could lose."""
    data, rng = Dataset.create(tmp_path / "data", arm), np.random.default_rng(0)
    for i, (unit, payload) in enumerate((("one", 0.0), ("two", 0.2), ("two", 0.2))):
        ctrl = wave(50 + 7 * i, 2, hertz=0.4 + 0.1 * i)
        extra = {
            c: rng.standard_normal(ctrl.shape) for c in ("qacc", "tau", "tau_eq", "temperature")
        }
        notes = {"rate_hz": 50.0, "warmth_K": 3.25, "events": [["0", "START"]]}
        sequence = arm_sequence(
            arm, ctrl, late(ctrl, 2), f"m{i}", payload, unit=unit, notes=notes, **extra
        )
        fields = {
            "repetition": 2 * i,
            "virtual": True,
            "level": "joint",
            "source": "somewhere/else.csv",
            "source_sha256": "ab" * 32,
            "recorded_at": "2026-01-02T03:04:05Z",
        }
        fields |= (
            {"kp": (5.0 + i, 6.0), "kd": (0.1, 0.2)} if i else {}
        )  # the first from before gains were kept
        data.append(replace(sequence, meta=replace(sequence.meta, **fields)))
    data.set_provenance(licence="CC0-1.0")
    return data


def back(lerobot, robot, out, **options):
    return import_logs(lerobot, robot, out, ImportRequest(format="lerobot", **options)).dataset


def same(one, other):
    """Every sample, period and field of metadata."""
    assert len(one) == len(other)
    for entry in one.entries:
        copy = other.find(entry.hash)
        assert copy is not None
        assert (copy.meta, copy.dt, copy.channels) == (entry.meta, entry.dt, entry.channels)
        for c in entry.channels:
            assert np.array_equal(getattr(one.read(entry), c), getattr(other.read(copy), c))


def test_a_round_trip_loses_nothing(dataset, arm, tmp_path):
    (written,) = export_lerobot(dataset, tmp_path / "out")
    assert (written.path, written.episodes, written.frames, written.fps) == (
        tmp_path / "out",
        3,
        171,
        50,
    )
    again = back(tmp_path / "out", arm, tmp_path / "again")
    same(dataset, again)
    assert again.header == dataset.header


def test_several_rates_become_several_sets_and_come_back(dataset, arm, tmp_path):
    fast = replace(dataset.read(dataset.entries[0]), dt=1 / 60)  # no whole number of 10 µs
    odd = replace(dataset.read(dataset.entries[1]), dt=0.02006)
    bare = replace(
        dataset.read(dataset.entries[2]),
        tau=None,
        tau_eq=None,
        qacc=None,
        temperature=None,
        ctrl=wave(64, 2),
    )
    for sequence in (fast, odd, bare):
        dataset.append(sequence)
    sets = export_lerobot(dataset, tmp_path / "out")
    assert [s.path.name for s in sets] == [
        "50hz-ctrl-qpos-qvel-qacc-tau-tau_eq-temperature",
        "60hz",
        "49.8504hz",
        "50hz-ctrl-qpos-qvel",
    ]
    same(dataset, back(tmp_path / "out", arm, tmp_path / "again"))


@pytest.fixture
def exported(dataset, tmp_path):
    """The one set of the dataset."""
    return export_lerobot(dataset, tmp_path / "out")[0].path


def test_the_layout_is_the_standards(exported):
    info = json.loads((exported / "meta" / "info.json").read_text())
    assert info["codebase_version"] == "v3.0"
    assert info["fps"] == 50
    assert info["robot_type"] == "arm"
    assert info["total_episodes"] == 3
    assert info["total_frames"] == 171
    assert info["splits"] == {"train": "0:3"}
    assert info["features"]["action"]["names"] == ["shoulder", "elbow"]
    assert info["features"]["observation.torque"]["info"] == {"unit": "N·m"}


def test_frames_are_numbered_in_all_and_in_their_episode(exported):
    frames = pq.read_table(exported / "data" / "chunk-000" / "file-000.parquet")
    numbers = ["timestamp", "frame_index", "episode_index", "index", "task_index"]
    assert frames.column_names[-5:] == numbers
    assert frames["index"].to_pylist() == list(range(171))
    assert frames["frame_index"].to_pylist()[50:53] == [0, 1, 2]


def test_an_episode_says_its_frames_its_unit_its_payload_and_its_motion(exported):
    file = exported / "meta" / "episodes" / "chunk-000" / "file-000.parquet"
    episodes = pq.read_table(file).to_pylist()
    assert [episode["dataset_from_index"] for episode in episodes] == [0, 50, 107]
    assert [episode["dataset_to_index"] for episode in episodes] == [50, 107, 171]
    assert episodes[1]["unit_id"] == "two"
    assert episodes[1]["payload_mass"] == 0.2
    assert episodes[1]["virtual"] is True
    assert episodes[2]["tasks"] == ["m2"]


def test_the_tasks_are_the_index_of_their_table(exported):
    tasks = pq.read_table(exported / "meta" / "tasks.parquet")
    assert json.loads(tasks.schema.metadata[b"pandas"])["index_columns"] == ["task"]


def test_statistics_are_those_of_all_frames(dataset, exported):
    stats = json.loads((exported / "meta" / "stats.json").read_text())["observation.state"]
    every = np.concatenate([s.qpos for s in dataset.sequences()]).astype(float)
    for name, value in (
        ("min", every.min(0)),
        ("max", every.max(0)),
        ("mean", every.mean(0)),
        ("std", every.std(0)),
    ):
        assert np.allclose(stats[name], value)
    assert stats["count"] == [171]


def test_many_episodes_are_spread_over_files(dataset, arm, tmp_path, monkeypatch):
    monkeypatch.setattr(lerobot_export, "MAX_FILE_MB", 0.001)
    monkeypatch.setattr(lerobot_export, "CHUNK_FILES", 2)
    monkeypatch.setattr(lerobot_export, "BLOCK_EPISODES", 2)
    export_lerobot(dataset, tmp_path / "out")
    files = sorted(
        f.relative_to(tmp_path / "out").as_posix()
        for f in (tmp_path / "out" / "data").rglob("*.parquet")
    )
    assert files == [
        "data/chunk-000/file-000.parquet",
        "data/chunk-000/file-001.parquet",
        "data/chunk-001/file-000.parquet",
    ]
    same(dataset, back(tmp_path / "out", arm, tmp_path / "again"))


def test_of_a_dataset_that_grew_all_files_but_the_last_are_the_same(arm, tmp_path, monkeypatch):
    monkeypatch.setattr(lerobot_export, "USUAL_MB", 0.01)
    data = Dataset.create(tmp_path / "data", arm)

    def exported(name, motions):
        for motion in motions:
            ctrl = wave(50, 2) + 0.001 * len(data)
            data.append(arm_sequence(arm, ctrl, late(ctrl, 1), motion, 0.0))
        export_lerobot(data, tmp_path / name)
        return {
            f.name: f.read_bytes() for f in sorted((tmp_path / name / "data").rglob("*.parquet"))
        }

    before = exported("first", [f"walk {i}" for i in range(30)])
    after = exported("second", ["one more"])
    assert len(before) > 3
    assert all(after[name] == content for name, content in [*before.items()][:-1])
    same(data, back(tmp_path / "second", arm, tmp_path / "again"))


def test_what_is_too_much_to_hold_is_read_twice(dataset, arm, tmp_path, monkeypatch):
    monkeypatch.setattr("gaponet.data.importer.MAX_HELD_BYTES", 2000)
    export_lerobot(dataset, tmp_path / "out")
    same(dataset, back(tmp_path / "out", arm, tmp_path / "again"))


def test_an_interrupted_export_leaves_nothing(dataset, tmp_path):
    def interrupt(*_: object) -> None:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        export_lerobot(dataset, tmp_path / "out", interrupt)
    assert not [f for f in tmp_path.iterdir() if "out" in f.name]


@pytest.mark.parametrize(
    ("option", "said"),
    [
        ({"unit_id": "three"}, "one"),
        ({"payload_mass": 1.0}, r"0\.0"),
        ({"position_unit": "deg"}, "--position-unit"),
    ],
)
def test_options_that_contradict_the_export_are_refused(dataset, arm, tmp_path, option, said):
    export_lerobot(dataset, tmp_path / "out")
    with pytest.raises(UsageError, match=said):
        import_logs(tmp_path / "out", arm, tmp_path / "again", ImportRequest(**option))
    assert not (tmp_path / "again").exists()


def read_stock(folder, so101, out, **options):
    options = {"position_unit": "deg"} | options
    return import_logs(
        folder, so101, out, ImportRequest(unit_id="lab", payload_mass=0.0, **options)
    ).dataset


def test_a_stock_set_in_degrees_becomes_radians(so101, tmp_path):
    data = read_stock(stock(tmp_path / "set"), so101, tmp_path / "data")
    assert detect(tmp_path / "set") == "lerobot"
    entry = data.entries[1]
    assert (entry.meta.motion, entry.rows, entry.dt) == ("pick_up-0001", 50, 1 / 30)
    assert entry.meta.source == "set/data/chunk-000/file-000.parquet#1"
    first = data.read(entry)
    assert first.ctrl[0, 0] == pytest.approx(np.radians(10))
    assert first.qpos[0, 4] == pytest.approx(np.radians(9))
    low, high = so101.qpos_range[5]
    assert first.ctrl[0, 5] == pytest.approx(low + 0.10 * (high - low))  # the gripper is 0..100
    assert entry.meta.notes["converted_from"]["gripper"] == "percent"
    older = read_stock(tmp_path / "set", so101, tmp_path / "older", position_unit="signed_percent")
    low, high = so101.qpos_range[0]
    assert older.read(older.entries[0]).ctrl[0, 0] == pytest.approx(
        (low + high) / 2 + 0.05 * (high - low)
    )
    with pytest.raises(UsageError, match="--position-unit"):
        read_stock(tmp_path / "set", so101, tmp_path / "none", position_unit=None)


def test_joints_are_taken_by_name(so101, tmp_path):
    names = ("gripper", *SO101[:5])
    values = [np.tile([50.0, 1, 2, 3, 4, 5], (30, 1)) + np.arange(30)[:, None] / 10]
    data = read_stock(stock(tmp_path / "set", values, names=names), so101, tmp_path / "data")
    assert np.allclose(data.read(data.entries[0]).ctrl[0, :5], np.radians([1, 2, 3, 4, 5]))


def test_timestamps_that_are_not_regular_are_believed(so101, tmp_path):
    folder = stock(tmp_path / "set", rows=(40,))
    file = folder / "data" / "chunk-000" / "file-000.parquet"
    table = pq.read_table(file)
    late_by = np.where(np.arange(40) >= 20, 0.5, 0.0)  # half a second is missing in the middle
    time = (table["timestamp"].to_numpy() + late_by).astype(np.float32)
    pq.write_table(table.set_column(2, "timestamp", pa.array(time)), file)
    entry = read_stock(folder, so101, tmp_path / "data").entries[0]
    assert entry.rows == 55
    assert entry.meta.notes["longest_gap_ms"] == pytest.approx(533.3, abs=0.1)
    assert "resampled" in entry.meta.notes["rows"]


def test_a_file_cut_short_and_missing_frames_are_named(so101, tmp_path):
    folder = stock(tmp_path / "set")
    file = folder / "data" / "chunk-000" / "file-000.parquet"
    whole = pq.read_table(file)
    pq.write_table(whole.slice(0, 80), file)
    with pytest.raises(LogError, match="50"):
        read_stock(folder, so101, tmp_path / "data")
    file.write_bytes(file.read_bytes()[:200])
    with pytest.raises(LogError, match=r"file-000\.parquet"):
        read_stock(folder, so101, tmp_path / "data")


@pytest.mark.parametrize(
    "place",
    [
        "../other/data/file-{file_index:03d}.parquet",
        "data/{file_index}/../../../other/file-000.parquet",
        "/etc/passwd",
        "data/{chunk_index:0999999999d}",
        "data/\x00",
    ],
)
def test_a_data_path_cannot_leave_the_set_or_fill_the_memory(so101, tmp_path, place):
    folder = stock(tmp_path / "set", data_path=place)
    stock(tmp_path / "other")
    with pytest.raises(LogError, match="data_path"):
        read_stock(folder, so101, tmp_path / "data")


@pytest.mark.parametrize(
    ("change", "complaint"),
    [
        ({"codebase_version": "v1.6"}, "codebase_version"),
        ({"features": {}}, "'action'"),
        ({"features": {"action": 3}}, r"features\.action"),
        (
            {
                "features": {
                    f: {"shape": [6], "names": None} for f in ("action", "observation.state")
                }
            },
            "joints",
        ),
        ({"fps": 0}, "fps"),
        ({"data_path": None}, "data_path"),
    ],
)
def test_metadata_that_cannot_be_read_are_refused_by_field(so101, tmp_path, change, complaint):
    with pytest.raises(LogError, match=rf"info\.json: .*{complaint}"):
        read_stock(stock(tmp_path / "set", **change), so101, tmp_path / "data")
    assert not (tmp_path / "data").exists()


def rewrite(file, **columns):
    """A Parquet file with columns replaced, or gone where None."""
    table = pq.read_table(file)
    for name, values in columns.items():
        table = table.drop_columns([name])
        table = table if values is None else table.append_column(name, values)
    pq.write_table(table, file)


@pytest.mark.parametrize(
    ("columns", "complaint"),
    [
        ({"length": pa.array([-1, 50])}, r"\[0\]\.length"),
        ({"data/file_index": pa.array([None, 0])}, r"\[0\]\.data/file_index"),
        ({"episode_index": None}, ".*'episode_index'"),
        ({"tasks": pa.array([1, 2])}, r"\[0\]\.tasks"),
        ({"length": pa.array([1, 2], pa.timestamp("ns"))}, ".*readable"),
    ],
)
def test_episodes_of_other_types_are_refused_by_field(so101, tmp_path, columns, complaint):
    folder = stock(tmp_path / "set")
    rewrite(folder / "meta" / "episodes" / "chunk-000" / "file-000.parquet", **columns)
    with pytest.raises(LogError, match=rf"file-000\.parquet: {complaint}"):
        read_stock(folder, so101, tmp_path / "data")


@pytest.mark.parametrize(
    ("columns", "complaint"),
    [
        ({"timestamp": None}, ".*'timestamp'"),
        ({"action": pa.array(["x"] * 90)}, ".*string"),
        ({"frame_index": pa.array([None] * 90, pa.int64())}, "frame_index"),
        ({"action": pa.array([[1.0] * 5 + [None]] * 90)}, "action"),
    ],
)
def test_frames_of_other_types_are_refused_by_feature(so101, tmp_path, columns, complaint):
    folder = stock(tmp_path / "set")
    rewrite(folder / "data" / "chunk-000" / "file-000.parquet", **columns)
    with pytest.raises(LogError, match=rf"file-000\.parquet(:1)?: {complaint}"):
        read_stock(folder, so101, tmp_path / "data")


@pytest.mark.parametrize(
    ("column", "value", "complaint"),
    [
        ("payload_mass", float("nan"), "payload_mass"),
        ("notes", "[1", "notes: "),
        ("notes", "3", "notes"),
        ("level", "legs", "level"),
        ("kp", '["x"]', "kp"),
    ],
)
def test_what_an_export_says_of_a_recording_is_checked(
    dataset, arm, tmp_path, column, value, complaint
):
    export_lerobot(dataset, tmp_path / "out")
    rewrite(
        tmp_path / "out" / "meta" / "episodes" / "chunk-000" / "file-000.parquet",
        **{column: pa.array([value] * 3)},
    )
    with pytest.raises(LogError, match=rf"episode 0: .*{complaint}"):
        back(tmp_path / "out", arm, tmp_path / "again")
    assert not (tmp_path / "again").exists()


@pytest.mark.parametrize("change", [{"dt": 0}, {"dataset": 3}])
def test_gaponet_json_cannot_say_what_it_likes(dataset, arm, tmp_path, change):
    export_lerobot(dataset, tmp_path / "out")
    file = tmp_path / "out" / "meta" / "gaponet.json"
    file.write_text(json.dumps(json.loads(file.read_text()) | change))
    with pytest.raises(LogError, match=r"gaponet\.json: "):
        back(tmp_path / "out", arm, tmp_path / "again")


def test_tasks_of_another_type_are_refused(so101, tmp_path):
    folder = stock(tmp_path / "set")
    rewrite(folder / "meta" / "tasks.parquet", task_index=pa.array([1], pa.timestamp("ns")))
    with pytest.raises(LogError, match=r"tasks\.parquet: "):
        read_stock(folder, so101, tmp_path / "data")


def test_a_set_of_version_2_1_is_read_as_far_as_its_episodes_are_there(so101, tmp_path, caplog):
    """Names inside a list, in the style of C; one file an episode, of which some were not
    downloaded.
    """
    names = [
        [
            "kShoulderPan",
            "kShoulderLift",
            "kElbowFlex",
            "kWristFlex",
            "kWristRoll",
            "kGripper",
            "kCameraTilt",
        ]
    ]
    feature = {"dtype": "float32", "shape": [7], "names": names}
    info = {
        "codebase_version": "v2.1",
        "fps": 30,
        "chunks_size": 2,
        "features": dict.fromkeys(("action", "observation.state"), feature),
        "data_path": "data/chunk-{episode_chunk:03d}/episode_{episode_index:06d}.parquet",
    }
    listed = [{"episode_index": i, "tasks": ["Pick up!"], "length": 40} for i in range(4)]
    (tmp_path / "meta").mkdir()
    (tmp_path / "meta" / "info.json").write_text(json.dumps(info))
    (tmp_path / "meta" / "episodes.jsonl").write_text("\n".join(map(json.dumps, listed)) + "\n")
    for i in (0, 3):
        file = tmp_path / "data" / f"chunk-{i // 2:03d}" / f"episode_{i:06d}.parquet"
        file.parent.mkdir(parents=True, exist_ok=True)
        flat = pa.array(np.tile(0.1 * i + 0.01 * np.arange(7, dtype=np.float32), 40))
        pq.write_table(
            pa.table(
                {
                    **dict.fromkeys(
                        ("action", "observation.state"), pa.FixedSizeListArray.from_arrays(flat, 7)
                    ),
                    "timestamp": pa.array(np.arange(40) / 30, pa.float32()),
                    "frame_index": np.arange(40),
                    "episode_index": np.full(40, i),
                    "index": np.arange(40),
                    "task_index": np.zeros(40, int),
                }
            ),
            file,
        )
    (tmp_path / "logs.toml").write_text('position_unit = "rad"\nignore = ["kCamera*"]\n')
    found = dict(read_logs(tmp_path, so101))
    assert list(found) == ["pick_up-0000", "pick_up-0003"]
    assert np.allclose(found["pick_up-0003"].channels["qpos"].values[:, 4], 0.34)
    assert "2 episodes that meta/episodes lists are missing" in caplog.text


def test_a_unit_that_is_no_text_is_no_unit(dataset, arm, tmp_path):
    export_lerobot(dataset, tmp_path / "out")
    file = tmp_path / "out" / "meta" / "info.json"
    info = json.loads(file.read_text())
    info["features"]["action"]["info"] = {"unit": {"x": 1}}
    file.write_text(json.dumps(info))
    with pytest.raises(UsageError, match="unit"):
        back(tmp_path / "out", arm, tmp_path / "again")


def test_a_folder_without_a_set_and_a_set_without_episodes_are_refused(so101, tmp_path):
    with pytest.raises(LogError, match=r"info\.json"):
        list(read_logs(tmp_path, so101, ReadOptions("lerobot")))
    folder = stock(tmp_path / "set")
    next((folder / "meta" / "episodes").rglob("*.parquet")).unlink()
    with pytest.raises(LogError, match="episode"):
        read_stock(folder, so101, tmp_path / "data")


def test_a_set_of_which_nothing_was_downloaded_is_refused(so101, tmp_path):
    """Version 2.1, which has a file for each episode."""
    folder = stock(
        tmp_path / "set", codebase_version="v2.1", data_path="data/{episode_index:06d}.parquet"
    )
    listed = {"episode_index": 0, "tasks": ["Pick up!"], "length": 40}
    (folder / "meta" / "episodes.jsonl").write_text(json.dumps(listed) + "\n")
    with pytest.raises(LogError, match="none"):
        read_stock(folder, so101, tmp_path / "data")


def test_tasks_without_a_text_are_refused(so101, tmp_path):
    folder = stock(tmp_path / "set")
    pq.write_table(pa.table({"task_index": [0]}), folder / "meta" / "tasks.parquet")
    with pytest.raises(LogError, match="no task"):
        read_stock(folder, so101, tmp_path / "data")


def test_a_sequence_that_changed_since_it_was_listed_is_not_exported(dataset, tmp_path):
    file = dataset.path / "sequences" / f"{dataset.entries[0].id}.parquet"
    table = pq.read_table(file)
    changed = pa.FixedSizeListArray.from_arrays(pa.array(np.zeros(100, np.float32)), 2)
    column = table.schema.get_field_index("qpos")
    pq.write_table(table.set_column(column, "qpos", changed), file)
    with pytest.raises(DatasetError, match="restore"):
        export_lerobot(dataset, tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_an_empty_folder_may_be_exported_into(dataset, tmp_path):
    (tmp_path / "out").mkdir()
    (written,) = export_lerobot(dataset, tmp_path / "out")
    assert written.episodes == 3
