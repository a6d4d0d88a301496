"""Jobs in other processes, here or on a cluster: one loop over any concurrent.futures.Executor.

What a job raises is its outcome. What the executor raises means that its worker died (out of memory, kill -9, a machine
gone): the job is given to another worker, RETRIES times. Libraries are loaded only where they are asked for.
"""

from __future__ import annotations

import os
import signal
import threading
import time
import traceback
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import FIRST_COMPLETED, Executor, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass
from functools import partial
from multiprocessing import get_context
from typing import Any, Generic, TypeVar

from gaponet.base.child import SAFE
from gaponet.base.errors import UsageError, WorkerError

Job = TypeVar("Job")
Result = TypeVar("Result")

LOCAL = "local"
RETRIES = 2
BEAT = 0.3  # s between two looks at what is going on
MOST_WORKERS = 1024
POOLS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")


@dataclass(frozen=True)
class _Outcome(Generic[Job, Result]):
    """What came of a job."""

    job: Job
    value: Result | None
    error: Exception | None
    """What the job raised, or a WorkerError where its workers died."""

    def result(self) -> Result:
        """The value; raises the error."""
        if self.error is not None:
            raise self.error
        return self.value  # type: ignore[return-value]


@dataclass(frozen=True)
class Pool:
    """An executor, how many jobs it is given at a time, and on how many threads each computes."""

    executor: Executor
    size: int
    threads: int = 1

    def run(
        self,
        work: Callable[[Job], Result],
        jobs: Iterable[Job],
        look: Callable[[], None] = lambda: None,
        stop: Callable[[Job], bool] = lambda job: True,
    ) -> Iterator[_Outcome[Job, Result]]:
        """Do the jobs; yields what came of each as it ends.

        Args:
            work: What to do with one; a module's function, or a partial of one.
            jobs: Taken when there is room for them.
            look: Called every BEAT.
            stop: Where the loop is left early: asks a job to end, returns whether it has begun. Those are waited for.
        """
        waiting, running = iter(jobs), dict[Future[Any], tuple[Job, int]]()

        def submit(job: Job, died: int) -> None:
            with _for_children(self.threads):
                running[self.executor.submit(_done, work, job)] = job, died

        try:
            while True:
                while len(running) < self.size and (job := next(waiting, None)) is not None:
                    submit(job, 0)
                if not running:
                    return
                for future in wait(running, BEAT, FIRST_COMPLETED).done:
                    job, died = running.pop(future)
                    lost = future.exception()
                    if lost is None:
                        yield _Outcome(job, *future.result())
                    elif died < RETRIES:
                        submit(job, died + 1)
                    else:
                        said = str(lost).strip() or type(lost).__name__
                        why = f"{died + 1} workers died of it, out of memory? The last: {said}"
                        yield _Outcome(job, None, WorkerError(why))
                look()
        finally:
            for future, (job, _) in running.items():
                if not stop(job):
                    future.cancel()
            wait(running)

    def map(self, work: Callable[[Job], Result], jobs: Iterable[Job]) -> Iterator[Result]:
        """Results in the order of the jobs, whichever is done first; raises the first error in its turn."""
        early: dict[int, _Outcome[Any, Result]] = {}
        turn = 0
        for outcome in self.run(partial(_second, work), enumerate(jobs)):
            early[outcome.job[0]] = outcome
            while turn in early:
                yield early.pop(turn).result()
                turn += 1

    @staticmethod
    def cores(threads: int) -> int:
        """How many jobs on so many threads each this machine has cores for."""
        return max(1, (os.cpu_count() or 1) // threads)


def _done(work: Callable[[Job], Result], job: Job) -> tuple[Result | None, Exception | None]:
    """A job in its worker."""
    try:
        return work(job), None
    except Exception as error:
        error.add_note(traceback.format_exc())
        return None, error


def _second(work: Callable[[Job], Result], job: tuple[int, Job]) -> Result:
    return work(job[1])


@contextmanager
def opened(where: str | Executor, workers: int, threads: int) -> Iterator[Pool]:
    """Start what jobs run on, or reach it; what was started here ends with the block.

    Args:
        where: local; ray, with :ADDRESS of a cluster; or an executor.
        workers: Jobs at a time; 0 for as many as there are cores.
        threads: How many one job takes.

    Raises:
        UsageError: No such executor, or no cluster there.
    """
    with ExitStack() as stack:
        executor = stack.enter_context(_Processes()) if where == LOCAL else where
        size = workers or Pool.cores(threads)
        if not isinstance(executor, Executor):
            kind, _, address = str(executor).partition(":")
            if kind != "ray":
                raise UsageError(
                    f"--executor {where}: choose local, ray or ray:ADDRESS; "
                    "from Python, give a concurrent.futures.Executor (docs/scale.md)"
                )
            with _for_children(threads):
                executor, size = _ray(stack, address, workers, threads)
        yield Pool(executor, max(1, size), threads)


class _Processes(Executor):
    """Processes of this machine, each a pool of its own: one that is killed takes nobody else's job with it."""

    def __init__(self) -> None:
        self.last: dict[ProcessPoolExecutor, Future[Any]] = {}

    def submit(self, fn: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Future[Any]:
        for pool in [pool for pool, last in self.last.items() if last.done()]:
            with suppress(BrokenProcessPool):
                self.last[pool] = pool.submit(fn, *args, **kwargs)
                return self.last[pool]
            del self.last[pool]
        pool = ProcessPoolExecutor(1, get_context("spawn"), _leave_with, (os.getpid(),))
        self.last[pool] = pool.submit(fn, *args, **kwargs)
        return self.last[pool]

    def shutdown(self, wait: bool = True, *, cancel_futures: bool = False) -> None:
        for pool in self.last:
            pool.shutdown(wait, cancel_futures=cancel_futures)


class _Ray(Executor):
    """Ray's tasks as futures; it has no executor of its own."""

    def __init__(self, call: Any) -> None:
        self.call = call

    def submit(self, fn: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Future[Any]:
        future: Future[Any] = self.call.remote(fn, *args, **kwargs).future()
        return future


def _call(fn: Callable[..., Any], *args: Any, **kwargs: Any) -> Any:
    return fn(*args, **kwargs)


def _ray(stack: ExitStack, address: str, workers: int, threads: int) -> tuple[Executor, int]:
    """A cluster at an address or $RAY_ADDRESS, else a Ray of our own that nobody outside this machine can reach."""
    address = address or os.environ.get("RAY_ADDRESS") or LOCAL
    if address == LOCAL:
        os.environ["RAY_ENABLE_WINDOWS_OR_OSX_CLUSTER"] = "0"  # on every system: bind to loopback
    import ray

    if not ray.is_initialized():
        mine: dict[str, Any] = {"include_dashboard": False, "num_cpus": workers * threads or None}
        quiet = {"log_to_driver": False, "logging_level": "ERROR"}
        try:
            ray.init(address, **quiet, **(mine if address == LOCAL else {}))
        except (ConnectionError, ValueError) as error:
            raise UsageError(f"--executor ray: no cluster at {address}: {error}") from None
        stack.callback(ray.shutdown)
    there = int(ray.cluster_resources().get("CPU", 1))
    call = ray.remote(num_cpus=min(threads, there), max_retries=0)(_call)
    return _Ray(call), workers or there // threads


@contextmanager
def _for_children(threads: int) -> Iterator[None]:
    """What a process that is started now reads from its environment; Ctrl-C in the terminal is for its parent alone."""
    told = dict.fromkeys(POOLS, str(threads)) | {SAFE: "1"}
    before = {name: os.environ.get(name) for name in told}
    main = threading.current_thread() is threading.main_thread()
    handler = signal.signal(signal.SIGINT, signal.SIG_IGN) if main else None
    os.environ.update(told)
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value
        if handler is not None:
            signal.signal(signal.SIGINT, handler)


def _leave_with(parent: int) -> None:
    """A worker whose parent was killed would wait for work forever: it ends itself instead."""

    def watch() -> None:
        while os.getppid() == parent:
            time.sleep(BEAT)
        os._exit(1)

    threading.Thread(target=watch, daemon=True).start()
