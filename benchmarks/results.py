"""Measure the numbers of README.md and docs/results.md again.

    python benchmarks/results.py WORK [STEP …]

results.toml lists the steps: commands with their seeds. The output, commit, date and seconds of a
step go to WORK/answers/STEP.json. A step whose command has an answer is skipped, and an
interrupted command resumes where it can. Then docs/results/real.md, benchmarks/steps.md, README's
table and its picture are written from the answers, and page_numbers.py puts the numbers into the
other pages. What was not measured again stays as it was.

    quick     every step in its short form, in WORK/quick; no page changes
    --list    show steps and answers
    --write   only write the pages
    --data FOLDER   public recordings
"""

from __future__ import annotations

import argparse
import json
import os
import re
import shutil
import subprocess
import sys
import time
import tomllib
from collections.abc import Iterable
from dataclasses import dataclass
from datetime import date
from pathlib import Path
from typing import Any

import page_charts
import page_numbers
from real_robots.page import write_page

ROOT = Path(__file__).parents[1]
PAGES = ROOT / "docs" / "results"
# What each step printed; steps.md beside it is for people.
STEPS_LOG = ROOT / "benchmarks" / "steps.json"
LISTED = tomllib.loads(Path(__file__).with_suffix(".toml").read_text(encoding="utf-8"))
README_COLUMNS = (
    ("nominal simulator",),
    ("delay + offset",),
    ("least-squares script", "mujoco.sysid"),
    ("identification",),
    ("identification + network",),
)
QUICK = "quick"
TAIL = 120  # lines of an output on the page
STEPS_HEAD = """# Steps of `make results`

Commands of `benchmarks/results.toml`, and when `make results` last ran each. DATA is the folder of
the public recordings (`GAPONET_DATA`), WORK is `results_work`. `make results STEPS="backlash
hinge"` runs two steps. A step with an answer in WORK/answers is skipped unless its command has
changed; delete the answer to repeat it. A killed step starts again. Commands that store each robot
or set, such as `python benchmarks/compare_methods.py`, then continue. `make results STEPS=quick`
runs each step in its short form and writes no page. Below the table is what steps printed.
"""

Answer = dict[str, Any]  # command, commit, date, seconds and output of a step


@dataclass(frozen=True)
class Step:
    """A command of results.toml."""

    name: str
    command: str
    """With {words} and folders still in it."""
    seeds: str
    quick: str | None
    """Its short form; "" for none, None if the command itself is short."""
    program: str | None
    """A program without which the step is skipped."""

    def filled(self, work: Path, data: Path, *, quick: bool = False) -> str:
        """Return the command with words and folders in place; "" if there is no short form."""
        text = self.command
        if quick and self.quick is not None:
            text = self.quick
        words = text.format(**LISTED["words"], work="{work}", data="{data}")
        return words.format(work=work, data=data)


def listed_steps() -> list[Step]:
    """Return the steps of results.toml, in their order."""
    steps = []
    for name, (command, seeds) in LISTED["steps"].items():
        quick = LISTED["quick"].get(name)
        steps.append(Step(name, command, seeds, quick, LISTED["needs"].get(name)))
    return steps


# ---- measuring


def run_steps(
    steps: Iterable[Step], work: Path, data: Path, *, quick: bool, dry: bool
) -> list[str]:
    """Run the steps whose commands have no answer, and return the names of those that failed.

    Args:
        quick: Run their short forms.
        dry: Only show what there is to do.
    """
    answers = work / "answers"
    answers.mkdir(parents=True, exist_ok=True)
    failed = []
    for step in steps:
        command = step.filled(work, data, quick=quick)
        state = _state(step, command, answers, dry)
        print(f"{step.name}: {state}: {command}", flush=True)
        if state == "runs" and not _measure(step.name, command, answers):
            failed.append(step.name)
            print(f"{step.name}: failed", flush=True)
    return failed


def _state(step: Step, command: str, answers: Path, dry: bool) -> str:
    file = answers / f"{step.name}.json"
    if file.is_file():
        answer = json.loads(file.read_text(encoding="utf-8"))
        if answer.get("command") == command:  # a short form is no answer to the whole one
            return "done before"
    if not command:
        return "left out, it has no short form"
    if dry:
        return "to do"
    if step.program and not shutil.which(step.program):
        return f"skipped, no {step.program} here"
    return "runs"


def _measure(name: str, command: str, answers: Path) -> bool:
    """Run a command; store its answer if it ended well, and return whether it did."""
    began = time.monotonic()
    log = answers / f"{name}.txt"
    commit = _commit()
    paths = {
        "PATH": f"{Path(sys.executable).parent}:{os.environ['PATH']}",
        "PYTHONPATH": str(ROOT / "src"),
    }
    with log.open("w") as file:
        done = subprocess.run(command, shell=True, cwd=ROOT, stdout=file, env=os.environ | paths)
    if done.returncode != 0:
        return False
    answer = {
        "command": command,
        "commit": commit,
        "date": date.today().isoformat(),
        "seconds": round(time.monotonic() - began),
        "output": log.read_text(encoding="utf-8"),
    }
    text = json.dumps(answer, indent=1, ensure_ascii=False)
    log.with_suffix(".json").write_text(text + "\n", encoding="utf-8")
    return True


def _commit() -> str:
    """Return the commit that is measured, with a "+" where code differs from it."""
    commit = _git("rev-parse", "--short=8", "HEAD").strip()
    changed = _git("diff", "HEAD", "--name-only", "--", "src", "benchmarks")
    return f"{commit}+" if changed else commit


def _git(*words: str) -> str:
    return subprocess.run(["git", *words], cwd=ROOT, capture_output=True, text=True).stdout


# ---- pages


def write_pages(steps: list[Step], work: Path) -> None:
    """Write the pages of real robots and of steps, README's table, and the numbers of other
    pages.
    """
    answers = {}
    for step in steps:
        file = work / "answers" / f"{step.name}.json"
        if file.is_file():
            answers[step.name] = json.loads(file.read_text(encoding="utf-8"))
    rows = _write_real_robots(answers)
    _write_steps(steps, answers, work)
    _write_readme(rows)
    picture = work / "so101_id" / "gap.png"  # of so101_causes
    if picture.is_file():
        shutil.copyfile(picture, PAGES / "so101_causes.png")
    for paper in sorted(work.glob("paper_*/paper.json")):
        store_paper(paper)
    for unseen in sorted(work.glob("unseen_*/unseen_simulators.json")):
        shutil.copyfile(unseen, PAGES / f"{unseen.parent.name}.json")
    page_numbers.main()
    page_charts.main()


def _write_real_robots(answers: dict[str, Answer]) -> list[dict[str, Any]]:
    """Replace the rows of docs/results/real.md that were measured again; return all rows."""
    result = json.loads((PAGES / "real.json").read_text(encoding="utf-8"))
    rows = {(row["set"], row["question"], row["method"]): row for row in result["rows"]}
    for name, answer in answers.items():
        if not name.startswith("real_"):
            continue
        new = json.loads(answer["output"])
        for row in new["rows"]:
            row["method"] = LISTED["titles"].get(row["method"], row["method"])
            row["measured"] = measured(answer)
            rows[row["set"], row["question"], row["method"]] = row
        for key in ("labels", "seconds"):
            result[key] |= new[key]
    order = list(result["cards"])
    result["rows"] = sorted(rows.values(), key=lambda row: order.index(row["set"]))
    write_page(result, PAGES)
    with (PAGES / "real.md").open("a", encoding="utf-8") as file:
        file.write("\n| measured | set: rows |\n| --- | --- |\n")
        for when, methods_of_sets in _by_measurement(result["rows"]).items():
            texts = []
            for name, methods in methods_of_sets.items():
                texts.append(f"{name}: {' / '.join(dict.fromkeys(methods))}")
            file.write(f"| {when} | {'; '.join(texts)} |\n")
    kept: list[dict[str, Any]] = result["rows"]
    return kept


def _by_measurement(rows: list[dict[str, Any]]) -> dict[str, dict[str, list[str]]]:
    """Return commit and date → data set → methods that were measured then."""
    made: dict[str, dict[str, list[str]]] = {}
    for row in rows:
        sets = made.setdefault(row["measured"], {})
        sets.setdefault(row["set"], []).append(row["method"])
    return made


def _write_steps(steps: list[Step], answers: dict[str, Answer], work: Path) -> None:
    """Write steps.json and steps.md; steps without an answer keep what is stored."""
    stored = json.loads(STEPS_LOG.read_text(encoding="utf-8"))
    for name, answer in answers.items():
        output: list[str] = []
        if not name.startswith("real_"):  # their output is docs/results/real.json
            text = answer["output"].replace(str(work), "WORK").replace(str(Path.home()), "~")
            output = re.sub(r"/tmp/\S+", "TEMPORARY", text).splitlines()[-TAIL:]
        stored[name] = answer | {"output": output}
        stored[name].pop("command", None)  # steps.md has it
    kept = {step.name: stored[step.name] for step in steps if step.name in stored}
    text = json.dumps(kept, indent=1, ensure_ascii=False)
    STEPS_LOG.write_text(text + "\n", encoding="utf-8")
    page = [STEPS_HEAD, "| step | command | seeds | measured | minutes |"]
    page.append("| --- | --- | --- | --- | ---: |")
    for step in steps:
        done = "– | –"
        if step.name in kept:
            answer = kept[step.name]
            done = f"{measured(answer)} | {answer['seconds'] / 60:.1f}"
        command = step.filled(Path("WORK"), Path("DATA"))
        page.append(f"| {step.name} | `{command}` | {step.seeds} | {done} |")
    for name, answer in kept.items():
        if answer["output"]:
            page.append(f"\n## {name}\n\n```text\n" + "\n".join(answer["output"]) + "\n```")
    STEPS_LOG.with_suffix(".md").write_text("\n".join(page) + "\n", encoding="utf-8")


def _write_readme(rows: list[dict[str, Any]]) -> None:
    readme = ROOT / "README.md"
    table = re.compile(r"(\| real robot \|.*\n\|[- :|]+\|\n)(\|.*\n)+")
    lines = "".join(readme_rows(rows))
    text = table.sub(lambda match: match[1] + lines, readme.read_text(encoding="utf-8"))
    readme.write_text(text, encoding="utf-8")


def readme_rows(rows: list[dict[str, Any]]) -> list[str]:
    """Return the lines of README's table: errors of each column's method, of two rivals the better
    one.
    """
    errors = {}
    for row in rows:
        errors[f"{row['set']}, {row['question']}", row["method"]] = row["mrad"]
    lines = []
    for key, label in LISTED["readme"].items():
        cells = []
        for methods in README_COLUMNS:
            found = [errors[key, method] for method in methods if (key, method) in errors]
            cells.append(f"{min(found):.2f}" if found else "–")
        lines.append(f"| {label} | {' | '.join(cells)} |\n")
    return lines


def store_paper(paper: Path) -> None:
    """Keep facts and tables of the paper's experiment, as page_numbers.toml reads them."""
    whole = json.loads(paper.read_text(encoding="utf-8"))
    tables = {}
    for name, table in whole["tables"].items():
        tables[name] = {"columns": table["columns"], "texts": table["texts"]}
    kept = {"provenance": whole["provenance"], "facts": whole["facts"], "tables": tables}
    text = json.dumps(kept, indent=1, ensure_ascii=False)
    (PAGES / f"{paper.parent.name}.json").write_text(text + "\n", encoding="utf-8")


def measured(answer: Answer) -> str:
    """Return commit and date of an answer."""
    return f"{answer['commit']}, {answer['date']}"


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    data = Path(os.environ.get("GAPONET_DATA", ROOT.parent / "shared/data"))
    parser.add_argument("work", type=Path)
    parser.add_argument("steps", nargs="*", metavar="STEP")
    parser.add_argument("--data", type=Path, default=data)
    parser.add_argument("--list", action="store_true")
    parser.add_argument("--write", action="store_true")
    args = parser.parse_intermixed_args()
    steps = listed_steps()
    names = [step.name for step in steps]
    quick = QUICK in args.steps
    wanted = [name for name in args.steps if name != QUICK] or names
    for name in wanted:
        if name not in names:
            parser.error(f"no step {name}; there are {', '.join(names)}, and {QUICK}")
    work = args.work.resolve()
    if quick:
        work = work / QUICK
    chosen = [step for step in steps if step.name in wanted]
    dry = args.list or args.write
    failed = run_steps(chosen, work, args.data.resolve(), quick=quick, dry=dry)
    if not quick and not args.list:
        write_pages(steps, work)
    if failed:
        print(f"failed: {', '.join(failed)}; the same command tries again")
    else:
        print("no step failed")
    return bool(failed)


if __name__ == "__main__":
    sys.exit(main())
