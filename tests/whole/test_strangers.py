"""What a stranger named, a user closed or did not install: no command ends in a traceback or in
somebody's markup.
"""

import os
import subprocess
import sys

import pytest
from arm import write_arm
from logs import arm_columns, table_text

from gaponet.base.installation import EXTRAS, install_command
from gaponet.cli.main import main
from gaponet.cli.out import Out
from gaponet.data.store import Dataset

HOSTILE = "[red]x[/] $a$ <script>alert(1)<|script> `b` \x1b[31m\nnew 'q\" & [/bold]"
PARTS = ("[red]x[/]", "$a$", "<script>alert(1)<|script>", "\\x1b[31m\\nnew", "[/bold]")


@pytest.fixture(scope="module")
def place(tmp_path_factory):
    """Logs whose names are markup, HTML and no UTF-8, and the robot that they are of."""
    folder = tmp_path_factory.mktemp("strange")
    write_arm(folder / "arm")
    (folder / "logs").mkdir()
    for i, name in enumerate((os.fsencode(HOSTILE.replace("/", "|")), b"\xff\xfe")):
        with open(os.path.join(os.fsencode(folder), b"logs", name + b".csv"), "w") as file:
            file.write(table_text(arm_columns(60 + i)))
    words = [
        "import",
        f"{folder}/logs",
        "--robot",
        f"{folder}/arm",
        "--unit-id",
        HOSTILE,
        "--payload-mass",
        "0",
        "--out",
        f"{folder}/set",
        "--time-unit",
        "s",
        "--position-unit",
        "rad",
    ]
    assert main(words) == 0
    return folder


@pytest.mark.parametrize(
    ("command", "code"),
    [
        ("doctor {}/set", 0),
        ("gap {}/set --json", 0),
        ("data card {}/set --json", 0),
        ("data split {}/set --by motion", 2),  # two motions cannot be divided in three
        ("data figures {}/set --out {}/f", 0),
    ],
)
def test_hostile_names_pass_through_every_command_as_letters(place, capsys, command, code):
    assert main([word.replace("{}", str(place)) for word in command.split()]) == code
    captured = capsys.readouterr()
    assert "\x1b" not in captured.out + captured.err
    assert code == 0 or captured.err.count("\n") == 1


def test_a_card_in_markdown_holds_no_markup_of_a_strangers(place):
    main(["data", "card", f"{place}/set"])
    text = (place / "set" / "CARD.md").read_text(encoding="utf-8")
    assert "<script>" not in text.replace("\\<", "")
    assert "\\<script\\>alert(1)\\<\\|script\\>" in text


def test_a_table_and_a_line_show_every_letter(capsys):
    out = Out()
    out.console.width = 400
    out.table(HOSTILE, ["name", HOSTILE], [[HOSTILE, "1"]])
    out.say(f" pip install 'gaponet[bench]' {HOSTILE}", HOSTILE)
    printed = capsys.readouterr().out
    for part in PARTS:
        assert printed.count(part) == 5
    assert "pip install 'gaponet[bench]'" in printed


def test_names_that_are_no_text_are_kept_with_their_bytes_escaped(place):
    assert sorted(e.meta.motion for e in Dataset(place / "set").entries)[-1] == "\\udcff\\udcfe"


@pytest.mark.parametrize("missing", ["torch", "serial", "made_up"])
def test_a_missing_extra_is_one_line_with_the_command(missing, monkeypatch, capsys):
    def command(place: str = "x") -> None:
        """Needs something."""
        raise ModuleNotFoundError(f"No module named '{missing}'", name=f"{missing}.sub")

    monkeypatch.setattr("gaponet.cli.main.load", lambda where: command)
    if missing == "made_up":  # that is our mistake, and not the user's
        with pytest.raises(ModuleNotFoundError):
            main(["doctor"])
        return
    assert main(["doctor"]) == 2
    said = f"Missing: {missing} is not installed; run: {install_command(EXTRAS[missing])}\n"
    assert capsys.readouterr().err == said


def test_completion_knows_every_command_where_no_extra_is_installed():
    code = """
import sys
from gaponet.cli.main import main
from gaponet.base.installation import EXTRAS

class Hidden:
    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0] in EXTRAS:
            raise ModuleNotFoundError(name, name=name)

sys.meta_path.insert(0, Hidden())
try:
    code = main(["--tyro-print-completion", "bash"])
except SystemExit as end:
    code = end.code
sys.exit(code)
"""
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert (run.returncode, run.stderr) == (0, "")
    assert "experiment" in run.stdout


@pytest.mark.parametrize(
    "words", [["import", "--formats"], ["import", "--formats", "--json"], ["--help"]], ids=" ".join
)
def test_a_closed_pipe_is_no_traceback(words):
    run = subprocess.Popen(
        [sys.executable, "-m", "gaponet", *words], stdout=subprocess.PIPE, stderr=subprocess.PIPE
    )
    run.stdout.close()
    said = run.stderr.read().decode()
    assert run.wait() in (141, 0)
    assert "Traceback" not in said
    assert "Exception" not in said


def test_ctrl_c_is_one_line_and_130(monkeypatch, capsys):
    def command() -> None:
        """Takes long."""
        raise KeyboardInterrupt

    monkeypatch.setattr("gaponet.cli.main.load", lambda where: command)
    assert main(["doctor"]) == 130
    assert capsys.readouterr().err == "interrupted; what was written so far is complete\n"


IMPORTING = """
import os, runpy, signal, sys
module, sys.argv[1:] = sys.argv[1], ["doctor", "nowhere"]
class Interrupting:
    def find_spec(self, name, path=None, target=None):
        if name == module:
            os.kill(os.getpid(), signal.SIGINT)
sys.meta_path.insert(0, Interrupting())
runpy.run_module("gaponet", run_name="__main__")
"""


@pytest.mark.parametrize("module", ["gaponet.cli.main", "tyro", "gaponet.cli.logs"])
def test_ctrl_c_while_modules_are_imported_is_one_line_and_130(module):
    run = subprocess.run([sys.executable, "-c", IMPORTING, module], capture_output=True, text=True)
    assert (run.returncode, run.stderr) == (130, "interrupted\n")
