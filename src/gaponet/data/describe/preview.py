"""Logs that nobody described yet: read as they lie there, or by a logs.toml that is guessed from
them.
"""

from __future__ import annotations

import re
import tempfile
from dataclasses import replace
from pathlib import Path

from gaponet.base.errors import GAPONetError, LogError, UsageError
from gaponet.base.files import write_text
from gaponet.data.describe.guess import guess_logs
from gaponet.data.formats import ReadOptions, find_logs, look, read_logs
from gaponet.data.log import Log, skip_bad_rows
from gaponet.robot.spec import RobotSpec

# lines of a logs.toml by which joints are told apart
NAMED = re.compile(r"^(\[names\]|joints = )", re.MULTILINE)


class DescriptionNeededError(LogError):
    """A person has to look at a logs.toml (text): logs cannot be read by it, or it guesses which
    joint is which.
    """

    def __init__(self, why: str, text: str) -> None:
        super().__init__(why)
        self.text = text


def read_first_recording(
    logs: Path,
    robot: RobotSpec,
    options: ReadOptions,
    anyhow: bool = False,
    skip_bad: bool = False,
) -> tuple[Log, int, str]:
    """The first recording, how many there are, and the logs.toml that was guessed; "" where none
    was needed.

    Args:
        logs: File or folder.
        options: With a logs.toml, nothing is guessed beside it.
        anyhow: Also by a guess of which joint is which.
        skip_bad: Leave out recordings that cannot be read.

    Raises:
        DescriptionNeededError, LogError, UsageError: The message says what is missing.
    """

    def read(options: ReadOptions, described: str = "") -> tuple[Log, int, str]:
        with skip_bad_rows(skip_bad):
            first = next(iter(read_logs(logs, robot, options)), None)
        if first is None:
            raise UsageError(f"{logs}: holds no recording")
        return first[1], len(find_logs(logs, options.format)), described

    try:
        return read(options)
    except GAPONetError as error:
        if options.logs is not None:
            raise
        try:
            kind, known, recordings = look(logs, options)
        except GAPONetError:
            raise error from None
    text = guess_logs(recordings, robot, kind, dict(known))
    with tempfile.TemporaryDirectory() as place:
        file = Path(place) / "logs.toml"
        write_text(file, text)
        try:
            matches = read(replace(options, logs=file), text)
        except GAPONetError as again:
            raise DescriptionNeededError(str(again), text) from None
    if NAMED.search(text) and not anyhow:
        raise DescriptionNeededError("which joint is which is a guess", text)
    return matches
