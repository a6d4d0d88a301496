"""The journal of a dataset (sequences.jsonl): one line of JSON per sequence, only ever appended to.

A line that a crash cut short does not count. Opening parses the beginning of each line
(`EntryHeader`); the rest is parsed when it is first needed. 100,000 recordings therefore open in
about a second.
"""

from __future__ import annotations

import json
import os
import time
from collections.abc import Iterator
from dataclasses import asdict, dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Annotated

from annotated_types import Interval, Len

from gaponet.base.errors import DatasetError
from gaponet.base.files import flush_to_disk
from gaponet.base.structure import Name, parse_json
from gaponet.data.fingerprint import CommandFingerprint
from gaponet.data.sequence import ARRAYS, SequenceMeta

FILE = "sequences.jsonl"
HINT = "delete the line and import that log again"
FLUSH_INTERVAL_S = 1.0
# measured at import: delay_s, fast_speed → joint → value
Findings = dict[str, dict[str, float | None]]


@dataclass(frozen=True)
class EntryHeader:
    """The beginning of a journal line: what must be known of every sequence when a dataset is
    opened.
    """

    id: Name
    hash: Annotated[str, Len(8, 64)]
    dt: Annotated[float, Interval(ge=1e-4, le=1)]
    rows: Annotated[int, Interval(ge=1, le=10**8)]
    channels: tuple[str, ...]

    def __post_init__(self) -> None:
        if not {"ctrl", "qpos", "qvel"} <= set(self.channels) <= set(ARRAYS):
            raise DatasetError(
                f"channels: {self.channels!r:.80} lack ctrl, qpos or qvel, or hold an unknown one"
            )


@dataclass(frozen=True)
class _JournalLine(EntryHeader):
    meta: SequenceMeta
    findings: Findings
    command: CommandFingerprint | None = None  # journals before October 2026 have none


@dataclass(frozen=True)
class Entry(EntryHeader):
    """One sequence of a dataset, as the journal lists it."""

    line: bytes = field(compare=False, repr=False)  # JSON without line end
    where: str = field(default="", compare=False, repr=False)  # file and line number, for errors

    @classmethod
    def create(
        cls,
        header: EntryHeader,
        meta: SequenceMeta,
        findings: Findings,
        command: CommandFingerprint | None = None,
    ) -> Entry:
        """Return the entry of a new sequence; `command` is the fingerprint of its commands."""
        content = asdict(header) | {"meta": asdict(meta), "findings": findings, "command": command}
        return cls(
            **vars(header), line=json.dumps(content, ensure_ascii=False, allow_nan=False).encode()
        )

    @classmethod
    def parse(cls, line: bytes, where: str) -> Entry:
        """Return the entry of a journal line.

        Raises:
            DatasetError: The beginning of the line is damaged.
        """
        head, _, _ = line.partition(b', "meta": {')
        try:
            header = parse_json(EntryHeader, head + b"}", where, DatasetError)
            return cls(**vars(header), line=line, where=where)
        except DatasetError:  # damaged, or another program wrote the fields in another order
            whole = parse_json(_JournalLine, line, where, DatasetError, HINT)
            return cls(whole.id, whole.hash, whole.dt, whole.rows, whole.channels, line, where)

    @cached_property
    def _parsed(self) -> _JournalLine:
        return parse_json(_JournalLine, self.line, self.where or self.id, DatasetError, HINT)

    @property
    def meta(self) -> SequenceMeta:
        """Provenance and labels of the sequence."""
        return self._parsed.meta

    @property
    def findings(self) -> Findings:
        """Numbers that the import measured."""
        return self._parsed.findings

    @property
    def command(self) -> CommandFingerprint | None:
        """Fingerprint of the commands; None in an old journal."""
        return self._parsed.command


class Journal:
    """Reads and appends the lines of one journal file.

    The caller holds the dataset's lock while it appends.
    """

    def __init__(self, folder: Path) -> None:
        """Nothing is read yet; the journal may not exist."""
        self.path = folder / FILE
        self._size = 0  # bytes of complete lines that this object knows
        self._pending: list[Entry] = []
        self._next_flush = 0.0

    def read(self) -> Iterator[Entry]:
        """Yield every entry.

        Raises:
            DatasetError: A line is damaged, or a sequence is listed twice.
        """
        self._size = 0
        self._pending = []
        if not self.path.is_file():
            return
        content = self.path.read_bytes()
        self._size = content.rfind(b"\n") + 1
        id_of_hash: dict[str, str] = {}
        lines = content[: self._size].split(b"\n")[:-1]
        for number, line in enumerate(lines, 1):
            entry = Entry.parse(line, f"{self.path}:{number}")
            if entry.hash in id_of_hash:
                raise DatasetError(
                    f"{entry.where}: '{id_of_hash[entry.hash]}' is listed already; delete this line"
                )
            id_of_hash[entry.hash] = entry.id
            yield entry

    @property
    def changed(self) -> bool:
        """True if another process has written since the last read or append."""
        size = self.path.stat().st_size if self.path.is_file() else 0
        return size != self._size

    def append(self, entry: Entry, at_once: bool = True) -> None:
        """Add an entry whose file is complete; with at_once=False, it is written within
        FLUSH_INTERVAL_S.
        """
        self._pending.append(entry)
        if at_once or time.monotonic() > self._next_flush:
            self.flush()

    def flush(self) -> None:
        """Write pending entries; returns when they are on the disk."""
        if not self._pending:
            return
        lines = b"".join(entry.line + b"\n" for entry in self._pending)
        # the names of the listed files are on the disk first
        flush_to_disk(self.path.parent / "sequences")
        with self.path.open("ab") as file:
            file.truncate(self._size)  # removes a line that a crash or a full disk cut short
            file.write(lines)
            file.flush()
            os.fsync(file.fileno())
        if not self._size:
            flush_to_disk(self.path.parent)
        self._size += len(lines)
        self._pending = []
        self._next_flush = time.monotonic() + FLUSH_INTERVAL_S

    def roll_back(self) -> list[Entry]:
        """Forget pending entries, and lines that a failed flush wrote; return the entries."""
        pending = self._pending
        self._pending = []
        if pending and self.path.is_file():
            os.truncate(self.path, self._size)
            flush_to_disk(self.path)
        return pending
