"""Fuzzing: files that gaponet reads, changed at random, and what may never happen to whoever opens them.

A target says which files there are and what is done with them. A mutant is one of these file sets with one to three
changes; its number and the seed make it again. It fails when anything but a GAPONetError comes out, when it takes
longer than HANG_S, wants more than MEMORY beyond what the process had, writes a file outside the folder meant for it,
or leaves something absurd stored (the target looks). Workers are processes; one that hangs or dies costs its mutant.
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
from collections import Counter
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from fuzzing.mutate import Files, mutate
from gaponet.base.errors import GAPONetError

HANG_S = 5.0
PATIENCE = 12  # times HANG_S of waiting: a reader may start a process, on a machine that others use too
MEMORY = 2 << 30  # bytes
RENEW = 4000  # mutants after which a worker is replaced: what it leaked is no mutant's fault


class AbsurdError(Exception):
    """Something was stored or returned that no robot can have done."""


@dataclass(frozen=True)
class Target:
    """One kind of input.

    Attributes:
        name: Of the target.
        files: Its untouched files: path below the folder → content. Called once in each worker.
        use: Reads the files in the first folder and writes below the second only; raises AbsurdError.
        share: How many of a run's mutants it gets, beside the others' shares.
        only: Names of files (suffix) that are changed, all by default; the others stand beside them.
    """

    name: str
    files: Callable[[], Files]
    use: Callable[[Path, Path], None]
    share: float = 1.0
    only: tuple[str, ...] = ("",)


@dataclass(frozen=True)
class Failure:
    """A mutant that did what may not happen; kind: traceback, hang, memory, died, outside, absurd."""

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
    progress: Callable[[int, int], None] | None = None,
) -> Result:
    """Try so many mutants, spread over the targets by their shares.

    Args:
        targets: What to try.
        mutants: How many in all.
        seed: Of all changes.
        workers: Processes.
        keep: Folder for the files of failed mutants, in a folder each; default: they are not kept.
        progress: Called with done and failures.

    Returns:
        The counts; of what was done so far where Ctrl-C ends it.
    """
    chosen = list(targets)
    total = sum(t.share for t in chosen)
    plan = [(i, k) for i, t in enumerate(chosen) for k in range(round(mutants * t.share / total))]
    random.Random(seed).shuffle(plan)
    crew = [_Crew(chosen, plan[w::workers], seed, keep) for w in range(workers)]
    start, failures, counts = time.monotonic(), [], Counter()
    by_target = Counter(chosen[i].name for i, _ in plan)
    try:
        while any(member.busy for member in crew):
            for member in crew:
                failures += member.look(counts)
            if progress:
                progress(counts["done"], len(failures))
    except KeyboardInterrupt:
        pass  # the counts so far are true
    finally:
        for member in crew:
            member.close()
    return Result(
        counts["done"], counts["refused"], counts["taken"], time.monotonic() - start, dict(by_target), failures
    )


def one(target: Target, number: int, seed: int, folder: Path) -> Failure | None:
    """Make one mutant below a folder, for a look, and try it in this process."""
    return _attempt(target, target.files(), number, seed, folder)[1]


class _Crew:
    """One worker at a time on one list of mutants, replaced when it is used up, hangs or dies."""

    def __init__(self, targets: list[Target], plan: list[tuple[int, int]], seed: int, keep: Path | None) -> None:
        self.targets, self.plan, self.seed, self.keep, self.at = targets, plan, seed, keep, 0
        self.process: Any = None
        self.since = 0.0

    @property
    def busy(self) -> bool:
        return self.at < len(self.plan)

    def look(self, counts: Counter[str]) -> list[Failure]:
        """Wait shortly for what the worker reports; one report for each mutant begun and each one ended."""
        if not self.busy:
            return []
        if self.process is None:
            self._start()
        found = []
        if not self.pipe.poll(0.2):
            if time.monotonic() - self.since > PATIENCE * HANG_S and self.begun:
                found.append(self._lost("hang", f"no answer after {PATIENCE * HANG_S:g} s", counts))
            return found
        try:
            while self.busy and self.process and self.pipe.poll(0):
                found += self._report(self.pipe.recv(), counts)
        except (EOFError, OSError):
            self.process.join()
            if not self.begun:
                raise RuntimeError("a fuzzing worker died before its first mutant") from None
            found.append(self._lost("died", f"exit code {self.process.exitcode}", counts))
        return found

    def _report(self, said: Any, counts: Counter[str]) -> list[Failure]:
        self.begun, self.since = True, time.monotonic()
        if said in ("begin", "renew"):
            if said == "renew":
                self.close()
            return []
        outcome, failure = said
        self.at += 1
        counts["done"] += 1
        counts[outcome] += 1
        return [failure] if failure else []

    def _lost(self, kind: str, text: str, counts: Counter[str]) -> Failure:
        index, number = self.plan[self.at]
        self.close()
        self.at += 1
        counts["done"] += 1
        return Failure(self.targets[index].name, number, kind, text)

    def _start(self) -> None:
        self.pipe, theirs = mp.get_context("fork").Pipe(duplex=False)
        memory = Path("/dev/shm")
        self.room = Path(tempfile.mkdtemp(prefix="fuzz-", dir=memory if os.access(memory, os.W_OK) else None))
        what = (self.targets, self.plan[self.at : self.at + RENEW], self.seed, self.keep, self.room, theirs)
        self.process = mp.get_context("fork").Process(target=_work, args=what, daemon=True)
        self.begun, self.since = False, time.monotonic()
        self.process.start()
        theirs.close()

    def close(self) -> None:
        """End the worker."""
        if self.process is not None:
            self.process.kill()
            self.process.join()
            self.pipe.close()
            self.process = None
            shutil.rmtree(self.room, ignore_errors=True)


def _work(
    targets: list[Target], plan: list[tuple[int, int]], seed: int, keep: Path | None, room: Path, pipe: Any
) -> None:
    """A worker: its mutants one after the other, below an empty folder."""
    untouched = {i: targets[i].files() for i in sorted({i for i, _ in plan})}
    for i, files in untouched.items():  # must be taken: a fuzzer of what is refused anyway finds nothing
        _lay(files, room)
        targets[i].use(room / "in", room / "out")
    quiet = os.open(os.devnull, os.O_WRONLY)
    os.dup2(quiet, 1)
    os.dup2(quiet, 2)
    sys.stdout, sys.stderr = open(1, "w", closefd=False), open(2, "w", closefd=False)  # noqa: SIM115
    sys.addaudithook(_watch)
    _limit_memory()
    pipe.send("begin")
    parent = os.getppid()
    for index, number in plan:
        if os.getppid() != parent:  # it was killed
            return
        outcome, failure = _attempt(targets[index], untouched[index], number, seed, room)
        if failure and keep:
            to = keep / f"{failure.kind}-{failure.target}-{number}"
            shutil.copytree(room / "in", to, dirs_exist_ok=True, symlinks=True)
            (to / "WHY.txt").write_text(failure.text, encoding="utf-8")
        pipe.send((outcome, failure))
    pipe.send("renew")
    time.sleep(60)  # until it is ended


def _attempt(target: Target, files: Files, number: int, seed: int, room: Path) -> tuple[str, Failure | None]:
    """("refused", "taken" or "failed", what went wrong)."""
    mutant = mutate(files, random.Random(f"{seed} {target.name} {number}"), target.only)
    _lay(mutant, room)
    _WATCHED[:] = [str(room / "out")]
    start, outcome, kind, text = time.process_time(), "taken", "", ""
    try:
        target.use(room / "in", room / "out")
    except GAPONetError as error:
        outcome = "refused"
        if "\n" in str(error).strip() or len(str(error)) > 2000:
            kind, text = "traceback", f"not one line: {str(error)[:2500]!r}"
    except AbsurdError as error:
        kind, text = "absurd", str(error)
    except MemoryError:
        kind, text = "memory", traceback.format_exc()
    except BaseException:
        kind, text = "traceback", traceback.format_exc()
    if not kind and time.process_time() - start > HANG_S:
        kind, text = "hang", f"{time.process_time() - start:.1f} s of computing"
    outside = [*_WATCHED[1:], *(p.name for p in room.iterdir() if p.name not in ("in", "out")), *_changed(mutant, room)]
    _WATCHED.clear()
    if not kind and outside:
        kind, text = "outside", f"written outside the target: {', '.join(outside)}"
    return ("failed", Failure(target.name, number, kind, text)) if kind else (outcome, None)


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
    there = {p.relative_to(room / "in").as_posix(): p for p in (room / "in").rglob("*") if p.is_file()}
    laid = {name: content for name, content in files.items() if content is not None}
    return sorted(there.keys() ^ laid.keys()) + [
        n for n in there.keys() & laid.keys() if there[n].read_bytes() != laid[n]
    ]


_WATCHED: list[str] = []  # the folder that may be written while a mutant is tried, then what was written elsewhere


def _watch(event: str, args: tuple[Any, ...]) -> None:
    """Audit hook: notes what Python opens for writing, makes, renames or deletes outside the folder meant for it."""
    if not _WATCHED or event not in ("open", "os.mkdir", "os.rename", "os.remove", "os.rmdir", "os.symlink"):
        return
    if event == "open" and not (isinstance(args[2], int) and args[2] & (os.O_WRONLY | os.O_RDWR | os.O_CREAT)):
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
