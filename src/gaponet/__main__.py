"""The console script and `python -m gaponet`: Ctrl-C ends it in one line during imports too."""

import os
import signal
import sys
from types import FrameType

from gaponet.base.child_process import exclude_current_folder


def _leave(number: int = signal.SIGINT, frame: FrameType | None = None) -> None:
    """End at once: nothing has begun, and an exception could be lost in an import."""
    os.write(sys.stderr.fileno(), b"interrupted\n")
    os._exit(128 + number)


def entry() -> None:
    try:
        signal.signal(signal.SIGINT, _leave)
        exclude_current_folder()
        from gaponet.cli.main import main

        code = main(begin=lambda: signal.signal(signal.SIGINT, signal.default_int_handler))
        # What is left is Python's own end, which a second Ctrl-C may cut short.
        signal.signal(signal.SIGINT, signal.SIG_DFL)
    except KeyboardInterrupt:  # while an error was being said
        _leave()
    sys.exit(code)


if __name__ == "__main__":
    entry()
