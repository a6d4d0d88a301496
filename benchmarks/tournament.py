"""Tournament of identification on random robots (random_robots.py), by commands only.

    python benchmarks/tournament.py WORK --robots 60 --first 0   # resumes after an interrupt
    python benchmarks/tournament.py WORK --robots 200 --small    # 2 to 4 joints, up to 60 Hz
    python benchmarks/tournament.py WORK --robots 1 --named ur5e --file-error units
    python benchmarks/tournament.py WORK --robots 0              # the tables

Each seed draws a vendor's file with errors and logs of a plain simulator. Then run gaponet robot
new, import, doctor and identify, and benchmarks/plain_fit.py on the same dataset. gaponet gap
measures both on fresh motions, which no fit has seen. Each robot has its own process. For a
repeated seed, the last line of the journal counts. The results are in docs/results/robots.md.
"""

from __future__ import annotations

import argparse
import contextlib
import io
import json
import multiprocessing
import resource
import shutil
import time
from collections.abc import Callable, Iterable
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from common import Row, append_row, command_line, drop_cut_line, read_rows
from plain_fit import plain_fit
from random_robots import FILE_ERRORS, RandomRobot, Recording, draw_robot, with_file_error

from gaponet.cli.main import main as gaponet
from gaponet.data.sequence import Sequence
from gaponet.data.split import split_entries
from gaponet.robot.spec import RobotSpec, load_robot
from gaponet.sim.dataset_robot import open_dataset
from gaponet.sim.metrics import standard_error
from gaponet.sim.replay import rollout_errors

FIELDS = ("kp", "damping", "frictionloss", "armature", "delay", "offset")
MAX_OF_NOMINAL = 1.01  # error over that of the file; above it the fit has made the robot worse
MAX_OF_PLAIN = 1.10  # error over that of the plain script
FRESH_MOTIONS = 8  # that are measured
FIRST_FRESH = 100  # number of the first of them
SMALL_S = 60.0  # recorded of a small robot
MAX_REASON_LENGTH = 160  # characters of a refusal in the table
NAN = float("nan")
KINDS: dict[str, Callable[[Row], bool]] = {
    "all": lambda row: True,
    "servo of the form that is fitted": lambda row: not row["effects"],
    "of another form": lambda row: bool(row["effects"]),
    "public model": lambda row: "/" in row["body"],
}
ROBOT_COLUMNS = (
    "robots",
    "how many",
    "never worse",
    "median of nominal",
    "worst",
    "plain's or less",
    "within 1 %",
    "or in ±",
    "> 10 %",
    "plain, median",
    "s, median",
    "s, worst",
    "plain, s",
)
PARAMETER_COLUMNS = (
    "parameter, servos of the form",
    "within 2 standard errors",
    "median distance from the truth",
    "called not determined",
)
REMARK = (
    "Never worse: than the file, by 1 %. Within ±: of the standard error of the difference over "
    "the fresh motions. Seconds are of the processor, commands as a whole."
)
LOSER_COLUMNS = (
    "seed",
    "body",
    "joints",
    "Hz",
    "effects",
    "nominal, mrad",
    "identified",
    "plain",
    "what",
)


@dataclass(frozen=True)
class Settings:
    """How robots are drawn and recorded.

    Attributes:
        motions: Recorded of each robot.
        seconds: Recorded in all; None for two to five minutes.
        small: Small robots.
        named: Part of a public model's path; every robot is this one.
        file_error: What the file has wrong beyond that, one of FILE_ERRORS.
        rival: The plain script fits too.
    """

    motions: int
    seconds: float | None
    small: bool
    named: str
    file_error: str
    rival: bool


# ---- one robot


class RefusedError(Exception):
    """A command ended with an error."""


class Stopwatch:
    """Wall and processor time since the start."""

    def __init__(self) -> None:
        self.began_s = time.monotonic()
        self.began_cpu_s = _processor_s()

    def read(self) -> tuple[float, float]:
        """Return seconds on the wall and of the processor."""
        return time.monotonic() - self.began_s, _processor_s() - self.began_cpu_s


def _processor_s() -> float:
    used = resource.getrusage(resource.RUSAGE_SELF)
    return used.ru_utime + used.ru_stime


def call(*words: object) -> str:
    """Run a command and return what it prints."""
    out = io.StringIO()
    err = io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        try:
            code = gaponet(list(map(str, words)))
        except SystemExit as end:  # the command line was not understood
            code = end.code if isinstance(end.code, int) else 1
    if code:
        told = (out.getvalue() + err.getvalue()).strip().splitlines()
        raise RefusedError(f"{words[0]} ended with {code}: {' '.join(told[-3:])}")
    return out.getvalue()


def write(robot: RandomRobot, folder: Path, logs: Iterable[Recording]) -> None:
    """Write the logs, one folder per payload."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    for log in logs:
        place = folder / f"{log.payload:g}"
        place.mkdir(parents=True, exist_ok=True)
        pq.write_table(pa.table(log.columns(robot.joints)), place / f"{log.motion}.parquet")


def play(seed: int, folder: Path, settings: Settings) -> Row:
    """Run one robot of the tournament in a folder."""
    robot = draw_robot(seed, small=settings.small, named=settings.named)
    robot = with_file_error(robot, settings.file_error)
    row: Row = {
        "seed": seed,
        "small": settings.small,
        "file_error": settings.file_error,
        "body": robot.body,
        "joints": len(robot.joints),
        "rate": robot.rate,
        "effects": list(robot.effects),
        "payload": robot.payload,
        "log_noise": vars(robot.log_noise),
    }
    row["seconds_recorded"] = _record(robot, folder, settings)
    nominal = _make_robot(robot, folder)
    data = _import_logs(folder / "logs", nominal, folder / "data")
    fresh = _import_logs(folder / "fresh_logs", nominal, folder / "fresh")
    findings = json.loads(call("doctor", data, "--json"))["findings"]
    bad = [f for f in findings if f["level"] in ("warning", "error")]
    row["doctor"] = [f"{f['level']} {f['check']}" for f in bad]
    identified = folder / "identified"
    try:
        row |= _identify(robot, data, identified)
    except RefusedError as refused:
        row["refused"] = str(refused)
        identified = nominal
    row |= _measure(fresh, nominal, identified)
    if settings.rival:
        row |= _fit_plain(row, data, fresh)
    return row


def _record(robot: RandomRobot, folder: Path, settings: Settings) -> float:
    """Write logs to fit and fresh ones, every second with the payload; return seconds to fit."""
    recordings = list(robot.recordings(settings.motions, settings.seconds))
    write(robot, folder / "logs", recordings)
    motion_s = float(recordings[0].time[-1])
    fresh = []
    for i in range(FIRST_FRESH, FIRST_FRESH + FRESH_MOTIONS):
        payload = robot.payload * (i % 2)
        fresh.append(robot.play(f"fresh{i}", robot.commands(i, motion_s), payload, i))
    write(robot, folder / "fresh_logs", fresh)
    return sum((float(recording.time[-1]) for recording in recordings), 0.0)


def _make_robot(robot: RandomRobot, folder: Path) -> Path:
    """Make a robot folder of the vendor's file."""
    vendor = folder / "vendor.xml"
    vendor.write_text(robot.file())
    made = folder / "robot"
    options = ["--out", made, "--rate", robot.rate, "--name", "stranger"]
    call("robot", "new", vendor, *options, "--joints", *robot.joints)
    if robot.payload:  # where it hangs is known; robot new guesses it
        robot_file = made / "robot.toml"
        before, _, _ = robot_file.read_text().partition("[[payload_mount]]")
        mount = f'side = "hand"\nbody = "{robot.bodies[-1]}"\npos = [0.0, 0.0, 0.0]\n'
        robot_file.write_text(f"{before}[[payload_mount]]\n{mount}")
    return made


def _import_logs(logs: Path, robot: Path, out: Path) -> Path:
    """Import the folders of all payloads into one dataset."""
    units = ["--position-unit", "rad", "--time-unit", "s"]
    for place in sorted(logs.iterdir()):
        payload = ["--unit-id", "a", "--payload-mass", place.name]
        call("import", place, "--robot", robot, "--out", out, *payload, *units)
    return out


def _identify(robot: RandomRobot, data: Path, out: Path) -> Row:
    """Identify the robot; return times, what the command says, and distances from the truth."""
    stopwatch = Stopwatch()
    fit = json.loads(call("identify", data, "--out", out, "--json"))
    seconds, cpu = stopwatch.read()
    return {
        "seconds": seconds,
        "cpu": cpu,
        "warnings": fit["warnings"],
        "chosen": fit["chosen"],
        "val": fit["val_mpjae"],
        **distances(robot, load_robot(out), fit["std"], fit["undetermined"]),
    }


def _measure(fresh: Path, nominal: Path, identified: Path) -> Row:
    """Return the errors on the fresh motions, rad, by gaponet gap and by motion."""
    methods = json.loads(call("gap", fresh, "--robot", identified, "--json"))["methods"]
    motions = _fresh_motions(fresh)
    return {
        "nominal": methods["nominal"]["mpjae"],
        "identified": methods.get("identified", methods["nominal"])["mpjae"],
        "motions": {
            "nominal": errors_of(motions, load_robot(nominal)),
            "identified": errors_of(motions, load_robot(identified)),
        },
    }


def _fresh_motions(fresh: Path) -> list[Sequence]:
    dataset, _ = open_dataset(str(fresh), None, None)
    return dataset.sequences(dataset.select())


def _fit_plain(row: Row, data: Path, fresh: Path) -> Row:
    """Fit the plain script to the same training motions; return its times and errors."""
    stopwatch = Stopwatch()
    dataset, spec = open_dataset(str(data), None, None)
    plain = plain_fit(dataset.sequences(split_entries(dataset)["train"]), spec)
    seconds, cpu = stopwatch.read()
    errors = errors_of(_fresh_motions(fresh), plain)
    return {
        "plain_seconds": seconds,
        "plain_cpu": cpu,
        "motions": row["motions"] | {"plain": errors},
        "plain": float(np.mean(errors)),
    }


def errors_of(motions: list[Sequence], robot: RobotSpec) -> list[float]:
    """Return the mean |error| of each motion, rad."""
    return [float(f"{error:.6g}") for error in rollout_errors(motions, robot)]


def distances(
    robot: RandomRobot,
    spec: RobotSpec,
    std: dict[str, dict[str, float]],
    undetermined: dict[str, list[str]],
) -> Row:
    """Compare parameters with the truth: distances in standard errors and relative, by field.

    Those that identify calls not determined are counted instead.
    """
    true = robot.servo
    truth = {
        "kp": true.kp,
        "damping": true.kd + true.damping,
        "frictionloss": true.friction,
        "armature": true.armature,
        "delay": true.delay,
        "offset": true.offset,
    }
    found = {field: spec.servo[field] for field in FIELDS}
    found["damping"] = found["damping"] + spec.servo.kd
    row: Row = {"sigmas": {}, "relative": {}, "undetermined": {}}
    for field in FIELDS:
        for j, name in enumerate(robot.joints):
            joint = name.replace("/", "_")
            true_value = truth[field][j]
            away = abs(float(found[field][spec.joint_names.index(joint)] - true_value))
            error = std.get(joint, {}).get(field)
            if field in undetermined.get(joint, ()):
                row["undetermined"][field] = row["undetermined"].get(field, 0) + 1
            elif error and np.isfinite(away):
                row["sigmas"].setdefault(field, []).append(round(away / error, 2))
                if field not in ("offset", "delay"):
                    row["relative"].setdefault(field, []).append(round(away / true_value, 3))
    return row


# ---- tables


def ratios(rows: Iterable[Row], over: str = "nominal") -> np.ndarray:
    """Return the error of the identified robot relative to another one."""
    return np.array([row["identified"] / row[over] for row in rows if over in row])


def is_level(row: Row) -> bool:
    """Return whether the error exceeds the plain script's by at most 1 % or the standard error.

    The latter is of the difference paired by motion.
    """
    more = np.subtract(row["motions"]["identified"], row["motions"]["plain"])
    return bool(more.mean() <= max((MAX_OF_NOMINAL - 1) * row["plain"], standard_error(more)))


def tables(rows: list[Row]) -> list[str]:
    """Return the tables in Markdown."""
    lines = _head(ROBOT_COLUMNS)
    for name, is_of_kind in KINDS.items():
        some = [row for row in rows if is_of_kind(row)]
        if some:
            lines.append(_line([name, *_robot_cells(some)]))
    lines += ["", REMARK, "", *_head(PARAMETER_COLUMNS)]
    of_the_form = [row for row in rows if not row["effects"]]
    for field in FIELDS:
        parts = [row for row in of_the_form if field in row.get("sigmas", {})]
        if parts:
            lines.append(_line([field, *_parameter_cells(field, parts)]))
    repeated = [row for row in rows if "first" in row]
    if repeated:
        lines += ["", f"Played again after a mend, mrad: {', '.join(map(_repeated, repeated))}."]
    errors = _doctor_errors(rows)
    lines += ["", f"Errors that doctor sees in these good logs: {', '.join(errors) or 'none'}."]
    return lines


def _head(columns: tuple[str, ...]) -> list[str]:
    return [_line(columns), "|---|" + "---:|" * (len(columns) - 1)]


def _line(cells: Iterable[object]) -> str:
    return f"| {' | '.join(map(str, cells))} |"


def _robot_cells(rows: list[Row]) -> list[str]:
    """Return the cells of one kind of robots behind its name."""
    of_nominal = ratios(rows)
    with_plain = [row for row in rows if "plain" in row]
    cpu = np.array([row["cpu"] for row in rows if "cpu" in row] or [NAN])
    plain_cpu = np.array([row["plain_cpu"] for row in with_plain] or [NAN])
    return [
        str(len(rows)),
        f"{np.mean(of_nominal <= MAX_OF_NOMINAL):.0%}",
        f"{np.median(of_nominal):.3f}",
        f"{of_nominal.max():.2f}",
        *_rival_cells(with_plain),
        f"{np.median(cpu):.0f}",
        f"{cpu.max():.0f}",
        f"{np.median(plain_cpu):.0f}",
    ]


def _rival_cells(rows: list[Row]) -> list[str]:
    """Return the five cells of the comparison with the plain script."""
    if not rows:
        return ["–"] * 5
    of_plain = ratios(rows, "plain")
    plain_of_nominal = [row["plain"] / row["nominal"] for row in rows]
    level = [is_level(row) for row in rows]
    return [
        f"{np.mean(of_plain <= 1):.0%}",
        f"{np.mean(of_plain <= MAX_OF_NOMINAL):.1%}",
        f"{np.mean(level):.1%}",
        f"{np.sum(of_plain > MAX_OF_PLAIN)} of {len(of_plain)}",
        f"{np.median(plain_of_nominal):.3f}",
    ]


def _parameter_cells(field: str, rows: list[Row]) -> list[str]:
    """Return the cells of one field, of robots whose servo has the form that is fitted."""
    sigmas = np.concatenate([row["sigmas"][field] for row in rows])
    relative = np.concatenate([row["relative"].get(field, []) for row in rows])
    unknown = sum(row["undetermined"].get(field, 0) for row in rows)
    size = f"{np.median(relative):.1%}" if len(relative) else "–"
    return [f"{np.mean(sigmas <= 2):.0%} of {len(sigmas)}", size, str(unknown)]


def _repeated(row: Row) -> str:
    return f"{row['seed']} {1e3 * row['first']:.3g} → {1e3 * row['identified']:.3g}"


def _doctor_errors(rows: list[Row]) -> list[str]:
    found = []
    for row in rows:
        for finding in row["doctor"]:
            if finding.startswith("error"):
                found.append(f"{row['seed']} ({finding.removeprefix('error ')})")
    return found


def losers(rows: list[Row]) -> list[str]:
    """List robots that are worse than their file or the plain script, and refused ones."""
    lines = [_line(LOSER_COLUMNS), "|---" * len(LOSER_COLUMNS) + "|"]
    for row in rows:
        is_worse = row["identified"] > MAX_OF_NOMINAL * row["nominal"]
        is_worse_than_plain = "plain" in row and not is_level(row)
        refused = row.get("refused") or row.get("plain_refused") or ""
        if is_worse or is_worse_than_plain or refused:
            cells = [row["seed"], row["body"], row["joints"], f"{row['rate']:g}"]
            cells.append(", ".join(row["effects"]) or "of the form")
            for method in ("nominal", "identified", "plain"):
                cells.append(f"{1e3 * row[method]:.2f}" if method in row else "–")
            cells.append(refused[:MAX_REASON_LENGTH].replace("|", "/"))
            lines.append(_line(cells))
    return lines


# ---- the tournament


def known(journal: Path) -> dict[int, Row]:
    """Read the journal: seed → its last row, with the first result of a repeated seed."""
    found: dict[int, Row] = {}
    for row in read_rows(journal):
        before = found.get(row["seed"])
        if before:
            row["first"] = before.get("first", before["identified"])
        found[row["seed"]] = row
    return dict(sorted(found.items()))


def read_arguments() -> tuple[argparse.Namespace, Settings]:
    """Read the command line."""
    parser = command_line(__doc__)
    parser.add_argument("work", type=Path)
    parser.add_argument("--robots", type=int, default=10)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--motions", type=int, default=12)
    parser.add_argument(
        "--seconds", type=float, help="recorded of each robot; default two to five minutes"
    )
    parser.add_argument("--small", action="store_true", help="small robots, a minute of logs")
    parser.add_argument("--alone", action="store_true", help="without the plain script")
    parser.add_argument(
        "--named", default="", help="part of a public model's path: every robot is this one"
    )
    parser.add_argument(
        "--file-error",
        default=FILE_ERRORS[0],
        choices=FILE_ERRORS,
        help="what its file has wrong beyond that",
    )
    parser.add_argument(
        "--seeds", type=int, nargs="*", help="these, instead of a range; measured again"
    )
    parser.add_argument("--keep", action="store_true", help="keep each robot's folder")
    args = parser.parse_args()
    seconds = args.seconds or None
    if seconds is None and args.small:
        seconds = SMALL_S
    settings = Settings(
        motions=args.motions,
        seconds=seconds,
        small=args.small,
        named=args.named,
        file_error=args.file_error,
        rival=not args.alone,
    )
    return args, settings


def play_missing(args: argparse.Namespace, settings: Settings, journal: Path) -> None:
    """Play the robots that are not in the journal, one at a time, each in a process of its own."""
    for seed in args.seeds or range(args.first, args.first + args.robots):
        # Perhaps another process on the same folder has played it.
        if seed in known(journal) and not args.seeds:
            continue
        folder = args.work / str(seed)
        shutil.rmtree(folder, ignore_errors=True)
        with ProcessPoolExecutor(1, multiprocessing.get_context("spawn")) as process:
            row = process.submit(play, seed, folder, settings).result()
        append_row(journal, row)
        print(_outcome(row), flush=True)
        if not args.keep:
            shutil.rmtree(folder)


def _outcome(row: Row) -> str:
    """Return a line about a robot that was played."""
    effects = ",".join(row["effects"]) or "in form"
    plain = 1e3 * row.get("plain", NAN)
    return (
        f"{row['seed']} {row['body']} {row['joints']} joints {row['rate']:g} Hz {effects}: "
        f"{1e3 * row['nominal']:.2f} → {1e3 * row['identified']:.2f} (plain {plain:.2f}) mrad, "
        f"{row.get('cpu', NAN):.0f} s (plain {row.get('plain_cpu', NAN):.0f} s) "
        f"{row.get('refused', '')}"
    )


def main() -> None:
    """Run the missing robots one at a time, then print the tables."""
    args, settings = read_arguments()
    args.work.mkdir(parents=True, exist_ok=True)
    journal = args.work / "robots.jsonl"
    drop_cut_line(journal)
    play_missing(args, settings, journal)
    rows = list(known(journal).values())
    print("\n".join([*tables(rows), "", *losers(rows)]) + "\n")
    is_worse = (ratios(rows) > MAX_OF_NOMINAL).any()
    if is_worse or (ratios(rows, "plain") > MAX_OF_PLAIN).any():
        raise SystemExit(
            "a robot is worse than its file by more than 1 %, "
            "or than the plain script by more than 10 %"
        )


if __name__ == "__main__":
    main()
