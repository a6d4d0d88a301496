"""Motions and live targets on a robot, real or virtual, with limits, plan, consent and watchdog.

`execute` is one run: it resolves the robot, makes driver, compensator and live targets, plans,
asks, and runs the controller. `run_robot` is its public form. gaponet run and gaponet record call
the same.
"""

from __future__ import annotations

from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from gaponet.api.opening import Place, as_robot
from gaponet.api.results import RunResult
from gaponet.api.run_consent import Consent, Permission
from gaponet.api.run_options import LiveOptions, RunOptions
from gaponet.api.run_report import RunReporter, StderrReporter, describe_plan
from gaponet.base.arrays import Array
from gaponet.base.errors import ModelError, UsageError
from gaponet.deploy.compensator import Compensator, CompensatorConfig
from gaponet.hw.control.clock import Clock, MonotonicClock, SimulatedClock
from gaponet.hw.control.controller import Controller
from gaponet.hw.control.driver import Driver
from gaponet.hw.control.hardware import (
    ROBOT_OF_DRIVER,
    hardware_robot,
    reference_robot,
    require_plausible,
    robot_hash,
)
from gaponet.hw.control.plan import Plan, Planner
from gaponet.hw.control.recording import Recording, require_file_name
from gaponet.hw.drivers.dry import DryRun, summarize_commands
from gaponet.hw.drivers.open import driver_names, open_driver, supported_options
from gaponet.hw.targets.live import LiveTargets
from gaponet.hw.targets.message import Transport
from gaponet.motion.files import SUFFIXES, read_motion
from gaponet.motion.library import Library
from gaponet.motion.motion import Motion
from gaponet.nn.packaged_networks import named_folder
from gaponet.robot.folder import has_stored_robot, load_stored_robot
from gaponet.robot.spec import RobotSpec, load_robot
from gaponet.sim.model import require_stored_robot

if TYPE_CHECKING:
    from gaponet.motion.feasible import Feasibility
    from gaponet.nn.artifact import GapModel

VIRTUAL = "virtual"
ROBOTS = ROBOT_OF_DRIVER | {VIRTUAL: "h1_2"}  # driver → robot, where none is given
DEFAULT_ROBOT = "h1_2"


def known_drivers() -> tuple[str, ...]:
    """Return the names of all drivers: virtual, those of the package and of installed
    extensions.
    """
    return (VIRTUAL, *driver_names())


@dataclass(frozen=True)
class RunRequest:
    """What is played, on which robot, and how."""

    robot: RobotSpec | Place | None = None
    """Robot, its name or folder; it may be identified. None: that of the model's run, or the
    driver's."""
    motion: Motion | Place | None = None
    """Motion, its name in the library, or its file (.txt, .csv, .npz). None: live targets,
    options.targets."""
    driver: str = VIRTUAL
    """virtual, unitree, so101, or the driver of an installed extension."""
    compensate: bool = False
    """Correct the commands by what was identified. A model in the options corrects too."""
    options: RunOptions = RunOptions()  # noqa: RUF009
    """All other settings."""

    @property
    def dt(self) -> float:
        """Control period, s."""
        return 1.0 / self.options.control.rate

    @property
    def is_virtual(self) -> bool:
        """True for a virtual robot in this process."""
        return self.driver == VIRTUAL

    def require_consistent(self) -> None:
        """Refuse options that contradict each other or would do nothing.

        Raises:
            UsageError: Always with what to do instead.
        """
        options = self.options
        if self.driver not in known_drivers():
            raise UsageError(f"no driver '{self.driver}'; there are {', '.join(known_drivers())}")
        if (self.motion is None) == (options.targets is None):
            raise UsageError(
                "give either --motion, what to play, or --targets, where targets come from while "
                "it moves"
            )
        self._require_one_correction()
        if options.live != LiveOptions() and options.targets is None:
            raise UsageError(
                "settings of live targets are given, and this is a motion; leave them out"
            )
        if options.connection.fast and self.is_virtual and options.targets:
            raise UsageError("live targets come in real time; leave out --fast")
        if options.dry_run and options.out:
            raise UsageError(
                "a dry run moves nothing, so there is nothing to record; leave out --out"
            )

    def _require_one_correction(self) -> None:
        """Refuse two ways to correct the commands, and settings of a correction that is off."""
        options = self.options
        corrects = self.compensate or options.model is not None
        follows = options.follow is not None
        if follows and corrects:
            raise UsageError(
                "--follow already corrects the commands; leave out --compensate and --model"
            )
        if options.compensation != CompensatorConfig() and not (corrects or follows):
            raise UsageError(
                "settings of the compensation are given, and it is off; add --compensate, --model "
                "or --follow"
            )


def run_robot(
    robot: RobotSpec | Place | None = None,
    *,
    motion: Motion | Place | None = None,
    driver: str = VIRTUAL,
    compensate: bool = False,
    options: RunOptions = RunOptions(),  # noqa: B008
    consent: Consent | None = None,
    report: RunReporter | None = None,
) -> RunResult:
    """Play a motion, or follow live targets, on a robot: what gaponet run does.

    The gains, ranges, effort limits and collision shapes are those of the package's robot (or
    options.limits_from); a folder that differs is refused. The whole run is planned and shown
    before the first command. A real robot moves only after consent. A watchdog in another process
    damps the robot if this one dies or hangs. Any key on the terminal, Ctrl-C included, stops it.

    Args:
        robot: Robot, its name or folder; it may be identified. Default: the robot of the model's
            run; without a model that of options.limits_from for the driver of an extension, so101
            for so101, otherwise h1_2.
        motion: Motion, its name in the library, or its file (.txt, .csv, .npz). Leave it out with
            options.targets.
        driver: virtual (a simulated robot in this process), unitree (DDS), so101 (serial), or the
            driver of an installed extension.
        compensate: Correct the commands so that the robot follows the motion, by what was
            identified.
        options: All other settings.
        consent: Called with a statement of what will happen, after the plan was shown. The robot
            moves only if it returns True. With topic lowcmd it is first asked whether the robot
            hangs, before there is a plan; Connection(hangs=True) replaces that question. Default:
            the person at the terminal types the answers. RunOptions(yes=True) moves the robot
            without the question after the plan.
        report: Shows plan, notes and phases; default on standard error.

    Returns:
        Recording, plan and tracking errors. After a fault `result.fault` says which; the robot has
        then damped.

    Raises:
        UsageError: Nobody consented or could be asked, options contradict each other, or no clear
            way exists; nothing was commanded.
        RobotError: The folder differs from the known robot, or its identified values are
            implausible.
        DriverError: The robot does not answer.
        UnsavedError: The robot ran, and the recording could not be saved.
    """
    request = RunRequest(robot, motion, driver, compensate, options)
    result = execute(request, report or StderrReporter(), consent)
    if options.out is None:
        return result
    return replace(result, file=result.recording.save(options.out, recording_name(result.plan)))


def execute(request: RunRequest, report: RunReporter, consent: Consent | None = None) -> RunResult:
    """Prepare, ask for consent and run.

    Everything that can be refused without the robot is refused before the driver connects. The
    periods are written to options.out as they come. They are saved there only if an error ends the
    run; otherwise the caller does it.
    """
    options = request.options
    permission = Permission(request.driver, options, consent)
    request.require_consistent()
    identified = resolve_robot(request)  # corrects the commands
    robot = with_known_limits(request, identified)  # bounds and checks them
    permission.require_someone_to_ask()
    require_shapes(request, robot, report)
    permission.require_hung()
    motion, feasibility = find_motion(request, robot)
    if motion is not None and options.out is not None:
        require_file_name(motion.name, "motion")
    clock = SimulatedClock() if request.is_virtual and options.connection.fast else MonotonicClock()
    driver, unit = make_driver(request, robot, clock)
    if motion is not None:
        require_commanded(motion, robot, driver)
    planner = Planner(robot, driver.commanded, options.control, options.safety, feasibility)
    compensation = make_compensation(request, identified, unit, report)
    live = None
    if motion is None:
        live = listen(request, robot, driver, clock)
        live.observe = compensation.observe
        report.note(f"targets are expected on {live.transport.address}")

    def plan_and_ask(connected: Driver) -> None:
        """Plan, show and ask: the robot has answered, and nothing was commanded.

        `controller`, which is made below, calls this once it is connected, and then plays the plan
        that it is given here.
        """
        compensation.require_gains(connected)
        if motion is not None:
            plan = planner.plan(motion, connected.read().qpos)
            plan = compensation.judge(planner, plan, options.payload_mass)
            report.plan(describe_plan(plan, robot, connected, feasibility.max_payload))
            controller.plan = plan
        how = "as planned" if motion is not None else f"as {options.targets} says"
        permission.require_motion(connected, how)
        controller.recording.meta["consent"] = permission.source

    facts = facts_of(request, robot, motion, unit, compensation)
    if live is not None:
        facts["targets"] = live.counts
    controller = Controller(
        driver,
        robot,
        config=options.control,
        safety=options.safety,
        compensator=compensation.compensator,
        clock=clock,
        payload_mass=options.payload_mass,
        payload_side=options.payload_side,
        folder=options.out,
        on_event=report.event,
        on_connect=plan_and_ask,
        planner=None if options.unchecked else planner,
        unchecked=options.unchecked,
        metadata=facts,
    )
    try:
        recording = run_controller(controller, live)
    except BaseException:
        save_after_error(request, controller)
        raise
    compensation.note_failures(recording, report)
    return RunResult(
        recording=recording,
        robot=identified,
        plan=controller.plan,
        would_send=would_send(request, recording, controller),
    )


# ---- robot and motion


def resolve_robot(request: RunRequest) -> RobotSpec:
    """Return the robot of the model's run, which a given robot must equal; without a model the
    given or the driver's.

    Raises:
        ModelError: The given robot is not that of the run.
    """
    options = request.options
    if options.model is not None:
        model = named_folder(options.model)
        run = model.parent if model.name == "model" else model
        if request.robot is not None:
            return require_stored_robot(
                run, as_robot(request.robot), ModelError, "leave --robot out"
            )
        if has_stored_robot(run):
            return load_stored_robot(run, "")
    if request.robot is not None:
        return as_robot(request.robot)
    return load_robot(ROBOTS.get(request.driver) or options.limits_from or DEFAULT_ROBOT)


def with_known_limits(request: RunRequest, identified: RobotSpec) -> RobotSpec:
    """Return the robot with the limits of the reference robot; a virtual one keeps its own.

    Raises:
        RobotError: The robot differs from the reference, or its identified values are implausible.
        UsageError: The driver is an extension's, and options.limits_from is not given.
    """
    if request.is_virtual:
        return identified
    reference = reference_robot(request.driver, request.options.limits_from)
    return hardware_robot(identified, reference)


def require_shapes(request: RunRequest, robot: RobotSpec, report: RunReporter) -> None:
    """Refuse a real robot without collision shapes; note a virtual one.

    Raises:
        UsageError: There is no collision.toml, and options.unchecked is not given.
    """
    if request.options.unchecked or (robot.folder / "collision.toml").is_file():
        return
    text = (
        f"{robot.name} has no collision.toml, so nobody would look whether it meets itself or "
        f"what it stands on. Write one into {robot.folder} (docs/new-robot.md has the fields), or "
        "say --unchecked"
    )
    if not request.is_virtual:
        raise UsageError(text)
    report.note(f"unchecked: {text}")


def find_motion(request: RunRequest, robot: RobotSpec) -> tuple[Motion | None, Feasibility]:
    """Return the motion, or None for live targets; and the limits that it must keep.

    Raises:
        UsageError: max_payload is less than payload_mass, or the library has no such motion.
        LogError: The file cannot be read.
    """
    options = request.options
    payload = options.payload_mass or 0.0
    heaviest = payload if options.max_payload is None else options.max_payload
    if heaviest < payload:
        raise UsageError(f"--max-payload {heaviest:g} is less than --payload-mass {payload:g}")
    library = Library(
        robot, max_payload=heaviest, height=options.plane, unchecked=options.unchecked
    )
    motion = request.motion
    if motion is None or isinstance(motion, Motion):
        return motion, library.limits
    if str(motion).endswith(SUFFIXES):
        return read_motion(motion, robot), library.limits
    return library.make(str(motion)), library.limits


def require_commanded(motion: Motion, robot: RobotSpec, driver: Driver) -> None:
    """Refuse a motion that moves joints which the driver does not command."""
    left = [name for name in motion.moved(robot) if name not in driver.commanded]
    if left:
        raise UsageError(
            f"motion '{motion.name}' moves {', '.join(left)}, which {driver.address} does not "
            f"command; it commands {', '.join(driver.commanded)}. Choose another motion, or let "
            "the driver command more joints"
        )


# ---- driver and live targets


@dataclass(frozen=True)
class Unit:
    """Which robot of its type is moved, as far as it is known; a virtual one knows its fleet."""

    name: str = ""
    fleet: str = ""

    def facts(self) -> dict[str, str]:
        """Return what the recording stores of a virtual unit."""
        return {"unit_id": self.name, "fleet": self.fleet} if self.fleet else {}


def make_driver(request: RunRequest, robot: RobotSpec, clock: Clock) -> tuple[Driver, Unit]:
    """Return the driver, not yet connected, and the unit that it moves.

    Raises:
        RobotError: Gains or ranges are beyond those of the reference robot.
        UsageError: There is no such driver or virtual unit.
    """
    options = request.options
    connection = options.connection
    if request.is_virtual:
        driver, unit = make_virtual_driver(request, robot, clock)
    else:
        supported = supported_options(request.driver, vars(connection))
        if request.driver == "unitree":
            supported["silent"] = options.dry_run
        driver = open_driver(request.driver, robot, **supported)
        unit = Unit(options.unit_id)
    if options.dry_run:
        driver = DryRun(driver)
    return driver, unit


def make_virtual_driver(request: RunRequest, robot: RobotSpec, clock: Clock) -> tuple[Driver, Unit]:
    """Return the driver of a virtual robot in this process, and its unit."""
    from gaponet.virtual.fleet import load_fleet
    from gaponet.virtual.virtual_driver import VirtualDriver

    options = request.options
    connection = options.connection
    # what was identified is a unit's, and this unit has its own
    nominal = robot.before_identification
    name = connection.unit_name
    physics = load_fleet(connection.fleet, nominal).unit(name)
    payload = (options.payload_mass or 0.0, options.payload_side)
    driver = VirtualDriver(nominal, physics, clock, payload, name, seed=options.seed)
    return driver, Unit(name, connection.fleet)


def listen(request: RunRequest, robot: RobotSpec, driver: Driver, clock: Clock) -> LiveTargets:
    """Open the transport of live targets."""
    options = request.options
    return LiveTargets(
        open_transport(options),
        robot,
        driver.commanded,
        clock,
        request.dt,
        options.safety.speed,
        options.live,
    )


def open_transport(options: RunOptions) -> Transport:
    """Open the source of live targets that the options name."""
    live = options.live
    if options.targets == "zmq":
        from gaponet.hw.targets.zeromq import ZeroMQTransport

        return ZeroMQTransport(live.address)
    if options.targets == "dds":
        from gaponet.hw.targets.ros2 import ROS2Transport

        connection = options.connection
        return ROS2Transport(connection.domain, connection.interface, live.topic, live.states)
    from gaponet.hw.targets.pipe import PipeTransport

    return PipeTransport()


# ---- compensation


@dataclass(frozen=True)
class Compensation:
    """The compensator of a run, or none.

    Attributes:
        adapted: Unit whose adaptation it uses.
    """

    compensator: Compensator | None = None
    adapted: str | None = None

    def observe(self, qpos: Array) -> tuple[Array, Array] | None:
        """Return what a policy is to see while the nominal simulator is followed, else None; (n)
        rad and rad/s.
        """
        compensator = self.compensator
        if compensator is None or compensator.follower is None or not compensator.started:
            return None
        return compensator.observe(qpos)

    def require_gains(self, driver: Driver) -> None:
        """Refuse servo gains other than those of the recordings."""
        if self.compensator is not None:
            self.compensator.require_gains(driver.joint_names, driver.kp, driver.kd)

    def judge(self, planner: Planner, plan: Plan, payload_mass: float | None) -> Plan:
        """Return the plan with the compensator's commands checked, for the stated payload or the
        extreme ones, kg.

        Raises:
            UsageError: A command is not a number or comes too near to something, or the network
                fails.
        """
        compensator = self.compensator
        if compensator is None:
            return plan
        masses = (payload_mass,) if payload_mass is not None else _extremes(compensator)
        plan = planner.judge_commands(plan, compensator, masses)
        if compensator.refused_answers:
            raise UsageError(
                f"{compensator.refused_answers} answers of the network are not finite on the "
                "planned motion; choose another motion, train the model again, or leave out --model"
            )
        return plan

    def note_failures(self, recording: Recording, report: RunReporter) -> None:
        """Store and report which joints were at their limits, and how often the network failed."""
        if self.compensator is None:
            return
        limited = self.compensator.limited_shares
        recording.meta["limited"] = limited
        if limited:
            shares = ", ".join(f"{joint} {share:.0%}" for joint, share in limited.items())
            report.note(f"at a limit of torque or correction, in share of the time: {shares}")
        if self.compensator.model is None:
            return
        refused = self.compensator.refused_answers
        recording.meta["refused_answers"] = refused
        if refused:
            report.note(
                f"{refused} answers of the network were not finite; there the feed-forward alone "
                "was sent"
            )


def _extremes(compensator: Compensator) -> tuple[float, ...]:
    """Return the smallest and the largest payload that a compensator can carry, kg."""
    masses = compensator.payload.masses
    return tuple(sorted({float(masses[0]), float(masses[-1])}))


def make_compensation(
    request: RunRequest, robot: RobotSpec, unit: Unit, report: RunReporter
) -> Compensation:
    """Make the compensator that the request asks for; everything is checked before anything is
    opened.

    Raises:
        ModelError: The model does not fit the robot, the rate or the payload.
        RobotError: The identified values of its robot are implausible for hardware.
    """
    options = request.options
    if options.model is not None:
        compensation = _with_model(request, robot, unit, report)
    elif options.follow is not None:
        compensation = _following(request, robot)
    elif request.compensate:
        compensation = _feedforward(request, robot, report)
    else:
        return Compensation()
    compensator = compensation.compensator
    assert compensator is not None
    if options.payload_mass is not None:
        compensator.require_payload(options.payload_mass)
    if options.dry_run:
        # Its states follow the commands at once, as if nothing weighed on the robot.
        compensator.payload.compared = False
    if not request.is_virtual:
        require_plausible(compensator.robot)
    return compensation


def _feedforward(request: RunRequest, robot: RobotSpec, report: RunReporter) -> Compensation:
    """Return the compensation by the robot alone.

    Velocity and acceleration of live targets are not fed forward.
    """
    options = request.options
    config = options.compensation
    if options.targets is None:
        config = replace(config, dynamics=True)
    compensator = Compensator(
        robot,
        config=config,
        dt=request.dt,
        payload_side=options.payload_side,
        extrapolate=options.extrapolate,
    )
    if not robot.is_identified:
        report.note(f"{robot.folder} is not identified: the feed-forward is the nominal robot's")
    return Compensation(compensator)


def _following(request: RunRequest, robot: RobotSpec) -> Compensation:
    """Return the compensation under which the robot moves as its nominal simulator does."""
    options = request.options
    compensator = Compensator(
        robot,
        config=options.compensation,
        dt=request.dt,
        payload_side=options.payload_side,
        extrapolate=options.extrapolate,
        follow=options.follow,
    )
    return Compensation(compensator)


def _with_model(
    request: RunRequest, robot: RobotSpec, unit: Unit, report: RunReporter
) -> Compensation:
    """Return the compensation by a network, with the adaptation of the unit if its run has one."""
    from gaponet.nn.adaptation import Adaptation
    from gaponet.nn.artifact import GapModel

    options = request.options
    assert options.model is not None
    model = GapModel.load(options.model)
    known = Adaptation.load(_run_of(model), model.weights_hash())
    name = options.unit_id or unit.name
    if name in known:
        report.note(f"commands are found with the adaptation of unit {name}")
    elif known:
        report.note(
            f"the run holds adaptations of {', '.join(known)}, none of which is used: --unit-id "
            "says which unit this is"
        )
    compensator = Compensator(
        robot,
        model,
        config=options.compensation,
        dt=request.dt,
        payload_side=options.payload_side,
        extrapolate=options.extrapolate,
        adaptation=known.get(name),
    )
    return Compensation(compensator, name if name in known else None)


def _run_of(model: GapModel) -> Path:
    return model.path.parent if model.path.name == "model" else model.path


# ---- the run and its record


def facts_of(
    request: RunRequest,
    robot: RobotSpec,
    motion: Motion | None,
    unit: Unit,
    compensation: Compensation,
) -> dict[str, Any]:
    """Return what the recording stores of the request."""
    options = request.options
    compensator = compensation.compensator
    facts = {
        "motion": motion.name if motion is not None else "live",
        "payload_side": options.payload_side,
        "model": str(options.model) if options.model else None,
        "compensated_by": str(compensator.robot.folder) if compensator else None,
        "follow": options.follow,
        "adapted": compensation.adapted,
        "limits_from": str(robot.folder),
        "robot_hash": robot_hash(robot),
    }
    return facts | unit.facts()


def run_controller(controller: Controller, live: LiveTargets | None) -> Recording:
    """Run a controller, and tell the sender of live targets why it ended."""
    try:
        return controller.run(live, keys=True)
    finally:
        if live is not None:
            live.close(controller.recording.ending or "nothing was commanded")


def recording_name(plan: Plan | None) -> str:
    """Return the name of a recording: that of the planned motion, or of live targets."""
    if plan is None or plan.motion is None:
        return "live"
    return plan.motion.name


def save_after_error(request: RunRequest, controller: Controller) -> None:
    """Save the recording of a run that an error ended, so that it says why.

    A run that was refused has no events, and nothing to save. If the recording cannot be saved
    either, the error itself is the more important one: its caller raises it.
    """
    folder = request.options.out
    recording = controller.recording
    if folder is None or not recording.events:
        return
    with suppress(Exception):
        recording.save(folder, recording_name(controller.plan))


def would_send(
    request: RunRequest, recording: Recording, controller: Controller
) -> dict[str, dict[str, float]]:
    """Return the commands of a dry run by joint, and store them; empty for a run that sends."""
    if not request.options.dry_run:
        return {}
    commands = summarize_commands(recording, controller.limits)
    recording.meta["would_send"] = commands
    return commands
