"""Extensions of other packages: a broken one is a warning, and none replaces what gaponet has."""

from __future__ import annotations

import os
import re
import subprocess
import sys
import tomllib
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest
from arm import write_arm
from logs import arm_columns

from gaponet.base import plugins
from gaponet.base.errors import LogError, UsageError
from gaponet.cli.main import main
from gaponet.data.formats import FORMATS, detect, formats
from gaponet.data.importer import ImportRequest, import_logs
from gaponet.data.store import Dataset
from gaponet.hw.drivers.open import open_driver


@pytest.fixture
def installed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Callable[..., None]]:
    """Install a package `rival` with these entry points and modules; HERE is a prefix of module
    names.
    """

    def install(points: str, **modules: str) -> None:
        info = tmp_path / "rival-1.0.dist-info"
        info.mkdir()
        (info / "METADATA").write_text("Metadata-Version: 2.1\nName: rival\nVersion: 1.0\n")
        (info / "entry_points.txt").write_text(points.replace("HERE", tmp_path.name))
        for name, text in modules.items():
            (tmp_path / f"{tmp_path.name}_{name}.py").write_text(text)
        monkeypatch.syspath_prepend(str(tmp_path))
        plugins.forget_extensions()

    yield install
    monkeypatch.undo()
    plugins.forget_extensions()


# The command line knows the drivers that were there when it was imported.
LIST_AND_RUN = """
from contextlib import suppress
from gaponet.cli.main import main
with suppress(SystemExit):
    main(["run", "--help"])
words = ["--driver", "toy", "--motion", "sweep-wrist_flex", "--yes"]
main(["run", *words, "--limits-from", "so101", "--port", "/dev/arm"])
"""
BROKEN = {
    "the import fails": ("import no_such_module", "(ModuleNotFoundError"),
    "the module raises": ("raise ValueError('two\\nlines')", "(ValueError: two"),
    "the module ends Python": ("raise SystemExit(3)", "(SystemExit"),
    "it is no reader": ("", "(AttributeError"),
    "it fails on a file": (
        "EXTRA = ''\ndef detects(path): raise RuntimeError('no')",
        "(RuntimeError: no",
    ),
}


@pytest.mark.parametrize(("source", "said"), BROKEN.values(), ids=BROKEN)
def test_a_broken_format_is_one_warning_and_every_other_is_read(
    installed, tmp_path, caplog, source, said
):
    installed("[gaponet.formats]\nwav = HERE_wav\n", wav=source)
    (tmp_path / "log.npz").touch()
    for _ in range(2):
        assert detect(tmp_path / "log.npz") == "npz"
        assert main(["import", "--formats"]) == 0
    (text,) = [r.getMessage() for r in caplog.records]
    assert text.startswith("Warning: rival: ")
    assert said in text
    assert text.endswith("gaponet continues without it")


def test_a_built_in_name_is_not_replaced_and_one_line_says_so(installed, caplog):
    installed("[gaponet.formats]\nsage = json\n[gaponet.drivers]\nso101 = json:loads\n")
    assert formats() == formats() == FORMATS
    with pytest.raises(UsageError, match="unitree"):
        open_driver("x", "so101")
    assert [r.getMessage() for r in caplog.records] == [
        "Warning: rival: 'sage' of gaponet.formats exists already and is not replaced",
        "Warning: rival: 'so101' of gaponet.drivers exists already and is not replaced",
    ]


def test_an_extension_adds_a_format_and_a_driver(installed, tmp_path, capsys, caplog):
    installed(
        "[gaponet.formats]\nwav = HERE_wav\n[gaponet.drivers]\ntoy = HERE_toy:Toy\n",
        wav='"""Sound."""\nEXTRA = ""\n'
        'def detects(path): return path.is_file() and b"acme" in path.read_bytes()',
        toy="class Toy:\n    def __init__(self, robot, port): self.robot, self.port = robot, port\n"
        "    def __getattr__(self, name): return None",
    )
    assert main(["import", "--formats"]) == 0
    assert "Sound" in capsys.readouterr().out
    for name, text, fmt in (
        ("a.wav", "acme", "wav"),
        ("b.csv", "# acme\n1,2\n", "wav"),
        ("c.csv", "x,y\n1,2\n", "table"),
    ):
        (tmp_path / name).write_text(text)
        assert detect(tmp_path / name) == fmt
    driver = open_driver("toy", "so101", port="x")
    assert (driver.robot.name, driver.port) == ("so101", "x")
    assert caplog.records == []


def test_the_format_of_the_architecture_page_is_listed_and_read(installed, tmp_path, capsys):
    page = (Path(__file__).parents[2] / "docs/architecture.md").read_text(encoding="utf-8")
    section = page.partition("## A package of your own")[2]
    project, module = (
        re.findall(rf"```{kind}\n(.*?)```", section, re.DOTALL)[0] for kind in ("toml", "python")
    )
    points = tomllib.loads(project)["project"]["entry-points"]
    assert set(points) <= set(plugins.GROUPS)
    (tmp_path / f"{points['gaponet.formats']['mylog']}.py").write_text(module)
    installed("[gaponet.formats]\nmylog = mylog\n")
    rows = np.column_stack(list(arm_columns().values())).astype(np.float32)
    robot = write_arm(tmp_path / "arm")
    log = tmp_path / "wave.mylog"
    rows.tofile(log)
    assert main(["import", "--formats"]) == 0
    assert "Log of my arm" in capsys.readouterr().out
    made = import_logs(
        log, robot, tmp_path / "data", ImportRequest(unit_id="lab", payload_mass=0.0)
    )
    (entry,) = made.entries
    assert entry.meta.motion == "wave"
    assert np.allclose(Dataset(tmp_path / "data").read(entry).ctrl, rows[:, 1:3])
    log.write_bytes(b"1234")
    with pytest.raises(LogError, match="five"):
        import_logs(log, robot, tmp_path / "data", ImportRequest(unit_id="lab", payload_mass=0.0))


def test_run_lists_and_opens_the_drivers_of_extensions(installed, tmp_path):
    installed(
        "[gaponet.drivers]\ntoy = HERE_toy:Toy\n", toy="def Toy(robot, port): raise OSError(port)"
    )
    environment = os.environ | {"PYTHONPATH": os.pathsep.join([str(tmp_path), *sys.path])}

    run = subprocess.run(
        [sys.executable, "-P", "-c", LIST_AND_RUN], env=environment, capture_output=True, text=True
    )

    assert "{virtual,unitree,so101,toy}" in " ".join(run.stdout.split())
    assert "/dev/arm" in run.stderr


def test_a_broken_driver_is_refused(installed):
    installed("[gaponet.drivers]\ntoy = HERE_toy:Toy\n", toy="import no_such_module")
    with pytest.raises(UsageError, match="broken"):
        open_driver("toy", "so101")


def test_a_driver_that_lacks_a_member_is_refused(installed):
    installed(
        "[gaponet.drivers]\ntoy = HERE_toy:Toy\n",
        toy="class Toy:\n    def __init__(self, robot): pass",
    )
    with pytest.raises(UsageError, match="lacks"):
        open_driver("toy", "so101")


def test_a_failure_of_gaponet_itself_is_raised(monkeypatch):
    with pytest.raises(ZeroDivisionError):
        plugins.attempt("gaponet.data.formats.npz", lambda: 1 / 0, None)
