"""Simulators that no model was trained in, and free runs in them: in free space, on a plane, pushed."""

from __future__ import annotations

import re
import time
from collections.abc import Callable, Iterator
from collections.abc import Sequence as ListOf
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import mujoco
import numpy as np

from gaponet.arrays import Array
from gaponet.data.sequence import Sequence
from gaponet.deploy.aligned_sim import AlignedSim
from gaponet.deploy.transfer import Inverse, Reference
from gaponet.files import write_text
from gaponet.model.artifact import GapModel
from gaponet.robot import RobotSpec, Tip, load_robot
from gaponet.robot import Table as Plane
from gaponet.robot_folder import save_robot
from gaponet.sim.model import build_model
from gaponet.sim.replay import idle_limbs
from gaponet.sim.table import TABLE
from gaponet.spread import Spread

Disturbance = Literal["", "plane", "push"]

CHANGES: dict[str, dict[str, float]] = {  # simulator → factors of the nominal one's numbers
    "kp × 0.5": {"kp": 0.5}, "kp × 0.7": {"kp": 0.7}, "kp × 1.5": {"kp": 1.5}, "kp × 2.2": {"kp": 2.2},
    "friction × 0": {"frictionloss": 0.0}, "friction × 3": {"frictionloss": 3.0},
    "damping × 0.5": {"damping": 0.5}, "damping × 2": {"damping": 2.0}, "armature × 2": {"armature": 2.0},
    "mixture, stiff": {"kp": 1.5, "damping": 0.5, "frictionloss": 2.0, "armature": 0.5},
    "mixture, soft": {"kp": 0.7, "damping": 2.0, "frictionloss": 0.5, "armature": 2.0},
}  # fmt: skip
FAR = {"kp × 0.33": {"kp": 0.33}, "kp × 3": {"kp": 3.0}, "friction × 9": {"frictionloss": 9.0}}
PAYLOAD, FASTER, EULER = "payload wrong", "100 Hz", "Euler, 5 ms"
EXTRA = 0.2  # kg in the simulator's hands where the robot never had any
PUSH = 0.1  # rad: a push is kp times this on every joint, PUSHED s long every PUSH_EVERY s, to either side by turns
PUSHED, PUSH_EVERY = 0.3, 2.0
TOUCHING = 0.3  # share of the time that the lowest tip, as recorded, would be below the plane
FRICTION, STIFFNESS = 0.3, 2e3  # of the plane; N/m
TIMED = 500  # control periods


@dataclass(frozen=True)
class Simulator:
    """One that no model was trained in."""

    name: str
    robot: RobotSpec
    times: int = 1
    """Its control rate, in that of the recordings."""
    payload: float | None = None
    """kg in its hands, whatever the robot has in its own."""


def simulators_of(nominal: RobotSpec, laden: bool, folder: Path) -> Iterator[Simulator]:
    """Made from the nominal one; folder keeps the one whose MJCF is another; laden robots carry what it does not."""
    model = build_model(nominal)
    own = {f: getattr(model, f"dof_{f}") for f in ("damping", "frictionloss", "armature")}
    own |= {"kp": nominal.kp, "kd": nominal.kd}
    for name, factors in (CHANGES | FAR).items():
        both = factors | ({"kd": factors["damping"]} if "damping" in factors else {})
        yield Simulator(name, replace(nominal, **{f: x * own[f] for f, x in both.items()}, nominal=nominal))
    yield Simulator(PAYLOAD, nominal, payload=0.0 if laden else EXTRA)
    yield Simulator(FASTER, nominal, times=2)
    if not (folder / "robot.toml").is_file():
        save_robot(nominal, folder)
        xml = (folder / "robot.xml").read_text(encoding="utf-8")
        write_text(folder / "robot.xml", re.sub(r'integrator="\w+"', 'integrator="Euler"', xml))
    yield Simulator(EULER, replace(load_robot(folder), nominal=nominal))


def simulator_of(reference: Reference) -> RobotSpec:
    """The simulator that a model corrects, or itself."""
    return reference.simulator() if isinstance(reference, GapModel) else reference


def free_run(
    sequences: ListOf[Sequence],
    at: Simulator,
    reference: Reference | None = None,
    how: Inverse | Literal["as it is"] = "closed",
    disturbed: Disturbance = "",
    payload: Array | None = None,
    before: Callable[[AlignedSim, int], None] = lambda sim, t: None,
) -> Array:
    """Play commands from their first row, the longest first; positions (T, k, n free) rad at their rows.

    Args:
        sequences: Recordings of one rate.
        at: The simulator.
        reference: What it is to move like; None for the simulator itself.
        how: The way of transfer; or the network as it is, whatever simulator it was trained in.
        disturbed: What happens besides.
        payload: kg that the reference carries, (k,); default the recordings'.
        before: Called before each period of the recordings.
    """
    first = sequences[0]
    robot = on_plane(at.robot, sequences) if disturbed == "plane" else at.robot
    payload = np.array([s.meta.payload_mass for s in sequences]) if payload is None else payload
    given = None if how == "as it is" else reference
    sim = AlignedSim(
        robot, given, payload, first.meta.payload_side, first.dt / at.times, len(sequences), 0,
        idle_limbs(sequences, robot), extrapolate=True, simulator_payload=at.payload,
        inverse="probes" if how == "probes" else "closed",
    )  # fmt: skip
    loop = None
    if how == "as it is" and isinstance(reference, GapModel):
        loop = reference.loop(len(sequences))
    free = robot.index(sim.joint_names)
    ctrl = np.stack([s.ctrl[np.minimum(np.arange(len(first)), len(s) - 1)][:, free] for s in sequences], axis=1)
    qpos, qvel = (np.stack([getattr(s, name)[0, free] for s in sequences]) for name in ("qpos", "qvel"))
    sim.reset(qpos, qvel, ctrl[0])
    pushed = sim.sim.batch.bind("qfrc_applied")
    out = np.empty(ctrl.shape)
    for t, target in enumerate(ctrl):
        out[t] = sim.qpos
        before(sim, t)
        if disturbed == "push":
            pushed[:] = _push(t * first.dt) * PUSH * (robot.nominal or robot).kp[free]
        for _ in range(at.times):
            asked = target.copy()
            if loop is not None:
                asked[:, sim.op] += loop.delta(sim.qpos[:, sim.op], sim.qvel[:, sim.op], asked[:, sim.op], payload)
            sim.step(asked)
    return np.array(out[..., sim.op])


def recorded(sequences: ListOf[Sequence], robot: RobotSpec) -> Array:
    """What free_run gives of the robot itself; motions that end wait where they end."""
    rows = np.arange(len(sequences[0]))
    return np.stack([s.qpos[np.minimum(rows, len(s) - 1)][:, robot.operated_index] for s in sequences], axis=1)


def errors(sequences: ListOf[Sequence], run: Array, truth: Array) -> list[float]:
    """Mean |difference| of two runs in each motion, mrad."""
    apart = np.abs(run - truth)
    return [1e3 * float(apart[1 : len(s), i].mean()) for i, s in enumerate(sequences)]


def share(error: ListOf[float], base: ListOf[float]) -> Spread:
    """One error as a share of another, paired over motions, ± its standard error."""
    e, b = np.array(error), np.array(base)
    ratio = e.mean() / b.mean()
    spread = (e - ratio * b).std(ddof=1) / b.mean() / np.sqrt(len(e)) if len(e) > 1 else np.nan
    return Spread(float(ratio), float(spread), len(e))


def on_plane(robot: RobotSpec, sequences: ListOf[Sequence]) -> RobotSpec:
    """The robot on a plane so high that its tips, as recorded, would be below it TOUCHING of the time."""
    nominal = robot.nominal or robot
    tips = robot.tips or tuple(Tip(m.body, m.pos, 0.03) for m in robot.payload_mounts)
    model = build_model(replace(nominal, tips=tips, table=Plane(0.0, FRICTION, STIFFNESS)))
    data, lowest = mujoco.MjData(model), []
    for s in sequences:
        for q in s.qpos[::25]:
            data.qpos[:] = q
            mujoco.mj_kinematics(model, data)
            lowest.append(min(data.geom(f"{TABLE}_tip_{i}").xpos[2] - tip.radius for i, tip in enumerate(tips)))
    return replace(robot, tips=tips, table=Plane(float(np.quantile(lowest, TOUCHING)), FRICTION, STIFFNESS))


def microseconds(sequence: Sequence, at: Simulator, ways: ListOf[tuple[Reference | None, Inverse]]) -> list[float]:
    """Median times of a control period of one robot on one thread, simulation and all, of each way in turns."""
    meta, locked = sequence.meta, idle_limbs([sequence], at.robot)
    sims = [
        AlignedSim(
            at.robot, like, meta.payload_mass, meta.payload_side, sequence.dt, None, 1, locked, True, inverse=how
        )
        for like, how in ways
    ]
    free = at.robot.index(sims[0].joint_names)
    for sim in sims:
        sim.reset(sequence.qpos[0, free], 0.0, sequence.ctrl[0, free])
    took = np.empty((min(TIMED, len(sequence)), len(sims)))
    for row, target in zip(took, sequence.ctrl[:, free], strict=False):
        for i, sim in enumerate(sims):
            began = time.perf_counter()
            sim.step(target)
            row[i] = time.perf_counter() - began
    return [1e6 * float(x) for x in np.median(took, axis=0)]


def _push(t: float) -> float:
    count, since = divmod(t, PUSH_EVERY)
    return (-1.0 if count % 2 else 1.0) if since >= PUSH_EVERY - PUSHED else 0.0
