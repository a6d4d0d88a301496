"""How do the motors differ from ideal ones: lag, sag, stiction; and is their torque credible?"""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from gaponet.base.arrays import Array
from gaponet.data.checks.check import Check
from gaponet.data.checks.completeness import torque_limits, unsigned_torque
from gaponet.data.checks.survey import Recorded, Survey, with_torque
from gaponet.data.checks.timing import MAX_EXTRA_LAG_S, WHY_LATE, verdict_on
from gaponet.data.signals import FAST_COMMAND_RAD_S, Response
from gaponet.data.static_poses import StaticError, StaticPoses
from gaponet.robot.finding import Finding, abbreviate, masked_names
from gaponet.robot.spec import RobotSpec

MIN_SAG_RAD = 0.02  # static error that is reported
MAX_SHOWN = 4  # joints whose static error is told
MAX_DEAD_TIME_S = 0.15  # of all joints
# Up to so many s → what the lag that kp and damping do not explain is, as a dead time.
VERDICTS = {
    0.015: "as good as none",
    0.06: "usual for a bus and a servo's firmware",
    MAX_DEAD_TIME_S: "long, as of hobby servos and slow buses",
    np.inf: "very long: look for a buffer, a filter, or clocks of command and state that are apart",
}


def _lag(surveys: list[Survey], robot: RobotSpec) -> Iterator[Finding]:
    """How long after the command does each joint move?"""
    lags = fast_lags(surveys, robot)
    if not lags:
        yield _no_lag(surveys)
        return
    of_all = np.concatenate(list(lags.values()))
    median = float(np.median(of_all))
    low = of_all.min()
    high = of_all.max()
    period = float(np.median([1 / survey.timing.rate_hz for survey in surveys]))
    text = (
        f"state follows command after {median * 1e3:.0f} ms "
        f"({low * 1e3:.0f}–{high * 1e3:.0f} over joints and motions at {FAST_COMMAND_RAD_S} rad/s "
        f"or faster), {low / period:.0f} to {high / period:.0f} periods"
    )
    expected = _expected_lag(robot)
    dead_times = _dead_times(lags, surveys, robot, expected)
    usual = 0.0
    if dead_times:
        usual = float(np.median(list(dead_times.values())))
        verdict = verdict_on(usual, VERDICTS)
        text += (
            f". kp and damping do not explain {usual * 1e3:.0f} ms of it: dead time, friction or "
            f"inertia (gaponet identify separates them). As a dead time this is {verdict}"
        )
    level = "ok"
    if usual > MAX_DEAD_TIME_S:
        level = "warning"
    elif median > period:
        level = "note"
    values = {name: lag_values(of_joint) for name, of_joint in lags.items()}
    yield Finding(level, "lag", text, tuple(lags), values)
    if len(dead_times) > 2:
        yield from _late_joints(dead_times, usual, expected)


def _no_lag(surveys: list[Survey]) -> Finding:
    """Say why no lag is known."""
    if any(np.isfinite(survey.tracking.copied_rows).any() for survey in surveys):
        return Finding("ok", "lag", "a command that repeats the state shows no lag")
    text = (
        f"nothing is commanded faster than {FAST_COMMAND_RAD_S} rad/s: lag and stiction "
        "cannot be separated"
    )
    return Finding("note", "lag", f"{text}; add fast motions")


def _dead_times(
    lags: dict[str, Array],
    surveys: list[Survey],
    robot: RobotSpec,
    expected: dict[str, _ExpectedLag],
) -> dict[str, float]:
    """Return by how much longer joints lag than kp and damping explain, s.

    Only joints with smooth commands: of the others the timing check sees more.
    """
    sharp = Response.sharp([survey.tracking.response for survey in surveys])  # (operated)
    dead_times = {}
    for name, of_joint in lags.items():
        if name in robot.operated and not sharp[robot.operated.index(name)]:
            dead_times[name] = float(np.median(of_joint)) - expected[name].slow
    return dead_times


def _late_joints(
    dead_times: dict[str, float], usual: float, expected: dict[str, _ExpectedLag]
) -> Iterator[Finding]:
    """Find joints that lag longer than the others, whose dead time is `usual`, s."""
    for name, late in dead_times.items():
        explained = max(2 * expected[name].slow, expected[name].resonance)
        if late - usual > MAX_EXTRA_LAG_S and late > explained:
            text = (
                f"{name} lags {(late - usual) * 1e3:.0f} ms longer than the other joints: "
                f"{WHY_LATE}"
            )
            yield Finding("warning", "lag", text, (name,), {"extra_s": late - usual})


class _ExpectedLag(NamedTuple):
    """The lag of a joint without any dead time, s."""

    # of a slow motion, by damping: (kd + the MJCF's damping) / kp
    slow: float
    # what the inertia at home adds at the servo's own frequency √(kp / inertia): a quarter period
    resonance: float


def _expected_lag(robot: RobotSpec) -> dict[str, _ExpectedLag]:
    """Return by joint the lag that gains, damping and inertia explain."""
    import mujoco

    from gaponet.robot.mjcf import compile_spec, read_mjcf

    model = compile_spec(read_mjcf(robot.mjcf), robot.mjcf)
    data = mujoco.MjData(model)
    full = np.empty((model.nv, model.nv))
    mujoco.mj_forward(model, data)
    mujoco.mj_fullM(model, data, full)
    dofs = [model.joint(name).dofadr[0] for name in robot.joint_names]
    servo = robot.servo
    passive = np.where(np.isfinite(servo.damping), servo.damping, model.dof_damping[dofs])
    damping = passive + servo.kd
    inertia = np.diag(full)[dofs]
    stiff = np.where(servo.kp > 0, servo.kp, np.inf)
    slow = (damping / stiff).tolist()
    resonance = (np.pi / 2 * np.sqrt(inertia / stiff)).tolist()
    lags = map(_ExpectedLag, slow, resonance)
    return dict(zip(robot.joint_names, lags, strict=True))


def _sag(surveys: list[Survey], robot: RobotSpec) -> Iterator[Finding]:
    """How far from its command does each joint rest, with the lightest and the heaviest payload?"""
    payloads = sorted({survey.meta.payload_mass for survey in surveys})
    errors: dict[float, dict[str, StaticError]] = {}  # payload → joint → error
    for payload in (payloads[0], payloads[-1]):
        same = [survey for survey in surveys if survey.meta.payload_mass == payload]
        errors[payload] = static_errors(same, robot)
    largest = {}  # joint → static error, rad
    for name in robot.operated:
        largest[name] = max(abs(by_joint[name].middle) for by_joint in errors.values())
    sagging = [name for name in robot.operated if largest[name] >= MIN_SAG_RAD]
    sagging.sort(key=lambda name: -largest[name])
    if sagging:
        yield _sag_finding(sagging, errors)
    elif not _rests(errors):
        text = (
            "the robot never rests under a constant command: sag and offsets are not determined; "
            "add holds"
        )
        yield Finding("note", "sag", text)


def _rests(errors: dict[float, dict[str, StaticError]]) -> int:
    """Return the number of rests. errors: payload → joint → error."""
    rests = 0
    for by_joint in errors.values():
        for error in by_joint.values():
            rests += error.up + error.down
    return rests


def _sag_finding(sagging: list[str], errors: dict[float, dict[str, StaticError]]) -> Finding:
    """Report joints that rest away from their commands, the farthest first.

    Args:
        errors: Payload → joint → static error.
    """
    shown = sagging[:MAX_SHOWN]
    parts = []
    for payload, by_joint in errors.items():
        part = ", ".join(f"{name} {_mrad(by_joint[name])}" for name in shown)
        if len(errors) > 1:
            part += f" with {payload:g} kg"
        parts.append(part)
    text = f"state − command at rest, mrad: {'; '.join(parts)}"
    others = len(sagging) - len(shown)
    if others:
        text += f"; {others} more joints above {MIN_SAG_RAD * 1e3:.0f}"
    text += ": sag under load, or an offset. Within ± (stiction) a joint can stop anywhere"
    values = {}
    for payload, by_joint in errors.items():
        values[f"{payload:g} kg"] = {name: by_joint[name].middle for name in sagging}
    return Finding("note", "sag", text, tuple(sagging), values)


def _torque(surveys: list[Survey], robot: RobotSpec) -> Iterator[Finding]:
    """Can the torque signal be trusted?"""
    recorded = with_torque(surveys)
    if not recorded:
        yield Finding(
            "note", "torque", "no torque recorded; equivalent torque comes from inverse dynamics"
        )
        return
    torques = torque_limits(recorded)
    constant = masked_names(robot, torques.moved & (torques.low == torques.high))
    unsigned = unsigned_torque(recorded, robot)
    if constant:
        text = f"torque of {', '.join(constant)} never changes; ignore it"
        yield Finding("warning", "torque", text, constant)
    if unsigned:
        text = (
            "torque is unsigned (never negative, though joints move both ways): a current's "
            "magnitude; do not fit it"
        )
        yield Finding("warning", "torque", text, unsigned)
    spiky = [(survey, torque) for survey, torque in recorded if torque.spikes.any()]
    yield from _spikes(spiky, robot)


def _spikes(spiky: Recorded, robot: RobotSpec) -> Iterator[Finding]:
    """Report recordings with torque spikes, and the worst of these."""
    if not spiky:
        return
    heights = []  # of the spikes, (n) N·m each; 0 without
    for _, torque in spiky:
        heights.append(np.where(torque.spikes > 0, torque.largest, 0.0))
    height = np.array(heights)  # (sequences, n)
    k, i = np.unravel_index(height.argmax(), height.shape)
    joint = robot.joint_names[i]
    worst_survey, _ = spiky[k]
    samples = sum(int(torque.spikes.sum()) for _, torque in spiky)
    motions = abbreviate([survey.motion for survey, _ in spiky])
    text = (
        f"torque spikes: {samples} samples in {motions}; worst {height[k, i]:.2f} N·m on {joint} "
        f"in {worst_survey.motion}"
    )
    values = {"samples": samples, "worst": height[k, i]}
    yield Finding("warning", "torque", text, (joint,), values)


def fast_lags(surveys: list[Survey], robot: RobotSpec) -> dict[str, Array]:
    """Return joint → lags in motions that command it at FAST_COMMAND_RAD_S or more, s; only joints
    that have any.
    """
    lags = {}
    for i, name in enumerate(robot.joint_names):
        known = [float(s.tracking.delay[i]) for s in surveys if _shows_fast_lag(s, i)]
        if known:
            lags[name] = np.array(known)
    return lags


def _shows_fast_lag(survey: Survey, i: int) -> bool:
    """Return True if the lag of joint i is known, and of a fast motion."""
    if survey.tracking.speed[i] < FAST_COMMAND_RAD_S:
        return False
    tracking = survey.tracking
    return bool(np.isfinite(tracking.delay[i]) and np.isnan(tracking.copied_rows[i]))


def lag_values(lags: Array) -> dict[str, float]:
    """Return median and range of lags, s, and their number."""
    return {
        "median": float(np.median(lags)),
        "min": float(lags.min()),
        "max": float(lags.max()),
        "motions": len(lags),
    }


def static_errors(surveys: list[Survey], robot: RobotSpec) -> dict[str, StaticError]:
    """Return the static error of each operated joint over all static poses."""
    parts = [survey.samples.static_poses for survey in surveys]
    poses = StaticPoses.joined(parts, len(robot.joint_names))
    errors = map(poses.static_error, robot.operated_index)
    return dict(zip(robot.operated, errors, strict=True))


def _mrad(error: StaticError) -> str:
    middle = f"{error.middle * 1e3:+.0f}"
    if error.balanced:
        return f"{middle} ± {error.half_band * 1e3:.0f}"
    return f"{middle} (approached from one side only)"


CHECKS = (
    Check(_lag, "lag", "", needs_commands=True),
    Check(
        _sag,
        "sag",
        f"every joint rests within {MIN_SAG_RAD * 1e3:.0f} mrad of its command",
        needs_commands=True,
    ),
    Check(_torque, "torque", "torque is signed and without spikes"),
)
