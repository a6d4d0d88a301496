"""Files that a browser sends to the page: each is stored whole, in its own event, over no other
file.

An upload passes three places, and is renamed from one to the next:

1. `.gaponet-PROCESS-…`: it is written, or unpacked, here. What is not readable never leaves it.
2. `incoming/logs-1`: it is complete, and waits while a command runs.
3. `logs`: its files are moved here. If the server is killed in between, the next one moves the
others.
"""

from __future__ import annotations

import errno
import functools
import io
import lzma
import os
import re
import shutil
import tempfile
import threading
import zipfile
import zlib
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from gaponet.base.errors import GAPONetError, UsageError
from gaponet.base.files import FOLDER_MARKER
from gaponet.base.installation import pip
from gaponet.base.text import escape_markdown
from gaponet.report.view.jobs import Jobs
from gaponet.report.view.server import TESTED_VISER

PLACES = ("logs", "model", "new_logs")
INCOMING = "incoming"  # folder of complete uploads that wait
WAITING_NAME = re.compile(rf"({'|'.join(PLACES)})-(\d{{1,9}})")
MAX_UNPACKED_BYTES = 2 << 30  # of a .zip; the page holds an upload in memory
BROKEN_ZIP_ERRORS = (
    zipfile.BadZipFile,
    zlib.error,
    lzma.LZMAError,
    EOFError,
    RuntimeError,
    ValueError,
)
# OSErrors of the disk. Any other one comes from the .zip too: a file where it has a folder, a name
# that is too long, damaged bzip2.
DISK_ERRORS = (errno.ENOSPC, errno.EDQUOT, errno.EROFS, errno.EACCES, errno.EIO, errno.EMFILE)
MAX_SHOWN_STORED = 5  # lines of stored files; the newest
MAX_SHOWN_REFUSED = 20  # lines of refused files; the oldest, and the number of the others


class Uploads:
    """Uploads of a page: those that wait for a command, and what became of the others.

    Attributes:
        folder: The page's folder.
        jobs: Its commands; no file is put into a place while one runs.
        notices: What is shown.
    """

    def __init__(self, folder: Path, jobs: Jobs, show: Callable[[str, bool], None]) -> None:
        """Look after the uploads of a folder.

        Args:
            show: Is called with the notices, in Markdown, and whether there is one that must be
                dismissed.
        """
        self.folder = folder
        self.jobs = jobs
        self.notices = Notices(show)
        self._names: dict[str, str] = {}  # waiting folder → name of the uploaded file
        self._number = 0
        self._lock = threading.Lock()

    def receive(self, name: str, content: bytes, place: str) -> None:
        """Store an uploaded file in logs, model or new_logs, now or when the running command has
        ended.
        """
        try:
            with tempfile.TemporaryDirectory(
                prefix=f"{FOLDER_MARKER}-{os.getpid()}-", dir=self.folder
            ) as temporary:
                complete = Path(temporary) / "files"
                complete.mkdir()
                unpack(name, content, complete)
                self._add_waiting(name, complete, place)
        except (GAPONetError, OSError) as error:
            self.notices.refused(name, str(error))
            return
        self.place_waiting()

    def place_waiting(self) -> None:
        """Move complete uploads to their places, in their order, unless a command runs."""
        with self.jobs.lock:
            waiting = self._waiting()
            if not waiting:
                return
            try:
                self.jobs.require_idle()
            except UsageError:
                names = [self._names.get(upload.name, upload.name) for upload in waiting]
                self.notices.waiting(names)
                return
            self.notices.waiting([])
            for upload in waiting:
                self._place(upload)

    def _add_waiting(self, name: str, complete: Path, place: str) -> None:
        incoming = self.folder / INCOMING
        with self._lock:
            incoming.mkdir(exist_ok=True)
            self._number += 1
            while os.path.lexists(incoming / f"{place}-{self._number}"):
                self._number += 1
            waiting = incoming / f"{place}-{self._number}"
            self._names[waiting.name] = name
            complete.rename(waiting)

    def _waiting(self) -> list[Path]:
        """Return the folders of complete uploads in their order."""
        found = {}
        for path in (self.folder / INCOMING).glob("*"):
            matched = WAITING_NAME.fullmatch(path.name)
            if matched and path.is_dir() and not path.is_symlink():
                found[path] = int(matched[2])
        return sorted(found, key=lambda path: found[path])

    def _place(self, upload: Path) -> None:
        place = upload.name.rpartition("-")[0]
        name = self._names.pop(upload.name, f"an upload of an earlier page ({upload.name})")
        try:
            move_files(upload, self.folder / place)
        except (GAPONetError, OSError) as error:
            self.notices.refused(name, str(error))
        else:
            self.notices.stored(name, place)
        shutil.rmtree(upload)


class Notices:
    """What became of the uploads. Reasons of refused ones stay until they are dismissed."""

    def __init__(self, show: Callable[[str, bool], None]) -> None:
        self._show = show
        self._stored: list[str] = []
        self._refused: list[str] = []
        self._waiting: list[str] = []
        self._lock = threading.Lock()

    def stored(self, name: str, place: str) -> None:
        """Say that an upload is stored."""
        self._add(self._stored, f"{escape_markdown(name)} is stored in {place}.")

    def refused(self, name: str, reason: str) -> None:
        """Say why an upload is not stored."""
        text = f"**Not stored: {escape_markdown(name)}.** {escape_markdown(reason)}"
        self._add(self._refused, text)

    def waiting(self, names: list[str]) -> None:
        """Say which uploads wait until the running command has ended."""
        with self._lock:
            if names != self._waiting:
                self._waiting = names
                self._update()

    def dismiss(self) -> None:
        """Forget all."""
        with self._lock:
            self._stored.clear()
            self._refused.clear()
            self._update()

    def _add(self, lines: list[str], text: str) -> None:
        with self._lock:
            lines.append(text)
            self._update()

    def _update(self) -> None:
        lines = self._refused[:MAX_SHOWN_REFUSED]
        if len(self._refused) > MAX_SHOWN_REFUSED:
            lines.append(f"{len(self._refused) - MAX_SHOWN_REFUSED} more uploads are not stored.")
        if self._waiting:
            names = escape_markdown(", ".join(self._waiting[:MAX_SHOWN_STORED]))
            lines.append(f"Uploads that wait until the command has ended: {names}")
        if len(self._stored) > MAX_SHOWN_STORED:
            lines.append(f"{len(self._stored)} uploads are stored, the last of them:")
        lines += self._stored[-MAX_SHOWN_STORED:]
        self._show("\n\n".join(lines), bool(self._refused))


def connect_upload_button(button: Any, receive: Callable[[str, bytes], None]) -> None:
    """Call receive(name, content) in a thread for each file that an upload button of viser gets.

    viser stores every file as `value` of the one button that all pages share, and calls back later,
    in a thread. Of two files that arrive together, both callbacks would read the second one.

    Raises:
        UsageError: This version of viser keeps its callbacks elsewhere.
    """
    state: Any = getattr(button, "_impl", None)
    if not isinstance(getattr(state, "update_cb", None), list):
        raise UsageError(f"this version of viser mixes up uploads; run: {pip()} '{TESTED_VISER}'")
    state.update_cb = _CallbacksOfEachFile(button, receive)


class _CallbacksOfEachFile(list[Any]):
    """Callbacks of an upload button.

    viser walks through them at once when a file is complete: it is taken then.
    """

    def __init__(self, button: Any, receive: Callable[[str, bytes], None]) -> None:
        super().__init__()
        self._button = button
        self._receive = receive

    def __iter__(self) -> Iterator[Any]:
        uploaded = self._button.value
        yield functools.partial(self._call, uploaded.name, uploaded.content)

    def _call(self, name: str, content: bytes, _event: Any) -> None:
        self._receive(name, content)


def unpack(name: str, content: bytes, folder: Path) -> None:
    """Write an uploaded file, or what a .zip holds, into an empty folder.

    Raises:
        UsageError: It is a .zip that cannot be unpacked as a whole.
    """
    if name.lower().endswith(".zip"):
        _unpack_zip(content, folder)
        return
    last = re.split(r"[/\\:]", name)[-1].lstrip(".")
    (folder / (last or "file")).write_bytes(content)


def _unpack_zip(content: bytes, folder: Path) -> None:
    try:
        with zipfile.ZipFile(io.BytesIO(content)) as archive:
            members = [member for member in archive.infolist() if not member.is_dir()]
            if sum(member.file_size for member in members) > MAX_UNPACKED_BYTES:
                size = f"{MAX_UNPACKED_BYTES >> 30} GiB"
                raise UsageError(f"it unpacks to more than {size}; give it in parts")
            archive.extractall(folder)  # which drops .. and a leading / from names
    except OSError as error:
        if error.errno in DISK_ERRORS:
            raise
        raise _broken_zip(error.strerror or str(error)) from None
    except BROKEN_ZIP_ERRORS as error:
        raise _broken_zip(str(error)) from None
    unpacked = _files(folder)
    if not unpacked:
        raise UsageError("the .zip holds no file")
    if len(unpacked) < len(members):
        raise UsageError("the .zip holds two files of one name; pack it again. Nothing is stored")


def _broken_zip(reason: str) -> UsageError:
    return UsageError(
        f"the .zip is broken or has a password ({reason}); pack it again. Nothing of it is stored"
    )


def move_files(source: Path, target: Path) -> None:
    """Move the files below one folder to the same places below another: all, or none if one has no
    place.

    Raises:
        UsageError: A file exists, a file stands where a folder is needed, or a link leads out of
            the target.
        OSError: One could not be moved; those before it are moved back.
    """
    files = _files(source)
    for file in files:
        _require_free(file, target)
    moved: list[Path] = []
    new_folders = _missing_folders(files, target)
    try:
        for file in files:
            place = target / file
            place.parent.mkdir(parents=True, exist_ok=True)
            shutil.move(source / file, place)
            moved.append(file)
    except OSError:
        for file in moved:
            shutil.move(target / file, source / file)
        for folder in sorted(new_folders, reverse=True):
            if folder.exists():
                folder.rmdir()
        raise


def _files(folder: Path) -> list[Path]:
    """Return the files below a folder, relative to it, in the order of their names."""
    return sorted(path.relative_to(folder) for path in folder.rglob("*") if path.is_file())


def _require_free(file: Path, target: Path) -> None:
    """Refuse a relative path below `target` that exists, or where something stands in the way."""
    for parent in reversed(file.parents):
        place = target / parent
        if not place.resolve().is_relative_to(target.resolve()):
            raise UsageError(f"{place}: a link leads out of here; nothing is stored; move it away")
        if os.path.lexists(place) and not place.is_dir():
            raise UsageError(
                f"{place}: is a file where the upload has a folder; nothing is stored; move it away"
            )
    if os.path.lexists(target / file):
        raise UsageError(f"{target / file}: exists; nothing is stored; move it away")


def _missing_folders(files: list[Path], target: Path) -> set[Path]:
    """Return the folders below `target` that relative paths need and that do not exist."""
    missing = set[Path]()
    for file in files:
        missing.update(target / parent for parent in file.parents if not (target / parent).exists())
    return missing
