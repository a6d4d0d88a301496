"""What Windows has not is not needed from logs to a report: here it is taken away from Linux."""

import ast
import subprocess
import sys
from pathlib import Path

import pytest
from arm import write_arm
from logs import late, wave, write_sage

import gaponet

pytestmark = pytest.mark.skipif(sys.platform == "win32", reason="there it is so")
SOURCE = Path(gaponet.__file__).parent
POSIX = ("fcntl", "resource", "termios", "tty", "pty", "pwd", "grp", "syslog", "readline")
WITHOUT = f"""
# subprocess takes a Python that has msvcrt for Windows
import fcntl, os, signal, subprocess, sys, types

real, sys.modules["msvcrt"] = fcntl, types.ModuleType("msvcrt")

def locking(descriptor, mode, count):
    assert os.lseek(descriptor, 0, os.SEEK_CUR) > os.fstat(descriptor).st_size
    try:
        real.flock(descriptor, real.LOCK_EX | real.LOCK_NB)
    except BlockingIOError:
        raise PermissionError(13, "Permission denied") from None

class Hidden:
    def find_spec(self, name, path=None, target=None):
        if name in {POSIX!r}:
            raise ModuleNotFoundError(f"No module named {{name!r}}", name=name)

sys.modules["msvcrt"].locking, sys.modules["msvcrt"].LK_NBLCK = locking, 2
for name in {POSIX!r}:
    sys.modules.pop(name, None)
sys.meta_path.insert(0, Hidden())
for module, names in (
    (os, "pread pwrite fchmod O_NOFOLLOW getuid geteuid openpty killpg"),
    (signal, "SIGHUP SIGPIPE SIGALRM setitimer"),
):
    for name in names.split():
        delattr(module, name)

import gaponet.base.files
gaponet.base.files.WINDOWS = True
"""
WAY = """
from pathlib import Path
import gaponet as gp
from gaponet.cli.main import main
from gaponet.nn.training.config import TrainConfig, PretrainingConfig

work = Path(sys.argv[1])
gp.import_logs(work / "logs", robot=work / "arm", out=work / "data", unit_id="a", payload_mass=0.0)
small = PretrainingConfig(
    rounds=1, num_envs=4, steps=20, gradient_steps=5, batch_size=64, sensor_states=16
)
gp.train(work / "data", out=work / "run", budget="120", config=TrainConfig(pretraining=small))
for words in ("doctor data", "eval run data", "report run", "report . --list"):
    name, *rest = words.split()
    assert main([name, *(w if w.startswith("--") else str(work / w) for w in rest)]) == 0, words
assert (work / "run" / "report.html").is_file()
print("all the way")
"""
LOCK = """
import subprocess, sys
from pathlib import Path
from gaponet.base.files import lock_file
descriptor, folder = lock_file(Path(sys.argv[1])), Path(sys.argv[1]).parent
assert descriptor is not None
if len(sys.argv) == 2:
    words = [sys.executable, "-c", sys.stdin.read(), sys.argv[1], "again"]
    assert "AssertionError" in subprocess.run(words, capture_output=True, text=True).stderr
    print("locked")
"""


def without_posix(code: str, *args: object) -> str:
    whole = WITHOUT + code
    words = [sys.executable, "-c", whole, *map(str, args)]
    done = subprocess.run(words, capture_output=True, text=True, input=whole)
    assert done.returncode == 0, done.stderr
    return done.stdout


def test_the_way_from_logs_to_a_report_needs_nothing_that_windows_has_not(tmp_path):
    robot = write_arm(tmp_path / "arm")
    motions = tmp_path / "logs" / "real" / "arm" / "custom"
    for i in range(5):
        ctrl = wave(80, 2, hertz=0.3 + 0.2 * i)
        write_sage(motions / f"wave_{i}", ctrl, late(ctrl, 2), names=robot.joint_names)
    assert "all the way" in without_posix(WAY, tmp_path)


def test_one_process_locks_another_out(tmp_path):
    assert without_posix(LOCK, tmp_path / "lock") == "locked\n"


def test_what_windows_has_not_is_imported_nowhere_at_the_top():
    """But by the virtual servo bus, which is a pseudo-terminal."""
    for file in SOURCE.rglob("*.py"):
        top = [
            n
            for n in ast.parse(file.read_text(encoding="utf-8")).body
            if isinstance(n, ast.Import | ast.ImportFrom)
        ]
        names = {a.name for n in top if isinstance(n, ast.Import) for a in n.names}
        names |= {n.module for n in top if isinstance(n, ast.ImportFrom)}
        assert file.stem == "so101_virtual" or not names & set(POSIX), file
