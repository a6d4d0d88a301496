"""logs.toml: what a lab's logs mean, said once.

It lies in the folder of the logs, or is given with --logs.

docs/logs.md shows examples.
"""

from __future__ import annotations

import csv
import io
import re
from collections.abc import Mapping
from fnmatch import fnmatchcase
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from annotated_types import Interval, Len
from typing_extensions import TypedDict

from gaponet.base.errors import LogError, UsageError
from gaponet.base.structure import read_toml

NAME = "logs.toml"
HINT = "gaponet import LOGS --robot ROBOT --guess writes one to start from"
Text = Annotated[str, Len(1, 300)]
Gain = Annotated[float, Interval(ge=0, le=1e6)]
Sign = Annotated[int, Interval(ge=-1, le=1)]
Offset = Annotated[float, Interval(ge=-10, le=10)]
# What a name or a sheet may say of a recording: its word here → field of SequenceMeta, and what it
# looks like.
FIELDS = {
    "motion": ("motion", r".+"), "unit": ("unit_id", r".+"), "side": ("payload_side", r"[^_/]+"),
    "payload": ("payload_mass", r"\d+(?:[.p]\d+)?"), "rep": ("repetition", r"\d+"),
    "level": ("level", r"[a-z_]+"), "virtual": ("virtual", r"yes|no"),
    "kp": ("kp", r"\d+(?:[.p]\d+)?"), "kd": ("kd", r"\d+(?:[.p]\d+)?"),
    "estimated": ("estimated", r".+"), "leave_out": ("leave_out", r"yes|no"), "": ("", r".+?"),
}  # fmt: skip
# Words of a pattern that match any text: each more makes a name that does not fit slower to refuse.
MAX_LOOSE_WORDS = 3
NUMBERS = ("payload_mass", "repetition", "kp", "kd")
MAX_SHEET_BYTES = 16 << 20
# Of the files of all built-in formats (SUFFIXES of each): no part of a recording's name.
SUFFIX = re.compile(
    r"\.(csv|tsv|txt|dat|parquet|npz|pt|pkl|mat|h5|hdf5|db3|mcap|bag|json)$", re.IGNORECASE
)


class LogsFile(TypedDict, total=False):
    """The fields of logs.toml, all optional."""

    format: Text  # where it cannot be seen
    # pattern of the recordings' names, or with a slash of their paths:
    # "{motion}_{payload:g}kg_{rep}"
    motion: Text
    # or a table: file, motion, unit, payload, side, rep, level, virtual, kp, kd, kp.<joint>,
    # estimated (which of these are no more than that), leave_out (yes or no)
    manifest: Text
    unit: Text  # of all recordings, like payload (kg) and side
    payload: Annotated[float, Interval(ge=0, le=100)]
    side: Text
    time: Text  # column of the clock
    rate: Annotated[float, Interval(ge=1, le=10_000)]  # Hz, where the log has no clock
    time_unit: Text  # s, ms, us, ns
    # rad, deg, ticks (4096 a turn); fraction (0..1), percent (0..100) or signed_percent
    # (−100..100) of the joint's range; velocities: per s
    position_unit: Text
    # LeRobot's calibration file of the arm, beside logs.toml: what ticks and percent mean
    calibration: Text
    ctrl: Text  # columns of commanded positions, as "{joint}_des", or the name of an array
    qpos: Text
    qvel: Text
    tau: Text
    temperature: Text
    feedforward_torque: Text  # N·m that the controller added to its PD torque
    # where a recording's signals lie in files of their own: "{name}_measured.csv"; {name}: default
    # the state file's
    state_file: Text
    command_file: Text
    time_file: Text
    header: Annotated[list[str], Len(1, 2000)]  # names of the columns of a table that has none
    # of the columns of an array that does not name them, in its order
    joints: Annotated[list[str], Len(1, 500)]
    ignore: list[str]  # columns that are no joints of this robot; "" in joints does the same
    # ctrl is a policy's action: target = home + scale · action
    action_scale: Annotated[float, Interval(ge=1e-6, le=1e3)]
    # while recording, N·m/rad: of all joints, by joint, or an array's name
    kp: Gain | dict[str, Gain] | Text
    kd: Gain | dict[str, Gain] | Text  # N·m·s/rad
    columns: dict[str, str]  # single columns, ours = the log's: "ctrl.elbow" = "cmd_1"
    names: dict[str, str]  # the log's joint = the robot's
    joint_units: dict[str, str]  # where one joint's position is in another unit
    signs: dict[str, Sign]  # −1: the log counts the other way round
    offsets: dict[str, Offset]  # rad to add to positions, after unit and sign
    posture: dict[str, Offset]  # rad at which a joint stood that the log does not hold
    # ctrl = "t_cmd"
    clock: dict[Literal["ctrl", "qpos", "qvel", "tau", "temperature", "feedforward_torque"], str]


def read_logs_file(src: Path, given: str | Path | None = None) -> tuple[LogsFile, Path | None]:
    """Read logs.toml, the given one or that beside the logs; return its contents and path."""
    file = (src if src.is_dir() else src.parent) / NAME
    if given is not None:
        file = Path(given)
    elif not file.is_file():
        return LogsFile(), None
    specified = read_toml(LogsFile, file, UsageError, f"docs/logs.md lists the fields; {HINT}")
    if "calibration" in specified:
        specified["calibration"] = str(file.parent / Path(specified["calibration"]).expanduser())
    return specified, file


class Naming:
    """Labels of recordings by their names: from the pattern `motion` and the sheet `manifest`."""

    def __init__(self, specified: LogsFile, where: Path | None) -> None:
        self.where = str(where or "logs.toml")
        self.pattern = _pattern(specified["motion"], self.where) if "motion" in specified else None
        self.text = specified.get("motion", "")
        self.sheet: list[dict[str, str]] | None = None
        if "manifest" in specified:
            name = specified["manifest"]
            if Path(name).name != name:
                raise UsageError(
                    f'{self.where}: manifest = "{name}": it lies beside logs.toml; give its name'
                )
            self.sheet = _read_sheet((where or Path()).parent / name)
        self.unused = set(range(len(self.sheet or ())))  # rows of the sheet
        self.all: dict[str, Any] = {}
        for word in ("unit", "payload", "side", "kp", "kd"):
            value = specified.get(word)
            is_array = word in ("kp", "kd") and isinstance(value, str)  # a name: it says no number
            if value is not None and not is_array:
                field, _ = FIELDS[word]
                self.all[field] = value

    def of(self, name: str, path: str) -> dict[str, Any]:
        """Fields of SequenceMeta for a recording called `name` at a path relative to the logs."""
        facts = dict(self.all)
        path = "#".join(map(_stem, path.split("#")))
        if self.pattern is not None:
            by_name = self._by_name(self.pattern, name, path)
            facts |= _agreeing(facts, by_name, path, f"logs.toml and {name}")
        if self.sheet is not None:
            by_sheet = self._by_sheet(self.sheet, name, path)
            facts |= _agreeing(facts, by_sheet, path, "logs.toml (or a name) and the manifest")
        return facts

    def _by_name(self, pattern: re.Pattern[str], name: str, path: str) -> dict[str, Any]:
        """Return what the name of a recording says, or its path where the pattern has a slash."""
        match = pattern.fullmatch(path if "/" in self.text else name)
        if not match:
            raise LogError(
                f'{path}: its name does not look like motion = "{self.text}" of {self.where}; '
                "rename it, or list the recordings in a manifest"
            )
        return _fields(match.groupdict(), path)

    def _by_sheet(self, sheet: list[dict[str, str]], name: str, path: str) -> dict[str, Any]:
        """Return what the sheet says of a recording, which one row must name."""
        words = (name, path, path.split("#")[0])
        rows = []
        for i, row in enumerate(sheet):
            pattern = _stem(row["file"])
            if pattern in words or any(fnmatchcase(word, pattern) for word in words):
                rows.append(i)
        if len(rows) != 1:
            raise LogError(
                f"{path}: {len(rows) or 'no'} rows of the manifest of {self.where} name it; "
                f"one must: write {name} under file"
            )
        self.unused -= set(rows)
        stated = dict(sheet[rows[0]])
        del stated["file"]
        return _fields(stated, path)

    def require_all_used(self) -> None:
        """Refuse rows of the sheet that name no recording: one that is missing, or a name with a
        slip.
        """
        if self.sheet and self.unused:
            names = ", ".join(self.sheet[i]["file"] for i in sorted(self.unused))
            raise LogError(
                f"the manifest of {self.where} names recordings that are not there: {names}; mend "
                "the names"
            )


def _agreeing(facts: dict[str, Any], more: dict[str, Any], path: str, both: str) -> dict[str, Any]:
    """Return `more`, which may say gains of single joints beside those of all, but contradict no
    other fact.

    Args:
        both: What says facts, and what says more.
    """
    for field in facts.keys() & more.keys():
        first = facts[field]
        second = more[field]
        if isinstance(second, dict):
            more[field] = _by_joint(first) | second
        elif second != first:
            raise LogError(
                f"{path}: {both} contradict: {field} {first} and {second}; delete the wrong one"
            )
    return more


def _by_joint(gains: Any) -> dict[str, Any]:
    """Return gains by joint; "" stands for all others."""
    return gains if isinstance(gains, dict) else {"": gains}


def _pattern(text: str, where: str) -> re.Pattern[str]:
    """Return the regular expression of "{motion}_{payload:g}kg"."""
    parts = []
    seen = set()
    loose = 0
    for literal, word, brace in re.findall(r"([^{}]+)|\{(\w*)(?::[^{}]*)?\}|([{}])", text):
        if literal:
            parts.append(re.escape(literal))
            continue
        repeated = word in seen and word != ""
        if brace or word not in FIELDS or repeated:
            known = ", ".join("{" + field + "}" for field in FIELDS)
            raise UsageError(f'{where}: motion = "{text}": use each of {known} at most once')
        seen.add(word)
        _, expression = FIELDS[word]
        if expression.startswith(".+"):
            loose += 1
        parts.append(f"(?P<{word}>{expression})" if word else expression)
    if loose > MAX_LOOSE_WORDS:
        raise UsageError(
            f'{where}: motion = "{text}": at most {MAX_LOOSE_WORDS} words may be of any text; use '
            "a manifest"
        )
    return re.compile("".join(parts))


def _fields(stated: Mapping[str, str | None], where: str) -> dict[str, Any]:
    """Words and their texts → fields of SequenceMeta; kp.<joint> becomes {"kp": {joint:
    number}}.
    """
    facts: dict[str, Any] = {}
    for word, text in stated.items():
        if text is None or not text.strip():
            continue
        kind, _, joint = word.partition(".")
        field, _ = FIELDS[kind]
        value: Any = _value(field, text, word, where)
        if joint:
            value = _by_joint(facts.get(field, {})) | {joint: value}
        facts[field] = value
    return facts


def _value(field: str, text: str, word: str, where: str) -> str | float | bool:
    """Return what the text of a word says of a field of SequenceMeta."""
    stripped = text.strip()
    if field in NUMBERS:
        number = _number(stripped)
        whole = field == "repetition"
        if number is None or (whole and number != int(number)):
            raise LogError(f"{where}: {word} is '{text}', not a number ≥ 0; mend it")
        return int(number) if whole else number
    if field in ("virtual", "leave_out"):
        if stripped not in ("yes", "no"):
            raise LogError(f"{where}: {field} is '{text}'; write yes or no")
        return stripped == "yes"
    return stripped


def _number(text: str) -> float | None:
    """Return a number ≥ 0, whose decimal point may be a p; None if the text is none."""
    try:
        number = float(text.replace("p", "."))
    except ValueError:
        return None
    return number if np.isfinite(number) and number >= 0 else None


def _stem(file: str) -> str:
    """Return the name of a file without the suffix of a built-in format."""
    return SUFFIX.sub("", file)


def _read_sheet(file: Path) -> list[dict[str, str]]:
    """The rows of a manifest; columns that say nothing here are left alone."""
    if not file.is_file() or file.stat().st_size > MAX_SHEET_BYTES:
        raise UsageError(f"{file}: the manifest is missing, or no table; a CSV with a column file")
    try:
        content = io.StringIO(file.read_text(encoding="utf-8-sig"))
        table = csv.DictReader(content, skipinitialspace=True)
        rows = list(table)
    except (UnicodeDecodeError, csv.Error) as error:
        raise UsageError(f"{file}: not a CSV table ({error})") from None
    names = list(table.fieldnames or ())
    if not rows or not rows[0].get("file"):
        raise UsageError(f"{file}: a manifest has a column file, and a row for each recording")
    columns = ["file", *filter(_is_known, names)]
    _require_clear_names(file, names, columns)
    _require_no_further_cells(file, rows)
    sheet = []
    for row in rows:
        if row.get("file"):
            sheet.append({column: row[column] for column in columns if row.get(column) is not None})
    return sheet


def _require_no_further_cells(file: Path, rows: list[dict[Any, Any]]) -> None:
    """Refuse rows with cells behind the last column, which csv keeps under None."""
    for row in rows:
        if any(row.get(None, ())):
            raise UsageError(
                f"{file}: the row of {row['file']} has more cells than the header; is a decimal "
                "comma in it?"
            )


def _require_clear_names(file: Path, names: list[str], columns: list[str]) -> None:
    """Refuse names of a manifest that are nearly those of FIELDS, and columns of one name.

    Args:
        names: Of all columns.
        columns: Those that say something here.
    """
    ours = {}
    for word, (field, _) in FIELDS.items():
        if word:
            ours[word] = word
            ours[field] = word
    for name in names:
        written = name.strip().lower()
        near = ours.get(written, "payload" if written.startswith("payload") else "")
        misspelt = near and name not in columns
        twice = name in columns and names.count(name) > 1
        if misspelt or twice:
            raise UsageError(f"{file}: column '{name}': write {near or name}, once")


def _is_known(column: Any) -> bool:
    """Return True for a word of FIELDS, and for kp.<joint> and kd.<joint>."""
    if not isinstance(column, str) or not column:
        return False
    kind, dot, joint = column.partition(".")
    if not dot:
        return kind in FIELDS
    return kind in ("kp", "kd") and "." not in joint
