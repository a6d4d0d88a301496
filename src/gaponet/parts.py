"""What the installed parts offer: commands, log formats, writers, figures, places, each by its name.

A part is a package behind the entry-point group `gaponet.parts`; gaponet itself needs none of them. Its `__init__`
imports nothing and holds tables of text, name → "module:attribute"; a module is imported when its name is asked for:

    COMMANDS   gaponet NAME                              FORMATS   readers of logs (gaponet.data.formats)
    PROVIDES   what core's commands use if it is there   WRITERS   datasets in others' formats (gaponet.data.writers)
    NAMES      names of `import gaponet as gp`

The four parts of this repository are one distribution; somebody else's package takes part in the same way.
"""

from __future__ import annotations

from functools import cache
from importlib import import_module
from importlib.metadata import entry_points
from typing import Any

from gaponet.errors import MissingPartError

GROUP = "gaponet.parts"


@cache
def offered(table: str) -> dict[str, str]:
    """Everything that the installed parts offer in a table, by name, in the order of the parts' names."""
    found: dict[str, str] = {}
    for point in sorted(entry_points(group=GROUP), key=lambda p: p.name):
        found |= getattr(point.load(), table, {})
    return found


def take(table: str, name: str, what: str) -> Any:
    """The object behind a name of a table; its module is imported now.

    Args:
        what: What is wanted, in words, for the error.

    Raises:
        MissingPartError: No installed part offers it.
    """
    where = offered(table).get(name)
    if where is None:
        raise MissingPartError(f"{what} is not in this installation (parts: {installed()}); install gaponet whole")
    return named(where)


def named(where: str) -> Any:
    """The object that `module:attribute` names, or the module without an attribute."""
    module, _, attribute = where.partition(":")
    return getattr(import_module(module), attribute) if attribute else import_module(module)


def installed() -> str:
    """The names of the installed parts beside the core."""
    return ", ".join(sorted(p.name for p in entry_points(group=GROUP))) or "core alone"
