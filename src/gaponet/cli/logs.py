"""gaponet import, doctor."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence as ListOf
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import numpy as np
import tyro

from gaponet import api
from gaponet.base.errors import UsageError
from gaponet.base.files import lock_folder
from gaponet.base.progress import progress_bar
from gaponet.cli.options import Data, Flag, Json, like
from gaponet.cli.out import Out
from gaponet.robot.finding import abbreviate
from gaponet.robot.spec import RobotSpec, load_robot

if TYPE_CHECKING:
    from gaponet.data.doctor import DoctorResult
    from gaponet.data.importer import ImportResult
    from gaponet.data.offsets import JointOffset
    from gaponet.data.store import Entry

MAX_ROWS = 60


@like(api.import_logs)
def import_logs(
    src: tyro.conf.Positional[Path | None] = None, robot: str = "", out: Path | None = None, unit_id: str | None = None,
    payload_mass: float | None = None, payload_side: str | None = None,
    map: Annotated[tuple[str, ...], tyro.conf.UseAppendAction] = (), format: str | None = None,
    logs: Path | None = None, position_unit: Literal["rad", "deg", "fraction", "ticks", "signed_percent"] | None = None,
    time_unit: Literal["s", "ms", "us", "ns"] | None = None, rate: float | None = None, cut: float | None = None,
    level: Literal["joint", "upper_body", "whole_body"] | None = None, kp: tuple[str, ...] = (),
    kd: tuple[str, ...] = (), skip_bad: bool = False, strict: bool = False, allow_pickle: bool = False,
    guess: bool = False, formats: Flag = False, json: Json = False,
) -> None:  # fmt: skip
    """Read a robot's logs into a dataset; the same call adds what is new.

    If one log is bad, nothing is imported. With --skip-bad only the bad log is left out.

    Args:
        src: File or folder of logs.
        robot: Robot name or folder.
        out: Dataset folder; appended to where it exists.
        map: A joint's name in the log and the robot's, as a=b; may be repeated.
        format: Format of the logs; default by inspection; --formats lists them.
        guess: Print a logs.toml for these logs, filled in as far as they show it, and import nothing.
        formats: List the formats that are read, and what each needs.
    """
    if formats:
        _show_formats(Out(json))
        return
    if src is None or not robot:
        raise UsageError(
            "give a folder of logs and --robot ROBOT (or --formats, to see which formats are read)"
        )
    spec = load_robot(robot)
    if guess:
        from gaponet.data.describe.guess import guess_logs
        from gaponet.data.formats import look

        kind, facts, recordings = look(src, format, logs, allow_pickle)
        print(guess_logs(recordings, spec, kind, dict(facts)), end="")
        return
    if out is None:
        raise UsageError(
            "say where the dataset goes: --out FOLDER (or --guess, to see how these logs are described)"
        )
    with progress_bar("importing") as update:
        made = api.import_logs(
            src, robot=spec, out=out, unit_id=unit_id, payload_mass=payload_mass, payload_side=payload_side,
            level=level, format=format, joint_map=joint_map(map), logs=logs, position_unit=position_unit,
            time_unit=time_unit, rate=rate, cut=cut, kp=kp, kd=kd, skip_bad=skip_bad, allow_pickle=allow_pickle,
            strict=strict, progress=update,
        )  # fmt: skip
    _show_import(Out(json), made)


def doctor(
    dataset: Data,
    robot: str | None = None,
    fix: Flag = False,
    figures: Path | None = None,
    json: Json = False,
) -> None:
    """Check a dataset: order, signs, units, rates, gaps, lag, payload.

    Args:
        robot: Robot name or folder, if not the one that the dataset stores.
        fix: Print a proposal for logs.toml after the findings; nothing is applied.
        figures: Folder for a picture of each finding.
    """
    from gaponet.api.opening import driven_by_torque
    from gaponet.robot.finding import Finding
    from gaponet.sim.dataset_robot import open_dataset

    out = Out(json)
    data, spec = open_dataset(dataset, robot)
    with progress_bar("examining") as update:
        diagnosis = api.doctor(data, robot=spec, progress=update)
    out.say(f", {diagnosis.inventory(data)}", spec.name)
    show_diagnosis(out, diagnosis)
    proposal = Finding.proposal(list(diagnosis.findings)) if fix else ""
    for line in proposal.splitlines():
        out.say(line)
    drawn: list[Path] = []
    if figures is not None:
        from gaponet.report.figures.dataset_figures import draw_findings

        with lock_folder(figures, "figures"):
            drawn = draw_findings(data, spec, list(diagnosis.findings), figures)
        out.say(f"{len(drawn)} pictures written: {figures!s}")
    if diagnosis.count("error"):
        out.next(
            "correct the logs, import them into a new folder"
            if fix
            else f"gaponet doctor {dataset} --fix"
        )
    elif driven_by_torque(data):
        out.next(f"gaponet identify {dataset} --out ROBOT")
    else:
        out.next(f"gaponet gap {dataset}")
    out.result({"dataset": data.path.name, "robot": spec.name, "logs_toml": proposal,
                "figures": [str(path) for path in drawn]} | diagnosis.to_dict())  # fmt: skip


def _show_formats(out: Out) -> None:
    from gaponet.data.formats import about, extra_of, formats

    rows = {fmt: (about(fmt), extra) for fmt in formats() if (extra := extra_of(fmt)) is not None}
    out.table("Formats that gaponet import reads", ["format", "what it is", "needs"], [
        [fmt, what, f"gaponet[{extra}]" if extra else ""] for fmt, (what, extra) in rows.items()
    ])  # fmt: skip
    out.say(
        "Other columns: gaponet import LOGS --robot ROBOT --guess > LOGS/logs.toml; then check that file."
    )
    out.result({fmt: {"about": what, "extra": extra} for fmt, (what, extra) in rows.items()})


def _notes(entries: ListOf[Entry], robot: RobotSpec) -> list[str]:
    """Return lines about recordings that were cut, implausible rows, and operated joints that the logs lack."""
    cuts, implausible = (
        defaultdict[str, list[str]](list),
        defaultdict[str, list[tuple[str, dict[str, Any]]]](list),
    )
    for entry in entries:
        if cut := entry.meta.notes.get("cut"):
            cuts[cut].append(entry.meta.motion)
        for channel, rows in entry.meta.notes.get("nonsense", {}).items():
            implausible[channel].append((entry.meta.motion, rows))
    lines = [
        f"{', '.join(motions)}: {cut}; what follows was left out" for cut, motions in cuts.items()
    ]
    lines += [
        f"{channel} is implausible in {sum(rows['rows'] for _, rows in counts)} rows of {len(counts)} recordings "
        f"(first {counts[0][1]['worst']:.4g} of {counts[0][1]['joints'][0]} in {counts[0][0]}): "
        f"{', '.join(dict.fromkeys(rows['done'] for _, rows in counts))}; --strict refuses them"
        for channel, counts in implausible.items()
    ]
    if uneven := [e.meta for e in entries if "why_resampled" in e.meta.notes]:
        why = f"{uneven[0].notes['rows']}; {uneven[0].notes['why_resampled']}"
        lines.append(f"{abbreviate([meta.motion for meta in uneven])}: {why}")
    lacking = [
        j for j in robot.operated if any(j in e.meta.notes.get("held_at_home", ()) for e in entries)
    ]
    where = "missing in some recordings, assumed at the home position there; [posture] in logs.toml sets another"
    return [*lines, f"{abbreviate(lacking)}: {where}"] if lacking else lines


def joint_map(pairs: tuple[str, ...]) -> dict[str, str] | None:
    """("a=b",) → {"a": "b"}."""
    for pair in pairs:
        if pair.count("=") != 1 or not all(part.strip() for part in pair.split("=")):
            raise UsageError(f"--map {pair}: write NAME_IN_LOG=NAME_OF_ROBOT")
    names = {a.strip(): b.strip() for a, b in (pair.split("=") for pair in pairs)}
    if len(names) < len(pairs):
        raise UsageError(f"--map {' '.join(pairs)}: names one joint of the log twice")
    return names or None


def _show_import(out: Out, made: ImportResult) -> None:
    """Print what was added, the lag and the offsets of each joint, and the next command."""
    entries, data, robot, table = made.entries, made.dataset, made.robot, made.to_dict()
    minutes, rates = table["minutes"], table["rate_hz"]
    units = ", ".join(dict.fromkeys(e.meta.unit_id for e in entries))
    payloads = ", ".join(f"{p:g}" for p in sorted({e.meta.payload_mass for e in entries}))
    virtual = "VIRTUAL " if any(e.meta.virtual for e in entries) else ""
    if made.present:
        out.say(f"{len(made.present)} recordings were imported before, {len(made.added)} are new")
    out.say(
        f"{len(entries)} recordings, {minutes:.1f} min at {', '.join(f'{r:g}' for r in rates)} Hz, {virtual}robot "
        f"{robot.name}, unit {units}, payload {payloads} kg; {data.path!s} now holds {len(data)}"
    )
    for line in _notes(entries, robot):
        out.say(f"  {line}", "note", "cyan")
    for line in made.cut[:MAX_ROWS]:
        out.say(f"  {line}", "cut", "yellow")
    if len(made.cut) > MAX_ROWS:
        out.say(f"  … and {len(made.cut) - MAX_ROWS} more; --json lists all", "cut", "yellow")
    offsets = made.offsets or {}
    _show_offsets(out, table["fast_lag_s"], offsets)
    if offsets:
        out.say(
            f"Offsets are recorded in {data.path!s}/offsets.json; nothing was applied to the data."
        )
    out.next(f"gaponet doctor {data.path!s}")
    out.result(table)


def _show_offsets(out: Out, lags: dict[str, list[float]], offsets: dict[str, JointOffset]) -> None:
    """Show lag and static errors by joint."""
    rows = []
    for name, counts in lags.items():
        median = f"{np.median(counts) * 1e3:.0f}" if counts else "–"
        joint = offsets.get(name)
        at_rest = _signed_mrad(joint.static_error, joint.stiction_band) if joint else "–"
        rows.append([name, median, at_rest, _signed_mrad(joint.tracking_offset) if joint else "–"])
    out.table(
        "Lag and errors at rest", ["joint", "lag, ms", "error at rest, mrad", "offset, mrad"], rows
    )
    if offsets:
        out.say(
            "error at rest: state − command ± stiction, both directions. offset: without the sag that kp explains"
        )


def show_diagnosis(out: Out, diagnosis: DoctorResult) -> None:
    """Tables of sequences and joints, the findings, the verdict."""
    shown = diagnosis.sequences[:MAX_ROWS]
    columns = ["motion", "kg", "s", "Hz", "jitter, ms", "longest gap, ms", "lag, ms"]
    out.table("Recordings", columns, [
        [r["motion"] + f" ({r['repetition']})" * (r["repetition"] > 0), f"{r['payload_mass']:g}",
         f"{r['seconds']:.1f}", f"{r['rate_hz']:.2f}", f"{r['jitter_ms']:.2f}", f"{r['longest_gap_ms']:.1f}",
         _span(list(r["fast_lag_s"].values()))]
        for r in shown
    ])  # fmt: skip
    if len(shown) < len(diagnosis.sequences):
        out.say(f"… and {len(diagnosis.sequences) - len(shown)} more; --json lists all")
    columns = ["joint", "commanded, rad", "lag, ms", "error at rest ± stiction, mrad", "rests"]
    out.table("Joints", columns, [
        [r["joint"], "{:.2f}…{:.2f}".format(*r["commanded_rad"]), _lag(r["lag_s"]),
         _signed_mrad(r["static_error_rad"], r["stiction_band_rad"]), str(r["rests"])]
        for r in diagnosis.joints
    ])  # fmt: skip
    out.findings(diagnosis.findings)
    out.say("", diagnosis.verdict)


def _lag(values: dict[str, float] | None) -> str:
    """Median and range, "104 (81–120)"."""
    return (
        f"{values['median'] * 1e3:.0f} ({_span([values['min'], values['max']])})" if values else "–"
    )


def _span(seconds: list[float]) -> str:
    """[0.08, 0.12] → "80–120" ms."""
    low, high = (f"{f(seconds) * 1e3:.0f}" for f in (min, max)) if seconds else ("–", "–")
    return low if low == high else f"{low}–{high}"


def _signed_mrad(value: float | None, band: float | None = None) -> str:
    """0.037, 0.031 → "+37 ± 31"."""
    if value is None:
        return "–"
    return f"{round(value * 1e3):+d}" + (f" ± {band * 1e3:.0f}" if band is not None else "")
