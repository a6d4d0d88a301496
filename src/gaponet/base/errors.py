"""Errors that a user can correct: the message says what is wrong, where, and what to do.

Every error raised on bad input derives from `GAPONetError`; the command line prints it in one line
and exits with 2, or with 3 if a robot has run.
"""

from gaponet.base.text import remove_credentials

# Of a message; the middle of a longer one is omitted, as its ends say where and what to do.
MAX_CHARACTERS = 1000


class GAPONetError(Exception):
    """Base class of errors that input causes.

    The message is one line of printable characters without credentials.
    """

    def __init__(self, text: str) -> None:
        text = remove_credentials(text)
        if len(text) > MAX_CHARACTERS:
            text = f"{text[: MAX_CHARACTERS // 2]} … {text[-MAX_CHARACTERS // 2 :]}"
        super().__init__("".join(c if c.isprintable() else ascii(c)[1:-1] for c in text))


class RobotError(GAPONetError):
    """A robot folder is missing, incomplete or contradicts its MJCF."""


class JointMismatchError(GAPONetError):
    """Joint names of a log, dataset or model do not match the robot's."""


class LogError(GAPONetError):
    """A log file cannot be read: the message names the file and line."""


class DatasetError(GAPONetError):
    """A dataset folder is missing, damaged or belongs to another robot."""


class FolderError(GAPONetError):
    """An output folder is somebody else's, or another process is writing into it."""


class ModelError(GAPONetError):
    """A run or model artifact is missing, damaged or does not fit the robot, rate or gains."""


class NoGainError(GAPONetError):
    """No fitted candidate follows the recordings better than the robot that is given."""


class UnsavedError(GAPONetError):
    """A robot ran, and its recording could not be saved; the command line exits with 3."""


class WorkerError(GAPONetError):
    """Every worker process of a job died."""


class UsageError(GAPONetError):
    """Options contradict each other or are out of range."""
