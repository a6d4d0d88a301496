"""Consent of the person at the terminal, without which no real robot moves.

All commands ask through this module.
"""

from __future__ import annotations

import os
import sys

from gaponet.base.errors import UsageError
from gaponet.base.text import escape


def require_terminal(option: str = "--yes") -> int:
    """Return the descriptor of the terminal on which to ask.

    Args:
        option: Option that replaces the question; named in the error.

    Raises:
        UsageError: Standard input is no terminal.
    """
    if sys.stdin is None or not sys.stdin.isatty():
        raise UsageError(
            f"no terminal to ask on, so nothing was commanded; give {option} if the space around "
            "the robot is free"
        )
    return sys.stdin.fileno()


def require_consent(
    statement: str,
    question: str = "Is the space around it free, and a hand on its own emergency stop?",
    word: str = "yes",
    option: str = "--yes",
) -> None:
    """Return only if the word is typed on the terminal after the question is shown.

    Call it before the first command to the robot.

    Args:
        statement: What will happen, a sentence.
        question: What the person confirms.
        word: The only answer that consents, in lower case.
        option: Option that replaces the question; named where there is no terminal.

    Raises:
        UsageError: Anything else was typed, standard input ended, or it is no terminal.
    """
    descriptor = require_terminal(option)
    import termios  # not on Windows

    # An answer typed before the question was shown answers nothing.
    termios.tcflush(descriptor, termios.TCIFLUSH)
    sys.stderr.write(
        f"{escape(statement)} {question} Type '{word}' to start; anything else leaves: "
    )
    sys.stderr.flush()
    # Not sys.stdin, which may hold earlier bytes.
    line = os.read(descriptor, 1024).decode(errors="replace")
    if not line.endswith("\n"):  # end of file, also behind a word
        sys.stderr.write("\n")
    elif line.strip().lower() == word:
        return
    raise UsageError(f"the answer was {line.strip()!r}, not '{word}'; nothing was commanded")
