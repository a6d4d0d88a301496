"""Several copies of a robot side by side in one MuJoCo scene, one colour per method.

Nothing is simulated here: body positions follow from given joint angles. The robots of the package
have no meshes. Housings about the joints and the shells of look.toml or collision.toml are drawn
instead.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import NamedTuple

import mujoco
import numpy as np

from gaponet.base.arrays import Array
from gaponet.base.errors import RobotError, UsageError
from gaponet.base.structure import read_toml
from gaponet.evaluation.methods import colour as method_colour
from gaponet.motion.feasible import carriers
from gaponet.report.view.side_by_side import SideBySide
from gaponet.robot.collision import Shapes
from gaponet.robot.spec import RobotSpec
from gaponet.sim.model import build_spec

# Drawn of the shapes of collision.toml, which are larger than the robot.
COLLISION_RADIUS_SHARE = 0.85
PAYLOAD_RGBA = (0.93, 0.60, 0.10, 1.0)
GHOST_RGBA = (0.07, 0.07, 0.07, 0.4)  # the recording inside each other copy
GHOST_THICKNESS = 0.9  # of the limbs: a copy without error covers its ghost
GHOST_DISTANCE = 0.12  # of the robot's height, behind its copy on a flat picture
GROUND_GREY = 0.96
FITTED_FRAMES = 60  # for the size of the picture


@dataclass(frozen=True)
class View:
    """Direction of the camera. Robots face +x; their row runs from left to right on the picture."""

    azimuth: float = 145.0  # degrees: 180 looks at the robot's front, 90 at its right side
    elevation: float = -14.0  # degrees, negative from above

    @property
    def axes(self) -> tuple[Array, Array]:
        """Unit vectors to the right and up on the picture, (3) each."""
        a, e = np.radians([self.azimuth, self.elevation])
        right = np.array([np.sin(a), -np.cos(a), 0.0])
        forward = np.array([np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e)])
        return right, np.cross(right, forward)


class Outline(NamedTuple):
    """Outline of one robot on the picture, relative to its base, m."""

    left: float
    right: float
    bottom: float
    top: float

    @property
    def height(self) -> float:
        return self.top - self.bottom


class Scene:
    """The copies of a SideBySide in one MuJoCo model.

    Attributes:
        model, data: MuJoCo model and data of all copies together; copy i's bodies and joints are
            called METHOD/NAME.
        spacing: Between neighbours along the picture, m.
        extent: Half the size of the scene, m.
        box: Outline of one robot over all frames.
        base: Base of each copy, (k, 3), m.
    """

    def __init__(
        self,
        shown: SideBySide,
        view: View = View(),
        rows: slice = slice(None),
        flat: bool = False,
        closeup: bool = False,
    ) -> None:
        """Build the model and fit the picture.

        Args:
            view: The camera's direction decides the direction of the row.
            rows: Frames that have to fit.
            flat: Put ghosts behind their copies, for an orthographic picture: only the differences
                are visible.
            closeup: Limbs without an operated joint need not fit.
        """
        self.shown = shown
        self.view = view
        self.ghosts = any(m.method == "recorded" for m in shown.motions) and len(shown.motions) > 1
        self.box, self.floor = self._fit(rows, closeup)
        self.spacing = 1.1 * (self.box.right - self.box.left)
        k = len(shown.motions)
        self.base = (np.arange(k) - (k - 1) / 2)[:, None] * self.spacing * view.axes[0]
        self.extent = max(0.5 * k * self.spacing, self.box.height)
        across, up = view.axes
        behind = np.zeros(3)
        if flat:
            behind = GHOST_DISTANCE * self.box.height * np.cross(up, across)
        self.model = self._compose(self.base, behind)
        self.data = mujoco.MjData(self.model)
        methods = [motion.method for motion in shown.motions]
        self.address = [(i, self._address(method)) for i, method in enumerate(methods)]
        if self.ghosts:
            recorded = methods.index("recorded")
            for method in methods:
                if method != "recorded":
                    self.address.append((recorded, self._address(f"{method}-ghost")))

    def pose(self, time: float) -> None:
        """Set the positions of every copy at a time of the recording, s, interpolated between
        rows.
        """
        dt = self.shown.real.dt
        rows = len(self.shown.real)
        x = float(np.clip(time / dt, 0, rows - 1))
        i = min(int(x), rows - 2)
        for motion, address in self.address:
            q = self.shown.motions[motion].qpos
            self.data.qpos[address] = q[i] + (x - i) * (q[i + 1] - q[i])
        mujoco.mj_kinematics(self.model, self.data)
        mujoco.mj_camlight(self.model, self.data)

    def row(self, time: float) -> int:
        """Return the last row before a time of the recording, s."""
        return int(np.clip(time / self.shown.real.dt + 1e-6, 0, len(self.shown.real) - 1))

    @property
    def middle(self) -> Array:
        """Centre of the row of robots, (3), m."""
        box = self.box
        across, up = self.view.axes
        return across * (box.left + box.right) / 2 + up * (box.bottom + box.top) / 2

    def _address(self, prefix: str) -> Array:
        names = self.shown.robot.joint_names
        return np.array([self.model.joint(f"{prefix}/{name}").qposadr[0] for name in names])

    def _fit(self, rows: slice, closeup: bool) -> tuple[Outline, float]:
        """Return the outline of one robot on the picture over all motions, and its lowest point."""
        robot = self.shown.robot
        meta = self.shown.real.meta
        model = visual_spec(robot, "#808080", meta.payload_mass, meta.payload_side).compile()
        geoms = _visible_geoms(model)
        if not len(geoms):
            raise UsageError(
                f"{robot.mjcf}: has no visible geom; add one to each body to look at it"
            )
        near = _operated_bodies(model, robot) if closeup else set(range(model.nbody))
        fits = np.array([body in near for body in model.geom_bodyid[geoms]])
        low = np.full(2, np.inf)  # left, bottom
        high = np.full(2, -np.inf)  # right, top
        floor = np.inf
        axes = np.stack(self.view.axes)
        for points in self._corners(model, geoms, rows):
            floor = min(floor, float(points[..., 2].min()))
            places = points[fits].reshape(-1, 3) @ axes.T
            low = np.minimum(low, places.min(axis=0))
            high = np.maximum(high, places.max(axis=0))
        left, bottom = low.tolist()
        right, top = high.tolist()
        return Outline(left, right, bottom, top), floor

    def _corners(self, model: mujoco.MjModel, geoms: Array, rows: slice) -> Iterator[Array]:
        """Yield the corners of the boxes around geoms, (k, 8, 3) m, in FITTED_FRAMES of every
        motion.
        """
        data = mujoco.MjData(model)
        address = [model.joint(name).qposadr[0] for name in self.shown.robot.joint_names]
        middle = model.geom_aabb[geoms, None, :3]
        half = model.geom_aabb[geoms, None, 3:]
        signs = np.array(np.meshgrid(*[[-1, 1]] * 3)).reshape(3, 8).T
        corners = middle + half * signs  # in the geom's frame
        for motion in self.shown.motions:
            part = motion.qpos[rows]
            frames = np.linspace(0, len(part) - 1, FITTED_FRAMES).astype(int)
            for q in part[np.unique(frames)]:
                data.qpos[address] = q
                mujoco.mj_kinematics(model, data)
                rotation = data.geom_xmat[geoms].reshape(-1, 3, 3)
                yield data.geom_xpos[geoms, None] + corners @ rotation.mT

    def _compose(self, base: Array, behind: Array) -> mujoco.MjModel:
        scene = mujoco.MjSpec()
        meta = self.shown.real.meta
        scene.compiler.degree = False
        _light(scene, self.floor, self.extent)
        for motion, place in zip(self.shown.motions, base, strict=True):
            parts = {motion.method: (method_colour(motion.method), place)}
            if self.ghosts and motion.method != "recorded":
                parts[f"{motion.method}-ghost"] = ("", place + behind)
            for prefix, (colour, pos) in parts.items():
                spec = visual_spec(self.shown.robot, colour, meta.payload_mass, meta.payload_side)
                # User data of the servo model: MuJoCo warns if scene and robot differ in it.
                scene.nuser_actuator = spec.nuser_actuator
                scene.attach(spec, prefix=f"{prefix}/", frame=scene.worldbody.add_frame(pos=pos))
        return scene.compile()


def _visible_geoms(model: mujoco.MjModel) -> Array:
    """Return the numbers of the geoms that belong to the picture of the robot, (k,)."""
    is_plane = model.geom_type == mujoco.mjtGeom.mjGEOM_PLANE
    return np.flatnonzero((model.geom_group < 3) & ~is_plane)


def visual_spec(
    robot: RobotSpec, colour: str, payload_mass: float, payload_side: str = "both"
) -> mujoco.MjSpec:
    """Return the robot in one colour with housings, shells and payload; colour "" gives a ghost."""
    spec = build_spec(robot, payload_mass, payload_side)
    _delete_invisible_parts(spec)
    payload_bodies = {f"payload_{mount.side}" for mount in robot.payload_mounts}
    rgba = rgb(colour) if colour else GHOST_RGBA
    payload_rgba = PAYLOAD_RGBA if colour else GHOST_RGBA
    dark = (*(0.55 * np.array(rgba[:3])), rgba[3])
    meshes = any(geom.type == mujoco.mjtGeom.mjGEOM_MESH for geom in spec.geoms)
    for geom in spec.geoms:
        geom.material = ""
        geom.rgba = payload_rgba if geom.parent.name in payload_bodies else rgba
    if not meshes:
        for body in spec.bodies[1:]:  # asked for the world's parent, MuJoCo 3.10 ends the process
            _add_housings(body, dark)
        _add_shells(spec, robot, rgba)
    if not colour:
        for geom in spec.geoms:
            geom.size = GHOST_THICKNESS * np.array(geom.size)
            _cast_no_shadow(geom)
    return spec


def _delete_invisible_parts(spec: mujoco.MjSpec) -> None:
    """Delete all but bodies, joints and shapes: nothing is simulated, and all copies must agree.

    The ground goes too, because the scene has its own.
    """
    spec.option = mujoco.MjSpec().option
    parts = [*spec.actuators, *spec.lights, *spec.cameras, *spec.sensors]
    parts += [*spec.keys, *spec.pairs, *spec.excludes]
    parts += [geom for geom in spec.geoms if geom.type == mujoco.mjtGeom.mjGEOM_PLANE]
    for part in parts:
        spec.delete(part)


def rgb(colour: str) -> tuple[float, float, float, float]:
    """Return #rrggbb as rgba, a little lighter, since a black body shows no shape."""
    parts = [int(colour[i : i + 2], 16) / 255 for i in (1, 3, 5)]
    return (*(0.14 + 0.86 * p for p in parts), 1.0)  # type: ignore[return-value]


def _add_housings(body: mujoco.MjsBody, rgba: tuple[float, ...]) -> None:
    """Add a short cylinder about each joint axis, a third wider than the limb."""
    around = [*body.geoms, *body.parent.geoms]
    sizes = [geom.size[0] for geom in around if geom.type == mujoco.mjtGeom.mjGEOM_CAPSULE]
    if not sizes:
        return
    radius = 1.35 * max(sizes)
    for joint in body.joints:
        middle = np.array(joint.pos)
        half = 1.1 * radius * np.array(joint.axis) / np.linalg.norm(joint.axis)
        ends = [*(middle - half), *(middle + half)]
        _add(body, mujoco.mjtGeom.mjGEOM_CYLINDER, ends, radius, rgba)


def _add_shells(spec: mujoco.MjSpec, robot: RobotSpec, rgba: tuple[float, ...]) -> None:
    """Add the shapes of look.toml, or else those of collision.toml, which are larger than the
    robot.
    """
    path = robot.folder / "look.toml"
    share = 1.0
    if not path.is_file():
        path = robot.folder / "collision.toml"
        share = COLLISION_RADIUS_SHARE
    if not path.is_file():
        return
    table = read_toml(Shapes, path, RobotError, "docs/new-robot.md lists the fields")
    bodies = [capsule["body"] for capsule in table.capsule] + [box.body for box in table.box]
    for name in bodies:
        if spec.body(name) is None:
            raise RobotError(f"{path}: names body '{name}', which {robot.mjcf.name} lacks")
    for capsule in table.capsule:
        body = spec.body(capsule["body"])
        ends = [*capsule["from"], *capsule["to"]]
        _add(body, mujoco.mjtGeom.mjGEOM_CAPSULE, ends, share * capsule["radius"], rgba)
    for box in table.box:
        spec.body(box.body).add_geom(
            type=mujoco.mjtGeom.mjGEOM_BOX,
            pos=box.pos,
            size=box.size,
            mass=0,
            contype=0,
            conaffinity=0,
            rgba=rgba,
        )


def _add(
    body: mujoco.MjsBody,
    kind: mujoco.mjtGeom,
    ends: list[float],
    radius: float,
    rgba: tuple[float, ...],
) -> None:
    body.add_geom(
        type=kind, fromto=ends, size=(radius, 0, 0), mass=0, contype=0, conaffinity=0, rgba=rgba
    )


def _operated_bodies(model: mujoco.MjModel, robot: RobotSpec) -> set[int]:
    """Return the bodies that operated joints move, and the bodies that carry them."""
    moving = {int(model.jnt_bodyid[model.joint(name).id]) for name in robot.operated}
    chains = [carriers(model, body) for body in range(1, model.nbody)]
    return set[int]().union(*(chain for chain in chains if moving & chain))


def _cast_no_shadow(geom: mujoco.MjsGeom) -> None:
    if hasattr(geom, "castshadow"):  # from MuJoCo 4 on
        geom.castshadow = False


def _light(scene: mujoco.MjSpec, floor: float, extent: float) -> None:
    """Add a light ground, one light that casts shadows and one that fills them."""
    world = scene.worldbody
    ground = world.add_geom(
        type=mujoco.mjtGeom.mjGEOM_PLANE,
        size=(0, 0, 1),
        pos=(0, 0, floor),
        rgba=(*[GROUND_GREY] * 3, 1),
        contype=0,
        conaffinity=0,
    )
    _cast_no_shadow(ground)  # onto itself
    scene.add_texture(
        name="sky",
        type=mujoco.mjtTexture.mjTEXTURE_SKYBOX,
        builtin=mujoco.mjtBuiltin.mjBUILTIN_FLAT,
        rgb1=[GROUND_GREY] * 3,
        rgb2=[GROUND_GREY] * 3,
        width=8,
        height=48,
    )
    sun = np.array([-0.25, 0.15, -1.0])
    fill = np.array([-0.6, -0.5, -0.4])
    for direction, bright, shadow in ((sun, 0.5, True), (fill, 0.3, False)):
        world.add_light(
            type=mujoco.mjtLightType.mjLIGHT_DIRECTIONAL,
            pos=[0, 0, floor] - 2 * extent * direction,
            dir=direction,
            diffuse=[bright] * 3,
            specular=[0.3 * bright] * 3,
            castshadow=shadow,
        )
    scene.visual.headlight.ambient = [0.32] * 3
    scene.visual.headlight.diffuse = [0.1] * 3
    scene.visual.headlight.specular = [0.0] * 3
    scene.visual.map.shadowclip = 1.2
    scene.visual.quality.shadowsize = 2048
    scene.visual.quality.numslices = 18
    scene.visual.quality.numstacks = 10
    scene.visual.global_.offwidth = 4096
    scene.visual.global_.offheight = 4096
    scene.stat.extent = extent
    scene.stat.center = [0, 0, floor]
