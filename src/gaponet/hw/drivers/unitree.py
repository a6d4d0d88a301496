"""UnitreeDriver: the H1-2 over DDS. States from rt/lowstate, commands to rt/arm_sdk or rt/lowcmd.

Motor numbers, topics, the weight of rt/arm_sdk in q of motor 27, mode 1 = enabled, mode_machine
echoed from the state, and mode_pr 0 for pitch/roll ankles are from Unitree's public SDK examples
(h1_2_arm_sdk_dds_example.cpp, h1_2_low_level_example.py). Tested against a virtual robot and
against programs on Unitree's IDL and DDS version only. Not checked, for want of a robot:

- that `tick` counts milliseconds: it is measured when connecting, and arrival times are used where
  it does not
- how the robot behaves when commands cease
- the sign and scale of tau_est
- that slots without a motor stay zero, and that motorstate is 0 without an error

The arm_sdk example numbers the wrists yaw, pitch, roll, the low-level one roll, pitch, yaw (17 to
19 and 24 to 26). This driver follows the latter, as the MJCF does; check it with one small wrist
motion first.
"""

from __future__ import annotations

import contextlib
import time
from typing import Any, Literal

from gaponet.base.arrays import Array
from gaponet.base.errors import UsageError
from gaponet.hw.control.driver import DriverError, EndAction, Fault, State
from gaponet.hw.control.hardware import accepted_folder, range_violation, require_known_limits
from gaponet.hw.drivers.unitree_commands import CommandMessages
from gaponet.hw.drivers.unitree_link import STATES_TOPIC, UnitreeLink
from gaponet.hw.drivers.unitree_states import (
    MOTOR_NAMES,
    StateReceiver,
    listen,
    motor_numbers,
    require_h1_2,
)
from gaponet.robot.spec import RobotSpec

Topic = Literal["arm_sdk", "lowcmd"]
Joints = Literal["arms", "upper_body", "all"]

FIRST_MOTOR = {"arms": 13, "upper_body": 12, "all": 0}  # of the commanded ones
MAX_SILENCE_S = 0.5  # without a state after which nobody knows the robot's state


class UnitreeDriver:
    """A `Driver` for the 27 motors of an H1-2.

    Legs are commanded only with joints="all" on rt/lowcmd.
    """

    noisy = True
    reads_back = False
    at_stop = "damps"
    qpos_range = None

    def __init__(
        self,
        robot: RobotSpec,
        topic: Topic = "arm_sdk",
        joints: Joints = "arms",
        domain: int = 0,
        interface: str = "lo",
        sole: bool = True,
        silent: bool = False,
    ) -> None:
        """
        Args:
            robot: The H1-2; its kp and kd before identification are sent with every command.
            topic: arm_sdk leaves legs and balance to the robot; lowcmd switches off all motors that
                are not commanded and is for a robot that hangs.
            joints: arms, upper_body (with torso), or all.
            domain: DDS domain; 0 on a robot.
            interface: Network interface to the robot; lo for a virtual one on this machine.
            sole: Refuse to connect if another participant publishes the topic, or if two robots
                publish their states; report a participant that sends commands later.
            silent: Only listen: publish nothing, and accept other publishers of the topic.

        Raises:
            UsageError: The robot is no H1-2, or the topic does not take the legs.
            RobotError: Gains or ranges exceed those of the known robot, or effort limits those of
                the motors.
        """
        if set(robot.joint_names) != set(MOTOR_NAMES):
            raise UsageError(
                f"the unitree driver is for the 27 joints of h1_2; {robot.name} has others"
            )
        if joints == "all" and topic != "lowcmd":
            raise UsageError(
                "rt/arm_sdk does not take the legs; use joints arms or upper_body, or topic lowcmd"
            )
        require_known_limits(robot, "h1_2")
        first = FIRST_MOTOR[joints]
        motors = zip(robot.joint_names, motor_numbers(robot), strict=True)
        self.robot = robot
        self.joint_names = robot.joint_names
        self.commanded = tuple(name for name, motor in motors if motor >= first)
        self.facts: dict[str, Any] = {}
        self.at_end: EndAction = "hand_over" if topic == "arm_sdk" else "damp"
        self.address = f"unitree dds domain {domain}"
        self._joints = joints
        self._at = robot.index(self.commanded)
        self._link = UnitreeLink(topic, domain, interface, sole, silent)
        self._states = StateReceiver(motor_numbers(robot))
        self._commands = CommandMessages(robot, self.commanded, topic == "arm_sdk")

    @property
    def virtual(self) -> bool:
        """True if the robot says that it is our virtual one; False before it was found."""
        return self._states.virtual

    @property
    def kp(self) -> Array:
        """Stiffness that is sent with positions, (n) N·m/rad."""
        return self.robot.before_identification.servo.kp

    @property
    def kd(self) -> Array:
        """Damping that is sent with positions, (n) N·m·s/rad."""
        return self.robot.before_identification.servo.kd

    @property
    def received(self) -> int:
        """Intact messages since the robot was found."""
        return self._states.received

    def connect(self) -> None:
        """Find the robot, learn its tick and machine mode, and refuse if another participant
        commands it.
        """
        link = self._link
        source = link.open()
        first = listen(source, f"domain {link.domain}, interface {link.interface}")
        link.require_one_robot(source)
        require_h1_2(first.messages, link.interface)
        self._states.begin(source, first)
        self._commands.set_machine(self._states.machine)
        self.facts = {
            "mode_machine": self._states.machine,
            "topic": link.topic,
            "interface": link.interface,
            "source": f"{STATES_TOPIC} on {link.interface}, of {source.identity}",
        }

    def read(self) -> State:
        """Return the newest state with a right checksum.

        Its time is the robot's, mapped to ours. From the moment at which another program commands
        the robot on our topic, each state has the fault `source`.
        """
        if commander := self._link.other_commander():
            topic = self._link.topic
            text = f"another program commands the robot on rt/{topic}: {commander}"
            self._states.report(Fault("source", text))
        return self._states.read()

    def write(self, ctrl: Array, weight: float = 1.0) -> None:
        """Send targets with the robot's gains; the weight is our share of control on rt/arm_sdk.

        There the torso is held where it was at the first command, if it is not commanded.

        Raises:
            DriverError: A target is outside its joint's range, or DDS refuses the message.
        """
        if problem := range_violation(self.robot, ctrl, self._at):
            raise DriverError(f"{problem}; it was not sent")
        if self._link.can_send:
            self._link.send(self._commands.positions(ctrl, weight, self._states.newest))

    def verify(self) -> None:
        """Do nothing: nothing can be read back. The controller checks that the joints follow."""

    def damp(self, weight: float = 1.0, share: float = 0.0) -> None:
        """Send stiffness 0 and damping gains."""
        state = self._newest_state()
        if self._link.can_send:
            self._link.send(self._commands.damping(weight, state))

    def _newest_state(self) -> State | None:
        """Return the newest state, or the last one if the bus gives none; None before `connect`.

        The watchdog reads nothing until it damps. The state from its connection may be minutes old:
        a torso that is held there, with stiffness, would jump back to it.
        """
        if self._states.is_open:
            with contextlib.suppress(DriverError):
                self.read()
        return self._states.newest

    def confirm(self) -> str:
        """Check that the robot still sends states; it reports nothing else of its damping."""
        state = self.read()
        age = time.monotonic() - state.time
        if age > MAX_SILENCE_S:
            raise DriverError(f"nothing was heard of the robot for {age:.1f} s")
        return "damped and let go"

    def close(self, hold: bool = False) -> None:
        """Leave the bus; after damping the last message has weight 0: the arms are the robot's own
        again (arm_sdk).
        """
        if not self._link.is_open:
            return
        with contextlib.suppress(DriverError):
            if not hold:
                self.damp(0.0)
        self._link.close()
        self._states.end()

    def publishers(self) -> dict[str, list[str]]:
        """Return the other publishers on the bus: topic → programs.

        The robot's topics are always included.
        """
        return self._link.publishers()

    def watchdog(self) -> dict[str, object] | None:
        """Return the options of a second participant: connected from the start, and silent until
        it damps.
        """
        return {
            "kind": "unitree",
            "robot": str(self.robot.folder.resolve()),
            "topic": self._link.topic,
            "joints": self._joints,
            "domain": self._link.domain,
            "interface": self._link.interface,
            "sole": False,
            "limits_from": accepted_folder(self.robot),
        }
