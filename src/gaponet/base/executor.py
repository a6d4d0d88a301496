"""Jobs in other processes of this machine or of a cluster, on any concurrent.futures.Executor.

An exception of a job is its outcome. An exception of the executor means that the worker died (out
of memory, kill -9, machine lost): the job is then repeated, up to MAX_RETRIES times. Ray is
imported only on request.
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
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from functools import partial
from multiprocessing import get_context
from typing import Any, Generic, TypeVar

from gaponet.base.child_process import SAFE_PATH_VARIABLE
from gaponet.base.errors import UsageError, WorkerError

Job = TypeVar("Job")
Result = TypeVar("Result")

LOCAL = "local"
MAX_RETRIES = 2  # of a job whose worker died
POLL_INTERVAL_S = 0.3
MAX_WORKERS = 1024
THREAD_VARIABLES = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")


@dataclass(frozen=True)
class _Outcome(Generic[Job, Result]):
    """Result of one job, or its error: the exception of the job, or a WorkerError if its workers
    died.
    """

    job: Job
    value: Result | None
    error: Exception | None

    def result(self) -> Result:
        """Return the value or raise the error."""
        if self.error is not None:
            raise self.error
        return self.value  # type: ignore[return-value]


@dataclass(frozen=True)
class Pool:
    """Executor with the number of jobs that it receives at a time."""

    executor: Executor
    size: int

    def run(
        self,
        work: Callable[[Job], Result],
        jobs: Iterable[Job],
        on_poll: Callable[[], None] = lambda: None,
        request_stop: Callable[[Job], bool] = lambda job: True,
    ) -> Iterator[_Outcome[Job, Result]]:
        """Yield the outcome of each job when it ends.

        Args:
            work: A module's function, or a partial of one.
            jobs: Consumed as workers become free.
            on_poll: Called every POLL_INTERVAL_S.
            request_stop: Called for each job that is left if the caller leaves the loop early. It
                asks the job to end and returns True if the job has begun; those jobs are awaited.
        """
        waiting = iter(jobs)
        running = dict[Future[Any], tuple[Job, int]]()  # → job, and how many workers died of it

        def submit(job: Job, deaths: int) -> None:
            with _child_environment():
                running[self.executor.submit(_run_job, work, job)] = job, deaths

        try:
            while True:
                while len(running) < self.size and (job := next(waiting, None)) is not None:
                    submit(job, 0)
                if not running:
                    return
                for future in wait(running, POLL_INTERVAL_S, FIRST_COMPLETED).done:
                    job, deaths = running.pop(future)
                    death = future.exception()
                    if death is None:
                        value, error = future.result()  # of _run_job
                        yield _Outcome(job, value, error)
                    elif deaths < MAX_RETRIES:
                        submit(job, deaths + 1)
                    else:
                        yield _Outcome(job, None, _worker_error(death, deaths + 1))
                on_poll()
        finally:
            for future, (job, _) in running.items():
                has_begun = request_stop(job)
                if not has_begun:
                    future.cancel()
            wait(running)

    def map(self, work: Callable[[Job], Result], jobs: Iterable[Job]) -> Iterator[Result]:
        """Yield the results in the order of the jobs; raise the first error in its turn."""
        early: dict[int, _Outcome[Any, Result]] = {}
        turn = 0
        for outcome in self.run(partial(_run_numbered, work), enumerate(jobs)):
            early[outcome.job[0]] = outcome
            while turn in early:
                yield early.pop(turn).result()
                turn += 1


def _worker_error(last: BaseException, deaths: int) -> WorkerError:
    """Return the error of a job of which so many workers died."""
    reason = str(last).strip() or type(last).__name__
    return WorkerError(f"{deaths} workers died of it, out of memory? The last: {reason}")


def _run_job(work: Callable[[Job], Result], job: Job) -> tuple[Result | None, Exception | None]:
    """Run a job in its worker; return its result and None, or None and its error."""
    try:
        return work(job), None
    except Exception as error:
        error.add_note(traceback.format_exc())
        return None, error


def _run_numbered(work: Callable[[Job], Result], job: tuple[int, Job]) -> Result:
    return work(job[1])


@contextmanager
def open_pool(where: str | Executor, workers: int) -> Iterator[Pool]:
    """Start or reach an executor; what was started here ends with the block.

    A job has one thread.

    Args:
        where: "local"; "ray", with ":ADDRESS" of a cluster; or an executor.
        workers: Jobs at a time; 0 for as many as there are cores.

    Raises:
        UsageError: There is no such executor, or no cluster at the address.
    """
    executor: Executor
    size = workers or os.cpu_count() or 1
    with ExitStack() as stack:
        if isinstance(where, Executor):
            executor = where
        elif where == LOCAL:
            executor = stack.enter_context(_ProcessPerWorker())
        else:
            address = _ray_address(where)
            with _child_environment():
                executor, size = _connect_ray(stack, address, workers)
        yield Pool(executor, max(1, size))


def _ray_address(where: str) -> str:
    """Return ADDRESS of "ray:ADDRESS", "" of "ray".

    Raises:
        UsageError: It is no Ray.
    """
    kind, _, address = str(where).partition(":")
    if kind != "ray":
        raise UsageError(
            f"--executor {where}: choose local, ray or ray:ADDRESS; from Python, give a "
            "concurrent.futures.Executor (docs/install.md)"
        )
    return address


class _ProcessPerWorker(Executor):
    """Pools of one process each: when a worker is killed, only its own job is lost."""

    def __init__(self) -> None:
        self.last_jobs: dict[ProcessPoolExecutor, Future[Any]] = {}

    def submit(self, fn: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Future[Any]:
        idle = [pool for pool, last in self.last_jobs.items() if last.done()]
        for pool in idle:
            try:
                future = pool.submit(fn, *args, **kwargs)
            except BrokenProcessPool:
                del self.last_jobs[pool]
                continue
            self.last_jobs[pool] = future
            return future
        pool = ProcessPoolExecutor(1, get_context("spawn"), _end_with_parent, (os.getpid(),))
        self.last_jobs[pool] = pool.submit(fn, *args, **kwargs)
        return self.last_jobs[pool]

    def shutdown(self, wait: bool = True, *, cancel_futures: bool = False) -> None:
        for pool in self.last_jobs:
            pool.shutdown(wait, cancel_futures=cancel_futures)


class _RayExecutor(Executor):
    """Executor of Ray tasks."""

    def __init__(self, task: Any) -> None:
        self.task = task

    def submit(self, fn: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Future[Any]:
        future: Future[Any] = self.task.remote(fn, *args, **kwargs).future()
        return future


def _call(fn: Callable[..., Any], *args: Any, **kwargs: Any) -> Any:
    return fn(*args, **kwargs)


def _connect_ray(stack: ExitStack, address: str, workers: int) -> tuple[Executor, int]:
    """Connect to the cluster at an address or $RAY_ADDRESS, or start Ray here, closed to other
    machines.
    """
    address = address or os.environ.get("RAY_ADDRESS") or LOCAL
    options: dict[str, Any] = {"log_to_driver": False, "logging_level": "ERROR"}
    if address == LOCAL:
        options |= {"include_dashboard": False, "num_cpus": workers or None}
        # Ray then binds to the loopback interface on every system.
        os.environ["RAY_ENABLE_WINDOWS_OR_OSX_CLUSTER"] = "0"
    import ray

    if not ray.is_initialized():
        try:
            ray.init(address, **options)
        except (ConnectionError, ValueError) as error:
            raise UsageError(f"--executor ray: no cluster at {address}: {error}") from None
        stack.callback(ray.shutdown)
    cpus = int(ray.cluster_resources().get("CPU", 1))
    task = ray.remote(num_cpus=1, max_retries=0)(_call)
    return _RayExecutor(task), workers or cpus


@contextmanager
def _child_environment() -> Iterator[None]:
    """Set the environment that a process started in the block inherits.

    Ctrl-C reaches its parent only.
    """
    variables = dict.fromkeys(THREAD_VARIABLES, "1") | {SAFE_PATH_VARIABLE: "1"}
    before = {name: os.environ.get(name) for name in variables}
    main = threading.current_thread() is threading.main_thread()
    handler = signal.signal(signal.SIGINT, signal.SIG_IGN) if main else None
    os.environ.update(variables)
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


def _end_with_parent(parent: int) -> None:
    """End this worker when its parent is gone: it would wait for work forever."""

    def watch() -> None:
        while os.getppid() == parent:
            time.sleep(POLL_INTERVAL_S)
        os._exit(1)

    threading.Thread(target=watch, daemon=True).start()
