"""A scene in a browser, served by viser: orbit with the mouse, play, pause, move through the clip."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

import mujoco
import numpy as np

from gaponet.base.arrays import Array
from gaponet.base.text import escape_markdown
from gaponet.report.view.scene import Scene
from gaponet.report.view.side_by_side import Clip

FRAME_S = 1 / 30
HOST = "127.0.0.1"  # private; forward the port for another machine


class WebScene:
    """The bodies of a scene as viser frames with meshes; `update` moves them."""

    def __init__(self, scene: Scene, clip: Clip, port: int = 8080, magnify: float = 1.0) -> None:
        """Start a server.

        Args:
            port: Port on this machine.
        """
        import viser

        self.scene, self.clip = scene, clip
        self.server = viser.ViserServer(HOST, port, label="gaponet view", verbose=False)
        self.url = f"http://{HOST}:{self.server.get_port()}"
        self.frames = self._bodies()
        self.labels = self._labels()
        self._aim()
        meta, gui = scene.shown.real.meta, self.server.gui
        gui.main_panel.dock_right()  # beside the robots, not in front of them
        heading = "**VIRTUAL ROBOT**\n\n" if meta.virtual else ""
        heading += escape_markdown(f"{meta.robot}, {meta.motion}, unit {meta.unit_id}, {meta.payload_mass:g} kg")
        self.title = gui.add_markdown(heading + (f"\n\ndifferences drawn {magnify:g}×" if magnify != 1 else ""))
        self.playing = gui.add_checkbox("play", True)
        self.time: Any = gui.add_slider("time, s", clip.start, clip.stop, scene.shown.real.dt, clip.start)
        self.speed = gui.add_slider("speed", 0.05, 2.0, 0.05, min(max(clip.speed, 0.05), 2.0))
        self.table = gui.add_markdown("")
        self.update()

    def update(self) -> None:
        """Show the scene at the slider's time."""
        scene, now = self.scene, float(self.time.value)
        scene.pose(now)
        with self.server.atomic():
            for body, frame in self.frames.items():
                frame.position, frame.wxyz = scene.data.xpos[body], scene.data.xquat[body]
        row = scene.row(now)
        errors = [(m.name, m.error[row] * 1e3, m.mpjae * 1e3) for m in scene.shown.motions if m.method != "recorded"]
        rows = "\n".join(f"| {name} | {e:.1f} | {mean:.1f} |" for name, e, mean in errors)
        self.table.content = f"| mean error, mrad | now | whole motion |\n| --- | ---: | ---: |\n{rows}"

    def advance(self, elapsed: float) -> None:
        """Advance by `elapsed` s of wall time; the clip repeats."""
        if self.playing.value:
            on = self.time.value - self.clip.start + elapsed * self.speed.value
            self.time.value = self.clip.start + on % self.clip.duration
        self.update()

    def _bodies(self) -> dict[int, Any]:
        model, frames = self.scene.model, {}
        seen = np.flatnonzero((model.geom_group < 3) & (model.geom_type != mujoco.mjtGeom.mjGEOM_PLANE))
        for body in range(model.nbody):
            geoms = [g for g in seen if model.geom_bodyid[g] == body]
            if not geoms:
                continue
            name = "/" + model.body(body).name.replace("/", "_")
            frames[body] = self.server.scene.add_frame(name, show_axes=False)
            for g in geoms:
                vertices, faces = surface(model, int(g))
                colour = (255 * model.geom_rgba[g, :3]).astype(int)
                self.server.scene.add_mesh_simple(
                    f"{name}/{g}", vertices, faces, color=colour, opacity=float(model.geom_rgba[g, 3]),
                    position=model.geom_pos[g], wxyz=model.geom_quat[g],
                )  # fmt: skip
        across = float(2.5 * self.scene.extent)
        self.server.scene.add_grid("/floor", across, across, position=(0, 0, self.scene.floor))
        return frames

    def _labels(self) -> list[Any]:
        above = self.scene.view.axes[1] * 1.08 * self.scene.box[3]
        pairs = zip(self.scene.shown.motions, self.scene.base, strict=True)
        return [self.server.scene.add_label(f"/label_{m.method}", m.name, position=b + above) for m, b in pairs]

    def _aim(self) -> None:
        across, up = self.scene.view.axes
        camera, toward = self.server.initial_camera, np.cross(across, up)
        camera.look_at = self.scene.middle
        camera.position = self.scene.middle + 2.0 * self.scene.extent * toward
        camera.fov = np.radians(45)


def serve(scene: Scene, clip: Clip, port: int, magnify: float, say: Callable[[str], None]) -> None:
    """Serve until Ctrl-C."""
    web = WebScene(scene, clip, port, magnify)
    say(f"open {web.url} in a browser; Ctrl-C ends")
    before = time.monotonic()
    try:
        while True:
            time.sleep(FRAME_S)
            now = time.monotonic()
            web.advance(now - before)
            before = now
    except KeyboardInterrupt:
        web.server.stop()


def surface(model: mujoco.MjModel, geom: int) -> tuple[Array, Array]:
    """Return vertices (k, 3), m in the geom's frame, and triangles (m, 3)."""
    from trimesh import creation

    kind, (a, b, c) = model.geom_type[geom], (float(x) for x in model.geom_size[geom])
    match kind:
        case mujoco.mjtGeom.mjGEOM_MESH:
            mesh = model.mesh(model.geom_dataid[geom])
            first, face = mesh.vertadr[0], mesh.faceadr[0]
            return model.mesh_vert[first : first + mesh.vertnum[0]], model.mesh_face[face : face + mesh.facenum[0]]
        case mujoco.mjtGeom.mjGEOM_CAPSULE:
            shape = creation.capsule(2 * b, a, count=[12, 12])
            shape.apply_translation(-shape.bounds.mean(axis=0))
        case mujoco.mjtGeom.mjGEOM_CYLINDER:
            shape = creation.cylinder(a, 2 * b, sections=16)
        case mujoco.mjtGeom.mjGEOM_BOX:
            shape = creation.box((2 * a, 2 * b, 2 * c))
        case _:  # sphere, ellipsoid
            shape = creation.icosphere(2)
            shape.apply_scale((a, a, a) if kind == mujoco.mjtGeom.mjGEOM_SPHERE else (a, b, c))
    return np.asarray(shape.vertices, np.float32), np.asarray(shape.faces, np.uint32)
