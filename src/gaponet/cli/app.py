"""gaponet app."""

from __future__ import annotations

import signal
import sys
from importlib.util import find_spec
from pathlib import Path

import tyro

from gaponet.base.errors import UsageError
from gaponet.base.files import lock_folder
from gaponet.cli.out import Out


def app(folder: tyro.conf.Positional[Path] = Path("gaponet_app"), port: int = 8080) -> None:
    """All steps in a browser: from logs to an identified simulator.

    The page is served to this machine only. Its address holds a secret. Ctrl-C ends it.
    The same command opens it again.

    Args:
        folder: Folder for logs, models and results.
        port: Port of the page, on this machine; the next free one is taken.
    """
    if find_spec("viser") is None:
        raise UsageError("gaponet app needs viser; run: pip install 'gaponet[view,report]'")
    from gaponet.report.view.app import App
    from gaponet.report.view.server import run_until_interrupt

    signal.signal(signal.SIGTERM, lambda *_: sys.exit(143))  # otherwise the running command would stay
    with lock_folder(folder, "app"):
        page = App(folder.resolve(), port)
        Out().say(f"open {page.address} in a browser; Ctrl-C ends")
        try:
            run_until_interrupt(page.server, page.tick)
        finally:
            page.jobs.cancel()
