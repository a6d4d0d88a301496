"""MuJoCo models side by side as one picture, such as a vendor's model and the robot folder made from it."""

from __future__ import annotations

import io

import mujoco
import numpy as np

from gaponet.base.arrays import Array
from gaponet.report.view.picture import INK, font, renderer

SIDE, HEAD = 480, 30  # pixels of one model's square and of its label
FLOOR = mujoco.mjtGeom.mjGEOM_PLANE


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
