"""Validation of file contents: a value of the stated type, or a one-line error with the file and
the field.

A type is a dataclass or a TypedDict; its annotations hold ranges and sizes (annotated_types: Ge,
Interval, Len). pydantic validates strictly: no text for a number, no NaN or infinity unless the
annotation allows it, no unknown field unless the caller allows it. Only this module uses pydantic.
"""

from __future__ import annotations

import functools
import math
import struct
import tokenize
import tomllib
import zipfile
import zlib
from collections.abc import Iterable
from pathlib import Path
from typing import Annotated, Any, TypeVar, cast

import numpy as np
from annotated_types import Interval
from pydantic import AfterValidator, AllowInfNan, ConfigDict, TypeAdapter, ValidationError
from pydantic_core import PydanticSerializationError, to_json
from typing_extensions import TypedDict

from gaponet.base.errors import GAPONetError, UsageError

T = TypeVar("T")
MAX_DOCUMENT_BYTES = 64 << 20  # of a document that is read at once; gaponet's own have kilobytes
MAX_ARRAYS_BYTES = 512 << 20  # of the arrays in one file


def _name(text: str) -> str:
    has_separator = "/" in text or "\\" in text
    if not 0 < len(text) <= 200 or has_separator or text in (".", "..") or min(text) < " ":
        raise ValueError(
            "should be 1 to 200 letters, none of them a slash, a backslash or a control character"
        )
    return text


def _all_finite(value: Any) -> Any:
    if isinstance(value, float) and not math.isfinite(value):
        raise ValueError("holds a number that is not finite")
    if isinstance(value, dict):
        for part in value.values():
            _all_finite(part)
    elif isinstance(value, list):
        for part in value:
            _all_finite(part)
    return value


def _hex(text: str) -> str:
    if len(text) != 64 or not set(text) <= set("0123456789abcdef"):
        raise ValueError("should be the 64 lowercase hex digits of a SHA-256")
    return text


class _Format(TypedDict):
    format: int


Name = Annotated[str, AfterValidator(_name)]  # may become the name of a file
Sha256 = Annotated[str, AfterValidator(_hex)]
Count = Annotated[int, Interval(ge=0, le=10**15)]
Angle = Annotated[float, Interval(ge=-1e3, le=1e3)]  # rad
# Infinity too, but no NaN.
Extended = Annotated[float, AllowInfNan(True), Interval(ge=-math.inf, le=math.inf)]
# A measured number; in a file, None stands for a missing one.
Number = Annotated[
    Annotated[float, AllowInfNan(True)] | None,
    AfterValidator(lambda x: math.nan if x is None else x),
]
Json = Annotated[Any, AfterValidator(_all_finite)]  # any JSON value with finite numbers


def validated(
    kind: type[T],
    data: Any,
    where: str | Path,
    error: type[GAPONetError],
    hint: str = "",
    allow_extra: bool = False,
) -> T:
    """Convert plain data (dict, list, text, numbers) to a value of type `kind`.

    Args:
        kind: Dataclass, TypedDict, or any other type that pydantic supports, such as dict[str,
            float].
        where: Source of the data, for the error.
        error: Class of the error.
        hint: What the user can do, for the error.
        allow_extra: Keep fields that a TypedDict does not name, instead of refusing them.

    Raises:
        error: It names the source, the field, what is wrong, and the hint.
    """
    try:
        text = to_json(data, inf_nan_mode="constants")
    # Of unpaired surrogates and recursive lists.
    except (PydanticSerializationError, ValueError) as invalid:
        raise error(_message(where, str(invalid), hint)) from None
    return parse_json(kind, text, where, error, hint, allow_extra)


def parse_json(
    kind: type[T],
    text: bytes | str,
    where: str | Path,
    error: type[GAPONetError],
    hint: str = "",
    allow_extra: bool = False,
) -> T:
    """Convert JSON text to a value of type `kind`; arguments and error as for `validated`."""
    try:
        value = type_adapter(cast("Any", kind)).validate_json(
            text, extra="allow" if allow_extra else "forbid"
        )
    except ValidationError as invalid:
        raise error(_message(where, _first_error(invalid), hint)) from None
    except GAPONetError as invalid:  # raised by __post_init__
        raise error(_message(where, str(invalid), hint)) from None
    if value is None:
        raise error(_message(where, "holds nothing (null)", hint))
    result: T = value
    return result


def read_json(
    kind: type[T], path: Path, error: type[GAPONetError], hint: str = "", allow_extra: bool = False
) -> T:
    """Read a JSON file as a value of type `kind`; arguments and error as for `validated`."""
    return parse_json(kind, read_limited(path, error, hint), path, error, hint, allow_extra)


def read_format(
    kind: type[T], path: Path, newest: int, error: type[GAPONetError], hint: str = ""
) -> T:
    """Read a JSON file with a "format" of at most `newest`.

    Fields that `kind` does not name are kept.
    """
    table = read_json(_Format, path, error, hint, allow_extra=True)
    if table["format"] > newest:
        raise error(
            f"{path}: format {table['format']} is newer than this gaponet reads ({newest}); "
            "upgrade gaponet"
        )
    return validated(kind, table, path, error, hint, allow_extra=True)


def read_toml(kind: type[T], path: Path, error: type[GAPONetError], hint: str = "") -> T:
    """Read a TOML file as a value of type `kind`; arguments and error as for `validated`."""
    try:
        table = tomllib.loads(read_limited(path, error, hint).decode())
    except (ValueError, RecursionError) as invalid:  # not TOML, not UTF-8, a number of 5,000 digits
        raise error(_message(path, f"not valid TOML: {invalid}", hint)) from None
    return validated(kind, table, path, error, hint)


def load_toml(kind: str, folder: Path, name_or_path: str | Path) -> tuple[Path, dict[str, Any]]:
    """Read folder/NAME.toml of the package, or the TOML file at a path; returns path and table.

    Args:
        kind: Noun for messages, such as "recipe".

    Raises:
        UsageError: There is no such file, or it is not TOML.
    """
    path = folder / f"{name_or_path}.toml"
    if not path.is_file():
        path = Path(name_or_path)
    if not path.is_file():
        names = ", ".join(sorted(p.stem for p in folder.glob("*.toml")))
        raise UsageError(
            f"no {kind} '{name_or_path}': in the package are {names}; or give a .toml file"
        )
    return path, read_toml(dict[str, Any], path, UsageError)


def read_npz(
    path: Path, error: type[GAPONetError], hint: str = "", max_bytes: int = MAX_ARRAYS_BYTES
) -> dict[str, np.ndarray]:
    """Read the arrays of an .npz file by name; pickled objects are refused."""
    if not path.is_file():
        raise error(_message(path, "is missing, or not a file", hint))
    try:
        with zipfile.ZipFile(path) as packed:
            if sum(part.file_size for part in packed.infolist()) > max_bytes:
                raise error(_message(path, f"unpacks to more than {max_bytes >> 20} MiB", hint))
        with np.load(path, allow_pickle=False) as file:
            return {name: np.asarray(file[name]) for name in file.files}
    # NumPy parses a header as Python text; zipfile passes on errors of zlib and struct.
    except (
        OSError,
        ValueError,
        KeyError,
        EOFError,
        MemoryError,
        SyntaxError,
        TypeError,
        NotImplementedError,
        OverflowError,
        RuntimeError,
        tokenize.TokenError,
        struct.error,
        zlib.error,
        zipfile.BadZipFile,
    ) as invalid:
        reason = " ".join(str(invalid).split())[:120] or type(invalid).__name__
        raise error(_message(path, f"not readable ({reason})", hint)) from None


def read_limited(
    path: Path, error: type[GAPONetError], hint: str = "", max_bytes: int = MAX_DOCUMENT_BYTES
) -> bytes:
    """Read a file; refuses folders, pipes and files of more than `max_bytes`."""
    if not path.is_file():
        raise error(_message(path, "is missing, or not a file", hint))
    if path.stat().st_size > max_bytes:
        raise error(_message(path, f"has more than {max_bytes >> 20} MiB", hint))
    return path.read_bytes()


@functools.cache
def type_adapter(kind: Any) -> Any:
    """Return pydantic's strict validator of a type, made once."""
    # pydantic accepts no configuration for a dataclass, but passes that of a union on to its
    # members.
    return TypeAdapter(kind | None, config=ConfigDict(strict=True, allow_inf_nan=False))


def _first_error(invalid: ValidationError) -> str:
    """Describe the first error (field, reason, value) and count the others."""
    errors = invalid.errors(include_url=False)
    kind = errors[0]["type"]
    given = errors[0]["input"]
    field = ""
    for part in errors[0]["loc"]:
        field += f"[{part}]" if isinstance(part, int) else f".{part}"
    field = field.lstrip(".")
    reason = errors[0]["msg"].removeprefix("Input ").removeprefix("Value error, ").rstrip(".")
    if kind == "missing":
        reason = "is missing"
    elif kind in ("unexpected_keyword_argument", "extra_forbidden"):
        reason = "is not a known field"
    elif kind != "json_invalid" and not isinstance(given, (dict, list)):
        reason += f", not {given!r:.60}"
    if len(errors) > 1:
        reason += f" (and {len(errors) - 1} more)"
    return f"{field}: {reason}" if field else reason


def _message(where: str | Path, reason: str, hint: str) -> str:
    return f"{where}: {reason}" + (f"; {hint}" if hint else "")


def require_choice(name: str, value: object, choices: Iterable[str]) -> None:
    """Refuse a word that is none of the choices.

    Raises:
        UsageError: It names the choices.
    """
    known = tuple(choices)
    if value not in known:
        raise UsageError(f"{name} is {value!r}; choose {', '.join(known)}")
