"""Measure the numbers of README.md and docs/results.md again: python benchmarks/results.py WORK [STEP …]

results.toml lists the steps: commands with their seeds. The output, commit, date and seconds of a step go to
WORK/answers/STEP.json. A step with an answer is skipped, and an interrupted command resumes where it can. Then
docs/results/real.md, benchmarks/steps.md, README's table and its picture are written from the answers, and
page_numbers.py puts the numbers into the other pages. What was not measured again stays as it was.

    --list    show steps and answers       --write   only write the pages       --data FOLDER   public recordings
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
from datetime import date
from pathlib import Path
from typing import Any

import page_charts
import page_numbers
from real_robots.page import write_page

ROOT = Path(__file__).parents[1]
PAGES = ROOT / "docs" / "results"
STEPS_LOG = (
    ROOT / "benchmarks" / "steps.json"
)  # what each step printed; steps.md beside it is for people
LISTED = tomllib.loads(Path(__file__).with_suffix(".toml").read_text(encoding="utf-8"))
STEPS: dict[str, list[str]] = LISTED["steps"]
README_COLUMNS = (
    ("nominal simulator",),
    ("delay + offset",),
    ("least-squares script", "mujoco.sysid"),
    ("identification",),
    ("identification + network",),
)
TAIL = 60  # lines of an output on the page
STEPS_HEAD = """# Steps of `make results`

Commands of `benchmarks/results.toml`, and when `make results` last ran each. DATA is the folder of the public
recordings (`GAPONET_DATA`), WORK is `results_work`. `make results STEPS="backlash hinge"` runs two steps. A step with
an answer in WORK/answers is skipped; delete the answer to repeat it. A killed step starts again. Commands that store
each robot or set, such as `python benchmarks/compare_methods.py`, then continue. Below the table is what steps printed.
"""


def measure(name: str, command: str, work: Path) -> bool:
    """Run a step; store its answer if it ended well, and return whether it did."""
    began, log = time.monotonic(), work / "answers" / f"{name}.txt"
    git = lambda *words: (  # noqa: E731
        subprocess.run(["git", *words], cwd=ROOT, capture_output=True, text=True).stdout
    )
    changed = git("diff", "HEAD", "--name-only", "--", "src", "benchmarks")
    commit = git("rev-parse", "--short=8", "HEAD").strip() + "+" * bool(changed)
    paths = {
        "PATH": f"{Path(sys.executable).parent}:{os.environ['PATH']}",
        "PYTHONPATH": str(ROOT / "src"),
    }
    with log.open("w") as file:
        code = subprocess.run(
            command, shell=True, cwd=ROOT, stdout=file, env=os.environ | paths
        ).returncode
    answer = {
        "commit": commit,
        "date": date.today().isoformat(),
        "seconds": round(time.monotonic() - began),
    }
    if code == 0:
        answer["output"] = log.read_text(encoding="utf-8")
        log.with_suffix(".json").write_text(
            json.dumps(answer, indent=1, ensure_ascii=False) + "\n", encoding="utf-8"
        )
    return code == 0


def write(answers: dict[str, dict[str, Any]], work: Path) -> None:
    """Write the pages of real robots and of steps, README's table and its picture."""
    result = json.loads((PAGES / "real.json").read_text(encoding="utf-8"))
    rows = {(r["set"], r["question"], r["method"]): r for r in result["rows"]}
    for answer in (a for name, a in answers.items() if name.startswith("real_")):
        new = json.loads(answer["output"])
        for r in new["rows"]:
            r |= {
                "method": LISTED["titles"].get(r["method"], r["method"]),
                "measured": measured(answer),
            }
            rows[r["set"], r["question"], r["method"]] = r
        result |= {key: result[key] | new[key] for key in ("labels", "seconds")}
    order = [*result["cards"]]
    result["rows"] = sorted(rows.values(), key=lambda r: order.index(r["set"]))
    write_page(result, PAGES)
    made: dict[str, dict[str, list[str]]] = {}
    for r in result["rows"]:
        made.setdefault(r["measured"], {}).setdefault(r["set"], []).append(r["method"])
    with (PAGES / "real.md").open("a", encoding="utf-8") as file:
        file.write("\n| measured | set: rows |\n| --- | --- |\n")
        for when, sets in made.items():
            text = "; ".join(
                f"{name}: {' / '.join(dict.fromkeys(methods))}" for name, methods in sets.items()
            )
            file.write(f"| {when} | {text} |\n")
    kept = json.loads(STEPS_LOG.read_text(encoding="utf-8"))
    for name, a in answers.items():
        text = re.sub(r"/tmp/\S+", "TEMPORARY", a["output"].replace(str(work), "WORK"))
        kept[name] = a | {"output": [] if name.startswith("real_") else text.splitlines()[-TAIL:]}
    kept = {name: kept[name] for name in STEPS if name in kept}
    text = json.dumps(kept, indent=1, ensure_ascii=False)
    STEPS_LOG.write_text(text + "\n", encoding="utf-8")
    page = [STEPS_HEAD]
    page.append("| step | command | seeds | measured | minutes |\n| --- | --- | --- | --- | ---: |")
    for name, (command, seeds) in STEPS.items():
        done = "– | –"
        if name in kept:
            done = f"{measured(kept[name])} | {kept[name]['seconds'] / 60:.1f}"
        page.append(
            f"| {name} | `{filled(command, Path('WORK'), Path('DATA'))}` | {seeds} | {done} |"
        )
    page += [
        f"\n## {name}\n\n```text\n" + "\n".join(a["output"]) + "\n```"
        for name, a in kept.items()
        if a["output"]
    ]
    STEPS_LOG.with_suffix(".md").write_text("\n".join(page) + "\n", encoding="utf-8")
    if (picture := work / "so101_id" / "gap.png").is_file():  # of so101_causes
        shutil.copyfile(picture, PAGES / "so101_causes.png")
    readme = (ROOT / "README.md").read_text(encoding="utf-8")
    table = re.compile(r"(\| real robot \|.*\n\|[- :|]+\|\n)(\|.*\n)+")
    text = "".join(readme_rows(result["rows"]))
    (ROOT / "README.md").write_text(table.sub(lambda m: m[1] + text, readme), encoding="utf-8")
    for paper in sorted(work.glob("paper_*/paper.json")):
        store_paper(paper)
    for unseen in sorted(work.glob("unseen_*/unseen_simulators.json")):
        shutil.copyfile(unseen, PAGES / f"{unseen.parent.name}.json")
    page_numbers.main()
    page_charts.main()


def store_paper(paper: Path) -> None:
    """Keep facts and tables of the paper's experiment, as page_numbers.toml reads them."""
    whole = json.loads(paper.read_text(encoding="utf-8"))
    tables = {
        name: {"columns": table["columns"], "texts": table["texts"]}
        for name, table in whole["tables"].items()
    }
    kept = {"provenance": whole["provenance"], "facts": whole["facts"], "tables": tables}
    text = json.dumps(kept, indent=1, ensure_ascii=False)
    (PAGES / f"{paper.parent.name}.json").write_text(text + "\n", encoding="utf-8")


def measured(answer: dict[str, Any]) -> str:
    return f"{answer['commit']}, {answer['date']}"


def readme_rows(rows: list[dict[str, Any]]) -> list[str]:
    """Return the lines of README's table: errors of each column's method, of two rivals the better one."""
    errors = {(f"{r['set']}, {r['question']}", r["method"]): r["mrad"] for r in rows}
    lines = []
    for key, label in LISTED["readme"].items():
        cells = [
            min((errors[key, m] for m in methods if (key, m) in errors), default=None)
            for methods in README_COLUMNS
        ]
        lines.append(f"| {label} | {' | '.join(f'{c:.2f}' if c else '–' for c in cells)} |\n")
    return lines


def filled(command: str, work: Path, data: Path) -> str:
    """Return a step's command with words and folders in place."""
    return command.format(**LISTED["words"], work="{work}", data="{data}").format(
        work=work, data=data
    )


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("work", type=Path)
    parser.add_argument("steps", nargs="*", metavar="STEP")
    parser.add_argument(
        "--data",
        type=Path,
        default=Path(os.environ.get("GAPONET_DATA", ROOT.parent / "shared/data")),
    )
    parser.add_argument("--list", action="store_true")
    parser.add_argument("--write", action="store_true")
    args = parser.parse_args()
    if unknown := set(args.steps) - STEPS.keys():
        parser.error(f"no step {min(unknown)}; there are {', '.join(STEPS)}")
    work, failed = args.work.resolve(), list[str]()
    (work / "answers").mkdir(parents=True, exist_ok=True)
    files = {name: work / "answers" / f"{name}.json" for name in STEPS}
    for i, (name, (text, _)) in enumerate(STEPS.items()):
        command = filled(text, work, args.data.resolve())
        program = LISTED["needs"].get(name)
        state = (
            "done before"
            if files[name].is_file()
            else "to do"
            if args.list or args.write
            else "runs"
        )
        if state == "runs" and program and not shutil.which(program):
            state = f"skipped, no {program} here"
        if not args.steps or name in args.steps:
            print(f"[{i + 1}/{len(STEPS)}] {name}: {state}: {command}", flush=True)
            if state == "runs" and not measure(name, command, work):
                failed.append(name)
    if not args.list:
        write(
            {
                name: json.loads(f.read_text(encoding="utf-8"))
                for name, f in files.items()
                if f.is_file()
            },
            work,
        )
    print(
        f"failed: {', '.join(failed)}; the same command tries again" if failed else "no step failed"
    )
    return bool(failed)


if __name__ == "__main__":
    sys.exit(main())
