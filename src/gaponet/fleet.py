"""Nightly check of a fleet: which robots changed, by what and since when; robots that drifted are adapted.

OUT/ROBOT.json holds every night of a robot. A robot that was checked is not checked again in the same night, so an
interrupted night continues.
"""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Iterator
from concurrent.futures import Executor
from dataclasses import dataclass
from pathlib import Path

from typing_extensions import TypedDict

from gaponet.api import adapt_robot, check
from gaponet.base.errors import GAPONetError, NoGainError, UsageError
from gaponet.base.executor import open_pool
from gaponet.base.files import lock_folder, write_json, write_text
from gaponet.base.structure import read_json
from gaponet.report.page import render
from gaponet.robot.spec import load_robot
from gaponet.sysid.uncertainty import ParameterUncertainty, format_change

KIND = "fleet"
SAME, FAILED = "same", "not checked"
MARKS = {SAME: "·", "drifted": "■", "contradictory": "?", FAILED: "–"}
MAX_NIGHTS_SHOWN = 14


class Night(TypedDict):
    """Result of one robot's check in one night."""

    night: str
    verdict: str  # verdict of gaponet check, or FAILED
    advice: str  # what to do, or why there is no verdict
    moved: list[str]  # parameters that changed, as text; `numbers` has their joint and field
    numbers: list[tuple[str, str]]
    recordings: int
    seconds: float  # duration of the recordings, s
    adapted: tuple[float, float] | None  # error before and after an adaptation, mrad
    took: float  # processor time, s


@dataclass(frozen=True)
class Job:
    """One robot to check: its folder, its logs, and the folder of its adaptation (None: it is not adapted)."""

    name: str
    robot: Path
    logs: Path
    unit: str
    night: str
    out: Path | None
    payload_mass: float | None


def check_robot(job: Job) -> Night:
    """Check one robot, and adapt it if it drifted."""
    began, spec = time.process_time(), load_robot(job.robot)
    checked = check(spec, job.logs, unit=job.unit, payload_mass=job.payload_mass, threads=1)
    uncertainty, adapted, advice = ParameterUncertainty.require(spec), None, checked.advice
    if checked.verdict == "drifted" and job.out is not None:
        try:
            made = adapt_robot(
                spec, job.logs, out=job.out, unit=job.unit, payload_mass=job.payload_mass
            )
            adapted = 1e3 * made.before, 1e3 * made.after
        except NoGainError:
            advice += "; an adaptation does not reduce the error on these logs"
    return {
        "night": job.night, "verdict": checked.verdict, "advice": advice, "recordings": checked.recordings,
        "moved": [
            f"{m.joint} {m.field} {format_change(m.field, m.by, uncertainty, m.joint)} ({m.sigmas:+.0f} σ)"
            for m in checked.drift.moved
        ],
        "numbers": [(m.joint, m.field) for m in checked.drift.moved], "seconds": checked.drift.seconds,
        "adapted": adapted, "took": time.process_time() - began,
    }  # fmt: skip


def check_fleet(
    robots: Path, logs: Path, out: Path, name: str, adapt: bool = True, payload_mass: float | None = None,
    executor: str | Executor = "local", workers: int = 0,
) -> Iterator[tuple[str, Night, int]]:  # fmt: skip
    """Check every robot that was not checked this night, and write the page; arguments as of `gaponet check --fleet`.

    Yields:
        Robot, its night, and the number of robots; first the robots that were checked before.

    Raises:
        UsageError: There are no robots.
    """
    folders = sorted(p.parent for p in robots.glob("*/robot.toml"))
    if not folders:
        raise UsageError(
            f"{robots}: holds no robot folders; give a folder with one of gaponet identify for each robot"
        )
    one_dataset = (logs / "dataset.json").is_file()
    with lock_folder(out, KIND):
        nights = {f.name: load_nights(out / f"{f.name}.json") for f in folders}
        jobs = []
        for f in folders:
            last = nights[f.name][-1] if nights[f.name] else None
            if last and last["night"] == name and last["verdict"] != FAILED:
                yield f.name, last, len(folders)
                continue
            adapted = out / "adapted" / f.name if adapt else None
            source, unit = (logs, f.name) if one_dataset else (logs / f.name, "")
            jobs.append(Job(f.name, f, source, unit, name, adapted, payload_mass))
        with open_pool(executor, workers, 1) as pool:
            for outcome in pool.run(check_robot, jobs):
                if outcome.error is not None and not isinstance(
                    outcome.error, GAPONetError | OSError
                ):
                    raise outcome.error
                none: Night = {
                    "night": name, "verdict": FAILED, "advice": str(outcome.error), "moved": [], "numbers": [],
                    "recordings": 0, "seconds": 0.0, "adapted": None, "took": 0.0,
                }  # fmt: skip
                result, robot = outcome.value or none, outcome.job.name
                nights[robot] = [*(n for n in nights[robot] if n["night"] != name), result]
                write_json(out / f"{robot}.json", nights[robot])
                yield robot, result, len(folders)
        write_text(out / "fleet.html", fleet_page(nights, name))


def load_nights(file: Path) -> list[Night]:
    """Return a robot's nights, the first one first."""
    return (
        read_json(list[Night], file, UsageError, "remove it to forget its nights")
        if file.is_file()
        else []
    )


def changed_since(nights: list[Night]) -> str:
    """Return the first of the last nights in a row in which the robot was not the same; empty if it is the same."""
    first = ""
    for night in reversed([n for n in nights if n["verdict"] != FAILED]):
        if night["verdict"] == SAME:
            break
        first = night["night"]
    return first


def fleet_page(nights: dict[str, list[Night]], name: str) -> str:
    """Return the page: robots that changed, by what and since when; parameters by frequency; unchanged robots."""
    last = {robot: results[-1] for robot, results in nights.items() if results}
    count = Counter(n["verdict"] for n in last.values())
    changed = {r: n for r, n in last.items() if n["verdict"] != SAME}

    def row(robot: str, night: Night) -> list[str]:
        marks = "".join(MARKS[n["verdict"]] for n in nights[robot][-MAX_NIGHTS_SHOWN:])
        errors = "{:.1f} → {:.1f}".format(*night["adapted"]) if night["adapted"] else ""
        moved = "; ".join(night["moved"]) or night["verdict"]
        return [robot, changed_since(nights[robot]), marks, moved, errors, night["advice"]]

    moved = Counter(number for n in changed.values() for number in n["numbers"])
    return render(
        "fleet.html.j2", title=f"Fleet, {name}",
        summary=f"{len(last)} robots: {', '.join(f'{k} {verdict}' for verdict, k in count.items())}",
        changed=sorted((row(robot, night) for robot, night in changed.items()), key=lambda r: (r[1], r[0])),
        legend=", ".join(f"{mark} {verdict}" for verdict, mark in MARKS.items()),
        moved=[[f"{j}, {f}", str(k)] for (j, f), k in moved.most_common()],
        unchanged=", ".join(sorted(r for r, n in last.items() if n["verdict"] == SAME)),
    )  # fmt: skip
