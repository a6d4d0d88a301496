"""What a file says becomes a value of a stated type here, or one line that names the file and the field.

A structure is a dataclass or a TypedDict; ranges and sizes stand in its annotations (annotated_types: Ge, Interval,
Len). pydantic checks it, strictly: no text for a number, no NaN or infinity unless the annotation says so, no unknown
field unless the caller keeps those. Nothing outside this module asks pydantic.
"""

from __future__ import annotations

import functools
import math
import struct
import tokenize
import tomllib
import zipfile
import zlib
from pathlib import Path
from typing import Annotated, Any, TypeVar, cast

import numpy as np
from annotated_types import Interval
from pydantic import AfterValidator, AllowInfNan, ConfigDict, TypeAdapter, ValidationError
from pydantic_core import PydanticSerializationError, to_json
from typing_extensions import TypedDict

from gaponet.base.errors import GAPONetError, UsageError

T = TypeVar("T")
LARGEST = 64 << 20  # bytes of a document that is read at once; ours have kilobytes
LARGEST_ARRAYS = 512 << 20  # bytes of the arrays of one file


def _name(text: str) -> str:
    if not 0 < len(text) <= 200 or "/" in text or "\\" in text or text in (".", "..") or min(text) < " ":
        raise ValueError("should be 1 to 200 letters, none of them a slash, a backslash or a control character")
    return text


def _all_finite(value: Any) -> Any:
    if isinstance(value, float) and not math.isfinite(value):
        raise ValueError("holds a number that is not finite")
    for part in value.values() if isinstance(value, dict) else value if isinstance(value, list) else ():
        _all_finite(part)
    return value


def _hex(text: str) -> str:
    if len(text) != 64 or not set(text) <= set("0123456789abcdef"):
        raise ValueError("should be the 64 lowercase hex digits of a SHA-256")
    return text


class _Format(TypedDict):
    format: int


Name = Annotated[str, AfterValidator(_name)]  # of something that may become the name of a file
Sha256 = Annotated[str, AfterValidator(_hex)]
Count = Annotated[int, Interval(ge=0, le=10**15)]
Angle = Annotated[float, Interval(ge=-1e3, le=1e3)]  # rad
Extended = Annotated[float, AllowInfNan(True), Interval(ge=-math.inf, le=math.inf)]  # infinity too, but no NaN
# What was measured; None, in a file, where there was nothing to measure.
Number = Annotated[Annotated[float, AllowInfNan(True)] | None, AfterValidator(lambda x: math.nan if x is None else x)]
Json = Annotated[Any, AfterValidator(_all_finite)]  # whatever JSON can say in finite numbers


def validated(
    kind: type[T], data: Any, where: str | Path, error: type[GAPONetError], hint: str = "", more: bool = False
) -> T:
    """Plain data (dict, list, text, numbers) as a value of type `kind`.

    Args:
        kind: Dataclass, TypedDict, or anything else that pydantic knows, such as dict[str, float].
        hint: What to do about it, for the error.
        more: Keep fields that a TypedDict does not name, instead of refusing them.

    Raises:
        error: The error to raise, with file, field, what is wrong with it, and the hint.
    """
    try:
        text = to_json(data, inf_nan_mode="constants")
    except (PydanticSerializationError, ValueError) as found:  # half a surrogate pair, lists without end
        raise error(_line(where, str(found), hint)) from None
    return parse_json(kind, text, where, error, hint, more)


def parse_json(
    kind: type[T], text: bytes | str, where: str | Path, error: type[GAPONetError], hint: str = "", more: bool = False
) -> T:
    """JSON text as a value of type `kind`; arguments and error as of `validated`."""
    try:
        value = _checker(cast("Any", kind)).validate_json(text, extra="allow" if more else "forbid")
    except ValidationError as found:
        raise error(_line(where, _first(found), hint)) from None
    except GAPONetError as found:  # a dataclass's own rule
        raise error(_line(where, str(found), hint)) from None
    if value is None:
        raise error(_line(where, "holds nothing (null)", hint))
    return value


def read_json(kind: type[T], path: Path, error: type[GAPONetError], hint: str = "", more: bool = False) -> T:
    """A JSON file as a value of type `kind`; arguments and error as of `validated`."""
    return parse_json(kind, content(path, error, hint), path, error, hint, more)


def read_format(kind: type[T], path: Path, newest: int, error: type[GAPONetError], hint: str = "") -> T:
    """A JSON file whose "format" is a whole number up to `newest`, with fields that `kind` does not name kept."""
    table = read_json(_Format, path, error, hint, more=True)
    if table["format"] > newest:
        raise error(f"{path}: format {table['format']} is newer than this gaponet reads ({newest}); upgrade gaponet")
    return validated(kind, table, path, error, hint, more=True)


def read_toml(kind: type[T], path: Path, error: type[GAPONetError], hint: str = "") -> T:
    """A TOML file as a value of type `kind`; arguments and error as of `validated`."""
    try:
        table = tomllib.loads(content(path, error, hint).decode())
    except (ValueError, RecursionError) as found:  # not TOML, not UTF-8, a number of 5,000 digits
        raise error(_line(path, f"not valid TOML: {found}", hint)) from None
    return validated(kind, table, path, error, hint)


def load_toml(kind: str, folder: Path, name_or_path: str | Path) -> tuple[Path, dict[str, Any]]:
    """Path and table of folder/NAME.toml, which the package ships, or of the file at a path.

    Args:
        kind: What it is, for messages: "recipe".

    Raises:
        UsageError: No such file, or not TOML.
    """
    path = folder / f"{name_or_path}.toml"
    if not path.is_file():
        path = Path(name_or_path)
    if not path.is_file():
        known = ", ".join(sorted(p.stem for p in folder.glob("*.toml")))
        raise UsageError(f"no {kind} '{name_or_path}': in the package are {known}; or give a .toml file")
    return path, read_toml(dict[str, Any], path, UsageError)


def read_npz(path: Path, error: type[GAPONetError], hint: str = "") -> dict[str, np.ndarray]:
    """The arrays of an .npz file, by name; nothing pickled is ever loaded."""
    if not path.is_file():
        raise error(_line(path, "is missing, or not a file", hint))
    try:
        with zipfile.ZipFile(path) as packed:
            if sum(part.file_size for part in packed.infolist()) > LARGEST_ARRAYS:
                raise error(_line(path, f"unpacks to more than {LARGEST_ARRAYS >> 20} MiB", hint))
        with np.load(path, allow_pickle=False) as file:
            return {name: np.asarray(file[name]) for name in file.files}
    # NumPy reads a header as Python text; zipfile raises what zlib and struct do.
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
    ) as found:
        reason = " ".join(str(found).split())[:120] or type(found).__name__
        raise error(_line(path, f"not readable ({reason})", hint)) from None


def content(path: Path, error: type[GAPONetError], hint: str = "", largest: int = LARGEST) -> bytes:
    """The bytes of a file; refuses what is none (a folder, a pipe) and what has more than `largest`."""
    if not path.is_file():
        raise error(_line(path, "is missing, or not a file", hint))
    if path.stat().st_size > largest:
        raise error(_line(path, f"has more than {largest >> 20} MiB", hint))
    return path.read_bytes()


@functools.cache
def _checker(kind: Any) -> Any:
    # pydantic takes no configuration for a dataclass itself, but hands that of a union on to its members.
    return TypeAdapter(kind | None, config=ConfigDict(strict=True, allow_inf_nan=False))


def _first(found: Any) -> str:
    """The first complaint: field, reason, what was there; and how many more there are."""
    errors = found.errors(include_url=False)
    kind, given = errors[0]["type"], errors[0]["input"]
    field = "".join(f"[{part}]" if isinstance(part, int) else f".{part}" for part in errors[0]["loc"]).lstrip(".")
    reason = errors[0]["msg"].removeprefix("Input ").removeprefix("Value error, ").rstrip(".")
    if kind == "missing":
        reason = "is missing"
    elif kind in ("unexpected_keyword_argument", "extra_forbidden"):
        reason = "is not a known field"
    elif kind != "json_invalid" and not isinstance(given, (dict, list)):
        reason += f", not {given!r:.60}"
    rest = f" (and {len(errors) - 1} more)" if len(errors) > 1 else ""
    return f"{field}{': ' if field else ''}{reason}{rest}"


def _line(where: str | Path, reason: str, hint: str) -> str:
    return f"{where}: {reason}" + (f"; {hint}" if hint else "")
