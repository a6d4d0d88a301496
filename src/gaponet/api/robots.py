"""Robots, servo types and networks: what is in the package, and the actions of gaponet robot."""

from __future__ import annotations

from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from gaponet.api.opening import Place, as_robot, open_dataset
from gaponet.base.errors import UsageError
from gaponet.robot.card import ROBOT_HEADINGS, RobotCard, robot_cards
from gaponet.robot.spec import RobotSpec, ServoType, load_robot, packaged_robots, servo_table
from gaponet.robot.toml_file import RobotOptions

if TYPE_CHECKING:
    from gaponet.base.arrays import Array
    from gaponet.data.store import Dataset
    from gaponet.nn.network_card import NetworkCard
    from gaponet.robot.drives import Drive
    from gaponet.robot.finding import Finding
    from gaponet.robot.new import NewRobot
    from gaponet.sysid.uncertainty import JointSummary, ParameterUncertainty

MAX_POSTURES = 300  # of the recordings, in a check
PICTURE_SUFFIXES = (".png", ".svg")
ROBOT_OF_LINK = {"unitree": "h1_2", "so101": "so101"}


@dataclass(frozen=True, kw_only=True)
class RobotList:
    """Robots of the package.

    Attributes:
        robots: As their makers state them.
        identified: Cards of those that were identified from public recordings.
    """

    headings = ROBOT_HEADINGS
    robots: tuple[RobotSpec, ...]
    identified: tuple[RobotCard, ...]

    def to_dict(self) -> dict[str, Any]:
        robots = []
        for robot in self.robots:
            joints = {"joints": robot.joint_names, "operated": robot.operated}
            robots.append({"name": robot.name, **joints})
        return {"robots": robots, "identified": [asdict(card) for card in self.identified]}


@dataclass(frozen=True, kw_only=True)
class RobotCheck:
    """A robot that was stepped in its simulator.

    Attributes:
        findings: The worst first.
        simulator: Hash of the simulator.
    """

    robot: RobotSpec
    findings: tuple[Finding, ...]
    simulator: str

    def count(self, level: str) -> int:
        """Return the number of findings of a level: error, warning or note."""
        return sum(finding.level == level for finding in self.findings)

    def to_dict(self) -> dict[str, Any]:
        robot = self.robot
        bad = [f.message for f in self.findings if f.level in ("error", "warning")]
        joints = []
        for i, name in enumerate(robot.joint_names):
            joint = {
                "name": name,
                "operated": name in robot.operated,
                "kp": robot.servo.kp[i],
                "kd": robot.servo.kd[i],
                "effort_limit": robot.servo.effort_limit[i],
                "range": robot.qpos_range[i],
                "home": robot.qpos_home[i],
                "log_unit": robot.log_joints.units[i],
            }
            joints.append(joint)
        mounts = [{"side": m.side, "body": m.body, "pos": m.pos} for m in robot.payload_mounts]
        return {
            "simulator_hash": self.simulator,
            "warnings": bad,
            "findings": [vars(finding) for finding in self.findings],
            "name": robot.name,
            "dt": robot.dt,
            "timestep": robot.timestep,
            "joints": joints,
            "payload_mounts": mounts,
        }


@dataclass(frozen=True, kw_only=True)
class NewRobotResult:
    """A robot folder that was made from a vendor's model.

    Attributes:
        check: The robot, and what its check found.
        drives: Gains and limits of each joint, with their sources.
        notes: What was omitted, fixed or corrected.
        picture: The vendor's model beside the robot; None where none could be drawn.
        no_picture: Why there is no picture.
    """

    folder: Path
    check: RobotCheck
    drives: tuple[Drive, ...]
    notes: list[str]
    picture: Path | None
    no_picture: str = ""

    def sources(
        self, name: Literal["kp_source", "kd_source", "limit_source", "passive_source"]
    ) -> str:
        """Return where the values of all joints come from, each source once."""
        found = dict.fromkeys(getattr(drive, name) for drive in self.drives)
        return ", ".join(found)

    def to_dict(self) -> dict[str, Any]:
        picture = None if self.picture is None else str(self.picture)
        made = {"folder": str(self.folder), "notes": self.notes, "picture": picture}
        return self.check.to_dict() | made


@dataclass(frozen=True, kw_only=True)
class ParametersResult:
    """Identified parameters of a robot with their standard errors.

    Attributes:
        joints: Operated joint → values and standard errors.
        findings: What the fit found, in sentences.
        despite_errors: Errors of the recordings that the user accepted.
        picture: File that was drawn, or None.
    """

    robot: RobotSpec
    uncertainty: ParameterUncertainty = field(repr=False)
    joints: dict[str, JointSummary] = field(repr=False)
    findings: tuple[str, ...] = ()
    despite_errors: tuple[str, ...] = ()
    picture: Path | None = None

    @property
    def fields(self) -> tuple[str, ...]:
        """Parameters that at least one joint has."""
        found = []
        for name in self.uncertainty.fields:
            if any(joint.values[name] for joint in self.joints.values()):
                found.append(name)
        return tuple(found)

    def rows(self) -> list[list[str]]:
        """Return a row for each joint: its name, then the value of each of `fields` with its
        error.
        """
        from gaponet.sysid.uncertainty import table_rows

        return table_rows(self.uncertainty, self.fields)

    def sentences(self) -> list[str]:
        """Return the findings, the recordings, and what is only known together."""
        from gaponet.sysid.uncertainty import sentences

        return [*self.findings, *sentences(self.uncertainty)]

    def to_dict(self) -> dict[str, Any]:
        joints = {}
        for name, joint in self.joints.items():
            known = self.uncertainty.joints[name]
            joints[name] = {
                "values": joint.values,
                "standard_errors": joint.errors,
                "together": joint.sets,
                "left": known.residual_rms,
                "band_90": known.residual_p90,
                "predicted": known.parameter_rms,
                "scale": known.residual_rms / max(known.parameter_rms, 1e-12),
            }
        return {
            "robot": self.robot.name,
            "sources": self.uncertainty.sources,
            "held": self.uncertainty.validated,
            "joints": joints,
            "findings": list(self.findings),
            "picture": None if self.picture is None else str(self.picture),
        }


@dataclass(frozen=True, kw_only=True)
class ServoTypes:
    """Servo types with their limits and measured values.

    Attributes:
        version: Version of the package's table.
    """

    version: int
    types: tuple[ServoType, ...]

    def toml(self) -> str:
        """Return the types as entries of servos.toml or robot.toml."""
        from gaponet.sysid.servo_types import toml_entry

        return "\n".join(toml_entry(servo) for servo in self.types)

    def to_dict(self) -> dict[str, Any]:
        return {"version": self.version, "servos": [asdict(servo) for servo in self.types]}


@dataclass(frozen=True, kw_only=True)
class LinkResult:
    """Quality of the connection to a robot.

    Attributes:
        measured: states, rate_hz, age_ms and interval_ms (p50, p99, max), lost, refused.
        publishers: DDS topic of commands or states → programs that publish it.
        facts: What the driver knows of the robot.
    """

    robot: str
    address: str
    virtual: bool
    measured: dict[str, Any]
    publishers: dict[str, list[str]]
    facts: dict[str, Any]

    def to_dict(self) -> dict[str, Any]:
        found = self.measured | {"publishers": self.publishers, "virtual": self.virtual}
        return found | self.facts


def robots() -> RobotList:
    """Return the robots of the package: as their makers state them, and identified ones."""
    specs = tuple(load_robot(name) for name in packaged_robots())
    return RobotList(robots=specs, identified=robot_cards())


def networks(name: str = "") -> tuple[NetworkCard, ...]:
    """Return the cards of the trained networks in the package, by name.

    GapModel.load takes the names.

    Errors in a card are mean absolute joint position errors in mrad, payloads are in kg, rates in
    Hz.

    Args:
        name: Only networks with this in their names.

    Raises:
        ModelError: A card is damaged.
        UsageError: No network has this in its name.
    """
    from gaponet.nn.network_card import network_cards

    cards = network_cards()
    found = tuple(card for card in cards if name.lower() in card.name.lower())
    if not found and name:
        names = ", ".join(card.name for card in cards) or "no networks"
        raise UsageError(f"no network has '{name}' in its name; the package has {names}")
    return found


def new_robot(
    model: Place,
    *,
    out: Place,
    options: RobotOptions = RobotOptions(),  # noqa: B008
) -> NewRobotResult:
    """Make a robot folder from a vendor's MJCF or URDF, with the source of every number, and check
    it.

    Args:
        model: MJCF or URDF file with the files that it names.
        out: New robot folder.
        options: Joints, gains and limits.

    Raises:
        RobotError: The model is damaged, or has no joint to record.
        UsageError: An option does not fit the model, or a gain is stated nowhere.
    """
    from gaponet.report.view.gl import prepare

    prepare()  # before MuJoCo is imported
    from gaponet.robot import new

    reasons: list[str] = []

    def draw(made: NewRobot) -> bytes | None:
        try:
            return _picture(made, Path(model).name)
        except (UsageError, ModuleNotFoundError) as error:
            reasons.append(str(error))
            return None

    folder = Path(out)
    made = new.new_robot(Path(model), folder, options, draw)
    return NewRobotResult(
        folder=folder,
        check=check_robot(made.robot),
        drives=made.drives,
        notes=made.notes,
        picture=None if reasons else folder / new.PICTURE,
        no_picture="; ".join(reasons),
    )


def find_model(name: str) -> Path:
    """Return the model file of a name such as menagerie:franka_fr3, on this disk.

    Raises:
        RobotError: It is not there; the message says how to get it.
    """
    from gaponet.report.view.gl import prepare

    prepare()  # before MuJoCo is imported
    from gaponet.robot import vendor

    return vendor.find_model(name)


def _picture(made: NewRobot, label: str) -> bytes:
    """Return a PNG: the vendor's model beside ours, both at home."""
    from gaponet.report.view.picture import still
    from gaponet.sim.model import build_model

    theirs = (label, made.vendor, made.pose)
    ours = ("robot.xml", build_model(made.robot), made.robot.qpos_home)
    return still([theirs, ours])


def check_robot(
    robot: RobotSpec | Place,
    *,
    data: Dataset | Place | None = None,
    payloads: tuple[float, ...] = (),
) -> RobotCheck:
    """Step a robot's simulator and list the faults of its folder.

    Args:
        data: Recordings of this robot, whose postures and payloads are checked too.
        payloads: kg in every mount; each is held for a minute. Default: those of the data, or 0.

    Raises:
        RobotError: The robot does not compile.
    """
    from gaponet.sim import robot_check
    from gaponet.sim.model import model_hash

    spec = as_robot(robot)
    postures: Array | None = None
    if data is not None:
        recordings, _ = open_dataset(data, spec)
        recorded = sorted({entry.meta.payload_mass for entry in recordings.entries})
        payloads = payloads or tuple(recorded)
        rows = np.concatenate([recordings.read(entry).qpos for entry in recordings.entries])
        stride = max(1, len(rows) // MAX_POSTURES)
        postures = rows[::stride].astype(float)
    findings = robot_check.check_robot(spec, payloads or (0.0,), postures)
    return RobotCheck(robot=spec, findings=tuple(findings), simulator=model_hash(spec))


def robot_parameters(robot: RobotSpec | Place, *, picture: Place | None = None) -> ParametersResult:
    """Return an identified robot's parameters and their standard errors.

    Args:
        robot: Robot folder that `identify` or `adapt_robot` wrote.
        picture: Picture to draw, .png or .svg.

    Raises:
        RobotError: The folder holds no standard errors.
        UsageError: The picture has another suffix.
    """
    from gaponet.evaluation.candidate import read_origin
    from gaponet.sysid.uncertainty import ParameterUncertainty, summarize

    spec = as_robot(robot)
    uncertainty = ParameterUncertainty.require(spec)
    origin = read_origin(spec.folder)
    findings: tuple[str, ...] = ()
    despite_errors: tuple[str, ...] = ()
    if origin is not None:
        findings = tuple(origin.get("findings", ()))
        despite_errors = tuple(origin.get("doctor", {}).get("despite_errors", ()))
    if picture is not None:
        _draw_parameters(spec, uncertainty, Path(picture))
    return ParametersResult(
        robot=spec,
        uncertainty=uncertainty,
        joints={joint: summarize(uncertainty, joint) for joint in uncertainty.joints},
        findings=findings,
        despite_errors=despite_errors,
        picture=None if picture is None else Path(picture),
    )


def _draw_parameters(robot: RobotSpec, uncertainty: ParameterUncertainty, file: Path) -> None:
    from gaponet.base.files import atomic_write
    from gaponet.report.figures.evaluation import draw_uncertainty

    if file.suffix not in PICTURE_SUFFIXES:
        raise UsageError(f"--out {file}: a picture is a .png or an .svg")
    figure = draw_uncertainty(uncertainty, f"{robot.name}: parameters with 90 % intervals")
    with atomic_write(file) as temporary:
        figure.savefig(temporary, format=file.suffix[1:], dpi=200)


def servo_types(
    name: str = "", *, measured: tuple[Place, ...] = (), source: str = "", licence: str = ""
) -> ServoTypes:
    """Return servo types of the package, or those that identified robots have measured.

    Args:
        name: Only types with this in their names.
        measured: Identified robot folders; the types of their joints get their measured values.
        source: Data set of the recordings, with `measured`.
        licence: Licence of the data set, with `measured`.

    Raises:
        UsageError: There is no such type, or source and licence are missing.
    """
    from gaponet.sysid.servo_types import measured_types

    table = servo_table()
    types = list(table.servo)
    if measured:
        if not (source and licence):
            raise UsageError(
                "--from: name the recordings' data set with --source, and its licence with "
                "--licence"
            )
        types = measured_types([load_robot(folder) for folder in measured], source, licence)
    found = tuple(servo for servo in types if name.lower() in servo.name.lower())
    if not found:
        raise UsageError(f"no servo type has '{name}' in its name; gaponet robot servos lists them")
    return ServoTypes(version=table.version, types=found)


def measure_link(
    robot: str = "",
    *,
    driver: Literal["unitree", "so101"] = "unitree",
    domain: int = 0,
    interface: str = "lo",
    port: str = "/dev/ttyACM0",
    seconds: float = 5.0,
) -> LinkResult:
    """Listen to a robot without moving it: rate and age of its states, and who publishes commands.

    Args:
        robot: Name or folder; default h1_2, or so101 for that driver.
        driver: unitree (DDS) or so101 (serial).
        domain: unitree: DDS domain.
        interface: unitree: network interface to the robot.
        port: so101: serial port.
        seconds: Duration, s.

    Raises:
        DriverError: The robot does not answer.
    """
    from gaponet.hw.drivers import link
    from gaponet.hw.drivers.open import open_driver

    name = robot or ROBOT_OF_LINK[driver]
    options: dict[str, Any] = {"port": port}
    if driver == "unitree":
        options = {"domain": domain, "interface": interface, "silent": True, "sole": False}
    bus = open_driver(driver, name, **options)
    try:
        bus.connect()
        measured = link.measure_link(bus, seconds)
        publishers = bus.publishers() if hasattr(bus, "publishers") else {}
    finally:
        bus.close(hold=True)
    return LinkResult(
        robot=name,
        address=bus.address,
        virtual=bus.virtual,
        measured=measured,
        publishers=publishers,
        facts=bus.facts,
    )
