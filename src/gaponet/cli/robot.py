"""gaponet robot new, check, list, link, show, servos, networks."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import numpy as np
import tyro

from gaponet import api
from gaponet.base.errors import UsageError
from gaponet.base.files import atomic_write
from gaponet.cli.options import Flag, Folder, Json, actions
from gaponet.cli.out import Out
from gaponet.nn.packaged_networks import packaged_networks
from gaponet.robot.card import ROBOT_HEADINGS, robot_cards
from gaponet.robot.spec import RobotSpec, load_robot, packaged_robots, robot_argument, servo_table
from gaponet.robot.toml_file import MEASURED_FIELDS
from gaponet.sim.dataset_robot import open_dataset

if TYPE_CHECKING:
    from gaponet.robot.new import NewRobot

MAX_POSTURES = 300  # of the logs


def list_robots(json: Json = False) -> None:
    """Robots in the package: as their makers state them, and identified from public recordings."""
    out = Out(json)
    specs = [load_robot(name) for name in packaged_robots()]
    out.table("Robots", ["name", "joints", "operated", "Hz", "payload", "what it is"], [
        [s.name, str(len(s.joint_names)), str(len(s.operated)), f"{1 / s.dt:g}",
         ", ".join(m.side for m in s.payload_mounts) or "–", s.description] for s in specs
    ])  # fmt: skip
    cards = robot_cards()
    if cards:
        out.table("Identified robots", list(ROBOT_HEADINGS), [card.row() for card in cards])
        for card in cards:
            out.say(f": {card.details()}", card.name)
    out.say(
        "A name stands wherever a robot does. Your own: a folder with robot.toml and robot.xml; gaponet robot check "
        "FOLDER"
    )
    out.result({
        "robots": [
            {"name": s.name, "joints": s.joint_names, "operated": s.operated} for s in specs
        ],
        "identified": [asdict(card) for card in cards],
    })  # fmt: skip


def link(
    robot: tyro.conf.Positional[str] = "", driver: Literal["unitree", "so101"] = "unitree", domain: int = 0,
    interface: str = "lo", port: str = "/dev/ttyACM0", seconds: float = 5.0, json: Json = False,
) -> None:  # fmt: skip
    """Listen to a robot without moving it: rate and age of its states, and the programs that publish commands.

    Args:
        robot: Name, or a folder with robot.toml and robot.xml.
        driver: unitree (DDS) or so101 (serial).
        domain: unitree: DDS domain.
        interface: unitree: network interface to the robot.
        port: so101: serial port.
        seconds: Duration, s.
    """
    from gaponet.hw.drivers.link import measure_link
    from gaponet.hw.drivers.open import open_driver

    out, name = Out(json), robot or ("h1_2" if driver == "unitree" else "so101")
    options = (
        {"domain": domain, "interface": interface, "silent": True, "sole": False}
        if driver == "unitree"
        else {"port": port}
    )
    bus = open_driver(driver, name, **options)
    try:
        bus.connect()
        measured = measure_link(bus, seconds)
        publishers = bus.publishers() if hasattr(bus, "publishers") else {}
    finally:
        bus.close(hold=True)
    three = lambda what: ", ".join(f"{value:.2f}" for value in measured[what])  # noqa: E731
    out.table(f"{'VIRTUAL ' * bus.virtual}{name} at {bus.address}, {seconds:g} s", ["what", "value"], [
        ["states, a second", f"{measured['states']}, {measured['rate_hz']:.1f}"],
        ["age when it comes, ms: p50, p99, max", three("age_ms")],
        ["between two, ms: p50, p99, max", three("interval_ms")],
        ["lost, refused", f"{measured['lost']}, {measured['refused']}"],
        ["these states are of", bus.facts.get("source", "a driver that does not say")],
        *([f"publish {topic}", "; ".join(programs) or "nobody"] for topic, programs in publishers.items()),
    ])  # fmt: skip
    robots = publishers.get("rt/lowstate", [])
    if len(robots) > 1:
        out.say(
            f"{len(robots)} robots publish rt/lowstate: both would move, so run refuses this bus"
        )
    out.result(measured | {"publishers": publishers, "virtual": bus.virtual} | bus.facts)


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
        raise UsageError(
            f"gaponet robot check needs a robot name ({', '.join(packaged_robots())}) or a folder"
        )
    out = Out(json)
    out.result(check_robot(out, load_robot(robot), data, payloads))


def new(
    model: Annotated[tyro.conf.Positional[Path | None], tyro.conf.arg(metavar="MODEL")] = None,
    *, out: Path, from_: Annotated[str, tyro.conf.arg(name="from", metavar="COLLECTION:NAME")] = "",
    joints: tuple[str, ...] = (), kp: tuple[str, ...] = (), kd: tuple[str, ...] = (),
    effort_limit: tuple[str, ...] = (), servo: tuple[str, ...] = (), packages: tuple[str, ...] = (),
    rate: float = 50.0, keyframe: str = "", contacts: Flag = False, name: str = "", json: Json = False,
) -> None:  # fmt: skip
    """Make a robot folder from a vendor's MJCF or URDF, with the source of every number, and check it.

    Args:
        model: MJCF or URDF file with the files that it names.
        out: New robot folder.
        from_: A model of this disk by name, instead of a file: menagerie:franka_fr3, robot_descriptions:NAME or
            example-robot-data:NAME. Nothing is downloaded.
        joints: Recorded joints, by name or pattern ('*_elbow_*'); all others are frozen. Default: all hinges with an
            actuator, or all hinges.
        kp: Position gain of the controller while recording, N·m/rad: 100 for all joints, '*wrist*=20' for some; a later
            value replaces an earlier one. Default: the model's actuators.
        kd: Damping gain, likewise, N·m·s/rad.
        effort_limit: Torque limit, likewise, N·m.
        servo: Servo type, likewise, as gaponet robot servos lists them: its measured damping, friction and armature and
            its torque limit replace the model's.
        packages: NAME=FOLDER for package://NAME in a URDF. Default: searched around the file.
        rate: Commands per second, Hz.
        keyframe: Keyframe that gives the home position and the angles of frozen joints. Default: the first, or zero.
        contacts: Keep the contacts between links that the model has.
        name: Name of the robot. Default: the file's name.
    """
    from gaponet.report.view.gl import prepare

    prepare()
    from gaponet.robot.new import PICTURE, RobotOptions, new_robot
    from gaponet.robot.vendor import find_model

    if (model is None) == (not from_):
        raise UsageError(
            "give a model file, or --from COLLECTION:NAME, such as --from menagerie:franka_fr3"
        )
    model = model or find_model(from_)

    screen = Out(json)
    options = RobotOptions(
        joints, kp, kd, effort_limit, servo, packages, rate, keyframe, contacts, name
    )
    no_picture = list[str]()

    def draw(made: NewRobot) -> bytes | None:
        try:
            return _picture(made, model.name)
        except (UsageError, ModuleNotFoundError) as error:
            no_picture.append(str(error))
            return None

    made = new_robot(model, out, options, draw)
    for note in made.notes:
        screen.say(f"  {note}", "   note", "cyan")
    passive = ("damping, friction, armature", "passive_source")
    for what, field in (
        ("kp", "kp_source"),
        ("kd", "kd_source"),
        ("effort_limit", "limit_source"),
        passive,
    ):
        screen.say(
            f"  {what}: {', '.join(dict.fromkeys(getattr(d, field) for d in made.drives))}",
            "   from",
            "cyan",
        )
    for reason in no_picture:
        screen.say(f"  no picture: {reason}", "   note", "cyan")
    picture = None if no_picture else out / PICTURE
    result = check_robot(screen, made.robot, None, ())
    screen.say(f"written: {out}/robot.toml, robot.xml{', picture.png' if picture else ''}")
    screen.next(
        f"look at robot.toml and the picture; gaponet import LOGS --robot {robot_argument(out)} --out data"
    )
    screen.result(
        result | {"folder": str(out), "notes": made.notes, "picture": picture and str(picture)}
    )


def _picture(made: NewRobot, label: str) -> bytes:
    """Return a PNG: the vendor's model beside ours, both at home."""
    from gaponet.report.view.picture import still
    from gaponet.sim.model import build_model

    return still(
        [
            (label, made.vendor, made.pose),
            ("robot.xml", build_model(made.robot), made.robot.qpos_home),
        ]
    )


def check_robot(
    out: Out, spec: RobotSpec, dataset: Path | None, payloads: tuple[float, ...]
) -> dict[str, Any]:
    """Step the robot; a broken one raises RobotError, a doubtful one gets warnings."""
    from gaponet.sim import robot_check as check
    from gaponet.sim.model import model_hash

    postures = None
    if dataset is not None:
        data, _ = open_dataset(dataset, spec)
        payloads = payloads or tuple(sorted({e.meta.payload_mass for e in data.entries}))
        rows = np.concatenate([data.read(e).qpos for e in data.entries])
        postures = rows[:: max(1, len(rows) // MAX_POSTURES)].astype(float)
    findings = check.check_robot(spec, payloads or (0.0,), postures)
    out.table(f"{spec.name}: {spec.description}; N·m/rad, N·m·s/rad, N·m, rad",
              ["joint", "operated", "kp", "kd", "limit", "range"], [
        [name, "yes" if name in spec.operated else "no", f"{spec.kp[i]:g}", f"{spec.kd[i]:g}",
         f"{spec.effort_limit[i]:g}", "{:.2f}…{:.2f}".format(*spec.qpos_range[i])]
        for i, name in enumerate(spec.joint_names)
    ])  # fmt: skip
    for name, unit in zip(spec.joint_names, spec.log_units, strict=True):
        if unit != "rad":
            out.say(f"{name} is expected as {unit} in SAGE logs")
    mounts = ", ".join(f"{m.side} on {m.body}" for m in spec.payload_mounts) or "none"
    out.say(
        f"control period {spec.dt * 1e3:g} ms, physics step {spec.timestep * 1e3:g} ms ({spec.decimation} a period); "
        f"payload mounts: {mounts}; contacts {'on' if spec.contacts else 'off'}; simulator {model_hash(spec)}"
    )
    out.findings(findings)
    bad = {level: sum(f.level == level for f in findings) for level in ("error", "warning")}
    if bad["error"]:
        out.say(
            f": {spec.name} is no simulator of it yet; mend the {bad['error']} error(s)",
            "not ok",
            "bold red",
        )
    elif bad["warning"]:
        out.say(f"{spec.name} compiles and holds; see the {bad['warning']} warning(s)")
    else:
        out.say(f": {spec.name} compiles, holds its home and is stable", "ok", "bold green")
    return {
        "simulator_hash": model_hash(spec), "warnings": [f.message for f in findings if f.level in bad],
        "findings": [vars(f) for f in findings],
        "name": spec.name, "dt": spec.dt, "timestep": spec.timestep,
        "joints": [
            {"name": name, "operated": name in spec.operated, "kp": spec.kp[i], "kd": spec.kd[i],
             "effort_limit": spec.effort_limit[i], "range": spec.qpos_range[i], "home": spec.qpos_home[i],
             "log_unit": spec.log_units[i]}
            for i, name in enumerate(spec.joint_names)
        ],
        "payload_mounts": [{"side": m.side, "body": m.body, "pos": m.pos} for m in spec.payload_mounts],
    }  # fmt: skip


def show(
    robot: Annotated[
        Folder,
        tyro.conf.arg(help="Robot folder of gaponet identify or gaponet adapt.", metavar="ROBOT"),
    ],
    out: Path | None = None,
    json: Json = False,
) -> None:
    """Show an identified robot's parameters and their standard errors.

    Args:
        out: Picture to write, .png or .svg.
    """
    from gaponet.evaluation.candidate import read_origin
    from gaponet.report.figures.evaluation import draw_uncertainty
    from gaponet.robot.servo_fields import SERVO_FIELDS
    from gaponet.sysid.uncertainty import ParameterUncertainty, sentences, summarize, table_rows

    screen = Out(json)
    spec = load_robot(robot)
    known = ParameterUncertainty.require(spec)
    sure = {j: summarize(known, j) for j in known.joints}
    fields = tuple(f for f in known.fields if any(c.values[f] for c in sure.values()))
    columns = ["joint", *(SERVO_FIELDS[f].heading for f in fields)]
    screen.table(f"Parameters of {spec.name}, ± standard error", columns, table_rows(known, fields))
    origin = read_origin(spec.folder)
    findings = list(origin.get("findings", ())) if origin else []
    doctor = origin.get("doctor", {}) if origin else {}
    for error in doctor.get("despite_errors", ()):
        screen.say(f"  identified despite an error of the recordings, {error}", "warning", "yellow")
    for line in (*findings, *sentences(known)):
        screen.say(line)
    if out is not None:
        if out.suffix not in (".png", ".svg"):
            raise UsageError(f"--out {out}: a picture is a .png or an .svg")
        with atomic_write(out) as temporary:
            draw_uncertainty(known, f"{spec.name}: parameters and standard errors").savefig(
                temporary, format=out.suffix[1:], dpi=200
            )
        screen.say(f"picture: {out}")
    screen.result({
        "robot": spec.name, "sources": known.sources, "held": known.validated,
        "joints": {
            j: {
                "values": c.values, "standard_errors": c.errors, "together": c.sets,
                "left": known.joints[j].residual_rms,
                "band_90": known.joints[j].residual_p90, "predicted": known.joints[j].parameter_rms,
                "scale": known.joints[j].residual_rms / max(known.joints[j].parameter_rms, 1e-12),
            }
            for j, c in sure.items()
        },
        "findings": findings, "picture": None if out is None else str(out),
    })  # fmt: skip


def servos(
    name: tyro.conf.Positional[str] = "", measured: Annotated[tuple[Path, ...], tyro.conf.arg(name="from")] = (),
    source: str = "", licence: str = "", json: Json = False,
) -> None:  # fmt: skip
    """Servo types: limits, measured values (median, and 5 to 95 % of joints with their standard errors), and sources.

    Args:
        name: Only types with this in their names.
        measured: Identified robot folders; prints an entry for each servo type of their joints, as TOML, instead.
        source: Data set of the recordings, for --from.
        licence: Licence of the data set, for --from.
    """
    from gaponet.robot.servo_fields import SERVO_FIELDS
    from gaponet.sysid.servo_types import measured_types, toml_entry

    out, table = Out(json), servo_table()
    if measured and not (source and licence):
        raise UsageError(
            "--from: name the recordings' data set with --source, and its licence with --licence"
        )
    types = (
        measured_types(list(map(load_robot, measured)), source, licence)
        if measured
        else table.servo
    )
    types = [servo for servo in types if name.lower() in servo.name.lower()]
    if not types:
        raise UsageError(f"no servo type has '{name}' in its name; gaponet robot servos lists them")
    if measured:
        for line in "\n".join(map(toml_entry, types)).splitlines():
            out.say(line)
    else:
        stated = {
            "effort_limit": "torque limit, N·m",
            "speed_limit": "speed limit, rad/s",
            "gain": "kp of 1, N·m/rad",
        }
        fields = (*MEASURED_FIELDS[:3], *stated, *MEASURED_FIELDS[3:])
        headings = [stated.get(f) or SERVO_FIELDS[f].heading for f in fields]
        title = f"Servo types, version {table.version}; measured values: median (5…95 % of joints)"
        out.table(
            title,
            ["servo type", *headings],
            [[s.name, *(s.text(f) for f in fields)] for s in types],
        )
        for servo in types:
            counts = (
                servo.gaponet
                and f"joints: {servo.joints}, robots: {servo.robots}; gaponet {servo.gaponet}"
            )
            limits = servo.limit_source and f"limits: {servo.limit_source}"
            sources = filter(None, (servo.variant, servo.source, servo.licence, counts, limits))
            out.say(f"{servo.name}: {'; '.join(sources)}")
    out.result({"version": table.version, "servos": [asdict(servo) for servo in types]})


def networks(name: tyro.conf.Positional[str] = "", json: Json = False) -> None:
    """Trained networks in the package: data, errors on test motions, limits of use.

    Args:
        name: Only networks with this in their names.
    """
    from gaponet.nn.network_card import HEADINGS

    out = Out(json)
    cards = [card for card in api.networks() if name.lower() in card.name.lower()]
    if not cards:
        names = ", ".join(packaged_networks()) or "no networks"
        raise UsageError(f"no network has '{name}' in its name; the package has {names}")
    out.table("Networks", list(HEADINGS), [card.row() for card in cards])
    for card in cards:
        out.say(f": {card.details()}", card.name)
    out.next(f"gaponet eval {cards[0].name} DATASET")
    out.result({"networks": [asdict(card) for card in cards]})


@actions(
    new=new, check=check, list=list_robots, link=link, show=show, servos=servos, networks=networks
)
def robot(action: None) -> None:
    """Make, check or show a robot folder; list servos and networks."""
