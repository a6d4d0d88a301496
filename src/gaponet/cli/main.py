"""`gaponet COMMAND …`: one function per command; an input error is one line on stderr and exit
code 2.

A recording that cannot be saved after a robot ran is exit code 3.
"""

from __future__ import annotations

import ast
import io
import math
import os
import signal
import sys
from collections.abc import Callable, Sequence
from dataclasses import is_dataclass
from difflib import get_close_matches
from functools import wraps
from importlib.util import find_spec
from itertools import chain
from pathlib import Path
from typing import Any

from gaponet.base.errors import GAPONetError, UnsavedError, UsageError
from gaponet.base.installation import missing_package
from gaponet.base.plugins import load
from gaponet.base.text import escape

# Task → commands.
TASKS = {
    "Start here": ("app", "start", "demo"),
    "Logs": ("import", "doctor", "data", "excite", "collect", "robot"),
    "The gap": ("gap", "view"),
    "Closing it": ("identify", "adapt", "train", "export"),
    "Is it closed?": ("eval", "check", "replay", "report", "experiment"),
    "On a robot, real or virtual": ("run", "record", "virtual"),
    "Share it": ("push", "pull"),
}
# Functions that have another name or are in another module than their command.
ELSEWHERE = {
    "import": "logs:import_logs",
    "doctor": "logs:doctor",
    "eval": "train:evaluate",
    "push": "share:push",
    "pull": "share:pull",
}
# Command → module:function. A module is imported when its command runs.
COMMANDS = {
    name: "gaponet.cli." + ELSEWHERE.get(name, f"{name}:{name}")
    for name in chain.from_iterable(TASKS.values())
}
SIGPIPE = 13  # Windows does not have it
ABOUT = "Close the gap between simulated and real motors from joint logs."


def main(argv: Sequence[str] | None = None, begin: Callable[[], object] = lambda: None) -> int:
    """Run a command; return its exit code.

    Args:
        argv: The command and its options; default: those of the shell.
        begin: Called when all options are understood, just before the command runs. The console
            script lets Ctrl-C raise KeyboardInterrupt from then on.
    """
    for stream in (sys.stdout, sys.stderr):
        # a terminal may lack our letters, and a file's name may be no text
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")
    try:
        _run(list(sys.argv[1:] if argv is None else argv), begin)
        sys.stdout.flush()
    except BrokenPipeError:  # `| head` has seen enough
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 128 + SIGPIPE
    except KeyboardInterrupt as stop:
        print(f"interrupted; {str(stop) or 'what was written so far is complete'}", file=sys.stderr)
        return 128 + signal.SIGINT
    except Exception as error:
        text = _error_line(error)
        if text is None:
            raise
        print(escape(text), file=sys.stderr)
        # 2 means that nothing was done; here a robot ran
        return 3 if isinstance(error, UnsavedError) else 2
    return 0


def _error_line(error: Exception) -> str | None:
    """Return an error of input or of the machine in one line; None for a fault of the program."""
    if isinstance(error, GAPONetError):
        return f"{type(error).__name__.removesuffix('Error')}: {error}"
    if isinstance(error, ModuleNotFoundError):
        missing = missing_package(error)
        return None if missing is None else f"Missing: {missing}"
    if isinstance(error, OSError):  # a full disk, a missing permission: the user's to mend
        parts = ("File", error.filename, error.strerror or error)
        return ": ".join(str(part) for part in parts if part)
    if isinstance(error, MemoryError):
        return (
            "Memory: there is not enough of it for this; give less at once, or close other programs"
        )
    return None


def _run(argv: list[str], begin: Callable[[], object]) -> None:
    """Parse the command and run it; arguments as of `main`.

    Raises:
        UsageError: There is no such command, or an option is out of range.
    """
    if argv == ["--version"]:
        from gaponet import __version__

        print(f"gaponet {__version__}")
        return
    if not argv or argv[0] in ("-h", "--help"):
        print(_overview())
        return
    name = argv[0]
    is_completion = name.startswith("--tyro-")  # the shell asks what may follow
    if name not in COMMANDS and not is_completion:
        close = get_close_matches(name, COMMANDS, 1)
        guess = f"do you mean {close[0]}? " if close else ""
        raise UsageError(f"no command '{name}'; {guess}gaponet --help lists them all")
    import tyro

    from gaponet.cli.options import OPTIONAL

    wanted = COMMANDS if is_completion else {name: COMMANDS[name]}
    functions = {command: _prepared(load(where), begin) for command, where in wanted.items()}
    tyro.extras.subcommand_cli_from_dict(
        functions,
        prog="gaponet",
        description=ABOUT,
        args=argv,
        sort_subcommands=False,
        registry=OPTIONAL,
    )


def _prepared(function: Callable[..., Any], begin: Callable[[], object]) -> Callable[..., Any]:
    """Return the function of a command for tyro: with options explained in one line each, that are
    checked before it begins.
    """
    from gaponet.cli.options import hide_nothing, join_lines

    join_lines(function)
    hide_nothing(function)

    @wraps(function)
    def run(*args: Any, **kwargs: Any) -> Any:
        _require_counts(kwargs)
        begin()
        return function(*args, **kwargs)

    return run


def _require_counts(options: dict[str, Any]) -> None:
    """Refuse an option that is nan, and a whole number below 0: no option has a meaning for
    them.
    """
    for name, value in options.items():
        option = f"--{name.replace('_', '-')}"
        values = value if isinstance(value, tuple) else (value,)
        for one in values:
            if is_dataclass(one):
                _require_counts(vars(one))
            elif isinstance(one, float) and math.isnan(one):
                raise UsageError(f"{option} nan: give a number")
            elif isinstance(one, int) and one < 0:
                raise UsageError(f"{option} {one}: give at least 0")


def _overview() -> str:
    """All commands by task, a line each, on one screen; nothing is imported for it."""
    lines = ["usage: gaponet COMMAND …   (gaponet COMMAND --help for one of them)", ABOUT]
    for task, names in TASKS.items():
        lines += ["", task, *(f"  {name:<11}{_purpose(COMMANDS[name])}" for name in names)]
    return "\n".join(lines)


def _purpose(where: str) -> str:
    """Return the first sentence of a command's docstring."""
    module, function = where.split(":")
    spec = find_spec(module)
    assert spec
    assert spec.origin
    tree = ast.parse(Path(spec.origin).read_text(encoding="utf-8"))
    definition = next(n for n in tree.body if isinstance(n, ast.FunctionDef) and n.name == function)
    return (ast.get_docstring(definition) or "").splitlines()[0]
