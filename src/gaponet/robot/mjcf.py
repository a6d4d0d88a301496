"""Reading of untrusted MJCF files: valid, of a robot's size, and without endless files."""

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

MAX_ELEMENTS = 20_000  # after <replicate> and the like; the largest public humanoids have hundreds
MAX_CELLS = 1 << 24  # pixels of a texture, samples of a height field
MAX_BYTES = 256 << 20  # of one file, or of a simulation's memory
MAX_VALUE = 1e10  # kg, kg·m², m: MuJoCo's own mjMAXVAL
PACKAGED = Path(__file__).resolve().with_name("robots")
# Elements whose cost is visible in the file. Others (meshes, textures, attached models) are read in
# the sandbox first.
PLAIN_TAGS = {
    "mujoco",
    "compiler",
    "option",
    "flag",
    "size",
    "memory",
    "default",
    "worldbody",
    "body",
    "frame",
    "inertial",
    "joint",
    "freejoint",
    "geom",
    "site",
    "light",
    "camera",
    "statistic",
    "visual",
    "global",
    "headlight",
    "map",
    "scale",
    "rgba",
    "quality",
    "contact",
    "pair",
    "exclude",
    "actuator",
    "position",
    "velocity",
    "motor",
    "general",
    "keyframe",
    "key",
    "sensor",
    "jointpos",
    "jointvel",
    "actuatorfrc",
    "gyro",
    "accelerometer",
    "framepos",
}
MAX_PLAIN_ELEMENTS = 2000
# create more than the file shows
EXPANDING_ATTRIBUTES = {
    "nsample",
    "resolution",
    "builtin",
    "file",
    "num",
    "dim",
}
USER_SIZES = [
    f"nuser_{kind}"
    for kind in ("body", "jnt", "geom", "site", "cam", "tendon", "actuator", "sensor")
]
SOLVER_ITERATIONS = (
    "iterations",
    "ls_iterations",
    "noslip_iterations",
    "ccd_iterations",
    "sdf_iterations",
    "sdf_initpoints",
)
LIMITED_ATTRIBUTES = {"size": {"nuserdata", "nkey", *USER_SIZES}, "option": {*SOLVER_ITERATIONS}}
MAX_ATTRIBUTE = 1000
_ACCEPTED: set[frozenset[tuple[str, int, int]]] = set()


def read_mjcf(path: Path, tried: bool = False) -> mujoco.MjSpec:
    """Read an MJCF as a specification, which can be changed and compiled.

    A file of plain elements, or of the package, is as small as it looks. Others are first read in
    the sandbox, once for each state of their files.

    Args:
        tried: The caller has read it in the sandbox.

    Raises:
        RobotError: It is not MJCF, is larger than a robot, or names something that is not a file.
    """
    import mujoco

    inspection = inspect_mjcf(path)
    state = frozenset(inspection.files)
    if not (
        tried or inspection.plain or state in _ACCEPTED or path.resolve().is_relative_to(PACKAGED)
    ):
        _try(path)
        _ACCEPTED.add(state)
    with mujoco_errors(path, "not valid MJCF"):
        return mujoco.MjSpec.from_file(str(path))


def compile_spec(spec: mujoco.MjSpec, path: Path) -> mujoco.MjModel:
    """Compile a specification that was read from `path`.

    Raises:
        RobotError: It does not compile, or a mass, inertia or position is above MAX_VALUE.
    """
    with mujoco_errors(path, "does not compile"):
        model = spec.compile()
    for name in ("body_mass", "body_inertia", "body_pos", "body_ipos", "geom_pos", "jnt_pos"):
        values = getattr(model, name)
        if values.size and not -MAX_VALUE <= values.min() <= values.max() <= MAX_VALUE:
            raise RobotError(
                f"{path}: {name.replace('_', ' ')} is above {MAX_VALUE:g} in SI units; correct it"
            )
    return model


@contextmanager
def mujoco_errors(path: Path, problem: str) -> Iterator[None]:
    """Raise errors of MuJoCo as a RobotError of one line: path, problem, MuJoCo's text."""
    import mujoco

    try:
        yield
    except (ValueError, RuntimeError, mujoco.FatalError) as error:
        text = " ".join(str(error).split())
        if sandbox.in_sandbox() and "allocat" in text:
            raise MemoryError from None
        text = (
            "MuJoCo gives no reason; is the model too large?"
            if "unknown exception" in text
            else text
        )
        raise RobotError(f"{path}: {problem}: {text}") from None


@sandboxed(RobotError, "mujoco", 0.5)
def _try(path: Path) -> None:
    require_simulable(compile_spec(read_mjcf(path, tried=True), path), path)


def require_simulable(model: mujoco.MjModel, path: Path) -> None:
    """Refuse a model whose simulation needs more than MAX_BYTES or fails in its first step."""
    import mujoco

    data = mujoco.MjData(model)
    if mujoco.mj_sizeModel(model) + data.nbuffer > MAX_BYTES:
        raise RobotError(
            f"{path}: a simulation of it takes more than {MAX_BYTES >> 20} MiB; gaponet does not "
            "load it"
        )
    mujoco.mj_step(model, data)


@dataclass
class _Inspection:
    """Content of an MJCF: its files (path, size, time), the number of elements, and whether all
    are plain.
    """

    files: set[tuple[str, int, int]] = field(default_factory=set)
    count: float = 0.0
    plain: bool = True


def inspect_mjcf(path: Path) -> _Inspection:
    """Inspect an MJCF before MuJoCo reads it; refuses files that are not XML or are larger than a
    robot.
    """
    inspection = _Inspection()
    _count(path, path.parent, {path.resolve()}, inspection, 1.0)
    inspection.plain = inspection.plain and inspection.count <= MAX_PLAIN_ELEMENTS
    return inspection


def _count(
    path: Path, folder: Path, seen: set[Path], inspection: _Inspection, times: float
) -> None:
    """Count the elements of a file and its <include>s; refuses too many."""
    if not path.is_file():
        raise RobotError(f"{path}: is no file, nor a robot of the package (gaponet robot list)")
    if path.stat().st_size > MAX_BYTES:
        raise RobotError(f"{path}: has more than {MAX_BYTES >> 20} MiB")
    try:
        root = ElementTree.parse(path).getroot()
    except (ElementTree.ParseError, ValueError, LookupError) as error:  # an unknown encoding
        raise RobotError(f"{path}: not valid MJCF: {error}") from None
    open_tags = [(root, times)]
    while open_tags:
        tag, times = open_tags.pop()
        times *= _copies(tag)
        inspection.count += times
        expands = EXPANDING_ATTRIBUTES & tag.attrib.keys()
        if tag.tag not in PLAIN_TAGS or expands:
            inspection.plain = False
        _require_small(tag, inspection.count, path)
        if tag.tag == "include":
            other = folder / tag.get("file", "")
            if other.resolve() in seen:
                raise RobotError(f"{path}: includes {other.name} twice")
            _count(other, folder, seen | {other.resolve()}, inspection, times)
        open_tags += [(child, times) for child in tag]
    _require_files(root, path, folder, inspection)


def _require_small(tag: ElementTree.Element, count: float, path: Path) -> None:
    """Refuse an element that makes a model far larger than a robot.

    Args:
        count: Number of elements so far.
    """
    cells = max(_extent(tag, "width", "height"), _extent(tag, "nrow", "ncol"))
    if count > MAX_ELEMENTS or cells > MAX_CELLS:
        raise RobotError(
            f"{path}: <{tag.tag}> makes a model far larger than a robot; gaponet does not load it"
        )
    if tag.tag == "size" and _bytes(tag.get("memory", "0")) > MAX_BYTES:
        raise RobotError(
            f"{path}: <size memory> is above {MAX_BYTES >> 20} MiB; delete it, MuJoCo chooses "
            "the size"
        )
    for name in LIMITED_ATTRIBUTES.get(tag.tag, set()) & tag.attrib.keys():
        if not _extent(tag, name) <= MAX_ATTRIBUTE:
            raise RobotError(
                f"{path}: <{tag.tag} {name}> is above {MAX_ATTRIBUTE}, more than a robot needs; "
                "delete it"
            )


def _require_files(
    root: ElementTree.Element, path: Path, folder: Path, inspection: _Inspection
) -> None:
    places = {folder}
    for tag in root.iter("compiler"):
        for key in ("meshdir", "texturedir", "assetdir"):
            places.add(folder / tag.get(key, ""))
    names = {path.name}
    for tag in root.iter():
        names.add(tag.get("file", ""))
        names.add(tag.get("filename", ""))
    for name in names:
        for place in places:
            file = place / name
            if not file.exists() or file.is_dir():
                continue
            status = file.stat()
            inspection.files.add((str(file.resolve()), status.st_size, status.st_mtime_ns))
            if not file.is_file() or status.st_size > MAX_BYTES:
                raise RobotError(
                    f"{path}: {name} is not a file, or has more than {MAX_BYTES >> 20} MiB"
                )


def _copies(tag: ElementTree.Element) -> float:
    """Return how many copies of its content an element creates."""
    if tag.tag not in ("replicate", "composite", "flexcomp"):
        return 1.0
    return math.prod(max(1.0, abs(x)) for x in _numbers(tag.get("count", "1")))


def _extent(tag: ElementTree.Element, *names: str) -> float:
    """Return the product of the first numbers of some attributes, without signs."""
    extent = 1.0
    for name in names:
        numbers = _numbers(tag.get(name, "0"))
        if numbers:
            extent *= abs(numbers[0])
    return extent


def _bytes(text: str) -> float:
    unit = {"K": 1 << 10, "M": 1 << 20, "G": 1 << 30, "T": 1 << 40}.get(
        text.strip()[-1:].upper(), 1
    )
    return max([0.0, *_numbers(text.strip().rstrip("KMGTPEkmgtpe"))]) * unit


def _numbers(text: str) -> list[float]:
    """Parse the numbers of an attribute; infinity if MuJoCo may read more than Python."""
    try:
        numbers = [float(word) for word in text.split()]
    except ValueError:
        return [math.inf]
    return [math.inf if math.isnan(x) else x for x in numbers]
