"""gaponet import, formats, doctor."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import numpy as np
import tyro

from gaponet import api
from gaponet.base.errors import UsageError
from gaponet.base.files import lock_folder
from gaponet.cli.options import Flag, Json, Logs, Source, like
from gaponet.cli.out import Out
from gaponet.data.signals import FAST
from gaponet.plugins import attempt
from gaponet.robot.finding import abbreviate
from gaponet.robot.spec import RobotSpec, load_robot

if TYPE_CHECKING:
    from gaponet.data.doctor import Diagnosis
    from gaponet.data.importer import ImportReport
    from gaponet.data.offsets import JointOffset
    from gaponet.data.store import Entry

MAX_ROWS = 60


@like(api.import_logs)
def import_logs(
    src: Logs,
    robot: str,
    out: Path | None = None,
    unit_id: str | None = None,
    payload_mass: float | None = None,
    payload_side: str | None = None,
    map: Annotated[tuple[str, ...], tyro.conf.UseAppendAction] = (),
    format: Literal["sage", "lerobot", "bam", "table", "rosbag", "hdf5", "npz", "mat", "pace", "asap"] | None = None,
    logs: Path | None = None,
    position_unit: Literal["rad", "deg", "fraction", "signed_percent"] | None = None,
    time_unit: Literal["s", "ms", "us", "ns"] | None = None,
    rate: float | None = None,
    cut: float | None = None,
    level: Literal["joint", "upper_body", "whole_body"] | None = None,
    kp: tuple[str, ...] = (),
    kd: tuple[str, ...] = (),
    skip_bad: bool = False,
    strict: bool = False,
    allow_pickle: bool = False,
    guess: bool = False,
    json: Json = False,
) -> None:
    """Read a robot's logs into a dataset; the same call adds what is new.

    A bad log refuses them all (--skip-bad leaves it out instead).

    Args:
        robot: Robot name or folder.
        out: Dataset folder; appended to where it exists.
        payload_side: Which hand carries it: both (default), or the side of one payload mount.
        map: A joint's name in the log and the robot's, as a=b; may be repeated.
        format: Format of the logs; default by looking. gaponet formats lists them.
        logs: A logs.toml: what columns, names, units, signs and clocks mean; default the one in the folder of the logs.
        position_unit: Unit of positions, where the format leaves it open; velocities are that per second.
            signed_percent: LeRobot's older −100..100.
        time_unit: Unit of time, where the format leaves it open.
        rate: Hz, of logs without a clock.
        cut: Cut long recordings into equal pieces of about so long, s; each is a motion of its own.
        level: What the motions move; whole_body by default.
        kp: Stiffness while recording, N·m/rad: a number, or JOINT=NUMBER for some joints; default what the format
            states, else the robot's.
        kd: The same of the damping gain, N·m·s/rad.
        skip_bad: Cut bad rows and leave out logs that cannot be read, and list both, instead of refusing all.
        strict: Refuse logs whose velocity, torque or temperature is nonsense in some rows, instead of making up for it
            there and saying so.
        allow_pickle: Open pickled files (ASAP), with an unpickler that makes arrays, numbers and text only.
        guess: Print a logs.toml for these logs, filled in as far as they show it, and import nothing.
    """
    spec = load_robot(robot)
    if guess:
        from gaponet.data.describe.guess import guess_logs
        from gaponet.data.formats import look

        kind, told, recordings = look(src, format, logs, allow_pickle)
        print(guess_logs(recordings, spec, kind, dict(told)), end="")
        return
    if out is None:
        raise UsageError("say where the dataset goes: --out FOLDER (or --guess, to see how these logs are described)")
    report = api.import_logs(
        src, spec, out, unit_id, payload_mass, payload_side=payload_side, level=level, fmt=format,
        joint_map=joint_map(map), logs=logs, position_unit=position_unit, time_unit=time_unit, rate=rate, cut=cut,
        kp=kp, kd=kd,
        skip_bad=skip_bad, allow_pickle=allow_pickle, strict=strict,
    )  # fmt: skip
    _show_import(Out(json), report, spec)


def doctor(
    dataset: Source, robot: str | None = None, fix: Flag = False, figures: Path | None = None, json: Json = False
) -> None:
    """Check a dataset: order, signs, units, rates, gaps, lag, payload.

    Args:
        robot: Robot name or folder, if not the one that the dataset keeps.
        fix: Print a proposal for logs.toml after the findings; nothing is applied.
        figures: Folder for a picture of each finding.
    """
    from gaponet.data.doctor import Diagnosis
    from gaponet.robot.finding import Finding
    from gaponet.share.reading import open_dataset

    out = Out(json)
    data, spec = open_dataset(dataset, robot)
    diagnosis = api.doctor(data, spec)
    out.say(f", {Diagnosis.inventory(data)}", spec.name)
    show_diagnosis(out, diagnosis)
    mended = Finding.proposal(diagnosis.findings) if fix else ""
    for line in mended.splitlines():
        out.say(line)
    drawn: list[Path] = []
    if figures is not None:
        from gaponet.report.figures.draw_findings import draw_findings

        with lock_folder(figures, "figures"):
            drawn = draw_findings(data, spec, diagnosis.findings, figures)
        out.say(f"{len(drawn)} pictures written: {figures!s}")
    out.say(f"next: gaponet doctor {dataset} --fix" if diagnosis.count("error") else f"next: gaponet gap {dataset}")
    out.result({"dataset": data.path.name, "robot": spec.name, "logs_toml": mended,
                "figures": [str(path) for path in drawn]} | diagnosis.as_dict())  # fmt: skip


def formats(json: Json = False) -> None:
    """List the log formats that are read, and what each needs."""
    from gaponet.data.formats import about, module
    from gaponet.data.formats import formats as known

    out = Out(json)
    extras = {fmt: attempt(where, lambda fmt=fmt: str(module(fmt).EXTRA), None) for fmt, where in known().items()}  # type: ignore[misc]
    rows = {fmt: (about(fmt), extra) for fmt, extra in extras.items() if extra is not None}
    out.table("Formats that gaponet import reads", ["format", "what it is", "needs"], [
        [fmt, what, f"gaponet[{extra}]" if extra else ""] for fmt, (what, extra) in rows.items()
    ])  # fmt: skip
    out.say("Strange columns: gaponet import LOGS --robot ROBOT --guess > LOGS/logs.toml, then look it over.")
    out.result({fmt: {"about": what, "extra": extra} for fmt, (what, extra) in rows.items()})


def _cuts(entries: list[Entry]) -> dict[str, list[str]]:
    """Why recordings were cut → which."""
    found: dict[str, list[str]] = {}
    for entry in entries:
        if cut := entry.meta.notes.get("cut"):
            found.setdefault(cut, []).append(entry.meta.motion)
    return found


def _nonsense(entries: list[Entry]) -> list[str]:
    """What was nonsense in some rows, a line for each channel (data.describe.limits)."""
    told: dict[str, list[tuple[Entry, dict[str, Any]]]] = {}
    for entry in entries:
        for channel, found in entry.meta.notes.get("nonsense", {}).items():
            told.setdefault(channel, []).append((entry, found))
    return [
        f"{channel} is nonsense in {sum(f['rows'] for _, f in found)} rows of {len(found)} recordings (first "
        f"{found[0][1]['worst']:.4g} of {found[0][1]['joints'][0]} in {found[0][0].meta.motion}): "
        f"{', '.join(dict.fromkeys(f['done'] for _, f in found))}; --strict refuses them"
        for channel, found in told.items()
    ]


def _unrecorded(entries: list[Entry], robot: RobotSpec) -> list[str]:
    """A line about operated joints that the logs do not hold."""
    lacking = [j for j in robot.operated if any(j in e.meta.notes.get("held_at_home", ()) for e in entries)]
    if not lacking:
        return []
    return [
        f"{abbreviate(lacking)}: not in every recording, taken to stand at home there; [posture] in logs.toml says "
        "where"
    ]


def joint_map(pairs: tuple[str, ...]) -> dict[str, str] | None:
    """("a=b",) → {"a": "b"}."""
    for pair in pairs:
        if pair.count("=") != 1 or not all(part.strip() for part in pair.split("=")):
            raise UsageError(f"--map {pair}: write NAME_IN_LOG=NAME_OF_ROBOT")
    return {a.strip(): b.strip() for a, b in (pair.split("=") for pair in pairs)} or None


def _show_import(out: Out, report: ImportReport, robot: RobotSpec) -> None:
    """What came in, the lag and the offsets of each joint, and what to do next."""
    entries, data = report.entries or report.present, report.dataset
    minutes = sum(e.rows * e.dt for e in entries) / 60
    rates = sorted({round(1 / e.dt, 2) for e in entries})
    units = ", ".join(dict.fromkeys(e.meta.unit_id for e in entries))
    payloads = ", ".join(f"{p:g}" for p in sorted({e.meta.payload_mass for e in entries}))
    virtual = "VIRTUAL " if any(e.meta.virtual for e in entries) else ""
    if report.present:
        out.say(f"{len(report.present)} there already, {len(report.entries)} added")
    out.say(
        f"{len(entries)} sequences, {minutes:.1f} min at {', '.join(f'{r:g}' for r in rates)} Hz, {virtual}robot "
        f"{robot.name}, unit {units}, payload {payloads} kg; {data.path!s} now holds {len(data)}"
    )
    for cut, motions in _cuts(entries).items():
        out.say(f"  {', '.join(motions)}: {cut}; what follows was left out", "note", "cyan")
    for line in (*_nonsense(entries), *_unrecorded(entries, robot)):
        out.say(f"  {line}", "note", "cyan")
    for line in report.cut[:MAX_ROWS]:
        out.say(f"  {line}", "cut", "yellow")
    if len(report.cut) > MAX_ROWS:
        out.say(f"  … and {len(report.cut) - MAX_ROWS} more; --json lists all", "cut", "yellow")
    lags = {name: _fast_lags(entries, name) for name in robot.operated}
    offsets = report.offsets.joints if report.offsets else {}
    _show_offsets(out, lags, offsets)
    if offsets:
        out.say(f"Offsets are recorded in {data.path!s}/offsets.json; nothing was applied to the data.")
    out.say(f"Next: gaponet doctor {data.path!s}")
    out.result({
        "dataset": str(data.path), "imported": [e.id for e in report.entries],
        "present": [e.id for e in report.present], "sequences": len(data), "minutes": minutes,
        "rate_hz": rates, "fast_lag_s": lags, "delay_s": {e.id: e.findings.get("delay_s", {}) for e in entries},
        "offsets": {name: vars(joint) for name, joint in offsets.items()}, "offsets_applied": False, "cut": report.cut,
    })  # fmt: skip


def _show_offsets(out: Out, lags: dict[str, list[float]], offsets: dict[str, JointOffset]) -> None:
    """Lag and static errors by joint, and why a zero offset is not identified."""
    rows = []
    for name, found in lags.items():
        median = f"{np.median(found) * 1e3:.0f}" if found else "–"
        joint = offsets.get(name)
        at_rest = (
            [_signed_mrad(joint.static_error, joint.stiction_band), _signed_mrad(joint.tracking_offset)]
            if joint
            else ["–", "–"]
        )
        zero = _signed_mrad(joint.zero_offset, joint.zero_std) if joint else "–"
        rows.append([name, median, *at_rest, zero if joint and joint.identifiable else f"({zero})"])
    out.table("Lag in fast motions, ms; errors at rest, mrad", ["joint", "lag", "at rest", "offset", "zero"], rows)
    if not offsets:
        return
    out.say(
        "at rest: state − command half way between both approaches, ± stiction; offset: what of it the nominal model's "
        "gravity sag leaves; zero: turn of the encoder zero that would explain it, ± standard error, in brackets where "
        "it is not identified"
    )
    for reason in dict.fromkeys(joint.reason for joint in offsets.values() if joint.reason):
        joints = ", ".join(name for name, joint in offsets.items() if joint.reason == reason)
        out.say(f"zero not identified for {joints}: {reason}")


def show_diagnosis(out: Out, diagnosis: Diagnosis) -> None:
    """Tables of sequences and joints, the findings, the verdict."""
    shown = diagnosis.sequences[:MAX_ROWS]
    columns = ["motion", "kg", "s", "Hz", "jitter", "gap", "lag"]
    out.table("Sequences; jitter, longest gap and fast lag in ms", columns, [
        [r["motion"], f"{r['payload_mass']:g}", f"{r['seconds']:.1f}", f"{r['rate_hz']:.2f}",
         f"{r['jitter_ms']:.2f}", f"{r['longest_gap_ms']:.1f}", _span(list(r["fast_lag_s"].values()))]
        for r in shown
    ])  # fmt: skip
    if len(shown) < len(diagnosis.sequences):
        out.say(f"… and {len(diagnosis.sequences) - len(shown)} more; --json lists all")
    columns = ["joint", "commanded, rad", "lag", "at rest", "rests"]
    out.table("Joints; fast lag in ms, error at rest ± stiction in mrad", columns, [
        [r["joint"], "{:.2f}…{:.2f}".format(*r["commanded_rad"]), _lag(r["lag_s"]),
         _signed_mrad(r["static_error_rad"], r["stiction_band_rad"]), str(r["rests"])]
        for r in diagnosis.joints
    ])  # fmt: skip
    out.findings(diagnosis.findings)
    out.say("", diagnosis.verdict)


def _fast_lags(entries: list[Entry], joint: str) -> list[float]:
    """Lags of a joint in the sequences that command it fast, s."""

    def of(entry: Entry, name: str) -> float | None:
        return entry.findings.get(name, {}).get(joint)  # a collected recording has none

    found = [of(e, "delay_s") for e in entries if (of(e, "fast_speed") or 0) >= FAST]
    return [lag for lag in found if lag is not None]


def _lag(values: dict[str, float] | None) -> str:
    """Median and range, "104 (81–120)"."""
    return f"{values['median'] * 1e3:.0f} ({_span([values['min'], values['max']])})" if values else "–"


def _span(seconds: list[float]) -> str:
    """[0.08, 0.12] → "80–120" ms."""
    low, high = (f"{f(seconds) * 1e3:.0f}" for f in (min, max)) if seconds else ("–", "–")
    return low if low == high else f"{low}–{high}"


def _signed_mrad(value: float | None, band: float | None = None) -> str:
    """0.037, 0.031 → "+37 ± 31"."""
    if value is None:
        return "–"
    return f"{value * 1e3:+.0f}" + (f" ± {band * 1e3:.0f}" if band is not None else "")
