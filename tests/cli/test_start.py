"""gaponet start: a model file and a folder of logs, as a lab has them, to a report by commands that
it prints.
"""

import json
import re
import shlex
import shutil
from pathlib import Path

import numpy as np
import pytest
from arm import XML, commands, record, write_arm

from gaponet.api.start import Start, hash_logs
from gaponet.cli import start
from gaponet.cli.main import main

SERVOS = "".join(
    f'<position joint="{joint}" kp="20" forcerange="-5 5"/>' for joint in ("shoulder", "elbow")
)
ORDER = ["robot", "import", "doctor", "gap", "identify", "gap", "export", "report"]


@pytest.fixture
def place(tmp_path, monkeypatch):
    """A model file and csv logs of an arm with weaker, later servos; columns and names as no format
    has them.
    """
    monkeypatch.chdir(tmp_path)
    Path("arm.xml").write_text(XML.replace("</mujoco>", f"<actuator>{SERVOS}</actuator></mujoco>"))
    robot = write_arm(tmp_path / "nominal")
    Path("logs").mkdir()
    for seed in range(5):
        s = record(robot, commands(300, seed), f"swing_{seed}", kp=0.7, delay=2)
        table = np.concatenate([1e3 * s.dt * np.arange(300)[:, None], s.ctrl, s.qpos], axis=1)
        head = "time_ms,shoulder_des,elbow_des,shoulder_meas,elbow_meas"
        np.savetxt(
            f"logs/swing_{seed}.csv", table, delimiter=",", header=head, comments="", fmt="%.6f"
        )
    return tmp_path


def test_a_dry_run_says_what_was_understood_and_writes_nothing(place, capsys):
    before = sorted(place.rglob("*"))
    assert main(["start", "arm.xml", "logs", "--dry-run", "--json"]) == 0
    said = json.loads(capsys.readouterr().out)
    assert (said["joints"], said["recordings"], said["rate_hz"]) == (["shoulder", "elbow"], 5, 50.0)
    assert 'time_unit = "ms"' in said["logs_toml"]
    assert (
        'motion = "{motion}"' in said["logs_toml"]
    )  # other commands: a number at a name's end counts no repetitions
    assert [shlex.split(line)[1] for line in said["commands"]] == ORDER
    assert sorted(place.rglob("*")) == before


def test_a_single_recording_is_cut_so_that_parts_of_it_can_judge(place, capsys):
    for seed in range(1, 5):
        Path(f"logs/swing_{seed}.csv").unlink()
    one = Path("logs/swing_0.csv")
    head, *rows = one.read_text().splitlines()
    later = [f"{float(row.split(',')[0]) + 6000},{row.partition(',')[2]}" for row in rows]
    assert main(["start", "arm.xml", "logs", "--dry-run", "--json"]) == 0
    assert "--cut" not in json.loads(capsys.readouterr().out)["commands"][1]  # 6 s are too short
    last = [f"{float(row.split(',')[0]) + 6000},{row.partition(',')[2]}" for row in later]
    one.write_text("\n".join([head, *rows, *later, *last]))
    assert main(["start", "arm.xml", "logs", "--dry-run", "--json"]) == 0
    assert "--cut 5.99" in json.loads(capsys.readouterr().out)["commands"][1]


def test_an_interrupted_start_goes_on_and_keeps_the_commands_that_ran(place, monkeypatch, capsys):
    ran = []

    def stopping(words):
        ran.append(words[0])
        if words[0] != "identify":
            return main(words)
        if ran.count("identify") == 1:
            return 2
        shutil.copytree("started/robot", "started/identified")
        return 0

    monkeypatch.setattr(start, "main", stopping)
    every = Start.steps
    monkeypatch.setattr(
        Start, "steps", lambda *args: [s for s in every(*args) if s.words[0] in ORDER[:5]]
    )
    assert main(["start", "arm.xml", "logs"]) == 2
    assert "stopped at: gaponet identify started/data" in capsys.readouterr().err
    assert main(["start", "arm.xml", "logs"]) == 0
    assert ran == [
        "robot",
        "import",
        "gap",
        "identify",
        "identify",
        "gap",
    ]  # the doctor is asked directly
    lines = Path("started/commands.sh").read_text().splitlines()
    assert [shlex.split(line)[1] for line in lines] == [
        "robot",
        "import",
        "doctor",
        "gap",
        "identify",
        "gap",
    ]


@pytest.fixture
def started(place, monkeypatch, capsys):
    """The commands that ran after robot, import and doctor of four logs; the fifth lies beside."""
    ran = []
    every = Start.steps
    look = start.api.doctor

    def run(words):
        ran.append(words[0])
        return main(words)

    def doctor(data, **how):
        ran.append("doctor")
        return look(data, **how)

    def first_steps(*args):
        return [step for step in every(*args) if step.words[0] in ORDER[:3]]

    monkeypatch.setattr(start, "main", run)
    monkeypatch.setattr(start.api, "doctor", doctor)
    monkeypatch.setattr(Start, "steps", first_steps)
    Path("logs/swing_4.csv").rename("swing_4.csv")
    assert main(["start", "arm.xml", "logs"]) == 0
    assert ran == ORDER[:3]
    ran.clear()
    capsys.readouterr()
    return ran


def contents():
    """The files of the started folder."""
    return {file: file.read_bytes() for file in Path("started").rglob("*") if file.is_file()}


def count_sequences():
    return len(Path("started/data/sequences.jsonl").read_text().splitlines())


def test_the_same_logs_elsewhere_are_the_same_data(started):
    shutil.copytree("logs", "other")
    assert main(["start", "arm.xml", "other"]) == 0
    assert started == ["import"]


def test_logs_behind_a_link_are_compared_and_hidden_files_are_not(place):
    Path("logs").rename("day")
    Path("logs").mkdir()
    Path("logs/day").symlink_to(Path("day").resolve())
    Path("logs/.swing_9.csv").write_text("hidden\n")
    compared = hash_logs(Path("logs"), Path("started"))
    assert sorted(compared) == [f"day/swing_{seed}.csv" for seed in range(5)]


def test_more_logs_run_again_what_followed_from_them(started):
    Path("logs/swing_4.csv").write_text("no log\n")
    assert main(["start", "arm.xml", "logs"]) == 2  # a new log that cannot be read may be mended
    assert started == ["import"]
    Path("swing_4.csv").rename("logs/swing_4.csv")
    assert main(["start", "arm.xml", "logs"]) == 0
    assert started[1:] == ["import", "doctor"]
    assert count_sequences() == 5
    assert main(["start", "arm.xml", "logs"]) == 0
    assert started[3:] == []


def test_another_cut_of_the_logs_needs_another_folder(started, capsys):
    before = contents()
    assert main(["start", "arm.xml", "logs", "--cut", "3"]) == 2
    assert "started/data was imported with --robot started/robot" in capsys.readouterr().err
    assert contents() == before


def test_other_logs_need_another_folder(started, capsys):
    before = contents()
    shutil.copytree("logs", "other")
    Path("other/swing_2.csv").unlink()
    Path("other/swing_3.csv").write_text(Path("swing_4.csv").read_text())
    Path("logs/swing_3.csv").unlink()
    gone = "swing_2.csv, swing_3.csv are missing or changed in other"
    for words, why in (
        (["other"], gone),
        (["other", "--dry-run"], gone),
        (["logs"], "swing_3.csv is"),
    ):
        assert main(["start", "arm.xml", *words]) == 2
        said = capsys.readouterr().err
        assert why in said
        assert "Give another --out for these logs, or the same logs again" in said
        assert "or delete started/data" in said
    assert contents() == before


def test_where_the_dataset_was_deleted_other_logs_are_imported(started):
    Path("logs/swing_3.csv").unlink()
    shutil.rmtree("started/data")
    assert main(["start", "arm.xml", "logs"]) == 0
    assert count_sequences() == 3


def test_what_is_said_of_the_logs_reaches_their_import(place, capsys):
    """Options that messages of import recommend; by some of them the first recording is read here
    already.
    """
    for file in Path("logs").iterdir():
        table = np.loadtxt(file, delimiter=",", skiprows=1)
        head = file.read_text().split("\n", 1)[0].replace("shoulder", "a1")
        np.savetxt(
            file,
            np.c_[table[:, :1], np.rad2deg(table[:, 1:])],
            delimiter=",",
            header=head,
            comments="",
        )
    said = [
        "--map",
        "a1=shoulder",
        "--position-unit",
        "deg",
        "--time-unit",
        "ms",
        "--cut",
        "3",
        "--skip-bad",
        "--budget",
        "4m",
    ]
    assert main(["start", "arm.xml", "logs", "--dry-run", "--json", *said]) == 0
    found = json.loads(capsys.readouterr().out)
    words = shlex.split(found["commands"][1])
    assert (found["joints"], found["rate_hz"]) == (["shoulder", "elbow"], 50.0)
    line = " ".join(words)
    for option in ("--map a1=shoulder", "--position-unit deg", "--time-unit ms", "--cut 3.0"):
        assert option in line
    assert "--skip-bad" in words
    assert found["commands"][4].endswith("--budget 4m")


def rename_in_logs(old, new):
    for file in Path("logs").iterdir():
        file.write_text(file.read_text().replace(old, new))


def assert_stops_with_a_file_to_correct(capsys):
    """Return what is printed, and the file."""
    assert main(["start", "arm.xml", "logs"]) == 2
    said = capsys.readouterr()
    assert "they are in started/logs.toml: check those with a ?" in said.err
    return said.out, Path("started/logs.toml")


def assert_goes_on(monkeypatch, capsys):
    """The folder that holds the guess is its own: the first command begins."""
    assert main(["start", "arm.xml", "logs", "--dry-run"]) == 0
    monkeypatch.setattr(start, "main", lambda words: 2)
    assert main(["start", "arm.xml", "logs"]) == 2
    assert "stopped at: gaponet robot new" in capsys.readouterr().err


def test_a_guessed_joint_stops_with_a_file_to_check(place, monkeypatch, capsys):
    rename_in_logs("shoulder", "a1")
    assert main(["start", "arm.xml", "logs", "--dry-run"]) == 0
    said = capsys.readouterr()
    assert "\\n" not in said.err
    assert re.search('^ *"a1" = "shoulder"', said.out, re.MULTILINE)
    printed, told = assert_stops_with_a_file_to_correct(capsys)
    assert '"a1" = "shoulder"' in printed
    assert '"a1" = "shoulder"' in told.read_text()
    assert_goes_on(monkeypatch, capsys)


def test_a_signal_that_is_not_found_stops_with_a_file_to_correct(place, monkeypatch, capsys):
    rename_in_logs("meas", "x")
    assert main(["start", "arm.xml", "logs", "--dry-run"]) == 2
    said = capsys.readouterr()
    assert "\\n" not in said.err
    assert re.search('^ *# qpos = "…"', said.out, re.MULTILINE)
    printed, told = assert_stops_with_a_file_to_correct(capsys)
    assert '"a1" = "shoulder"' not in printed
    text = told.read_text()
    assert '# qpos = "…"' in text
    told.write_text(re.sub("# qpos.*", 'qpos = "{joint}_x"', text))
    assert_goes_on(monkeypatch, capsys)


def test_logs_with_an_error_are_not_fitted(place, monkeypatch, capsys):
    for file in Path("logs").iterdir():  # the shoulder's command with the other sign
        head, *rows = file.read_text().splitlines()
        values = np.array([[float(x) for x in row.split(",")] for row in rows])
        values[:, 1] *= -1
        file.write_text(
            "\n".join([head, *(",".join(f"{x:.6f}" for x in row) for row in values)]) + "\n"
        )
    assert main(["start", "arm.xml", "logs"]) == 2
    said = capsys.readouterr().err.splitlines()[-1]
    assert "sign: shoulder moves against its command" in said
    assert "delete started/data, and give the same command again" in said
    assert not Path("started/identified").exists()
