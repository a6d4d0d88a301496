"""`gaponet COMMAND …`: one function per command; an input error is one line on stderr and exit code 2."""

from __future__ import annotations

import ast
import functools
import io
import os
import signal
import sys
from collections.abc import Callable, Sequence
from difflib import get_close_matches
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from textwrap import shorten
from typing import Any

from gaponet.errors import GAPONetError, UsageError, missing_extra
from gaponet.text import plain

# Task → command → module:function. A module is imported when its command is run; help reads what it says of itself.
TASKS = {
    "Logs": {
        "import": "gaponet.cli.logs:import_logs",
        "formats": "gaponet.cli.logs:formats",
        "doctor": "gaponet.cli.logs:doctor",
        "data": "gaponet.cli.data:data",
        "excite": "gaponet.cli.robots.excite:excite",
        "collect": "gaponet.cli.collect:collect",
        "robot": "gaponet.cli.robots.robot:robot",
    },
    "The gap": {
        "gap": "gaponet.cli.gap:gap",
        "view": "gaponet.cli.view:view",
    },
    "Closing it": {
        "identify": "gaponet.cli.identify:identify",
        "train": "gaponet.cli.train:train",
        "calibrate": "gaponet.cli.calibrate:calibrate",
        "export": "gaponet.cli.export:export",
    },
    "Is it closed?": {
        "eval": "gaponet.cli.train:evaluate",
        "report": "gaponet.cli.train:report",
        "runs": "gaponet.cli.studies.runs:runs",
        "experiment": "gaponet.cli.studies.experiment:experiment",
    },
    "On a robot, real or virtual": {
        "run": "gaponet.cli.robots.run:run",
        "record": "gaponet.cli.robots.record:record",
        "virtual": "gaponet.cli.robots.virtual:virtual",
    },
    "Try it, time it, share it": {
        "demo": "gaponet.cli.demo:demo",
        "bench": "gaponet.cli.bench:bench",
        "push": "gaponet.cli.share:push",
        "pull": "gaponet.cli.share:pull",
    },
}
ABOUT = "Close the gap between simulated and real motors from joint logs."
WIDTH = 100  # letters of a command's purpose
COMMANDS = {name: where for commands in TASKS.values() for name, where in commands.items()}


def load(command: str) -> Callable[..., Any]:
    """The function behind a command."""
    module, function = COMMANDS[command].split(":")
    return getattr(import_module(module), function)


def main(argv: Sequence[str] | None = None, begin: Callable[[], object] = lambda: None) -> int:
    """Run a command; returns its exit code. `begin` is called once all options are understood, just before it."""
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):  # a terminal may lack our letters, and a file's name may be no text
            stream.reconfigure(errors="backslashreplace")
    try:
        _run(list(sys.argv[1:] if argv is None else argv), begin)
        sys.stdout.flush()
    except GAPONetError as error:
        return _say(f"{type(error).__name__.removesuffix('Error')}: {error}")
    except ModuleNotFoundError as error:
        missing = missing_extra(error)
        if missing is None:
            raise
        return _say(f"Missing: {missing}")
    except BrokenPipeError:  # `| head` has seen enough
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 128 + 13  # SIGPIPE, which Windows has not
    except OSError as error:  # a full disk, a missing permission: the user's to mend, not a bug
        return _say(f"File: {error.filename or ''}: {error.strerror or error}")
    except MemoryError:
        return _say("Memory: there is not enough of it for this; give less at once, or close other programs")
    except KeyboardInterrupt:
        print("interrupted; what was written so far is complete", file=sys.stderr)
        return 128 + signal.SIGINT
    return 0


def _run(argv: list[str], begin: Callable[[], object]) -> None:
    if argv == ["--version"]:
        from gaponet import __version__

        print(f"gaponet {__version__}")
        return
    if not argv or argv[0] in ("-h", "--help"):
        print(overview())
        return
    name, completing = argv[0], argv[0].startswith("--tyro-")
    if name not in COMMANDS and not completing:
        close = get_close_matches(name, COMMANDS, 1)
        guess = f"do you mean {close[0]}? " if close else ""
        raise UsageError(f"no command '{name}'; {guess}gaponet --help lists them all")
    import tyro

    def begun(command: Callable[..., Any]) -> Callable[..., Any]:
        @functools.wraps(command)
        def run(*args: Any, **kwargs: Any) -> Any:
            begin()
            return command(*args, **kwargs)

        return run

    tyro.extras.subcommand_cli_from_dict(
        {name: begun(load(name)) for name in (COMMANDS if completing else (name,))},
        prog="gaponet",
        description=ABOUT,
        args=argv,
        sort_subcommands=False,
    )


def overview() -> str:
    """All commands by task, a line each, on one screen; nothing is imported for it."""
    lines = ["usage: gaponet COMMAND …   (gaponet COMMAND --help for one of them)", "", ABOUT]
    for task, commands in TASKS.items():
        lines += ["", task]
        lines += [f"  {name:<11}{_purpose(*where.split(':'))}" for name, where in commands.items()]
    return "\n".join(lines)


def _purpose(module: str, function: str) -> str:
    """The first sentence of a command's docstring."""
    spec = find_spec(module)
    assert spec
    assert spec.origin
    tree = ast.parse(Path(spec.origin).read_text(encoding="utf-8"))
    found = next(n for n in tree.body if isinstance(n, ast.FunctionDef) and n.name == function)
    first = " ".join((ast.get_docstring(found) or "").split("\n\n")[0].split())
    return shorten(first, WIDTH, placeholder=" …")


def _say(text: str) -> int:
    """An error in one line, and its exit code."""
    print(plain(text), file=sys.stderr)
    return 2
