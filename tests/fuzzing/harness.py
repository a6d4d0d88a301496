"""Fuzzing: files that gaponet reads, changed at random, and what may never happen to whoever opens
them.

A target says which files there are and what is done with them. A mutant is one of these file sets
with one to three changes; its number and the seed make it again. It fails when anything but a
GAPONetError comes out, when it takes longer than HANG_S, wants more than MEMORY beyond what the
process had, writes a file outside the folder meant for it, or leaves something absurd stored (the
target looks). Workers are processes; one that hangs or dies costs its mutant.
"""

from __future__ import annotations

import multiprocessing as mp
import os
import random
import resource
import shutil
import sys
import tempfile
import time
import traceback
from collections import Counter, deque
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from itertools import islice
from multiprocessing.connection import wait
from pathlib import Path
from typing import Any

from fuzzing.mutate import Files, mutate
from gaponet.base.errors import GAPONetError

HANG_S = 5.0
# times HANG_S of waiting: a reader may start a process, on a machine that others use too
PATIENCE = 12
MEMORY = 2 << 30  # bytes
WHY = "WHY.txt"  # beside the files of a failed mutant
RENEW = 4000  # mutants after which a worker is replaced: what it leaked is no mutant's fault


class AbsurdError(Exception):
    """Something was stored or returned that no robot can have done."""


@dataclass(frozen=True)
class Target:
    """One kind of input."""

    name: str
    # the untouched files: path below the folder → content; called once in each worker
    files: Callable[[], Files]
    # reads the first folder, writes below the second only; raises AbsurdError
    use: Callable[[Path, Path], None]
    share: float = 1.0  # of a run's mutants, beside the others' shares
    # suffixes of the files that are changed; the others stand beside them
    only: tuple[str, ...] = ("",)


@dataclass(frozen=True)
class Failure:
    """A mutant that did what may not happen; kind: traceback, hang, memory, died, outside,
    absurd.
    """

    target: str
    number: int
    kind: str
    text: str


@dataclass
class Result:
    """Counts of a run. refused: one clear error; taken: read as if nothing were wrong."""

    mutants: int
    refused: int
    taken: int
    seconds: float
    by_target: dict[str, int]
    failures: list[Failure]


def run(
    targets: Iterable[Target],
    mutants: int,
    seed: int = 0,
    workers: int = 1,
    keep: Path | None = None,
    progress: Callable[[int, int], None] = lambda done, failed: None,
) -> Result:
    """Try so many mutants, spread over the targets by their shares.

    Args:
        seed: Of all changes.
        workers: Processes.
        keep: Folder for the files of failed mutants, in a folder each; default: they are not kept.
        progress: Called with the numbers of mutants done and of failures.

    Returns:
        The counts; of what was done so far where Ctrl-C ends it.
    """
    chosen = list(targets)
    total = sum(t.share for t in chosen)
    plan = [(t, k) for t in chosen for k in range(round(mutants * t.share / total))]
    random.Random(seed).shuffle(plan)
    crew = [_Worker(plan[w::workers], seed, keep) for w in range(workers)]
    start = time.monotonic()
    counts = Counter[str]()
    failures: list[Failure] = []
    try:
        while any(worker.plan for worker in crew):
            for outcome, failure in _next_outcomes(crew):
                counts[outcome] += 1
                if failure:
                    failures.append(failure)
            progress(counts.total(), len(failures))
    except KeyboardInterrupt:
        pass  # the counts so far are true
    finally:
        for worker in crew:
            worker.close()
    by_target = dict(Counter(t.name for t, _ in plan))
    return Result(
        counts.total(),
        counts["refused"],
        counts["taken"],
        time.monotonic() - start,
        by_target,
        failures,
    )


Outcome = tuple[str, Failure | None]  # "refused", "taken" or "failed", and what went wrong
Problem = tuple[str, str]  # kind and text of a failure


def _next_outcomes(crew: list[_Worker]) -> Iterator[Outcome]:
    """Yield what the workers have tried since the last call, after a wait of at most 0.2 s."""
    busy = [worker for worker in crew if worker.plan]
    wait([worker.pipe for worker in busy], 0.2)
    for worker in busy:
        yield from worker.outcomes()


class _Worker:
    """A process that tries the mutants of a plan; it is replaced when it is used up, hangs or
    dies.
    """

    def __init__(self, plan: list[tuple[Target, int]], seed: int, keep: Path | None) -> None:
        self.plan = deque(plan)
        self.seed = seed
        self.keep = keep
        self._start()

    def _start(self) -> None:
        context = mp.get_context("fork")
        memory = Path("/dev/shm")
        self.room = Path(
            tempfile.mkdtemp(prefix="fuzz-", dir=memory if os.access(memory, os.W_OK) else None)
        )
        self.pipe, theirs = context.Pipe(duplex=False)
        what = (list(islice(self.plan, RENEW)), self.seed, self.keep, self.room, theirs)
        self.process = context.Process(target=_work, args=what, daemon=True)
        self.begun = False
        self.since = time.monotonic()
        self.process.start()
        theirs.close()

    def outcomes(self) -> Iterator[Outcome]:
        """Yield the outcomes since the last call, without waiting for more."""
        ended = False
        try:
            yield from self._received()
        except (EOFError, OSError):
            self.process.join()
            if not self.begun:
                raise RuntimeError("a fuzzing worker died before its first mutant") from None
            ended = True
        problem = self._problem(ended)
        if problem and self.plan:
            target, number = self.plan.popleft()
            yield "failed", Failure(target.name, number, *problem)
        if (problem or ended) and self.plan:
            self.close()
            self._start()

    def _received(self) -> Iterator[Outcome]:
        """Yield what the process has sent; its first message only says that it begins."""
        while self.plan and self.pipe.poll(0):
            outcome = self.pipe.recv()
            self.since = time.monotonic()
            if self.begun:
                self.plan.popleft()
                yield outcome
            self.begun = True

    def _problem(self, ended: bool) -> Problem | None:
        """What went wrong with the process itself, if anything."""
        if self.begun and time.monotonic() - self.since > PATIENCE * HANG_S:
            return "hang", f"no answer after {PATIENCE * HANG_S:g} s"
        if ended and self.process.exitcode:
            return "died", f"exit code {self.process.exitcode}"
        return None

    def close(self) -> None:
        """End the process."""
        self.process.kill()
        self.process.join()
        self.pipe.close()
        shutil.rmtree(self.room, ignore_errors=True)


def _work(
    plan: list[tuple[Target, int]], seed: int, keep: Path | None, room: Path, pipe: Any
) -> None:
    """Try mutants one after the other, below an empty folder, and report when the first begins and
    when each ends.
    """
    untouched = {target.name: target.files() for target, _ in plan}
    for target in {target.name: target for target, _ in plan}.values():
        _lay(untouched[target.name], room)
        target.use(
            room / "in", room / "out"
        )  # must be taken: changes of what is refused anyway find nothing
    quiet = os.open(os.devnull, os.O_WRONLY)
    os.dup2(quiet, 1)
    os.dup2(quiet, 2)
    sys.stdout = open(1, "w", closefd=False)  # noqa: SIM115
    sys.stderr = open(2, "w", closefd=False)  # noqa: SIM115
    sys.addaudithook(_watch)
    _limit_memory()
    parent = os.getppid()
    pipe.send("begin")
    for target, number in plan:
        if os.getppid() != parent:  # it was killed
            return
        outcome, failure = _attempt(target, untouched[target.name], number, seed, room)
        if failure and keep:
            to = keep / f"{failure.kind}-{failure.target}-{number}"
            shutil.copytree(room / "in", to, dirs_exist_ok=True, symlinks=True)
            (to / WHY).write_text(failure.text, encoding="utf-8")
        pipe.send((outcome, failure))


def _attempt(target: Target, files: Files, number: int, seed: int, room: Path) -> Outcome:
    mutant = mutate(files, random.Random(f"{seed} {target.name} {number}"), target.only)
    _lay(mutant, room)
    _WATCHED[:] = [str(room / "out")]
    start = time.process_time()
    outcome, problem = _use(target, room)
    seconds = time.process_time() - start
    if problem is None and seconds > HANG_S:
        problem = ("hang", f"{seconds:.1f} s of computing")
    outside = [
        *_WATCHED[1:],
        *(p.name for p in room.iterdir() if p.name not in ("in", "out")),
        *_changed(mutant, room),
    ]
    _WATCHED.clear()
    if problem is None and outside:
        problem = ("outside", f"written outside the target: {', '.join(outside)}")
    if problem is None:
        return outcome, None
    return "failed", Failure(target.name, number, *problem)


def _use(target: Target, room: Path) -> tuple[str, Problem | None]:
    """Read the mutant in room/in: "refused" or "taken", and what may not happen, if it did."""
    try:
        target.use(room / "in", room / "out")
    except GAPONetError as error:
        if "\n" in str(error).strip() or len(str(error)) > 2000:
            return "refused", ("traceback", f"not one line: {str(error)[:2500]!r}")
        return "refused", None
    except AbsurdError as error:
        return "taken", ("absurd", str(error))
    except MemoryError:
        return "taken", ("memory", traceback.format_exc())
    except BaseException:
        return "taken", ("traceback", traceback.format_exc())
    return "taken", None


def _lay(files: Files, room: Path) -> None:
    """room/in holds exactly these files (None: a folder of that name), room/out is not there."""
    for name in os.listdir(room):
        shutil.rmtree(room / name) if (room / name).is_dir() else (room / name).unlink()
    (room / "in").mkdir()
    for name, content in files.items():
        file = room / "in" / name
        file.parent.mkdir(parents=True, exist_ok=True)
        if content is None:
            file.mkdir()
        else:
            file.write_bytes(content)


def _changed(files: Files, room: Path) -> list[str]:
    """Files below room/in that are not as they were laid."""
    there = {
        p.relative_to(room / "in").as_posix(): p for p in (room / "in").rglob("*") if p.is_file()
    }
    laid = {name: content for name, content in files.items() if content is not None}
    return sorted(there.keys() ^ laid.keys()) + [
        n for n in there.keys() & laid.keys() if there[n].read_bytes() != laid[n]
    ]


# the folder that may be written while a mutant is tried, then what was written elsewhere
_WATCHED: list[str] = []


def _watch(event: str, args: tuple[Any, ...]) -> None:
    """Audit hook: notes what Python opens for writing, makes, renames or deletes outside the folder
    meant for it.
    """
    if not _WATCHED or event not in (
        "open",
        "os.mkdir",
        "os.rename",
        "os.remove",
        "os.rmdir",
        "os.symlink",
    ):
        return
    if event == "open" and not (
        isinstance(args[2], int) and args[2] & (os.O_WRONLY | os.O_RDWR | os.O_CREAT)
    ):
        return
    path = args[0]
    if isinstance(path, (str, bytes, os.PathLike)):
        path = os.path.abspath(os.fsdecode(path))
        if not path.startswith((_WATCHED[0], "/dev/null")):
            _WATCHED.append(f"{event} {path}")


def _limit_memory() -> None:
    """MEMORY beyond what the process has mapped now."""
    pages = int(Path("/proc/self/statm").read_text().split()[0])
    limit = pages * os.sysconf("SC_PAGE_SIZE") + MEMORY
    resource.setrlimit(resource.RLIMIT_AS, (limit, limit))
