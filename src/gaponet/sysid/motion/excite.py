"""Excitation of one joint: each signal shows another part of the actuator.

All signals stay within [low, high], start and end at rest, and are smooth enough to have a torque.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from gaponet.base.arrays import Array
from gaponet.sysid.motion.minjerk import fade, move_time, through

Signal = Callable[[float, float, np.random.Generator, float], Array]  # (low, high, rng, dt) → (T,) rad


def sweep(low: float, high: float, rng: np.random.Generator, dt: float) -> Array:
    """Up and down the whole interval: shows gravity over the range, and friction as the distance of the two ways."""
    time = max((high - low) / 0.8, 2.5)
    return _line([low, high, low], [time, time], [0.5, 0.5, 0.5], dt)


def creep(low: float, high: float, rng: np.random.Generator, dt: float) -> Array:
    """A few tenths of a radian at 0.1 rad/s, there and back: shows sticking, backlash and the Stribeck dip."""
    half = min(0.15, (high - low) / 2)
    mid = rng.uniform(low + half, high - half) if high - low > 2 * half else (low + high) / 2
    levels = [mid - half, mid + half, mid - half]
    return _ramps(levels, [0.1, 0.1], dt)


def steps(low: float, high: float, rng: np.random.Generator, dt: float) -> Array:
    """Quick moves of a quarter radian with rests between: shows delay, overshoot and where the joint comes to rest."""
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
    duration, f0, f1 = 7.5, 0.15, 2.0
    time = np.arange(round(duration / dt)) * dt
    growth = np.log(f1 / f0) / duration
    frequency = f0 * np.exp(growth * time)
    phase = 2 * np.pi * (frequency - f0) / growth
    amplitude = np.minimum(min(0.35, (high - low) / 2), 0.9 / (2 * np.pi * frequency))  # 0.9 rad/s
    return _about(low, high, amplitude * np.sin(phase), rng, dt)


def multisine(low: float, high: float, rng: np.random.Generator, dt: float) -> Array:
    """Seven incommensurate sines from 0.1 to 1.6 Hz with random phases: many speeds at many positions."""
    time = np.arange(round(8.0 / dt)) * dt
    frequency = 0.1 * 1.59 ** np.arange(7) * rng.uniform(0.95, 1.05, 7)
    phase = rng.uniform(0, 2 * np.pi, 7)
    wave = (np.sin(2 * np.pi * np.outer(time, frequency) + phase) / (1 + frequency / 0.2)).sum(axis=1)
    return _about(low, high, wave * min(0.45, (high - low) / 2) / np.abs(wave).max(), rng, dt)


def holds(low: float, high: float, rng: np.random.Generator, dt: float) -> Array:
    """A staircase through the interval with rests, from both sides: shows sag and the dead band around it."""
    up = np.linspace(low, high, 4) + rng.uniform(-0.05, 0.05, 4) * (high - low)
    levels = np.clip(np.concatenate([up, up[-2::-1]]), low, high)
    return _line(levels, move_time(np.diff(levels), 2.0), [0.6] * len(levels), dt)


SIGNALS: dict[str, Signal] = {f.__name__: f for f in (sweep, creep, steps, trapezoids, chirp, multisine, holds)}


def _line(levels: Array | list[float], moves: Array | list[float], rests: list[float], dt: float) -> Array:
    return through(np.asarray(levels)[:, None], np.asarray(moves), np.asarray(rests), dt)[:, 0]


def _ramps(levels: Array | list[float], speeds: Array | list[float], dt: float) -> Array:
    """Go from level to level at constant speeds (rad/s), corners rounded over 0.3 s."""
    kernel = np.hanning(max(3, round(0.3 / dt)))
    out = [np.full(round(0.5 / dt), levels[0])]
    for a, b, speed in zip(levels[:-1], levels[1:], speeds, strict=True):
        line = np.linspace(a, b, max(2, round(abs(b - a) / speed / dt)))
        ramp = np.concatenate([np.full(len(kernel), a), line, np.full(len(kernel) + round(0.2 / dt), b)])
        out.append(np.convolve(ramp, kernel / kernel.sum(), "valid"))
    return np.concatenate(out)


def _about(low: float, high: float, wave: Array, rng: np.random.Generator, dt: float) -> Array:
    """The wave, faded in and out, about a random centre that keeps it inside the interval."""
    wave = wave * fade(len(wave), dt, 1.0)
    centre = rng.uniform(low - wave.min(), high - wave.max()) if high - low > np.ptp(wave) else (low + high) / 2
    rest = np.zeros(round(0.5 / dt))
    return centre + np.concatenate([rest, wave, rest])
