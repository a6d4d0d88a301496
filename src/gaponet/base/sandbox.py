"""Sandbox for untrusted files: one child process parses them within limits of memory, time and
open files.

A file of a few bytes can demand gigabytes or never end, and no parser can tell beforehand. The
child is started on demand, serves until it is idle for IDLE_S or this process ends, and is
restarted if it dies of a file. Memory and processor time are limited where the system allows it
(Linux; macOS limits the time only). Elsewhere a file that does not end is given up after
MAX_WALL_FACTOR times its processor time.
"""

from __future__ import annotations

import atexit
import functools
import os
import pickle
import select
import signal
import subprocess
import sys
import tempfile
import threading
from collections.abc import Callable
from contextlib import suppress
from importlib import import_module
from itertools import islice
from pathlib import Path
from typing import IO, Any, NamedTuple, TypeVar

from gaponet.base.child_process import module_command
from gaponet.base.errors import GAPONetError

try:
    import resource
except ImportError:  # Windows
    resource = None  # type: ignore[assignment]

T = TypeVar("T")
MEMORY_BYTES = 960 << 20  # of the child, with the libraries that it loads
PROCESSOR_S = 6.0  # for a small file
MAX_WALL_FACTOR = 20.0  # wall time over processor time, on a machine with other work
MAX_OPEN_FILES = 256
MAX_FILES_BESIDE_MODEL = 5000  # whose sizes count
IDLE_S = 20.0
IDLE = "the child was idle and ended"
# One thread and the system's allocator: what other allocators reserve counts as memory in use.
INHERITED_VARIABLES = (
    "PATH",
    "HOME",
    "LANG",
    "LC_ALL",
    "SYSTEMROOT",
    "TEMP",
    "TMP",
    "TMPDIR",
    "LD_LIBRARY_PATH",
)
CHILD_VARIABLES = {
    "OMP_NUM_THREADS": "1",
    "OPENBLAS_NUM_THREADS": "1",
    "MKL_NUM_THREADS": "1",
    "ARROW_DEFAULT_MEMORY_POOL": "system",
}


def sandboxed(
    error: type[GAPONetError], library: str, seconds_per_mb: float = 1.0
) -> Callable[[Callable[..., T]], Callable[..., T]]:
    """Decorate a module's function, whose first argument is an untrusted file, to run in the
    sandbox.

    Arguments and results are pickled. An exception of the function is raised in the caller.

    Args:
        error: Raised if the child ends or exceeds a limit; the message names the file.
        library: The parser, imported before time and memory count.
        seconds_per_mb: Additional processor time, s per MB of the file.
    """

    def wrap(function: Callable[..., T]) -> Callable[..., T]:
        @functools.wraps(function)
        def call(file: Path, *arguments: Any) -> T:
            if Child.is_this_process:
                return function(file, *arguments)
            path = Path(os.path.abspath(file))
            seconds = PROCESSOR_S + 1e-6 * seconds_per_mb * _size(path)
            request = _Request(
                function.__module__, function.__name__, path, file, arguments, seconds
            )
            result: T = answer_of_child(request, error)
            return result

        call.sandboxed = function, library  # type: ignore[attr-defined]
        return call

    return wrap


def in_sandbox() -> bool:
    """Return True in the child."""
    return Child.is_this_process


class _Request(NamedTuple):
    """What the child is asked to do: call a function of a module with a file."""

    module: str
    function: str
    path: Path  # absolute, since the child works in another folder
    file: Path  # the same, as the caller names it in messages
    arguments: tuple[Any, ...]
    seconds: float  # processor time that it may take


def answer_of_child(request: _Request, error: type[GAPONetError]) -> Any:
    """Return the result of a request.

    Raises:
        error: The child ended, or exceeded a limit.
        Exception: That of the function.
    """
    with _LOCK:
        answer, failure = Child.current_or_new().request(request)
        if failure == IDLE:  # it ended before it could read the request
            answer, failure = Child.current_or_new().request(request)
    file = request.file
    if failure == "memory":
        raise error(
            f"{file}: takes more than {MEMORY_BYTES >> 20} MiB to be read, more than a file may; "
            "cut it"
        )
    if failure == "time":
        raise error(
            f"{file}: is not read after {request.seconds:.0f} s, longer than a file of its size "
            "may take; cut it"
        )
    if failure:
        raise error(f"{file}: is not readable ({failure}); copy or make it again")
    if isinstance(answer, Exception):
        raise answer
    return answer


def _size(path: Path) -> int:
    """Return the bytes of a file or folder.

    A model counts with the files around it, which it may name.
    """
    with suppress(OSError):
        if path.is_dir() or path.suffix in (".xml", ".urdf"):
            folder = path if path.is_dir() else path.parent
            around = islice(folder.rglob("*"), MAX_FILES_BESIDE_MODEL)
            return sum(file.stat().st_size for file in around if file.is_file())
        return path.stat().st_size
    return 0


class Child:
    """The child process, seen from its parent."""

    is_this_process = False
    current: Child | None = None

    def __init__(self) -> None:
        inherited = {name: os.environ[name] for name in INHERITED_VARIABLES if name in os.environ}
        self.owner = os.getpid()
        self.process = subprocess.Popen(
            module_command(__name__),
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            cwd=tempfile.gettempdir(),
            env=inherited | CHILD_VARIABLES,
        )

    @classmethod
    def current_or_new(cls) -> Child:
        child = cls.current
        if child is None or child.owner != os.getpid() or child.process.poll() is not None:
            child = cls()
            cls.current = child
        return child

    def request(self, request: _Request) -> tuple[Any, str]:
        """Return the answer and "", or None and the failure: "memory", "time", or a reason."""
        assert self.process.stdin
        assert self.process.stdout
        timeout = threading.Timer(MAX_WALL_FACTOR * request.seconds, self.process.kill)
        timeout.start()
        try:
            _write(self.process.stdin, request)
            result: tuple[Any, str] = pickle.load(self.process.stdout)
            return result
        except (EOFError, BrokenPipeError, pickle.UnpicklingError):
            # The child has ended: before its answer, before it read the request, or in its answer.
            code = self.process.wait()
            if code == 0:
                return None, IDLE
            if code == -getattr(signal, "SIGXCPU", 0) or not timeout.is_alive():
                return None, "time"
            return None, f"its parser ended with code {code}: damaged, or too large"
        except BaseException:  # an unread answer would be taken for the next one
            self.close()
            raise
        finally:
            timeout.cancel()

    def close(self) -> None:
        if self.owner == os.getpid():
            self.process.kill()
            self.process.wait()


_LOCK = threading.Lock()


@atexit.register
def _close() -> None:
    if Child.current is not None:
        Child.current.close()


def _write(stream: IO[bytes], value: Any) -> None:
    """Write a pickle.

    Protocol 5 writes arrays without a copy, which would count as the child's memory.
    """
    pickle.dump(value, stream, 5)
    stream.flush()


def _serve() -> None:
    """Answer requests in the child until it is idle."""
    out = os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)  # a library may print; that is no answer
    Child.is_this_process = True
    while os.name == "nt" or select.select([0], [], [], IDLE_S)[0]:
        try:
            request: _Request = pickle.load(sys.stdin.buffer)
        except EOFError:
            return
        try:
            decorated = getattr(import_module(request.module), request.function)
            function, library = decorated.sandboxed
            import_module(library)
            _set_limits(request.seconds)
            _write(out, _answer(function, request))
        except ImportError as error:  # an extra that is not installed
            _write(out, (error, ""))
        except MemoryError:
            _write(out, (None, "memory"))


def _answer(function: Callable[..., Any], request: _Request) -> tuple[Any, str]:
    """Return the result of a function or its error, and ""; or None and why the file cannot be
    read.
    """
    try:
        return function(request.path, *request.arguments), ""
    except (MemoryError, ImportError):
        raise
    except GAPONetError as error:
        return type(error)(str(error).replace(str(request.path), str(request.file))), ""
    except Exception as error:
        return None, f"{type(error).__name__}: {' '.join(str(error).split())}"[:200]


def _set_limits(seconds: float) -> None:
    """Limit what the next request may use, beyond what the child has used already."""
    if resource is None:
        return
    used = resource.getrusage(resource.RUSAGE_SELF)
    _set_limit(resource.RLIMIT_CPU, int(used.ru_utime + used.ru_stime + seconds + 1))
    _set_limit(resource.RLIMIT_CORE, 0)
    _set_limit(resource.RLIMIT_FSIZE, MEMORY_BYTES)
    _set_limit(resource.RLIMIT_NOFILE, MAX_OPEN_FILES)
    with suppress(OSError):  # /proc exists on Linux only
        lines = Path("/proc/self/status").read_text().splitlines()
        status = dict(line.split(":") for line in lines)
        resident = int(status["VmRSS"].split()[0]) << 10  # bytes
        private = int(status["VmData"].split()[0]) << 10  # bytes
        _set_limit(resource.RLIMIT_DATA, private + max(MEMORY_BYTES - resident, 0))


def _set_limit(kind: int, soft: int) -> None:
    _, hard = resource.getrlimit(kind)
    if hard != resource.RLIM_INFINITY:
        soft = min(soft, hard)
    resource.setrlimit(kind, (soft, hard))


if __name__ == "__main__":
    # Not as __main__: functions know this module by its name.
    import_module("gaponet.base.sandbox")._serve()
