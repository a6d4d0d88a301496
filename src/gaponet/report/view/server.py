"""A viser server for one user of this machine.

Its address holds a secret; Host and Origin are checked. The page's Content-Security-Policy lets
only the scripts run that are in the page when it is sent. A script in a name or a result that
somebody else wrote does not run, and nothing is sent or loaded anywhere but to and from this
server.
"""

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
from gaponet.base.installation import pip

HOST = "127.0.0.1"  # private; forward the port for another machine
FRAME_S = 1 / 30
HOST_NAMES = (HOST, "localhost")
HEADERS = {
    "Referrer-Policy": "no-referrer",
    "X-Frame-Options": "DENY",
    "X-Content-Type-Options": "nosniff",
    "Cache-Control": "no-store",
}
TESTED_VISER = "viser>=1.1,<1.2"

# viser's page holds one script. It unpacks the application and puts it into the page as a second
# script, which needs the nonce too. Only the first script that is created gets it.
PASS_NONCE_ON = """
document.createElement = (name, ...options) => {
  const element = Document.prototype.createElement.call(document, name, ...options);
  if (name === "script") {
    element.nonce = "NONCE";
    delete document.createElement;
  }
  return element;
};
"""
# viser sorts Gaussian splats, which no page of ours shows, with functions made from text. The
# policy refuses that.
LEAVE_OUT_SPLATS = """
addEventListener("unhandledrejection", (event) => {
  if (event.reason instanceof EvalError) event.preventDefault();
});
"""


def open_server(label: str, port: int, script: str = "") -> tuple[Any, str]:
    """Start a viser server that only answers requests below /TOKEN/.

    viser has no hook for this. The check is put into the handshake of its websockets server, which
    serves the page too.

    Args:
        script: JavaScript of ours that the page runs before viser's.

    Returns:
        The server and its address, which holds the token.

    Raises:
        UsageError: This version of viser would serve without the check.
    """
    import viser

    transport: Any = import_module("websockets.asyncio.server")
    token = secrets.token_urlsafe(24)
    serve = transport.serve
    guarded = list[Any]()

    def guarded_serve(*args: Any, process_request: Any, **options: Any) -> Any:
        guarded.append(process_request)
        return serve(*args, process_request=_guard(token, process_request, script), **options)

    transport.serve = guarded_serve
    try:
        with contextlib.redirect_stdout(io.StringIO()):  # viser prints an address without the token
            server: Any = viser.ViserServer(HOST, port, label=label, verbose=False)
    finally:
        transport.serve = serve
    if not guarded:
        server.stop()
        raise UsageError(
            f"viser {viser.__version__} cannot be protected; run: {pip()} '{TESTED_VISER}'"
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


def content_policy(host: str, nonce: str) -> str:
    """Return the Content-Security-Policy of the page.

    viser's client compiles WebAssembly, starts a worker from a blob, which opens the WebSocket, and
    styles elements in place; pictures and files to save are data or blobs.

    Args:
        host: Name and port under which the page was requested. Not every browser counts ws: as
            'self'.
        nonce: Secret of this answer, which its scripts carry.
    """
    directives = (
        "default-src 'none'",
        f"script-src 'nonce-{nonce}' 'wasm-unsafe-eval'",
        "worker-src blob: data:",
        f"connect-src 'self' ws://{host} data: blob:",
        "img-src 'self' data: blob:",
        "font-src 'self' data:",
        "style-src 'unsafe-inline'",
        "base-uri 'none'",
        "form-action 'none'",
        "frame-ancestors 'none'",
    )
    return "; ".join(directives)


def with_nonce(page: str, script: str, nonce: str) -> str:
    """Return viser's page with the nonce at its script, and `script` before it.

    Raises:
        UsageError: This version of viser has another page.
    """
    before, head, after = page.partition("<head>")
    start, tag, rest = after.partition("<script")
    if not head or not tag:
        raise UsageError(
            f"this version of viser has a page that is not known; run: {pip()} '{TESTED_VISER}'"
        )
    code = PASS_NONCE_ON.replace("NONCE", nonce) + LEAVE_OUT_SPLATS + script
    own = f'<script nonce="{nonce}">{code}</script>'
    return f'{before}{head}{own}{start}{tag} nonce="{nonce}"{rest}'


def _guard(token: str, answer: Callable[[Any, Any], Any], script: str) -> Callable[[Any, Any], Any]:
    """Return a check of each request, which passes allowed ones on without the token."""

    def check(connection: Any, request: Any) -> Any:
        first, _, rest = request.path.lstrip("/").partition("?")[0].partition("/")
        known = secrets.compare_digest(first.encode(), token.encode())
        if not known or not _is_own(request.headers):
            return connection.respond(
                HTTPStatus.FORBIDDEN, "Open the address that gaponet printed.\n"
            )
        headers = request.headers.copy()
        headers.pop("Accept-Encoding", None)  # the answer is changed below
        response = answer(
            connection, dataclasses.replace(request, path=f"/{rest}", headers=headers)
        )
        if response is not None:
            _protect(response, request.headers["Host"], script)
        return response

    return check


def _is_own(headers: Any) -> bool:
    """Return True for a request to a name of this machine, and from no other site."""
    hosts = headers.get_all("Host")
    if len(hosts) != 1:
        return False
    name, _, port = hosts[0].rpartition(":")
    if name not in HOST_NAMES or not (port.isascii() and port.isdigit()):
        return False
    return all(origin == f"http://{hosts[0]}" for origin in headers.get_all("Origin"))


def _protect(response: Any, host: str, script: str) -> None:
    """Add the headers to an answer and, if it is the page, the nonce and `script`."""
    nonce = secrets.token_urlsafe(16)
    if response.headers.get("Content-Type", "").startswith("text/html"):
        response.body = with_nonce(response.body.decode(), script, nonce).encode()
        del response.headers["Content-Length"]
        response.headers["Content-Length"] = str(len(response.body))
    for name, value in HEADERS.items():
        response.headers[name] = value
    response.headers["Content-Security-Policy"] = content_policy(host, nonce)
