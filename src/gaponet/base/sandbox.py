"""A sandbox for strangers' content: one child that parses it, within limits of memory, time and files.

A file of some bytes can ask for gigabytes, or for ever, and no parser says so before it has begun. The child parses;
what it returns has a size and has come to an end. It is started when it is asked, serves until nobody asks for a while
or this process ends, and is started again where a file was the end of it. Memory and computing time are limited where
the system can do that (Linux; macOS limits the time alone); elsewhere a file that does not end is given up after WAIT.
"""

from __future__ import annotations

import atexit
import functools
import os
import pickle
import select
import signal
import struct
import subprocess
import sys
import tempfile
import threading
from collections.abc import Callable
from contextlib import suppress
from importlib import import_module
from itertools import islice
from pathlib import Path
from typing import IO, Any, TypeVar

from gaponet.base import child
from gaponet.base.errors import GAPONetError

try:
    import resource
except ImportError:  # Windows
    resource = None  # type: ignore[assignment]

T = TypeVar("T")
MEMORY = 960 << 20  # bytes of the child, with what it loads
SECONDS = 6.0  # of computing, and more of it for a larger file
WAIT = 20.0  # times as long as that on a machine that others use too, before a child that does not compute is ended
FILES = 256  # open ones
MOST = 5000  # files around a model whose sizes are added
REST = 20.0  # s after which a child that nobody asks ends
IDLE = "ended, as nobody asked"
# One thread and the system's allocator: what others reserve counts as memory that is used.
KEPT = ("PATH", "HOME", "LANG", "LC_ALL", "SYSTEMROOT", "TEMP", "TMP", "TMPDIR", "LD_LIBRARY_PATH")
OWN = {
    "OMP_NUM_THREADS": "1",
    "OPENBLAS_NUM_THREADS": "1",
    "MKL_NUM_THREADS": "1",
    "ARROW_DEFAULT_MEMORY_POOL": "system",
}
HEAD = struct.Struct("<Q")


def inside(
    error: type[GAPONetError], library: str, pace: float = 1.0
) -> Callable[[Callable[..., T]], Callable[..., T]]:
    """A function of a module whose first argument is a stranger's file: it runs in the sandbox, with plain arguments.

    What it raises is raised here; where the child ends of it, or wants more than it may have, `error` says which file.

    Args:
        error: How the caller is told.
        library: What parses, which is imported before time and memory count.
        pace: s of computing that it may take for a MB.
    """

    def wrap(function: Callable[..., T]) -> Callable[..., T]:
        @functools.wraps(function)
        def call(file: Path, *given: Any) -> T:
            whole = Path(os.path.abspath(file))
            return _called(function, error, SECONDS + 1e-6 * pace * _size(whole), whole, file, given)

        call.inside = function, library  # type: ignore[attr-defined]
        return call

    return wrap


def here() -> bool:
    """Whether this process is the sandbox."""
    return _Child.here


def _called(
    function: Callable[..., T], error: type[GAPONetError], seconds: float, whole: Path, file: Path, given: Any
) -> T:
    if _Child.here:
        return function(file, *given)
    what = function.__module__, function.__name__, whole, file, given, seconds
    with _LOCK:
        found, said = _Child.open().ask(what, seconds)
        if said == IDLE:
            found, said = _Child.open().ask(what, seconds)
    if said == "memory":
        raise error(f"{file}: takes more than {MEMORY >> 20} MiB to be read, more than a file may; cut it")
    if said == "time":
        raise error(f"{file}: is not read after {seconds:.0f} s, longer than a file of its size may take; cut it")
    if said:
        raise error(f"{file}: is not readable ({said}); copy or make it again")
    if isinstance(found, Exception):
        raise found
    return found


def _size(path: Path) -> int:
    """Bytes of a file, or of the files directly in a folder; of a model with those around it, which it names."""
    with suppress(OSError):
        if path.is_dir() or path.suffix in (".xml", ".urdf"):
            folder = path if path.is_dir() else path.parent
            return sum(f.stat().st_size for f in islice(folder.rglob("*"), MOST) if f.is_file())
        return path.stat().st_size
    return 0


class _Child:
    """The child, seen from this process."""

    here = False  # this process is one
    current: _Child | None = None

    def __init__(self) -> None:
        kept = {name: os.environ[name] for name in KEPT if name in os.environ}
        self.owner, self.process = os.getpid(), subprocess.Popen(
            child.words(__name__), stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL,
            cwd=tempfile.gettempdir(), env=kept | OWN,
        )  # fmt: skip

    @classmethod
    def open(cls) -> _Child:
        mine = cls.current
        if mine is None or mine.owner != os.getpid() or mine.process.poll() is not None:
            mine = cls.current = cls()
        return mine

    def ask(self, what: Any, seconds: float) -> tuple[Any, str]:
        """What the child answers, and "", or why it does not: memory, time, or in words."""
        assert self.process.stdin
        assert self.process.stdout
        late = threading.Timer(WAIT * seconds, self.process.kill)
        late.start()
        try:
            _write(self.process.stdin, what)
            return _read(self.process.stdout)
        except (EOFError, BrokenPipeError):
            code = self.process.wait()
            if code == 0:
                return None, IDLE
            timed = code == -getattr(signal, "SIGXCPU", 0) or not late.is_alive()
            return None, "time" if timed else f"its parser ended with code {code}: damaged, or too large"
        except BaseException:  # an answer that nobody took is not the next one's
            self.close()
            raise
        finally:
            late.cancel()

    def close(self) -> None:
        if self.owner == os.getpid():
            self.process.kill()
            self.process.wait()


_LOCK = threading.Lock()


@atexit.register
def _close() -> None:
    if _Child.current is not None:
        _Child.current.close()


def _write(stream: IO[bytes], what: Any) -> None:
    """Pickled; large arrays lie behind it as they are."""
    buffers: list[pickle.PickleBuffer] = []
    parts: list[Any] = [pickle.dumps(what, 5, buffer_callback=buffers.append), *(b.raw() for b in buffers)]
    stream.write(b"".join(HEAD.pack(n) for n in (len(parts), *(memoryview(part).nbytes for part in parts))))
    for part in parts:
        stream.write(part)
    stream.flush()


def _read(stream: IO[bytes]) -> Any:
    sizes = [_number(stream) for _ in range(_number(stream))]
    text, *buffers = (_exactly(stream, size) for size in sizes)
    return pickle.loads(text, buffers=buffers)


def _number(stream: IO[bytes]) -> int:
    return int(HEAD.unpack(_exactly(stream, HEAD.size))[0])


def _exactly(stream: IO[bytes], size: int) -> bytearray:
    whole = bytearray(size)
    view, at = memoryview(whole), 0
    while at < size:
        got = stream.readinto(view[at:])  # type: ignore[attr-defined]
        if not got:
            raise EOFError
        at += got
    return whole


def _serve() -> None:
    """The child: a request, an answer, until nobody asks."""
    out = os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)  # what a library prints is no answer
    _Child.here = True
    while os.name == "nt" or select.select([0], [], [], REST)[0]:
        try:
            module, name, whole, file, given, seconds = _read(sys.stdin.buffer)
        except EOFError:
            return
        try:
            function, library = getattr(import_module(module), name).inside
            import_module(library)
            _limit(seconds)
            _write(out, _answer(function, whole, file, given))
        except ImportError as error:  # an extra that is not installed
            _write(out, (error, ""))
        except MemoryError:
            _write(out, (None, "memory"))


def _answer(function: Callable[..., Any], whole: Path, file: Path, given: tuple[Any, ...]) -> tuple[Any, str]:
    try:
        return function(whole, *given), ""
    except (MemoryError, ImportError):
        raise
    except GAPONetError as error:
        return type(error)(str(error).replace(str(whole), str(file))), ""
    except Exception as error:
        return None, f"{type(error).__name__}: {' '.join(str(error).split())}"[:200]


def _limit(seconds: float) -> None:
    """For what comes now: what the limits count so far is not its own."""
    if resource is None:
        return
    used = resource.getrusage(resource.RUSAGE_SELF)
    _lower(resource.RLIMIT_CPU, int(used.ru_utime + used.ru_stime + seconds + 1))
    _lower(resource.RLIMIT_CORE, 0)
    _lower(resource.RLIMIT_FSIZE, MEMORY)
    _lower(resource.RLIMIT_NOFILE, FILES)
    with suppress(OSError):  # /proc is Linux's
        counts = dict(line.split(":") for line in Path("/proc/self/status").read_text().splitlines())
        resident, private = (int(counts[name].split()[0]) << 10 for name in ("VmRSS", "VmData"))
        _lower(resource.RLIMIT_DATA, private + max(MEMORY - resident, 0))


def _lower(which: int, soft: int) -> None:
    _, hard = resource.getrlimit(which)
    resource.setrlimit(which, (soft if hard == resource.RLIM_INFINITY else min(soft, hard), hard))


if __name__ == "__main__":
    import_module("gaponet.base.sandbox")._serve()  # not as __main__: functions know this module by its name
