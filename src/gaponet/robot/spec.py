"""Robot description: joint names, gains, limits, control period and payload mounts, read from a
robot folder.

A folder holds `robot.toml` (what logs and controllers need) and `robot.xml` (MJCF: kinematics,
inertia, friction). Position actuators with the gains of `robot.toml` replace the actuators of the
MJCF. A new robot is a new folder; it needs no code.
"""

from __future__ import annotations

import atexit
import dataclasses
import functools
import shutil
import tempfile
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from gaponet.base.arrays import Array
from gaponet.base.errors import JointMismatchError, RobotError
from gaponet.base.structure import read_toml
from gaponet.robot.by_name import hub_folder, identified_catalogue
from gaponet.robot.log_joints import Follower, LogJoints, nearest
from gaponet.robot.servo_parameters import ServoParameters
from gaponet.robot.toml_file import (
    Link,
    PayloadMount,
    RobotTable,
    ServoTable,
    ServoType,
    Table,
    Tip,
)

__all__ = [
    "Link",
    "PayloadMount",
    "RobotSpec",
    "ServoType",
    "Table",
    "Tip",
    "load_robot",
    "packaged_robots",
]

PACKAGE_FOLDER = Path(__file__).parent / "robots"
GAIN_TOLERANCE = 1e-3  # relative; gains that differ by less are equal


@dataclass(frozen=True)
class Scene:
    """What the simulated robot touches and carries.

    Attributes:
        tips, table: Tips that can touch a table, and the table; all other contacts are then off.
        contacts: True if links collide as the MJCF states. It is off by default, because links
            welded to the world collide permanently with their neighbours, which looks like a gap.
        carries_payload: True if the simulated robot carries the payload of the recordings.
    """

    tips: tuple[Tip, ...] = ()
    table: Table | None = None
    contacts: bool = False
    carries_payload: bool = True


@dataclass(frozen=True)
class RobotSpec:
    """Description of a robot, without simulation.

    Arrays have n joints in the order of `joint_names`.

    Attributes:
        name: As in its robot.toml, e.g. "so101".
        description: What the robot is, in a few words.
        mjcf: Path of the MJCF.
        folder: Folder of robot.toml.
        joint_names: All actuated joints, (n).
        operated: The subset that the operator corrects, in the same order.
        log_joints: How logs name and measure the joints.
        servo: Gains, torque limits, friction, delays and all else of the servos.
        qpos_home: Rest position, (n), rad.
        payload_mounts: Places where payloads are attached.
        dt: Control period, s.
        timestep: Physics step at that control period, s; dt / timestep is an exact integer.
        scene: What the simulated robot touches and carries.
        links: MJCF body → identified mass, centre of mass and inertia, which replace the MJCF's.
        nominal: The robot before identification; None if no parameter was identified
            (sysid/identify.py).
        limits_accepted: True if the user stated that this folder's gains and ranges hold on
            hardware (hw/control/hardware.py); no file states it.
    """

    name: str
    description: str
    mjcf: Path
    folder: Path
    joint_names: tuple[str, ...]
    operated: tuple[str, ...]
    log_joints: LogJoints
    servo: ServoParameters
    qpos_home: Array
    payload_mounts: tuple[PayloadMount, ...]
    dt: float
    timestep: float
    scene: Scene = field(default_factory=Scene)
    links: dict[str, Link] = field(default_factory=dict)
    nominal: RobotSpec | None = None
    limits_accepted: bool = False

    def __post_init__(self) -> None:
        n = len(self.joint_names)
        home = np.array(self.qpos_home, float)
        if home.shape != (n,) or not np.isfinite(home).all():
            raise RobotError(f"{self.name}: qpos_home must be {n} finite numbers, got {home}")
        home.flags.writeable = False
        object.__setattr__(self, "qpos_home", home)
        if self.servo.kp.shape != (n,):
            raise RobotError(
                f"{self.name}: {len(self.servo.kp)} servos, but {n} joints; give a value of kp for "
                "each joint"
            )
        if not self.operated:
            raise RobotError(
                f"{self.name}: no joint has operated = true; the operator needs at least one"
            )
        ratio = self.dt / self.timestep
        if abs(ratio - round(ratio)) > 1e-9 or ratio < 1:
            raise RobotError(
                f"{self.name}: dt / timestep = {self.dt} / {self.timestep} = {ratio:.4g} is not a "
                "whole number; choose a timestep that divides the control period"
            )

    def __getstate__(self) -> dict[str, Any]:
        """Include the files: another process may run on a machine without this folder."""
        files = [self.mjcf, *self.folder.glob("*.toml")]
        return vars(self) | {"files": _contents(files)}

    def __setstate__(self, state: dict[str, Any]) -> None:
        files: dict[str, bytes] = state.pop("files")
        vars(self).update(state)
        here = [self.mjcf.parent / name for name in files]
        if _contents(here) != files:
            folder = _unpacked(tuple(sorted(files.items())))
            vars(self).update(folder=folder, mjcf=folder / self.mjcf.name)

    @property
    def decimation(self) -> int:
        """Physics steps per control period of dt."""
        return self.steps_per(self.dt)

    def steps_per(self, dt: float) -> int:
        """Return the physics steps per control period of length dt, s, with steps close to
        `timestep`.
        """
        return max(1, round(dt / self.timestep))

    @property
    def is_identified(self) -> bool:
        """True if at least one parameter was identified."""
        return self.nominal is not None

    @property
    def before_identification(self) -> RobotSpec:
        """The nominal robot: this one, or the one before identification."""
        return self.nominal or self

    def with_servo(self, **values: ArrayLike) -> RobotSpec:
        """Return the robot with other values of its servos: field of SERVO_FIELDS → (n), or one
        number for all joints.
        """
        changed: dict[str, Any] = values
        return dataclasses.replace(self, servo=dataclasses.replace(self.servo, **changed))

    def with_table(self, table: Table | None) -> RobotSpec:
        """Return the robot above another table, or above none."""
        return dataclasses.replace(self, scene=dataclasses.replace(self.scene, table=table))

    def with_identified(self, servos: dict[str, dict[str, float]]) -> RobotSpec:
        """Return the robot with identified values: joint → any of SERVO_FIELDS.

        Negative damping reduces kd instead.
        """
        joints = {}
        for joint, values in servos.items():
            joints[int(self.index([joint])[0])] = values
        servo = self.servo.with_joints(joints)
        return dataclasses.replace(self, servo=servo, nominal=self.before_identification)

    def with_gains(self, kp: tuple[float, ...] | None, kd: tuple[float, ...] | None) -> RobotSpec:
        """Return the robot with other nominal gains, (n) N·m/rad and N·m·s/rad; None keeps the
        present ones.

        Identified gains keep their ratio to the nominal ones.
        """
        if kp is None and kd is None:
            return self
        nominal = self.before_identification
        old = nominal.servo
        new_kp = np.array(old.kp if kp is None else kp)
        new_kd = np.array(old.kd if kd is None else kd)
        if np.allclose((new_kp, new_kd), (old.kp, old.kd), rtol=GAIN_TOLERANCE, atol=0.0):
            return self
        changed = dataclasses.replace(self, servo=self.servo.with_gains(new_kp, new_kd, old))
        if self.nominal is None:
            return changed
        new_nominal = nominal.with_servo(kp=new_kp, kd=new_kd)
        return dataclasses.replace(changed, nominal=new_nominal)

    def at_temperature(self, temperature: tuple[float, ...] | None) -> RobotSpec:
        """Return the robot with friction and damping at joint temperatures, (n) °C; None or NaN:
        as stated.
        """
        if temperature is None:
            return self
        return dataclasses.replace(self, servo=self.servo.at_temperature(np.array(temperature)))

    def with_gain_scale(self, scale: float) -> RobotSpec:
        """Return the same robot with the operated joints set to `scale` times the kp and kd of
        [[joint]].
        """
        servo = self.servo.with_gain_scale(scale, self.operated_index)
        changed = dataclasses.replace(self, servo=servo)
        if self.nominal is None:
            return changed
        return dataclasses.replace(changed, nominal=self.nominal.with_gain_scale(scale))

    @functools.cached_property
    def qpos_range(self) -> Array:
        """Joint limits of the MJCF, (n, 2), rad; ±inf where a joint is unlimited.

        Compiles the MJCF on first use.
        """
        from gaponet.robot.mjcf import compile_spec, read_mjcf

        model = compile_spec(read_mjcf(self.mjcf), self.mjcf)
        try:
            joints = [model.joint(name) for name in self.joint_names]
        except KeyError as error:
            raise RobotError(f"{self.mjcf}: lacks a joint of robot.toml: {error.args[0]}") from None
        limited = np.array([model.jnt_limited[j.id] for j in joints], bool)[:, None]
        return self.servo.within_stops(
            np.where(limited, [j.range for j in joints], [-np.inf, np.inf])
        )

    @property
    def operated_index(self) -> Array:
        """Positions of the operated joints in `joint_names`, (n_operated,)."""
        return self.index(self.operated)

    def index(self, names: tuple[str, ...] | list[str]) -> Array:
        """Return the positions of `names` in `joint_names`; an unknown name raises
        JointMismatchError.
        """
        for name in names:
            if name not in self.joint_names:
                raise JointMismatchError(self._unknown(name, "a request"))
        return np.array([self.joint_names.index(name) for name in names], int)

    def resolve(self, name: str, where: str, joint_map: dict[str, str] | None = None) -> str:
        """Return the robot's name of a joint in a log.

        Args:
            name: Name in the log, as LogJoints.find reads it.
            where: File, for the error.
            joint_map: The user's --map, which has priority.

        Raises:
            JointMismatchError: No joint or several joints match.
        """
        asked, matches = self.log_joints.find(name, self.joint_names, joint_map or {})
        if len(matches) != 1:
            raise JointMismatchError(
                f"{self._unknown(asked, where)}. Correct it there; of logs, map it with --map "
                f"{asked}={nearest(asked, self.joint_names)[0]}, or leave it out with "
                f'ignore = ["{asked}"] in logs.toml (--logs)'
            )
        return matches[0]

    def _unknown(self, name: str, where: str) -> str:
        """Return the error text for an unknown joint name."""
        return (
            f"{where} names joint '{name}', which robot '{self.name}' does not have; nearest: "
            f"{', '.join(nearest(name, self.joint_names))}"
        )


@functools.cache
def _unpacked(files: tuple[tuple[str, bytes], ...]) -> Path:
    """Write the files into a temporary folder that lives as long as this process."""
    folder = Path(tempfile.mkdtemp(prefix="gaponet-robot-"))
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    for name, content in files:
        (folder / name).write_bytes(content)
    return folder


def packaged_robots() -> list[str]:
    """Return the names of the robots in the package."""
    return sorted(p.parent.name for p in PACKAGE_FOLDER.glob("*/robot.toml"))


def named_robots() -> list[str]:
    """Return the names that load_robot takes: of the robots in the package, then of the identified
    ones.
    """
    return [*packaged_robots(), *identified_catalogue().names()]


def as_robot(robot: RobotSpec | str | Path) -> RobotSpec:
    """Return a robot, loaded where a name or a folder is given."""
    return robot if isinstance(robot, RobotSpec) else load_robot(robot)


def load_robot(name_or_path: str | Path) -> RobotSpec:
    """Read a robot from the package by name, from a folder by path, or from the Hub by its address
    hf://USER/NAME.

    A string without a slash is a name: "so101" is a robot as its maker states it, "so101@sage" one
    that was identified (`gaponet robot list`). It is never a folder of the current directory. A
    Path, or a string with a slash such as "./g1", is a folder, except for the path that is the name
    of an identified robot.

    Raises:
        RobotError: It names the folder, the field and what to write there.
    """
    folder = _folder(name_or_path)
    file = folder / "robot.toml"
    if not file.is_file():
        nominal = only_as_its_maker_states_it(str(folder))
        if nominal:
            raise RobotError(nominal)
        raise RobotError(
            f"{folder}: no robot.toml there; put robot.toml and robot.xml there, or choose another"
        )
    toml = read_toml(RobotTable, file, RobotError, "docs/new-robot.md lists the fields")
    mjcf = folder / toml.mjcf
    if not mjcf.is_file():
        raise RobotError(
            f"{file}: {mjcf.name} is missing beside it; put the MJCF there or name it with mjcf = "
            '"..."'
        )
    try:
        return _spec(toml, mjcf, folder)
    except RobotError as error:
        raise RobotError(f"{file}: {error}") from None


def robot_argument(folder: Path) -> str:
    """Return the value of --robot for a robot folder: with a slash, because a string without one
    is a name.
    """
    if identified_catalogue().holds(folder):
        return folder.name
    return f"./{folder}" if folder.name == str(folder) else str(folder)


def _folder(name_or_path: str | Path) -> Path:
    """Return the folder of a robot; refuses an ambiguous name."""
    text = str(name_or_path)
    folder = Path(name_or_path)
    found = identified_catalogue().find(name_or_path) or hub_folder(name_or_path)
    if found is not None:
        return found
    if isinstance(name_or_path, Path) or folder.name != text or text == "..":
        return folder
    packaged = PACKAGE_FOLDER / text
    here = (folder / "robot.toml").is_file()
    if text not in packaged_robots():
        what = (
            f"for the folder here write ./{text}"
            if here
            else "or give a folder, with a slash: ./my_robot"
        )
        names = named_robots()
        raise RobotError(
            f"no robot '{text}': in the package are {', '.join(names)}; nearest: "
            f"{nearest(text, names)[0]}; {what}"
        )
    if here and not packaged.samefile(folder):
        raise RobotError(
            f"'{text}' is a robot of the package and a folder here; write {packaged} or ./{text}"
        )
    return packaged


def only_as_its_maker_states_it(name: str) -> str:
    """Return the error for a name of a robot of the package where one is needed that was
    identified; "" for any other name.
    """
    if name not in packaged_robots():
        return ""
    identified = [other for other in named_robots() if other.startswith(f"{name}@")]
    return (
        f"{name}: no folder of that name here, and the package's {name} is as its maker states it; "
        f"give an identified robot: {', '.join(identified) or 'none is there'}, or a folder of "
        "gaponet identify"
    )


def _contents(files: list[Path]) -> dict[str, bytes]:
    """Return file name → content of those files that exist."""
    contents = {}
    for file in files:
        if file.is_file():
            contents[file.name] = file.read_bytes()
    return contents


@functools.cache
def servo_table() -> ServoTable:
    """Return the package's servo types."""
    return read_toml(ServoTable, PACKAGE_FOLDER.parent / "servos.toml", RobotError)


def servo_type(name: str, where: str, own: tuple[ServoType, ...] = ()) -> ServoType:
    """Return the servo type of that name among a robot.toml's own and the package's; `where`
    begins the error.
    """
    types = {servo.name: servo for servo in (*servo_table().servo, *own)}
    if sum(servo.name == name for servo in own) > 1:
        raise RobotError(f"{where}: two [[servo]] have the name '{name}'")
    if name not in types:
        near = " or ".join(nearest(name, types))
        raise RobotError(
            f"{where}: servo '{name}' is no [[servo]], nor in gaponet robot servos; nearest: {near}"
        )
    return types[name]


def _spec(toml: RobotTable, mjcf: Path, folder: Path) -> RobotSpec:
    """Return the robot of a robot.toml, with its identified values.

    Raises:
        RobotError: Names contradict each other.
    """
    _require_known_names(toml)
    robot = _nominal(toml, mjcf, folder)
    identified = robot
    servos = _identified_servos(toml)
    if servos:
        identified = robot.with_identified(servos)
    changed: dict[str, Any] = {}
    if toml.identified_table is not None:
        changed["scene"] = dataclasses.replace(robot.scene, table=toml.identified_table)
    if toml.identified_mount:
        changed["payload_mounts"] = _identified_mounts(toml)
    if toml.identified_link:
        changed["links"] = toml.identified_link
    if changed:
        identified = dataclasses.replace(identified, **changed, nominal=robot)
    return identified


def _nominal(toml: RobotTable, mjcf: Path, folder: Path) -> RobotSpec:
    """Return the robot of a robot.toml without its identified values.

    Of its servos, robot.toml states only kp, kd, effort_limit and the type; all else has the
    defaults of ServoParameters, which are the MJCF's values or no effect.
    """
    joints = toml.joint
    aliases: dict[str, str] = {}
    followers = {}
    for joint in joints:
        aliases.update(dict.fromkeys(joint.aliases, joint.name))
        if joint.follows:
            followers[joint.name] = Follower(joint.follows, joint.ratio, joint.at_zero)
    servo = ServoParameters(
        kp=np.array([joint.kp for joint in joints]),
        kd=np.array([joint.kd for joint in joints]),
        effort_limit=np.array([joint.effort_limit for joint in joints]),
        types=_servo_types(toml),
    )
    units = tuple(joint.log_unit for joint in joints)
    robot = RobotSpec(
        name=toml.name,
        description=toml.description or toml.name,
        mjcf=mjcf,
        folder=folder.absolute(),  # other processes may have another current folder
        joint_names=tuple(joint.name for joint in joints),
        operated=tuple(joint.name for joint in joints if joint.operated),
        log_joints=LogJoints(units, aliases, followers),
        servo=servo,
        qpos_home=np.array([joint.home for joint in joints]),
        payload_mounts=toml.payload_mount,
        dt=toml.dt,
        timestep=toml.timestep,
        scene=Scene(toml.tip, toml.table, toml.contacts, toml.carries_payload),
    )
    return robot.with_gain_scale(toml.gain_scale)


def _servo_types(toml: RobotTable) -> tuple[ServoType | None, ...]:
    """Return the servo type of each joint; None where robot.toml names none."""
    servos: list[ServoType | None] = []
    for joint in toml.joint:
        servo = None
        if joint.servo:
            servo = servo_type(joint.servo, f"joint '{joint.name}'", toml.servo)
        servos.append(servo)
    return tuple(servos)


def _require_known_names(toml: RobotTable) -> None:
    """Refuse names that appear twice, a table without tips, and identified values of joints and
    mounts that are not there.

    Bodies of identified links are looked for when the MJCF is compiled.
    """
    joints = [joint.name for joint in toml.joint]
    names: list[str] = []
    for joint in toml.joint:
        # A joint may repeat its own name among its aliases; two joints may share none.
        names += dict.fromkeys((joint.name, *joint.aliases))
    if len(set(names)) != len(names):
        raise RobotError(
            f"{toml.name}: a joint name appears twice in {', '.join(names)} (names and aliases)"
        )
    if (toml.table or toml.identified_table) and not toml.tip:
        raise RobotError(
            "[table]: no [[tip]] can touch it; add a [[tip]] with body, pos and radius"
        )
    for name in toml.identified:
        if name not in joints:
            raise RobotError(f"[identified.{name}] names no joint; joints are {', '.join(joints)}")
    _require_sides(toml)


def _require_sides(toml: RobotTable) -> None:
    """Refuse a side that two payload mounts have, and identified mounts that are not there."""
    sides = [mount.side for mount in toml.payload_mount]
    for side in sides:
        if sides.count(side) > 1:
            raise RobotError(
                f"two [[payload_mount]] have side = '{side}'; give each a side of its own"
            )
    for side in toml.identified_mount:
        if side not in sides:
            raise RobotError(
                f"[identified_mount.{side}] names no [[payload_mount]]; sides are "
                f"{', '.join(sides)}"
            )


def _identified_servos(toml: RobotTable) -> dict[str, dict[str, float]]:
    """Return joint → field → identified value, SI."""
    servos: dict[str, dict[str, float]] = {}
    for joint, servo in toml.identified.items():
        servos[joint] = {}
        for name, value in vars(servo).items():
            if value is not None:
                servos[joint][name] = value
    return servos


def _identified_mounts(toml: RobotTable) -> tuple[PayloadMount, ...]:
    """Return the payload mounts with their identified places and masses."""
    mounts = []
    for mount in toml.payload_mount:
        moved = toml.identified_mount.get(mount.side)
        mounts.append(mount if moved is None else dataclasses.replace(mount, **vars(moved)))
    return tuple(mounts)
