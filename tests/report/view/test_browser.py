"""What a browser shows: gaponet view, and the report on a desk and on a phone. make browser."""

import time

import numpy as np
import pytest
from arm import recordings

from gaponet.data.store import Dataset
from gaponet.evaluation.methods import colour

pytestmark = pytest.mark.browser
OFF = 60  # |difference| of one channel, of 255, by which a pixel is another


@pytest.fixture
def web(arm):
    """Two copies of a moving arm, served and played as gaponet view does."""
    from gaponet.report.view.player import Player
    from gaponet.report.view.scene import Scene
    from gaponet.report.view.server import open_server
    from gaponet.report.view.side_by_side import Clip, Copy, SideBySide

    real = recordings(arm, 1, rows=200, kp=0.5)[0]
    swing = 0.8 * np.sin(np.arange(len(real)) / 20)[:, None] * np.ones(2)
    off = {"nominal": 0.4, "gaponet": 0.1}
    shown = SideBySide(
        real, arm, tuple(Copy(m, swing + o, np.full(len(real), o)) for m, o in off.items()), None
    )
    server, address = open_server("test", 0)
    served = Player(server, Scene(shown), Clip.from_start(shown, 0.0, 3.0))
    served.address = address
    served.playing.value = False
    from browser import ticking

    with ticking(served.advance):
        yield served
    server.stop()


def reddish(picture):
    """Pixels of the copy of GAPONet, in light and in shade."""
    r, g, b = np.moveaxis(picture, -1, 0)
    return int(((r > 70) & (r > 2.2 * g) & (r > 2.2 * b)).sum())


def moved(a, b):
    return int((np.abs(a - b).max(axis=2) > OFF).sum())


def test_the_canvas_shows_the_robot_and_it_moves_when_played_and_stands_when_not(web):
    from browser import Browser, wait

    assert colour("gaponet") == "#c8102e"
    with Browser() as page:
        page.ask("Page.navigate", url=web.address)
        wait(lambda: page.value("!!document.querySelector('canvas')"))
        wait(lambda: reddish(page.look("canvas")) > 500)
        wait(lambda: moved(page.look("canvas"), page.look("canvas")) == 0)  # all is loaded
        still = page.look("canvas")
        colours = np.unique(still.reshape(-1, 3), axis=0)
        assert len(colours) > 200
        time.sleep(1.0)
        assert moved(still, page.look("canvas")) == 0
        web.playing.value = True
        assert wait(lambda: (n := moved(still, page.look("canvas"))) > 300 and n)
        web.playing.value = False
        # And the eye is no blind one: without robots it sees none.
        for frame in web.bodies.frames.values():
            frame.visible = False
        # What is left is an axis of the compass.
        wait(lambda: reddish(page.look("canvas")) < 0.1 * reddish(still))
        assert page.complaints() == []
        print(
            f"canvas: {len(colours)} colours, {reddish(still)} reddish pixels of "
            f"{still.shape[0] * still.shape[1]}"
        )


@pytest.mark.parametrize("width", [390, 1200])
@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_the_report_loads_nothing_else_and_fits_desk_and_phone(evaluated, width, scheme):
    from browser import Browser, wait

    from gaponet.report.report import write_report
    from gaponet.report.view.picture import portrait

    path = write_report(evaluated, picture=portrait)
    with Browser(max(width, 500), 900) as page:
        page.ask(
            "Emulation.setDeviceMetricsOverride",
            width=width,
            height=900,
            deviceScaleFactor=1,
            mobile=width < 500,
        )
        page.ask(
            "Emulation.setEmulatedMedia",
            features=[{"name": "prefers-color-scheme", "value": scheme}],
        )
        page.ask("Page.navigate", url=path.as_uri())
        wait(
            lambda: (
                page.value("document.readyState") == "complete"
                and page.value("!!document.querySelector('h2')")
            )
        )
        assert page.value("document.documentElement.scrollWidth") <= width
        assert page.value("[...document.images].every(i => i.naturalWidth > 100)")
        assert page.value("document.images.length") >= 1
        picture = page.look()
        assert (picture.mean() > 200) == (scheme == "light")
        words = page.value(
            "[...document.querySelectorAll('.plot text')].every(t => "
            "t.getBoundingClientRect().height > 5)"
        )
        assert words
        assert page.requested() == [path.as_uri()]
        assert page.complaints() == []


@pytest.fixture
def evaluated(arm, tmp_path):
    """A run folder that has been evaluated; its data are a Dataset of a virtual arm."""
    from reports import evaluated_run

    return evaluated_run(arm, Dataset.create(tmp_path / "data", arm), tmp_path / "run")
