"""Writing commands under adversity: killed at random moments, on full disks, and started twice.

    python benchmarks/kills.py WORK [--kills 20] [--only import,train] [--trials kills] [--seed 0]

Records a small VIRTUAL SO-101 set in WORK/input. Each command of `cases` runs once undisturbed, and
then

    kills      with kill -9 at random moments, restarted until the number of kills is reached
    full       on a tmpfs that is too small, then on the same one made larger (root only)
    read_only  on a read-only tmpfs (root only)
    races      twice at once into one folder
    mixed      import and collect at once into one dataset; the second is refused, then and later
    foreign    into a folder with a `.git`

At the end, the content of the folder must equal that of the undisturbed command. Prints one JSON
object; exits with 1 if a content differs, a file remains, an exit code is wrong, or a traceback was
printed.

Not among the cases: run and record, which play a motion again and store it under a new name; demo,
which consists of commands that are; view --render and replay --out, which write one file as `robot
show --out` does.
"""

from __future__ import annotations

import hashlib
import itertools
import json
import os
import shutil
import signal
import subprocess
import sys
import time
import traceback
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from fnmatch import fnmatch
from pathlib import Path
from typing import Any

import numpy as np
from common import command_line, read_rows

import gaponet.nn.onnx_export  # imported before children are forked
import gaponet.nn.training.trainer  # noqa: F401
from gaponet.base.files import FOLDER_MARKER
from gaponet.cli.main import main as gaponet_main
from gaponet.data.store import Dataset

TRAIN_OPTIONS = {
    "--model.history": "2",
    "--pretraining.num-envs": "16",
    "--pretraining.steps": "40",
    "--pretraining.rounds": "3",
    "--pretraining.gradient-steps": "40",
    "--pretraining.batch-size": "128",
    "--ppo.num-envs": "16",
    "--ppo.num-steps": "16",
    "--validate-every": "2",
}
TRAIN = list(itertools.chain(*TRAIN_OPTIONS.items()))
QUICK_FIT = ["--windows", "2", "--no-table", "--threads", "1", "--terms"]
ARM = """<mujoco model="arm">
  <compiler angle="radian" autolimits="true"/>
  <default><joint damping="0.5" armature="0.02" frictionloss="0.05"/></default>
  <worldbody>
    <body name="upper">
      <joint name="shoulder" axis="0 1 0" range="-1.5 1.5"/>
      <geom type="capsule" fromto="0 0 0 0.2 0 0" size="0.02" mass="0.3"/>
      <body name="fore" pos="0.2 0 0">
        <joint name="elbow" axis="0 1 0" range="-1.5 1.5"/>
        <geom type="capsule" fromto="0 0 0 0.2 0 0" size="0.02" mass="0.2"/>
      </body>
    </body>
  </worldbody>
</mujoco>
"""  # two joints, so that a fit takes seconds
GAINS = ["--kp", "20", "--effort-limit", "5"]
LIMIT_S = 600.0
TRIALS = ("kills", "races", "foreign", "full", "read_only")
AS_ROOT = ("full", "read_only")  # trials that mount a disk
# First of two commands at once on one dataset → the other one, and its exit code afterwards.
AFTER = {"import": ("collect", 2), "collect": ("import", 0)}
REFUSALS = ("Folder", "File", "Usage", "Dataset", "Model")  # first words of one-line errors


@dataclass(frozen=True)
class Case:
    """Command with its arguments, its initial folder, and the content to compare."""

    argv: Callable[[Path], list[str]]
    content: Callable[[Path], Any]
    begin: Path | None = None  # initial content of OUT
    done: tuple[int, ...] = (0,)  # exit codes of a repeated command that had already ended
    unwritable: int = 2  # exit code on a disk that is mounted read-only
    trials: tuple[str, ...] = TRIALS


def entries(out: Path) -> Any:
    """Return order and hashes of a dataset, and its files; reads all samples."""
    data = Dataset(out)
    data.sequences()
    return [[(e.id, e.hash) for e in data.entries], names(out)]


def names(out: Path) -> list[str]:
    """Return the files of a folder without markers, which depend on the order of writing."""
    return sorted(
        str(f.relative_to(out)) for f in out.rglob("*") if f.is_file() and f.name != FOLDER_MARKER
    )


def digests(out: Path) -> dict[str, str]:
    """Return the hash of every file."""
    return {name: hashlib.sha256((out / name).read_bytes()).hexdigest() for name in names(out)}


def trained(out: Path) -> Any:
    """Return the content of a run without times."""
    curve = read_rows(out / "progress.jsonl")
    for row in curve:
        row.pop("seconds", None)
    return [curve, digests(out / "model")["model.onnx"], names(out)]


def without(*patterns: str) -> Callable[[Path], Any]:
    """Return a content: the hash of each file, and only the name of files that hold a time or a
    place.
    """

    def content(out: Path) -> Any:
        made = digests(out)
        for name in made:
            if any(fnmatch(name, pattern) for pattern in patterns):
                made[name] = ""
        return made

    return content


def page(out: Path) -> Any:
    """Require a complete report; return the evaluation and the files."""
    assert (out / "report.html").read_text().rstrip().endswith("</html>")
    return [json.loads((out / "metrics.json").read_text())["methods"], names(out)]


def file_count(out: Path) -> int:
    """Return the number of files: the name of a pushed file is its hash, and some files hold the
    time of the push.
    """
    return len(names(out))


def measured(out: Path) -> Any:
    """Return the errors of an evaluation, and the files."""
    return [json.loads((out / "metrics.json").read_text())["methods"], names(out)]


def result(out: Path) -> Any:
    """Return the claims and Figure 3 of an experiment, and its files."""
    tables = json.loads((out / "paper.json").read_text())["tables"]
    return [tables["claims_labels"]["rows"], tables["figure3_labels"]["rows"], names(out)]


def cases(given: Path) -> dict[str, Case]:
    """Return every command that writes a folder in several steps.

    `given` holds data, bare (data without replays), logs (LeRobot), a run, and what `further_cases`
    needs.
    """
    robot = ["--robot", "so101"]
    data = str(given / "data")
    log = str(given / "logs")
    run = str(given / "run")
    recipe = ["--recipe", str(given / "more.toml")]

    def train(out: Path) -> list[str]:
        begun = (out / "checkpoint.pt").is_file() or (out / "candidates").is_dir()
        resume = ["--resume"] if begun else []
        return ["train", data, "--out", str(out), "--budget", "4000", *resume, *TRAIN]

    def experiment(out: Path) -> list[str]:
        part = ["--quick", "--methods", "GAPONet", "--blocks", "labels"]
        return ["experiment", "paper", data, "--out", str(out), *part]

    return {
        "import": Case(lambda out: ["import", log, *robot, "--out", str(out)], entries),
        "collect": Case(lambda out: ["collect", *robot, *recipe, "--out", str(out)], entries),
        "gap": Case(
            lambda out: ["gap", str(out)], entries, given / "bare", unwritable=0
        ),  # replays go elsewhere
        "train": Case(train, trained),
        "export": Case(
            lambda out: ["data", "export", data, "--out", str(out)], digests, done=(0, 2)
        ),
        "artifact": Case(lambda out: ["export", run, "--out", str(out)], names),
        "report": Case(lambda out: ["report", str(out), "--dataset", data], page, given / "run"),
        "experiment": Case(experiment, result),
    } | further_cases(given)


def further_cases(given: Path) -> dict[str, Case]:
    """Return commands that are only killed and repeated.

    `given` holds, of an arm with two joints, a model file, a nominal and an identified robot, data
    and logs; and an empty folder.
    """
    data = str(given / "arm_data")
    logs = str(given / "arm_logs")
    nominal = str(given / "nominal")
    identified = str(given / "identified")
    trained_on = str(given / "data")

    def killed(
        words: Callable[[Path], list[str]],
        content: Callable[[Path], Any] = digests,
        begin: str | None = None,
        done: tuple[int, ...] = (0,),
    ) -> Case:
        return Case(words, content, given / begin if begin else None, done, trials=("kills",))

    def identify(out: Path) -> list[str]:
        return ["identify", data, "--out", str(out), *QUICK_FIT]

    def adapt(out: Path) -> list[str]:
        return ["adapt", nominal, data, "--out", str(out), "--unit", "virtual-1", "--seconds", "8"]

    def new_robot(out: Path) -> list[str]:
        return ["robot", "new", str(given / "arm.xml"), "--out", str(out), *GAINS]

    def start(out: Path) -> list[str]:
        return ["start", nominal, logs, "--out", str(out), "--unit-id", "virtual-1"]

    return {
        "robot new": killed(new_robot),
        "identify": killed(identify, without("identified.json")),  # the path of the dataset
        "adapt": killed(adapt),
        "adapt a run": killed(
            lambda out: ["adapt", str(out), trained_on, "--seconds", "8"], begin="run"
        ),
        "eval": killed(lambda out: ["eval", str(out), trained_on], measured, "run"),
        "gap by cause": killed(lambda out: ["gap", data, "--robot", f"{out}/"], begin="identified"),
        "export to mjcf": killed(
            lambda out: ["export", identified, "--to", "mjcf", "--out", str(out)], without("*.npz")
        ),
        "export randomization": killed(
            lambda out: ["export", identified, "--to", "randomization", "--out", str(out)]
        ),
        "excite": killed(
            lambda out: ["excite", "--robot", nominal, "--out", str(out), "--minutes", "2"]
        ),
        "doctor": killed(lambda out: ["doctor", data, "--figures", str(out)]),
        "data card": killed(
            lambda out: ["data", "card", str(out), "--licence", "CC0-1.0"],
            without("card.json", "CARD.md", "dataset.json"),  # dates, order of keys
            "arm_data",
        ),
        "data split": killed(
            lambda out: ["data", "split", str(out), "--by", "motion"], begin="arm_data"
        ),
        "data remove": killed(
            lambda out: ["data", "remove", str(out), "tour-all-0*"],
            entries,
            "arm_data",
            done=(0, 2),
        ),
        "data figures": killed(lambda out: ["data", "figures", data, "--out", str(out)]),
        "robot show": killed(
            lambda out: ["robot", "show", identified, "--out", str(out / "known.png")],
            begin="empty",
        ),
        # The commands name the folder.
        "start": killed(start, without("commands.sh", "*.html", "*.json", "*.npz")),
    }


def prepare(given: Path) -> None:
    """Create the inputs."""
    given.mkdir(parents=True)
    for name, payloads, variants in (("few", [0.0], 3), ("more", [0.0, 0.2], 6)):
        (given / f"{name}.toml").write_text(
            'motions = ["steps-*", "tour-all-*"]\nunits = ["virtual-1"]\n'
            f"payloads = {payloads}\nvariants = {variants}\n"
        )
    (given / "arm.xml").write_text(ARM)
    nominal = str(given / "nominal")
    arm_data = str(given / "arm_data")
    few = ["--recipe", str(given / "few.toml")]
    for argv in (
        ["collect", "--robot", "so101", *few, "--out", str(given / "data")],
        ["data", "export", str(given / "data"), "--out", str(given / "logs")],
        ["train", str(given / "data"), "--out", str(given / "run"), "--budget", "2000", *TRAIN],
        ["robot", "new", str(given / "arm.xml"), "--out", nominal, *GAINS],
        ["collect", "--robot", nominal, *few, "--fleet", "easy", "--out", arm_data],
        ["data", "export", arm_data, "--out", str(given / "arm_logs")],
        ["identify", arm_data, "--out", str(given / "identified"), *QUICK_FIT],
    ):
        if wait(start(argv, given / "prepare.txt")):
            raise SystemExit(f"{argv[0]} failed; see {given / 'prepare.txt'}")
    shutil.copytree(given / "data", given / "bare", ignore=shutil.ignore_patterns("replays"))
    (given / "empty").mkdir()


def start(argv: list[str], log: Path) -> int:
    """Start a command in a forked process, with everything imported; returns its id."""
    process = os.fork()
    if process:
        return process
    code = 70
    try:
        os.environ["COLUMNS"] = "200"
        descriptor = os.open(log, os.O_WRONLY | os.O_CREAT | os.O_APPEND)
        os.dup2(descriptor, 1)
        os.dup2(descriptor, 2)
        sys.stdout = sys.stderr = open(1, "w", closefd=False)  # noqa: SIM115
        code = gaponet_main(argv)
    except SystemExit as left:
        code = int(left.code or 0)
    except BaseException:
        traceback.print_exc()
    finally:
        sys.stdout.flush()
        os._exit(code)


def wait(process: int, until: float = LIMIT_S) -> int | None:
    """Return the exit code of a process; None if it still runs after `until` s."""
    deadline = time.monotonic() + until
    while True:
        ended, status = os.waitpid(process, os.WNOHANG)
        if ended:
            return os.waitstatus_to_exitcode(status)
        if time.monotonic() > deadline:
            return None
        time.sleep(0.002)


class Trial:
    """Tests of one command under adversity; collects failures."""

    def __init__(self, name: str, case: Case, work: Path, rng: np.random.Generator) -> None:
        self.name = name
        self.case = case
        self.work = work / name
        self.rng = rng
        self.log = self.work / "log.txt"
        self.wrong: list[str] = []
        self.count: Counter[str] = Counter()
        self.work.mkdir(parents=True)
        began = time.monotonic()
        whole = self.fresh(self.work / "whole")
        self.expect("whole", wait(start(case.argv(whole), self.log)), 0)
        self.duration = time.monotonic() - began
        self.content = case.content(whole)
        self.before = size(case.begin) if case.begin else 0.0
        self.needed = size(whole) - self.before

    def fresh(self, out: Path) -> Path:
        """Create OUT with its initial content."""
        if self.case.begin is not None:
            shutil.copytree(self.case.begin, out, dirs_exist_ok=True)
        return out

    def expect(self, what: str, code: int | None, *meant: int) -> None:
        """Record an exit code that is not expected, and a traceback."""
        self.count[what] += 1
        text = self.log.read_text(errors="replace") if self.log.is_file() else ""
        if code not in meant or "Traceback" in text:
            self.wrong.append(f"{what}: exit {code}: {text.strip().splitlines()[-1:] or ''}")
        elif code == 2 and text.strip().splitlines()[-1].split(":")[0] not in REFUSALS:
            self.wrong.append(f"{what}: no one-line error: {text.strip().splitlines()[-1]}")
        self.log.unlink(missing_ok=True)

    def same(self, what: str, out: Path) -> None:
        """Record content that differs from that of the undisturbed command."""
        try:
            equal = self.case.content(out) == self.content
        except Exception as error:
            equal = False
            self.wrong.append(f"{what}: {type(error).__name__}: {error}")
        if not equal:
            self.wrong.append(f"{what}: {out} is not what the undisturbed command leaves")

    def run(self, kind: str, kills: int) -> None:
        """Run a trial of TRIALS."""
        if kind == "kills":
            self.kills(kills)
        else:
            getattr(self, kind)()

    def kills(self, wanted: int) -> None:
        """Kill and restart the command; compare when it ends."""
        turn = 0
        while self.count["killed"] < wanted:
            out = self.fresh(self.work / f"killed-{turn}")
            turn += 1
            code = None
            while code is None:
                code = self._run_or_kill(out, wanted)
            self.expect("resumed", code, *self.case.done)
            self.same("killed", out)

    def _run_or_kill(self, out: Path, wanted: int) -> int | None:
        """Start the command; return its exit code, or None if it was killed at a random moment."""
        process = start(self.case.argv(out), self.log)
        patience = LIMIT_S
        if self.count["killed"] < wanted:
            patience = self.rng.uniform(0, 1.1 * self.duration)
        code = wait(process, patience)
        if code is not None:
            return code
        os.kill(process, signal.SIGKILL)
        os.waitpid(process, 0)
        self.count["killed"] += 1
        self.log.unlink(missing_ok=True)
        if self.case.content is entries and (out / "dataset.json").is_file():
            Dataset(out).sequences()  # whatever is listed is there
        return None

    def full(self) -> None:
        """Run on a disk with a fraction of the needed space, then with enough."""
        for share in (0.02, 0.35, 0.7):
            place = mounted(self.work / f"full-{share:g}", self.before + self.needed * share)
            try:
                out = self.fresh(place / "out")
                code = wait(start(self.case.argv(out), self.log))
                self.expect("full", code, 0, 2)
                self.count["refused, full"] += code == 2
                subprocess.run(["mount", "-o", "remount,size=1g", str(place)], check=True)
                self.expect("room again", wait(start(self.case.argv(out), self.log)), 0)
                self.same("full", out)
            finally:
                subprocess.run(["umount", str(place)], check=True)

    def read_only(self) -> None:
        """Run on a read-only disk."""
        place = mounted(self.work / "read-only", 1 << 30)
        try:
            out = self.fresh(place / "out")
            subprocess.run(["mount", "-o", "remount,ro", str(place)], check=True)
            before = digests(place)
            self.expect(
                "read-only", wait(start(self.case.argv(out), self.log)), self.case.unwritable
            )
            if digests(place) != before:
                self.wrong.append("read-only: changed")
        finally:
            subprocess.run(["umount", str(place)], check=True)

    def races(self, turns: int = 5) -> None:
        """Run two commands at once: one succeeds, the other is refused or finds the result."""
        for turn in range(turns):
            out = self.fresh(self.work / f"race-{turn}")
            logs = [self.log.with_name(f"race-{turn}-{i}.txt") for i in range(2)]
            both = [start(self.case.argv(out), log) for log in logs]
            codes = [wait(process) for process in both]
            for code, log in zip(codes, logs, strict=True):
                log.rename(self.log)
                self.expect("raced", code, 0, 2)
            self.count["refused, second"] += 2 in codes
            if 0 not in codes:
                self.wrong.append(f"race: exit codes {codes}")
            self.same("race", out)

    def foreign(self) -> None:
        """Run into a folder of another program."""
        if self.case.begin is not None:
            return
        out = self.work / "foreign"
        (out / ".git").mkdir(parents=True)
        (out / ".git" / "HEAD").write_text("ref: refs/heads/main\n")
        self.expect("foreign", wait(start(self.case.argv(out), self.log)), 2)
        if names(out) != [".git/HEAD"] or len(list(out.iterdir())) != 1:
            self.wrong.append(f"foreign: {out} was changed")


def mixed(given: Path, work: Path, turns: int = 6) -> dict[str, Any]:
    """Run import and collect at once into one dataset: one succeeds.

    Then run the other again: an import finds the collected recordings, and collect refuses
    imported ones.
    """
    both = {name: cases(given)[name] for name in ("import", "collect")}
    count: Counter[str] = Counter()
    wrong: list[str] = []
    work.mkdir()
    for name, case in both.items():
        wait(start(case.argv(work / name), work / f"{name}.txt"))
    for turn in range(turns):
        out = work / f"mixed-{turn}"
        log = work / f"mixed-{turn}.txt"
        order = ("import", "collect") if turn % 2 == 0 else ("collect", "import")
        running = {name: start(both[name].argv(out), log) for name in order}
        codes = {name: wait(running[name]) for name in order}
        first = "import" if codes["import"] == 0 else "collect"
        second, meant = AFTER[first]
        count[f"{first} first"] += 1
        again = wait(start(both[second].argv(out), log))
        if (codes[first], codes[second], again) != (0, 2, meant):
            wrong.append(f"mixed: exit codes {codes}, then {again}; see {log}")
        has_traceback = "Traceback" in log.read_text(errors="replace")
        if has_traceback or entries(out)[0] != entries(work / first)[0]:
            wrong.append(f"mixed: {out} is not what {first} leaves; see {log}")
    return {**count, "wrong": wrong}


def size(folder: Path) -> float:
    """Return the disk space of a folder, bytes."""
    return sum(4096 * (1 + f.stat().st_size // 4096) for f in folder.rglob("*"))


def mounted(place: Path, size: float) -> Path:
    """Mount a tmpfs of this size, bytes."""
    place.mkdir()
    pages = max(int(size) // 4096, 4)
    subprocess.run(
        ["mount", "-t", "tmpfs", "-o", f"size={pages * 4096}", "tmpfs", str(place)], check=True
    )
    return place


def main() -> int:
    parser = command_line(__doc__)
    parser.add_argument("work", type=Path)
    parser.add_argument("--kills", type=int, default=20)
    parser.add_argument("--only", default="", help="some of the commands, separated by commas")
    parser.add_argument(
        "--trials", default=",".join(TRIALS), help="some of the trials, separated by commas"
    )
    parser.add_argument("--seed", type=int, default=0, help="of the moments")
    args = parser.parse_args()
    work = args.work.resolve()
    found: dict[str, Any] = {}
    wrong = 0
    wanted = set(args.trials.split(","))
    if os.geteuid() != 0:
        wanted -= set(AS_ROOT)
    only = args.only.split(",") if args.only else []
    if not (work / "input").is_dir():
        prepare(work / "input")
    for name, case in cases(work / "input").items():
        if only and name not in only:
            continue
        trial = Trial(name, case, work, np.random.default_rng(args.seed))
        for kind in case.trials:
            if kind in wanted:
                trial.run(kind, args.kills)
        found[name] = {"whole_s": round(trial.duration, 1), **trial.count, "wrong": trial.wrong}
        wrong += len(trial.wrong)
        print(f"{name}: {found[name]}", file=sys.stderr, flush=True)
    if "mixed" in only or (not only and "races" in wanted):
        found["mixed"] = mixed(work / "input", work / "mixed")
        wrong += len(found["mixed"]["wrong"])
    print(json.dumps(found))
    return int(wrong > 0)


if __name__ == "__main__":
    sys.exit(main())
