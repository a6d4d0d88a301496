"""A fleet's night: is each robot still the one that is known? Those that moved are adapted; and one page: who
drifted, by what, since when.

OUT/ROBOT.json keeps every night of a robot; a night that is there is not asked again, so what was interrupted goes on.
"""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Iterator
from concurrent.futures import Executor
from dataclasses import dataclass
from pathlib import Path

from typing_extensions import TypedDict

from gaponet.api import adapt_robot
from gaponet.api.logs import unit_recordings
from gaponet.base.errors import GAPONetError, NoGainError, UsageError
from gaponet.base.executor import open_pool
from gaponet.base.files import lock_folder, write_json, write_text
from gaponet.base.structure import read_json
from gaponet.report.page import render
from gaponet.robot.spec import load_robot
from gaponet.sysid.drift import drift
from gaponet.sysid.uncertainty import ParameterUncertainty
from gaponet.sysid.uncertainty_table import format_change

KIND = "fleet"
SAME, FAILED = "same", "not asked"
MARKS = {SAME: "·", "drifted": "■", "contradictory": "?", FAILED: "–"}
SHOWN = 14  # nights


class Night(TypedDict):
    """What came of a robot's logs: verdict of gaponet check, or why there is none; what moved, in words, and of which
    joint and number; mrad before and after an adaptation; processor seconds."""

    night: str
    verdict: str
    advice: str
    moved: list[str]
    numbers: list[tuple[str, str]]
    recordings: int
    seconds: float
    adapted: tuple[float, float] | None
    took: float


@dataclass(frozen=True)
class Job:
    """A robot of the fleet: its folder, its logs, where its adaptation goes (None: it is not adapted)."""

    name: str
    robot: Path
    logs: Path
    unit: str
    night: str
    out: Path | None
    payload_mass: float | None


def ask(job: Job) -> Night:
    """One robot's night."""
    began, spec = time.process_time(), load_robot(job.robot)
    known = ParameterUncertainty.require(spec)
    with unit_recordings(job.logs, spec, job.unit, (), job.payload_mass) as (_, sequences):
        found = drift(spec, known, sequences, 1)
    adapted, advice = None, found.advice
    if found.verdict == "drifted" and job.out is not None:
        try:
            made = adapt_robot(spec, job.logs, out=job.out, unit=job.unit, payload_mass=job.payload_mass)
            adapted = 1e3 * made.before, 1e3 * made.after
        except NoGainError:
            advice += "; an adaptation does not follow these logs better"
    return {
        "night": job.night, "verdict": found.verdict, "advice": advice, "recordings": len(sequences),
        "moved": [
            f"{m.joint} {m.field} {format_change(m.field, m.by, known, m.joint)} ({m.sigmas:+.0f} σ)"
            for m in found.moved
        ],
        "numbers": [(m.joint, m.field) for m in found.moved], "seconds": found.seconds,
        "adapted": adapted, "took": time.process_time() - began,
    }  # fmt: skip


def night(
    robots: Path, logs: Path, out: Path, name: str, adapt: bool = True, payload_mass: float | None = None,
    executor: str | Executor = "local", workers: int = 0,
) -> Iterator[tuple[str, Night, int]]:  # fmt: skip
    """Ask every robot that was not asked that night yet, and write the page.

    Args:
        robots: Folder of robot folders.
        logs: Folder with a folder of logs, or a dataset, of each robot's name; or one dataset with units so called.
        out: Folder of what is found.
        name: What the night is called, such as 2026-11-23.
        adapt: Whether robots that drifted get OUT/adapted/ROBOT.

    Yields:
        Robot, its night, and how many robots there are; of those that were asked before at once.

    Raises:
        UsageError: There are no robots.
    """
    folders = sorted(p.parent for p in robots.glob("*/robot.toml"))
    if not folders:
        raise UsageError(f"{robots}: holds no robot folders; give a folder with one of gaponet identify for each robot")
    one = (logs / "dataset.json").is_file()
    with lock_folder(out, KIND):
        kept = {f.name: history(out / f"{f.name}.json") for f in folders}
        jobs = []
        for f in folders:
            last = kept[f.name][-1] if kept[f.name] else None
            if last and last["night"] == name and last["verdict"] != FAILED:
                yield f.name, last, len(folders)
                continue
            place = out / "adapted" / f.name if adapt else None
            jobs.append(
                Job(f.name, f, logs if one else logs / f.name, f.name if one else "", name, place, payload_mass)
            )
        with open_pool(executor, workers, 1) as pool:
            for outcome in pool.run(ask, jobs):
                if outcome.error is not None and not isinstance(outcome.error, GAPONetError | OSError):
                    raise outcome.error
                found = outcome.value or _failed(name, outcome.error)
                mine = [n for n in kept[outcome.job.name] if n["night"] != name]
                kept[outcome.job.name] = [*mine, found]
                write_json(out / f"{outcome.job.name}.json", kept[outcome.job.name])
                yield outcome.job.name, found, len(folders)
        write_text(out / "fleet.html", fleet_page(kept, name))


def history(file: Path) -> list[Night]:
    """A robot's nights, the first first."""
    return read_json(list[Night], file, UsageError, "remove it: its nights are forgotten") if file.is_file() else []


def since(nights: list[Night]) -> str:
    """The first of the nights in a row on which it was not the same robot; empty where it is."""
    told, first = [n for n in nights if n["verdict"] != FAILED], ""
    for n in reversed(told):
        if n["verdict"] == SAME:
            break
        first = n["night"]
    return first


def _failed(name: str, error: Exception | None) -> Night:
    return {"night": name, "verdict": FAILED, "advice": str(error), "moved": [], "numbers": [], "recordings": 0,
            "seconds": 0.0, "adapted": None, "took": 0.0}  # fmt: skip


def fleet_page(kept: dict[str, list[Night]], name: str) -> str:
    """One page: those that are not as they were, by what, since when; what moved in how many; all others by name."""
    last = {robot: nights[-1] for robot, nights in kept.items() if nights}
    count = Counter(n["verdict"] for n in last.values())
    odd = {r: n for r, n in last.items() if n["verdict"] != SAME}
    strip = lambda robot: "".join(MARKS[n["verdict"]] for n in kept[robot][-SHOWN:])  # noqa: E731
    lines = [
        [robot, since(kept[robot]), strip(robot), "; ".join(n["moved"]) or n["verdict"],
         "{:.1f} → {:.1f}".format(*n["adapted"]) if n["adapted"] else "", n["advice"]]
        for robot, n in sorted(odd.items(), key=lambda item: (since(kept[item[0]]), item[0]))
    ]  # fmt: skip
    moved = Counter(number for n in odd.values() for number in n["numbers"])
    said = ", ".join(f"{k} {verdict}" for verdict, k in count.items())
    return render(
        "fleet.html.j2", title=f"Fleet, {name}", summary=f"{len(last)} robots: {said}", changed=lines,
        legend=", ".join(f"{mark} {what}" for what, mark in MARKS.items()),
        moved=[[f"{j}, {f}", str(k)] for (j, f), k in moved.most_common()],
        unchanged=", ".join(sorted(r for r, n in last.items() if n["verdict"] == SAME)),
    )  # fmt: skip
