"""`gaponet run`: play a motion, or live targets, on a robot, real or virtual, with or without a model."""

from __future__ import annotations

import sys
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import numpy as np
import tyro

from gaponet.base.errors import UsageError
from gaponet.cli.options import Flag, Json
from gaponet.cli.out import Out, writes
from gaponet.deploy.compensator import CompensatorConfig
from gaponet.hw.control.consent import require_consent, require_terminal
from gaponet.hw.control.phases import ControlConfig
from gaponet.hw.control.safety import SafetyConfig
from gaponet.hw.drivers.open import driver_names
from gaponet.hw.targets.live import LiveConfig

if TYPE_CHECKING:
    from gaponet.hw.control.clock import Clock
    from gaponet.hw.control.controller import Controller
    from gaponet.hw.control.driver import Driver
    from gaponet.hw.control.plan import Plan
    from gaponet.hw.control.recording import Event, Recording
    from gaponet.hw.targets.live import LiveTargets, Transport
    from gaponet.robot.spec import RobotSpec
    from gaponet.sysid.motion.feasible import Feasibility
    from gaponet.sysid.motion.motion import Motion

DRIVERS = ("virtual", *driver_names())
DriverName = Annotated[str, tyro.constructors.PrimitiveConstructorSpec(
    nargs=1, metavar=f"{{{','.join(DRIVERS)}}}", choices=DRIVERS, instance_from_str=lambda words: words[0],
    is_instance=lambda value: isinstance(value, str), str_from_instance=lambda name: [name],
)]  # fmt: skip


@dataclass(frozen=True)
class Connection:
    """How the robot is connected."""

    topic: Literal["arm_sdk", "lowcmd"] = "arm_sdk"
    """unitree: arm_sdk leaves legs and balance to the robot's own controller; lowcmd requires that the robot hangs."""
    joints: Literal["arms", "upper_body", "all"] = "arms"
    """unitree: joints that are commanded. The legs are commanded with all on lowcmd only."""
    domain: int = 0
    """unitree, and targets over DDS: DDS domain."""
    interface: str = "lo"
    """unitree, and targets over DDS: network interface to the robot; lo for a virtual one on this machine."""
    port: str = "/dev/ttyACM0"
    """so101: serial port."""
    calibration: Path | None = None
    """so101: calibration file of lerobot-calibrate for this arm. It must agree with the calibration in the servos.
    Default: the calibration in the servos."""
    unit: str = "4"
    """virtual: number or name of the robot in the fleet."""
    fleet: str = "hard"
    """virtual: hard, easy, shifted, unnamed, or a .toml file."""
    hangs: Flag = False
    """unitree: state that the robot hangs. lowcmd switches off all motors that are not commanded, legs too."""
    fast: Flag = False
    """virtual: run as fast as this machine can instead of in real time."""

    @property
    def unit_name(self) -> str:
        """Name in the fleet: a number stands for virtual-NUMBER."""
        return f"virtual-{self.unit}" if self.unit.isdigit() else self.unit


@dataclass(frozen=True)
class ControlArgs:
    """Options about robot and control loop. The docstrings are the command-line help."""

    driver: DriverName = "virtual"
    """virtual (a simulated robot in this process), unitree (DDS: a real H1-2 or gaponet virtual serve), so101 (serial),
    or the driver of an installed extension."""
    robot: str | None = None
    """Robot name or folder; it may be identified. Default: the robot of the model's run; without a model h1_2, or so101
    for the so101 driver."""
    limits_from: str | None = None
    """Robot folder whose gains, joint ranges, effort limits and collision shapes are used on hardware instead of the
    packaged robot. Check its values first. The driver of an extension requires it. Identified values come from --robot
    or --model."""
    payload_side: str = "both"
    """Hand that carries the payload: both, or the side of one payload mount."""
    max_payload: float | None = None
    """Payload for which the motion must be feasible, kg in each hand. Default: payload_mass, or 0. To play one library
    motion with several payloads, give the heaviest."""
    connection: tyro.conf.OmitArgPrefixes[Connection] = Connection()
    """Connection to the robot."""
    control: tyro.conf.OmitArgPrefixes[ControlConfig] = ControlConfig()  # noqa: RUF009
    """Timing."""
    safety: SafetyConfig = SafetyConfig()  # noqa: RUF009
    """Limits and checks of states."""
    plane: float | None = None
    """Height of the floor or table in the robot's frame, m. Default: the height in its collision.toml."""
    unchecked: Flag = False
    """Skip the check for collisions of the robot with itself and with the floor or table."""
    yes: Flag = False
    """Move a real robot without asking first."""


@dataclass(frozen=True)
class Live(LiveConfig):
    """Targets that arrive while the robot moves."""

    address: str = "tcp://127.0.0.1:5555"
    """zmq: address to listen on. 127.0.0.1 accepts programs of this machine only."""
    topic: str = "rt/joint_trajectory_controller/joint_trajectory"
    """dds: topic of trajectory_msgs/JointTrajectory, by its name on the bus of ROS 2."""
    states: str = "rt/joint_states"
    """dds: topic of sensor_msgs/JointState on which states are published."""


@dataclass(frozen=True)
class RunArgs(ControlArgs):
    """Options of a run: those of ControlArgs, compensation and live targets."""

    targets: Literal["zmq", "dds", "stdin"] | None = None
    """Follow targets that arrive while the robot moves, instead of a motion: JSON over ZeroMQ, JSON lines on standard
    input, or ROS 2's JointTrajectory over DDS. docs/deploy.md describes the messages."""
    live: Live = Live()
    """Source and limits of live targets."""
    payload_mass: float | None = None
    """Payload, kg in each hand. Compensation estimates it if it is not given."""
    compensate: Flag = False
    """Correct the commands so that the robot follows the motion: feed-forward by --robot, best a folder of gaponet
    identify. Velocity and acceleration of a motion are fed forward; those of live targets only with
    --compensation.dynamics."""
    model: Path | None = None
    """Run or artifact folder whose network corrects the commands in addition."""
    compensation: CompensatorConfig = CompensatorConfig()  # noqa: RUF009
    """Settings of the compensation."""
    unit_id: str = ""
    """Name of this robot. With a model, the adaptation that gaponet adapt stored for this name is used."""
    extrapolate: Flag = False
    """Accept payloads (with a model) and servo gains outside those of the recorded data."""
    dry_run: Flag = False
    """Connect, read and compute, but send nothing; print the commands instead."""


@writes("recordings")
def run(
    motion: str | None = None,
    out: Path | None = None,
    args: Annotated[RunArgs, tyro.conf.arg(name="")] = RunArgs(),
    json: Json = False,
) -> None:
    """Play a motion or live targets on a robot; any key stops it.

    Ctrl-C, Ctrl-Z and SIGTERM also stop it, within one control period. A real robot moves only after you typed yes.

    Args:
        motion: Motion name (gaponet collect lists the forms) or motion file (.txt, .csv, .npz). Or give --targets.
        out: Folder for the recording: MOTION.parquet (gaponet import reads it), MOTION.json and MOTION.cycles.npy.
        args: Robot, control loop and model.
    """
    screen = Out(json)
    if args.dry_run and out:
        raise UsageError("a dry run moves nothing, so there is nothing to record; leave out --out")
    recording, played, _ = perform(screen, motion, args, folder=out)
    if out:
        screen.say(
            f"written: {recording.save(out, played.name if played else 'live').with_suffix('.*')}"
        )
    screen.result(recording.summary() | tracking(recording))
    if recording.fault or (out and recording.rows.error):
        sys.exit(3)


def perform(
    screen: Out, motion_name: str | None, args: RunArgs, seed: int = 0, folder: Path | None = None
) -> tuple[Recording, Motion | None, RobotSpec]:
    """Prepare, ask for consent, run and report. Live targets are no motion. The seed is for a virtual robot."""
    from gaponet.hw.control.clock import MonotonicClock, SimulatedClock
    from gaponet.hw.control.controller import Controller
    from gaponet.hw.control.hardware import (
        hardware_robot,
        reference_robot,
        require_plausible,
        robot_hash,
    )
    from gaponet.hw.control.plan import Planner
    from gaponet.hw.drivers.dry import DryRun

    if (motion_name is None) == (args.targets is None):
        raise UsageError(
            "give either --motion, what to play, or --targets, where targets come from while it moves"
        )
    if args.compensation != CompensatorConfig() and not (args.compensate or args.model):
        raise UsageError(
            "settings of the compensation are given, and it is off; add --compensate or --model"
        )
    if args.live != Live() and args.targets is None:
        raise UsageError("settings of live targets are given, and this is a motion; leave them out")
    spec = identified = resolve_robot(args)
    if args.driver != "virtual":
        spec = hardware_robot(identified, reference_robot(args.driver, args.limits_from))
    fast = args.connection.fast and args.driver == "virtual"
    if fast and args.targets:
        raise UsageError("live targets come in real time; leave out --fast")
    clock = SimulatedClock() if fast else MonotonicClock()
    needs_consent = args.driver != "virtual" and not args.yes and not args.dry_run
    if needs_consent:
        require_terminal()
    _require_shapes(screen, args, spec)
    _require_hung(args)
    motion, limits = find_motion(motion_name, args, spec)
    driver, facts = make_driver(args, spec, clock, seed)
    if motion:
        _require_commanded(motion, spec, driver)
    planner = Planner(spec, driver.commanded, args.control, args.safety, limits)
    if args.dry_run:
        driver = DryRun(driver)
    compensator, adapted = _compensator(
        screen, args, identified, args.unit_id or facts.get("unit_id", "")
    )
    if compensator and args.driver != "virtual":
        require_plausible(compensator.robot)
    live = None if motion else listen(screen, args, spec, driver, clock)

    def plan_and_ask(robot: Driver) -> None:
        """Plan, show and ask when the robot has answered and before anything is commanded."""
        if compensator:
            compensator.require_gains(robot.joint_names, robot.kp, robot.kd)
        if motion:
            plan = planner.plan(motion, robot.read().qpos)
            if compensator:
                stated = args.payload_mass
                masses = compensator.masses[[0, -1]].tolist() if stated is None else [stated]
                plan = planner.judge_commands(plan, compensator, tuple(sorted(set(masses))))
            controller.plan = plan
            _show(screen, plan, spec, robot, limits.max_payload)
        if needs_consent:
            how = f"as {args.targets} says" if motion is None else "as planned"
            require_consent(
                f"{robot.address} will move {how}; {len(robot.commanded)} joints are commanded."
            )

    controller = Controller(
        driver, spec, config=args.control, safety=args.safety, compensator=compensator, clock=clock,
        payload_mass=args.payload_mass, folder=folder, on_event=lambda event: _show_event(screen, event),
        on_connect=plan_and_ask, planner=None if args.unchecked else planner, unchecked=args.unchecked,
        metadata={
            "motion": motion.name if motion else "live", "payload_side": args.payload_side,
            "model": str(args.model) if args.model else None,
            "compensated_by": str(compensator.robot.folder) if compensator else None, "adapted": adapted,
            "limits_from": str(spec.folder), "robot_hash": robot_hash(spec),
        } | facts | ({"targets": live.counts} if live else {}),
    )  # fmt: skip
    try:
        recording = controller.run(live, keys=True)
    finally:
        if live:
            events = controller.recording.events
            live.close(events[-1].text if events else "nothing was commanded")
    if args.dry_run:
        _show_dry_run(screen, recording, controller)
    else:
        _show_summary(screen, recording)
    return recording, controller.plan.motion if controller.plan else None, identified


def listen(
    screen: Out, args: RunArgs, robot: RobotSpec, driver: Driver, clock: Clock
) -> LiveTargets:
    """Open the transport of live targets."""
    from gaponet.hw.targets.live import LiveTargets

    transport: Transport
    live = args.live
    if args.targets == "zmq":
        from gaponet.hw.targets.zeromq import ZeroMQTransport

        transport = ZeroMQTransport(live.address)
    elif args.targets == "dds":
        from gaponet.hw.targets.ros2 import ROS2Transport

        transport = ROS2Transport(
            args.connection.domain, args.connection.interface, live.topic, live.states
        )
    else:
        from gaponet.hw.targets.pipe import PipeTransport

        transport = PipeTransport()
    screen.say(f"targets are expected on {transport.address}")
    return LiveTargets(
        transport, robot, driver.commanded, clock, 1.0 / args.control.rate, args.safety.speed, live
    )


def resolve_robot(args: RunArgs) -> RobotSpec:
    """Return the robot of the model's run, which --robot must equal; without a model --robot, or the driver's."""
    from gaponet.base.errors import ModelError
    from gaponet.hw.control.hardware import ROBOT_OF_DRIVER
    from gaponet.robot.folder import has_stored_robot, load_stored_robot
    from gaponet.robot.spec import load_robot
    from gaponet.sim.model import require_stored_robot

    place = (
        None
        if args.model is None
        else args.model.parent
        if args.model.name == "model"
        else args.model
    )
    if place is not None and args.robot is not None:
        return require_stored_robot(place, load_robot(args.robot), ModelError, "leave --robot out")
    if place is not None and has_stored_robot(place):
        return load_stored_robot(place, "")
    own = ROBOT_OF_DRIVER | {"virtual": "h1_2"}
    return load_robot(args.robot or own.get(args.driver) or args.limits_from or "h1_2")


def _require_commanded(motion: Motion, robot: RobotSpec, driver: Driver) -> None:
    """Refuse a motion that moves joints which the driver does not command."""
    left = [name for name in motion.moved(robot) if name not in driver.commanded]
    if left:
        raise UsageError(
            f"motion '{motion.name}' moves {', '.join(left)}, which {driver.address} does not command; it commands "
            f"{', '.join(driver.commanded)}. Choose another motion, or let the driver command more joints"
        )


def _require_shapes(screen: Out, args: RunArgs, robot: RobotSpec) -> None:
    """Refuse a real robot without collision shapes."""
    if args.unchecked or (robot.folder / "collision.toml").is_file():
        return
    text = (
        f"{robot.name} has no collision.toml, so nobody would look whether it meets itself or what it stands on. Write "
        f"one into {robot.folder} (docs/new-robot.md has the fields), or say --unchecked"
    )
    if args.driver != "virtual":
        raise UsageError(text)
    screen.say(f"unchecked: {text}")


def _require_hung(args: RunArgs) -> None:
    """Refuse lowcmd unless the user states that the robot hangs."""
    if (
        args.driver != "unitree"
        or args.connection.topic != "lowcmd"
        or args.connection.hangs
        or args.dry_run
    ):
        return
    words = {
        "arms": "legs and torso",
        "upper_body": "the legs",
        "all": "at the end of the run all motors",
    }
    off = words[args.connection.joints]
    if args.yes:
        raise UsageError(
            f"with --topic lowcmd {off} go off, and a robot that stands falls; say --hangs if it hangs"
        )
    text = f"With --topic lowcmd {off} go off: a robot that stands falls."
    require_consent(text, "Does it hang?", "it hangs", "--hangs")


def find_motion(
    name: str | None, args: RunArgs, robot: RobotSpec
) -> tuple[Motion | None, Feasibility]:
    """Return a motion from a file or the library, or None for live targets; and the limits that it must keep."""
    from gaponet.sysid.motion.files import SUFFIXES, read_motion
    from gaponet.sysid.motion.library import Library

    payload = args.payload_mass or 0.0
    heaviest = payload if args.max_payload is None else args.max_payload
    if heaviest < payload:
        raise UsageError(f"--max-payload {heaviest:g} is less than --payload-mass {payload:g}")
    library = Library(robot, max_payload=heaviest, height=args.plane, unchecked=args.unchecked)
    if name is None:
        return None, library.limits
    return read_motion(name, robot) if name.endswith(SUFFIXES) else library.make(
        name
    ), library.limits


def make_driver(
    args: RunArgs, robot: RobotSpec, clock: Any, seed: int
) -> tuple[Driver, dict[str, Any]]:
    """Return the driver, and facts about a virtual robot for the recording."""
    from gaponet.hw.drivers.open import open_driver, supported_options

    connection = args.connection
    if args.driver != "virtual":
        options = supported_options(args.driver, vars(connection))
        if args.driver == "unitree":
            options["silent"] = args.dry_run
        return open_driver(args.driver, robot, **options), {}
    from gaponet.testing.fleet import load_fleet
    from gaponet.testing.virtual_driver import VirtualDriver

    robot = robot.nominal or robot  # what identification found is the unit's, and that has its own
    name, side = connection.unit_name, args.payload_side
    physics = load_fleet(connection.fleet, robot).unit(name)
    payload = (args.payload_mass or 0.0, side)
    return VirtualDriver(robot, physics, clock, payload, name, seed=seed), {
        "unit_id": name,
        "fleet": connection.fleet,
    }


def tracking(recording: Recording) -> dict[str, Any]:
    """Return the mean |measured − target| of each joint over the run, rad; measured one period after the command."""
    rows = recording.phase_rows("run")
    if len(rows) < 2:
        return {}
    at = [recording.joint_names.index(name) for name in recording.commanded]
    target, qpos = rows["target"][:, at], rows["qpos"][:, at]
    error = np.abs(qpos[1:] - target[:-1])
    moved = np.ptp(target, axis=0) > 1e-6
    joints = {
        n: float(e)
        for n, e, m in zip(recording.commanded, error.mean(axis=0), moved, strict=True)
        if m
    }
    return {
        "tracking_error_rad": {"mean": float(np.mean(list(joints.values()))) if joints else None}
        | joints
    }


def _compensator(screen: Out, args: RunArgs, robot: RobotSpec, unit: str) -> tuple[Any, str | None]:
    """Return the compensator, or None; and the unit whose adaptation it uses."""
    if args.model is None and not args.compensate:
        return None, None
    from gaponet.deploy.compensator import Compensator

    config, dt = args.compensation, 1.0 / args.control.rate
    if args.model is None:
        config = replace(config, dynamics=config.dynamics or args.targets is None)
        made = Compensator(
            robot, None, config, dt, None, args.payload_side, extrapolate=args.extrapolate
        )
        if args.payload_mass is not None:
            made.require_payload(args.payload_mass)  # before anything is opened
        if robot.nominal is None:
            screen.say(f"{robot.folder} is not identified: the feed-forward is the nominal robot's")
        return made, None
    from gaponet.nn.adaptation import Adaptation
    from gaponet.nn.artifact import GapModel

    model = GapModel.load(args.model)
    folder = model.path.parent if model.path.name == "model" else model.path
    known = Adaptation.load(folder, model.weights_hash())
    if unit in known:
        screen.say(f"commands are found with the adaptation of unit {unit}")
    elif known:
        units = ", ".join(known)
        screen.say(
            f"the run holds adaptations of {units}, none of which is used: --unit-id says which unit this is"
        )
    compensator = Compensator(
        robot, model, config, dt, payload_side=args.payload_side,
        extrapolate=args.extrapolate, adaptation=known.get(unit),
    )  # fmt: skip
    if args.payload_mass is not None:
        compensator.require_payload(args.payload_mass)
    return compensator, unit if unit in known else None


def _show(screen: Out, plan: Plan, robot: RobotSpec, driver: Driver, heaviest: float) -> None:
    """Print the plan: what moves from where to where, what is held, clearances, and how it ends."""
    from gaponet.hw.control.plan import NO_MOVEMENT

    rows = plan.rows
    moves = [
        n
        for n, span in zip(robot.joint_names, np.ptp(rows, axis=0), strict=True)
        if span > NO_MOVEMENT
    ]
    held = [n for n in driver.commanded if n not in moves]
    assert plan.motion
    title = f"Plan: {plan.motion.name}, {plan.duration:.1f} s, of which {plan.approach.duration:.1f} to where it begins"
    screen.table(title, ["moves", "found, rad", "begins", "lowest", "highest", "ends"], [
        [joint, *(f"{x:.2f}" for x in (plan.start[j], plan.motion.ctrl[0, j], rows[:, j].min(), rows[:, j].max(),
                                       rows[-1, j]))]
        for joint, j in zip(moves, robot.index(moves), strict=True)
    ])  # fmt: skip
    around = len(plan.approach.points) - 2
    how = {
        "hand_over": "handed over to the robot's own controller",
        "hold": "held",
        "damp": "damped, then let go",
    }
    load = (
        f"with up to {heaviest:g} kg in each hand"
        if heaviest
        else "with nothing in the hands (--payload-mass)"
    )
    back = "goes back to where it was found and is " if plan.retreat else "is "
    for text in (
        f"held where found: {', '.join(held)}" if held else "",
        f"the motion is {plan.changed}, to keep within limits" if plan.changed else "",
        f"it goes around what is in between ({around} stops)" if around else "",
        "nobody looks whether it meets itself or what it stands on" if not np.isfinite(plan.clearance)
        else f"nearest to each other: {plan.nearest}, {100 * plan.clearance:.1f} cm",
        f"commands lead their targets by at most {plan.correction:.2f} rad ({plan.corrected_joint}); nearest to each "
        f"other: {100 * plan.command_clearance:.1f} cm" if plan.corrected_joint else "",
        f"the robot: {driver.facts['source']}" if "source" in driver.facts else "",
        f"limits and collision shapes: {robot.folder}",
        f"most torque, {load}: {plan.joint}, {plan.torque:.2f} of what may be used",
        f"at the end it {back}{how[driver.at_end]}; a stop {driver.at_stop} it",
    ):  # fmt: skip
        if text:
            screen.say(f"  {text}")


def _show_event(screen: Out, event: Event) -> None:
    colour = "bold red" if event.kind not in ("", "end") else "cyan"
    screen.say(f"  {event.kind and event.kind + ': '}{event.text}", f"{event.phase:>9}", colour)


def _show_summary(screen: Out, recording: Recording) -> None:
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


def _show_dry_run(screen: Out, recording: Recording, controller: Controller) -> None:
    from gaponet.hw.drivers.dry import summarize_commands

    sent = summarize_commands(recording, controller.limits)
    screen.table("Dry run: nothing was sent. These commands would have been, to a robot that follows at once",
                 ["joint", "from, rad", "to, rad", "fastest, rad/s", "torque asked, N·m"], [
        [joint, *(f"{value:.3f}" for value in values.values())] for joint, values in sent.items()
    ])  # fmt: skip
    recording.meta["would_send"] = sent
