"""logs.toml: what a lab's logs mean, said once.

It lies in the folder of the logs, or is given with --logs.

docs/logs.md shows examples.
"""

from __future__ import annotations

import csv
import io
import re
from collections.abc import Iterable
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
    "kp": ("kp", r"\d+(?:[.p]\d+)?"), "kd": ("kd", r"\d+(?:[.p]\d+)?"), "estimated": ("estimated", r".+"),
    "leave_out": ("leave_out", r"yes|no"), "": ("", r".+?"),
}  # fmt: skip
# of a pattern's words that match anything: each more makes a name that does not fit slower to
# refuse
MOST_LOOSE = 3
NUMBERS = ("payload_mass", "repetition", "kp", "kd")


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
    beside = (src if src.is_dir() else src.parent) / NAME
    file = Path(given) if given is not None else beside if beside.is_file() else None
    if file is None:
        return LogsFile(), None
    specified = read_toml(LogsFile, file, UsageError, f"docs/logs.md lists the fields; {HINT}")
    if "calibration" in specified:
        specified["calibration"] = str(file.parent / Path(specified["calibration"]).expanduser())
    return specified, file


class Naming:
    """Labels of recordings by their names: from the pattern `motion` and the sheet `manifest`."""

    def __init__(self, specified: LogsFile, where: Path | None) -> None:
        self.where = str(where or "logs.toml")
        self.pattern, self.by_path = _pattern(specified.get("motion"), self.where)
        self.text = specified.get("motion", "")
        if Path(specified.get("manifest", "")).name != specified.get("manifest", ""):
            raise UsageError(
                f'{self.where}: manifest = "{specified["manifest"]}": it lies beside logs.toml; '
                "give its name"
            )
        self.sheet = (
            _read_sheet((where or Path()).parent / specified["manifest"])
            if "manifest" in specified
            else None
        )
        self.unused = set(range(len(self.sheet or ())))
        stated = {
            k: specified[k] for k in ("unit", "payload", "side", "kp", "kd") if k in specified
        }
        self.all = {
            FIELDS[k][0]: v
            for k, v in stated.items()
            if k in ("unit", "side") or not isinstance(v, str)
        }

    def of(self, name: str, path: str) -> dict[str, Any]:
        """Fields of SequenceMeta for a recording called `name` at a path relative to the logs."""
        facts = dict(self.all)
        path = "#".join(map(_stem, path.split("#")))
        if self.pattern:
            match = self.pattern.fullmatch(path if self.by_path else name)
            if not match:
                raise LogError(
                    f'{path}: its name does not look like motion = "{self.text}" of {self.where}; '
                    "rename it, or list "
                    "the recordings in a manifest"
                )
            facts |= _agreeing(
                facts, _fields(match.groupdict(), path), path, f"logs.toml and {name}"
            )
        if self.sheet is not None:
            rows = [
                i
                for i, row in enumerate(self.sheet)
                if any(
                    fnmatchcase(word, _stem(row["file"]))
                    for word in (name, path, path.split("#")[0])
                )
            ]
            if len(rows) != 1:
                raise LogError(
                    f"{path}: {len(rows) or 'no'} rows of the manifest of {self.where} name it; "
                    f"one must: write {name} under file"
                )
            self.unused -= set(rows)
            row = _fields({k: v for k, v in self.sheet[rows[0]].items() if k != "file"}, path)
            facts |= _agreeing(facts, row, path, "logs.toml (or a name) and the manifest")
        return facts

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
    """
    for field in facts.keys() & more.keys():
        first = facts[field]
        second = more[field]
        if isinstance(second, dict):
            more[field] = (first if isinstance(first, dict) else {"": first}) | second
        elif second != first:
            raise LogError(
                f"{path}: {both} contradict: {field} {first} and {second}; delete the wrong one"
            )
    return more


def _pattern(text: str | None, where: str) -> tuple[re.Pattern[str] | None, bool]:
    """The regular expression of "{motion}_{payload:g}kg", and whether it is of the path."""
    if text is None:
        return None, False
    parts = []
    seen = set()
    loose = 0
    for literal, word, brace in re.findall(r"([^{}]+)|\{(\w*)(?::[^{}]*)?\}|([{}])", text):
        if brace or (not literal and (word not in FIELDS or (word and word in seen))):
            known = ", ".join("{" + k + "}" for k in FIELDS)
            raise UsageError(f'{where}: motion = "{text}": use each of {known} at most once')
        seen.add(word)
        loose += not literal and FIELDS[word][1].startswith(".+")
        parts.append(
            re.escape(literal)
            if literal
            else f"(?P<{word}>{FIELDS[word][1]})"
            if word
            else FIELDS[""][1]
        )
    if loose > MOST_LOOSE:
        raise UsageError(
            f'{where}: motion = "{text}": at most {MOST_LOOSE} words may be of any text; use a '
            "manifest"
        )
    return re.compile("".join(parts)), "/" in text


def _fields(stated: dict[str, str], where: str) -> dict[str, Any]:
    """Words and their texts → fields of SequenceMeta; kp.<joint> becomes {"kp": {joint:
    number}}.
    """
    facts: dict[str, Any] = {}
    for word, text in stated.items():
        if text is None or not text.strip():
            continue
        kind, _, joint = word.partition(".")
        field = FIELDS[kind][0]
        value: Any = text.strip()
        if field in NUMBERS:
            try:
                value = float(value.replace("p", "."))
                if not (
                    np.isfinite(value)
                    and value >= 0
                    and (field != "repetition" or value == int(value))
                ):
                    raise ValueError
            except ValueError:
                raise LogError(f"{where}: {word} is '{text}', not a number ≥ 0; mend it") from None
            value = int(value) if field == "repetition" else value
        if field in ("virtual", "leave_out"):
            if value not in ("yes", "no"):
                raise LogError(f"{where}: {field} is '{text}'; write yes or no")
            value = value == "yes"
        if joint:
            gains = facts.get(field, {})
            value = (gains if isinstance(gains, dict) else {"": gains}) | {joint: value}
        facts[field] = value
    return facts


def _stem(file: str) -> str:
    return re.sub(r"\.(csv|txt|parquet|npz|pt|mat|h5|hdf5|db3|mcap|json|pkl|dat|tsv)$", "", file)


def _read_sheet(file: Path) -> list[dict[str, str]]:
    """The rows of a manifest; columns that say nothing here are left alone."""
    if not file.is_file() or file.stat().st_size > 16 << 20:
        raise UsageError(f"{file}: the manifest is missing, or no table; a CSV with a column file")
    try:
        rows = list(
            table := csv.DictReader(
                io.StringIO(file.read_text(encoding="utf-8-sig")), skipinitialspace=True
            )
        )
    except (UnicodeDecodeError, csv.Error) as error:
        raise UsageError(f"{file}: not a CSV table ({error})") from None
    if not rows or not rows[0].get("file"):
        raise UsageError(f"{file}: a manifest has a column file, and a row for each recording")
    columns = ["file", *_known(rows[0])]
    ours = {name: k for k, (field, _) in FIELDS.items() if k for name in (k, field)}
    for name in (names := list(table.fieldnames or ())):
        near = ours.get(
            word := name.strip().lower(), "payload" if word.startswith("payload") else ""
        )
        if (near and name not in columns) or (name in columns and names.count(name) > 1):
            raise UsageError(f"{file}: column '{name}': write {near or name}, once")
    if long := [row["file"] for row in rows if any(row.get(None, ()))]:
        raise UsageError(
            f"{file}: the row of {long[0]} has more cells than the header; is a decimal comma in "
            "it?"
        )
    return [
        {c: row[c] or "" for c in columns if row.get(c) is not None}
        for row in rows
        if row.get("file")
    ]


def _known(columns: Iterable[Any]) -> list[str]:
    return [
        c
        for c in columns
        if isinstance(c, str)
        and c
        and c.partition(".")[0] in FIELDS
        and c.count(".") <= 1
        and ("." not in c or c.partition(".")[0] in ("kp", "kd"))
    ]
