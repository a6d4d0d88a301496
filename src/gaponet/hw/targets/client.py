"""Client of `gaponet run --targets zmq`: the robot as a policy or a teleoperator in another
process sees it.
"""

from __future__ import annotations

import contextlib
import json
import time
from collections.abc import Iterator, Mapping

import numpy as np
import zmq

from gaponet.base.arrays import Array
from gaponet.hw.control.driver import DriverError, State
from gaponet.hw.targets.zeromq import ADDRESS

UNREAD_TARGETS = 8  # that wait to be sent; further ones are dropped
# A policy may stall for long and must then still find the newest state, and why the run is over.
# ZeroMQ forgets what a full queue has not taken when the other side leaves.
UNREAD_STATES = 100_000


class RemoteRobot:
    """Receives states of a robot that `gaponet run --targets zmq` commands, and sends it targets.

        with RemoteRobot() as robot:
            for state in robot:  # the newest, once per control period of the robot
                robot.send(policy(state.qpos, state.qvel))

    While a policy is slow or stalls the robot is held; after 0.5 s (--live.hold) it damps.

    Attributes:
        joint_names: All joints of the robot, in the order of every array; set with the first state.
        commanded: Those that targets may name.
        ended: Why the run is over; empty before.
        nominal_qpos, nominal_qvel: What a policy is to see with --follow nominal, rad and rad/s;
            None without it.
    """

    def __init__(self, address: str = ADDRESS, patience: float = 10.0) -> None:
        """
        Args:
            address: Where `gaponet run` listens.
            patience: Longest wait for a state, s.
        """
        self.address = address
        self.patience = patience
        self.joint_names: tuple[str, ...] = ()
        self.commanded: tuple[str, ...] = ()
        self.ended = ""
        self.nominal_qpos: Array | None = None
        self.nominal_qvel: Array | None = None
        self._context = zmq.Context()
        self._socket = self._context.socket(zmq.DEALER)
        self._socket.setsockopt(zmq.LINGER, 200)
        self._socket.setsockopt(zmq.SNDHWM, UNREAD_TARGETS)
        self._socket.setsockopt(zmq.RCVHWM, UNREAD_STATES)
        self._socket.connect(address)
        self._send({})

    def __enter__(self) -> RemoteRobot:
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        self.close(end=kind is None)

    def __iter__(self) -> Iterator[State]:
        """Yield the newest state whenever there is a newer one, until the run is over.

        Raises:
            DriverError: No state came for `patience` s.
        """
        while (state := self._newest()) is not None:
            yield state

    def send(self, target: Mapping[str, float] | Array) -> None:
        """Send a target: joint → rad, or an array (n) of all joints, rad, of which the commanded
        ones count.

        Raises:
            DriverError: An array was given before the first state, when the order of the joints is
                not known.
        """
        if not isinstance(target, Mapping):
            if not self.joint_names:
                raise DriverError(
                    "take a state first: only then the order of the joints is known; or name them"
                )
            named = dict(zip(self.joint_names, np.asarray(target, float).tolist(), strict=True))
            target = {name: named[name] for name in self.commanded}
        self._send({"target": {name: float(value) for name, value in target.items()}})

    def close(self, end: bool = True) -> None:
        """Leave.

        With `end` the robot goes back to where it started; without, it is held, then damps.
        """
        if end and not self.ended:
            self._send({"end": True})
        self._context.destroy()

    def _send(self, message: dict[str, object]) -> None:
        data = json.dumps({"time": time.monotonic()} | message).encode()
        with contextlib.suppress(zmq.Again):  # nobody reads; the next target is newer
            self._socket.send(data, zmq.NOBLOCK)

    def _newest(self) -> State | None:
        if not self._socket.poll(round(1e3 * self.patience)):
            raise DriverError(
                f"no state from {self.address} in {self.patience:g} s; is gaponet run --targets "
                "zmq there?"
            )
        with contextlib.suppress(zmq.Again):
            while True:
                message = json.loads(self._socket.recv(zmq.NOBLOCK))
                self.ended = message.get("end", "")
                if self.ended:
                    return None
        self.joint_names = tuple(message["joint_names"])
        self.commanded = tuple(message["commanded"])
        if "nominal_qpos" in message:
            self.nominal_qpos = np.array(message["nominal_qpos"], float)
            self.nominal_qvel = np.array(message["nominal_qvel"], float)
        qpos = np.array(message["qpos"], float)
        qvel = np.array(message["qvel"], float)
        tau = np.array(message["tau"], float)
        return State(message["time"], qpos, qvel, tau, np.full_like(qpos, np.nan))
