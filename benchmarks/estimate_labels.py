"""Estimation of missing labels: the payload of each recording, and the unit that made it.

A unit is one physical robot.

    python benchmarks/estimate_labels.py LOGS --robot h1_2 --rate 50 --payloads 0 1 2 3 --units 3 --out labels

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
from gaponet.sysid.torque import Gains, servo_gains

MIN_MOVE_RAD = 0.05  # of a command that moves a joint
MAX_END_DIFFERENCE = 0.05  # of two commands that count as one, over the range of a joint's commands
SETTLE_S = 0.1
# standard deviations of a repetition within which neighbours are repetitions
MAX_REPETITION_STD = 3.0
MIN_NM_PER_KG, MIN_BAND_DISTANCE = (
    0.3,
    2.5,
)  # distance in widths of a band, from which a joint determines its payload
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
class Labels:
    """Estimated labels.

    Attributes:
        agreement: Shares of the recordings whose payload agrees with that in the file's name.
        gains: Joint → gains of its servo from torque, of all rows and of the recordings' ends.
    """

    recordings: list[LabelledRecording]
    groups: list[LabelGroup]
    agreement: dict[str, float] = field(default_factory=dict)
    gains: dict[str, tuple[Gains, Gains]] = field(default_factory=dict)

    @property
    def remarks(self) -> list[str]:
        """Return remarks in sentences."""
        a = self.agreement
        lines = [
            f"of {a['said']} recordings with a payload in the file's name, {a['within_half_a_kg']:.0%} are within "
            f"0.5 kg of it; of {a['not_said']} others {a['taken_for_one_of_these']:.0%} are taken for one of these"
        ] if a else []  # fmt: skip
        loaded = [r for r in self.recordings if r.determined and not r.copy_of]
        near = sum(abs(r.torque_payload - r.payload) < MAX_PAYLOAD_ERROR_KG for r in loaded)
        if loaded:
            lines.append(
                f"torque alone, without the unit, gives {near} of {len(loaded)} payloads within "
                f"{MAX_PAYLOAD_ERROR_KG:g} kg of their label"
            )
        return lines + [
            f"{joint}: torque is kp (command − position) − kd velocity, kp {format_uncertainty(g.kp, g.error)} "
            f"N·m/rad ({format_uncertainty(end.kp, end.error)} by the end of recordings), kd {g.kd:.2f} N·m·s/rad: "
            f"{g.explained:.1%} of its variance"
            for joint, (g, end) in self.gains.items()
            if g.trusted
        ]


def estimate(
    logs: Iterable[tuple[str, Log]], payloads: Sequence[float], units: int, gain: dict[str, float]
) -> Labels:
    """Estimate payload and unit of every recording. Payloads in files' names are only compared with
    the estimates.

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
        digest = hashlib.sha256(
            b"".join(log.channels[c].values.tobytes() for c in ("ctrl", "qpos"))
        ).hexdigest()
        first = seen.setdefault((one.joint, digest), one)
        if first is not one:
            one.copy_of = first.name
            first.named_payload = (
                one.named_payload if first.named_payload is None else first.named_payload
            )
            copies.append((one, first))
        recordings.append(one)
    own = list(seen.values())
    groups = [_fit(part, payloads, units) for part in _by_command(own)]
    for one, first in copies:
        one.payload, one.unit, one.determined = first.payload, first.unit, first.determined
    named = [r for r in own if r.named_payload is not None and r.determined]
    agreement = {}
    if named:
        masses = {r.named_payload for r in named}
        others = [r for r in own if r.named_payload is None and r.determined]
        agreement = {
            "said": len(named),
            "within_half_a_kg": float(np.mean([abs(r.payload - (r.named_payload or 0.0)) < MAX_PAYLOAD_ERROR_KG
                                               for r in named])),
            # What a file's name does not list is none of these either, where such files list all of
            # a payload.
            "not_said": len(others),
            "taken_for_one_of_these": float(np.mean([r.payload in masses for r in others] or [False])),
        }  # fmt: skip
    torque_rows: dict[str, list[Array]] = {}
    for r in own:
        torque_rows.setdefault(r.joint, []).extend([] if r.servo_rows is None else [r.servo_rows])
    enough = {joint: rows for joint, rows in torque_rows.items() if len(rows) >= MIN_RECORDINGS}
    gains = {joint: (servo_gains(rows), servo_gains(rows, 1)) for joint, rows in enough.items()}
    return Labels(recordings, groups, agreement, gains)


def _read(name: str, log: Log, gain: dict[str, float]) -> LabelledRecording:
    ctrl, qpos = log.channels["ctrl"], log.channels["qpos"]
    moved = np.flatnonzero(np.ptp(ctrl.values, axis=0) > MIN_MOVE_RAD)
    if len(moved) != 1:
        raise LogError(
            f"{log.source}: {len(moved)} joints are commanded to move; labels are estimated from recordings of one"
        )
    j = int(moved[0])
    joint = log.joint_names[j]
    servo_rows = None
    if tau := log.channels.get("tau"):
        time, values = tau.time, tau.values[:, j]
        at = lambda c: np.interp(ctrl.time, log.channels[c].time, log.channels[c].values[:, j])  # noqa: E731
        speed = at("qvel") if "qvel" in log.channels else np.gradient(at("qpos"), ctrl.time)
        servo_rows = np.stack([ctrl.values[:, j], at("qpos"), speed, at("tau")])
    else:
        time = qpos.time
        values = gain[joint] * (
            ctrl.values[: len(qpos.values), j] - qpos.values[: len(ctrl.values), j]
        )
    later = time[: len(values)] >= time[0] + SETTLE_S
    commands = np.interp(time[: len(values)][later], ctrl.time, ctrl.values[:, j])
    kilograms = PAYLOAD_IN_NAME.search(Path(log.source.partition("#")[0]).stem)
    payload = float(kilograms[1].replace("p", ".")) if kilograms else None
    return LabelledRecording(
        name,
        joint,
        float(ctrl.values[-1, j]),
        (values[later], commands),
        payload,
        servo_rows=servo_rows,
    )


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
    width, slope, base = _bands(x, masses)
    start = [
        base + np.array(d) * width for d in itertools.combinations(np.linspace(-2, 2, 9), units)
    ]
    fits = [_mixture(x, masses, a, slope, 0.5 * width, max(step / 2, 0.04 * slope)) for a in start]
    _, zero, slope, _ = max((f for f in fits if f[2] > 0), key=lambda f: f[0], default=fits[0])
    load = masses[
        np.abs(x[:, None] - (zero[:, None] + slope * masses).ravel()).argmin(axis=1) % len(masses)
    ]
    new = (np.abs(np.diff(x)) > MAX_REPETITION_STD * max(step, 1e-6)) | (np.diff(load) != 0)
    group = np.concatenate([[0], np.cumsum(new)])
    mean = np.bincount(group, x) / np.bincount(group)
    first = np.unique(group, return_index=True)[1]
    unit, own = _ranked(mean - slope * load[first], load[first], units)
    determined = bool(slope >= MIN_NM_PER_KG and slope / width >= MIN_BAND_DISTANCE)
    held = (x - own.mean()) / slope
    for r, g, m, kg in zip(part, group, load, held, strict=True):
        r.payload, r.torque_payload = float(m), float(kg)
        r.unit, r.determined = int(unit[g]), determined
    return LabelGroup(
        part[0].joint,
        part[0].command,
        len(part),
        sign * slope,
        float(slope / width),
        sign * own,
        determined,
    )


def _at_equal_commands(recordings: list[tuple[Array, Array]]) -> Array:
    """Return the mean torque of each at equal commands, (k,) N·m: one may have begun a period later
    than another.
    """
    sign = 1.0 if np.mean([ctrl[-1] - ctrl[0] for _, ctrl in recordings]) > 0 else -1.0
    risen = [np.maximum.accumulate(sign * ctrl) for _, ctrl in recordings]
    low, high = max(r[0] for r in risen), min(r[-1] for r in risen)
    if not high > low:
        return np.array([torque.mean() for torque, _ in recordings])
    grid = np.linspace(low, high, 50)
    return np.array(
        [
            np.interp(grid, r, torque).mean()
            for r, (torque, _) in zip(risen, recordings, strict=True)
        ]
    )


def _ranked(rest: Array, load: Array, units: int) -> tuple[Array, Array]:
    """Return the unit of each group, (k,), by its torque without payload, N·m, and the torque of
    each unit, (units,).

    At each payload the units are in one order; where there are fewer groups than units, the nearest
    unit is taken.
    """
    bands = [np.flatnonzero(load == m) for m in np.unique(load)]
    whole = [np.sort(rest[b]) for b in bands if len(b) == units]
    own = np.mean(whole, axis=0) if whole else np.quantile(rest, (np.arange(units) + 0.5) / units)
    unit = np.abs(rest[:, None] - own).argmin(axis=1)
    for b in bands:
        if len(b) == units:
            unit[b[np.argsort(rest[b])]] = np.arange(units)
    return unit, own


def _bands(x: Array, masses: Array) -> tuple[float, float, float]:
    """Return width, distance per kg and place of the first of evenly spaced bands, all units
    together.
    """
    span = float(np.ptp(x)) / float(np.ptp(masses))
    fits = [
        _mixture(x, masses, np.array([a]), b * span, 0.3 * b * span, 0.02 * b * span)
        for b in np.linspace(0.4, 1.1, 15)
        for a in np.percentile(x, [0, 5, 10, 15, 20, 25])
    ]
    _, zero, slope, width = max((f for f in fits if f[2] > 0), key=lambda f: f[0], default=fits[0])
    return max(width, 1e-9), slope, float(zero[0])


def _mixture(
    x: Array, masses: Array, zero: Array, slope: float, width: float, least: float
) -> tuple[float, Array, float, float]:
    """Fit normals of one width at zero + slope·masses, all with equal weight, by expectation
    maximisation.

    Args:
        x: Torque of each recording, (k,) N·m.
        masses: kg, (p,).
        zero, slope, width, least: Where to start, (units,) and scalars; no width below `least`.

    Returns:
        Log likelihood, zero, slope, width.
    """
    for _ in range(60):
        apart = x[:, None, None] - zero[:, None] - slope * masses  # (k, units, masses)
        w = np.exp(-0.5 * (apart**2 - (apart**2).min(axis=(1, 2), keepdims=True)) / width**2)
        w /= w.sum(axis=(1, 2), keepdims=True)
        n = np.maximum(w.sum(axis=(0, 2)), 1e-9)
        m, mean = (w * masses).sum(axis=(0, 2)) / n, (w * x[:, None, None]).sum(axis=(0, 2)) / n
        aside = masses - m[:, None]
        slope = float(
            (w * aside * (x[:, None, None] - mean[:, None])).sum()
            / max((w * aside**2).sum(), 1e-12)
        )
        zero = mean - slope * m
        apart = x[:, None, None] - zero[:, None] - slope * masses
        width = max(float(np.sqrt((w * apart**2).sum() / len(x))), least, 1e-9)
    likely = np.log(np.exp(-0.5 * (apart / width) ** 2).sum(axis=(1, 2)) + 1e-300) - np.log(width)
    return float(likely.sum()), zero, slope, width


def write(labels: Labels, folder: Path, rate: float | None = None) -> None:
    """Write logs.toml and labels.csv into a folder, for `gaponet import LOGS --logs
    FOLDER/logs.toml`.
    """
    folder.mkdir(parents=True, exist_ok=True)
    text = io.StringIO()
    sheet = csv.writer(text)
    sheet.writerow(["file", "motion", "unit", "payload", "estimated", "leave_out"])
    for r in labels.recordings:
        payload = r.payload if r.named_payload is None else r.named_payload
        unsure = "" if r.determined else " (not determined by this joint)"
        estimated = "unit" if r.named_payload is not None else f"unit, payload{unsure}"
        sheet.writerow([r.name, f"{r.joint}-to{r.command:+.2f}", f"unit-{r.unit + 1}", f"{payload:g}", estimated,
                        "yes" if r.copy_of else "no"])  # fmt: skip
    write_text(folder / "labels.csv", text.getvalue())
    lines = [
        "# benchmarks/estimate_labels.py: units and payloads are estimated from held torque",
        'manifest = "labels.csv"',
    ]
    lines += [f"rate = {rate:g}"] if rate else []
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
            f"{group.slope:+.2f} N·m a kg, bands {group.band_distance:.1f} apart, units {zeros} N·m, "
            f"payload {determined}determined"
        )
    for line in labels.remarks:
        print(line)
    print(f"written: {out / 'labels.csv'}")
    print(f"Next: gaponet import {logs} --robot {robot} --logs {out / 'logs.toml'}")


if __name__ == "__main__":
    tyro.cli(main)
