"""Good logs of a virtual arm, and faults to put into them, one at a time, before they are
imported.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import mujoco
import numpy as np
from logs import write_sage

from gaponet.base.errors import GAPONetError
from gaponet.data.doctor import DoctorResult
from gaponet.data.importer import ImportRequest, import_logs
from gaponet.robot.spec import RobotSpec
from gaponet.sim.dynamics import dynamics_of, gravity_of
from gaponet.sim.model import build_model

SECONDS = 24.0  # of a motion
DELAY = 2  # periods until a command arrives
MASSES = (0.0, 0.0, 0.0, 0.2, 0.2, 0.2)


@dataclass(frozen=True)
class Recording:
    """One log before it is written; arrays (T, n)."""

    motion: str
    payload: float
    time: np.ndarray
    ctrl: np.ndarray
    qpos: np.ndarray
    qvel: np.ndarray
    tau: np.ndarray

    def change(self, j: int | slice, **how: Callable[[np.ndarray], np.ndarray]) -> Recording:
        """With columns j of some channels changed."""
        changed = {}
        for name, function in how.items():
            values = getattr(self, name).copy()
            values[:, j] = function(values[:, j])
            changed[name] = values
        return replace(self, **changed)


def commands(robot: RobotSpec, seed: int) -> np.ndarray:
    """From posture to posture with rests of a second, and a faster sine at the end, (T, n) rad."""
    rng = np.random.default_rng(seed)
    dt = robot.dt
    low, high = np.clip(robot.qpos_range.T, -1.2, 1.2) * 0.8
    at = robot.qpos_home.copy()
    parts = []
    while sum(map(len, parts)) * dt < SECONDS - 6:
        goal = np.where(
            np.isin(robot.joint_names, robot.operated), rng.uniform(low, high), robot.qpos_home
        )
        s = np.linspace(0, 1, round(rng.uniform(1.0, 2.0) / dt))[:, None]
        parts += [
            at + (goal - at) * (10 * s**3 - 15 * s**4 + 6 * s**5),
            np.repeat(goal[None], round(1 / dt), axis=0),
        ]
        at = goal
    t = np.arange(round(6 / dt))[:, None] * dt
    wave = (
        0.2
        * np.sin(2 * np.pi * (0.5 + 0.1 * (np.arange(len(at)) % 5)) * t)
        * np.isin(robot.joint_names, robot.operated)
    )
    return np.concatenate([*parts, np.clip(at + wave, *robot.qpos_range.T)])


def recordings(robot: RobotSpec, kp: float = 0.9) -> list[Recording]:
    """What an arm with softer motors, more friction, a delay and noise does under some motions."""
    found = []
    for seed, mass in enumerate(MASSES):
        model = build_model(robot, mass)
        model.actuator_gainprm[:, 0] *= kp
        model.actuator_biasprm[:, 1] *= kp
        model.dof_frictionloss *= 1.3
        data = mujoco.MjData(model)
        rng = np.random.default_rng(seed + 100)
        ctrl = commands(robot, seed)
        data.qpos[:] = ctrl[0]
        state = []
        for t in range(len(ctrl)):
            mujoco.mj_forward(model, data)
            state.append((data.qpos.copy(), data.qvel.copy(), data.actuator_force.copy()))
            data.ctrl[:] = ctrl[max(t - DELAY, 0)]
            mujoco.mj_step(model, data, robot.decimation)
        qpos, qvel, tau = (np.array(x) for x in zip(*state, strict=True))
        read = [
            x + size * rng.standard_normal(x.shape)
            for x, size in ((qpos, 3e-4), (qvel, 5e-3), (tau, 5e-3))
        ]
        found.append(
            Recording(f"m{seed}", mass, 0.5 + robot.dt * np.arange(len(ctrl)), ctrl, *read)
        )
    return found


def examine(
    robot: RobotSpec,
    logs: list[Recording],
    folder: Path,
    damage: Callable[[Path], None] | None = None,
    gain: float | None = None,
    logs_toml: str = "",
) -> DoctorResult | GAPONetError:
    """Write the logs, import them and call the doctor; an import that refuses is an answer as
    well.
    """
    for log in logs:
        place = folder / f"{log.payload:g}" / "real" / robot.name / "tests" / log.motion
        write_sage(place, log.ctrl, log.qpos, log.tau, robot.joint_names, 1e6 * log.time, log.qvel)
    if damage is not None:
        damage(folder)
    try:
        for mass in dict.fromkeys(log.payload for log in logs):
            (folder / f"{mass:g}" / "logs.toml").write_text(logs_toml)
            kp = (
                ()
                if gain is None
                else tuple(
                    f"{n}={gain * k}"
                    for n, k in zip(robot.joint_names, robot.servo.kp, strict=True)
                )
            )
            report = import_logs(
                folder / f"{mass:g}",
                robot,
                folder / "data",
                ImportRequest(unit_id="a", payload_mass=mass, kp=kp),
            )
        models = {"gravity_model": gravity_of(robot), "dynamics_model": dynamics_of(robot)}
        return DoctorResult.of(report.dataset, robot, **models)
    except GAPONetError as error:
        return error


def all_of(logs: list[Recording], change: Callable[[Recording], Recording]) -> list[Recording]:
    """The same fault in every log."""
    return [change(log) for log in logs]


def one_of(
    logs: list[Recording], change: Callable[[Recording], Recording], which: int = 2
) -> list[Recording]:
    """A fault in one log."""
    return [change(log) if i == which else log for i, log in enumerate(logs)]


def cut_at_a_row(folder: Path) -> None:
    """Cut a file at the end of a row: what was written last is a whole row."""
    file = sorted(folder.rglob("state_motor.csv"))[2]
    text = file.read_text()
    file.write_text(text[: text.index("\n", len(text) * 2 // 3) + 1])


def rotated(log: Recording) -> Recording:
    """All channels with the arm's joints in another order than the list says."""
    turned = {f: getattr(log, f).copy() for f in ("ctrl", "qpos", "qvel", "tau")}
    for values in turned.values():
        values[:, ARM] = np.roll(values[:, ARM], 1, axis=1)
    return replace(log, **turned)


def peak(x: np.ndarray) -> float:
    """Largest size."""
    return float(np.abs(x).max())


def delayed(x: np.ndarray, rows: int = 5) -> np.ndarray:
    """The same some rows later."""
    return np.concatenate([np.repeat(x[:1], rows, axis=0), x[:-rows]])


def at(
    rows: slice, values: Callable[[np.ndarray], np.ndarray] | float
) -> Callable[[np.ndarray], np.ndarray]:
    """Other values in some rows."""

    def change(x: np.ndarray) -> np.ndarray:
        x = x.copy()
        x[rows] = values(x[rows]) if callable(values) else values
        return x

    return change


ARM = [0, 1, 2, 3, 4]  # of an SO-101
J = 2  # a joint that carries weight
EVERY = slice(None)
FAULTS: dict[str, tuple[Callable[[list[Recording]], list[Recording]], dict[str, object]]] = {
    "sign of command and state": (
        lambda logs: all_of(
            logs,
            lambda g: g.change(J, **dict.fromkeys(("ctrl", "qpos", "qvel", "tau"), np.negative)),
        ),
        {},
    ),
    "offset of 20 mrad": (
        lambda logs: all_of(logs, lambda g: g.change(J, qpos=lambda x: x + 0.02)),
        {},
    ),
    "offset of 150 mrad": (
        lambda logs: all_of(logs, lambda g: g.change(J, qpos=lambda x: x + 0.15)),
        {},
    ),
    "lag of 100 ms more": (
        lambda logs: all_of(logs, lambda g: g.change(EVERY, qpos=delayed, qvel=delayed)),
        {},
    ),
    "lag of one joint": (
        lambda logs: all_of(logs, lambda g: g.change(J, qpos=delayed, qvel=delayed)),
        {},
    ),
    "scale of 1.2": (lambda logs: all_of(logs, lambda g: g.change(J, qpos=lambda x: 1.2 * x)), {}),
    "spike of a state": (
        lambda logs: one_of(
            logs, lambda g: g.change(J, qpos=at(slice(400, 401), lambda x: x + 0.5))
        ),
        {},
    ),
    "frozen channel": (
        lambda logs: one_of(logs, lambda g: g.change(J, qpos=at(slice(0, 400), lambda x: x[:1]))),
        {},
    ),
    "command and state swapped in one": (
        lambda logs: one_of(logs, lambda g: replace(g, ctrl=g.qpos, qpos=g.ctrl)),
        {},
    ),
    "two robots in one": (
        lambda logs: one_of(logs, lambda g: g.change(J, qpos=lambda x: x + 0.1)),
        {},
    ),
    "wrong gains": (list, {"gain": 2.0}),
    "wrong payload label": (lambda logs: one_of(logs, lambda g: replace(g, payload=0.2)), {}),
    "joint order": (lambda logs: all_of(logs, rotated), {}),
    "zero of command and state": (
        lambda logs: all_of(
            logs, lambda g: g.change(J, ctrl=lambda x: x - 0.6, qpos=lambda x: x - 0.6)
        ),
        {},
    ),
    "torque of the other sign": (
        lambda logs: all_of(logs, lambda g: g.change(J, tau=lambda x: -x)),
        {},
    ),
    "quantised": (
        lambda logs: all_of(logs, lambda g: g.change(EVERY, qpos=lambda x: np.round(x, 2))),
        {},
    ),
    "saturated torque": (
        lambda logs: all_of(
            logs, lambda g: g.change(J, tau=lambda x: np.clip(x, -peak(x) / 2, peak(x) / 2))
        ),
        {},
    ),
    "saturated command": (
        lambda logs: all_of(logs, lambda g: g.change(J, ctrl=lambda x: np.clip(x, -0.4, 0.4))),
        {},
    ),
    "truncated at a row's end": (list, {"damage": cut_at_a_row}),
}
