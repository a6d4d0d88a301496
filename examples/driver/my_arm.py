"""A driver for gaponet, and a simulated arm at the other end of its bus. Copy this folder, and put
your bus where this one sends JSON in UDP messages.

    pip install -e .         # gaponet then knows the driver my_arm
    python my_arm.py so101   # a simulated arm with the joints of an SO-101; it prints PORT
    gaponet run --driver my_arm --port PORT --limits-from so101 --motion sweep-wrist_flex

For your robot, name its robot folder in place of so101. With --dry-run nothing is sent.

The bus speaks of angles in degrees by joint, so the driver converts them:

    {"listen": true}                          asks for states; moves nothing
    {"go": {"shoulder": 10.0}}                targets
    {"damp": 0.5}                             brake, with this share of the torque
    {"q": {…}, "dq": {…}, "damped": false}    a state, 200 times a second

gaponet.hw.control.driver.Driver says what each member must do.
"""

from __future__ import annotations

import contextlib
import json
import socket
import sys
import threading
import time
from typing import Any

import numpy as np

import gaponet as gp
from gaponet.hw.control.driver import DriverError, EndAction, Fault, State

CONNECT_TIMEOUT_S = 2.0
STATE_PERIOD_S = 0.005
LARGEST_MESSAGE = 65_536  # bytes


class MyArm:
    """A `Driver`: all joints are commanded."""

    noisy = True
    reads_back = False
    virtual = False
    at_end: EndAction = "hold"
    at_stop = "damps"
    qpos_range = None

    def __init__(self, robot: gp.RobotSpec, port: str = "127.0.0.1:9000") -> None:
        """port: Host and port of the arm; `gaponet run` passes its --port."""
        servo = robot.before_identification.servo
        self.address = f"my arm at {port}"
        self.joint_names = robot.joint_names
        self.commanded = robot.joint_names
        self.kp = servo.kp
        self.kd = servo.kd
        self.facts: dict[str, Any] = {"source": self.address}
        self._robot = robot
        self._port = port
        self._socket: socket.socket | None = None
        self._newest: State | None = None
        self._refused = 0  # messages
        self._is_damped = False  # as the arm says

    def connect(self) -> None:
        """Ask for states and wait for the first one.

        Raises:
            DriverError: No state comes.
        """
        host, _, number = self._port.rpartition(":")
        bus = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        bus.connect((host, int(number)))
        self._socket = bus
        self._newest = None
        self._send({"listen": True})
        threading.Thread(target=self._receive, args=(bus,), daemon=True).start()
        deadline = time.monotonic() + CONNECT_TIMEOUT_S
        while self._newest is None:
            if time.monotonic() > deadline:
                raise DriverError(f"{self.address}: no state within {CONNECT_TIMEOUT_S:g} s")
            time.sleep(0.001)

    def _receive(self, bus: socket.socket) -> None:
        """Note each state when it arrives. It runs in a thread of its own: a message that waited
        in the socket would look younger than it is.
        """
        while True:
            try:
                data = bus.recv(LARGEST_MESSAGE)
            except OSError:  # closed
                return
            now = time.monotonic()
            try:
                self._note(json.loads(data), now)
            except (ValueError, KeyError, TypeError):
                self._refused += 1

    def _note(self, message: dict[str, Any], now: float) -> None:
        qpos = np.deg2rad([message["q"][joint] for joint in self.joint_names])
        qvel = np.deg2rad([message["dq"][joint] for joint in self.joint_names])
        tau = np.zeros(len(qpos))  # not measured
        temperature = np.full(len(qpos), np.nan)  # not measured
        self._is_damped = bool(message["damped"])
        self._newest = State(now, qpos, qvel, tau, temperature, refused=self._refused)

    def read(self) -> State:
        """Return the newest state."""
        if self._newest is None:
            raise DriverError(f"{self.address}: not connected")
        return self._newest

    def write(self, ctrl: np.ndarray, weight: float = 1.0) -> None:
        """Send targets, (n) rad; this arm cannot share control, and `weight` is ignored."""
        degrees = np.rad2deg(ctrl)
        self._send({"go": dict(zip(self.joint_names, degrees.tolist(), strict=True))})

    def verify(self) -> Fault | None:
        """Return None: nothing can be read back. The controller checks that the joints follow."""
        return None

    def damp(self, weight: float = 1.0, share: float = 0.0) -> None:
        """Brake without targets."""
        self._send({"damp": share})

    def confirm(self) -> str:
        """Return what the arm says of its damping.

        Raises:
            DriverError: It does not say that it is damped.
        """
        if not self._is_damped:
            raise DriverError(f"{self.address} does not report that it is damped")
        return "damped, as the arm reports"

    def close(self, hold: bool = False) -> None:
        """Leave the bus; without `hold` the arm is damped."""
        if self._socket is None:
            return
        with contextlib.suppress(OSError):  # it may be the reason why we leave
            if not hold:
                self.damp()
        with contextlib.suppress(OSError):
            self._socket.shutdown(socket.SHUT_RDWR)  # ends `_receive`
        self._socket.close()
        self._socket = None

    def watchdog(self) -> dict[str, object]:
        """Return how another process opens this arm to damp it."""
        return {"kind": "my_arm", "robot": str(self._robot.folder), "port": self._port}

    def _send(self, message: dict[str, Any]) -> None:
        if self._socket is None:
            raise DriverError(f"{self.address}: not connected")
        self._socket.send(json.dumps(message).encode())


class SimulatedArm:
    """An arm in a thread: each joint goes a tenth of the way to its target in each state period.

    Attributes:
        port: Host and port, as MyArm takes them.
    """

    def __init__(self, robot: gp.RobotSpec) -> None:
        """Begin in the robot's home position."""
        self._joints = robot.joint_names
        self._qpos = np.array(robot.qpos_home, float)  # rad
        self._target = self._qpos.copy()
        self._damped = False
        self._count = 0
        self._random = np.random.default_rng(0)
        self._listeners: set[tuple[str, int]] = set()
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.bind(("127.0.0.1", 0))
        self._socket.setblocking(False)
        self.port = "{}:{}".format(*self._socket.getsockname())
        self._ended = threading.Event()
        threading.Thread(target=self._live, daemon=True).start()

    def commands_received(self) -> int:
        """Return how many targets and damping messages have arrived."""
        return self._count

    def positions(self) -> np.ndarray:
        """Return the true positions, (n) rad."""
        return self._qpos.copy()

    def close(self) -> None:
        """End the arm."""
        self._ended.set()

    def _live(self) -> None:
        while not self._ended.wait(STATE_PERIOD_S):
            while self._take_message():
                pass
            before = self._qpos
            if not self._damped:
                self._qpos = before + 0.1 * (self._target - before)
            self._tell((self._qpos - before) / STATE_PERIOD_S)
        self._socket.close()

    def _take_message(self) -> bool:
        """Take a message; return False if there is none."""
        try:
            data, sender = self._socket.recvfrom(LARGEST_MESSAGE)
        except OSError:
            return False
        message = json.loads(data)
        self._listeners.add(sender)
        if "go" in message:
            self._target = np.deg2rad([message["go"][joint] for joint in self._joints])
        if "go" in message or "damp" in message:
            self._damped = "damp" in message
            self._count += 1
        return True

    def _tell(self, qvel: np.ndarray) -> None:
        noisy = self._qpos + self._random.normal(0.0, 1e-4, len(self._qpos))
        state = {
            "q": dict(zip(self._joints, np.rad2deg(noisy).tolist(), strict=True)),
            "dq": dict(zip(self._joints, np.rad2deg(qvel).tolist(), strict=True)),
            "damped": self._damped,
        }
        for listener in list(self._listeners):
            with contextlib.suppress(OSError):
                self._socket.sendto(json.dumps(state).encode(), listener)


if __name__ == "__main__":
    arm = SimulatedArm(gp.load_robot(sys.argv[1]))
    print(f"a simulated arm at {arm.port}; end it with ctrl-c")
    with contextlib.suppress(KeyboardInterrupt):
        threading.Event().wait()
