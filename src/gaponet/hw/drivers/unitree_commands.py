"""Commands of an H1-2 as LowCmd messages: positions, damping, and a torso that is held."""

from __future__ import annotations

import numpy as np

from gaponet.base.arrays import Array
from gaponet.hw.control.driver import State
from gaponet.hw.control.safety import damping_gains
from gaponet.hw.drivers import hg
from gaponet.hw.drivers.unitree_states import motor_numbers
from gaponet.robot.spec import PACKAGE_FOLDER, RobotSpec, load_robot

WEIGHT_MOTOR = 27
# of damping: 8 N·m·s/rad at the shoulder, where a straight arm then sinks at about 1 rad/s
KD_FACTOR = 4.0


class CommandMessages:
    """Messages to some joints of an H1-2; all arrays have its n joints, in its order.

    On rt/arm_sdk the waist is ours with weight 1, whether a motion moves it or not. So, as in
    Unitree's own example, a torso that is not commanded is held where it was at the first command.
    """

    def __init__(self, robot: RobotSpec, commanded: tuple[str, ...], shares_control: bool) -> None:
        """
        Args:
            robot: Its nominal gains are sent with positions. Damping has kd and effort limits of
                the package's H1-2: the brake must not depend on a folder, where they may be 0.
            commanded: Joints that are commanded.
            shares_control: The messages are for rt/arm_sdk, where a weight shares control between
                us and the robot's own controller.
        """
        held = []
        if shares_control and "torso_joint" not in commanded:
            held.append("torso_joint")
        self._servo = robot.before_identification.servo
        packaged = load_robot(PACKAGE_FOLDER / "h1_2")
        order = packaged.index(robot.joint_names)
        self._brake_kd = packaged.servo.kd[order]  # (n) N·m·s/rad
        self._brake_effort = packaged.servo.effort_limit[order]  # (n) N·m
        self._motors = motor_numbers(robot)
        self._commanded = robot.index(commanded)
        self._held = robot.index(held)
        self._held_qpos: Array | None = None  # of the held joints at the first command, rad
        self._last_ctrl: Array | None = None  # last position command, rad
        self._shares_control = shares_control
        self._message = hg.LowCmd.new()

    def set_machine(self, machine: int) -> None:
        """Echo the robot's mode_machine in all messages."""
        hg.LowCmd.view(self._message, "mode_machine")[:] = machine

    def positions(self, ctrl: Array, weight: float, state: State | None) -> Array:
        """Return the message that sends targets, rad, with the robot's gains."""
        self._last_ctrl = np.array(ctrl, float)
        kp = self._servo.kp
        kd = self._servo.kd
        return self._filled(ctrl, kp, kd, kd, weight, state)

    def damping(self, weight: float, state: State | None) -> Array:
        """Return the message that damps: stiffness 0, and damping gains, at most those that the
        effort limits allow at the present speed.

        The position in the message has no stiffness, but a robot may blend it with its own by the
        weight. So it is the last command, not a reading, which may be what is wrong. The watchdog
        has sent no command: its position is the one that it reads when it begins to damp. A torso
        that is only held stays held until the weight is 0: a trunk must not swing while the arms
        brake.
        """
        qpos = np.zeros(len(self._motors)) if state is None else np.nan_to_num(state.qpos)
        qvel = np.zeros(len(self._motors)) if state is None else state.qvel
        if self._last_ctrl is None:
            self._last_ctrl = qpos
        kd = damping_gains(KD_FACTOR * self._brake_kd, qvel, self._brake_effort)
        kp = np.zeros_like(kd)
        return self._filled(self._last_ctrl, kp, kd, self._brake_kd, weight, state)

    def _filled(
        self,
        ctrl: Array,
        kp: Array,
        kd: Array,
        held_kd: Array,
        weight: float,
        state: State | None,
    ) -> Array:
        """Return the message with targets and gains of the commanded joints, and of those that
        are held.

        Args:
            ctrl, kp, kd: Of the commanded joints; (n) rad, N·m/rad and N·m·s/rad.
            held_kd: Of the held joints, (n) N·m·s/rad; their stiffness is the robot's.
            weight: Our share of control.
            state: The newest one; its position is held from the first message on.
        """
        if self._held_qpos is None:
            self._held_qpos = (ctrl if state is None else state.qpos)[self._held]
        commanded = self._commanded
        held = self._held
        held_kp = np.where(np.isfinite(self._held_qpos), self._servo.kp[held], 0.0)
        for name, values, held_values in (
            ("mode", np.ones(len(ctrl)), np.ones(len(held))),
            ("q", ctrl, np.nan_to_num(self._held_qpos)),
            ("kp", kp, held_kp),
            ("kd", kd, held_kd[held]),
        ):
            column = np.zeros(hg.MOTORS)
            column[self._motors[commanded]] = values[commanded]
            column[self._motors[held]] = held_values
            if name == "q" and self._shares_control:
                column[WEIGHT_MOTOR] = weight
            hg.LowCmd.set_motors(self._message, name, column)
        hg.LowCmd.seal(self._message)
        return self._message
