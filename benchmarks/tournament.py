"""Tournament of identification on random robots (random_robots.py), by commands only: docs/results/robots.md.

    python benchmarks/tournament.py WORK --robots 60 --first 0        # resumes after an interrupt
    python benchmarks/tournament.py WORK --robots 200 --small         # 2 to 4 joints, up to 60 Hz, a minute of logs
    python benchmarks/tournament.py WORK --robots 1 --named ur5e --file-error units   # one public model
    python benchmarks/tournament.py WORK --robots 0                   # the tables

Each seed draws a vendor's file with errors and logs of a plain simulator. Then run gaponet robot new, import, doctor
and identify, and benchmarks/plain_fit.py on the same dataset. gaponet gap measures both on FRESH motions, which no fit
has seen. Each robot has its own process. For a repeated seed, the last line of the journal counts.
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
from pathlib import Path
from typing import Any

import numpy as np
from plain_fit import plain_fit
from random_robots import FILE_ERRORS, RandomRobot, draw_robot, with_file_error

from gaponet.base.files import write_text
from gaponet.cli.main import main as gaponet
from gaponet.data.sequence import Sequence
from gaponet.data.split import split_entries
from gaponet.robot.spec import RobotSpec, load_robot
from gaponet.sim.dataset_robot import open_dataset
from gaponet.sim.metrics import standard_error
from gaponet.sim.replay import rollout_errors

FIELDS = ("kp", "damping", "frictionloss", "armature", "delay", "offset")
WORSE, WORSE_THAN_PLAIN = 1.01, 1.10
FRESH, LATER = 8, 100  # motions that are measured, and the number of the first
SMALL = 60.0  # s recorded of a small robot
Row = dict[str, Any]


class RefusedError(Exception):
    """A command ended with an error."""


class Taken:
    """Wall and processor time since the start, s."""

    def __init__(self) -> None:
        self.began, self.cpu = time.monotonic(), self._cpu()

    def __call__(self) -> tuple[float, float]:
        return time.monotonic() - self.began, self._cpu() - self.cpu

    def _cpu(self) -> float:
        used = resource.getrusage(resource.RUSAGE_SELF)
        return used.ru_utime + used.ru_stime


def call(*words: object) -> str:
    """Run a command and return what it prints."""
    out, said = io.StringIO(), io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(said):
        try:
            code = gaponet(list(map(str, words)))
        except SystemExit as end:  # the command line was not understood
            code = end.code if isinstance(end.code, int) else 1
    if code:
        told = (out.getvalue() + said.getvalue()).strip().splitlines()
        raise RefusedError(f"{words[0]} ended with {code}: {' '.join(told[-3:])}")
    return out.getvalue()


def write(robot: RandomRobot, folder: Path, logs: Iterable[Any]) -> float:
    """Write the logs, one folder per payload; returns the recorded seconds."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    recorded = 0.0
    for log in logs:
        place = folder / f"{log.payload:g}"
        place.mkdir(parents=True, exist_ok=True)
        pq.write_table(pa.table(log.columns(robot.joints)), place / f"{log.motion}.parquet")
        recorded += float(log.time[-1])
    return recorded


def play(
    seed: int,
    folder: Path,
    motions: int,
    seconds: float | None,
    small: bool,
    named: str = "",
    file_error: str = FILE_ERRORS[0],
    rival: bool = True,
) -> Row:
    """Run one robot of the tournament."""
    robot = with_file_error(draw_robot(seed, small=small, named=named), file_error)
    row: Row = {"seed": seed, "small": small, "file_error": file_error, "body": robot.body, "joints": len(robot.joints),
                "rate": robot.rate, "effects": list(robot.effects), "payload": robot.payload,
                "log_noise": vars(robot.log_noise)}  # fmt: skip
    recordings = list(robot.recordings(motions, seconds))
    row["seconds_recorded"] = write(robot, folder / "logs", recordings)
    each, kinds = float(recordings[0].time[-1]), range(LATER, LATER + FRESH)
    carried = [robot.payload * (i % 2) for i in kinds]
    write(robot, folder / "fresh_logs", (
        robot.play(f"fresh{i}", robot.commands(i, each), kg, i) for i, kg in zip(kinds, carried, strict=True)
    ))  # fmt: skip
    (folder / "vendor.xml").write_text(robot.file())
    data, fresh, mine, found = (folder / x for x in ("data", "fresh", "robot", "identified"))
    call("robot", "new", folder / "vendor.xml", "--out", mine, "--rate", robot.rate, "--name", "stranger",
         "--joints", *robot.joints)  # fmt: skip
    if robot.payload:  # where it hangs is known; robot new guesses it
        robot_file = mine / "robot.toml"
        mount = f'[[payload_mount]]\nside = "hand"\nbody = "{robot.bodies[-1]}"\npos = [0.0, 0.0, 0.0]\n'
        robot_file.write_text(robot_file.read_text().partition("[[payload_mount]]")[0] + mount)
    for logs, out in ((folder / "logs", data), (folder / "fresh_logs", fresh)):
        for place in sorted(logs.iterdir()):
            call("import", place, "--robot", mine, "--out", out, "--unit-id", "a", "--payload-mass",
                 place.name, "--position-unit", "rad", "--time-unit", "s")  # fmt: skip
    told = json.loads(call("doctor", data, "--json"))
    row["doctor"] = [
        f"{f['level']} {f['check']}" for f in told["findings"] if f["level"] in ("warning", "error")
    ]
    try:
        took = Taken()
        fit = json.loads(call("identify", data, "--out", found, "--json"))
        row["seconds"], row["cpu"] = took()
        row |= {"warnings": fit["warnings"], "chosen": fit["chosen"], "val": fit["val_mpjae"]}
        row |= inside(robot, found, fit["std"], fit["undetermined"])
    except RefusedError as refused:
        row["refused"] = str(refused)
    best = mine if "refused" in row else found
    measured = json.loads(call("gap", fresh, "--robot", best, "--json"))["methods"]
    row["nominal"] = measured["nominal"]["mpjae"]
    row["identified"] = measured.get("identified", measured["nominal"])["mpjae"]
    judged = open_dataset(str(fresh), None, None)[0]
    whole = judged.sequences(judged.select())
    row["motions"] = {
        "nominal": errors_of(whole, load_robot(mine)),
        "identified": errors_of(whole, load_robot(best)),
    }
    if not rival:
        return row
    took, (dataset, spec) = Taken(), open_dataset(str(data), None, None)
    plain = plain_fit(dataset.sequences(split_entries(dataset)["train"]), spec)
    row["plain_seconds"], row["plain_cpu"] = took()
    row["motions"]["plain"] = errors_of(whole, plain)
    row["plain"] = float(np.mean(row["motions"]["plain"]))
    return row


def errors_of(whole: list[Sequence], robot: RobotSpec) -> list[float]:
    """Return the mean |error| of each motion, rad."""
    return [float(f"{e:.6g}") for e in rollout_errors(whole, robot)]


def inside(
    robot: RandomRobot,
    folder: Path,
    std: dict[str, dict[str, float]],
    undetermined: dict[str, list[str]],
) -> Row:
    """Compare parameters with the truth: deviation in standard errors and relative, by field; counts of those that
    identify reports as not determined."""
    spec, servo = load_robot(folder), robot.servo
    truth = {"kp": servo.kp, "damping": servo.kd + servo.damping, "frictionloss": servo.friction,
             "armature": servo.armature, "delay": servo.delay, "offset": servo.offset}  # fmt: skip
    row: Row = {"sigmas": {}, "relative": {}, "undetermined": {}}
    for field in FIELDS:
        for j, joint in enumerate(robot.joints):
            i = spec.joint_names.index(joint.replace("/", "_"))
            value = spec.servo[field][i] + (spec.servo.kd[i] if field == "damping" else 0.0)
            far, error = (
                abs(float(value - truth[field][j])),
                std.get(joint.replace("/", "_"), {}).get(field),
            )
            if field in undetermined.get(joint.replace("/", "_"), ()):
                row["undetermined"][field] = row["undetermined"].get(field, 0) + 1
            elif error and np.isfinite(far):
                row["sigmas"].setdefault(field, []).append(round(far / error, 2))
                if field not in ("offset", "delay"):
                    row["relative"].setdefault(field, []).append(round(far / truth[field][j], 3))
    return row


def ratios(rows: Iterable[Row], over: str = "nominal") -> np.ndarray:
    """Return the error of the identified robot relative to another one."""
    return np.array([r["identified"] / r[over] for r in rows if over in r])


def level(row: Row) -> bool:
    """Return True if the error exceeds that of the plain script by at most 1 %, or by less than the standard error of
    the paired difference."""
    more = np.subtract(*(row["motions"][k] for k in ("identified", "plain")))
    return bool(more.mean() <= max((WORSE - 1) * row["plain"], standard_error(more)))


def tables(rows: list[Row]) -> list[str]:
    """Return the tables in Markdown."""
    kinds: dict[str, Callable[[Row], bool]] = {
        "all": lambda r: True,
        "servo of the form that is fitted": lambda r: not r["effects"],
        "of another form": lambda r: bool(r["effects"]),
        "public model": lambda r: "/" in r["body"],
    }
    said = ["| robots | how many | never worse | median of nominal | worst | plain's or less | within 1 % | or in ± "
            "| > 10 % | plain, median | s, median | s, worst | plain, s |", "|---|" + "---:|" * 12]  # fmt: skip
    for name, kind in kinds.items():
        some = [r for r in rows if kind(r)]
        if not some:
            continue
        x, y = ratios(some), ratios(some, "plain")
        plain = np.array([r["plain"] / r["nominal"] for r in some if "plain" in r])
        even = [level(r) for r in some if "plain" in r]
        took = np.array([r["cpu"] for r in some if "cpu" in r] or [np.nan])
        theirs = np.array([r["plain_cpu"] for r in some if "plain" in r] or [np.nan])
        said.append(
            f"| {name} | {len(some)} | {np.mean(x <= WORSE):.0%} | {np.median(x):.3f} | {x.max():.2f} | "
            + (f"{np.mean(y <= 1):.0%} | {np.mean(y <= WORSE):.1%} | {np.mean(even):.1%} | "
               f"{np.sum(y > WORSE_THAN_PLAIN)} of {len(y)} | {np.median(plain):.3f} | "
               if len(y) else "– | " * 5)
            + f"{np.median(took):.0f} | {took.max():.0f} | {np.median(theirs):.0f} |"
        )  # fmt: skip
    said += ["", "Never worse: than the file, by 1 %. Within ±: of the standard error of the difference over the fresh "
             "motions. Seconds are of the processor, commands as a whole.", "",
             "| parameter, servos of the form | within 2 standard errors | median distance from the truth | called not "
             "determined |", "|---|---:|---:|---:|"]  # fmt: skip
    for field in FIELDS:
        parts = [r for r in rows if not r["effects"] and field in r.get("sigmas", {})]
        sigmas = np.concatenate([[], *(r["sigmas"][field] for r in parts)])
        if len(sigmas):
            far = np.concatenate([[], *(r["relative"].get(field, []) for r in parts)])
            size = f"{np.median(far):.1%}" if len(far) else "–"
            unknown = sum(r["undetermined"].get(field, 0) for r in parts)
            said.append(
                f"| {field} | {np.mean(sigmas <= 2):.0%} of {len(sigmas)} | {size} | {unknown} |"
            )
    false = [
        f"{r['seed']} ({e.removeprefix('error ')})"
        for r in rows
        for e in r["doctor"]
        if e.startswith("error")
    ]
    twice = [
        f"{r['seed']} {1e3 * r['first']:.3g} → {1e3 * r['identified']:.3g}"
        for r in rows
        if "first" in r
    ]
    said += ["", f"Played again after a mend, mrad: {', '.join(twice)}."] * bool(twice)
    return [*said, "", f"Errors that doctor sees in these good logs: {', '.join(false) or 'none'}."]


def losers(rows: list[Row]) -> list[str]:
    """List robots that are worse than their file or the plain script, and refused ones."""
    said = [
        "| seed | body | joints | Hz | effects | nominal, mrad | identified | plain | what |",
        "|---" * 9 + "|",
    ]
    for r in rows:
        worse = r["identified"] > WORSE * r["nominal"] or ("plain" in r and not level(r))
        if worse or "refused" in r or "plain_refused" in r:
            mrad = [
                f"{1e3 * r[k]:.2f}" if k in r else "–" for k in ("nominal", "identified", "plain")
            ]
            refused = str(r.get("refused") or r.get("plain_refused") or "")
            why = refused[:160].replace("|", "/")
            effects = ", ".join(r["effects"]) or "of the form"
            robot = f"{r['seed']} | {r['body']} | {r['joints']} | {r['rate']:g}"
            said.append(f"| {robot} | {effects} | {' | '.join(mrad)} | {why} |")
    return said


def known(journal: Path) -> dict[int, Row]:
    """Read the journal: seed → its last row, with the first result of a repeated seed. Incomplete lines are skipped."""
    found: dict[int, Row] = {}
    for line in journal.read_text().rpartition("\n")[0].splitlines() if journal.exists() else []:
        row = json.loads(line)
        if row["seed"] in found:
            before = found[row["seed"]]
            row["first"] = before.get("first", before["identified"])
        found[row["seed"]] = row
    return dict(sorted(found.items()))


def main() -> None:
    """Run the missing robots one at a time, then print the tables."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
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
    args.work.mkdir(parents=True, exist_ok=True)
    journal = args.work / "robots.jsonl"
    if known(journal):  # what was cut short goes
        write_text(journal, journal.read_text().rpartition("\n")[0] + "\n")
    seconds = args.seconds or (SMALL if args.small else None)
    for seed in args.seeds or range(args.first, args.first + args.robots):
        # by another process on the same folder, perhaps
        if seed in known(journal) and not args.seeds:
            continue
        folder = args.work / str(seed)
        shutil.rmtree(folder, ignore_errors=True)
        how = (seconds, args.small, args.named, args.file_error, not args.alone)
        with ProcessPoolExecutor(1, multiprocessing.get_context("spawn")) as process:
            r = process.submit(play, seed, folder, args.motions, *how).result()
        with journal.open("a") as file:
            file.write(json.dumps(r) + "\n")
        print(
            f"{seed} {r['body']} {r['joints']} joints {r['rate']:g} Hz {','.join(r['effects']) or 'in form'}: "
            f"{1e3 * r['nominal']:.2f} → {1e3 * r['identified']:.2f} (plain {1e3 * r.get('plain', np.nan):.2f}) mrad, "
            f"{r.get('cpu', np.nan):.0f} s (plain {r.get('plain_cpu', np.nan):.0f} s) {r.get('refused', '')}",
            flush=True,
        )
        if not args.keep:
            shutil.rmtree(folder)
    rows = list(known(journal).values())
    text = "\n".join([*tables(rows), "", *losers(rows)]) + "\n"
    print(text)
    if (ratios(rows) > WORSE).any() or (ratios(rows, "plain") > WORSE_THAN_PLAIN).any():
        parser.exit(
            1,
            "a robot is worse than its file by more than 1 %, or than the plain script by more than 10 %\n",
        )


if __name__ == "__main__":
    main()
