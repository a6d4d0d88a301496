"""Errors that a user can correct: the message says what is wrong, where, and what to do.

Every error raised on bad input derives from `GAPONetError`; the command line prints it in one line
and exits with 2.
"""

from gaponet.base.text import remove_credentials

# of a message; the middle of a longer one is omitted, as its ends say where and what to do
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


class WorkerError(GAPONetError):
    """Every worker process of a job died."""


class UsageError(GAPONetError):
    """Options contradict each other or are out of range."""


# Modules of optional dependencies → the extra that brings them.
EXTRAS = {
    "torch": "train",
    "onnx": "train",
    "onnxruntime": "deploy",
    "matplotlib": "report",
    "jinja2": "report",
    "markupsafe": "report",
    "cyclonedds": "dds",
    "serial": "so101",
    "gymnasium": "gym",
    "PIL": "view",
    "imageio_ffmpeg": "view",
    "viser": "view",
    "trimesh": "view",
    "rosbags": "ros",
    "h5py": "hdf5",
    "huggingface_hub": "hub",
    "fsspec": "hub",
    "s3fs": "s3",
    "gcsfs": "gs",
    "tensorboard": "tensorboard",
    "wandb": "wandb",
    "zmq": "zmq",
    "warp": "warp",
    "mujoco_warp": "warp",
    "ray": "ray",
}


def missing_extra(error: ModuleNotFoundError) -> str | None:
    """Return the install command for a missing optional dependency; None for any other module."""
    module = (error.name or "").split(".")[0]
    if module not in EXTRAS:
        return None
    return f"{module} is not installed; run: pip install 'gaponet[{EXTRAS[module]}]'"
