"""Extensions by other packages: log formats and drivers.

A package names them in its metadata, as entry points of one of two groups:

- `gaponet.formats`: a module that reads logs. gaponet.data.formats says what it has.
- `gaponet.drivers`: a function (robot, **options) that returns a Driver
  (gaponet.hw.control.driver). `gaponet run` gives it those of its own options that are parameters
  of the function, such as port.

A built-in name cannot be replaced. A failure of an extension is logged once as a warning, and
gaponet continues without the extension.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping
from functools import cache
from importlib import import_module
from importlib.metadata import EntryPoint, entry_points
from typing import Any, TypeVar

from gaponet.base.errors import UsageError
from gaponet.base.text import escape

FORMATS = "gaponet.formats"
DRIVERS = "gaponet.drivers"
GROUPS = (FORMATS, DRIVERS)
Result = TypeVar("Result")
_WARNED: set[str] = set()


def registry(group: str, builtin: Mapping[str, str]) -> dict[str, str]:
    """Return name → "module:attribute" of a group: the built-in ones, then those of extensions."""
    entries = dict(builtin)
    for point in _points(group):
        if entries.setdefault(point.name, point.value) != point.value:
            _warn(
                f"{_package(point)}: '{point.name}' of {group}",
                "exists already and is not replaced",
            )
    return entries


def require(group: str, name: str, builtin: Mapping[str, str], what: str) -> Any:
    """Return the object that a group has under a name.

    Raises:
        UsageError: There is no such name, or the extension that brings it is broken.
    """
    known = registry(group, builtin)
    if name not in known:
        raise UsageError(f"no {what} '{name}'; use one of {', '.join(known)}")
    found = attempt(known[name], lambda: load(known[name]), None)
    if found is None:
        raise UsageError(
            f"the package that brings {what} '{name}' is broken; update or uninstall it"
        )
    return found


def load(where: str) -> Any:
    """Return the object that `module:attribute` names, or the module without an attribute."""
    module, _, attribute = where.partition(":")
    return getattr(import_module(module), attribute) if attribute else import_module(module)


def forget_extensions() -> None:
    """Look at the installed packages again at the next call, and warn of each extension again."""
    _points.cache_clear()
    _WARNED.clear()


def attempt(where: str, call: Callable[[], Result], otherwise: Result) -> Result:
    """Return call(). If it fails in an extension, warn and return `otherwise`.

    Args:
        where: `module:attribute` that is called; an error of a built-in one is raised.
    """
    try:
        return call()
    except (Exception, SystemExit) as error:
        package = _package_of(where)
        if not package:
            raise
        _warn(
            f"{package}: {where}",
            f"failed ({type(error).__name__}: {error}); gaponet continues without it",
        )
        return otherwise


@cache
def _points(group: str) -> tuple[EntryPoint, ...]:
    return tuple(sorted(entry_points(group=group), key=lambda point: (_package(point), point.name)))


def _package(point: EntryPoint) -> str:
    return point.dist.name if point.dist else point.module


def _package_of(where: str) -> str:
    """Return the package whose extension brings `module:attribute`; "" if none does."""
    for group in GROUPS:
        for point in _points(group):
            if point.value == where:
                return _package(point)
    return ""


def _warn(what: str, text: str) -> None:
    """Log a warning, the first of each thing, in the main process alone."""
    from multiprocessing import parent_process

    if what not in _WARNED and parent_process() is None:
        logging.getLogger("gaponet").warning("%s", escape(f"Warning: {what} {text}"))
    _WARNED.add(what)
