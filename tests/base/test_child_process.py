"""Commands and their children import no module of the current folder."""

import importlib.metadata
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import scipy.io
from arm import write_arm

from gaponet.cli.main import COMMANDS

IMPORTABLE = {*sys.stdlib_module_names, *importlib.metadata.packages_distributions()}
# packages_distributions() of CUDA's packages also has paths, such as nvidia/cusparselt.
NAMES = sorted(name for name in IMPORTABLE - {"gaponet", "__main__"} if name.isidentifier())
MARK = "ran.txt"
POISON = (
    f"import os; open(os.path.join(os.path.dirname(__file__), {MARK!r}), 'a').write(__name__ + "
    "'\\n')\n"
)

# What a console script is: sys.path begins with the folder of scripts.
SCRIPT = "import sys\nfrom gaponet.__main__ import entry\nentry()\n"

EVERY_COMMAND = """
from contextlib import suppress
from gaponet.base.child_process import exclude_current_folder
exclude_current_folder()
from gaponet.cli.main import COMMANDS, main
for command in COMMANDS:
    with suppress(SystemExit):
        main([command, "--help"])
"""

CHILDREN = """
import sys, os
from gaponet.base import child_process
child_process.exclude_current_folder()
from pathlib import Path
from gaponet.data.importer import ImportRequest, import_logs
from gaponet.hw.control.driver import DriverError
from gaponet.hw.control.watchdog import Watchdog
from gaponet.base.executor import open_pool
from gaponet.robot.spec import load_robot

if __name__ == "__main__":
    robot = load_robot(Path("arm"))
    lab = ImportRequest(unit_id="lab", payload_mass=0.0)
    print(len(import_logs("logs", robot, "set", lab).entries), "imported")
    lock = os.open("lock", os.O_CREAT | os.O_RDWR)
    port = os.ttyname(os.openpty()[1])
    arm = {"kind": "so101", "robot": "so101", "port": port, "silent": True}
    watchdog = Watchdog(arm, lock, 1, 1)
    watchdog.wait_ready()
    watchdog.release()
    print("watched")
    with open_pool("local", 1) as pool:
        print(*pool.map(abs, [-3]), "computed")
"""


@pytest.fixture
def poisoned(tmp_path):
    """Folder with modules named like all installed ones, a robot and a log."""
    for name in NAMES:
        (tmp_path / f"{name}.py").write_text(POISON)
    write_arm(tmp_path / "arm")
    (tmp_path / "logs").mkdir()
    time = 0.02 * np.arange(60)
    angles = np.sin(time)[:, None] * [0.3, 0.2]
    scipy.io.savemat(tmp_path / "logs" / "a.mat", {"time": time, "cmd": angles, "q": 0.9 * angles})
    told = (
        'ctrl = "cmd"\nqpos = "q"\njoints = ["shoulder", "elbow"]\nposition_unit = '
        '"rad"\ntime_unit = "s"\n'
    )
    (tmp_path / "logs" / "logs.toml").write_text(told)
    return tmp_path


def python(folder: Path, code: str, *words: str, **env: str) -> str:
    """Run a script of another folder in this folder; returns its output."""
    (folder / "elsewhere").mkdir(exist_ok=True)
    script = folder / "elsewhere" / "script.py"
    script.write_text(code)
    done = subprocess.run(
        [sys.executable, str(script), *words],
        cwd=folder,
        capture_output=True,
        text=True,
        env=os.environ | env,
    )
    return done.stdout + done.stderr


def ran(folder: Path) -> list[str]:
    return (folder / MARK).read_text().split() if (folder / MARK).exists() else []


def test_plain_python_imports_modules_of_the_current_folder(poisoned):
    """Shows that the fixture works."""
    subprocess.run([sys.executable, "-c", "import numpy"], cwd=poisoned, capture_output=True)
    assert "numpy" in ran(poisoned)


def test_no_command_imports_modules_of_the_current_folder(poisoned):
    said = python(poisoned, EVERY_COMMAND)
    assert said.count("usage: gaponet") == len(COMMANDS), said
    assert ran(poisoned) == []


def test_no_child_imports_modules_of_the_current_folder(poisoned):
    pytest.importorskip("serial")
    assert python(poisoned, CHILDREN).splitlines() == ["1 imported", "watched", "3 computed"]
    assert ran(poisoned) == []


@pytest.mark.parametrize("how", ["-m", "PYTHONPATH"])
def test_a_command_started_by_m_or_pythonpath_imports_none_of_them(poisoned, how):
    """Modules that Python imports before gaponet are exempt."""
    started = [sys.executable, "-c", "import sys; print(*sys.modules)"]
    # By .pth files as well.
    loaded = subprocess.run(started, cwd="/", capture_output=True, text=True).stdout.split()
    library = sys.stdlib_module_names - {
        "json",
        "tomllib",
        "hashlib",
        "subprocess",
        "multiprocessing",
        "csv",
    }
    for name in library.union(loaded):
        (poisoned / f"{name}.py").unlink(missing_ok=True)
    if how == "-m":
        words = [sys.executable, "-m", "gaponet", "import", "--formats"]
        said = subprocess.run(words, cwd=poisoned, capture_output=True, text=True).stdout
    else:
        said = python(
            poisoned,
            SCRIPT,
            "import",
            "--formats",
            PYTHONPATH=f":{os.environ.get('PYTHONPATH', '')}",
        )
    assert "rosbag" in said
    assert ran(poisoned) == []
