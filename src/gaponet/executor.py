"""Jobs in other processes, here or on a cluster: one loop over any concurrent.futures.Executor.

What a job raises is its outcome. What the executor raises means that its worker died (out of memory, kill -9, a machine
gone): the job is given to another worker, RETRIES times. Libraries are loaded only where they are asked for.
"""

from __future__ import annotations

import os
import shutil
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
from pathlib import Path
from typing import Any, Generic, TypeVar

from gaponet.errors import UsageError, WorkerError
from gaponet.files import MARK
from gaponet.process.child import SAFE

Job = TypeVar("Job")
Result = TypeVar("Result")

LOCAL = "local"
RETRIES = 2
BEAT = 0.3  # s between two looks at what is going on
POLL = 1.0  # s between two looks at submitit's jobs, which are files
MOST_WORKERS = 1024
LOOPBACK = "127.0.0.1"
DAY = 24 * 60  # min; submitit's own limit is minutes
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
def opened(where: str | Executor, workers: int, threads: int, folder: Path) -> Iterator[Pool]:
    """Start what jobs run on, or reach it; what was started here ends with the block.

    Args:
        where: local; ray or dask, with :ADDRESS of a cluster; submitit, with :KEY=VALUE,… for it; or an executor.
        workers: Jobs at a time; 0 for as many as there are cores.
        threads: How many one job takes.
        folder: A folder of the user's, seen by all workers, for submitit's files.

    Raises:
        UsageError: No such executor, or no cluster there.
    """
    if isinstance(where, Executor):
        yield Pool(where, workers or Pool.cores(threads), threads)
        return
    kind, _, at = where.partition(":")
    if kind not in KINDS or (at and kind == LOCAL):
        raise UsageError(f"--executor {where}: choose local, ray, dask or submitit; the last three with :ADDRESS")
    with ExitStack() as stack:
        with _for_children(threads):
            executor, size = KINDS[kind](stack, at, workers, threads, folder)
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


def _local(stack: ExitStack, at: str, workers: int, threads: int, folder: Path) -> tuple[Executor, int]:
    return stack.enter_context(_Processes()), workers or Pool.cores(threads)


class _Ray(Executor):
    """Ray's tasks as futures; it has no executor of its own."""

    def __init__(self, call: Any) -> None:
        self.call = call

    def submit(self, fn: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Future[Any]:
        future: Future[Any] = self.call.remote(fn, *args, **kwargs).future()
        return future


def _call(fn: Callable[..., Any], *args: Any, **kwargs: Any) -> Any:
    return fn(*args, **kwargs)


def _ray(stack: ExitStack, at: str, workers: int, threads: int, folder: Path) -> tuple[Executor, int]:
    """A cluster at an address or $RAY_ADDRESS, else a Ray of our own that nobody outside this machine can reach."""
    address = at or os.environ.get("RAY_ADDRESS") or LOCAL
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


def _dask(stack: ExitStack, at: str, workers: int, threads: int, folder: Path) -> tuple[Executor, int]:
    """A scheduler at an address or $DASK_SCHEDULER_ADDRESS, else processes of this machine."""
    import dask
    from distributed import Client, LocalCluster

    retried_here = {"distributed.scheduler.allowed-failures": 0, "distributed.scheduler.worker-saturation": 1.0}
    stack.enter_context(dask.config.set(retried_here))
    address = at or os.environ.get("DASK_SCHEDULER_ADDRESS")
    try:
        here = {"n_workers": workers or Pool.cores(threads), "threads_per_worker": 1, "memory_limit": 0}
        cluster = address or stack.enter_context(LocalCluster(host=LOOPBACK, dashboard_address=f"{LOOPBACK}:0", **here))
        client = stack.enter_context(Client(cluster))
    except (OSError, ValueError) as error:
        raise UsageError(f"--executor dask: no scheduler at {address}: {error}") from None
    return client.get_executor(pure=False), workers or sum(client.nthreads().values())


class _Submitit(Executor):
    """submitit's jobs as futures: one thread looks after all of them."""

    def __init__(self, auto: Any) -> None:
        self.auto, self.jobs, self.closed = auto, list[tuple[Any, Future[Any]]](), False
        self.thread = threading.Thread(target=self._look, daemon=True)
        self.thread.start()

    def submit(self, fn: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Future[Any]:
        future: Future[Any] = Future()
        self.jobs.append((self.auto.submit(fn, *args, **kwargs), future))
        return future

    def _look(self) -> None:
        while not self.closed:
            for job, future in list(self.jobs):
                if future.cancelled():
                    job.cancel(check=False)
                elif not job.done():
                    continue
                elif (error := job.exception()) is not None:
                    future.set_exception(error)
                else:
                    future.set_result(job.result())
                self.jobs.remove((job, future))
            time.sleep(POLL)

    def shutdown(self, wait: bool = True, *, cancel_futures: bool = False) -> None:
        self.closed = True
        self.thread.join()
        for job, _ in self.jobs:
            job.cancel(check=False)


def _submitit(stack: ExitStack, at: str, workers: int, threads: int, folder: Path) -> tuple[Executor, int]:
    """SLURM where there is sbatch, else processes of this machine; KEY=VALUE,… are submitit's parameters."""
    import submitit

    given = dict(word.partition("=")[::2] for word in at.split(",") if word)
    place = folder.absolute() / f"{MARK}-{os.getpid()}-submitit"
    stack.callback(shutil.rmtree, place, ignore_errors=True)
    try:
        auto = submitit.AutoExecutor(place, given.pop("cluster", None))
        asked = {key: int(value) if value.isdigit() else value for key, value in given.items()}
        auto.update_parameters(**({"timeout_min": DAY, "cpus_per_task": threads} | asked))
    except (ValueError, TypeError, NameError, RuntimeError) as error:
        raise UsageError(f"--executor submitit:{at}: {error}") from None
    usual = Pool.cores(threads) if auto.cluster == LOCAL else MOST_WORKERS
    return stack.enter_context(_Submitit(auto)), workers or usual


KINDS = {LOCAL: _local, "ray": _ray, "dask": _dask, "submitit": _submitit}


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
