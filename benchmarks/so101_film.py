"""Film a real SO-101 beside its nominal and its identified simulator (docs/index.md, README.md).

    gaponet import DATA/sage_so101 --robot so101 --unit-id so101 --payload-mass 0 --out DATASET
    gaponet identify DATASET --out ROBOT
    MUJOCO_GL=egl python benchmarks/so101_film.py DATASET ROBOT docs/assets/so101.webp

The motion is one of the test motions of `gaponet identify`, which fits nothing to it. A PNG beside
the film shows the moment of the largest nominal error.
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from gaponet.data.store import Dataset
from gaponet.evaluation.methods import colour
from gaponet.report.figures.style import DASHED, figure, styled
from gaponet.report.view.picture import Camera
from gaponet.report.view.scene import Scene, View
from gaponet.report.view.side_by_side import (
    Clip,
    SideBySide,
    largest_error_time,
    select_entry,
    side_by_side,
)
from gaponet.robot.spec import load_robot

if TYPE_CHECKING:
    from matplotlib.figure import Figure
    from PIL.Image import Image

MOTION = "dual_joint_elbow_wrist"
JOINT = "elbow_flex"
SHOWN = ("nominal", "identified", "recorded")
LABELS = {
    "nominal": "nominal simulator",
    "identified": "identified simulator",
    "recorded": "recorded robot",
}
LINES = {"nominal": (DASHED, 1.6), "identified": ("-", 1.4), "recorded": ("-", 2.4)}  # style, width
DURATION_S = 8.0
MAGNIFY = 3.0  # 20 mrad are one pixel here; the film states the factor
WIDTH = 840  # pixels
CURVES_HEIGHT = 250  # pixels
DPI = 120
FPS = 12.0
QUALITY = 72  # of WebP
GROUND = "#ebebeb"  # the ground of the scene
MARK = "#d99000"


class Curves:
    """Positions of one joint over time; a line marks the moment of the film."""

    def __init__(self, shown: SideBySide, clip: Clip) -> None:
        """Draw the curves once; only the line differs between frames."""
        from matplotlib.backends.backend_agg import FigureCanvasAgg
        from PIL.Image import fromarray

        drawing = draw_curves(shown, clip)
        canvas = FigureCanvasAgg(drawing)
        canvas.draw()
        self.image = fromarray(np.asarray(canvas.buffer_rgba())[..., :3].copy())
        self.axes = drawing.axes[0].get_window_extent()
        self.clip = clip

    def at(self, time: float) -> Image:
        """Return the picture with the line at a time of the recording, s."""
        from PIL.ImageDraw import Draw

        share = (time - self.clip.start) / self.clip.duration
        x = self.axes.x0 + share * (self.axes.x1 - self.axes.x0)
        top = self.image.height - self.axes.y1
        bottom = self.image.height - self.axes.y0
        image = self.image.copy()
        Draw(image).line([(x, top), (x, bottom)], fill=MARK, width=2)
        return image


@styled
def draw_curves(shown: SideBySide, clip: Clip) -> Figure:
    """Draw the joint's recorded and simulated positions over the time of the clip."""
    fig = figure(WIDTH / DPI, CURVES_HEIGHT / DPI)
    ax = fig.subplots()
    joint = shown.real.joint_names.index(JOINT)
    rows = rows_of(shown, clip)
    time = np.arange(len(shown.real))[rows] * shown.real.dt - clip.start
    for copy in reversed(shown.motions):
        style, width = LINES[copy.method]
        degrees = np.degrees(copy.qpos[rows, joint])
        ax.plot(
            time, degrees, color=colour(copy.method), ls=style, lw=width, label=LABELS[copy.method]
        )
    ax.set_xlim(0, clip.duration)
    ax.set_xlabel("time, s")
    ax.set_ylabel("elbow, degrees")
    ax.set_facecolor(GROUND)
    fig.legend(loc="outside upper center", ncols=3)
    fig.set_facecolor(GROUND)
    fig.set_dpi(DPI)
    return fig


def rows_of(shown: SideBySide, clip: Clip) -> slice:
    """Return the rows of the recording that a clip shows."""
    first = round(clip.start / shown.real.dt)
    last = round(clip.stop / shown.real.dt)
    return slice(first, last + 1)


def stacked(upper: Image, lower: Image) -> Image:
    """Return one picture above another of the same width."""
    from PIL.Image import new

    image = new("RGB", (upper.width, upper.height + lower.height))
    image.paste(upper, (0, 0))
    image.paste(lower, (0, upper.height))
    return image


def main() -> None:
    """Write the film and the picture."""
    dataset = Dataset(sys.argv[1])
    robot = load_robot(sys.argv[2])
    film = Path(sys.argv[3])
    entry = select_entry(dataset, [robot.folder], MOTION)
    shown = side_by_side(dataset, entry, robot).only(SHOWN)
    for copy in shown.motions:
        print(f"{MOTION}, {copy.method}: {1e3 * copy.mpjae:.2f} mrad")
    clip = Clip.from_start(shown, None, DURATION_S, fps=FPS)
    scene = Scene(shown.magnified(MAGNIFY), View(), rows_of(shown, clip), flat=True)
    curves = Curves(shown, clip)
    times = clip.times(1 / FPS)
    worst = largest_error_time(shown, clip)
    with Camera(scene, clip, WIDTH, MAGNIFY) as camera:
        frames = [stacked(camera.picture(time), curves.at(time)) for time in times]
        still = stacked(camera.picture(worst), curves.at(worst))
    still.save(film.with_suffix(".png"), optimize=True)
    frames[0].save(
        film,
        save_all=True,
        append_images=frames[1:],
        duration=round(1000 / FPS),
        loop=0,
        quality=QUALITY,
        method=4,
    )
    print(f"{film}: {len(frames)} pictures, {film.stat().st_size / 1e6:.2f} MB")


if __name__ == "__main__":
    main()
