"""A viser server for one user of this machine: the address holds a secret; Host and Origin are checked."""

from __future__ import annotations

import contextlib
import dataclasses
import io
import secrets
import time
from collections.abc import Callable
from http import HTTPStatus
from importlib import import_module
from typing import Any

from gaponet.base.errors import UsageError

HOST = "127.0.0.1"  # private; forward the port for another machine
FRAME_S = 1 / 30
HOST_NAMES = (HOST, "localhost")
HEADERS = {"Referrer-Policy": "no-referrer", "X-Frame-Options": "DENY", "Cache-Control": "no-store"}


def open_server(label: str, port: int) -> tuple[Any, str]:
    """Start a viser server that only answers requests below /TOKEN/.

    viser has no hook for this. The check is put into the handshake of its websockets server, which serves the page too.

    Returns:
        The server and its address, which holds the token.

    Raises:
        UsageError: This version of viser would serve without the check.
    """
    import viser

    transport: Any = import_module("websockets.asyncio.server")
    token, serve, guarded = secrets.token_urlsafe(24), transport.serve, list[Any]()

    def guarded_serve(*args: Any, process_request: Any, **options: Any) -> Any:
        guarded.append(process_request)
        return serve(*args, process_request=_guard(token, process_request), **options)

    transport.serve = guarded_serve
    try:
        with contextlib.redirect_stdout(io.StringIO()):  # viser prints an address without the token
            server = viser.ViserServer(HOST, port, label=label, verbose=False)
    finally:
        transport.serve = serve
    if not guarded:
        server.stop()
        raise UsageError(
            f"viser {viser.__version__} cannot be protected; run: pip install 'viser>=1.1,<1.2'"
        )
    server.request_share_url = lambda *_, **__: None  # would publish the page on the internet
    server.gui.configure_theme(show_logo=False, show_share_button=False)
    server.gui.main_panel.dock_right()  # beside the robots, not in front of them
    return server, f"http://{HOST}:{server.get_port()}/{token}/"


def run_until_interrupt(server: Any, tick: Callable[[float], None]) -> None:
    """Call `tick` with the elapsed wall time, s, until Ctrl-C."""
    before = time.monotonic()
    try:
        while True:
            time.sleep(FRAME_S)
            now = time.monotonic()
            tick(now - before)
            before = now
    except KeyboardInterrupt:
        server.stop()


def _guard(token: str, answer: Callable[[Any, Any], Any]) -> Callable[[Any, Any], Any]:
    """Return a check of each request, which passes allowed ones on without the token."""

    def check(connection: Any, request: Any) -> Any:
        hosts, origins = request.headers.get_all("Host"), request.headers.get_all("Origin")
        own = len(hosts) == 1 and hosts[0].rpartition(":")[0] in HOST_NAMES
        own = own and all(origin == f"http://{hosts[0]}" for origin in origins)
        first, _, rest = request.path.lstrip("/").partition("?")[0].partition("/")
        if not own or not secrets.compare_digest(first.encode(), token.encode()):
            return connection.respond(
                HTTPStatus.FORBIDDEN, "Open the address that gaponet printed.\n"
            )
        response = answer(connection, dataclasses.replace(request, path=f"/{rest}"))
        if response is not None:
            for name, value in HEADERS.items():
                response.headers[name] = value
        return response

    return check
