"""gaponet import and doctor as a user runs them: one line for what is wrong, and nothing
half-written.
"""

import json
from collections.abc import Callable
from pathlib import Path

import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from logs import arm_columns, late, table_text, wave, write_sage, write_so101

from gaponet.cli.main import main
from gaponet.data.store import Dataset
from gaponet.robot.spec import RobotSpec

SI = ["--position-unit", "rad", "--time-unit", "s"]


def import_so101(logs: Path, out: Path, *more: str, robot: str = "so101") -> int:
    who = ["--robot", robot, "--unit-id", "lab", "--payload-mass", "0"]
    return main(["import", str(logs), *who, "--out", str(out), *more])


def import_arm(logs: Path, arm: RobotSpec, out: Path, *more: str) -> int:
    return import_so101(logs, out, *more, robot=str(arm.mjcf.parent))


@pytest.fixture
def logs(tmp_path):
    """A SAGE folder with one SO-101 motion of 8 s, 2 periods late."""
    ctrl = wave(400, 6)
    ctrl[:, 5] = 0.5
    write_sage(tmp_path / "logs" / "real" / "so101" / "custom" / "wave", ctrl, late(ctrl, 2))
    return tmp_path / "logs"


def test_import_says_what_came_in_and_that_nothing_was_applied_and_the_same_again_adds_nothing(
    logs, tmp_path, capsys
):
    assert import_so101(logs, tmp_path / "data") == 0
    told = " ".join(capsys.readouterr().out.split())
    assert "1 recordings, 0.1 min at 49.85 Hz, robot so101, unit lab, payload 0 kg" in told
    assert "nothing was applied to the data" in told
    assert "next: gaponet doctor" in told
    assert (tmp_path / "data" / "offsets.json").is_file()
    assert import_so101(logs, tmp_path / "data") == 0
    assert "1 recordings were imported before, 0 are new" in capsys.readouterr().out
    assert len(Dataset(tmp_path / "data")) == 1


def test_import_prints_one_json_object_on_stdout(logs, tmp_path, capsys):
    assert import_so101(logs, tmp_path / "data", "--json") == 0
    result = json.loads(capsys.readouterr().out)
    assert (result["sequences"], result["rate_hz"], result["offsets_applied"]) == (
        1,
        [49.85],
        False,
    )
    assert result["offsets"]["elbow_flex"]["rests_up"] == 0
    (delays,) = result["delay_s"].values()
    assert delays["elbow_flex"] == pytest.approx(0.04, abs=0.003)
    assert delays["gripper"] is None


def test_the_payload_must_be_said(logs, tmp_path, capsys):
    assert (
        main(
            [
                "import",
                str(logs),
                "--robot",
                "so101",
                "--unit-id",
                "lab",
                "--out",
                str(tmp_path / "data"),
            ]
        )
        == 2
    )
    assert (
        "this format does not state unit or payload: give --payload-mass 0 (kg in each hand"
        in capsys.readouterr().err
    )
    assert main(["import", str(logs), "--robot", "so101", "--out", str(tmp_path / "data")]) == 2
    assert "give --unit-id NAME and --payload-mass 0 (kg" in capsys.readouterr().err  # all at once
    assert not (tmp_path / "data").exists()


def test_names_are_mapped_one_option_each(tmp_path):
    names = ("j1", "j2", "Elbow", "Wrist_Pitch", "Wrist_Roll", "Jaw")
    write_sage(tmp_path / "logs" / "wave", wave(50, 6), wave(50, 6), names=names)
    more = ["--map", "j1=shoulder_pan", "--map", "j2=shoulder_lift", "--format", "sage"]
    assert import_so101(tmp_path / "logs", tmp_path / "data", *more) == 0


def test_a_map_that_is_none_says_how_to_write_it(logs, tmp_path, capsys):
    assert import_so101(logs, tmp_path / "more", "--map", "j9=gripper") == 2
    assert "--map j9: no log under" in " ".join(capsys.readouterr().err.split())
    assert import_so101(logs, tmp_path / "data", "--map", "Elbow") == 2
    assert (
        capsys.readouterr()
        .err.strip()
        .endswith("Usage: --map Elbow: write NAME_IN_LOG=NAME_OF_ROBOT")
    )
    twice = ["--map", "j1=shoulder_pan", "--map", "j1=elbow_flex"]
    assert import_so101(logs, tmp_path / "data", *twice) == 2
    assert (
        "--map j1=shoulder_pan j1=elbow_flex: names one joint of the log twice"
        in capsys.readouterr().err
    )


def sage_with(old: str, new: str, name: str) -> Callable[[Path], Path]:
    """Write SAGE logs of which one file has other text; a good motion comes first."""

    def make(folder: Path) -> Path:
        file = write_so101(folder / "real" / "so101" / "custom" / "wave") / name
        file.write_text(file.read_text().replace(old, new, 1))
        write_so101(folder / "real" / "so101" / "custom" / "before", rows=50)
        return folder

    return make


def half_a_parquet(folder: Path) -> Path:
    folder.mkdir()
    pq.write_table(pa.table(arm_columns()), folder / "a.parquet")
    whole = (folder / "a.parquet").read_bytes()
    (folder / "b.parquet").write_bytes(whole[: len(whole) // 2])
    return folder


BROKEN = {
    "missing column": (
        sage_with("positions", "angles", "state_motor.csv"),
        "state_motor.csv:1: column 'positions' is missing; the header has: type, timestamp, angles",
    ),
    "wrong joint name": (
        sage_with("Elbow", "Ellbow", "joint_list.txt"),
        "joint_list.txt names joint 'Ellbow', which robot 'so101' does not have; "
        "nearest: elbow_flex, wrist_roll, wrist_flex. Correct it there; of logs, map it with --map Ellbow=elbow_flex",
    ),
    "half-written Parquet": (half_a_parquet, "b.parquet: not a readable Parquet file"),
}


@pytest.mark.parametrize("what", BROKEN)
def test_a_broken_input_is_one_line_that_says_what_where_and_what_to_do(
    what, arm, tmp_path, capsys
):
    """And leaves no dataset; the readers' own tests have every message."""
    make, message = BROKEN[what]
    logs = make(tmp_path / "logs")
    out = tmp_path / "data"
    code = (
        import_arm(logs, arm, out, *SI)
        if what == "half-written Parquet"
        else import_so101(logs, out)
    )
    assert code == 2
    error = capsys.readouterr().err.strip().split("\n")[-1]
    assert message in error
    assert error.split(": ")[0] in ("Log", "JointMismatch")
    assert not out.exists()


def test_another_robots_dataset_is_refused_and_left_as_it_was(arm, logs, tmp_path, capsys):
    table = tmp_path / "wave.csv"
    table.write_text(table_text(arm_columns()))
    assert import_arm(table, arm, tmp_path / "data", *SI) == 0
    before = {f: f.read_bytes() for f in (tmp_path / "data").rglob("*") if f.is_file()}
    assert import_so101(logs, tmp_path / "data") == 2
    error = capsys.readouterr().err.strip().split("\n")[-1]
    assert error.startswith("Dataset: ")
    assert "holds robot 'arm' (shoulder, elbow), not 'so101'" in error
    assert "leave --robot out, or give another dataset folder" in error
    assert {f: f.read_bytes() for f in (tmp_path / "data").rglob("*") if f.is_file()} == before


def test_a_note_about_joints_begins_a_word_of_its_own(arm, tmp_path, capsys):
    table = tmp_path / "wave.csv"
    table.write_text(table_text({k: v for k, v in arm_columns().items() if "elbow" not in k}))
    assert import_arm(table, arm, tmp_path / "data", *SI) == 0
    assert "note  elbow: missing in some recordings" in capsys.readouterr().out


def test_a_table_asks_for_its_units(arm, tmp_path, capsys):
    table = tmp_path / "wave.csv"
    table.write_text(table_text(arm_columns()))
    assert import_arm(table, arm, tmp_path / "data") == 2
    assert (
        "the log's time unit is not given; say it with --position-unit rad --time-unit s"
        in capsys.readouterr().err
    )


@pytest.fixture
def imported(logs, tmp_path, capsys):
    """A dataset of an SO-101."""
    import_so101(logs, tmp_path / "data")
    capsys.readouterr()
    return tmp_path / "data"


def test_doctor_ends_with_a_verdict_and_what_comes_next(imported, capsys):
    assert main(["doctor", str(imported)]) == 0
    told = capsys.readouterr().out
    assert "so101, 1 recordings, 1 motions" in told
    verdict, next_ = told.strip().split("\n")[-2:]
    assert verdict.startswith("Usable. Read the")
    assert next_ == f"next: gaponet gap {imported}"


def test_doctor_prints_one_json_object(imported, capsys):
    assert main(["doctor", str(imported), "--json"]) == 0
    result = json.loads(capsys.readouterr().out)
    assert result["sequences"][0]["rate_hz"] == 49.85
    assert {f["level"] for f in result["findings"]} <= {"ok", "note", "warning", "error"}
    assert [j["joint"] for j in result["joints"]][-1] == "gripper"


def test_doctor_refuses_another_robot_than_the_datasets(imported, capsys):
    assert main(["doctor", str(imported), "--robot", "h1_2"]) == 2
    assert "holds robot 'so101'" in capsys.readouterr().err


def test_logs_are_found_again_in_a_dataset_whose_journal_holds_no_lags(arm, tmp_path, capsys):
    """A collected dataset is one."""
    (tmp_path / "wave.csv").write_text(table_text(arm_columns(60)))
    assert import_arm(tmp_path / "wave.csv", arm, tmp_path / "set", *SI) == 0
    journal = tmp_path / "set" / "sequences.jsonl"
    journal.write_text(json.dumps(json.loads(journal.read_text()) | {"findings": {}}) + "\n")
    capsys.readouterr()
    assert import_arm(tmp_path / "wave.csv", arm, tmp_path / "set", *SI, "--json") == 0
    assert json.loads(capsys.readouterr().out)["imported"] == []
