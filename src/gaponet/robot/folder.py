"""Robot folders inside runs and datasets: complete copies that may be moved.

A network of the package has no copy. A file beside it names a robot of the package and the factor
on its gains.
"""

from __future__ import annotations

import json
import os
import re
import tomllib
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated

import numpy as np
from annotated_types import Interval
from typing_extensions import TypedDict

from gaponet.base.errors import RobotError, UsageError
from gaponet.base.files import lock_folder, write_json, write_text
from gaponet.base.structure import Name, read_json
from gaponet.robot.by_name import FILE_REFERENCES
from gaponet.robot.servo_fields import SERVO_TERMS, TERMS
from gaponet.robot.spec import PACKAGE_FOLDER, RobotSpec, load_robot, packaged_robots

STORED_ROBOT = "robot"  # subfolder of a run or a dataset
PACKAGED_ROBOT_FILE = "packaged_robot.json"  # beside a network of the package, instead of that
MOVE_STORED_ROBOT = "move that folder away to keep the other robot from now on"
PROVENANCE_FILE = "identified.json"  # what a robot was identified from (evaluation/candidate.py)
PROVENANCE_HINT = "identify again, or remove it: all recordings then count as seen"  # if damaged
# to which unit it was adapted, and what the doctor found in its recordings
ADAPTATION_FILE = "adapted.json"
UNCERTAINTY_FILE = "uncertainty.json"  # of its values (sysid/uncertainty.py)
OLD_UNCERTAINTY_FILE = "known.json"  # the same in folders that older versions wrote
COPIED_FILES = (
    "collision.toml",
    "look.toml",
    PROVENANCE_FILE,
    UNCERTAINTY_FILE,
    OLD_UNCERTAINTY_FILE,
)
IDENTIFIED_HEADING = (
    "# Identified from logs by gaponet identify; remove what follows for the nominal robot."
)
IDENTIFIED_TABLES = re.compile(
    r"^\[identified[._].*?(?=^\[(?!identified[._])|\Z)", re.MULTILINE | re.DOTALL
)


class _Provenance(TypedDict):
    """What this module reads of identified.json."""

    dataset: str  # path from the robot folder; a name alone: it never was on this machine


@dataclass(frozen=True)
class PackagedRobot:
    """Names a simulator without a copy of its folder.

    Attributes:
        name: Robot of the package.
        gain_scale: Factor on kp and kd of its operated joints.
    """

    name: Name
    gain_scale: Annotated[float, Interval(gt=0, le=1e3)] = 1.0

    def load(self) -> RobotSpec:
        """Load the robot.

        Raises:
            RobotError: The package has no robot of that name.
        """
        if self.name not in packaged_robots():
            raise RobotError(
                f"no robot '{self.name}' in the package, which has {', '.join(packaged_robots())}; "
                "install the gaponet of the network's card"
            )
        return load_robot(PACKAGE_FOLDER / self.name).with_gain_scale(self.gain_scale)

    def write(self, holder: Path) -> None:
        """Write the file that names the robot into the folder of a network."""
        write_json(holder / PACKAGED_ROBOT_FILE, asdict(self))

    @classmethod
    def read(cls, holder: Path) -> PackagedRobot | None:
        """Read the file in the folder of a network; None if there is none.

        Raises:
            RobotError: It is damaged.
        """
        file = holder / PACKAGED_ROBOT_FILE
        if not file.is_file():
            return None
        return read_json(cls, file, RobotError, "copy the network again")


def save_robot(robot: RobotSpec, folder: Path) -> None:
    """Write a robot folder: robot.toml with [identified.JOINT] tables for identified parameters,
    and robot.xml.

    An MJCF that includes or names files is written without them (gaponet.robot.self_contained).

    Args:
        robot: Result of load_robot, or derived from one by with_identified.
        folder: Destination; a folder that gaponet has not made is refused.

    Raises:
        RobotError: The MJCF in one file would have other dynamics, or identified.json is damaged.
    """
    from gaponet.robot.self_contained import self_contained_mjcf

    require_other_folder(folder, robot)
    text = _nominal_text(robot) + _identified_text(robot)
    xml = robot.mjcf.read_text(encoding="utf-8")
    if FILE_REFERENCES.search(xml):
        xml = self_contained_mjcf(robot.mjcf)
    with lock_folder(folder, "robot"):
        # its presence marks a complete folder: it is written last
        (folder / "robot.toml").unlink(missing_ok=True)
        write_text(folder / "robot.xml", xml)
        for name in COPIED_FILES:
            file = robot.folder / name
            if name == PROVENANCE_FILE:
                _copy_provenance(robot.folder, folder)
            elif file.is_file():
                write_text(folder / name, file.read_text(encoding="utf-8"))
        write_text(folder / "robot.toml", text)
    written = load_robot(folder).before_identification
    if not np.allclose(written.servo.kd, robot.before_identification.servo.kd, rtol=1e-4):
        raise RobotError(
            f"{robot.folder}/robot.toml: write each joint as a [[joint]] table of its own"
        )


def _copy_provenance(source: Path, folder: Path) -> None:
    """Copy what a robot was identified from, if it is stated, to another robot folder."""
    file = source / PROVENANCE_FILE
    if not file.is_file():
        return
    origin = read_json(_Provenance, file, RobotError, PROVENANCE_HINT, allow_extra=True)
    dataset = dataset_seen_from(folder, source, origin["dataset"])
    write_json(folder / PROVENANCE_FILE, dict(origin) | {"dataset": dataset})


def dataset_seen_from(folder: Path, source: Path, dataset: str) -> str:
    """Return the path of a dataset from a folder, given its path from the folder `source`; its name
    alone if it is not there.
    """
    place = source / dataset
    if place.is_dir():
        return os.path.relpath(place, folder)
    return Path(dataset).name


def _nominal_text(robot: RobotSpec) -> str:
    """Return the text of robot.toml without identified values: the robot's file, with its gains."""
    text = (robot.folder / "robot.toml").read_text(encoding="utf-8").split(IDENTIFIED_HEADING)[0]
    text = re.sub(r"(?m)^mjcf\s*=.*\n", "", text)
    text = IDENTIFIED_TABLES.sub("", text).rstrip() + "\n"
    text = _with_gains(text, robot.before_identification)
    for name, value, default in (
        ("carries_payload", robot.scene.carries_payload, True),
        ("gain_scale", robot.servo.gain_scale, 1.0),
    ):
        text = re.sub(rf"(?m)^{name}\s*=.*\n", "", text)
        if value != default:
            text = f"{name} = {str(value).lower()}\n{text}"
    return text


def _identified_text(robot: RobotSpec) -> str:
    """Return the tables of identified values; "" for a robot without any."""
    if robot.nominal is None:
        return ""
    parts = [f"\n{IDENTIFIED_HEADING}\n", *(_servo(robot, joint) for joint in robot.operated)]
    if robot.scene.table is not None and robot.scene.table != robot.nominal.scene.table:
        parts.append("[identified_table]\n")
        parts += [f"{name} = {value!r}\n" for name, value in vars(robot.scene.table).items()]
    if robot.payload_mounts != robot.nominal.payload_mounts:
        for mount in robot.payload_mounts:
            heading = f"[identified_mount.{_key(mount.side)}]"
            parts.append(f"{heading}\npos = {list(mount.pos)}\nmass = {mount.mass!r}\n")
    for body, link in robot.links.items():
        parts.append(
            f"[identified_link.{_key(body)}]\nmass = {link.mass!r}\npos = {list(link.pos)}\n"
            f"inertia = {list(link.inertia)}\n"
        )
    return "".join(parts)


def require_other_folder(folder: Path, robot: RobotSpec) -> None:
    """Refuse to write a robot over the folder that it was loaded from."""
    if folder.resolve() == robot.folder.resolve():
        raise UsageError(f"{folder}: is the robot's own folder; choose another")


def load_stored_robot(holder: Path, name: str) -> RobotSpec:
    """Load the robot that a run, a network of the package or a dataset stores.

    Older ones store none; for them, return the packaged robot of that name, but never another
    folder of that name.
    """
    if has_robot_folder(holder):
        return load_robot(holder / STORED_ROBOT)
    packaged = PackagedRobot.read(holder)
    if packaged is not None:
        return packaged.load()
    if name in packaged_robots():
        return load_robot(PACKAGE_FOLDER / name)
    raise RobotError(
        f"{holder}: stores no robot, and the package has no '{name}'; say which robot it is with "
        "--robot ./FOLDER"
    )


def has_stored_robot(holder: Path) -> bool:
    """Return True if a run or a dataset stores its robot, or names a robot of the package."""
    return has_robot_folder(holder) or (holder / PACKAGED_ROBOT_FILE).is_file()


def has_robot_folder(holder: Path) -> bool:
    """Return True if a run or a dataset stores its robot as a folder."""
    return (holder / STORED_ROBOT / "robot.toml").is_file()


def stored_robot_holder(artifact: Path) -> Path:
    """Return the folder that stores a model's robot: an exported model itself, else its run."""
    return artifact if has_stored_robot(artifact) else artifact.parent


def _with_gains(text: str, robot: RobotSpec) -> str:
    """Return the text of a robot.toml with kp and kd of this robot in its [[joint]] tables where
    they differ.
    """
    scale = np.where(np.isin(robot.joint_names, robot.operated), robot.servo.gain_scale, 1.0)
    tables = re.split(r"(?m)^(?=\[)", text)
    joints = [i for i, table in enumerate(tables) if table.startswith("[[joint]]")]
    for n, (i, table) in enumerate(zip(joints, tomllib.loads(text)["joint"], strict=False)):
        for name, values in (("kp", robot.servo.kp), ("kd", robot.servo.kd)):
            value = float(values[n] / scale[n])
            if not np.isclose(value, table.get(name, 0.0), rtol=1e-6):
                rest = re.sub(rf"(?m)^{name}\s*=.*\n", "", tables[i])
                tables[i] = rest.replace("[[joint]]\n", f"[[joint]]\n{name} = {value:.6g}\n", 1)
    return "".join(tables)


def _servo(robot: RobotSpec, joint: str) -> str:
    i = robot.joint_names.index(joint)
    optional = (*SERVO_TERMS, *TERMS["temperature"], "target_speed")  # 0 if absent
    lines = []
    for name, value in robot.servo.of_joint(i).items():
        is_absent = value == 0 and name in optional
        if np.isfinite(value) and not is_absent:
            lines.append(f"{name} = {value!r}\n")
    return f"[identified.{_key(joint)}]\n" + "".join(lines)


def _key(name: str) -> str:
    """Return a name as a key of TOML."""
    return json.dumps(name, ensure_ascii=False)
