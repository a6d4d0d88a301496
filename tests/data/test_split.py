"""Splits: parts share no recording, whatever it is filed under."""

import json
import re
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from arm import commands, record
from logs import arm_columns, arm_sequence, late, table_text, wave

from gaponet.base.errors import DatasetError, UsageError
from gaponet.data.fingerprint import equal_commands, fingerprint
from gaponet.data.importer import ImportRequest, import_logs
from gaponet.data.sequence import SequenceMeta
from gaponet.data.split import (
    SPLITS,
    canonical_motions,
    make_split,
    read_split,
    require_distinct_samples,
    resolve_splits,
    split_entries,
    split_motions,
    stratified_subset,
    write_split,
)
from gaponet.data.store import Dataset


@pytest.fixture
def dataset(arm, tmp_path):
    """Eight motions by three units with two payloads, all samples different."""
    data, lag = Dataset.create(tmp_path / "data", arm), 0
    for motion in "abcdefgh":
        for unit in ("one", "two", "three"):
            for payload in (0.0, 0.2):
                lag += 1
                ctrl = wave(60, 2, hertz=0.3 * 1.0171**lag)
                data.append(arm_sequence(arm, ctrl, late(ctrl, 2), motion, payload, unit=unit))
    return data


def values(entries, field):
    return {getattr(e.meta, field) for e in entries}


def test_a_split_holds_every_motion_once():
    motions = [f"m{i}" for i in range(40)]
    split = split_motions(motions)
    assert {part: len(names) for part, names in split.items()} == {
        "train": 25,
        "val": 5,
        "test": 10,
    }
    assert sorted(name for names in split.values() for name in names) == sorted(motions)
    assert split == split_motions([*reversed(motions), *motions])


def test_two_motions_cannot_be_split_in_three():
    with pytest.raises(UsageError, match="motion"):
        split_motions(["a", "b"])


def test_by_motion_is_the_rule_that_training_uses(dataset):
    parts, rule = make_split(dataset, "motion"), split_motions(list("abcdefgh"))
    assert values(parts["test"], "motion") == set(rule["test"])
    assert values(parts["val"], "motion") == set(rule["val"])
    assert values(parts["train"], "motion") == set(rule["train"])
    assert sum(map(len, parts.values())) == len(dataset)


def test_held_out_units_are_in_the_test_part_alone(dataset):
    parts = make_split(dataset, "unit", ("two",))
    assert values(parts["test"], "unit_id") == {"two"}
    assert values(parts["train"] + parts["val"], "unit_id") == {"one", "three"}
    assert not values(parts["train"], "motion") & values(parts["val"], "motion")


def test_a_few_entries_are_of_every_payload_and_unit_and_of_several_motions(dataset):
    """Every sixth entry would be of one payload and one unit: the recipe has six of each motion."""
    few = stratified_subset(dataset.entries, 8)
    assert len(few) == 8
    conditions = {(e.meta.payload_mass, e.meta.unit_id) for e in few}
    assert len(conditions) == 6
    assert len(values(few, "motion")) >= 6
    assert stratified_subset(few, 100) == few


def test_a_few_of_many_entries_are_of_motions_from_all_parts_of_a_recipe():
    """Neighbours in a recipe are alike: single joints come first, the whole body last."""
    entries = []
    for motion in range(40):
        for repetition in range(3):
            for unit in ("one", "two"):
                meta = SequenceMeta("arm", unit, f"m{motion:02}", 0.0, repetition=repetition)
                entries.append(SimpleNamespace(id=f"{len(entries)}", meta=meta, dt=0.02))
    few = stratified_subset(entries, 20)
    motions = sorted(int(entry.meta.motion[1:]) for entry in few)
    assert np.diff([-1, *motions, 40]).max() <= 5
    assert len(set(motions)) >= 16


def test_payloads_are_numbers_however_they_are_written(dataset):
    parts = make_split(dataset, "payload", ("0.20",))
    assert values(parts["test"], "payload_mass") == {0.2}
    assert values(parts["train"] + parts["val"], "payload_mass") == {0.0}


@pytest.mark.parametrize(
    ("by", "holdout", "complaint"),
    [
        ("motion", ("dance",), "'dance'"),
        ("unit", ("one", "two", "three"), "train"),
        ("payload", ("heavy",), "heavy"),
        ("motion", tuple("abcdefg"), "remain"),
    ],
    ids=["stranger", "everything", "not a number", "too much"],
)
def test_what_cannot_be_held_out_is_refused(dataset, by, holdout, complaint):
    with pytest.raises(UsageError, match=complaint):
        make_split(dataset, by, holdout)


def test_the_same_samples_under_another_unit_are_found(dataset):
    twice = dataset.read(dataset.entries[0])
    dataset.append(replace(twice, meta=replace(twice.meta, unit_id="two")))
    told = []
    require_distinct_samples(
        dataset, make_split(dataset, "motion"), lambda *what: told.append(what)
    )
    assert told[-1][:2] == (len(dataset), len(dataset))
    parts = make_split(dataset, "unit", ("two",))
    with pytest.raises(
        DatasetError,
        match=r"a-two-0kg-.*a-one-0kg-",
    ):
        require_distinct_samples(dataset, parts)


def test_a_split_file_is_read_back(dataset):
    parts = make_split(dataset, "unit", ("two",))
    path = write_split(dataset, parts, "unit", ("two",))
    assert path == dataset.path / "splits" / "unit-two.json"
    assert read_split(path, Dataset(dataset.path)) == parts
    record = json.loads(path.read_text())
    assert (record["by"], record["held_out"], record["virtual"]) == ("unit", ["two"], False)


def test_a_split_finds_sequences_by_content_and_is_refused_where_one_is_missing(
    dataset, arm, tmp_path
):
    path = write_split(dataset, make_split(dataset, "motion"), "motion")
    copy = Dataset.create(tmp_path / "copy", arm)
    for entry in reversed(dataset.entries):
        copy.append(dataset.read(entry))
    assert {e.hash for e in read_split(path, copy)["test"]} == {
        e.hash for e in read_split(path, dataset)["test"]
    }
    with pytest.raises(DatasetError, match=r"motion\.json"):
        read_split(path, Dataset.create(tmp_path / "other", arm))


def test_a_split_file_with_a_sequence_in_two_parts_is_refused(dataset):
    path = write_split(dataset, make_split(dataset, "motion"), "motion")
    record = json.loads(path.read_text())
    name, digest = next(iter(record["parts"]["test"].items()))
    record["parts"]["train"][name] = digest
    path.write_text(json.dumps(record))
    with pytest.raises(DatasetError, match="train"):
        read_split(path, dataset)


# Mutants of make fuzz --only samples (seed 0) that once ended in a traceback; the number is the
# mutant's.
@pytest.mark.parametrize(
    "change",
    [
        pytest.param(lambda text: re.sub(rb'"train": .', b'"train": [], "was": {', text), id="244"),
        pytest.param(
            lambda text: re.sub(rb'("train": \{\s*"[^"]*": )"[^"]*"', rb'\1["x"]', text), id="301"
        ),
        pytest.param(lambda text: text[:126] + b"\xff" + text[126:], id="518"),
        pytest.param(lambda text: b"[1]", id="no object"),
    ],
)
def test_a_split_file_that_was_changed_at_random_is_refused_in_one_line(dataset, change):
    path = write_split(dataset, make_split(dataset, "motion"), "motion")
    whole = path.read_bytes()
    path.write_bytes(change(whole))
    assert path.read_bytes() != whole
    with pytest.raises(DatasetError, match=r"motion\.json"):
        read_split(path, dataset)


def test_a_rate_keeps_the_split_by_motion_and_a_smaller_share_lies_in_a_larger(arm, tmp_path):
    data = Dataset.create(tmp_path / "rates", arm)
    for dt in (0.02, 0.01):
        for seed in range(8):
            data.append(record(replace(arm, dt=dt), commands(20, seed, dt), f"motion{seed}"))
    both, fast = split_entries(data), split_entries(data, rates=(100,))
    for part in SPLITS:
        assert values(both[part], "motion") == values(fast[part], "motion")
        assert {e.dt for e in fast[part]} == {0.01}
    half, quarter = (split_entries(data, train_share=s) for s in (0.5, 0.25))
    motions = [values(p["train"], "motion") for p in (quarter, half, both)]
    assert motions[0] < motions[1] < motions[2]
    assert half["test"] == both["test"]
    assert half["val"] == both["val"]
    with pytest.raises(UsageError, match="200"):
        split_entries(data, rates=(200,))
    with pytest.raises(UsageError, match="train_share"):
        split_entries(data, train_share=0)


def walk(rows, seed, dt=0.02, shift=0.0):
    """Smooth commands of two joints, as a function of time."""
    t = dt * np.arange(rows)[:, None] + shift
    rng = np.random.default_rng(seed)
    a, f, p = (
        rng.uniform(0.2, 0.5, (3, 2)),
        rng.uniform(0.1, 0.6, (3, 2)),
        rng.uniform(0, 6, (3, 2)),
    )
    return sum(a[k] * np.sin(2 * np.pi * f[k] * t + p[k]) for k in range(3))


@pytest.mark.parametrize(
    "again",
    [
        lambda c: c,
        lambda c: c[: len(c) // 2],  # cut short
        lambda c: np.concatenate(
            [np.repeat(c[:1], 70, axis=0), c, np.repeat(c[-1:], 9, axis=0)]
        ),  # a wait around it
        lambda c: np.repeat(c, 2, axis=0),  # logged at twice the rate
        lambda c: walk(400, 3, shift=0.013),  # computed anew, at other moments
    ],
)
def test_a_command_is_known_again_and_others_are_not_taken_for_it(again):
    first = walk(400, 3)
    dt = 0.01 if len(again(first)) == 800 else 0.02
    assert equal_commands([fingerprint(first, 0.02), fingerprint(again(first), dt)]) == [(0, 1)]
    assert (
        equal_commands(
            [
                fingerprint(again(first), dt),
                *(fingerprint(walk(400, seed), 0.02) for seed in range(4, 60)),
            ]
        )
        == []
    )


def steps(*targets, rests=40):
    """From home to one place after the other, (T, 2) rad."""
    return np.repeat(np.array([(0.1, -0.2), *targets]), rests, axis=0)


def test_motions_that_rest_at_one_place_are_not_one():
    """A motion of three places, two of which all motions have, is none of them; slower or once more
    it is the same.
    """
    park, there = (0.0, 0.0), (0.5, 0.3)
    walks = [np.concatenate([steps(), walk(400, seed), steps(park)]) for seed in range(4, 8)]
    others = [steps((0.7, 0.1), park), steps((-0.4, 0.3), park), steps(), *walks]
    assert equal_commands([fingerprint(x, 0.02) for x in (steps(there, park), *others)]) == []
    assert equal_commands(
        [fingerprint(steps(there, park), 0.02), fingerprint(steps(there, park, rests=70), 0.02)]
    ) == [(0, 1)]
    assert equal_commands(
        [fingerprint(steps(there), 0.02), fingerprint(steps(there, rests=70), 0.02)]
    ) == [(0, 1)]


def forget_sketches(dataset):
    """Rewrite the journal so that two of three sequences are from before sketches of commands were
    kept.
    """
    journal = dataset.path / "sequences.jsonl"
    lines = []
    for i, text in enumerate(journal.read_text().splitlines()):
        line = json.loads(text)
        if i % 3:
            line["command"] = None
        lines.append(json.dumps(line) + "\n")
    journal.write_text("".join(lines))
    return Dataset(dataset.path)


@pytest.fixture
def lifts(arm, tmp_path):
    """Twelve commands, each under two names with another payload: lift3_0kg and lift3_1kg."""
    data = Dataset.create(tmp_path / "data", arm)
    for number in range(12):
        ctrl = walk(200, number)
        for payload, lag in ((0.0, 2), (1.0, 5)):
            name = f"lift{number}_{payload:g}kg"
            data.append(arm_sequence(arm, ctrl, late(ctrl, lag), name, payload))
    return forget_sketches(data)


def commands_of(entries):
    return {entry.meta.motion.partition("_")[0] for entry in entries}


def test_motions_with_equal_commands_have_one_canonical_name(lifts):
    assert len(set(canonical_motions(lifts).values())) == 12


@pytest.mark.parametrize(
    "split",
    [
        split_entries,
        lambda data: make_split(data, "motion"),
        lambda data: make_split(data, "motion", ("lift3_1kg",)),
    ],
)
def test_motions_with_equal_commands_are_one_motion_for_every_split(lifts, split):
    """lift_0kg and lift_1kg are told the same: one in training would show the other's test
    commands.
    """
    parts = split(lifts)
    assert values(parts["test"], "payload_mass") == {0.0, 1.0}
    train = commands_of(parts["train"])
    val = commands_of(parts["val"])
    test = commands_of(parts["test"])
    assert not test & (train | val)
    assert not train & val


def test_motions_with_equal_commands_are_one_motion_for_training_and_validation_by_payload(lifts):
    parts = make_split(lifts, "payload", ("1",))
    assert values(parts["test"], "payload_mass") == {1.0}
    assert not commands_of(parts["train"]) & commands_of(parts["val"])


def test_a_motion_with_the_command_of_a_test_motion_is_tested_as_well(lifts):
    parts = make_split(lifts, "motion", ("lift3_1kg",))
    assert values(parts["test"], "motion") == {"lift3_0kg", "lift3_1kg"}


def test_motions_that_are_all_one_are_repetitions_and_no_motions(arm, tmp_path):
    data = Dataset.create(tmp_path / "data", arm)
    for lag in range(4):
        data.append(arm_sequence(arm, walk(100, 1), late(walk(100, 1), lag), f"m{lag}"))
    parts = split_entries(data)
    assert [[e.meta.motion for e in parts[part]] for part in SPLITS] == [
        ["m0", "m1"],
        ["m2"],
        ["m3"],
    ]
    with pytest.raises(UsageError, match="equal"):
        make_split(data, "motion")


@pytest.fixture
def played_again(arm, tmp_path):
    """One command, played seven times."""
    data = Dataset.create(tmp_path / "data", arm)
    ctrl = wave(900, 2)
    for i in range(7):
        played = arm_sequence(arm, ctrl, late(ctrl, 2) + 1e-3 * i, "chirp")
        data.append(replace(played, meta=replace(played.meta, repetition=i)))
    return data


def repetitions(parts):
    """Of train, val and test."""
    return [sorted(entry.meta.repetition for entry in parts[part]) for part in SPLITS]


def test_one_command_played_again_is_split_by_repetition(played_again):
    assert repetitions(split_entries(played_again)) == [[0, 1, 2, 3], [4], [5, 6]]


def test_a_repetition_that_is_named_is_the_test_part(played_again):
    parts = make_split(played_again, "repetition", ("2",))
    assert repetitions(parts) == [[0, 1, 3, 4, 5], [6], [2]]


def test_repetitions_cannot_be_split_by_time(played_again):
    with pytest.raises(UsageError, match="pieces"):
        make_split(played_again, "time")


def import_in_pieces(arm, columns, file):
    """Import a table, cut every 4 s."""
    file.write_text(table_text(columns))
    request = ImportRequest(
        unit_id="a", payload_mass=0.0, cut=4.0, position_unit="rad", time_unit="s"
    )
    return import_logs(file, arm, file.with_suffix(""), request)


def test_a_long_log_is_cut_into_equal_pieces_and_split_by_time(arm, tmp_path):
    pieces = import_in_pieces(arm, arm_columns(900), tmp_path / "long.csv")
    names = ["long@0s", "long@4s", "long@9s", "long@14s"]
    assert [entry.meta.motion for entry in pieces.entries] == names
    assert [entry.rows for entry in pieces.entries] == [225] * 4
    parts = make_split(pieces.dataset, "time")
    motions = [[entry.meta.motion for entry in parts[part]] for part in SPLITS]
    assert motions == [["long@0s", "long@4s"], ["long@9s"], ["long@14s"]]


def test_equal_pieces_of_one_recording_are_one(arm, tmp_path):
    columns = arm_columns(900)
    for name in columns.keys() - {"time"}:
        columns[name] = np.zeros(900)
    (piece,) = import_in_pieces(arm, columns, tmp_path / "rest.csv").entries
    assert piece.meta.motion == "rest@0s"


@pytest.fixture
def one_motion(arm, tmp_path):
    """One motion, four times by each of two units, at two rates."""
    data = Dataset.create(tmp_path / "one", arm)
    for dt in (0.02, 0.01):
        for unit in ("one", "two"):
            for repetition in range(4):
                ctrl = walk(round(4 / dt), 1, dt)
                state = late(ctrl, 2) + 1e-3 * len(data)
                played = arm_sequence(replace(arm, dt=dt), ctrl, state, unit=unit)
                data.append(replace(played, meta=replace(played.meta, repetition=repetition)))
    return data


def test_a_split_by_repetition_holds_only_the_rates_that_are_asked_for(one_motion):
    splits = split_entries(one_motion, rates=(100,))
    used = splits["train"] + splits["val"] + splits["test"]
    assert {entry.dt for entry in used} == {0.01}


def test_a_split_by_repetition_with_every_unit_held_out_is_refused(one_motion):
    with pytest.raises(UsageError, match="nothing left for train after holding out one, two"):
        split_entries(one_motion, holdout_units=("one", "two"))


def test_half_of_two_repeated_motions_is_one(arm, tmp_path):
    data = Dataset.create(tmp_path / "two", arm)
    for motion, seed in (("a", 1), ("b", 2)):
        for repetition in range(3):
            played = arm_sequence(arm, walk(200, seed), walk(200, seed) + 1e-3 * repetition, motion)
            data.append(replace(played, meta=replace(played.meta, repetition=repetition)))
    half = split_entries(data, train_share=0.5)
    assert [len(values(half[part], "motion")) for part in SPLITS] == [1, 2, 2]


def test_joints_recorded_one_at_a_time_are_all_judged_and_asked(arm, tmp_path):
    data = Dataset.create(tmp_path / "data", arm)
    for joint, others in (("shoulder", "abc"), ("elbow", "defg")):
        still = next(j for j in arm.joint_names if j != joint)
        for motion in others:
            ctrl = wave(60, 2, hertz=0.3 + 0.1 * len(data))
            one = arm_sequence(arm, ctrl, late(ctrl, 2), motion)
            data.append(replace(one, meta=replace(one.meta, notes={"posture": {still: 0.0}})))
    parts = split_entries(data)
    for part in SPLITS:
        assert {e.meta.unrecorded for e in parts[part]} == {("shoulder",), ("elbow",)}
    assert sum(map(len, parts.values())) == 7


def test_one_unit_cannot_be_split_by_unit(arm, tmp_path):
    data = Dataset.create(tmp_path / "data", arm)
    data.append(arm_sequence(arm, wave(60, 2), wave(60, 2)))
    with pytest.raises(UsageError, match="unit"):
        make_split(data, "unit")


@pytest.mark.parametrize("one", [("甲",), ("a", "b")])
@pytest.mark.parametrize("other", [("乙",), ("a-b",)])
def test_splits_of_units_whose_names_look_the_same_are_two_files(arm, tmp_path, one, other):
    data = Dataset.create(tmp_path / "data", arm)
    for i, unit in enumerate(["甲", "乙", "a", "b", "a-b"] * 3):
        ctrl = wave(60, 2, hertz=0.3 + 0.1 * i)
        data.append(arm_sequence(arm, ctrl, late(ctrl, 2), f"m{i}", unit=unit))
    paths = set()
    for units in (one, other):
        parts = make_split(data, "unit", units)
        paths.add(write_split(data, parts, "unit", units))
    assert len(paths) == 2


def test_a_held_out_payload_is_in_the_test_split_alone(arm, tmp_path):
    data = Dataset.create(tmp_path / "held_out", arm)
    for seed in range(4):
        for payload in (0.0, 0.2):
            data.append(record(arm, commands(40, seed), f"motion{seed}", payload))
    parts = split_entries(data, holdout_payloads=(0.2,))
    assert {e.meta.payload_mass for e in parts["train"] + parts["val"]} == {0.0}
    assert {e.meta.payload_mass for e in parts["test"]} == {0.0, 0.2}
    with pytest.raises(UsageError, match="3 kg"):
        split_entries(data, holdout_payloads=(3.0,))


def test_a_split_file_and_a_rule_of_ones_own_exclude_each_other(dataset):
    parts = make_split(dataset, "unit", ("two",))
    file = str(write_split(dataset, parts, "unit", ("two",)))
    nothing_else = ((), (), (), 1.0)
    assert resolve_splits(dataset, file, *nothing_else) == parts
    assert resolve_splits(dataset, "", *nothing_else) == split_entries(dataset)
    with pytest.raises(UsageError, match="--holdout-units"):
        resolve_splits(dataset, file, ("two",), (), (), 1.0)


@pytest.mark.parametrize(
    ("units", "word"), [(("four",), "'four'"), (("one", "two", "three"), "train")]
)
def test_units_that_cannot_be_held_out_of_training_are_refused(dataset, units, word):
    with pytest.raises(UsageError, match=word):
        split_entries(dataset, holdout_units=units)


def test_two_repetitions_cannot_be_split_by_repetition(arm, tmp_path):
    data = Dataset.create(tmp_path / "data", arm)
    for lag in (2, 3):
        data.append(arm_sequence(arm, wave(60, 2), late(wave(60, 2), lag)))
    with pytest.raises(UsageError, match="3 repetitions"):
        make_split(data, "repetition")
