"""Pictures and films of a scene, and of models in a row: MuJoCo renders, Pillow labels,
imageio-ffmpeg writes MP4.
"""

from __future__ import annotations

import io
import warnings
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import mujoco
import numpy as np

from gaponet.base.arrays import Array
from gaponet.base.errors import UsageError
from gaponet.base.files import atomic_write
from gaponet.base.installation import install_command
from gaponet.data.sequence import Sequence, SequenceMeta
from gaponet.evaluation.methods import colour, title
from gaponet.report.view.gl import INSTALL_HINT
from gaponet.report.view.scene import Scene
from gaponet.report.view.side_by_side import Clip, Copy, SideBySide, largest_error_time
from gaponet.robot.spec import RobotSpec

if TYPE_CHECKING:
    from PIL.Image import Image
    from PIL.ImageDraw import ImageDraw

INK = "#222222"
FAINT = "#777777"
ALARM = "#c8102e"
SEPARATOR = "  ·  "  # Pillow's own font has this, but no ×
MAX_HEIGHT = 0.7  # of the width
SIDE = 480  # of one model's square, pixels
HEAD = 30  # of its label, pixels
GIF_COLOURS = 200  # shared by all frames
SUFFIXES = (".gif", ".mp4", ".png")
FLOOR = mujoco.mjtGeom.mjGEOM_PLANE


class Camera:
    """Renders the frames of a scene. Close it, or use it in a with block."""

    def __init__(self, scene: Scene, clip: Clip, width: int = 960, magnify: float = 1.0) -> None:
        """Open a GL context.

        Args:
            clip: Its speed is printed on the picture.
            width: Width of the picture, pixels, even; the height follows from the robots.
            magnify: Printed on the picture.

        Raises:
            UsageError: The width is out of range, or nothing can be rendered here.
        """
        if not 160 <= width <= 3840:
            raise UsageError(f"--width is {width}; give 160 to 3840 pixels")
        self.scene = scene
        self.clip = clip
        self.magnify = magnify
        self.width = width - width % 2
        letters = max(width / 960, 0.5)
        tall = scene.box.height
        self.head = round(34 * letters)  # pixels
        labels = round(60 * letters)  # pixels
        room = MAX_HEIGHT * self.width - self.head - labels  # pixels
        # Pixels per metre.
        self.scale = min(self.width / (scene.spacing * len(scene.base)), room / tall)
        self.robots = round(1.1 * tall * self.scale)
        self.robots += (self.head + self.robots + labels) % 2  # h264 wants even sizes
        self.height = self.head + self.robots + labels
        self.lens = self._lens()
        self.renderer = renderer(scene.model, self.robots, self.width)
        self.fonts = {size: font(size * letters) for size in (13, 15, 17)}

    def __enter__(self) -> Camera:
        return self

    def __exit__(self, *_: object) -> None:
        self.renderer.close()

    def picture(self, time: float) -> Image:
        """Return the labelled frame at a time of the recording, s: a PIL image."""
        from PIL.Image import fromarray, new
        from PIL.ImageDraw import Draw

        self.scene.pose(time)
        self.renderer.update_scene(self.scene.data, self.lens)
        rendered = fromarray(self.renderer.render())
        image = new("RGB", (self.width, self.height), rendered.getpixel((0, 0)))
        image.paste(rendered, (0, self.head))
        self._write(Draw(image), time)
        return image

    def _lens(self) -> mujoco.MjvCamera:
        """Return an orthographic camera, which shows every copy from the same side."""
        scene = self.scene
        lens = mujoco.MjvCamera()
        lens.orthographic = 1
        scene.model.vis.global_.orthographic = 1  # MuJoCo 3 reads the model only
        lens.azimuth = scene.view.azimuth
        lens.elevation = scene.view.elevation
        lens.lookat[:] = scene.middle
        lens.distance = 4 * scene.extent
        scene.model.vis.global_.fovy = self.robots / self.scale  # m, of an orthographic picture
        scene.model.vis.map.znear = 0.01
        scene.model.vis.map.zfar = 20
        return lens

    def _write(self, draw: ImageDraw, time: float) -> None:
        """Write the heading, and name and errors below each robot."""
        row = self.scene.row(time)
        small = self.fonts[13]
        large = self.fonts[17]
        self._head(draw, time)
        top = self.head + self.robots
        pitch = self.scene.spacing * self.scale
        k = len(self.scene.base)
        for i, copy in enumerate(self.scene.shown.motions):
            x = self.width / 2 + (i - (k - 1) / 2) * pitch
            tint = colour(copy.method)
            draw.text((x, top), title(copy.method), tint, large, anchor="ma")
            if copy.method != "recorded":
                text = f"{copy.error[row] * 1e3:.1f} mrad now, {copy.mpjae * 1e3:.1f} mean"
                draw.text((x, top + 1.5 * large.size), text, FAINT, small, anchor="ma")

    def _head(self, draw: ImageDraw, time: float) -> None:
        """Write VIRTUAL where it applies, the recording on the left, and the time on the right."""
        shown = self.scene.shown
        pad = self.head // 3
        font = self.fonts[15]
        meta = shown.real.meta
        facts = [
            meta.robot,
            meta.motion,
            f"unit {meta.unit_id}",
            _payload(meta.payload_mass, meta.payload_side),
        ]
        if shown.seen is not None:
            facts.append("seen in training" if shown.seen else "new motion")
        clock = []
        if self.clip.speed != 1:
            clock.append(f"speed {self.clip.speed:g}x")
        if self.magnify != 1:
            clock.append(f"differences drawn {self.magnify:g}x")
        clock.append(f"{time:6.2f} s")
        left = SEPARATOR.join(facts)
        right = SEPARATOR.join(clock)
        mark = "VIRTUAL ROBOT   " if meta.virtual else ""
        while font.getlength(mark + left + right) > self.width - 4 * pad and font.size > 8:
            font = font.font_variant(size=font.size - 0.5)
        draw.text((pad, pad * 0.8), mark, ALARM, font)
        draw.text((pad + font.getlength(mark), pad * 0.8), left, INK, font)
        draw.text((self.width - pad, pad * 0.8), right, INK, font, anchor="ra")


def _payload(mass: float, side: str) -> str:
    if mass == 0:
        return "empty-handed"
    return f"{mass:g} kg in each hand" if side == "both" else f"{mass:g} kg in {side} hand"


def font(size: float) -> Any:
    """Return Pillow's own font in a size in pixels."""
    from PIL import ImageFont

    return ImageFont.load_default(max(size, 9))


def renderer(model: mujoco.MjModel, height: int, width: int) -> mujoco.Renderer:
    """Return MuJoCo's off-screen renderer.

    Raises:
        UsageError: Nothing can be rendered here; the message says what to install.
    """
    try:
        with warnings.catch_warnings():  # GLFW warns of a missing display before it fails
            warnings.simplefilter("ignore")
            return mujoco.Renderer(model, height, width)
    except Exception as error:  # GL libraries raise exceptions of any type
        raise UsageError(
            f"cannot render off screen ({type(error).__name__}: {error}). {INSTALL_HINT}"
        ) from None


def still(models: list[tuple[str, mujoco.MjModel, Array]]) -> bytes:
    """Return a PNG of models (label, model, qpos) in a row, all with the camera that fits the
    first.

    Raises:
        UsageError: Nothing can be rendered here; the message says what to install.
    """
    from PIL.Image import fromarray, new
    from PIL.ImageDraw import Draw

    image = new("RGB", (SIDE * len(models), SIDE + HEAD), "white")
    draw = Draw(image)
    camera = mujoco.MjvCamera()
    mujoco.mjv_defaultFreeCamera(models[0][1], camera)
    camera.azimuth = 140
    camera.elevation = -15
    for i, (label, model, qpos) in enumerate(models):
        data = mujoco.MjData(model)
        data.qpos[:] = qpos
        mujoco.mj_forward(model, data)
        model.geom_rgba[model.geom_type == FLOOR, 3] = 0
        model.vis.map.znear = 0.01 / model.stat.extent
        model.vis.headlight.ambient[:] = 0.5
        picture = renderer(model, SIDE, SIDE)
        picture.scene.flags[mujoco.mjtRndFlag.mjRND_SKYBOX] = 0
        picture.update_scene(data, camera)
        image.paste(fromarray(_white(picture)), (SIDE * i, HEAD))
        picture.close()
        draw.text((SIDE * (i + 0.5), HEAD / 2), label, INK, font(17), anchor="mm")
    file = io.BytesIO()
    image.save(file, "PNG", optimize=True)
    return file.getvalue()


def _white(picture: mujoco.Renderer) -> Array:
    """Return the picture with a white background."""
    pixels = picture.render().copy()
    picture.enable_segmentation_rendering()
    pixels[picture.render()[:, :, 0] < 0] = 255
    result: Array = pixels
    return result


def portrait(robot: RobotSpec, meta: SequenceMeta, dt: float, qpos: Mapping[str, Array]) -> bytes:
    """Return a PNG of the copies of a robot side by side at the largest nominal error.

    Args:
        robot: Joints that are not operated are drawn at home.
        dt: Period of the rows, s.
        qpos: Positions by method, "recorded" among them, (T, n operated) rad.

    Raises:
        UsageError: Nothing can be rendered here; the message says what to install.
    """
    whole = {}
    for method, q in qpos.items():
        whole[method] = np.tile(robot.qpos_home, (len(q), 1))
        whole[method][:, robot.operated_index] = q
    motions = []
    for method, q in whole.items():
        error = np.abs(qpos[method] - qpos["recorded"]).mean(axis=1)  # (T,) rad
        motions.append(Copy(method, q, error))
    base = whole["recorded"]
    real = Sequence(meta, robot.joint_names, dt, base, base, np.zeros_like(base))
    shown = SideBySide(real, robot, tuple(motions), None)
    clip = Clip.from_start(shown, None, 8.0)
    moment = largest_error_time(shown, clip)
    row = min(round(moment / dt), len(base) - 2)
    scene = Scene(shown, rows=slice(row, row + 2), flat=True, closeup=True)
    with Camera(scene, clip, 840) as camera:
        file = io.BytesIO()
        camera.picture(moment).save(file, "PNG", optimize=True)
    return file.getvalue()


def require_writable(path: Path) -> None:
    """Refuse an unknown file suffix, a missing folder or a missing library before any work is
    done.
    """
    if path.suffix.lower() not in SUFFIXES:
        raise UsageError(f"--render {path}: name a file that ends in {', '.join(SUFFIXES)}")
    if not path.parent.is_dir():
        raise UsageError(f"--render {path}: there is no folder {path.parent}; make it first")
    if path.suffix.lower() == ".mp4":
        _ffmpeg()


def write(
    camera: Camera, path: Path, progress: Callable[[int, int], None] = lambda i, n: None
) -> int:
    """Render to a file; a PNG shows the moment of the largest error of the first simulated copy.

    Returns:
        Number of pictures.
    """
    require_writable(path)
    clip = camera.clip
    suffix = path.suffix.lower()
    # A GIF counts in 1/100 s, and viewers slow down below 2.
    hundredths = max(round(100 / clip.fps), 2)
    times = clip.times(hundredths / 100 if suffix == ".gif" else 1 / clip.fps)

    def pictures() -> Iterator[Image]:
        for i, time in enumerate(times):
            yield camera.picture(float(time))
            progress(i + 1, len(times))

    with atomic_write(path) as temporary:
        if suffix == ".gif":
            _write_gif(list(pictures()), temporary, 10 * hundredths)
        elif suffix == ".mp4":
            _write_mp4(pictures(), temporary, clip.fps, (camera.width, camera.height))
        else:
            camera.picture(largest_error_time(camera.scene.shown, clip)).save(temporary)
    return 1 if suffix == ".png" else len(times)


def _write_gif(pictures: list[Image], path: Path, milliseconds: int) -> None:
    """Write with one palette for all frames and no dithering, which keeps the file small."""
    from PIL.Image import Dither, Quantize, fromarray

    sample = np.concatenate([np.asarray(p) for p in pictures[:: max(len(pictures) // 4, 1)]])
    palette = fromarray(sample).quantize(GIF_COLOURS, Quantize.MAXCOVERAGE)
    frames = [p.quantize(palette=palette, dither=Dither.NONE) for p in pictures]
    frames[0].save(
        path, save_all=True, append_images=frames[1:], duration=milliseconds, loop=0, optimize=True
    )


def _write_mp4(pictures: Iterator[Image], path: Path, fps: float, size: tuple[int, int]) -> None:
    writer = _ffmpeg().write_frames(str(path), size, fps=fps, quality=7, macro_block_size=2)
    writer.send(None)
    try:
        for picture in pictures:
            writer.send(picture.tobytes())
    finally:
        writer.close()


def _ffmpeg() -> Any:
    try:
        import imageio_ffmpeg
    except ImportError:
        raise UsageError(
            f"MP4 needs imageio-ffmpeg; run: {install_command('film')}, or render a .gif"
        ) from None
    return imageio_ffmpeg
