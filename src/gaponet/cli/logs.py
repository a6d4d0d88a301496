"""gaponet import, doctor."""

from __future__ import annotations

from collections import defaultdict
from dataclasses import dataclass, fields
from pathlib import Path
from shlex import quote
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
import tyro

from gaponet import api
from gaponet.api import logs as recordings
from gaponet.api.opening import driven_by_torque, open_dataset
from gaponet.api.options import ImportOptions, parse_joint_map
from gaponet.base.errors import UsageError
from gaponet.base.progress import progress_bar
from gaponet.cli.options import Data, Flag, Json
from gaponet.cli.out import Out
from gaponet.robot.finding import Finding, abbreviate
from gaponet.robot.spec import load_robot

if TYPE_CHECKING:
    from gaponet import DoctorResult, ImportResult

MAX_ROWS = 60
RECORDING_COLUMNS = ["motion", "kg", "s", "Hz", "jitter, ms", "longest gap, ms", "lag, ms"]
JOINT_COLUMNS = ["joint", "commanded, rad", "lag, ms", "error at rest ± stiction, mrad", "rests"]
OFFSET_COLUMNS = ["joint", "lag, ms", "error at rest, mrad", "offset, mrad"]
HELD_AT_HOME = (
    "missing in some recordings, assumed at the home position there; [posture] in logs.toml sets "
    "another"
)


@dataclass(frozen=True)
class ImportArgs(ImportOptions):
    """How logs are read, or what is done instead; joints are mapped by words instead of a
    dictionary."""

    joint_map: tyro.conf.Suppress[None] = None
    map: Annotated[tuple[str, ...], tyro.conf.UseAppendAction] = ()
    """NAME_IN_LOG=NAME_OF_ROBOT of a joint; give the option once for each joint."""
    guess: bool = False
    """Print a proposal for the logs.toml of these logs, and import nothing. A line with a ? is a
    guess that you must check."""
    formats: Flag = False
    """List the formats that can be read and what each of them needs; no logs are needed for
    this."""

    def options(self) -> ImportOptions:
        """Return the options of api.import_logs."""
        values = {field.name: getattr(self, field.name) for field in fields(ImportOptions)}
        values["joint_map"] = parse_joint_map(self.map)
        return ImportOptions(**values)


def import_logs(
    src: Annotated[tyro.conf.Positional[Path | None], tyro.conf.arg(metavar="LOGS")] = None,
    robot: str = "",
    out: Path | None = None,
    unit_id: str | None = None,
    payload_mass: float | None = None,
    args: Annotated[ImportArgs, tyro.conf.arg(name="")] = ImportArgs(),
    json: Json = False,
) -> None:
    """Read a robot's logs into a dataset; the same call adds what is new.

    Give LOGS, --robot and --out. If one log is bad, nothing is imported. With --skip-bad only bad
    rows and logs that cannot be read are left out.

    Args:
        src: File or folder of logs, or hf://USER/DATASET of the Hugging Face Hub.
        robot: Recorded robot: a name such as so101, or a robot folder such as ./my_arm.
        out: Dataset folder to write. If it exists, new recordings are added to it.
        unit_id: Name that you choose for the recorded robot, such as lab, the same in all its logs.
            Needed if the logs do not state it.
        payload_mass: Payload in each hand, kg; 0 for empty hands. Needed if the logs do not state
            it.
        args: How the logs are read.
    """
    if args.formats:
        _show_formats(Out(json))
        return
    if src is None or not robot:
        raise UsageError(
            "give a folder of logs and --robot ROBOT (or --formats, to see which formats are read)"
        )
    options = args.options()
    if args.guess:
        text = recordings.guess_description(src, robot=robot, options=options)
        if json:
            Out(json).result({"logs_toml": text})
        else:
            print(text, end="")
        return
    if out is None:
        raise UsageError(
            "say where the dataset goes: --out FOLDER (or --guess, to see how these logs are "
            "described)"
        )
    spec = load_robot(robot)
    with progress_bar("importing") as update:
        made = api.import_logs(
            src,
            robot=spec,
            out=out,
            unit_id=unit_id,
            payload_mass=payload_mass,
            options=options,
            progress=update,
        )
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
        robot: Robot name or folder. Default: the robot that the dataset stores.
        fix: Print lines for logs.toml that would correct the findings; nothing is changed.
        figures: Folder to which a picture of each finding is written.
    """
    screen = Out(json)
    data, spec = open_dataset(dataset, robot)
    with progress_bar("examining") as update:
        diagnosis = api.doctor(data, robot=spec, progress=update)
    screen.say(f", {diagnosis.inventory(data)}", spec.name)
    show_diagnosis(screen, diagnosis)
    proposal = Finding.proposal(list(diagnosis.findings)) if fix else ""
    for line in proposal.splitlines():
        screen.say(line)
    drawn: list[Path] = []
    if figures is not None:
        drawn = recordings.draw_findings(data, diagnosis, out=figures, robot=spec)
        screen.say(f"{len(drawn)} pictures written: {figures!s}")
    can_be_mended = any(finding.mend for finding in diagnosis.findings)
    if diagnosis.count("error") and (fix or not can_be_mended):
        screen.next("correct the logs, import them into a new folder")
    elif diagnosis.count("error"):
        screen.next(f"gaponet doctor {quote(str(dataset))} --fix")
    elif driven_by_torque(data):
        screen.next(f"gaponet identify {quote(str(dataset))} --out ROBOT")
    else:
        screen.next(f"gaponet gap {quote(str(dataset))}")
    facts = {
        "dataset": data.path.name,
        "robot": spec.name,
        "logs_toml": proposal,
        "figures": [str(path) for path in drawn],
    }
    screen.result(facts | diagnosis.to_dict())


def _show_formats(screen: Out) -> None:
    formats = recordings.log_formats()
    rows = []
    for made in formats:
        rows.append([made.name, made.about, f"gaponet[{made.extra}]" if made.extra else ""])
    screen.table("Formats that gaponet import reads", ["format", "what it is", "needs"], rows)
    screen.say(
        "Other columns: gaponet import LOGS --robot ROBOT --guess > LOGS/logs.toml; then check "
        "that file."
    )
    screen.result({made.name: {"about": made.about, "extra": made.extra} for made in formats})


def _show_import(screen: Out, made: ImportResult) -> None:
    """Print what was added, the lag and the offsets of each joint, and the next command."""
    data = made.dataset
    table = made.to_dict()
    if made.present:
        screen.say(
            f"{len(made.present)} recordings were imported before, {len(made.added)} are new"
        )
    screen.say(f"{_inventory(made, table)}; {data.path!s} now holds {len(data)}")
    for line in _notes(made):
        screen.say(f"  {line}", "note", "cyan")
    for line in made.cut[:MAX_ROWS]:
        screen.say(f"  {line}", "cut", "yellow")
    if len(made.cut) > MAX_ROWS:
        more = len(made.cut) - MAX_ROWS
        screen.say(f"  … and {more} more; --json lists all", "cut", "yellow")
    _show_offsets(screen, made, table["fast_lag_s"])
    if made.offsets:
        screen.say(
            f"Offsets are recorded in {data.path!s}/offsets.json; nothing was applied to the data."
        )
    screen.next(f"gaponet doctor {quote(str(data.path))}")
    screen.result(table)


def _inventory(made: ImportResult, table: dict[str, Any]) -> str:
    """Return how many recordings of what were imported; `table` is the result as JSON has it."""
    metas = [entry.meta for entry in made.entries]
    rates = ", ".join(f"{rate:g}" for rate in table["rate_hz"])
    units = ", ".join(dict.fromkeys(meta.unit_id for meta in metas))
    masses = {meta.payload_mass for meta in metas}
    payloads = ", ".join(f"{mass:g}" for mass in sorted(masses))
    virtual = "VIRTUAL " if any(meta.virtual for meta in metas) else ""
    return (
        f"{len(metas)} recordings, {table['minutes']:.1f} min at {rates} Hz, {virtual}robot "
        f"{made.robot.name}, unit {units}, payload {payloads} kg"
    )


def _notes(made: ImportResult) -> list[str]:
    """Return lines about what was cut, implausible, resampled or missing in the recordings."""
    return [
        *_notes_of_cuts(made),
        *_notes_of_implausible_rows(made),
        *_notes_of_resampling(made),
        *_notes_of_missing_joints(made),
    ]


def _notes_of_cuts(made: ImportResult) -> list[str]:
    motions = defaultdict[str, list[str]](list)  # where it was cut → motions
    for entry in made.entries:
        cut = entry.meta.notes.get("cut")
        if cut:
            motions[cut].append(entry.meta.motion)
    return [
        f"{', '.join(names)}: {cut}; what follows was left out" for cut, names in motions.items()
    ]


def _notes_of_implausible_rows(made: ImportResult) -> list[str]:
    counted = defaultdict[str, list[tuple[str, dict[str, Any]]]](list)  # channel → motion, rows
    for entry in made.entries:
        for channel, rows in entry.meta.notes.get("nonsense", {}).items():
            counted[channel].append((entry.meta.motion, rows))
    lines = []
    for channel, counts in counted.items():
        total = sum(rows["rows"] for _, rows in counts)
        motion, first = counts[0]
        done = ", ".join(dict.fromkeys(rows["done"] for _, rows in counts))
        lines.append(
            f"{channel} is implausible in {total} rows of {len(counts)} recordings (first "
            f"{first['worst']:.4g} of {first['joints'][0]} in {motion}): {done}; --strict refuses "
            "them"
        )
    return lines


def _notes_of_resampling(made: ImportResult) -> list[str]:
    uneven = [entry.meta for entry in made.entries if "why_resampled" in entry.meta.notes]
    if not uneven:
        return []
    first = uneven[0].notes
    motions = abbreviate([meta.motion for meta in uneven])
    return [f"{motions}: {first['rows']}; {first['why_resampled']}"]


def _notes_of_missing_joints(made: ImportResult) -> list[str]:
    held: set[str] = set()
    for entry in made.entries:
        held |= set(entry.meta.notes.get("held_at_home", ()))
    missing = [joint for joint in made.robot.operated if joint in held]
    return [f"{abbreviate(missing)}: {HELD_AT_HOME}"] if missing else []


def _show_offsets(screen: Out, made: ImportResult, lags: dict[str, list[float]]) -> None:
    """Show lag and static errors by joint."""
    offsets = made.offsets or {}
    rows = []
    for name, counts in lags.items():
        median = f"{np.median(counts) * 1e3:.0f}" if counts else "–"
        joint = offsets.get(name)
        at_rest = _signed_mrad(joint.static_error, joint.stiction_band) if joint else "–"
        rows.append([name, median, at_rest, _signed_mrad(joint.tracking_offset) if joint else "–"])
    screen.table("Lag and errors at rest", OFFSET_COLUMNS, rows)
    if offsets:
        screen.say(
            "error at rest: state − command ± stiction, both directions. offset: without the sag "
            "that kp explains"
        )


def show_diagnosis(screen: Out, diagnosis: DoctorResult) -> None:
    """Tables of sequences and joints, the findings, the verdict."""
    shown = diagnosis.sequences[:MAX_ROWS]
    screen.table("Recordings", RECORDING_COLUMNS, [_recording_row(facts) for facts in shown])
    more = len(diagnosis.sequences) - len(shown)
    if more:
        screen.say(f"… and {more} more; --json lists all")
    screen.table("Joints", JOINT_COLUMNS, [_joint_row(facts) for facts in diagnosis.joints])
    screen.findings(diagnosis.findings)
    screen.say("", diagnosis.verdict)


def _recording_row(facts: dict[str, Any]) -> list[str]:
    repetition = f" ({facts['repetition']})" if facts["repetition"] else ""
    return [
        facts["motion"] + repetition,
        f"{facts['payload_mass']:g}",
        f"{facts['seconds']:.1f}",
        f"{facts['rate_hz']:.2f}",
        f"{facts['jitter_ms']:.2f}",
        f"{facts['longest_gap_ms']:.1f}",
        _span(list(facts["fast_lag_s"].values())),
    ]


def _joint_row(facts: dict[str, Any]) -> list[str]:
    low, high = facts["commanded_rad"]
    return [
        facts["joint"],
        f"{low:.2f}…{high:.2f}",
        _lag(facts["lag_s"]),
        _signed_mrad(facts["static_error_rad"], facts["stiction_band_rad"]),
        str(facts["rests"]),
    ]


def _lag(values: dict[str, float] | None) -> str:
    """Return median and range, "104 (81–120)"."""
    if not values:
        return "–"
    return f"{values['median'] * 1e3:.0f} ({_span([values['min'], values['max']])})"


def _span(seconds: list[float]) -> str:
    """Return [0.08, 0.12] as "80–120" ms."""
    if not seconds:
        return "–"
    low = f"{min(seconds) * 1e3:.0f}"
    high = f"{max(seconds) * 1e3:.0f}"
    return low if low == high else f"{low}–{high}"


def _signed_mrad(value: float | None, band: float | None = None) -> str:
    """Return 0.037, 0.031 as "+37 ± 31"."""
    if value is None:
        return "–"
    text = f"{round(value * 1e3):+d}"
    return text if band is None else f"{text} ± {band * 1e3:.0f}"
