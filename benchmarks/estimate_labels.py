r"""Estimation of missing labels: the payload of each recording, and the unit that made it.

A unit is one physical robot.

    python benchmarks/estimate_labels.py LOGS --robot h1_2 --rate 50 --payloads 0 1 2 3 --units 3 \
        --out labels

Recordings in which one joint moves repeat the same commands with several payloads and units. The
held torque at equal commands is a + b·m: m is one of the given payloads, b is common, a is the
unit's. Each joint and command is fitted by itself, by expectation maximisation over all pairs of
unit and payload. Consecutive recordings with equal torque are repetitions of one unit. Units are
distinguished by the order of their torques, which is assumed to be the same at every payload; the
first unit of one joint need not be that of another.
"""

from __future__ import annotations

import csv
import hashlib
import io
import itertools
import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import tyro

from gaponet.base.arrays import Array
from gaponet.base.errors import LogError
from gaponet.base.files import write_text
from gaponet.base.text import format_uncertainty
from gaponet.data.formats import ReadOptions, read_logs
from gaponet.data.log import Log
from gaponet.robot.spec import load_robot
from gaponet.sysid.steps.torque_fit import Gains, servo_gains

MIN_MOVE_RAD = 0.05  # of a command that moves a joint
MAX_END_DIFFERENCE = 0.05  # of two commands that count as one, over the range of a joint's commands
SETTLE_S = 0.1
# standard deviations of a repetition within which neighbours are repetitions
MAX_REPETITION_STD = 3.0
# From which a joint determines its payload; the distance is in widths of a band.
MIN_NM_PER_KG = 0.3
MIN_BAND_DISTANCE = 2.5
MIN_RECORDINGS = 4  # of a joint, for its gains from torque
MAX_PAYLOAD_ERROR_KG = 0.5  # from a label
PAYLOAD_IN_NAME = re.compile(r"_(\d+(?:[.p]\d+)?)kg(?:_|$)")


@dataclass
class LabelledRecording:
    """Recording with its estimated labels.

    Attributes:
        name: The name that import gives it.
        joint, command: The joint that moves, and its last command, rad.
        torque: Torque and command of each row, (k,) N·m and rad; gain times error where no torque
            was recorded.
        named_payload: Payload in the file's name, kg.
        payload, unit: Estimates, kg and a number from 0 on within the joint.
        determined: Whether the joint's torque determines its payload.
        torque_payload: Payload estimated from torque without the unit, kg.
        copy_of: Name of an earlier recording with the same samples.
        servo_rows: Command, position, velocity and torque of each row, (4, k), where torque was
            recorded.
    """

    name: str
    joint: str
    command: float
    torque: tuple[Array, Array]
    named_payload: float | None
    payload: float = 0.0
    unit: int = 0
    determined: bool = False
    torque_payload: float = 0.0
    copy_of: str = ""
    servo_rows: Array | None = field(default=None, repr=False)


@dataclass(frozen=True)
class LabelGroup:
    """Recordings of one joint and command."""

    joint: str
    command: float
    count: int  # number of recordings
    slope: float  # N·m per kg
    band_distance: float  # distance of the payloads' bands in their widths
    units: Array  # torque of each unit without payload, N·m
    determined: bool  # whether the torque determines the payload


@dataclass(frozen=True)
class Agreement:
    """How estimated payloads agree with those in files' names.

    Attributes:
        said: Number of recordings with a payload in the file's name.
        within: Share of them whose estimate is near it.
        not_said: Number of other recordings.
        taken: Share of these that are taken for a payload of the first kind. What a file's name
            does not list is none of these either, where such files list all of a payload.
    """

    said: int
    within: float
    not_said: int
    taken: float

    def __str__(self) -> str:
        return (
            f"of {self.said} recordings with a payload in the file's name, {self.within:.0%} are "
            f"within {MAX_PAYLOAD_ERROR_KG:g} kg of it; of {self.not_said} others "
            f"{self.taken:.0%} are taken for one of these"
        )


@dataclass(frozen=True)
class Labels:
    """Estimated labels.

    Attributes:
        agreement: With payloads in files' names; None if there are none.
        gains: Joint → gains of its servo from torque, of all rows and of the recordings' ends.
    """

    recordings: list[LabelledRecording]
    groups: list[LabelGroup]
    agreement: Agreement | None
    gains: dict[str, tuple[Gains, Gains]] = field(default_factory=dict)

    @property
    def remarks(self) -> list[str]:
        """Return remarks in sentences."""
        lines = []
        if self.agreement is not None:
            lines.append(str(self.agreement))
        loaded = [r for r in self.recordings if r.determined and not r.copy_of]
        if loaded:
            near = sum(abs(r.torque_payload - r.payload) < MAX_PAYLOAD_ERROR_KG for r in loaded)
            lines.append(
                f"torque alone, without the unit, gives {near} of {len(loaded)} payloads within "
                f"{MAX_PAYLOAD_ERROR_KG:g} kg of their label"
            )
        for joint, (gains, at_end) in self.gains.items():
            if gains.trusted:
                lines.append(
                    f"{joint}: torque is kp (command − position) − kd velocity, "
                    f"kp {format_uncertainty(gains.kp, gains.error)} N·m/rad "
                    f"({format_uncertainty(at_end.kp, at_end.error)} by the end of recordings), "
                    f"kd {gains.kd:.2f} N·m·s/rad: {gains.explained:.1%} of its variance"
                )
        return lines


def estimate(
    logs: Iterable[tuple[str, Log]], payloads: Sequence[float], units: int, gain: dict[str, float]
) -> Labels:
    """Estimate payload and unit of every recording.

    Payloads in files' names are only compared with the estimates.

    Args:
        logs: Name and recording, one moving joint each.
        payloads: The masses that were used, kg.
        units: Number of robots.
        gain: Joint → N·m/rad, for recordings without torque.

    Raises:
        LogError: More than one joint moves.
    """
    recordings: list[LabelledRecording] = []
    seen: dict[tuple[str, str], LabelledRecording] = {}
    copies: list[tuple[LabelledRecording, LabelledRecording]] = []
    for name, log in logs:
        one = _read(name, log, gain)
        first = seen.setdefault((one.joint, _digest(log)), one)
        if first is not one:
            one.copy_of = first.name
            if first.named_payload is None:
                first.named_payload = one.named_payload
            copies.append((one, first))
        recordings.append(one)
    own = list(seen.values())
    groups = [_fit(part, payloads, units) for part in _by_command(own)]
    for one, first in copies:
        one.payload = first.payload
        one.unit = first.unit
        one.determined = first.determined
    return Labels(recordings, groups, _agreement(own), _gains(own))


def _digest(log: Log) -> str:
    """Return a hash of the samples."""
    commands = log.channels["ctrl"].values.tobytes()
    positions = log.channels["qpos"].values.tobytes()
    return hashlib.sha256(commands + positions).hexdigest()


def _agreement(recordings: list[LabelledRecording]) -> Agreement | None:
    """Compare the estimates with files' names; None if no name has a payload."""
    errors = []
    masses = set()
    others = []
    for r in recordings:
        if not r.determined:
            continue
        if r.named_payload is None:
            others.append(r.payload)
        else:
            masses.add(r.named_payload)
            errors.append(abs(r.payload - r.named_payload))
    if not errors:
        return None
    taken = [payload in masses for payload in others]
    return Agreement(
        said=len(errors),
        within=float(np.mean(np.array(errors) < MAX_PAYLOAD_ERROR_KG)),
        not_said=len(others),
        taken=float(np.mean(taken)) if taken else 0.0,
    )


def _gains(recordings: list[LabelledRecording]) -> dict[str, tuple[Gains, Gains]]:
    """Estimate the gains of each joint with enough recorded torque."""
    rows: dict[str, list[Array]] = {}
    for r in recordings:
        if r.servo_rows is not None:
            rows.setdefault(r.joint, []).append(r.servo_rows)
    gains = {}
    for joint, parts in rows.items():
        if len(parts) >= MIN_RECORDINGS:
            one_period = [1] * len(parts)
            gains[joint] = (servo_gains(parts, one_period), servo_gains(parts, one_period, last=1))
    return gains


def _read(name: str, log: Log, gain: dict[str, float]) -> LabelledRecording:
    """Return a recording of one moving joint without its labels."""
    ctrl = log.channels["ctrl"]
    qpos = log.channels["qpos"]
    moved = np.flatnonzero(np.ptp(ctrl.values, axis=0) > MIN_MOVE_RAD)
    if len(moved) != 1:
        raise LogError(
            f"{log.source}: {len(moved)} joints are commanded to move; labels are estimated from "
            "recordings of one"
        )
    j = int(moved[0])
    joint = log.joint_names[j]
    commands = ctrl.values[:, j]
    servo_rows = None
    if "tau" in log.channels:
        tau = log.channels["tau"]
        time = tau.time
        torque = tau.values[:, j]
        servo_rows = _servo_rows(log, j)
    else:
        time = qpos.time
        rows = min(len(commands), len(qpos.values))
        torque = gain[joint] * (commands[:rows] - qpos.values[:rows, j])
    time = time[: len(torque)]
    settled = time >= time[0] + SETTLE_S
    commands_then = np.interp(time[settled], ctrl.time, commands)
    return LabelledRecording(
        name,
        joint,
        float(commands[-1]),
        (torque[settled], commands_then),
        _named_payload(log.source),
        servo_rows=servo_rows,
    )


def _servo_rows(log: Log, j: int) -> Array:
    """Return command, position, velocity and torque of joint j at the commands' times, (4, k)."""
    time = log.channels["ctrl"].time

    def sampled(name: str) -> Array:
        channel = log.channels[name]
        values: Array = np.interp(time, channel.time, channel.values[:, j])
        return values

    qpos = sampled("qpos")
    speed = sampled("qvel") if "qvel" in log.channels else np.gradient(qpos, time)
    return np.stack([log.channels["ctrl"].values[:, j], qpos, speed, sampled("tau")])


def _named_payload(source: str) -> float | None:
    """Return the payload in a file's name, kg."""
    file, _, _ = source.partition("#")
    kilograms = PAYLOAD_IN_NAME.search(Path(file).stem)
    return float(kilograms[1].replace("p", ".")) if kilograms else None


def _by_command(recordings: list[LabelledRecording]) -> list[list[LabelledRecording]]:
    """Return the recordings by joint and last command, in their order; `command` becomes their
    mean.
    """
    parts = []
    for joint in dict.fromkeys(r.joint for r in recordings):
        mine = [r for r in recordings if r.joint == joint]
        ends = np.array([r.command for r in mine])
        order = np.argsort(ends)
        cut = np.diff(ends[order]) > MAX_END_DIFFERENCE * max(float(np.ptp(ends)), 1.0)
        for group in np.split(order, np.flatnonzero(cut) + 1):
            part = [mine[i] for i in sorted(group)]
            for r in part:
                r.command = round(float(ends[group].mean()), 2)
            parts.append(part)
    return parts


def _fit(part: list[LabelledRecording], payloads: Sequence[float], units: int) -> LabelGroup:
    """Estimate the labels of the recordings of one joint and command."""
    raw = _at_equal_commands([r.torque for r in part])
    sign = float(np.sign(np.median(raw))) or 1.0
    x = sign * raw  # gravity's torque grows with what hangs on it
    masses = np.asarray(payloads, float)
    if len(x) < len(masses):
        for r in part:
            r.payload = float(masses[0])
        return LabelGroup(part[0].joint, part[0].command, len(part), 0.0, 0.0, np.zeros(0), False)
    step = float(np.median(np.abs(np.diff(x)))) / 0.954  # most neighbours are repetitions
    bands = _bands(x, masses)
    least = max(step / 2, 0.04 * bands.slope)
    fits = []
    for places in itertools.combinations(np.linspace(-2, 2, 9), units):
        zero = bands.zero + np.array(places) * bands.width
        fits.append(_mixture(x, masses, zero, bands.slope, 0.5 * bands.width, least))
    best = _likeliest(fits)
    centres = (best.zero[:, None] + best.slope * masses).ravel()  # unit by unit
    load = masses[np.abs(x[:, None] - centres).argmin(axis=1) % len(masses)]
    jumps = np.abs(np.diff(x)) > MAX_REPETITION_STD * max(step, 1e-6)
    group = np.concatenate([[0], np.cumsum(jumps | (np.diff(load) != 0))])
    mean = np.bincount(group, x) / np.bincount(group)
    first = np.unique(group, return_index=True)[1]
    unit, own = _ranked(mean - best.slope * load[first], load[first], units)
    distance = float(best.slope / bands.width)
    determined = bool(best.slope >= MIN_NM_PER_KG and distance >= MIN_BAND_DISTANCE)
    held = (x - own.mean()) / best.slope
    for i, r in enumerate(part):
        r.payload = float(load[i])
        r.torque_payload = float(held[i])
        r.unit = int(unit[group[i]])
        r.determined = determined
    return LabelGroup(
        joint=part[0].joint,
        command=part[0].command,
        count=len(part),
        slope=sign * best.slope,
        band_distance=distance,
        units=sign * own,
        determined=determined,
    )


def _at_equal_commands(recordings: list[tuple[Array, Array]]) -> Array:
    """Return the mean torque of each at equal commands, (k,) N·m.

    One recording may have begun a period later than another.
    """
    ways = [commands[-1] - commands[0] for _, commands in recordings]
    sign = 1.0 if np.mean(ways) > 0 else -1.0
    risen = [np.maximum.accumulate(sign * commands) for _, commands in recordings]
    low = max(commands[0] for commands in risen)
    high = min(commands[-1] for commands in risen)
    if not high > low:
        return np.array([torque.mean() for torque, _ in recordings])
    grid = np.linspace(low, high, 50)
    means = []
    for commands, (torque, _) in zip(risen, recordings, strict=True):
        means.append(np.interp(grid, commands, torque).mean())
    return np.array(means)


def _ranked(rest: Array, load: Array, units: int) -> tuple[Array, Array]:
    """Return the unit of each group, (k,), by its torque without payload, N·m, and the torque of
    each unit, (units,).

    At each payload the units are in one order; where there are fewer groups than units, the nearest
    unit is taken.
    """
    bands = [np.flatnonzero(load == m) for m in np.unique(load)]
    whole = [band for band in bands if len(band) == units]
    if whole:
        own = np.mean([np.sort(rest[band]) for band in whole], axis=0)
    else:
        own = np.quantile(rest, (np.arange(units) + 0.5) / units)
    unit = np.abs(rest[:, None] - own).argmin(axis=1)
    for band in whole:
        unit[band[np.argsort(rest[band])]] = np.arange(units)
    return unit, own


@dataclass(frozen=True)
class Mixture:
    """Normals of one width at zero + slope · masses: N·m, N·m/kg; zero is (units,)."""

    likelihood: float  # its logarithm
    zero: Array
    slope: float
    width: float


def _likeliest(fits: list[Mixture]) -> Mixture:
    """Return the likeliest fit in which torque grows with the payload; the first if there is
    none.
    """
    rising = [fit for fit in fits if fit.slope > 0]
    return max(rising, key=lambda fit: fit.likelihood, default=fits[0])


@dataclass(frozen=True)
class Bands:
    """Evenly spaced bands of torque, all units together: N·m, N·m/kg; `zero` is without payload."""

    width: float
    slope: float
    zero: float


def _bands(x: Array, masses: Array) -> Bands:
    """Find the bands of torques (k,) N·m for masses (p,) kg."""
    span = float(np.ptp(x)) / float(np.ptp(masses))
    fits = []
    for share in np.linspace(0.4, 1.1, 15):
        slope = share * span
        for zero in np.percentile(x, [0, 5, 10, 15, 20, 25]):
            fits.append(
                _mixture(
                    x, masses, np.array([zero]), slope, 0.3 * share * span, 0.02 * share * span
                )
            )
    best = _likeliest(fits)
    return Bands(max(best.width, 1e-9), best.slope, float(best.zero[0]))


def _mixture(
    x: Array, masses: Array, zero: Array, slope: float, width: float, least: float
) -> Mixture:
    """Fit normals of one width, all with equal weight, by expectation maximisation.

    Args:
        x: Torque of each recording, (k,) N·m.
        masses: kg, (p,).
        zero, slope, width, least: Where to start, (units,) and scalars; no width below `least`.
    """
    torque = x[:, None, None]  # beside (units, masses)
    for _ in range(60):
        squares = (torque - zero[:, None] - slope * masses) ** 2  # (k, units, masses)
        nearest = squares.min(axis=(1, 2), keepdims=True)
        weight = np.exp(-0.5 * (squares - nearest) / width**2)
        weight /= weight.sum(axis=(1, 2), keepdims=True)
        count = np.maximum(weight.sum(axis=(0, 2)), 1e-9)  # (units,)
        mean_mass = (weight * masses).sum(axis=(0, 2)) / count
        mean_torque = (weight * torque).sum(axis=(0, 2)) / count
        aside = masses - mean_mass[:, None]
        covariance = (weight * aside * (torque - mean_torque[:, None])).sum()
        slope = float(covariance / max((weight * aside**2).sum(), 1e-12))
        zero = mean_torque - slope * mean_mass
        apart = torque - zero[:, None] - slope * masses
        width = max(float(np.sqrt((weight * apart**2).sum() / len(x))), least, 1e-9)
    density = np.exp(-0.5 * (apart / width) ** 2).sum(axis=(1, 2))
    likelihood = (np.log(density + 1e-300) - np.log(width)).sum()
    return Mixture(float(likelihood), zero, slope, width)


def write(labels: Labels, folder: Path, rate: float | None = None) -> None:
    """Write logs.toml and labels.csv into a folder, for `gaponet import LOGS --logs
    FOLDER/logs.toml`.
    """
    folder.mkdir(parents=True, exist_ok=True)
    text = io.StringIO()
    sheet = csv.writer(text)
    sheet.writerow(["file", "motion", "unit", "payload", "estimated", "leave_out"])
    for r in labels.recordings:
        payload = r.named_payload
        estimated = "unit"
        if payload is None:
            payload = r.payload
            unsure = "" if r.determined else " (not determined by this joint)"
            estimated = f"unit, payload{unsure}"
        motion = f"{r.joint}-to{r.command:+.2f}"
        leave_out = "yes" if r.copy_of else "no"
        sheet.writerow([r.name, motion, f"unit-{r.unit + 1}", f"{payload:g}", estimated, leave_out])
    write_text(folder / "labels.csv", text.getvalue())
    lines = [
        "# benchmarks/estimate_labels.py: units and payloads are estimated from held torque",
        'manifest = "labels.csv"',
    ]
    if rate:
        lines.append(f"rate = {rate:g}")
    write_text(folder / "logs.toml", "\n".join(lines) + "\n")


def main(
    logs: tyro.conf.Positional[Path],
    robot: str,
    out: Path,
    payloads: tuple[float, ...],
    units: int = 1,
    rate: float | None = None,
) -> None:
    """Estimate which payload each recording of one moving joint carried and which unit made it, by
    held torque.

    Args:
        logs: File or folder of logs.
        robot: Robot name or folder.
        out: Folder for logs.toml and labels.csv, which gaponet import LOGS --logs OUT/logs.toml
            takes.
        payloads: Masses that may have been carried, kg.
        units: Number of robots.
        rate: Hz, of logs without a clock.
    """
    spec = load_robot(robot)
    gain = dict(zip(spec.joint_names, spec.servo.kp.tolist(), strict=True))
    labels = estimate(read_logs(logs, spec, ReadOptions(rate=rate)), payloads, units, gain)
    write(labels, out, rate)
    print("held torque at equal commands:")
    for group in labels.groups:
        zeros = ", ".join(f"{torque:+.2f}" for torque in group.units)
        determined = "" if group.determined else "not "
        print(
            f"  {group.joint} to {group.command:+.2f} rad: {group.count} recordings, "
            f"{group.slope:+.2f} N·m a kg, bands {group.band_distance:.1f} apart, "
            f"units {zeros} N·m, payload {determined}determined"
        )
    for line in labels.remarks:
        print(line)
    print(f"written: {out / 'labels.csv'}")
    print(f"Next: gaponet import {logs} --robot {robot} --logs {out / 'logs.toml'}")


if __name__ == "__main__":
    tyro.cli(main)
