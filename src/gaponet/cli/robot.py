"""gaponet robot new, check, list, link, show, servos, networks."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from shlex import quote
from typing import Annotated, Literal

import tyro

from gaponet.api import robots
from gaponet.api.robots import NewRobotResult, RobotCheck, ServoTypes
from gaponet.base.errors import UsageError
from gaponet.cli.options import Folder, Json, actions
from gaponet.cli.out import Out
from gaponet.robot.servo_fields import SERVO_FIELDS
from gaponet.robot.spec import RobotSpec, ServoType, packaged_robots, robot_argument
from gaponet.robot.toml_file import MEASURED_FIELDS, RobotOptions

Known = Annotated[
    Folder,
    tyro.conf.arg(help="Robot folder of gaponet identify or gaponet adapt.", metavar="ROBOT"),
]
LIST_COLUMNS = ["name", "joints", "operated", "Hz", "payload", "what it is"]
CHECK_COLUMNS = ["joint", "operated", "kp", "kd", "limit", "range"]
LINK_COLUMNS = ["what", "value"]
STATED_FIELDS = {  # of a servo type, beside those that are measured
    "effort_limit": "torque limit, N·m",
    "speed_limit": "speed limit, rad/s",
    "gain": "kp of 1, N·m/rad",
}
# Columns of gaponet robot servos.
TYPE_FIELDS = (*MEASURED_FIELDS[:3], *STATED_FIELDS, *MEASURED_FIELDS[3:])


def list_robots(json: Json = False) -> None:
    """Robots in the package: as their makers state them, and identified from public recordings."""
    screen = Out(json)
    made = robots.robots()
    screen.table("Robots", LIST_COLUMNS, [_list_row(robot) for robot in made.robots])
    if made.identified:
        rows = [card.row() for card in made.identified]
        screen.table("Identified robots", list(made.headings), rows)
        for card in made.identified:
            screen.say(f": {card.details()}", card.name)
        screen.say(
            "An identified robot has the values of one unit on one day. Identify or adapt yours "
            "before you rely on them."
        )
    screen.say(
        "A name stands wherever a robot does. Your own: a folder with robot.toml and robot.xml; "
        "gaponet robot check FOLDER"
    )
    screen.result(made.to_dict())


def _list_row(robot: RobotSpec) -> list[str]:
    return [
        robot.name,
        str(len(robot.joint_names)),
        str(len(robot.operated)),
        f"{1 / robot.dt:g}",
        ", ".join(mount.side for mount in robot.payload_mounts) or "–",
        robot.description,
    ]


def link(
    robot: tyro.conf.Positional[str] = "",
    driver: Literal["unitree", "so101"] = "unitree",
    domain: int = 0,
    interface: str = "lo",
    port: str = "/dev/ttyACM0",
    seconds: float = 5.0,
    json: Json = False,
) -> None:
    """Listen to a robot without moving it: rate and age of its states, and the programs that
    publish commands.

    Args:
        robot: Name, or a folder with robot.toml and robot.xml.
        driver: unitree (DDS) or so101 (serial).
        domain: unitree: DDS domain.
        interface: unitree: network interface to the robot.
        port: so101: serial port.
        seconds: Duration, s.
    """
    screen = Out(json)
    made = robots.measure_link(
        robot, driver=driver, domain=domain, interface=interface, port=port, seconds=seconds
    )
    measured = made.measured
    rows = [
        ["states, a second", f"{measured['states']}, {measured['rate_hz']:.1f}"],
        ["age when it comes, ms: p50, p99, max", _numbers(measured["age_ms"])],
        ["between two, ms: p50, p99, max", _numbers(measured["interval_ms"])],
        ["lost, refused", f"{measured['lost']}, {measured['refused']}"],
        ["these states are of", made.facts.get("source", "a driver that does not say")],
    ]
    for topic, programs in made.publishers.items():
        rows.append([f"publish {topic}", "; ".join(programs) or "nobody"])
    label = "VIRTUAL " if made.virtual else ""
    screen.table(f"{label}{made.robot} at {made.address}, {seconds:g} s", LINK_COLUMNS, rows)
    count = len(made.publishers.get("rt/lowstate", []))
    if count > 1:
        screen.say(f"{count} robots publish rt/lowstate: both would move, so run refuses this bus")
    screen.result(made.to_dict())


def _numbers(values: list[float]) -> str:
    return ", ".join(f"{value:.2f}" for value in values)


def check(
    robot: tyro.conf.Positional[str] = "",
    data: Path | None = None,
    payloads: tuple[float, ...] = (),
    json: Json = False,
) -> None:
    """Step a robot's simulator and list the faults of its folder.

    Args:
        robot: Name, or a folder with robot.toml and robot.xml.
        data: Dataset of this robot whose postures and payloads are checked too.
        payloads: kg in every mount; each is held for a minute. Default: those of the data, or 0.
    """
    if not robot:
        names = ", ".join(packaged_robots())
        raise UsageError(f"gaponet robot check needs a robot name ({names}) or a folder")
    screen = Out(json)
    made = robots.check_robot(robot, data=data, payloads=payloads)
    _show_check(screen, made)
    screen.result(made.to_dict())


def _show_check(screen: Out, made: RobotCheck) -> None:
    """Print the joints, the timing, the findings and the verdict."""
    robot = made.robot
    title = f"{robot.name}: {robot.description}; N·m/rad, N·m·s/rad, N·m, rad"
    rows = [_joint_row(robot, i) for i in range(len(robot.joint_names))]
    screen.table(title, CHECK_COLUMNS, rows)
    for name, unit in zip(robot.joint_names, robot.log_joints.units, strict=True):
        if unit != "rad":
            screen.say(f"{name} is expected as {unit} in SAGE logs")
    mounts = ", ".join(f"{m.side} on {m.body}" for m in robot.payload_mounts) or "none"
    count = len(robot.payload_mounts)
    if count > 1:
        mounts += f" (a payload of 1 kg is 1 kg in each of {count} mounts)"
    contacts = "on" if robot.scene.contacts else "off"
    screen.say(
        f"control period {robot.dt * 1e3:g} ms, physics step {robot.timestep * 1e3:g} ms "
        f"({robot.decimation} a period); payload mounts: {mounts}; contacts {contacts}; "
        f"simulator {made.simulator}"
    )
    screen.findings(made.findings)
    errors = made.count("error")
    warnings = made.count("warning")
    if errors:
        text = f": {robot.name} is no simulator of it yet; mend the {errors} error(s)"
        screen.say(text, "not ok", "bold red")
    elif warnings:
        screen.say(f"{robot.name} compiles and holds; see the {warnings} warning(s)")
    else:
        screen.say(f": {robot.name} compiles, holds its home and is stable", "ok", "bold green")


def _joint_row(robot: RobotSpec, i: int) -> list[str]:
    name = robot.joint_names[i]
    low, high = robot.qpos_range[i]
    return [
        name,
        "yes" if name in robot.operated else "no",
        f"{robot.servo.kp[i]:g}",
        f"{robot.servo.kd[i]:g}",
        f"{robot.servo.effort_limit[i]:g}",
        f"{low:.2f}…{high:.2f}",
    ]


def new(
    model: Annotated[tyro.conf.Positional[Path | None], tyro.conf.arg(metavar="MODEL")] = None,
    *,
    out: Path,
    from_: Annotated[str, tyro.conf.arg(name="from", metavar="COLLECTION:NAME")] = "",
    options: Annotated[
        RobotOptions, tyro.conf.arg(name=""), tyro.conf.FlagCreatePairsOff
    ] = RobotOptions(),  # noqa: B008
    json: Json = False,
) -> None:
    """Make a robot folder from a vendor's MJCF or URDF, with the source of every number, and check
    it.

    Args:
        model: MJCF or URDF file with the files that it names.
        out: New robot folder.
        from_: A model of this disk by name, instead of a file: menagerie:franka_fr3,
            robot_descriptions:NAME or example-robot-data:NAME. Nothing is downloaded.
        options: Joints, gains and limits.
    """
    if (model is None) == (not from_):
        raise UsageError(
            "give a model file, or --from COLLECTION:NAME, such as --from menagerie:franka_fr3"
        )
    screen = Out(json)
    made = robots.new_robot(model or robots.find_model(from_), out=out, options=options)
    _show_sources(screen, made)
    _show_check(screen, made.check)
    picture = "" if made.picture is None else ", picture.png"
    screen.say(f"written: {out}/robot.toml, robot.xml{picture}")
    screen.next(
        "look at robot.toml and the picture; gaponet import LOGS "
        f"--robot {quote(robot_argument(out))} --unit-id NAME --payload-mass KG --out data"
    )
    screen.result(made.to_dict())


def _show_sources(screen: Out, made: NewRobotResult) -> None:
    """Print what was changed in the model, and where gains and limits come from."""
    for note in made.notes:
        screen.say(f"  {note}", "   note", "cyan")
    sources = {
        "kp": made.sources("kp_source"),
        "kd": made.sources("kd_source"),
        "effort_limit": made.sources("limit_source"),
        "damping, friction, armature": made.sources("passive_source"),
    }
    for name, source in sources.items():
        screen.say(f"  {name}: {source}", "   from", "cyan")
    if made.no_picture:
        screen.say(f"  no picture: {made.no_picture}", "   note", "cyan")


def show(robot: Known, out: Path | None = None, json: Json = False) -> None:
    """Show an identified robot's parameters and their standard errors.

    Args:
        out: Picture to write, .png or .svg.
    """
    screen = Out(json)
    made = robots.robot_parameters(robot, picture=out)
    columns = ["joint", *(SERVO_FIELDS[field].heading for field in made.fields)]
    screen.table(f"Parameters of {made.robot.name}, ± standard error", columns, made.rows())
    for error in made.despite_errors:
        screen.say(f"  identified despite an error of the recordings, {error}", "warning", "yellow")
    for sentence in made.sentences():
        screen.say(sentence)
    if made.picture is not None:
        screen.say(f"picture: {made.picture}")
    screen.result(made.to_dict())


def servos(
    name: tyro.conf.Positional[str] = "",
    measured: Annotated[tuple[Path, ...], tyro.conf.arg(name="from")] = (),
    source: str = "",
    licence: str = "",
    json: Json = False,
) -> None:
    """Servo types: limits, measured values (median, and 5 to 95 % of joints with their standard
    errors), and sources.

    Args:
        name: Only types with this in their names.
        measured: Identified robot folders; prints an entry for each servo type of their joints, as
            TOML, instead.
        source: Data set of the recordings, for --from.
        licence: Licence of the data set, for --from.
    """
    screen = Out(json)
    made = robots.servo_types(name, measured=measured, source=source, licence=licence)
    if measured:
        for line in made.toml().splitlines():
            screen.say(line)
    else:
        _show_types(screen, made)
    screen.result(made.to_dict())


def _show_types(screen: Out, made: ServoTypes) -> None:
    """Print limits and measured values of servo types, and their sources."""
    headings = [STATED_FIELDS.get(field) or SERVO_FIELDS[field].heading for field in TYPE_FIELDS]
    rows = []
    for servo in made.types:
        rows.append([servo.name, *(servo.text(field) for field in TYPE_FIELDS)])
    title = f"Servo types, version {made.version}; measured values: median (5…95 % of joints)"
    screen.table(title, ["servo type", *headings], rows)
    for servo in made.types:
        screen.say(f"{servo.name}: {'; '.join(_sources(servo))}")


def _sources(servo: ServoType) -> list[str]:
    """Return where the values of a servo type come from."""
    sources = [servo.variant, servo.source, servo.licence]
    if servo.gaponet:
        sources.append(f"joints: {servo.joints}, robots: {servo.robots}; gaponet {servo.gaponet}")
    if servo.limit_source:
        sources.append(f"limits: {servo.limit_source}")
    return [source for source in sources if source]


def networks(name: tyro.conf.Positional[str] = "", json: Json = False) -> None:
    """Trained networks in the package: data, errors on test motions, limits of use.

    Args:
        name: Only networks with this in their names.
    """
    screen = Out(json)
    cards = robots.networks(name)
    screen.table("Networks", list(cards[0].headings), [card.row() for card in cards])
    for card in cards:
        screen.say(f": {card.details()}", card.name)
    screen.next(f"gaponet eval {cards[0].name} DATASET")
    screen.result({"networks": [asdict(card) for card in cards]})


@actions(
    new=new, check=check, list=list_robots, link=link, show=show, servos=servos, networks=networks
)
def robot(action: None) -> None:
    """Make, check or show a robot folder; list servos and networks."""
