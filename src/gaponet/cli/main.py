"""`gaponet COMMAND …`: one function per command; an input error is one line on stderr and exit code 2."""

from __future__ import annotations

import sys
from collections.abc import Callable, Sequence
from importlib import import_module
from typing import Any

from gaponet.errors import GAPONetError

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
    """Entry point."""
    import tyro

    argv = list(sys.argv[1:] if argv is None else argv)
    if argv == ["--version"]:
        from gaponet import __version__

        print(f"gaponet {__version__}")
        return 0
    names = argv[:1] if argv[:1] and argv[0] in COMMANDS else list(COMMANDS)
    try:
        tyro.extras.subcommand_cli_from_dict(
            {name: load(name) for name in names},
            prog="gaponet",
            description="Close the gap between simulated and real motors from joint logs.",
            args=argv,
            sort_subcommands=False,
        )
    except GAPONetError as error:
        print(f"{type(error).__name__.removesuffix('Error')}: {error}", file=sys.stderr)
        return 2
    except OSError as error:  # a full disk, a missing permission: the user's to mend, not a bug
        print(f"File: {error.filename or ''}: {error.strerror or error}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print("interrupted; what was written so far is complete", file=sys.stderr)
        return 130
    return 0


def entry() -> None:
    """Console script."""
    sys.exit(main())


if __name__ == "__main__":
    entry()
