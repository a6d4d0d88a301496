"""Third-party parts: a broken one is a warning, and none replaces what gaponet has."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import nullcontext
from pathlib import Path

import pytest

from gaponet import parts
from gaponet.cli.main import CORE, commands, main
from gaponet.data.formats import detect, formats


@pytest.fixture
def installed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Callable[..., None]]:
    """Install a package `rival` whose part is this source; other modules by name."""

    def install(source: str, **modules: str) -> None:
        info = tmp_path / "rival-1.0.dist-info"
        info.mkdir()
        (info / "METADATA").write_text("Metadata-Version: 2.1\nName: rival\nVersion: 1.0\n")
        (info / "entry_points.txt").write_text(f"[{parts.GROUP}]\nrival = {tmp_path.name}_part\n")
        for name, text in {"part": source, **modules}.items():
            (tmp_path / f"{tmp_path.name}_{name}.py").write_text(text.replace("HERE", tmp_path.name))
        monkeypatch.syspath_prepend(str(tmp_path))
        forget()

    def forget() -> None:
        parts._installed_parts.cache_clear()
        parts._warn.cache_clear()

    yield install
    monkeypatch.undo()
    forget()


BROKEN = {
    "the import fails": ("import no_such_module", "_part failed (ModuleNotFoundError"),
    "its __init__ raises": ("raise ValueError('two\\nlines')", "_part failed (ValueError: two"),
    "its __init__ ends Python": ("raise SystemExit(3)", "_part failed (SystemExit"),
    "a table is none": ("COMMANDS = 3\nFORMATS = 3", "COMMANDS failed (TypeError"),
    "reading a table raises": ("def __getattr__(name):\n    raise OSError(name)", "COMMANDS failed (OSError"),
    "an entry is no text": ("COMMANDS = {'other': 3}", "COMMANDS['other'] failed (TypeError"),
    "a command's module is not there": ("COMMANDS = {'other': 'not.there:run'}", "not.there:run failed (Mod"),
    "a command has no function": ("COMMANDS = {'other': 'json'}", "json failed (ValueError"),
}  # fmt: skip


@pytest.mark.parametrize(("source", "said"), BROKEN.values(), ids=BROKEN)
def test_a_broken_part_is_one_warning_and_every_command_goes_on(installed, capsys, source, said):
    installed(source)
    for words in (["--help"], ["formats", "--help"], ["--help"]):
        with pytest.raises(SystemExit, match=r"^0$") if len(words) > 1 else nullcontext():
            assert main(words) == 0
    err = capsys.readouterr().err
    assert err.startswith("Warning: rival: ")
    assert err.endswith("gaponet works without it; pip uninstall rival or update it\n")
    assert err.count(said) == 1


def test_a_built_in_name_stays_and_one_line_says_so(installed, capsys):
    installed(
        "COMMANDS = {'gap': 'json:loads', 'start': 'json:loads', 'other': 'json:loads'}\n"
        "FORMATS = {'sage': 'json'}\nWRITERS = {'npz': 'json'}\nPROVIDES = {'motions': 'json:loads'}\n"
        "NAMES = {'identify': 'json:loads'}"
    )
    import gaponet as gp
    from gaponet.data.writers import writers

    assert commands() == commands() | CORE
    assert commands()["other"] == "json:loads"
    assert commands()["start"].startswith("gaponet_interop.")
    assert "json" not in {*formats().values(), *writers().values()}
    assert parts.offered("PROVIDES")["motions"].startswith("gaponet_robots.")
    assert gp.identify.__module__ == "gaponet.api"
    assert len(dir(gp)) == len(set(dir(gp)))
    lines = capsys.readouterr().err.splitlines()
    assert len(lines) == len(set(lines)) == 6
    assert lines[0] == "Warning: rival: its COMMANDS has 'gap', which exists already and stays; update rival"


def test_a_part_of_others_adds_a_command_and_a_format(installed, tmp_path, capsys):
    installed(
        "COMMANDS = {'wave': 'HERE_wave:wave'}\nFORMATS = {'wav': 'HERE_wav'}",
        wave='def wave() -> None:\n    """Wave a hand."""\n    print("waved")',
        wav='"""Sound."""\nEXTRA = ""\ndef detects(path): return path.suffix == ".wav"',
    )
    assert main(["wave"]) == main(["--help"]) == main(["formats"]) == 0
    out, err = capsys.readouterr()
    assert "waved" in out
    assert "Wave a hand." in out
    assert "Sound" in out
    assert err == ""
    (tmp_path / "a.wav").touch()
    assert detect(tmp_path / "a.wav") == "wav"


def test_a_broken_command_or_format_of_others_is_refused_and_no_other_is(installed, tmp_path, capsys):
    installed(
        "COMMANDS = {'wave': 'HERE_wave:wave'}\nFORMATS = {'wav': 'HERE_wave', 'mp3': 'HERE_mp3'}",
        wave="import no_such_module",
        mp3="def detects(path): raise RuntimeError('no')",
    )
    assert main(["wave"]) == 2
    assert "gaponet wave is broken in the package that brings it" in capsys.readouterr().err
    (tmp_path / "log.npz").touch()
    assert main(["formats"]) == 0
    assert detect(tmp_path / "log.npz") == "npz"
    assert "RuntimeError: no" in capsys.readouterr().err


def test_a_failure_of_gaponet_itself_is_raised(monkeypatch):
    monkeypatch.setattr(parts.EntryPoint, "load", lambda point: 1 / 0)
    parts._installed_parts.cache_clear()
    with pytest.raises(ZeroDivisionError):
        commands()
