"""The motions of a robot by name: made from a seed, fitted to its limits, the same every time."""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from dataclasses import replace

import numpy as np

from gaponet.base.arrays import Array
from gaponet.base.errors import UsageError
from gaponet.motion.coordinated import BUILDERS, WHOLE_BODY, Kit, available
from gaponet.motion.feasible import (
    MAX_PAYLOAD_KG,
    ExcitationRange,
    Feasibility,
    find_excitation_range,
)
from gaponet.motion.motion import GRID, Motion, fade, move_time, through
from gaponet.robot.spec import RobotSpec

# (low rad, high rad, generator, period s) → (T,) rad
Signal = Callable[[float, float, np.random.Generator, float], Array]


def sweep(low: float, high: float, rng: np.random.Generator, dt: float) -> Array:
    """Up and down the whole interval: shows gravity over the range, and friction as the distance of
    the two ways.
    """
    time = max((high - low) / 0.8, 2.5)
    return _line([low, high, low], [time, time], [0.5, 0.5, 0.5], dt)


def creep(low: float, high: float, rng: np.random.Generator, dt: float) -> Array:
    """A few tenths of a radian at 0.1 rad/s, there and back: shows sticking, backlash and the
    Stribeck dip.
    """
    half = min(0.15, (high - low) / 2)
    middle = (low + high) / 2
    if high - low > 2 * half:
        middle = rng.uniform(low + half, high - half)
    levels = [middle - half, middle + half, middle - half]
    return _ramps(levels, [0.1, 0.1], dt)


def steps(low: float, high: float, rng: np.random.Generator, dt: float) -> Array:
    """Quick moves of a quarter radian with rests between: shows delay, overshoot and where the
    joint comes to rest.
    """
    size = min(0.3, (high - low) / 3)
    levels = [float(rng.uniform(low + size, high - size))]
    while len(levels) < 7:
        step = rng.choice([-1.0, 1.0]) * rng.uniform(0.5, 1.0) * size
        levels.append(float(np.clip(levels[-1] + step, low, high)))
    return _line(levels, [0.3] * 6, [0.5] + [0.8] * 6, dt)


def trapezoids(low: float, high: float, rng: np.random.Generator, dt: float) -> Array:
    """Constant-speed moves between random levels at four speeds: shows viscous damping and lag."""
    return _ramps(rng.uniform(low, high, 5), rng.permutation([0.4, 0.7, 1.0, 1.4]), dt)


def chirp(low: float, high: float, rng: np.random.Generator, dt: float) -> Array:
    """0.15 → 2 Hz with falling amplitude: shows inertia, payload and resonance."""
    duration = 7.5  # s
    first = 0.15  # Hz
    last = 2.0  # Hz
    peak_speed = 0.9  # rad/s
    time = np.arange(round(duration / dt)) * dt
    growth = np.log(last / first) / duration
    frequency = first * np.exp(growth * time)
    phase = 2 * np.pi * (frequency - first) / growth
    widest = min(0.35, (high - low) / 2)
    amplitude = np.minimum(widest, peak_speed / (2 * np.pi * frequency))
    return _about(low, high, amplitude * np.sin(phase), rng, dt)


def multisine(low: float, high: float, rng: np.random.Generator, dt: float) -> Array:
    """Seven incommensurate sines from 0.1 to 1.6 Hz with random phases: many speeds at many
    positions.
    """
    time = np.arange(round(8.0 / dt)) * dt
    frequency = 0.1 * 1.59 ** np.arange(7) * rng.uniform(0.95, 1.05, 7)
    phase = rng.uniform(0, 2 * np.pi, 7)
    sines = np.sin(2 * np.pi * np.outer(time, frequency) + phase)
    wave = (sines / (1 + frequency / 0.2)).sum(axis=1)
    widest = min(0.45, (high - low) / 2)
    return _about(low, high, wave * widest / np.abs(wave).max(), rng, dt)


def holds(low: float, high: float, rng: np.random.Generator, dt: float) -> Array:
    """A staircase through the interval with rests, from both sides: shows sag and the dead band
    around it.
    """
    up = np.linspace(low, high, 4) + rng.uniform(-0.05, 0.05, 4) * (high - low)
    levels = np.clip(np.concatenate([up, up[-2::-1]]), low, high)
    return _line(levels, move_time(np.diff(levels), 2.0), [0.6] * len(levels), dt)


SIGNALS: dict[str, Signal] = {
    f.__name__: f for f in (sweep, creep, steps, trapezoids, chirp, multisine, holds)
}


def _line(
    levels: Array | list[float], moves: Array | list[float], rests: list[float], dt: float
) -> Array:
    """Move one joint from level to level (rad), resting at each; moves and rests in s."""
    points = np.asarray(levels)[:, None]
    return through(points, np.asarray(moves), np.asarray(rests), dt)[:, 0]


def _ramps(levels: Array | list[float], speeds: Array | list[float], dt: float) -> Array:
    """Go from level to level at constant speeds (rad/s), corners rounded over 0.3 s."""
    kernel = np.hanning(max(3, round(0.3 / dt)))
    parts = [np.full(round(0.5 / dt), levels[0])]
    for start, stop, speed in zip(levels[:-1], levels[1:], speeds, strict=True):
        before = np.full(len(kernel), start)
        line = np.linspace(start, stop, max(2, round(abs(stop - start) / speed / dt)))
        after = np.full(len(kernel) + round(0.2 / dt), stop)
        ramp = np.concatenate([before, line, after])
        parts.append(np.convolve(ramp, kernel / kernel.sum(), "valid"))
    return np.concatenate(parts)


def _about(low: float, high: float, wave: Array, rng: np.random.Generator, dt: float) -> Array:
    """The wave, faded in and out, about a random centre that keeps it inside the interval."""
    wave = wave * fade(len(wave), dt, 1.0)
    centre = (low + high) / 2
    if high - low > np.ptp(wave):
        centre = rng.uniform(low - wave.min(), high - wave.max())
    rest = np.zeros(round(0.5 / dt))
    return centre + np.concatenate([rest, wave, rest])


class Library:
    """Motions of one robot by name; joints' excitation ranges are cached."""

    def __init__(
        self,
        robot: RobotSpec,
        seed: int = 0,
        max_payload: float = MAX_PAYLOAD_KG,
        height: float | None = None,
        unchecked: bool = False,
    ) -> None:
        """Make the motions of a seed; the other arguments are those of Feasibility."""
        self.robot = robot
        self.seed = seed
        self.limits = Feasibility(robot, max_payload, height, unchecked)
        self.kit = Kit(self.limits)
        self._ranges: dict[str, ExcitationRange] = {}
        self._given: dict[str, Motion] = {}

    def add(self, motion: Motion) -> None:
        """Add a motion from elsewhere (motion/files.py), made feasible like all others.

        Raises:
            UsageError: It cannot be fitted.
        """
        self._given[motion.name] = self.limits.fit(motion)

    def names(self, variants: int = 1) -> list[str]:
        """Return all names: <signal>-<joint>, <kind>-<side>-<variant>, <kind>-all-<variant>, and
        what was added.
        """
        sides = list(self.kit.arms)
        if len(sides) == 2:
            sides.append("both")
        names = []
        for joint in self.robot.operated:
            names += [f"{signal}-{short(joint, self.robot)}" for signal in SIGNALS]
        for variant in range(variants):
            for kind in BUILDERS:
                names += [f"{kind}-{side}-{variant}" for side in sides]
        for variant in range(variants):
            names += [f"{kind}-all-{variant}" for kind in available(self.kit)]
        return names + list(self._given)

    def make(self, name: str) -> Motion:
        """Return the motion of that name.

        Raises:
            UsageError: No such motion; the message lists the forms.
        """
        if name in self._given:
            return self._given[name]
        rng = np.random.default_rng([self.seed, _number(name)])
        signal, _, joint = name.partition("-")
        if signal in SIGNALS:
            return self._joint(name, signal, joint, rng)
        match name.split("-"):
            case [kind, "both", _] if kind in BUILDERS:
                ctrl = BUILDERS[kind](self.kit, tuple(self.kit.arms), rng)
                return self._fitted(name, "upper_body", ctrl)
            case [kind, side, _] if kind in BUILDERS and side in self.kit.arms:
                ctrl = BUILDERS[kind](self.kit, (side,), rng)
                return self._fitted(name, "upper_body", ctrl)
            case [kind, "all", _] if kind in available(self.kit):
                return self._fitted(name, "whole_body", WHOLE_BODY[kind](self.kit, rng))
        raise UsageError(f"{self.robot.name} has no motion '{name}'; {self._forms()}")

    def _forms(self) -> str:
        """Say how motions are named."""
        joints = _short_names(self.robot)
        sides = "none (this robot has no arms by name)"
        if self.kit.arms:
            sides = ", ".join([*self.kit.arms, "both"])
        return (
            f"names are <signal>-<joint> with a signal of {', '.join(SIGNALS)} and a joint of "
            f"{joints}, or <kind>-<side>-<variant> with a kind of {', '.join(BUILDERS)} and a side "
            f"of {sides}, or <kind>-all-<variant> with a kind of {', '.join(available(self.kit))}"
        )

    def excitation_range(self, joint: str) -> ExcitationRange:
        """Return posture and interval in which a joint is excited."""
        if joint not in self._ranges:
            self._ranges[joint] = find_excitation_range(self.limits, joint, self.seed)
        return self._ranges[joint]

    def _joint(self, name: str, signal: str, joint: str, rng: np.random.Generator) -> Motion:
        full = next((j for j in self.robot.operated if short(j, self.robot) == joint), None)
        if full is None:
            raise UsageError(
                f"motion '{name}': {self.robot.name} has no operated joint '{joint}'; it has "
                f"{_short_names(self.robot)}"
            )
        interval = self.excitation_range(full)
        of_joint = SIGNALS[signal](interval.low, interval.high, rng, GRID)  # (T,) rad
        ctrl = np.repeat(interval.posture[None], len(of_joint), axis=0)
        ctrl[:, self.robot.index([full])[0]] = of_joint
        return self._fitted(name, "joint", ctrl)

    def _fitted(self, name: str, level: str, ctrl: Array) -> Motion:
        """Make commands feasible; the motion names the operated joints and those that move."""
        fitted = self.limits.fit(Motion(name, level, GRID, ctrl))
        about = {*self.robot.operated, *fitted.moved(self.robot)}
        joints = tuple(joint for joint in self.robot.joint_names if joint in about)
        return replace(fitted, joints=joints)


def _number(name: str) -> int:
    """Return a number that a name stands for, the same on every machine."""
    return int(hashlib.sha256(name.encode()).hexdigest()[:8], 16)


def _short_names(robot: RobotSpec) -> str:
    """Return the names of the operated joints, as motions have them."""
    return ", ".join(short(joint, robot) for joint in robot.operated)


def short(joint: str, robot: RobotSpec) -> str:
    """Return a joint's name in names of motions: without the suffix _joint, unless another joint
    has that name.
    """
    name = joint.removesuffix("_joint")
    return joint if name in robot.joint_names else name
