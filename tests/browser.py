"""A real browser without a window, told what to do over its debugging port."""

from __future__ import annotations

import base64
import contextlib
import io
import json
import shutil
import subprocess
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image
from websockets.sync.client import connect

NAMES = ("chromium", "chromium-browser", "google-chrome", "chrome")
PATIENCE = 90.0  # s, on a busy machine


@contextlib.contextmanager
def ticking(tick: Callable[[float], None]) -> Iterator[None]:
    """Call `tick` with 1/30 s, 30 times a second, in a thread that ends with the block."""
    ended = threading.Event()

    def run() -> None:
        while not ended.wait(1 / 30):
            tick(1 / 30)

    thread = threading.Thread(target=run)
    thread.start()
    try:
        yield
    finally:
        ended.set()
        thread.join()


class Browser:
    """One page. Use it in a with block: its process and its profile end there."""

    def __init__(self, width: int = 1000, height: int = 700) -> None:
        found = next((path for name in NAMES if (path := shutil.which(name))), None)
        assert found, f"none of {', '.join(NAMES)} is installed (Debian: apt-get install chromium)"
        self.folder = tempfile.TemporaryDirectory(prefix="browser", ignore_cleanup_errors=True)
        place = Path(self.folder.name)
        self.process = subprocess.Popen(
            [
                found,
                "--headless",
                "--no-sandbox",
                "--remote-debugging-port=0",
                f"--user-data-dir={place}",
                f"--window-size={width},{height}",
                "--use-angle=swiftshader",
                "--enable-unsafe-swiftshader",
                "about:blank",
            ],
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
        )
        port, path = wait(lambda: (place / "DevToolsActivePort").read_text().split()[:2])
        self.socket = connect(f"ws://127.0.0.1:{port}{path}", max_size=None, open_timeout=PATIENCE)
        self.events: list[dict[str, Any]] = []
        self.count = 0
        self.session = ""
        targets = self.ask("Target.getTargets")["targetInfos"]
        page = next(t["targetId"] for t in targets if t["type"] == "page")
        self.session = self.ask("Target.attachToTarget", targetId=page, flatten=True)["sessionId"]
        for domain in ("Page", "Runtime", "Network"):
            self.ask(f"{domain}.enable")

    def __enter__(self) -> Browser:
        return self

    def __exit__(self, *_: Any) -> None:
        self.socket.close()
        self.process.terminate()
        self.process.wait(PATIENCE)
        self.folder.cleanup()

    def ask(self, method: str, **parameters: Any) -> dict[str, Any]:
        """The answer to a command of the DevTools protocol; what happens meanwhile is kept in
        events.
        """
        self.count += 1
        message = {"id": self.count, "method": method, "params": parameters}
        self.socket.send(
            json.dumps(message | ({"sessionId": self.session} if self.session else {}))
        )
        while (answer := json.loads(self.socket.recv(PATIENCE))).get("id") != self.count:
            self.events.append(answer)
        assert "error" not in answer, answer
        return answer["result"]

    def value(self, script: str) -> Any:
        """What a JavaScript expression says in the page."""
        return self.ask("Runtime.evaluate", expression=script, returnByValue=True)["result"].get(
            "value"
        )

    def look(self, selector: str = "") -> np.ndarray:
        """What is seen of the page, or of one element: (height, width, 3) int."""
        options: dict[str, Any] = {}
        if selector:
            box = self.value(
                f"(({{x, y, width, height}}) => ({{x, y, width, height}}))"
                f"(document.querySelector({selector!r}).getBoundingClientRect())"
            )
            options["clip"] = box | {"scale": 1}
        data = self.ask("Page.captureScreenshot", format="png", **options)["data"]
        return np.asarray(Image.open(io.BytesIO(base64.b64decode(data))).convert("RGB")).astype(int)

    def complaints(self) -> list[str]:
        """Exceptions of the page's scripts."""
        return [
            json.dumps(e["params"])
            for e in self.events
            if e.get("method") == "Runtime.exceptionThrown"
        ]

    def requested(self) -> list[str]:
        """Everything that the page asked for, over whatever protocol."""
        sent = [
            e["params"]["request"]["url"]
            for e in self.events
            if e.get("method") == "Network.requestWillBeSent"
        ]
        return [url for url in sent if not url.startswith("data:")]


def wait(ask: Any) -> Any:
    """The first answer that is true; files that are not there yet and elements that are not are
    waited for.
    """
    end = time.monotonic() + PATIENCE
    while True:
        try:
            if found := ask():
                return found
        except (OSError, AssertionError, TypeError) as error:
            last: Any = error
        else:
            last = "nothing came"
        assert time.monotonic() < end, f"after {PATIENCE:g} s: {last}"
        time.sleep(0.2)
