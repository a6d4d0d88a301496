"""Reading someone's MJCF: valid, of a size that a robot has, and without files that never end."""

from __future__ import annotations

import math
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING
from xml.etree import ElementTree

from gaponet.base import sandbox
from gaponet.base.errors import RobotError
from gaponet.base.sandbox import sandboxed

if TYPE_CHECKING:
    import mujoco

ELEMENTS = 20_000  # after <replicate> and the like: the largest public humanoids have some hundreds
CELLS = 1 << 24  # pixels of a texture, samples of a height field
BYTES = 256 << 20  # of one file, or of a simulation's memory
MAX_VALUE = 1e10  # kg, kg·m², m: MuJoCo's own mjMAXVAL
PACKAGED = Path(__file__).resolve().with_name("robots")
# What costs no more than it says. Anything else (meshes, textures, attached models, …) is tried in the sandbox.
PLAIN = {
    "mujoco", "compiler", "option", "flag", "size", "memory", "default", "worldbody", "body", "frame", "inertial",
    "joint", "freejoint", "geom", "site", "light", "camera", "statistic", "visual", "global", "headlight", "map",
    "scale", "rgba", "quality", "contact", "pair", "exclude", "actuator", "position", "velocity", "motor", "general",
    "keyframe", "key", "sensor", "jointpos", "jointvel", "actuatorfrc", "gyro", "accelerometer", "framepos",
}  # fmt: skip
PLAIN_ELEMENTS = 2000
COUNTS = {"nsample", "resolution", "builtin", "file", "num", "dim"}  # attributes that make more than they say
USER = [f"nuser_{kind}" for kind in ("body", "jnt", "geom", "site", "cam", "tendon", "actuator", "sensor")]
SOLVERS = ("iterations", "ls_iterations", "noslip_iterations", "ccd_iterations", "sdf_iterations", "sdf_initpoints")
LARGEST = {"size": dict.fromkeys(("nuserdata", "nkey", *USER), 1000), "option": dict.fromkeys(SOLVERS, 1000)}
_TRIED: set[frozenset[tuple[str, int, int]]] = set()


def read_mjcf(path: Path, tried: bool = False) -> mujoco.MjSpec:
    """An MJCF as a specification that can be changed and compiled.

    What is made of plain elements alone, or lies in the package, is as small as it looks; anything else is tried in the
    sandbox first, once for each state of its files.

    Args:
        path: The file.
        tried: The caller has tried it.

    Raises:
        RobotError: Not MJCF, larger than a robot, or it names something that is not a file.
    """
    import mujoco

    look = inspect_mjcf(path)
    state = frozenset(look.files)
    if not (tried or look.plain or state in _TRIED or path.resolve().is_relative_to(PACKAGED)):
        _try(path)
        _TRIED.add(state)
    with mujoco_errors(path, "not valid MJCF"):
        return mujoco.MjSpec.from_file(str(path))


def compile_spec(spec: mujoco.MjSpec, path: Path) -> mujoco.MjModel:
    """The model of a specification that was read from `path`.

    Raises:
        RobotError: It does not compile, or a mass, inertia or position in it is above MAX_VALUE.
    """
    with mujoco_errors(path, "does not compile"):
        model = spec.compile()
    for name in ("body_mass", "body_inertia", "body_pos", "body_ipos", "geom_pos", "jnt_pos"):
        values = getattr(model, name)
        if values.size and not -MAX_VALUE <= values.min() <= values.max() <= MAX_VALUE:
            raise RobotError(f"{path}: {name.replace('_', ' ')} is above {MAX_VALUE:g} in SI units; correct it")
    return model


@contextmanager
def mujoco_errors(path: Path, what: str) -> Iterator[None]:
    """MuJoCo's errors as one line."""
    import mujoco

    try:
        yield
    except (ValueError, RuntimeError, mujoco.FatalError) as error:
        text = " ".join(str(error).split())
        if sandbox.in_sandbox() and "allocat" in text:
            raise MemoryError from None
        text = "MuJoCo does not say why; does it ask for too much?" if "unknown exception" in text else text
        raise RobotError(f"{path}: {what}: {text}") from None


@sandboxed(RobotError, "mujoco", 0.5)
def _try(path: Path) -> None:
    require_simulable(compile_spec(read_mjcf(path, tried=True), path), path)


def require_simulable(model: mujoco.MjModel, path: Path) -> None:
    """Refuse a model whose simulation takes more than BYTES, or does not come through a step."""
    import mujoco

    data = mujoco.MjData(model)
    if mujoco.mj_sizeModel(model) + data.nbuffer > BYTES:
        raise RobotError(f"{path}: a simulation of it takes more than {BYTES >> 20} MiB; gaponet does not load it")
    mujoco.mj_step(model, data)


@dataclass
class _Look:
    """What an MJCF is made of: files (path, size, time), how many elements in all, and whether all are PLAIN."""

    files: set[tuple[str, int, int]] = field(default_factory=set)
    count: float = 0.0
    plain: bool = True


def inspect_mjcf(path: Path) -> _Look:
    """Refuse a file that is no XML, or makes or names more than a robot has."""
    look = _Look()
    _count(path, path.parent, {path.resolve()}, look, 1.0)
    look.plain = look.plain and look.count <= PLAIN_ELEMENTS
    return look


def _count(path: Path, folder: Path, seen: set[Path], look: _Look, times: float) -> None:
    """Count what a file makes, its <include>s too; refuses too much."""
    if not path.is_file() or path.stat().st_size > BYTES:
        raise RobotError(f"{path}: is missing, not a file, or has more than {BYTES >> 20} MiB")
    try:
        root = ElementTree.parse(path).getroot()
    except (ElementTree.ParseError, ValueError, LookupError) as error:  # an encoding that nobody knows
        raise RobotError(f"{path}: not valid MJCF: {error}") from None
    open_tags = [(root, times)]
    while open_tags:
        tag, times = open_tags.pop()
        times *= _copies(tag)
        look.count += times
        look.plain = look.plain and tag.tag in PLAIN and not COUNTS & tag.attrib.keys()
        if look.count > ELEMENTS or _extent(tag, "width", "height") > CELLS or _extent(tag, "nrow", "ncol") > CELLS:
            raise RobotError(f"{path}: <{tag.tag}> makes a model far larger than a robot; gaponet does not load it")
        if tag.tag == "size" and _bytes(tag.get("memory", "0")) > BYTES:
            raise RobotError(f"{path}: <size memory> is above {BYTES >> 20} MiB; delete it, MuJoCo finds its own")
        for name in LARGEST.get(tag.tag, {}).keys() & tag.attrib.keys():
            if not _extent(tag, name) <= LARGEST[tag.tag][name]:
                most = LARGEST[tag.tag][name]
                raise RobotError(f"{path}: <{tag.tag} {name}> is above {most}, more than a robot needs; delete it")
        if tag.tag == "include":
            other = folder / tag.get("file", "")
            if other.resolve() in seen:
                raise RobotError(f"{path}: includes {other.name} twice")
            _count(other, folder, seen | {other.resolve()}, look, times)
        open_tags += [(child, times) for child in tag]
    _require_files(root, path, folder, look)


def _require_files(root: ElementTree.Element, path: Path, folder: Path, look: _Look) -> None:
    places = {folder} | {
        folder / tag.get(key, "") for tag in root.iter("compiler") for key in ("meshdir", "texturedir", "assetdir")
    }
    for name in {path.name, *(tag.get(key, "") for tag in root.iter() for key in ("file", "filename"))}:
        for place in places:
            file = place / name
            if not file.exists() or file.is_dir():
                continue
            told = file.stat()
            look.files.add((str(file.resolve()), told.st_size, told.st_mtime_ns))
            if not file.is_file() or told.st_size > BYTES:
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
