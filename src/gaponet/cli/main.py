"""`gaponet COMMAND …`: one function per command; an input error is one line on stderr and exit code 2."""

from __future__ import annotations

import io
import os
import signal
import sys
from collections.abc import Callable, Sequence
from importlib import import_module
from typing import Any

from gaponet.errors import GAPONetError, missing_extra
from gaponet.text import plain

# command → module:function. A module is imported when its command is run (or when help lists them all).
COMMANDS = {
    "robot": "gaponet.cli.robot:robot",
    "import": "gaponet.cli.data:import_logs",
    "doctor": "gaponet.cli.data:doctor",
    "pair": "gaponet.cli.gap:pair",
    "gap": "gaponet.cli.gap:gap",
    "data": "gaponet.cli.dataset:data",
    "collect": "gaponet.cli.collect:collect",
    "identify": "gaponet.cli.identify:identify",
    "train": "gaponet.cli.train:train",
    "calibrate": "gaponet.cli.calibrate:calibrate",
    "export": "gaponet.cli.export:export",
    "eval": "gaponet.cli.train:evaluate",
    "report": "gaponet.cli.train:report",
    "compare": "gaponet.cli.compare:compare",
    "experiment": "gaponet.cli.experiment:experiment",
    "run": "gaponet.cli.run:run",
    "record": "gaponet.cli.record:record",
    "virtual": "gaponet.cli.virtual:virtual",
    "budget": "gaponet.cli.budget:budget",
    "runs": "gaponet.cli.runs:runs",
    "view": "gaponet.cli.view:view",
    "demo": "gaponet.cli.demo:demo",
    "bench": "gaponet.cli.bench:bench",
}


def load(command: str) -> Callable[..., Any]:
    """The function behind a command."""
    module, function = COMMANDS[command].split(":")
    return getattr(import_module(module), function)


def main(argv: Sequence[str] | None = None) -> int:
    """Run a command; returns its exit code."""
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):  # a terminal may lack our letters, and a file's name may be no text
            stream.reconfigure(errors="backslashreplace")
    try:
        _run(list(sys.argv[1:] if argv is None else argv))
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
        return 128 + signal.SIGPIPE
    except OSError as error:  # a full disk, a missing permission: the user's to mend, not a bug
        return _say(f"File: {error.filename or ''}: {error.strerror or error}")
    except MemoryError:
        return _say("Memory: there is not enough of it for this; give less at once, or close other programs")
    except KeyboardInterrupt:
        print("interrupted; what was written so far is complete", file=sys.stderr)
        return 128 + signal.SIGINT
    return 0


def _run(argv: list[str]) -> None:
    if argv == ["--version"]:
        from gaponet import __version__

        print(f"gaponet {__version__}")
        return
    import tyro

    names = argv[:1] if argv[:1] and argv[0] in COMMANDS else list(COMMANDS)
    tyro.extras.subcommand_cli_from_dict(
        {name: load(name) for name in names},
        prog="gaponet",
        description="Close the gap between simulated and real motors from joint logs.",
        args=argv,
        sort_subcommands=False,
    )


def _say(text: str) -> int:
    """An error in one line, and its exit code."""
    print(plain(text), file=sys.stderr)
    return 2


def entry() -> None:
    """Console script."""
    try:
        code = main()
    except KeyboardInterrupt:  # while an error was being said
        code = 128 + signal.SIGINT
    signal.signal(
        signal.SIGINT, signal.SIG_DFL
    )  # what is left is Python's own end, which a second Ctrl-C may cut short
    sys.exit(code)


if __name__ == "__main__":
    entry()
