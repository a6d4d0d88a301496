"""The command line as a whole."""

import subprocess
import sys

import pytest

from gaponet.cli.main import COMMANDS, main


def test_help_is_one_screen_with_a_sentence_for_every_command(capsys):
    assert main(["--help"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert len(lines) <= 48
    assert max(map(len, lines)) <= 80
    for name in COMMANDS:
        (line,) = [line for line in lines if line.startswith(f"  {name} ")]
        assert len(line.split(maxsplit=1)[1]) > 20
        assert not line.endswith("…")


def test_help_imports_no_command():
    code = (
        "import sys; from gaponet.cli.main import main; main(['--help'])\n"
        "print({'tyro', 'torch', 'mujoco', 'gaponet.cli.train'} & {*sys.modules})"
    )
    said = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True
    ).stdout.splitlines()
    assert "gaponet COMMAND --help" in said[0]
    assert said[-1] == "set()"


def test_a_mistyped_command_is_told_its_neighbour(capsys):
    assert main(["trian"]) == 2
    assert (
        capsys.readouterr().err
        == "Usage: no command 'trian'; do you mean train? gaponet --help lists them all\n"
    )


def test_the_help_of_an_option_has_no_line_breaks_of_the_source(monkeypatch, capsys):
    monkeypatch.setenv("COLUMNS", "1000")
    with pytest.raises(SystemExit):
        main(["identify", "--help"])
    (line,) = [
        line for line in capsys.readouterr().out.splitlines() if "servo model to try" in line
    ]
    assert "temperature if it varies" in line


@pytest.mark.parametrize("command", ["identify", "train", "collect", "experiment", "export"])
def test_help_names_no_default_where_there_is_none(command, monkeypatch, capsys):
    monkeypatch.setenv("COLUMNS", "1000")
    with pytest.raises(SystemExit):
        main([command, "--help"])
    text = capsys.readouterr().out
    assert "{None}" not in text
    assert "(default: )" not in text
    assert "(default: None)" not in text
    assert "(default: '')" not in text


def test_a_fault_that_a_virtual_robot_does_not_have_is_refused(capsys):
    assert main(["virtual", "serve", "--robot", "so101", "--fault", "stop"]) == 2
    assert "--fault stop: only h1_2 has faults" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["identify", "data", "--threads", "-2"], "--threads -2: give at least 0"),
        (["excite", "--robot", "so101", "--minutes", "nan"], "--minutes nan: give a number"),
    ],
)
def test_a_number_without_a_meaning_is_refused(words, message, tmp_path, capsys):
    assert main([*words, "--out", str(tmp_path / "out")]) == 2
    assert message in capsys.readouterr().err
