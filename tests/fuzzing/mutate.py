"""Changes that break files: of bytes, of text, and of what JSON, Parquet and NumPy files hold."""

from __future__ import annotations

import io
import json
import random
import re
import zipfile
import zlib
from collections.abc import Callable
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

# path below a folder → content; None is a folder where a file is expected
Files = dict[str, bytes | None]
Change = Callable[[bytes, random.Random], bytes]
UNREADABLE = (
    ValueError,
    LookupError,
    EOFError,
    OSError,
    NotImplementedError,
    zipfile.BadZipFile,
    zlib.error,
)

NUMBERS = (
    "nan",
    "NaN",
    "inf",
    "-inf",
    "1e30",
    "-1e30",
    "1e400",
    "1e-320",
    "0",
    "-0.0",
    "-1",
    "1",
    "2",
    "0.5",
    "3.3",
    "100",
    "1e9",
    "99999999999999999999999999",
    "9223372036854775808",
    "-9223372036854775809",
    "4294967296",
    "0x10",
    "1_000",
    "true",
    "",
    "x",
    '"text"',
    "1e5",
    "1e-5",
    "3600",
    "200000",
    "1.3",
)
WORDS = (
    "",
    "x",
    "..",
    "../../secret/file",
    "/etc/passwd",
    "[red]m[/]",
    "$(id)",
    "<b>&",
    "a\nb",
    "a/b",
    "é∆",
    "\x00",
    "\x1b[31m",
    "{0}",
    "{chunk_index:099999999d}",
    "{chunk_index.__class__.__mro__}",
    "{file_index}/../..",
    "%s",
    "A" * 300,
    "A" * 140_000,
    "nan",
    "None",
    "positions",
    "time",
    "ctrl.elbow",
    "qpos",
    "v9.9",
    "-",
    "--help",
    " ",
)
VALUES: tuple[Any, ...] = (
    None,
    True,
    False,
    0,
    1,
    -1,
    2,
    10**9,
    10**30,
    2**63,
    -(2**63) - 1,
    0.5,
    -0.5,
    1e-9,
    1e30,
    1e308,
    float("nan"),
    float("inf"),
    float("-inf"),
    [],
    {},
    [[]],
    [1],
    ["x"],
    {"x": 1},
    [None],
    *WORDS,
)


def mutate(files: Files, rng: random.Random, only: tuple[str, ...] = ("",)) -> Files:
    """The files with one to three changes in those whose names end as `only` says."""
    files = dict(files)
    names = [name for name in sorted(files) if name.endswith(only)]
    for _ in range(rng.choice((1, 1, 1, 2, 3))):
        name = rng.choice(names)
        content = files.get(name)
        if rng.random() < 0.03:
            _of_folder(files, name, names, rng)
        elif content is not None:
            files[name] = change(name, content, rng)
    return files


def change(name: str, content: bytes, rng: random.Random) -> bytes:
    """One change of a kind that suits the file; where it holds something else by now, of its
    bytes.
    """
    of = [c for suffix, c in BY_SUFFIX.items() if name.endswith(suffix)]
    kinds = [*of[0] * 3, _bytes] if of else [_text, _bytes]
    try:
        return rng.choice(kinds)(content, rng)
    except UNREADABLE:  # what an earlier change left cannot be parsed: bytes can always be changed
        return _bytes(content, rng)


def _of_folder(files: Files, name: str, names: list[str], rng: random.Random) -> None:
    kind = rng.randrange(4)
    if kind == 0:
        files.pop(name, None)
        names.remove(name) if len(names) > 1 else None
    elif kind == 1:
        files[name] = None
    elif kind == 2:
        files[name] = b""
    else:
        # None where an earlier change took the only file
        files[name] = files.get(rng.choice(names))


def _bytes(content: bytes, rng: random.Random) -> bytes:
    at = rng.randrange(len(content) + 1)
    kind = rng.randrange(5)
    if kind == 0:
        return content[:at]
    if kind == 1:
        return content[:at] + content[at + rng.choice((1, 4, 100)) :]
    if kind == 2:
        return content[:at] + rng.randbytes(rng.choice((1, 1, 4, 50))) + content[at:]
    if kind == 3:
        other = rng.randrange(len(content) + 1)
        return content[:at] + content[other : other + 200] + content[at:]
    out = bytearray(content)
    for _ in range(rng.choice((1, 1, 3, 20))):
        if out:
            out[rng.randrange(len(out))] = rng.choice((0, 255, 34, 10, 44, rng.randrange(256)))
    return bytes(out)


def _text(content: bytes, rng: random.Random) -> bytes:
    """The content with a number, a word or a line changed."""
    text = content.decode("utf-8", errors="surrogateescape")
    kind = rng.randrange(9)
    if kind <= 2:
        text = _replace(r"[-+]?\d[\d.eE+-]*", rng.choice(NUMBERS), text, rng)
    elif kind == 3:
        text = _replace(r"[A-Za-z_][\w.]*", rng.choice(WORDS), text, rng)
    elif kind == 4:
        text = _replace(
            r"[,\[\]\"={}:]", rng.choice((",", "", "[", '"', "=", "\n", ",,")), text, rng
        )
    else:
        text = _lines(text, rng)
    return text.encode("utf-8", errors="surrogateescape")


def _lines(text: str, rng: random.Random) -> str:
    lines = text.split("\n")
    a = rng.randrange(len(lines))
    b = rng.randrange(len(lines))
    kind = rng.randrange(7)
    if kind == 0:
        del lines[a]
    elif kind == 1:
        lines.insert(a, lines[b])
    elif kind == 2:
        lines[a], lines[b] = lines[b], lines[a]
    elif kind == 3:
        lines[a] = rng.choice(("", " ", ",", "#", "﻿", "\x00", "1,2,3"))
    elif kind == 4:  # a column twice, gone, or one number in all rows
        at = rng.randrange(lines[0].count(",") + 1)
        number = rng.choice(NUMBERS)
        how = rng.randrange(3)
        do = lambda cell: (cell * 2, [], [number])[how]  # noqa: E731
        cells = [line.split(",") for line in lines]
        lines = [",".join(c[:at] + do(c[at : at + 1]) + c[at + 1 :]) for c in cells]
    elif kind == 5:
        lines = lines[: rng.choice((0, 1, 2, 3, 4))]
    else:
        lines[0] = _replace(r"\w+", rng.choice(WORDS), lines[0], rng)
    return "\n".join(lines)


def _replace(pattern: str, new: str, text: str, rng: random.Random) -> str:
    places = list(re.finditer(pattern, text))
    if not places:
        return text + new
    place = rng.choice(places)
    return text[: place.start()] + new + text[place.end() :]


def _json(content: bytes, rng: random.Random) -> bytes:
    return json.dumps(_structure(json.loads(content), rng)).encode()


def _json_line(content: bytes, rng: random.Random) -> bytes:
    lines = content.decode().split("\n")
    at = rng.randrange(max(1, len(lines) - 1))
    lines[at] = json.dumps(_structure(json.loads(lines[at]), rng))
    return "\n".join(lines).encode()


def _structure(value: Any, rng: random.Random) -> Any:
    """A parsed structure with one place changed: another value, a key gone, renamed or added, a
    list longer.
    """
    places = _places(value)
    if not places or rng.random() < 0.01:
        return rng.choice(VALUES)
    node, key = rng.choice(places)
    kind = rng.randrange(10)
    if kind == 0:
        del node[key]
    elif kind == 1 and isinstance(node, dict):
        node[rng.choice(WORDS)] = node.pop(key)
    elif kind == 2 and isinstance(node, list):
        node *= rng.choice((0, 2, 100))
    elif kind == 3 and isinstance(node[key], (int, float)):
        node[key] = node[key] * rng.choice((-1, 0.5, 2, 1000, 1e9))
    else:
        node[key] = rng.choice(VALUES)
    return value


def _places(node: Any) -> list[tuple[Any, Any]]:
    """(dict or list, key or index) of every value below a node, a container before its content."""
    if not isinstance(node, (dict, list)):
        return []
    places: list[tuple[Any, Any]] = []
    for key in node if isinstance(node, dict) else range(len(node)):
        places.append((node, key))
        places += _places(node[key])
    return places


def _parquet(content: bytes, rng: random.Random) -> bytes:
    """One column gone, renamed, twice, of other values or of another type; or rows gone or
    twice.
    """
    table = pq.read_table(io.BytesIO(content))
    at = rng.randrange(table.num_columns)
    kind = rng.randrange(9)
    values = table.column(at).to_pylist()
    if kind <= 3:
        table = _of_table(table, at, kind, rng)
    elif kind <= 5 or values:
        table = table.set_column(at, table.column_names[at], _of_column(values, kind, rng))
    out = io.BytesIO()
    pq.write_table(table, out)
    return out.getvalue()


def _of_table(table: pa.Table, at: int, kind: int, rng: random.Random) -> pa.Table:
    """A column gone (kind 0), renamed (1) or twice (2), or rows gone or twice (3)."""
    names = table.column_names
    if kind == 0:
        return table.remove_column(at)
    if kind == 1:
        names[at] = rng.choice((*WORDS, *names))
        return table.rename_columns(names)
    if kind == 2:
        return table.append_column(rng.choice((names[at], "x")), table.column(at))
    cut = rng.randrange(table.num_rows + 1)
    twice = pa.concat_tables([table, table])
    return rng.choice((table.slice(0, cut), table.slice(cut), twice))


def _of_column(values: list[Any], kind: int, rng: random.Random) -> pa.Array:
    """One value in all rows (kind 4), half of the values and another type (5), or one value
    changed.
    """
    if kind == 4:
        return pa.array([rng.choice((None, True, False, 1, "x"))] * len(values))
    if kind == 5:
        half = [v if rng.random() < 0.5 else None for v in values]
        return _column(half, rng.choice(TYPES))
    row = rng.randrange(len(values))
    values[row] = _of_value(values[row], rng)
    return _column(values, None)


def _of_value(value: Any, rng: random.Random) -> Any:
    number = rng.choice((None, float("nan"), float("inf"), 1e30, -1, 0, 10**9, 2**62, 0.5))
    if isinstance(value, list):
        cut = rng.randrange(len(value) + 1)
        return rng.choice((value[:cut], [*value, 1.0], [number] * len(value), None))
    return rng.choice(WORDS) if isinstance(value, str) else number


TYPES = (
    pa.int8(),
    pa.string(),
    pa.bool_(),
    pa.float16(),
    pa.uint64(),
    pa.timestamp("ns"),
    pa.list_(pa.float64()),
    pa.struct([("a", pa.int8())]),
)


def _column(values: list[Any], kind: pa.DataType | None) -> pa.Array:
    """The values as an array of a type, of None or of text where they cannot be converted."""
    try:
        array = pa.array(values, from_pandas=False)
        return array if kind is None else array.cast(kind)
    except (pa.ArrowException, OverflowError, TypeError):
        return (
            pa.nulls(len(values), kind)
            if kind
            else pa.array([None if v is None else str(v) for v in values])
        )


def _npz(content: bytes, rng: random.Random) -> bytes:
    """One array of another shape, kind or name, or with numbers that are none."""
    with np.load(io.BytesIO(content), allow_pickle=False) as file:
        arrays = dict(file)
    name = rng.choice(sorted(arrays))
    array = arrays.pop(name)
    kind = rng.randrange(6)
    if kind == 0:
        name = rng.choice(WORDS[:8])
    elif kind == 1:
        array = rng.choice(
            (array.ravel(), array[None], array[:0], np.float64(3), np.array("x"), array.T)
        )
    elif kind == 2:
        array = array.astype(rng.choice(("O", "U9", "complex", "bool", "float16")))
    elif kind == 3:
        array = np.array(rng.choice((0, -1, float("nan"), 1e-9, 1e30, [1, 2], "x")))
    elif array.size and array.dtype.kind == "f":
        array = array.copy()
        array.flat[rng.randrange(array.size)] = rng.choice((np.nan, np.inf, 1e30, 1e-30, -1e9))
    out = io.BytesIO()
    np.savez(out, **({name.replace("/", "_") or "x": array} | arrays))
    return out.getvalue()


BY_SUFFIX: dict[str, list[Change]] = {
    ".jsonl": [_json_line, _json_line, _text],
    ".json": [_json, _json, _text],
    ".parquet": [_parquet],
    ".npz": [_npz],
    ".csv": [_text],
    ".toml": [_text],
    ".txt": [_text],
    ".xml": [_text],
}
