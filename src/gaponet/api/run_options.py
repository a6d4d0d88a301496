"""Options of a run on a robot. `run_robot` takes them, and the command line reads the same classes.

The docstring of a field is its command-line help.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from gaponet.deploy.compensator import CompensatorConfig
from gaponet.hw.control.phases import ControlConfig as ControlConfig
from gaponet.hw.control.safety import SafetyConfig
from gaponet.hw.targets.live import LiveConfig


@dataclass(frozen=True)
class Connection:
    """How the robot is connected."""

    topic: Literal["arm_sdk", "lowcmd"] = "arm_sdk"
    """unitree: arm_sdk leaves legs and balance to the robot's own controller; lowcmd requires that
    the robot hangs."""
    joints: Literal["arms", "upper_body", "all"] = "arms"
    """unitree: joints that are commanded. all includes the legs and needs --topic lowcmd."""
    domain: int = 0
    """unitree, and targets over DDS: DDS domain."""
    interface: str = "lo"
    """unitree, and targets over DDS: network interface to the robot; lo for a virtual one on this
    machine."""
    port: str = "/dev/ttyACM0"
    """so101: serial port."""
    calibration: Path | None = None
    """so101: calibration file of lerobot-calibrate for this arm. It must agree with the calibration
    in the servos. Default: the calibration in the servos."""
    unit: str = "4"
    """virtual: number or name of the robot in the fleet."""
    fleet: str = "hard"
    """virtual: fleet of the robot: hard, easy, shifted, unnamed, firm, or a .toml file."""
    hangs: bool = False
    """unitree: state that the robot hangs, instead of answering the question. --topic lowcmd
    switches off all motors that are not commanded, those of the legs too."""
    fast: bool = False
    """virtual: run as fast as this machine can instead of in real time."""

    @property
    def unit_name(self) -> str:
        """Name in the fleet: a number stands for virtual-NUMBER."""
        return f"virtual-{self.unit}" if self.unit.isdigit() else self.unit


@dataclass(frozen=True)
class LiveOptions(LiveConfig):
    """Targets that arrive while the robot moves."""

    address: str = "tcp://127.0.0.1:5555"
    """zmq: address to listen on. 127.0.0.1 accepts programs of this machine only."""
    topic: str = "rt/joint_trajectory_controller/joint_trajectory"
    """dds: topic of trajectory_msgs/JointTrajectory, by its name on the bus of ROS 2."""
    states: str = "rt/joint_states"
    """dds: topic of sensor_msgs/JointState on which states are published."""


@dataclass(frozen=True)
class ControlOptions:
    """Robot, limits and control loop."""

    limits_from: str | None = None
    """Robot folder whose gains, joint ranges, effort limits and collision shapes are used for a
    real robot, instead of those of the packaged robot. Check its values first. The driver of an
    extension needs this option. Identified values come from --robot or --model."""
    payload_side: str = "both"
    """Hand that carries the payload: both, or the side of one payload mount."""
    max_payload: float | None = None
    """Heaviest payload with which the motion must be possible, kg in each hand. Default:
    --payload-mass, or 0. To play one library motion with several payloads, give the heaviest of
    them each time."""
    connection: Connection = Connection()
    """Connection to the robot."""
    control: ControlConfig = ControlConfig()  # noqa: RUF009
    """Timing."""
    safety: SafetyConfig = SafetyConfig()  # noqa: RUF009
    """Limits and checks of states."""
    plane: float | None = None
    """Height of the floor or table in the robot's frame, m. Default: the height in its
    collision.toml."""
    unchecked: bool = False
    """Skip the check for collisions of the robot with itself and with the floor or table."""
    yes: bool = False
    """Move a real robot without asking first."""


@dataclass(frozen=True)
class RunOptions(ControlOptions):
    """Settings of a run beyond robot, motion and driver."""

    targets: Literal["zmq", "dds", "stdin"] | None = None
    """Follow targets that arrive while the robot moves, instead of a motion: JSON over ZeroMQ, JSON
    lines on standard input, or ROS 2's JointTrajectory over DDS. docs/deploy.md describes the
    messages."""
    live: LiveOptions = LiveOptions()
    """Source and limits of live targets."""
    payload_mass: float | None = None
    """Payload, kg in each hand. Compensation estimates it if it is not given."""
    model: Path | None = None
    """Run folder of gaponet train, folder of an exported network, or name of a network of the
    package. The network corrects the commands in addition."""
    follow: Literal["nominal"] | None = None
    """nominal: command the robot so that it moves as its nominal simulator does under the targets,
    for a policy that was trained in an ordinary simulator. --robot must be identified. Not together
    with --compensate or --model."""
    compensation: CompensatorConfig = CompensatorConfig()  # noqa: RUF009
    """Settings of the compensation."""
    unit_id: str = ""
    """Name of this robot. With a model, the adaptation that gaponet adapt stored for this name is
    used."""
    extrapolate: bool = False
    """Accept payloads (with a model) and servo gains outside those of the recorded data."""
    dry_run: bool = False
    """Connect, read and compute, but send nothing; print the commands instead."""
    out: Path | None = None
    """Folder for the recording: MOTION.parquet (gaponet import reads it), MOTION.json and
    MOTION.cycles.npy."""
    seed: int = 0
    """virtual: seed of the noise of the robot."""
