"""`gaponet COMMAND …`: one function per command; an input error is one line on stderr and exit code 2."""

from __future__ import annotations

import ast
import io
import os
import signal
import sys
from collections.abc import Callable, Sequence
from difflib import get_close_matches
from functools import partial, wraps
from importlib.util import find_spec
from itertools import chain
from pathlib import Path
from typing import Any

from gaponet.errors import GAPONetError, MissingPartError, UsageError, missing_extra
from gaponet.parts import attempt, installed, named, offered
from gaponet.text import plain

# Task → commands; those of parts that are not installed are left out, and what somebody else's part brings comes last.
TASKS = {
    "Start here": ("start", "demo"),
    "Logs": ("import", "formats", "doctor", "data", "excite", "collect", "robot"),
    "The gap": ("gap", "view"),
    "Closing it": ("identify", "show", "torque", "calibrate", "train", "export"),
    "Is it closed?": ("eval", "check", "fleet", "replay", "report", "runs", "experiment"),
    "On a robot, real or virtual": ("run", "record", "virtual", "attach"),
    "Share it, time it": ("push", "pull", "prune", "bench"),
}
# Command → module:function. A module is imported when its command is run; help reads what it says of itself.
CORE = {
    **{name: f"gaponet.cli.{name}:{name}" for name in ("data", "gap", "identify", "calibrate", "train")},
    **{name: f"gaponet.cli.logs:{name}" for name in ("formats", "doctor")},
    "import": "gaponet.cli.logs:import_logs",
    "eval": "gaponet.cli.train:evaluate",
}
ABOUT = "Close the gap between simulated and real motors from joint logs."


def commands() -> dict[str, str]:
    """Every command of this installation → module:function."""
    return offered("COMMANDS", CORE)


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
        return _say(": ".join(str(part) for part in ("File", error.filename, error.strerror or error) if part))
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
        print(_overview())
        return
    name, completing = argv[0], argv[0].startswith("--tyro-")
    known = commands()
    if name not in known and not completing:
        if name in chain.from_iterable(TASKS.values()):
            raise MissingPartError(
                f"gaponet {name} is not in this installation (parts: {installed()}); install it whole"
            )
        close = get_close_matches(name, known, 1)
        guess = f"do you mean {close[0]}? " if close else ""
        raise UsageError(f"no command '{name}'; {guess}gaponet --help lists them all")
    import tyro

    def begun(command: Callable[..., Any]) -> Callable[..., Any]:
        @wraps(command)
        def run(*args: Any, **kwargs: Any) -> Any:
            begin()
            return command(*args, **kwargs)

        return run

    wanted = known if completing else {name: known[name]}
    found = {name: attempt(where, partial(named, where), None) for name, where in wanted.items()}
    if not completing and found[name] is None:
        raise MissingPartError(f"gaponet {name} is broken in the package that brings it; update that package")
    tyro.extras.subcommand_cli_from_dict(
        {name: begun(command) for name, command in found.items() if command},
        prog="gaponet",
        description=ABOUT,
        args=argv,
        sort_subcommands=False,
    )


def _overview() -> str:
    """All commands by task, a line each, on one screen; nothing is imported for it."""
    lines = ["usage: gaponet COMMAND …   (gaponet COMMAND --help for one of them)", ABOUT]
    known = commands()
    others = tuple(name for name in known if name not in chain.from_iterable(TASKS.values()))
    for task, names in (TASKS | {"Of other packages": others}).items():
        present = [name for name in names if name in known]
        lines += ["", task] * bool(present)
        lines += [f"  {name:<11}{attempt(known[name], partial(_purpose, known[name]), '')}" for name in present]
    return "\n".join(lines)


def _purpose(where: str) -> str:
    """Return the first sentence of a command's docstring."""
    module, function = where.split(":")
    spec = find_spec(module)
    assert spec
    assert spec.origin
    tree = ast.parse(Path(spec.origin).read_text(encoding="utf-8"))
    found = next(n for n in tree.body if isinstance(n, ast.FunctionDef) and n.name == function)
    return (ast.get_docstring(found) or "").splitlines()[0]


def _say(text: str) -> int:
    """An error in one line, and its exit code."""
    print(plain(text), file=sys.stderr)
    return 2
