"""Pictures of a scene, and of models in a row: rendered off screen by MuJoCo, labelled by Pillow."""

from __future__ import annotations

import io
import warnings
from typing import TYPE_CHECKING, Any

import mujoco
import numpy as np

from gaponet.base.arrays import Array
from gaponet.base.errors import UsageError
from gaponet.report.view.gl import INSTALL_HINT
from gaponet.report.view.scene import Scene
from gaponet.report.view.side_by_side import Clip

if TYPE_CHECKING:
    from PIL.Image import Image as Picture
    from PIL.ImageDraw import ImageDraw

INK, FAINT, ALARM = "#222222", "#777777", "#c8102e"
SEPARATOR = "  ·  "  # Pillow's own font has this, but no ×
MAX_HEIGHT = 0.7  # of the width
SIDE, HEAD = 480, 30  # pixels of one model's square and of its label
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
        self.scene, self.clip, self.magnify, self.width = scene, clip, magnify, width - width % 2
        letters, tall = max(width / 960, 0.5), scene.box[3] - scene.box[2]
        self.head, labels = round(34 * letters), round(60 * letters)  # pixels
        room = MAX_HEIGHT * self.width - self.head - labels
        self.scale = min(self.width / (scene.spacing * len(scene.base)), room / tall)  # pixels per metre
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

    def picture(self, time: float) -> Picture:
        """Return the labelled frame at a time of the recording, s: a PIL image."""
        from PIL import Image, ImageDraw

        self.scene.pose(time)
        self.renderer.update_scene(self.scene.data, self.lens)
        rendered = Image.fromarray(self.renderer.render())
        image = Image.new("RGB", (self.width, self.height), rendered.getpixel((0, 0)))
        image.paste(rendered, (0, self.head))
        self._write(ImageDraw.Draw(image), time)
        return image

    def _lens(self) -> mujoco.MjvCamera:
        """Return an orthographic camera, which shows every copy from the same side."""
        scene = self.scene
        lens = mujoco.MjvCamera()
        lens.orthographic = scene.model.vis.global_.orthographic = 1  # MuJoCo 3 reads the model only
        lens.azimuth, lens.elevation = scene.view.azimuth, scene.view.elevation
        lens.lookat[:] = scene.middle
        lens.distance = 4 * scene.extent
        scene.model.vis.global_.fovy = self.robots / self.scale  # m, of an orthographic picture
        scene.model.vis.map.znear, scene.model.vis.map.zfar = 0.01, 20
        return lens

    def _write(self, draw: ImageDraw, time: float) -> None:
        row, small, large = self.scene.row(time), self.fonts[13], self.fonts[17]
        self._head(draw, time)
        top, pitch, k = self.head + self.robots, self.scene.spacing * self.scale, len(self.scene.base)
        for i, m in enumerate(self.scene.shown.motions):
            x = self.width / 2 + (i - (k - 1) / 2) * pitch
            draw.text((x, top), m.name, m.colour, large, anchor="ma", stroke_width=0.3, stroke_fill=m.colour)
            if m.method != "recorded":
                text = f"{m.error[row] * 1e3:.1f} mrad now, {m.mpjae * 1e3:.1f} mean"
                draw.text((x, top + 1.5 * large.size), text, FAINT, small, anchor="ma")

    def _head(self, draw: ImageDraw, time: float) -> None:
        """Write VIRTUAL where it applies, the recording on the left, and the time on the right."""
        shown, pad, font = self.scene.shown, self.head // 3, self.fonts[15]
        meta = shown.real.meta
        facts = [meta.robot, meta.motion, f"unit {meta.unit_id}", _payload(meta.payload_mass, meta.payload_side)]
        facts += [] if shown.seen is None else ["seen in training" if shown.seen else "new motion"]
        clock = [f"speed {self.clip.speed:g}x"] if self.clip.speed != 1 else []
        clock += [f"differences drawn {self.magnify:g}x"] if self.magnify != 1 else []
        left, right = SEPARATOR.join(facts), SEPARATOR.join([*clock, f"{time:6.2f} s"])
        mark = "VIRTUAL ROBOT   " if meta.virtual else ""
        while font.getlength(mark + left + right) > self.width - 4 * pad and font.size > 8:
            font = font.font_variant(size=font.size - 0.5)
        draw.text((pad, pad * 0.8), mark, ALARM, font, stroke_width=0.4, stroke_fill=ALARM)
        draw.text((pad + font.getlength(mark), pad * 0.8), left, INK, font)
        draw.text((self.width - pad, pad * 0.8), right, INK, font, anchor="ra")


def _payload(mass: float, side: str) -> str:
    return "empty-handed" if mass == 0 else f"{mass:g} kg " + ("in each hand" if side == "both" else f"in {side} hand")


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
        raise UsageError(f"cannot render off screen ({type(error).__name__}: {error}). {INSTALL_HINT}") from None


def still(models: list[tuple[str, mujoco.MjModel, Array]]) -> bytes:
    """Return a PNG of models (label, model, qpos) in a row, all with the camera that fits the first.

    Raises:
        UsageError: Nothing can be rendered here; the message says what to install.
    """
    from PIL import Image, ImageDraw

    image = Image.new("RGB", (SIDE * len(models), SIDE + HEAD), "white")
    draw = ImageDraw.Draw(image)
    camera = mujoco.MjvCamera()
    camera.azimuth, camera.elevation = 140, -15
    for i, (label, model, qpos) in enumerate(models):
        data = mujoco.MjData(model)
        data.qpos[:] = qpos
        mujoco.mj_forward(model, data)
        if i == 0:
            low, high = _box(model, data)
            camera.lookat[:] = (low + high) / 2
            camera.distance = 1.15 * float(np.linalg.norm(high - low))
        model.geom_rgba[model.geom_type == FLOOR, 3] = 0
        model.vis.map.znear = 0.01 / model.stat.extent
        model.vis.headlight.ambient[:] = 0.5
        picture = renderer(model, SIDE, SIDE)
        picture.scene.flags[mujoco.mjtRndFlag.mjRND_SKYBOX] = 0
        picture.update_scene(data, camera)
        image.paste(Image.fromarray(_white(picture)), (SIDE * i, HEAD))
        picture.close()
        draw.text((SIDE * (i + 0.5), HEAD / 2), label, INK, font(17), anchor="mm")
    file = io.BytesIO()
    image.save(file, "PNG", optimize=True)
    return file.getvalue()


def _box(model: mujoco.MjModel, data: mujoco.MjData) -> tuple[Array, Array]:
    """Return the corners of a box around all geoms except floors, m."""
    shown = model.geom_type != FLOOR
    if not shown.any():
        return data.xpos.min(axis=0), data.xpos.max(axis=0)
    radius, centres = np.linalg.norm(model.geom_aabb[shown, 3:], axis=1)[:, None], data.geom_xpos[shown]
    return (centres - radius).min(axis=0, initial=np.inf), (centres + radius).max(axis=0, initial=-np.inf)


def _white(picture: mujoco.Renderer) -> Array:
    """Return the picture with a white background."""
    pixels = picture.render().copy()
    picture.enable_segmentation_rendering()
    pixels[picture.render()[:, :, 0] < 0] = 255
    return pixels
