"""gaponet app."""

from __future__ import annotations

from pathlib import Path

import tyro

from gaponet.api.pages import serve_app
from gaponet.cli.out import Out


def app(
    folder: tyro.conf.Positional[Path] = Path("gaponet_app"),
    port: int = 8080,
    outside: tuple[Path, ...] = (),
) -> None:
    """All steps in a browser: from logs to an identified simulator.

    The page is served to this machine only. Its address holds a secret. Ctrl-C ends it.
    The same command opens it again.

    Args:
        folder: Folder for logs, models and results.
        port: Port of the page, on this machine; the next free one is taken.
        outside: Other folders that the results in `folder` may use, as gaponet view prints them.
    """
    serve_app(folder, port=port, outside=outside, say=Out().say)
