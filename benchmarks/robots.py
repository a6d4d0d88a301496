"""The standing tournament: robots that nobody tuned on (strangers.py), as a user would have them, by commands alone.

    python benchmarks/robots.py WORK --robots 60 --first 0        # goes on where it was cut short
    python benchmarks/robots.py WORK --robots 200 --small         # of 2 to 4 joints, up to 60 Hz, a minute of logs
    python benchmarks/robots.py WORK --robots 1 --named ur5e --spoil units      # one public model
    python benchmarks/robots.py WORK --robots 0 --page docs/results/robots.md

Each seed: a vendor's file that is wrong and logs of a plain simulator; gaponet robot new, import, doctor, identify; and
benchmarks/plain_fit.py on the same dataset. Both are measured by gaponet gap on FRESH motions that are in no dataset
that anything was fitted to, as many of each kind. A process for each robot; of a seed the last line counts.
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
from typing import TYPE_CHECKING, Any

import numpy as np
from plain_fit import plain_fit
from strangers import SPOILS, Stranger, draw, spoiled

from gaponet.base.files import write_text
from gaponet.cli.main import main as gaponet
from gaponet.data.sequence import Sequence
from gaponet.data.split import split_entries
from gaponet.report.figures.style import figure, save, styled
from gaponet.robot.spec import RobotSpec, load_robot
from gaponet.share.reading import open_dataset
from gaponet.sim.metrics import standard_error
from gaponet.sim.replay import whole_errors

if TYPE_CHECKING:
    from matplotlib.figure import Figure

FIELDS = ("kp", "damping", "frictionloss", "armature", "delay", "offset")
WORSE, WORSE_THAN_PLAIN = 1.01, 1.10
MARK = "<!-- below by hand -->\n"
FRESH, LATER = 8, 100  # motions that are measured, and the number of the first
SMALL = 60.0  # s recorded of a small robot
Row = dict[str, Any]


class RefusedError(Exception):
    """A command ended with an error."""


class Taken:
    """Seconds, and those of the processor, since it was made."""

    def __init__(self) -> None:
        self.began, self.cpu = time.monotonic(), self._cpu()

    def __call__(self) -> tuple[float, float]:
        return time.monotonic() - self.began, self._cpu() - self.cpu

    def _cpu(self) -> float:
        used = resource.getrusage(resource.RUSAGE_SELF)
        return used.ru_utime + used.ru_stime


def call(*words: object) -> str:
    """What a command prints."""
    out, said = io.StringIO(), io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(said):
        code = gaponet(list(map(str, words)))
    if code:
        told = (out.getvalue() + said.getvalue()).strip().splitlines()
        raise RefusedError(f"{words[0]} ended with {code}: {' '.join(told[-3:])}")
    return out.getvalue()


def write(robot: Stranger, folder: Path, logs: Iterable[Any]) -> float:
    """The logs, a folder for each payload; seconds recorded."""
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
    spoil: str = SPOILS[0],
    rival: bool = True,
) -> Row:
    """One robot of the tournament."""
    robot = spoiled(draw(seed, small=small, named=named), spoil)
    row: Row = {"seed": seed, "small": small, "spoil": spoil, "body": robot.body, "joints": len(robot.joints),
                "rate": robot.rate, "laws": list(robot.laws), "payload": robot.payload,
                "dirt": vars(robot.dirt)}  # fmt: skip
    recordings = list(robot.recordings(motions, seconds))
    row["seconds_recorded"] = write(robot, folder / "logs", recordings)
    each, kinds = float(recordings[0].time[-1]), range(LATER, LATER + FRESH)
    carried = [robot.payload * (i % 2) for i in kinds]
    write(robot, folder / "fresh_logs", (
        robot.play(f"fresh{i}", robot.commands(i, each), kg, i) for i, kg in zip(kinds, carried, strict=True)
    ))  # fmt: skip
    (folder / "vendor.xml").write_text(robot.file())
    data, fresh, mine, found = (folder / x for x in ("data", "fresh", "robot", "identified"))
    mounts = ["--mounts", f"hand={robot.bodies[-1]}:0,0,0"] if robot.payload else []
    call("robot", "new", folder / "vendor.xml", "--out", mine, "--rate", robot.rate, "--name", "stranger",
         "--joints", *robot.joints, *mounts)  # fmt: skip
    for logs, out in ((folder / "logs", data), (folder / "fresh_logs", fresh)):
        for place in sorted(logs.iterdir()):
            call("import", place, "--robot", mine, "--out", out, "--unit-id", "a", "--payload-mass",
                 place.name, "--position-unit", "rad", "--time-unit", "s")  # fmt: skip
    told = json.loads(call("doctor", data, "--json"))
    row["doctor"] = [f"{f['level']} {f['check']}" for f in told["findings"] if f["level"] in ("warning", "error")]
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
    row["motions"] = {"nominal": errors_of(whole, load_robot(mine)), "identified": errors_of(whole, load_robot(best))}
    if not rival:
        return row
    took, (dataset, spec) = Taken(), open_dataset(str(data), None, None)
    plain = plain_fit(dataset.sequences(split_entries(dataset)["train"]), spec)
    row["plain_seconds"], row["plain_cpu"] = took()
    row["motions"]["plain"] = errors_of(whole, plain)
    row["plain"] = float(np.mean(row["motions"]["plain"]))
    return row


def errors_of(whole: list[Sequence], robot: RobotSpec) -> list[float]:
    """Mean |error| of each motion, rad."""
    return [float(f"{e:.6g}") for e in whole_errors(whole, robot)]


def inside(robot: Stranger, folder: Path, std: dict[str, dict[str, float]], undetermined: dict[str, list[str]]) -> Row:
    """Distance of each parameter called determined from the truth in its standard errors, and in its own size: field →
    numbers; and how many of each field are called not determined."""
    spec, law = load_robot(folder), robot.law
    truth = {"kp": law.kp, "damping": law.kd + law.damping, "frictionloss": law.friction, "armature": law.armature,
             "delay": law.delay, "offset": law.offset}  # fmt: skip
    row: Row = {"sigmas": {}, "relative": {}, "undetermined": {}}
    for field in FIELDS:
        for j, joint in enumerate(robot.joints):
            i = spec.joint_names.index(joint.replace("/", "_"))
            value = getattr(spec, field)[i] + (spec.kd[i] if field == "damping" else 0.0)
            far, error = abs(float(value - truth[field][j])), std.get(joint.replace("/", "_"), {}).get(field)
            if field in undetermined.get(joint.replace("/", "_"), ()):
                row["undetermined"][field] = row["undetermined"].get(field, 0) + 1
            elif error and np.isfinite(far):
                row["sigmas"].setdefault(field, []).append(round(far / error, 2))
                if field not in ("offset", "delay"):
                    row["relative"].setdefault(field, []).append(round(far / truth[field][j], 3))
    return row


def ratios(rows: Iterable[Row], over: str = "nominal") -> np.ndarray:
    """Error of the identified robot over another's."""
    return np.array([r["identified"] / r[over] for r in rows if over in r])


def level(row: Row) -> bool:
    """Whether a robot is at most as far from its fresh motions as the plain script's: by a hundredth, or by less than
    the standard error of the difference, motion by motion."""
    more = np.subtract(*(row["motions"][k] for k in ("identified", "plain")))
    return bool(more.mean() <= max((WORSE - 1) * row["plain"], standard_error(more)))


def tables(rows: list[Row]) -> list[str]:
    """What is claimed, in Markdown."""
    kinds: dict[str, Callable[[Row], bool]] = {
        "all": lambda r: True,
        "servo of the form that is fitted": lambda r: not r["laws"],
        "of another form": lambda r: bool(r["laws"]),
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
        parts = [r for r in rows if not r["laws"] and field in r.get("sigmas", {})]
        sigmas = np.concatenate([[], *(r["sigmas"][field] for r in parts)])
        if len(sigmas):
            far = np.concatenate([[], *(r["relative"].get(field, []) for r in parts)])
            size = f"{np.median(far):.1%}" if len(far) else "–"
            unknown = sum(r["undetermined"].get(field, 0) for r in parts)
            said.append(f"| {field} | {np.mean(sigmas <= 2):.0%} of {len(sigmas)} | {size} | {unknown} |")
    false = [f"{r['seed']} ({e.removeprefix('error ')})" for r in rows for e in r["doctor"] if e.startswith("error")]
    twice = [f"{r['seed']} {1e3 * r['first']:.3g} → {1e3 * r['identified']:.3g}" for r in rows if "first" in r]
    said += ["", f"Played again after a mend, mrad: {', '.join(twice)}."] * bool(twice)
    return [*said, "", f"Errors that doctor sees in these good logs: {', '.join(false) or 'none'}."]


def losers(rows: list[Row]) -> list[str]:
    """Robots that lose to their own file, or to the plain script beyond ± and a hundredth, and those refused."""
    said = ["| seed | body | joints | Hz | law | nominal, mrad | identified | plain | what |", "|---" * 9 + "|"]
    for r in rows:
        worse = r["identified"] > WORSE * r["nominal"] or ("plain" in r and not level(r))
        if worse or "refused" in r or "plain_refused" in r:
            mrad = [f"{1e3 * r[k]:.2f}" if k in r else "–" for k in ("nominal", "identified", "plain")]
            why = r.get("refused", r.get("plain_refused", ""))[:160].replace("|", "/")
            laws = ", ".join(r["laws"]) or "of the form"
            said.append(
                f"| {r['seed']} | {r['body']} | {r['joints']} | {r['rate']:g} | {laws} | {' | '.join(mrad)} | {why} |"
            )
    return said


@styled
def picture(rows: list[Row]) -> Figure:
    """What identification leaves beside what the plain script leaves, each of the vendor's file."""
    fig = figure(4.6, 4.2)
    ax = fig.subplots()
    for name, colour, kind in (("servo of the form", "#1f77b4", True), ("of another form", "#d95f02", False)):
        some = [r for r in rows if (not r["laws"]) == kind and "plain" in r]
        x, y = ([r[k] / r["nominal"] for r in some] for k in ("plain", "identified"))
        ax.scatter(x, y, 14, colour, label=f"{name}, {len(some)}", alpha=0.8)
    every = [r[k] / r["nominal"] for r in rows for k in ("plain", "identified") if k in r]
    ends = [0.7 * min(every), 1.5 * max(every)]
    ax.plot(ends, ends, color="0.6", lw=0.8)
    ax.set(xscale="log", yscale="log", xlim=ends, ylim=ends, aspect="equal",
           xlabel="plain script, share of the file's error", ylabel="gaponet identify")  # fmt: skip
    ax.xaxis.set_major_formatter("{x:g}")
    ax.yaxis.set_major_formatter("{x:g}")
    ax.legend(loc="upper left")
    ax.set_title("VIRTUAL robots that nobody tuned on")
    return fig


def publish(page: Path, rows: list[Row], text: str) -> None:
    """The page and its figure; what stands below the page's mark is kept."""
    head = (
        "# Robots that nobody tuned on\n\n"
        f"`python benchmarks/robots.py WORK --robots N{' --small' * all(r['small'] for r in rows)}`: {len(rows)} "
        "**virtual** robots drawn by seed (`benchmarks/strangers.py`), their\nlogs made by plain MuJoCo with a servo "
        "that gaponet's simulator does not know; by commands alone, as a user would.\n\n"
    )
    kept = page.read_text().partition(MARK)[2] if page.exists() else ""
    page.write_text(f"{head}![]({page.stem}.svg)\n\n{text}\n{MARK}{kept}")
    save(picture(rows), page.with_suffix(".svg"))


def known(journal: Path) -> dict[int, Row]:
    """Seed → its last row, with what was measured first of one played again; a line that was cut short is none."""
    found: dict[int, Row] = {}
    for line in journal.read_text().rpartition("\n")[0].splitlines() if journal.exists() else []:
        row = json.loads(line)
        if row["seed"] in found:
            before = found[row["seed"]]
            row["first"] = before.get("first", before["identified"])
        found[row["seed"]] = row
    return dict(sorted(found.items()))


def main() -> None:
    """Play what is missing, one robot at a time; print the tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("work", type=Path)
    parser.add_argument("--robots", type=int, default=10)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--motions", type=int, default=12)
    parser.add_argument("--seconds", type=float, help="recorded of each robot; default two to five minutes")
    parser.add_argument("--small", action="store_true", help="small robots, a minute of logs")
    parser.add_argument("--alone", action="store_true", help="without the plain script")
    parser.add_argument("--named", default="", help="part of a public model's path: every robot is this one")
    parser.add_argument("--spoil", default=SPOILS[0], choices=SPOILS, help="what its file has wrong beyond that")
    parser.add_argument("--seeds", type=int, nargs="*", help="these, instead of a range; measured again")
    parser.add_argument("--keep", action="store_true", help="keep each robot's folder")
    parser.add_argument("--page", type=Path, help="write the tables here")
    args = parser.parse_args()
    args.work.mkdir(parents=True, exist_ok=True)
    journal = args.work / "robots.jsonl"
    if known(journal):  # what was cut short goes
        write_text(journal, journal.read_text().rpartition("\n")[0] + "\n")
    seconds = args.seconds or (SMALL if args.small else None)
    for seed in args.seeds or range(args.first, args.first + args.robots):
        if seed in known(journal) and not args.seeds:  # by another process on the same folder, perhaps
            continue
        folder = args.work / str(seed)
        shutil.rmtree(folder, ignore_errors=True)
        how = (seconds, args.small, args.named, args.spoil, not args.alone)
        with ProcessPoolExecutor(1, multiprocessing.get_context("spawn")) as process:
            r = process.submit(play, seed, folder, args.motions, *how).result()
        with journal.open("a") as file:
            file.write(json.dumps(r) + "\n")
        print(
            f"{seed} {r['body']} {r['joints']} joints {r['rate']:g} Hz {','.join(r['laws']) or 'in form'}: "
            f"{1e3 * r['nominal']:.2f} → {1e3 * r['identified']:.2f} (plain {1e3 * r.get('plain', np.nan):.2f}) mrad, "
            f"{r.get('cpu', np.nan):.0f} s (plain {r.get('plain_cpu', np.nan):.0f} s) {r.get('refused', '')}",
            flush=True,
        )
        if not args.keep:
            shutil.rmtree(folder)
    rows = list(known(journal).values())
    text = "\n".join([*tables(rows), "", *losers(rows)]) + "\n"
    print(text)
    if args.page:
        publish(args.page, rows, text)
    if (ratios(rows) > WORSE).any() or (ratios(rows, "plain") > WORSE_THAN_PLAIN).any():
        parser.exit(1, "a robot is worse than its file by more than 1 %, or than the plain script by more than 10 %\n")


if __name__ == "__main__":
    main()
