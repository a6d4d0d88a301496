"""What the installed parts offer: commands, log formats, writers, figures, places, each by its name.

A part is a package behind the entry-point group `gaponet.parts`; gaponet itself needs none of them. Its `__init__`
imports nothing and holds tables of text, name → "module:attribute"; a module is imported when its name is asked for:

    COMMANDS   gaponet NAME                              FORMATS   readers of logs (gaponet.data.formats)
    PROVIDES   what core's commands use if it is there   WRITERS   datasets in others' formats (gaponet.data.writers)
    NAMES      names of `import gaponet as gp`

The four parts of this repository are one distribution; somebody else's package takes part in the same way. Such a
third-party part never replaces a name that gaponet has. Its failures are warnings: gaponet goes on without it.
"""

from __future__ import annotations

import re
import sys
from collections.abc import Callable, Mapping
from functools import cache
from importlib import import_module
from importlib.metadata import EntryPoint, entry_points
from types import MappingProxyType
from typing import Any, TypeVar

from gaponet.errors import MissingPartError
from gaponet.text import plain

GROUP = "gaponet.parts"
DISTRIBUTION = "gaponet"  # what its own parts are installed with
TABLES = ("COMMANDS", "FORMATS", "PROVIDES", "WRITERS", "NAMES")
NOTHING: Mapping[str, str] = MappingProxyType({})
Result = TypeVar("Result")


def offered(table: str, core: Mapping[str, str] = NOTHING) -> dict[str, str]:
    """Return everything in a table by name: the core's, its own parts', then third-party parts' that have a new name.

    Args:
        core: What the core itself has in this table.
    """
    offers = dict(core)
    for package, part in _installed_parts():
        found = _third_party_table(package, part, table) if package else getattr(part, table, {})
        for name, where in found.items():
            if offers.setdefault(name, where) != where:
                _warn(f"{package}: its {table} has '{name}', which exists already and stays; update {package}")
    return offers


def attempt(where: str, call: Callable[[], Result], otherwise: Result) -> Result:
    """Return call(), or `otherwise` and a warning where it fails and `where` belongs to a third-party part."""
    try:
        return call()
    except (Exception, SystemExit) as error:
        package = third_party(where)
        if not package:
            raise
        _warn_of_failure(package, where, error)
        return otherwise


def third_party(where: str) -> str:
    """Return the third-party package that offers `module:attribute`, or "" where gaponet itself does."""
    for package, part in _installed_parts():
        if package and any(where in _third_party_table(package, part, table).values() for table in TABLES):
            return package
    return ""


@cache
def _installed_parts() -> tuple[tuple[str, Any], ...]:
    """(third-party package or "", module) of each part that can be imported; gaponet's own come first."""
    parts: list[tuple[str, Any]] = []
    for point in sorted(entry_points(group=GROUP), key=lambda point: (bool(_package(point)), point.name)):
        try:
            parts.append((_package(point), point.load()))
        except (Exception, SystemExit) as error:
            if not _package(point):
                raise
            _warn_of_failure(_package(point), point.value, error)
    return tuple(parts)


def _package(point: EntryPoint) -> str:
    """Return the distribution that a third-party entry point came with, or "" for gaponet's own."""
    name = point.dist.name if point.dist else point.name
    return "" if name == DISTRIBUTION else name


def _third_party_table(package: str, part: Any, table: str) -> dict[str, str]:
    """A table of a third-party part without the entries that are not name → "module:attribute"."""
    try:
        entries = dict(getattr(part, table, {}))
    except (Exception, SystemExit) as error:
        _warn_of_failure(package, table, error)
        return {}
    text = {k: v for k, v in entries.items() if isinstance(k, str) and isinstance(v, str)}
    good = {k: v for k, v in text.items() if re.fullmatch(r"[\w.]+(:\w+)?", v)}
    for name in entries.keys() - good.keys():
        _warn_of_failure(package, f"{table}[{name!r}]", TypeError('is not text, name → "module:attribute"'))
    return good


def _warn_of_failure(package: str, where: str, error: BaseException) -> None:
    _warn(
        f"{package}: {where} failed ({type(error).__name__}: {error}); gaponet works without it; "
        f"pip uninstall {package} or update it"
    )


@cache
def _warn(text: str) -> None:
    """Say it once on stderr, in the main process alone."""
    from multiprocessing import parent_process

    if parent_process() is None:
        print(plain(f"Warning: {text}"), file=sys.stderr)


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
