"""Random and adversarial states through the controller, a compensator and the limits, judged
against the true state.

    python tests/hw/control/adversary.py --states 1000000 --seed 0

In simulated time. The true joints (14 arm joints of an H1-2) accelerate as they like, up to what
SafetyConfig states; what is read is true but up to 50 ms old, now and then NaN, frozen, displaced
or absent; targets and corrections are anything; the clock stops wherever it can: in reading, in the
policy, in the compensator, between any two looks at it. Every command is judged when it is written:
by the range, the rate since the last one, and the torque that it asks of the joint where it truly
is. Prints counts as JSON; exit code 1 if a command was wrong.
"""

from __future__ import annotations

import argparse
import contextlib
import gc
import json
import os
import sys
import time
from collections import Counter
from dataclasses import dataclass, field, replace

import numpy as np

from gaponet.hw.control.clock import SimulatedClock
from gaponet.hw.control.controller import Controller
from gaponet.hw.control.driver import DriverError, Fault, State
from gaponet.hw.control.phases import ControlConfig
from gaponet.hw.control.safety import Limits, SafetyConfig
from gaponet.hw.drivers.unitree import MOTOR_NAMES
from gaponet.robot.spec import RobotSpec

Array = np.ndarray
SAFETY = SafetyConfig()
# Rad by which the first command may be off: a step of blend and correction.
FIRST = 0.05 + 0.02 * SAFETY.delta_rate
STOP = 0.0005  # chance of a stop at each look at the clock


class Stopping(SimulatedClock):
    """A clock that jumps ahead at a look: the process stood still just before."""

    def __init__(self, rng: np.random.Generator) -> None:
        super().__init__()
        self.rng = rng
        self.stops = 0

    def now(self) -> float:
        if self.rng.random() < STOP:
            self.stops += 1
            self._now += float(self.rng.choice([0.0005, 0.002, 0.015, 0.03, 0.1, 0.7]))
        self._now += 1e-6
        return self._now

    @property
    def true(self) -> float:
        """Without a stop."""
        return self._now


@dataclass
class Count:
    """What happened."""

    states: int = 0
    commands: int = 0
    stops: int = 0
    ends: Counter[str] = field(default_factory=Counter)
    wrong: Counter[str] = field(default_factory=Counter)
    share: float = 0.0  # largest torque asked for, of the effort limit
    example: str = ""


class Adversary:
    """A `Driver` whose joints go where they want."""

    reads_back = True
    virtual = True
    noisy = True
    at_end = "hand_over"
    qpos_range = None
    address = f"adversary in process {os.getpid()}"

    def __init__(
        self, robot: RobotSpec, clock: Stopping, rng: np.random.Generator, count: Count
    ) -> None:
        self.robot = robot
        self.clock = clock
        self.rng = rng
        self.count = count
        self.joint_names = robot.joint_names
        self.kp = robot.servo.kp
        self.kd = robot.servo.kd
        self.facts = {}
        self.commanded = MOTOR_NAMES[13:]
        self.at = robot.index(self.commanded)
        self.limits = Limits.from_robot(robot, self.commanded, SAFETY)
        n = len(robot.joint_names)
        # 1/s², how the joints are drawn to their commands
        self.obeys = rng.choice([0.0, 100.0, 300.0])
        self.goal = np.clip(robot.qpos_home + 0.3 * rng.standard_normal(n), *robot.qpos_range.T)
        # Time, position, speed, and the acceleration from then on.
        self.knots = [(0.0, self.goal.copy(), np.zeros(n), np.zeros(n))]
        self.before: Array | None = None
        self.damped = self.closed = False
        self.last: State | None = None

    def connect(self) -> None: ...

    def watchdog(self) -> None:
        return None

    def truth(self, t: float) -> tuple[Array, Array]:
        since, q, v, a = next(k for k in reversed(self.knots) if k[0] <= t)
        s = t - since
        return q + v * s + a * s * s / 2, v + a * s

    def read(self) -> State:
        rng = self.rng
        now = self.clock.now()
        q, v = self.truth(now)
        push = rng.uniform(-1, 1, len(q)) if rng.random() < 0.7 else rng.choice([-1.0, 1.0], len(q))
        strength = SAFETY.acceleration * rng.choice([0.02, 0.2, 1.0], p=[0.6, 0.3, 0.1])
        a = self.obeys * (self.goal - q) - 25.0 * v + push * strength
        self.knots = [
            *self.knots[-4:],
            (now, q, v, np.clip(a, -SAFETY.acceleration, SAFETY.acceleration)),
        ]
        oldest = max(self.knots[0][0], self.last.time if self.last else 0.0)
        when = max(
            now - rng.choice([0.0, 0.002, 0.01, 0.03, 0.05], p=[0.5, 0.3, 0.15, 0.04, 0.01]), oldest
        )
        q, v = self.truth(when)
        tau = rng.standard_normal(len(q))
        hot = np.full(len(q), 40.0)
        self.count.states += 1
        self.last = self._spoiled(State(when, q, v, tau, hot))
        return self.last

    def _spoiled(self, state: State) -> State:
        """Now and then a state that is not true, or none."""
        rng = self.rng
        if rng.random() > 0.004:
            return state
        one = np.eye(len(state.qpos))[rng.integers(len(state.qpos))]
        return [
            lambda: replace(state, qpos=state.qpos + np.nan * one),
            lambda: replace(state, qvel=np.where(one > 0, np.inf, state.qvel)),
            lambda: replace(state, qpos=state.qpos + 2.0 * one),
            lambda: replace(state, temperature=state.temperature + 90.0 * one),
            lambda: replace(state, tilt=1.5),
            lambda: self.last or state,
            self._fail,
        ][rng.integers(7)]()

    def _fail(self) -> State:
        raise DriverError("the cable is out")

    def write(self, ctrl: Array, weight: float = 1.0) -> None:
        q, v = (x[self.at] for x in self.truth(self.clock.true))
        u = ctrl[self.at]
        limits = self.limits
        count = self.count
        torque = np.abs(limits.kp * (u - q) - limits.kd * v)
        # the first goal is the measured place, also where that is beyond the margin
        if self.before is None:
            found = self.last.qpos[self.at]
            self.low = np.minimum(limits.low, found)
            self.high = np.maximum(limits.high, found)
            if np.abs(u - found).max() > FIRST:
                count.wrong["first goal"] += 1
        believed = self.last is not None and np.abs(self.last.qpos[self.at] - q).max() < 1.0
        count.commands += 1
        if believed:
            count.share = max(
                count.share, float((torque / self.robot.servo.effort_limit[self.at]).max())
            )
        wrong = {
            "nan": not np.isfinite(ctrl[self.at]).all() or not 0 <= weight <= 1,
            "range": bool(((u < self.low) | (u > self.high)).any()),
            "rate": self.before is not None
            and bool((np.abs(u - self.before) > limits.speed * DT).any()),
            "torque": bool((torque > limits.effort * (1 + 1e-9)).any()),
            "after damping": self.damped or self.closed,
        }
        for kind in (kind for kind, is_so in wrong.items() if is_so):
            count.wrong[kind] += 1
            count.example = (
                count.example or f"{kind} at {self.clock.true:.6f} s, torque {torque.max():.3f}"
            )
        self.before = u.copy()
        self.goal[self.at] = u

    def damp(self, weight: float = 1.0, share: float = 0.0) -> None:
        self.damped = True
        if self.before is None:
            self.count.wrong["damping though nothing was commanded"] += 1

    def verify(self) -> None: ...

    def confirm(self) -> str:
        return "damped"

    def close(self, hold: bool = False) -> None:
        self.closed = True


DT = 0.02
QUICK = ControlConfig(blend=0.2, blend_speed=3.0, settle=0.02, damp=0.1)


class Wild:
    """A compensator that corrects by anything."""

    def __init__(self, rng: np.random.Generator, clock: Stopping) -> None:
        self.rng = rng
        self.clock = clock
        self.size = rng.choice([0.0, 0.05, 1.0])

    def reset(self, target: Array, payload_mass: float | None = None) -> None:
        self.clock.wait_until(self.clock.now() + 0.3 * self.rng.random())

    def step(self, target: Array, qpos: Array, qvel: Array) -> Array:
        self.clock.now()
        out = target + self.size * self.rng.standard_normal(len(target))
        return out if self.rng.random() > 0.0005 else out * self.rng.choice([np.nan, np.inf, 1e300])


def episode(robot: RobotSpec, rng: np.random.Generator, count: Count) -> None:
    """One controller's life."""
    clock = Stopping(rng)
    driver = Adversary(robot, clock, rng, count)
    amplitude = rng.choice([0.1, 0.5, 4.0])
    wave = rng.uniform(0.5, 8.0, len(robot.joint_names))
    length = int(rng.integers(50, 400))

    def policy(k: int, state: State) -> Array | Fault | None:
        clock.now()
        if rng.random() < 0.0003:
            raise RuntimeError("the policy's own fault")
        if rng.random() < 0.0003:  # live targets cease
            return Fault("silence", "nobody speaks")
        target = robot.qpos_home + amplitude * np.sin(wave * k * DT)
        if rng.random() < 0.0003:
            target[rng.integers(len(target))] = rng.choice([np.nan, np.inf, 1e300])
        return target if k < length else None

    controller = Controller(
        driver,
        robot,
        config=QUICK,
        safety=SAFETY,
        compensator=Wild(rng, clock),
        clock=clock,
        unchecked=True,
    )
    with contextlib.suppress(RuntimeError):
        controller.run(policy)
    fault = controller.recording.fault
    count.ends[fault.kind if fault else "end"] += 1
    count.stops += clock.stops


def attack(robot: RobotSpec, states: int, seed: int) -> Count:
    """Episodes until that many states were read."""
    count = Count()
    k = 0
    gc.freeze()  # each controller collects garbage once
    try:
        while count.states < states:
            episode(robot, np.random.default_rng([seed, k]), count)
            k += 1
    finally:
        gc.unfreeze()
    return count


def main() -> None:
    from gaponet.robot.spec import load_robot

    parser = argparse.ArgumentParser()
    parser.add_argument("--states", type=int, default=1_000_000)
    parser.add_argument("--seed", type=int, default=0)
    args = parser.parse_args()
    robot = load_robot("h1_2")
    began = time.monotonic()
    count = attack(robot, args.states, args.seed)
    result = vars(count) | {"ends": dict(count.ends), "wrong": dict(count.wrong)}
    result["seconds"] = round(time.monotonic() - began)
    print(json.dumps(result, indent=1))
    sys.exit(bool(count.wrong))


if __name__ == "__main__":
    main()
