"""`gaponet run`: play a motion, or live targets, on a robot, real or virtual, with or without a model."""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import numpy as np
import tyro

from gaponet.cli.options import Flag, Json
from gaponet.cli.out import Out, writes
from gaponet.deploy.compensator import CompensatorConfig
from gaponet.deploy.phases import ControlConfig
from gaponet.deploy.safety import SafetyConfig
from gaponet.deploy.targets.live import LiveConfig
from gaponet.errors import UsageError

if TYPE_CHECKING:
    from gaponet.deploy.clock import Clock
    from gaponet.deploy.controller import Controller
    from gaponet.deploy.driver import Driver
    from gaponet.deploy.recording import Event, Recording
    from gaponet.deploy.targets.live import LiveTargets, Wire
    from gaponet.motion.motion import Motion
    from gaponet.robot import RobotSpec


@dataclass(frozen=True)
class Reach:
    """How to reach the robot."""

    topic: Literal["arm_sdk", "lowcmd"] = "arm_sdk"
    """unitree: arm_sdk leaves legs and balance to the robot; lowcmd is for a robot that hangs."""
    joints: Literal["arms", "upper_body", "all"] = "arms"
    """unitree: what is commanded; the legs only with all, on lowcmd."""
    domain: int = 0
    """unitree, and targets over DDS: DDS domain."""
    interface: str = "lo"
    """unitree, and targets over DDS: network interface to the robot; lo for a virtual one on this machine."""
    port: str = "/dev/ttyACM0"
    """so101: serial port."""
    calibration: Path | None = None
    """so101: the file that lerobot-calibrate wrote for this arm. It is compared with what the servos hold of it, which
    counts where no file is given."""
    unit: str = "4"
    """virtual: number or name in the fleet."""
    fleet: str = "hard"
    """virtual: hard, easy, shifted, or a .toml file."""
    fast: Flag = False
    """virtual: as fast as this machine can, not in real time."""


@dataclass(frozen=True)
class Asked:
    """What playing a motion may be told of robot and loop, as data: the docstrings are the command-line help."""

    driver: Literal["virtual", "unitree", "so101"] = "virtual"
    """virtual (in this process), unitree (DDS: a real H1-2, or gaponet virtual serve), so101 (serial)."""
    robot: str | None = None
    """Name or folder; default the one that the model's run keeps; without a model h1_2, or so101 with so101."""
    payload_side: str = "both"
    """both, or one hand."""
    max_payload: float | None = None
    """kg that the motion must be possible with; default 3 for named motions, so that all payloads play the same one,
    and payload_mass for files."""
    reach: tyro.conf.OmitArgPrefixes[Reach] = Reach()
    """How to reach the robot."""
    control: tyro.conf.OmitArgPrefixes[ControlConfig] = ControlConfig()  # noqa: RUF009
    """Timing."""
    safety: SafetyConfig = SafetyConfig()  # noqa: RUF009
    """Limits and watchdogs."""
    yes: Flag = False
    """Do not ask before a robot moves."""


@dataclass(frozen=True)
class Live(LiveConfig):
    """Targets that come while the robot moves."""

    address: str = "tcp://127.0.0.1:5555"
    """zmq: where to listen; 127.0.0.1 is heard from this machine alone."""
    topic: str = "rt/joint_trajectory_controller/joint_trajectory"
    """dds: of trajectory_msgs/JointTrajectory, as ROS 2 has it on the bus."""
    states: str = "rt/joint_states"
    """dds: of sensor_msgs/JointState, to which states go."""


@dataclass(frozen=True)
class Request(Asked):
    """The same, with a model between targets and commands, and live targets."""

    targets: Literal["zmq", "dds", "stdin"] | None = None
    """Instead of a motion, targets that come while the robot moves: JSON over ZeroMQ or in lines on standard input, or
    ROS 2's JointTrajectory over DDS. docs/deploy.md has the messages."""
    live: Live = Live()
    """Live targets: where they come from, and which are taken."""
    payload_mass: float | None = None
    """kg in each hand; with a model, None estimates it."""
    model: Path | None = None
    """Run or artifact folder: compensate with it, so that the robot gets to where the motion says."""
    compensation: CompensatorConfig = CompensatorConfig()  # noqa: RUF009
    """How commands are found, with a model."""
    unit_id: str = ""
    """Which unit this is, with a model; what gaponet calibrate found out about it is used."""
    extrapolate: Flag = False
    """Take payloads, with a model, and servo gains that its training data do not hold."""
    dry_run: Flag = False
    """Connect, read and compute, send nothing, and say what would be sent."""


@writes("recordings")
def run(
    motion: str | None = None,
    out: Path | None = None,
    asked: Annotated[Request, tyro.conf.arg(name="")] = Request(),
    json: Json = False,
) -> None:
    """Play a motion, or live targets, on a robot. Any key, Ctrl-C or SIGTERM stops it within one control period.

    Args:
        motion: A motion's name (gaponet collect lists the forms) or a motion file (.txt, .csv, .npz); or --targets.
        out: Folder for the recording: MOTION.parquet for gaponet import, .json, .cycles.npz.
        asked: Robot, loop and model.
    """
    screen = Out(json)
    if asked.dry_run and out:
        raise UsageError("a dry run moves nothing, so there is nothing to record; leave out --out")
    recording, played, _ = perform(screen, motion, asked)
    if out:
        screen.say(f"written: {recording.save(out, played.name if played else 'live').with_suffix('.*')}")
    screen.result(recording.summary() | tracking(recording))
    if recording.fault:
        sys.exit(3)


def perform(
    screen: Out, motion_name: str | None, asked: Request, seed: int = 0
) -> tuple[Recording, Motion | None, RobotSpec]:
    """Make everything, ask, run, and say how it went; live targets are no motion. The seed is of a virtual robot."""
    from gaponet.deploy.clock import MonotonicClock, SimulatedClock
    from gaponet.deploy.controller import Controller
    from gaponet.deploy.drivers.dry import DryRun
    from gaponet.deploy.targets.policy import play

    if (motion_name is None) == (asked.targets is None):
        raise UsageError("give either --motion, what to play, or --targets, where targets come from while it moves")
    spec = asked_robot(asked)
    fast = asked.reach.fast and asked.driver == "virtual"
    if fast and asked.targets:
        raise UsageError("live targets come in real time; leave out --fast")
    clock = SimulatedClock() if fast else MonotonicClock()
    motion = None if motion_name is None else find_motion(motion_name, asked, spec)
    driver, facts = make_driver(asked, spec, clock, seed)
    if motion:
        _require_commanded(motion, spec, driver)
    if asked.dry_run:
        driver = DryRun(driver)
    compensator, calibrated = _compensator(screen, asked, spec, asked.unit_id or facts.get("unit_id", ""))
    live = None if motion else listen(screen, asked, spec, driver, clock)
    controller = Controller(
        driver, spec, asked.control, asked.safety, compensator, clock, payload_mass=asked.payload_mass,
        on_event=lambda event: _tell(screen, event), motion=motion.name if motion else "live",
        payload_side=asked.payload_side, model=str(asked.model) if asked.model else None, calibrated=calibrated,
        on_connect=lambda met: compensator.require_gains(met.joint_names, met.kp, met.kd) if compensator else None,
        **facts | ({"targets": live.counts} if live else {}),
    )  # fmt: skip
    try:
        if asked.driver != "virtual" and not asked.yes and not asked.dry_run:
            what = f"for {motion.duration:.1f} s ({motion.name})" if motion else f"as {asked.targets} says"
            _ask(screen, driver, what)
        recording = controller.run(play(motion, controller.dt) if motion else live, keys=True)  # type: ignore[arg-type]
    finally:
        if live:
            events = controller.recording.events
            live.close(events[-1].text if events else "nothing was commanded")
    if asked.dry_run:
        _report_dry(screen, recording, controller)
    else:
        _report(screen, recording)
    return recording, motion, spec


def listen(screen: Out, asked: Request, robot: RobotSpec, driver: Driver, clock: Clock) -> LiveTargets:
    """The wire of live targets, open."""
    from gaponet.deploy.targets.live import LiveTargets

    wire: Wire
    live = asked.live
    if asked.targets == "zmq":
        from gaponet.deploy.targets.zeromq import ZeroMQWire

        wire = ZeroMQWire(live.address)
    elif asked.targets == "dds":
        from gaponet.deploy.targets.ros2 import ROS2Wire

        wire = ROS2Wire(asked.reach.domain, asked.reach.interface, live.topic, live.states)
    else:
        from gaponet.deploy.targets.pipe import PipeWire

        wire = PipeWire()
    screen.say(f"targets are expected on {wire.address}")
    return LiveTargets(wire, robot, driver.commanded, clock, 1.0 / asked.control.rate, asked.safety.speed, live)


def asked_robot(asked: Request) -> RobotSpec:
    """The robot that the model's run keeps, which one named must be; without a model the one named, or the driver's."""
    from gaponet.errors import ModelError
    from gaponet.robot import load_robot
    from gaponet.robot_folder import keeps_robot, kept_robot
    from gaponet.sim.kept import require_kept

    place = None if asked.model is None else asked.model.parent if asked.model.name == "model" else asked.model
    if place is not None and asked.robot is not None:
        return require_kept(place, load_robot(asked.robot), ModelError, "leave --robot out")
    if place is not None and keeps_robot(place):
        return kept_robot(place, "")
    return load_robot(asked.robot or ("so101" if asked.driver == "so101" else "h1_2"))


def _require_commanded(motion: Motion, robot: RobotSpec, driver: Driver) -> None:
    """Refuse a motion that moves joints which the driver does not command."""
    left = [name for name in motion.moved(robot) if name not in driver.commanded]
    if left:
        raise UsageError(
            f"motion '{motion.name}' moves {', '.join(left)}, which {driver.address} does not command; it commands "
            f"{', '.join(driver.commanded)}. Choose another motion, or let the driver command more joints"
        )


def find_motion(name: str, asked: Request, robot: RobotSpec) -> Motion:
    """A motion file, fitted to the robot's limits, or a motion of the library."""
    from gaponet.motion.feasible import MAX_PAYLOAD
    from gaponet.motion.files import SUFFIXES, read_motion
    from gaponet.motion.library import Library

    payload = asked.payload_mass or 0.0
    is_file = name.endswith(SUFFIXES)
    heaviest = max(payload, 0.0 if is_file else MAX_PAYLOAD) if asked.max_payload is None else asked.max_payload
    if heaviest < payload:
        raise UsageError(f"--max-payload {heaviest:g} is less than --payload-mass {payload:g}")
    library = Library(robot, max_payload=heaviest)
    if not is_file:
        return library.make(name)
    motion = read_motion(name, robot)
    library.add(motion)
    return library.make(motion.name)


def make_driver(asked: Request, robot: RobotSpec, clock: Any, seed: int) -> tuple[Driver, dict[str, Any]]:
    """The driver, and what is known about the unit behind it."""
    from gaponet.deploy.drivers.open import open_driver

    reach = asked.reach
    if asked.driver == "unitree":
        options: dict[str, Any] = {n: getattr(reach, n) for n in ("topic", "joints", "domain", "interface")}
        return open_driver("unitree", robot, silent=asked.dry_run, **options), {}
    if asked.driver == "so101":
        return open_driver("so101", robot, port=reach.port, calibration=reach.calibration), {}
    from gaponet.deploy.drivers.virtual import VirtualDriver
    from gaponet.virtual.fleet import load_fleet

    name = f"virtual-{reach.unit}" if reach.unit.isdigit() else reach.unit
    side = asked.payload_side
    physics = load_fleet(reach.fleet, robot).unit(name)
    payload = (asked.payload_mass or 0.0, side)
    return VirtualDriver(robot, physics, clock, payload, name, seed=seed), {"unit_id": name, "fleet": reach.fleet}


def tracking(recording: Recording) -> dict[str, Any]:
    """Mean |measured − asked| by joint over the run, rad: measured one period after the command, as everywhere."""
    rows = [r for r in recording.rows if r.phase == "run" and r.target is not None]
    if len(rows) < 2:
        return {}
    at = [recording.joint_names.index(name) for name in recording.commanded]
    target, qpos = np.array([r.target for r in rows])[:, at], np.array([r.state.qpos for r in rows])[:, at]
    error = np.abs(qpos[1:] - target[:-1])
    moved = np.ptp(target, axis=0) > 1e-6
    joints = {n: float(e) for n, e, m in zip(recording.commanded, error.mean(axis=0), moved, strict=True) if m}
    return {"tracking_error_rad": {"mean": float(np.mean(list(joints.values()))) if joints else None} | joints}


def _compensator(screen: Out, asked: Request, robot: RobotSpec, unit: str) -> tuple[Any, str | None]:
    """The compensator of a model, or None; and the unit whose calibration it uses."""
    if asked.model is None:
        return None, None
    from gaponet.deploy.compensator import Compensator
    from gaponet.model import calibration
    from gaponet.model.artifact import GapModel

    model = GapModel.load(asked.model)
    known = calibration.load(model.path.parent if model.path.name == "model" else model.path, model.weights_hash())
    if unit in known:
        screen.say(f"commands are found with the calibration of unit {unit}")
    elif known:
        units = ", ".join(known)
        screen.say(f"the run holds calibrations of {units}, none of which is used: --unit-id says which unit this is")
    compensator = Compensator(
        robot, model, asked.compensation, 1.0 / asked.control.rate, payload_side=asked.payload_side,
        extrapolate=asked.extrapolate, calibration=known.get(unit),
    )  # fmt: skip
    if asked.payload_mass is not None:
        model.require_payload(asked.payload_mass, asked.extrapolate)  # before anything is opened
    return compensator, unit if unit in known else None


def _ask(screen: Out, driver: Driver, what: str) -> None:
    screen.say(
        f" will move {len(driver.commanded)} joints {what}. Is the space around it free, and a hand on its own "
        "emergency stop? Enter to start, Ctrl-C to leave.",
        driver.address,
    )
    if not sys.stdin.isatty():
        raise UsageError("no terminal to ask on; say --yes if the space around the robot is free")
    sys.stdin.readline()


def _tell(screen: Out, event: Event) -> None:
    colour = "bold red" if event.kind not in ("", "end") else "cyan"
    screen.say(f"  {event.kind and event.kind + ': '}{event.text}", f"{event.phase:>9}", colour)


def _report(screen: Out, recording: Recording) -> None:
    facts = recording.summary()
    three = lambda what: ", ".join(f"{facts[what][q]:.2f}" for q in ("p50", "p99", "max"))  # noqa: E731
    error = tracking(recording).get("tracking_error_rad", {}).get("mean")
    label = "VIRTUAL " if recording.virtual else ""
    screen.table(f"{label}{recording.robot} at {facts['rate_hz']:g} Hz", ["what", "value"], [
        ["periods, of which never started", f"{facts['periods']}, {recording.missed}"],
        ["late, ms: p50, p99, max", three("late_ms")],
        ["age of state, ms: p50, p99, max", three("state_age_ms")],
        ["tracking error, mrad", "–" if error is None else f"{1e3 * error:.2f}"],
    ])  # fmt: skip


def _report_dry(screen: Out, recording: Recording, controller: Controller) -> None:
    from gaponet.deploy.drivers.dry import would_send

    sent = would_send(recording, controller.limits)
    screen.table("Dry run: nothing was sent. These commands would have been, to a robot that follows at once",
                 ["joint", "from, rad", "to, rad", "fastest, rad/s", "torque asked, N·m"], [
        [joint, *(f"{value:.3f}" for value in values.values())] for joint, values in sent.items()
    ])  # fmt: skip
    recording.meta["would_send"] = sent
