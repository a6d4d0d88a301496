"""What the motors do that an ideal one would not: lag, sag, stiction; and whether their torque can be believed."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from gaponet.base.arrays import Array
from gaponet.data.holds import Holds, StaticError
from gaponet.data.signals import FAST, Response
from gaponet.data.survey import Survey, Torque
from gaponet.robot.finding import Finding, abbreviate, masked_names
from gaponet.robot.spec import RobotSpec

SAG = 0.02  # static error worth a line, rad
LONG, APART = 0.15, 0.05  # s: dead time worth a warning; of one joint beyond the others'
DEAD_TIMES = (
    (0.015, "as good as none"), (0.06, "usual for a bus and a servo's firmware"),
    (LONG, "long; hobby servos and slow buses have it"),
    (np.inf, "very long: look for a buffer, a filter, or clocks of command and state that are apart"),
)  # fmt: skip


def _lag(surveys: list[Survey], robot: RobotSpec) -> Iterator[Finding]:
    """How long after the command does each joint move?"""
    found = fast_lags(surveys, robot)
    if not found:
        text = f"nothing is commanded faster than {FAST} rad/s: lag cannot be told from stiction; add fast motions"
        yield Finding("note", "lag", text)
        return
    every = np.concatenate(list(found.values()))
    period = float(np.median([1 / s.rate_hz for s in surveys]))
    told = ", ".join(
        f"{name} {np.median(x) * 1e3:.0f} ms ({x.min() * 1e3:.0f}–{x.max() * 1e3:.0f})" for name, x in found.items()
    )
    text = (
        f"state follows command after (median and range over motions at {FAST} rad/s or faster) {told}: "
        f"{every.min() / period:.0f} to {every.max() / period:.0f} control periods; the operator's history must span it"
    )
    own, sharp = _servo_lag(robot), Response.sharp([s.response for s in surveys])
    jumps = dict(zip(robot.operated, sharp, strict=True))
    asked = [name for name in found if name in robot.operated and not jumps[name]]  # of others `timing` sees more
    extra = {name: float(np.median(found[name])) - own[name] for name in asked}
    usual = float(np.median(list(extra.values()))) if extra else 0.0
    if extra:
        words = next(word for most, word in DEAD_TIMES if usual <= most)
        text += f". Beyond what kp and damping make of it that is {usual * 1e3:.0f} ms of dead time: {words}"
    level = "warning" if usual > LONG else "note" if np.median(every) > period else "ok"
    yield Finding(level, "lag", text, tuple(found), {name: lag_values(x) for name, x in found.items()})
    for name, late in extra.items():
        if len(extra) > 2 and late - usual > APART and late > 2 * own[name]:
            text = (
                f"{name} lags {(late - usual) * 1e3:.0f} ms longer than the other joints: its channel is read late, "
                "filtered or from another bus, or it moves stiffly; shift it at import if the time of reading is known"
            )
            yield Finding("warning", "lag", text, (name,), {"extra_s": late - usual})


def _servo_lag(robot: RobotSpec) -> dict[str, float]:
    """Lag of a slow motion that kp, kd and the MJCF's damping make, by joint, s."""
    from gaponet.robot.mjcf import compile_spec, read_mjcf

    model = compile_spec(read_mjcf(robot.mjcf), robot.mjcf)
    damping = np.array([model.dof_damping[model.joint(name).dofadr[0]] for name in robot.joint_names])
    damping = np.where(np.isfinite(robot.damping), robot.damping, damping) + robot.kd
    lags = np.divide(damping, robot.kp, out=np.zeros_like(damping), where=robot.kp > 0)
    return dict(zip(robot.joint_names, lags.tolist(), strict=True))


def _sag(surveys: list[Survey], robot: RobotSpec) -> Iterator[Finding]:
    """How far from its command does each joint rest, with the lightest and the heaviest payload?"""
    payloads = sorted({s.entry.meta.payload_mass for s in surveys})
    rests = {
        p: static_errors([s for s in surveys if s.entry.meta.payload_mass == p], robot)
        for p in dict.fromkeys([payloads[0], payloads[-1]])
    }
    most = {name: max(abs(e[name].middle) for e in rests.values()) for name in robot.operated}
    heavy = sorted((name for name in robot.operated if most[name] >= SAG), key=lambda name: -most[name])
    if heavy:
        told = [
            ", ".join(f"{name} {_mrad(e[name])}" for name in heavy[:4]) + (f" with {p:g} kg" if payloads[1:] else "")
            for p, e in rests.items()
        ]
        more = f"; {len(heavy) - 4} more joints above {SAG * 1e3:.0f}" if len(heavy) > 4 else ""
        text = (
            f"state − command at rest, mrad: {'; '.join(told)}{more}: sag under load, or an offset. ± is stiction: so "
            "far to either side of it a joint stays stuck"
        )
        values = {f"{p:g} kg": {name: e[name].middle for name in heavy} for p, e in rests.items()}
        yield Finding("note", "sag", text, tuple(heavy), values)
    elif all(e.up + e.down == 0 for by_joint in rests.values() for e in by_joint.values()):
        text = "the robot never rests under a constant command: sag and offsets cannot be told; add holds"
        yield Finding("note", "sag", text)
    else:
        yield Finding("ok", "sag", f"every joint rests within {SAG * 1e3:.0f} mrad of its command")


def _torque(surveys: list[Survey], robot: RobotSpec) -> Iterator[Finding]:
    """Can the torque signal be trusted?"""
    told = [(s, s.torque) for s in surveys if s.torque is not None]
    if not told:
        yield Finding("note", "torque", "no torque recorded; equivalent torque comes from inverse dynamics")
        return
    low, high = np.min([t.low for _, t in told], axis=0), np.max([t.high for _, t in told], axis=0)
    used = np.max([s.qpos_range for s, _ in told], axis=0) > 0.05
    dead, alive = masked_names(robot, used & (low == high)), masked_names(robot, used & (low < high))
    unsigned = masked_names(robot, used & (low < high) & (low >= 0))
    found = []
    if dead:
        found.append(Finding("warning", "torque", f"torque of {', '.join(dead)} never changes; ignore it", dead))
    if unsigned and unsigned == alive:
        text = (
            "torque is unsigned (never negative, though joints move both ways): a magnitude of the current, not a "
            "torque; do not fit it"
        )
        found.append(Finding("warning", "torque", text, unsigned))
    found += _spikes([(s, t) for s, t in told if t.spikes.any()], robot)
    yield from found or [Finding("ok", "torque", "torque is signed and without spikes")]


def _spikes(spiky: list[tuple[Survey, Torque]], robot: RobotSpec) -> Iterator[Finding]:
    if not spiky:
        return
    height = np.array([np.maximum(-t.low, t.high) * (t.spikes > 0) for _, t in spiky])  # (sequences, n) N·m
    k, i = np.unravel_index(height.argmax(), height.shape)
    samples = sum(int(t.spikes.sum()) for _, t in spiky)
    text = (
        f"torque spikes: {samples} samples in {abbreviate([s.motion for s, _ in spiky])}; worst {height[k, i]:.2f} "
        "N·m on "
        f"{robot.joint_names[i]} in {spiky[k][0].motion}"
    )
    yield Finding("warning", "torque", text, (robot.joint_names[i],), {"samples": samples, "worst": height[k, i]})


def fast_lags(surveys: list[Survey], robot: RobotSpec) -> dict[str, Array]:
    """Lags (s) of each joint over the motions that command it at FAST or more; joints without one are left out."""
    found = {
        name: np.array([s.delay[i] for s in surveys if s.speed[i] >= FAST and np.isfinite(s.delay[i])])
        for i, name in enumerate(robot.joint_names)
    }
    return {name: x for name, x in found.items() if len(x)}


def lag_values(lags: Array) -> dict[str, float]:
    """Seconds, and the number of motions."""
    return {
        "median": float(np.median(lags)),
        "min": float(lags.min()),
        "max": float(lags.max()),
        "motions": len(lags),
    }


def static_errors(surveys: list[Survey], robot: RobotSpec) -> dict[str, StaticError]:
    """Static error of each operated joint over all rests."""
    holds = Holds.joined([s.holds for s in surveys], len(robot.joint_names))
    return {name: holds.static_error(j) for name, j in zip(robot.operated, robot.operated_index, strict=True)}


def _mrad(error: StaticError) -> str:
    band = f" ± {error.half_band * 1e3:.0f}" if error.balanced else " (approached from one side only)"
    return f"{error.middle * 1e3:+.0f}{band}"


CHECKS = (_lag, _sag, _torque)
