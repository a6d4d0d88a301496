"""Parts of a LeRobotDataset, v3.0 or v2.1: info, features, episodes, tasks, each checked."""

from __future__ import annotations

import os.path
import re
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Annotated, Any, NotRequired, cast

from annotated_types import Interval, Len
from typing_extensions import TypedDict

from gaponet.base.errors import LogError
from gaponet.base.structure import parse_json, read_json, validated
from gaponet.data.formats import parquet
from gaponet.data.sequence import SequenceMeta

VERSION = "v3.0"  # that is written
VERSIONS = ("v3", "v2")  # that are read
FEATURES = {
    "ctrl": "action",
    "qpos": "observation.state",
    "qvel": "observation.velocity",
    "qacc": "observation.acceleration",
    "tau": "observation.torque",
    "tau_eq": "observation.equivalent_torque",
    "temperature": "observation.temperature",
}
OURS = "gaponet.json"  # beside info.json in an export: dt, and that the episodes' metadata are ours
# columns of our meta/episodes
STATED = tuple(f for f in SequenceMeta.__dataclass_fields__ if f != "robot")
GAINS = ("kp", "kd")
AGAIN = "download or export it again"

# of a recording; none in sets from before they were written
Findings = dict[str, dict[str, float | None]]
Name = Annotated[str, Len(1, 200)]
Count = Annotated[int, Interval(ge=0, le=10**9)]
Chunk = Annotated[int, Interval(ge=0, le=10**6)]


class Info(TypedDict):
    """meta/info.json, what is read of it."""

    codebase_version: Name
    fps: Annotated[float, Interval(ge=1, le=10_000)]
    data_path: Annotated[str, Len(1, 500)]
    features: dict[str, Any]
    chunks_size: NotRequired[Annotated[int, Interval(ge=1, le=10**6)]]


class Feature(TypedDict):
    """One feature of a set; names are a list, one in a list or in a dictionary, often with .pos
    behind each.
    """

    shape: Annotated[list[Annotated[int, Interval(ge=1, le=1000)]], Len(1, 2)]
    names: list[Any] | dict[str, Any] | None
    info: NotRequired[dict[str, Any] | None]


# One row of meta/episodes; beside it, in what gaponet exported, the fields of SequenceMeta.
Episode = TypedDict(
    "Episode",
    {
        "episode_index": Count,
        "length": Annotated[int, Interval(ge=1, le=10**8)],
        "data/chunk_index": Chunk,
        "data/file_index": Chunk,
        "tasks": NotRequired[list[str] | None],
    },
)


class Listed(TypedDict):
    """One line of meta/episodes.jsonl, v2.1."""

    episode_index: Count
    length: Annotated[int, Interval(ge=1, le=10**8)]
    tasks: NotRequired[list[str] | None]


NEEDED = tuple(k for k in Episode.__annotations__ if k != "tasks")


class Stated(TypedDict):
    """What an export says of its dataset."""

    licence: NotRequired[str]
    source: NotRequired[str]


class Ours(TypedDict):
    """gaponet.json, what is read of it."""

    dt: Annotated[float, Interval(ge=1e-4, le=1)]
    dataset: Stated


@dataclass(frozen=True)
class Set:
    """One LeRobot folder."""

    path: Path
    info: Info
    features: dict[str, Feature]  # those of FEATURES that it has
    episodes: list[dict[str, Any]]  # by number
    ours: Ours | None  # None for a stock set
    absent: int = 0  # episodes that it lists and that are not there

    @property
    def dt(self) -> float:
        """s, exact."""
        return self.ours["dt"] if self.ours else 1 / self.info["fps"]

    def data_file(self, episode: dict[str, Any]) -> Path:
        """Where the frames of an episode are; never outside the set."""
        given = self.info["data_path"]
        which = {
            "chunk_index": "data/chunk_index",
            "file_index": "data/file_index",
            "episode_chunk": "data/chunk_index",
            "episode_index": "episode_index",
        }

        def number(match: re.Match[str]) -> str:
            return f"{episode[which[match[1]]]:0{match[2] or 0}d}"

        place = os.path.normpath(re.sub(rf"\{{({'|'.join(which)})(?::0?(\d))?d?\}}", number, given))
        if re.search(r"[{}\0]", place) or os.path.isabs(place) or place.startswith(".."):
            raise LogError(
                f"{self.path}/meta/info.json: data_path '{given}' is not a path inside the set "
                f"with {{chunk_index:03d}} and {{file_index:03d}}; {AGAIN}"
            )
        return self.path / place


def sets_under(path: Path) -> list[Set]:
    """The set at a path, or those in its folders."""
    infos = [path / "meta" / "info.json"]
    if not infos[0].is_file():
        infos = sorted(path.glob("*/meta/info.json"))
    if not infos:
        raise LogError(f"{path}: no meta/info.json in it; point at a LeRobotDataset v3.0 folder")
    return [_open(info) for info in infos]


def _open(file: Path) -> Set:
    """Return the set of an info.json."""
    info = read_json(Info, file, LogError, AGAIN, allow_extra=True)
    version = info["codebase_version"]
    if version.split(".")[0] not in VERSIONS:
        raise LogError(
            f"{file}: codebase_version is {version}, this reads {' and '.join(VERSIONS)}; convert "
            "the set with lerobot's own scripts"
        )
    root = file.parents[1]
    ours = _read_ours(file.with_name(OURS))
    listed = root / "meta" / "episodes.jsonl"
    if listed.is_file():
        episodes = _listed(listed, info.get("chunks_size", 1000))
    else:
        episodes = []
        for table in sorted((root / "meta" / "episodes").glob("*/*.parquet")):
            episodes += _episodes(table, ours)
    if not episodes:
        raise LogError(f"{root}: meta/episodes lists no episode; {AGAIN}")
    episodes.sort(key=lambda episode: episode["episode_index"])
    part = Set(root, info, _known_features(file, info), episodes, ours)
    # v2: one file an episode, and often only some of them
    return _without_absent(part) if listed.is_file() else part


def _read_ours(file: Path) -> Ours | None:
    """Return what an export of gaponet says beside info.json; None for a stock set."""
    if not file.is_file():
        return None
    hint = "restore it, or delete it to read the set as a stock one"
    return read_json(Ours, file, LogError, hint, allow_extra=True)


def _known_features(file: Path, info: Info) -> dict[str, Feature]:
    """Return the features of an info.json that are read."""
    known = {}
    for name in FEATURES.values():
        if name in info["features"]:
            where = f"{file}: features.{name}"
            spec = info["features"][name]
            known[name] = validated(Feature, spec, where, LogError, AGAIN, allow_extra=True)
    return known


def _without_absent(part: Set) -> Set:
    """Return a set without the episodes whose data files are not there."""
    here = [episode for episode in part.episodes if part.data_file(episode).is_file()]
    if not here:
        raise LogError(
            f"{part.path}: none of the {len(part.episodes)} episodes' data files is there; {AGAIN}"
        )
    return replace(part, episodes=here, absent=len(part.episodes) - len(here))


def _listed(file: Path, chunk: int) -> list[dict[str, Any]]:
    """Episodes of a v2.1 set, a line of JSON each."""
    lines = file.read_text(encoding="utf-8", errors="replace").splitlines()
    episodes = []
    for number, line in enumerate(lines, 1):
        row = parse_json(Listed, line, f"{file}:{number}", LogError, AGAIN, allow_extra=True)
        episodes.append(dict(row) | {"data/chunk_index": row["episode_index"] // chunk})
    return episodes


def _episodes(file: Path, ours: Ours | None) -> list[dict[str, Any]]:
    """Episodes of a v3.0 set, those of one file."""
    columns: tuple[str, ...] = NEEDED
    hint = AGAIN
    if ours:
        columns = NEEDED + STATED
        hint = f"restore it, or delete meta/{OURS} to read the set as a stock one"
    table = read_table(file, columns, ("tasks", "content_hash", "findings"), hint)
    rows = _rows(file, table)
    known = validated(list[Episode], rows, file, LogError, AGAIN, allow_extra=True)
    episodes = cast("list[dict[str, Any]]", known)
    if ours:
        return [_with_stated(episode, file, hint) for episode in episodes]
    return episodes


def _with_stated(row: dict[str, Any], file: Path, hint: str) -> dict[str, Any]:
    """Return a row of an export's episodes with `stated`, what it says of its recording as fields
    of SequenceMeta, checked.
    """
    where = f"{file}: episode {row['episode_index']}"
    stated = {name: row[name] for name in STATED if name in row} | {"robot": "?"}
    stated["notes"] = parse_json(
        dict[str, Any], str(row["notes"]), f"{where}: notes", LogError, hint
    )
    for name in GAINS:
        gains = str(stated.pop(name))
        if gains != "null":
            stated[name] = parse_json(list[float], gains, f"{where}: {name}", LogError, hint)
    stated = asdict(validated(SequenceMeta, stated, where, LogError, hint))
    findings = parse_json(
        Findings, str(row.get("findings", "{}")), f"{where}: findings", LogError, hint
    )
    return row | {"stated": {name: stated[name] for name in STATED}, "findings": findings}


def _rows(file: Path, table: Any) -> list[dict[str, Any]]:
    try:
        return cast("list[dict[str, Any]]", table.to_pylist())
    except ValueError as error:  # a date that Python cannot hold
        raise LogError(f"{file}: not readable ({error}); {AGAIN}") from None


def tasks_of(part: Set) -> dict[int, str]:
    """{task_index: text}; the text stands in the index of a pandas table, under either name."""
    file = part.path / "meta" / "tasks.parquet"
    if not file.is_file():
        return {}
    table = read_table(file, ("task_index",), ("task", "__index_level_0__"))
    if table.num_columns != 2:
        raise LogError(f"{file}: no task and task_index in it; {AGAIN}")
    rows = [tuple(row.values()) for row in _rows(file, table)]
    return dict(validated(list[tuple[Count, str]], rows, file, LogError, AGAIN))


def read_table(
    file: Path,
    need: tuple[str, ...],
    also: tuple[str, ...] = (),
    hint: str = AGAIN,
) -> Any:
    """The columns `need`, each once, and those of `also` that are there, in this order, of a
    Parquet file.
    """
    there = parquet.header(file)[0]
    for name in need:
        if there.count(name) != 1:
            text = "is missing" if name not in there else "stands twice"
            raise LogError(
                f"{file}: column '{name}' {text}; it has {', '.join(there[:12])}; {hint}"
            )
    wanted = [*need, *(name for name in also if there.count(name) == 1)]
    return parquet.read(file, wanted)
