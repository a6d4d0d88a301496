"""Who may talk to the page."""

import http.client
import io
import urllib.parse

import pytest

pytest.importorskip("viser")


@pytest.fixture(scope="module")
def address():
    from gaponet.report.view.server import open_server

    server, address = open_server("test", 0)
    yield urllib.parse.urlsplit(address)
    server.stop()


def answer(address, path=None, **headers):
    connection = http.client.HTTPConnection("127.0.0.1", address.port, timeout=10)
    connection.request("GET", address.path if path is None else path, headers=headers)
    response = connection.getresponse()
    text = response.read()
    connection.close()
    return response, text


def socket_opens(address, path, origin):
    from viser import __version__
    from websockets.exceptions import InvalidStatus
    from websockets.sync.client import connect

    uri = f"ws://127.0.0.1:{address.port}{path}"
    try:
        with connect(
            uri, origin=origin, subprotocols=[f"viser-v{__version__}"], max_size=None
        ) as socket:
            return bool(socket.recv(10))
    except InvalidStatus as refused:
        return refused.response.status_code != 403


def test_only_the_address_with_the_token_shows_the_page(address):
    response, text = answer(address)
    assert response.status == 200
    assert b"<html" in text
    assert response.headers["Referrer-Policy"] == "no-referrer"
    assert response.headers["X-Frame-Options"] == "DENY"
    assert answer(address, "/")[0].status == 403
    assert answer(address, "/" + "x" * 32 + "/")[0].status == 403
    assert answer(address, address.path + "../../../../etc/passwd")[0].status == 404


def test_only_scripts_of_the_page_itself_run_and_they_reach_only_its_server(address):
    response, text = answer(address)
    policy = dict(
        directive.split(" ", 1)
        for directive in response.headers["Content-Security-Policy"].split("; ")
    )
    nonce = policy["script-src"].split("'")[1].removeprefix("nonce-")
    assert policy["script-src"] == f"'nonce-{nonce}' 'wasm-unsafe-eval'"
    assert policy["connect-src"] == f"'self' ws://127.0.0.1:{address.port} data: blob:"
    assert policy["default-src"] == "'none'"
    assert text.count(b"<script nonce=") == 2
    assert text.count(b"<script") == text.count(b"<script nonce=")
    assert answer(address)[0].headers["Content-Security-Policy"].count(nonce) == 0


def test_a_page_of_viser_without_a_script_is_refused():
    from gaponet.base.errors import UsageError
    from gaponet.report.view.server import with_nonce

    with pytest.raises(UsageError, match="known"):
        with_nonce("<html><head></head></html>", "", "x")


def test_a_page_of_another_name_or_of_another_site_is_refused(address):
    assert answer(address, Host=f"localhost:{address.port}")[0].status == 200
    assert answer(address, Host="evil.example:80")[0].status == 403
    assert answer(address, Origin="https://evil.example")[0].status == 403
    assert answer(address, Origin="null")[0].status == 403


def test_another_site_cannot_post(address):
    connection = http.client.HTTPConnection("127.0.0.1", address.port, timeout=10)
    try:
        connection.request("POST", address.path, body=io.BytesIO(b"x"))
        assert connection.getresponse().status >= 400
    except (http.client.RemoteDisconnected, ConnectionError):
        pass
    finally:
        connection.close()


def test_the_websocket_needs_the_token_and_the_pages_own_origin(address):
    own = f"http://127.0.0.1:{address.port}"
    assert socket_opens(address, address.path, own)
    # What the page derives from its address.
    assert socket_opens(address, address.path.rstrip("/"), own)
    assert not socket_opens(address, "/", own)
    assert not socket_opens(address, address.path, "https://evil.example")


def test_a_viser_that_would_not_be_protected_is_refused(monkeypatch):
    import viser

    from gaponet.base.errors import UsageError
    from gaponet.report.view.server import open_server

    class Unprotected:
        def __init__(self, *_, **__):
            self.stopped = False

        def stop(self):
            stopped.append(True)

    stopped = []
    monkeypatch.setattr(viser, "ViserServer", Unprotected)
    with pytest.raises(UsageError, match="protected"):
        open_server("test", 0)
    assert stopped
