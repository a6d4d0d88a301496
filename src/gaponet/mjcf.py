"""Reading someone's MJCF: valid, of a size that a robot has, and without files that never end."""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING
from xml.etree import ElementTree

from gaponet.errors import RobotError

if TYPE_CHECKING:
    import mujoco

ELEMENTS = 20_000  # after <replicate> and the like: the largest public humanoids have some hundreds
CELLS = 1 << 24  # pixels of a texture, samples of a height field
BYTES = 256 << 20  # of one file, or of a simulation's memory


def read_mjcf(path: Path) -> mujoco.MjSpec:
    """An MJCF as a specification that can be changed and compiled.

    Raises:
        RobotError: Not MJCF, larger than a robot, or it names something that is not a file.
    """
    import mujoco

    require_size(path)
    try:
        return mujoco.MjSpec.from_file(str(path))
    except (ValueError, mujoco.FatalError) as error:
        raise RobotError(f"{path}: not valid MJCF: {' '.join(str(error).split())}") from None


def compiled(spec: mujoco.MjSpec, path: Path) -> mujoco.MjModel:
    """The model of a specification that was read from `path`.

    Raises:
        RobotError: It does not compile.
    """
    import mujoco

    try:
        return spec.compile()
    except (ValueError, mujoco.FatalError) as error:
        raise RobotError(f"{path}: does not compile: {' '.join(str(error).split())}") from None


def require_size(path: Path) -> None:
    """Refuse a file that is no XML, or makes or names more than a robot has."""
    _count(path, path.parent, {path.resolve()})


def _count(path: Path, folder: Path, seen: set[Path]) -> int:
    """Elements that a file makes, those of its <include>s counted; refuses too many."""
    if not path.is_file() or path.stat().st_size > BYTES:
        raise RobotError(f"{path}: is missing, not a file, or has more than {BYTES >> 20} MiB")
    try:
        root = ElementTree.parse(path).getroot()
    except (ElementTree.ParseError, ValueError, LookupError) as error:  # an encoding that nobody knows
        raise RobotError(f"{path}: not valid MJCF: {error}") from None
    count = 0.0
    open_tags = [(root, 1.0)]
    while open_tags:
        tag, times = open_tags.pop()
        times *= _copies(tag)
        count += times
        if count > ELEMENTS or _extent(tag, "width", "height") > CELLS or _extent(tag, "nrow", "ncol") > CELLS:
            raise RobotError(f"{path}: <{tag.tag}> makes a model far larger than a robot; gaponet does not load it")
        if tag.tag == "size" and _bytes(tag.get("memory", "0")) > BYTES:
            raise RobotError(f"{path}: <size memory> is above {BYTES >> 20} MiB; delete it, MuJoCo finds its own")
        if tag.tag == "include":
            other = folder / tag.get("file", "")
            if other.resolve() in seen:
                raise RobotError(f"{path}: includes {other.name} twice")
            count += times * _count(other, folder, seen | {other.resolve()})
        open_tags += [(child, times) for child in tag]
    _require_files(root, path, folder)
    return math.ceil(count)


def _require_files(root: ElementTree.Element, path: Path, folder: Path) -> None:
    places = {folder} | {
        folder / tag.get(key, "") for tag in root.iter("compiler") for key in ("meshdir", "texturedir", "assetdir")
    }
    for name in {tag.get("file", "") for tag in root.iter()}:
        for place in places:
            file = place / name
            if file.exists() and not file.is_dir() and (not file.is_file() or file.stat().st_size > BYTES):
                raise RobotError(f"{path}: {name} is not a file, or has more than {BYTES >> 20} MiB")


def _copies(tag: ElementTree.Element) -> float:
    """How often an element's content is made."""
    if tag.tag not in ("replicate", "composite", "flexcomp"):
        return 1.0
    return math.prod(max(1.0, abs(x)) for x in _numbers(tag.get("count", "1")))


def _extent(tag: ElementTree.Element, *names: str) -> float:
    return math.prod(abs(x) for name in names for x in _numbers(tag.get(name, "0"))[:1])


def _bytes(text: str) -> float:
    unit = {"K": 1 << 10, "M": 1 << 20, "G": 1 << 30, "T": 1 << 40}.get(text.strip()[-1:].upper(), 1)
    return max([0.0, *_numbers(text.strip().rstrip("KMGTPEkmgtpe"))]) * unit


def _numbers(text: str) -> list[float]:
    """The numbers of an attribute; infinity where MuJoCo may read something that Python does not."""
    try:
        found = [float(word) for word in text.split()]
    except ValueError:
        return [math.inf]
    return [math.inf if math.isnan(x) else x for x in found]
