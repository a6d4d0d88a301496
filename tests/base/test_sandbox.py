"""An untrusted file that exceeds a limit gives a one-line error, and the next file is read."""

import os
import resource
import subprocess
import sys
from pathlib import Path

import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from arm import write_arm
from base import hostile
from base.hostile import parsed

from gaponet.base import sandbox
from gaponet.base.errors import LogError, ModelError, RobotError
from gaponet.data.formats import ReadOptions, parquet, read_logs
from gaponet.nn.artifact import GapModel
from gaponet.robot.spec import load_robot

# Of a command that opens a hostile file, with all its processes.
MAX_PROCESSOR_S = 10.0
MAX_MEMORY = 1 << 30
MAX_ADDRESSES = 12 << 30  # bytes, so that a failure does not take the machine with it
limited = pytest.mark.skipif(sys.platform != "linux", reason="memory is limited on Linux alone")


def test_results_are_returned_unchanged(tmp_path):
    got = parsed(tmp_path / "a", "answers")
    assert got["zeros"].shape == (1000, 3)
    assert got["name"][0] == "a"
    got["zeros"][0] = 1.0  # an array of one's own
    assert parsed(tmp_path / "a", "prints") not in (None, os.getpid())


@pytest.mark.parametrize(
    ("how", "said"),
    [
        ("refuses", "x: no log"),
        (
            "ends",
            "x: is not readable (its parser ended with code -11: damaged, or too large); copy or "
            "make it again",
        ),
        (
            "fails",
            "x: is not readable (ZeroDivisionError: what nobody thought of); copy or make it again",
        ),
        pytest.param(
            "wants memory",
            "x: takes more than 960 MiB to be read, more than a file may; cut it",
            marks=limited,
        ),
        ("never ends", "x: is not read after 1 s, longer than a file of its size may take; cut it"),
        (
            "writes",
            "x: is not readable (OSError: [Errno 27] File too large); copy or make it again",
        ),
    ],
)
@limited
def test_a_failing_parser_gives_one_line_and_the_next_file_is_read(
    tmp_path, monkeypatch, how, said
):
    monkeypatch.setattr(sandbox, "PROCESSOR_S", 1.0)
    monkeypatch.chdir(tmp_path)
    with pytest.raises(LogError) as error:
        parsed(Path("x"), how)
    assert str(error.value) == said
    assert parsed(Path("x"), "answers")["name"][0] == "x"


def test_an_idle_child_ends_and_the_next_file_starts_another(tmp_path, monkeypatch):
    first = parsed(tmp_path, "prints")
    sandbox.Child.current.process.stdin.close()  # as after IDLE_S
    sandbox.Child.current.process.wait()
    second = parsed(tmp_path, "prints")
    assert first != second == parsed(tmp_path, "prints")


def test_one_child_serves_all_files_and_ends_with_its_parent(tmp_path):
    assert parsed(tmp_path, "prints") == parsed(tmp_path, "prints")
    code = (
        "from pathlib import Path; from base.hostile import parsed; print(parsed(Path('x'), "
        "'prints'))"
    )
    words = [sys.executable, "-c", code]
    done = subprocess.run(
        words, capture_output=True, text=True, env=os.environ | {"PYTHONPATH": ":".join(sys.path)}
    )
    with pytest.raises(ProcessLookupError):
        os.kill(int(done.stdout), 0)


@limited
@pytest.mark.parametrize(
    "name", ["mjcf cone", "mjcf supersphere", "mjcf nkey", "mjcf nuser_geom", "mjcf iterations"]
)
def test_a_robot_beyond_the_limits_is_refused(tmp_path, name):
    hostile.CASES[name].make(tmp_path)
    with pytest.raises(RobotError):
        _ = load_robot(tmp_path / "arm").qpos_range


@limited
@pytest.mark.parametrize("name", ["onnx Loop"])
def test_a_network_beyond_the_limits_is_refused(tmp_path, name, monkeypatch):
    monkeypatch.setattr(sandbox, "PROCESSOR_S", 1.0)
    hostile.CASES[name].make(tmp_path)
    with pytest.raises(ModelError, match=r"model\.onnx"):
        GapModel.load(tmp_path / "run")


@pytest.mark.parametrize("name", ["pickle bytearray", "pickle repr", "csv sparse"])
def test_a_log_beyond_the_limits_is_refused(tmp_path, name, monkeypatch):
    monkeypatch.setattr(sandbox, "PROCESSOR_S", 1.0)
    hostile.CASES[name].make(tmp_path)
    robot = load_robot(tmp_path / "arm")
    with pytest.raises(LogError):
        list(
            read_logs(
                tmp_path / "logs",
                robot,
                ReadOptions(allow_pickle=True, position_unit="rad", time_unit="s"),
            )
        )


def test_a_plain_or_already_accepted_robot_starts_no_child(tmp_path, monkeypatch):
    robot = write_arm(tmp_path / "arm")
    mesh = hostile.asset('<mesh name="m" vertex="0 0 0 1 0 0 0 1 0 0 0 1"/>')
    mesh(tmp_path / "meshed")
    meshed = load_robot(tmp_path / "meshed" / "arm")
    assert meshed.qpos_range.shape == (2, 2)
    monkeypatch.setattr(sandbox, "answer_of_child", None)
    assert robot.qpos_range.shape == (2, 2)
    assert load_robot("so101").qpos_range.shape == (6, 2)
    assert load_robot(tmp_path / "meshed" / "arm").qpos_range.shape == (2, 2)


def test_rows_are_counted_before_reading(tmp_path):
    pq.write_table(pa.table({"time": pa.nulls(70_000_000, pa.int8())}), tmp_path / "a.parquet")
    assert (tmp_path / "a.parquet").stat().st_size < 1e6
    with pytest.raises(LogError, match="512"):
        parquet.read(tmp_path / "a.parquet", ["time"])


@pytest.mark.slow
@limited
@pytest.mark.parametrize("name", hostile.CASES)
def test_a_command_ends_with_one_line_within_the_limits(tmp_path, name):
    hostile.CASES[name].make(tmp_path)
    words = [
        sys.executable,
        "-m",
        "gaponet",
        *(word.format(tmp_path) for word in hostile.CASES[name].words),
    ]

    def limit() -> None:
        resource.setrlimit(resource.RLIMIT_AS, (MAX_ADDRESSES, MAX_ADDRESSES))

    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    done = subprocess.run(
        words, capture_output=True, text=True, errors="replace", preexec_fn=limit, timeout=300
    )
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    lines = [
        x
        for x in done.stderr.splitlines()
        if not x.startswith(("reading", "checking", "downloading"))
    ]
    assert (done.returncode, len(lines)) in ((2, 1), (0, 0)), done.stderr
    assert used.ru_utime + used.ru_stime - before.ru_utime - before.ru_stime < MAX_PROCESSOR_S
    assert used.ru_maxrss << 10 < MAX_MEMORY
