"""A scene in the page: orbit with the mouse, play, pause, move through the clip, errors beside
it.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import mujoco
import numpy as np

from gaponet.base.arrays import Array
from gaponet.base.text import escape_markdown
from gaponet.evaluation.methods import colour, title
from gaponet.report.view.scene import Scene
from gaponet.report.view.side_by_side import Clip, Copy, SideBySide, largest_error_time

CURVE_ROWS = 1000  # of a chart
# Rgb; a body darker than that cannot be seen on a dark page.
DARK = 0.22
LIGHTER = np.array([0.20, 0.26, 0.38])


class Bodies:
    """The bodies of a scene as viser frames with meshes, a floor and labels.

    Attributes:
        frames: Body of the scene's model → frame.
    """

    def __init__(self, server: Any, scene: Scene) -> None:
        """Draw a scene in the page of a viser server."""
        self.server = server
        self.scene = scene
        self._root = server.scene.add_frame("/robots", show_axes=False)
        self.frames: dict[int, Any] = {}
        self._add_bodies()
        across = float(2.5 * scene.extent)
        server.scene.add_grid("/robots/floor", across, across, position=(0, 0, scene.floor))
        above = scene.view.axes[1] * 1.08 * scene.box.top
        for m, base in zip(scene.shown.motions, scene.base, strict=True):
            server.scene.add_label(
                f"/robots/label_{m.method}", title(m.method), position=base + above
            )
        self._aim()

    def pose(self, now: float) -> None:
        """Show the scene at a time, s."""
        self.scene.pose(now)
        with self.server.atomic():
            for body, frame in self.frames.items():
                frame.position = self.scene.data.xpos[body]
                frame.wxyz = self.scene.data.xquat[body]

    def remove(self) -> None:
        """Remove them from the page."""
        self._root.remove()

    def _add_bodies(self) -> None:
        model = self.scene.model
        seen = np.flatnonzero(
            (model.geom_group < 3) & (model.geom_type != mujoco.mjtGeom.mjGEOM_PLANE)
        )
        for body in range(model.nbody):
            geoms = [g for g in seen if model.geom_bodyid[g] == body]
            if not geoms:
                continue
            name = "/robots/" + model.body(body).name.replace("/", "_")
            self.frames[body] = self.server.scene.add_frame(name, show_axes=False)
            for g in geoms:
                vertices, faces = _surface(model, int(g))
                self.server.scene.add_mesh_simple(
                    f"{name}/{g}",
                    vertices,
                    faces,
                    color=page_colour(model.geom_rgba[g, :3]),
                    opacity=float(model.geom_rgba[g, 3]),
                    position=model.geom_pos[g],
                    wxyz=model.geom_quat[g],
                )

    def _aim(self) -> None:
        # One robot may point at the camera.
        scene = self.scene
        across, up = scene.view.axes
        far = 2.6 + 0.8 / len(scene.base)
        self.server.initial_camera.fov = np.radians(45)
        cameras = [client.camera for client in self.server.get_clients().values()]
        for camera in (self.server.initial_camera, *cameras):
            camera.look_at = scene.middle
            camera.position = scene.middle + far * scene.extent * np.cross(across, up)


class ErrorTable:
    """The simulators' errors now and in the whole motion, as a table."""

    def __init__(self, gui: Any, simulators: Mapping[str, Copy]) -> None:
        """Add the table to the current container of the page; simulators by title."""
        self.simulators = simulators
        self.text = gui.add_markdown("")

    def show(self, row: int) -> None:
        """Show the errors in a row of the motion."""
        lines = ["| mean error, mrad | now | whole motion |", "| --- | ---: | ---: |"]
        for name, simulator in self.simulators.items():
            error = 1e3 * simulator.error[row]
            mean = 1e3 * simulator.mpjae
            lines.append(f"| {escape_markdown(name)} | {error:.1f} | {mean:.1f} |")
        self.text.content = "\n".join(lines)


class Player:
    """A scene in the page, and controls in the current container of the page."""

    def __init__(self, server: Any, scene: Scene, clip: Clip, magnify: float = 1.0) -> None:
        """Draw a scene.

        Args:
            server: viser server.
            clip: Part that is played; it repeats.
            magnify: Stated in the page.
        """
        self.clip = clip
        self.bodies = Bodies(server, scene)
        shown = scene.shown
        simulators = {title(m.method): m for m in shown.motions if m.method != "recorded"}
        worst = largest_error_time(shown, clip)
        gui = server.gui
        self.folder = gui.add_folder(None, visible=len(shown.real) > 2)  # otherwise nothing moves
        with self.folder:
            self.title = gui.add_markdown(_heading(shown, magnify))
            self.playing = gui.add_checkbox("play", self.folder.visible)
            self.time: Any = gui.add_slider(
                "time, s", clip.start, clip.stop, shown.real.dt, clip.start
            )
            self.worst = gui.add_button(f"Worst moment: {worst:.2f} s")
            self.speed = gui.add_slider("speed", 0.05, 2.0, 0.05, min(max(clip.speed, 0.05), 2.0))
            self.errors = ErrorTable(gui, simulators)
            curves = {name: (1e3 * m.error, colour(m.method)) for name, m in simulators.items()}
            time = np.arange(len(shown.real)) * shown.real.dt
            draw_curves(gui, time, curves, "mean |error|, mrad")

        @self.worst.on_click  # type: ignore[untyped-decorator]
        def _(_: Any) -> None:
            self.playing.value = False
            self.time.value = worst

        self.updated = float(self.time.value)  # s, of what is shown
        self.update()

    def update(self) -> None:
        """Show the scene at the slider's time."""
        now = float(self.time.value)
        self.updated = now
        self.bodies.pose(now)
        self.errors.show(self.bodies.scene.row(now))

    def advance(self, elapsed: float) -> None:
        """Advance by `elapsed` s of wall time; the clip repeats."""
        if self.playing.value:
            on = self.time.value - self.clip.start + elapsed * self.speed.value
            self.time.value = self.clip.start + on % self.clip.duration
        if self.time.value != self.updated:
            self.update()

    def remove(self) -> None:
        """Remove the robots and the controls."""
        self.folder.remove()
        self.bodies.remove()


def _heading(shown: SideBySide, magnify: float) -> str:
    """Return what stands above the controls, in Markdown."""
    meta = shown.real.meta
    heading = "**VIRTUAL ROBOT**\n\n" if meta.virtual else ""
    heading += escape_markdown(
        f"{meta.robot}, {meta.motion}, unit {meta.unit_id}, {meta.payload_mass:g} kg"
    )
    if magnify != 1:
        heading += f"\n\ndifferences drawn {magnify:g}×"
    return heading


def page_colour(rgb: Array) -> Array:
    """Return a colour (3,) of 0 to 1 as one of 0 to 255 that a light and a dark page show: black
    becomes slate.
    """
    result: Array = (255 * (rgb + LIGHTER * (rgb.max() < DARK))).astype(int)
    return result


def draw_curves(gui: Any, time: Array, curves: Mapping[str, tuple[Array, str]], title: str) -> Any:
    """Return a new chart over time (T), s, above a button that saves it.

    curves: name → values (T) and colour.
    """
    from viser.uplot import Scale, Series

    rows = np.unique(np.linspace(0, len(time) - 1, CURVE_ROWS).astype(int))
    colours = [c for _, c in curves.values()]
    chart = gui.add_uplot(
        (time[rows], *(values[rows] for values, _ in curves.values())),
        (
            Series(label="time, s"),
            *(Series(label=n, stroke=c, width=2) for n, c in zip(curves, colours, strict=True)),
        ),
        title=title,
        aspect=2.2,
        scales={"x": Scale(time=False)},
    )

    def save_chart(event: Any) -> None:
        from gaponet.report.figures.style import draw_curves, save

        now, *values = chart.data
        figure = draw_curves(
            now, dict(zip(curves, zip(values, colours, strict=True), strict=True)), chart.title
        )
        with TemporaryDirectory() as folder:
            for file in save(figure, Path(folder) / "curves"):
                event.client.send_file_download(file.name, file.read_bytes())

    gui.add_button("Save the curves: PNG, SVG").on_click(save_chart)
    return chart


def _surface(model: mujoco.MjModel, geom: int) -> tuple[Array, Array]:
    """Return vertices (k, 3), m in the geom's frame, and triangles (m, 3)."""
    from trimesh import creation

    kind = model.geom_type[geom]
    a, b, c = (float(x) for x in model.geom_size[geom])
    match kind:
        case mujoco.mjtGeom.mjGEOM_MESH:
            mesh = model.mesh(model.geom_dataid[geom])
            first = mesh.vertadr[0]
            face = mesh.faceadr[0]
            vertices = model.mesh_vert[first : first + mesh.vertnum[0]]
            triangles = model.mesh_face[face : face + mesh.facenum[0]]
            return vertices, triangles
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
