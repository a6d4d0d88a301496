"""Link masses on VIRTUAL arms whose file is right or wrong: identify --masses beside a plain rival.

    python benchmarks/link_masses.py OUT.jsonl --robots 20 --first 100     # resumes

Arms have two joints. In a wrong file one link has 1 / 1.3 to 1 / 2 of the true mass, or its centre of mass 2 to 5 cm
away. Half of the arms are recorded with two payloads, half with none. Seven motions of 8 s are fitted and validated;
three new motions, and three with a payload that no fit has seen, test. The rivals are plain_fit.py with mass and centre
of mass of each link as four more parameters, and mujoco.sysid with its pseudo-inertia of each link as ten more
(where "mujoco[sysid]" is installed). With --torque, recordings hold the motors' torque, which only identify reads.
Its scale is wrong by 5 % in each joint (standard deviation), as torque constants are.
"""

from __future__ import annotations

import argparse
import contextlib
import importlib.util
import tempfile
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
from by_seed import Row, measure_seeds, plus_minus, print_table
from plain_fit import Problem, fit

from gaponet.data.sequence import Sequence, SequenceMeta
from gaponet.robot.spec import Link, RobotSpec, load_robot
from gaponet.sim.model import build_model, stiffen_friction
from gaponet.sim.replay import motion_errors
from gaponet.sysid.identify import identify
from gaponet.sysid.options import IdentifyOptions
from gaponet.virtual.physics import Physics, neutral
from gaponet.virtual.virtual_robot import VirtualRobot

JOINTS, DT, SECONDS, TRAIN, VALIDATION, TEST = 2, 0.02, 8.0, 4, 3, 3
SHIFT_M, LOG_MASS = 0.05, np.log(1.5)  # a large change of the rival's parameters
KNOWN = 0.7  # of the prior's standard deviation; a value with less is determined


def draw_arm(rng: np.random.Generator, folder: Path) -> tuple[RobotSpec, np.ndarray]:
    """Write a robot folder; return the robot and the torque that holds each stretched link, (n,) N·m."""
    lengths, masses = rng.uniform(0.12, 0.3, JOINTS), np.sort(rng.uniform(0.15, 1.2, JOINTS))[::-1]
    first = "0 0 1" if rng.random() < 0.3 else "0 1 0"
    bodies = ""
    for i, (length, mass) in enumerate(zip(lengths, masses, strict=True)):
        at, centre = (f"{lengths[i - 1]:.3f} 0 0" if i else "0 0 0"), length * rng.uniform(0.2, 0.9)
        bodies += (
            f'<body name="link{i}" pos="{at}"><joint name="j{i}" axis="{"0 1 0" if i else first}" range="-2.5 2.5"/>'
            f'<geom type="capsule" fromto="0 0 0 {length:.3f} 0 0" size="0.02" mass="{0.6 * mass:.3f}"/>'
            f'<geom type="box" pos="{centre:.3f} 0 {rng.uniform(-0.02, 0.02):.3f}" size="0.03 0.02 0.02" '
            f'mass="{0.4 * mass:.3f}"/>'
        )
    hold = np.array([
        9.81 * sum(masses[k] * (lengths[i:k].sum() + lengths[k] / 2) for k in range(i, JOINTS)) for i in range(JOINTS)
    ])  # fmt: skip
    kp = np.round(hold / rng.uniform(0.03, 0.1, JOINTS), 1)
    folder.mkdir(parents=True)
    (folder / "robot.xml").write_text(
        '<mujoco><compiler angle="radian" autolimits="true"/><option integrator="implicitfast"/><default>'
        '<geom contype="0" conaffinity="0"/><joint damping="0" armature="0.01" frictionloss="0"/></default><worldbody>'
        f"{bodies}{'</body>' * JOINTS}</worldbody></mujoco>"
    )
    joints = "".join(
        f'[[joint]]\nname="j{i}"\nkp={kp[i]}\nkd={0.03 * kp[i]:.3f}\neffort_limit={6 * hold[i]:.2f}\n'
        for i in range(JOINTS)
    )
    (folder / "robot.toml").write_text(
        f'name="arm"\ndt={DT}\ntimestep=0.005\n{joints}'
        f'[[payload_mount]]\nside="hand"\nbody="link{JOINTS - 1}"\npos=[{lengths[-1]:.3f},0.0,0.0]\n'
    )
    return load_robot(folder), np.maximum(hold, 0.3 * hold.max())


def draw_physics(
    rng: np.random.Generator, robot: RobotSpec, hold: np.ndarray, wrong: bool
) -> Physics:
    """Draw servos that differ from the file, and one link that does, if the file is to be wrong."""
    n, one = JOINTS, np.ones(JOINTS)
    physics = replace(
        neutral(n), kp_scale=np.exp(0.15 * rng.standard_normal(n)), kd_scale=np.exp(0.3 * rng.standard_normal(n)),
        friction=hold * rng.uniform(0.02, 0.1, n), damping=robot.servo.kp * rng.uniform(0, 0.03, n),
        delay=np.full(1, rng.uniform(0.01, 0.04)), zero_offset=0.005 * rng.standard_normal(n),
        encoder_step=0.0015 * one, velocity_noise=0.02 * one, encoder_noise=2e-4 * one,
    )  # fmt: skip
    if not wrong:
        return physics
    upright = bool(build_model(robot).jnt_axis[0][2])  # gravity does not see the first link
    link, change = int(rng.integers(1 if upright else 0, n)), np.zeros(n)
    if rng.random() < 0.5:
        change[link] = rng.uniform(0.3, 1.0)
        return replace(physics, mass_scale=one + change)
    change[link] = rng.uniform(0.02, 0.05) * rng.choice([-1, 1])
    return replace(physics, com_x=change) if rng.random() < 0.7 else replace(physics, com_z=change)


def record(
    rng: np.random.Generator,
    robot: RobotSpec,
    physics: Physics,
    name: str,
    payloads: list[float],
    torque_scale: np.ndarray | None,
) -> list[Sequence]:
    """Record one motion for each of the payloads, kg; with torque where its scale (n,) is given."""
    rows, count = round(SECONDS / DT), len(payloads)
    t = DT * np.arange(rows)[:, None]
    ctrl = np.zeros((count, rows, JOINTS))
    for one in ctrl:
        waves = (
            np.sin(2 * np.pi * rng.uniform(0.05, f, JOINTS) * t + rng.uniform(0, 6, JOINTS))
            for f in (0.2, 0.5, 0.9)
        )
        one[:] = rng.uniform(-1, 1, JOINTS) + sum(
            rng.uniform(0.1, 0.5, JOINTS) * wave for wave in waves
        )
    ctrl = ctrl.clip(-2, 2)
    units = VirtualRobot(robot, [physics] * count, [(mass, "both") for mass in payloads])
    units.reset(ctrl[:, 0], rng.integers(0, 1 << 30, count).tolist())
    qpos, qvel, tau = np.zeros((3, count, rows, JOINTS))
    for row in range(rows):
        now = units.read()
        qpos[:, row], qvel[:, row], tau[:, row] = now.qpos, now.qvel, now.tau
        units.step(ctrl[:, row])
    tau = tau if torque_scale is None else (torque_scale * tau).astype(np.float32)
    return [
        Sequence(
            joint_names=robot.joint_names, qpos=qpos[i].astype(np.float32), qvel=qvel[i].astype(np.float32),
            ctrl=ctrl[i].astype(np.float32), tau=None if torque_scale is None else tau[i], dt=DT,
            meta=SequenceMeta(robot="arm", motion=f"{name}{i}", unit_id="u", payload_mass=payloads[i], virtual=True),
        )
        for i in range(count)
    ]  # fmt: skip


class MassProblem(Problem):
    """Plain fit of servos with log mass and centre of mass of each link, (6 n + 4 L,)."""

    def __init__(self, sequences: list[Sequence], robot: RobotSpec) -> None:
        super().__init__(sequences, robot)
        self.bodies = [f"link{i}" for i in range(JOINTS)]
        size = 4 * len(self.bodies)
        self.start = np.r_[self.start, np.zeros(size)]
        self.low, self.high = (
            np.r_[self.low, np.full(size, -3.0)],
            np.r_[self.high, np.full(size, 3.0)],
        )

    def servos(self, x: np.ndarray, window: int) -> dict[str, np.ndarray]:
        """Return the servos' values in a window."""
        return super().servos(x[: 6 * JOINTS], window)

    def changed(self, x: np.ndarray, window: int, model: mujoco.MjModel) -> mujoco.MjModel:
        """Return a copy of a window's model with these parameters."""
        one = super().changed(x, window, model)
        for name, (mass, *shift) in zip(self.bodies, x[6 * JOINTS :].reshape(-1, 4), strict=True):
            body, scale = one.body(name), np.exp(LOG_MASS * mass)
            body.mass[:], body.inertia[:] = scale * body.mass, scale * body.inertia
            body.ipos[:] += SHIFT_M * np.array(shift)
        mujoco.mj_setConst(one, mujoco.MjData(one))
        stiffen_friction(one)
        return one

    def robot_with(self, x: np.ndarray) -> RobotSpec:
        """Return the robot with fitted servos and links."""
        model = self.changed(x, 0, self.specs[0].compile())
        return replace(super().robot_with(x[: 6 * JOINTS]), links=links_of(model, self.bodies))


def links_of(model: mujoco.MjModel, names: list[str]) -> dict[str, Link]:
    """Return masses, centres and inertias of a model's bodies."""
    links = {}
    for name in names:
        body, turn = model.body(name), np.zeros(9)
        mujoco.mju_quat2Mat(turn, body.iquat)
        full = turn.reshape(3, 3) @ np.diag(body.inertia) @ turn.reshape(3, 3).T
        numbers = (*np.diag(full), *full[[0, 0, 1], [1, 2, 2]])
        links[name] = Link(
            float(body.mass[0]), tuple(body.ipos.tolist()), tuple(map(float, numbers))
        )
    return links


def mujoco_sysid(sequences: list[Sequence], robot: RobotSpec) -> tuple[RobotSpec, np.ndarray]:
    """Fit servos and links with mujoco.sysid; return the robot, and its 90 % intervals of the masses, (L, 2) kg."""
    import mujoco_sysid as rival
    from mujoco import sysid

    problem, names = Problem(sequences, robot), [f"link{i}" for i in range(JOINTS)]
    with contextlib.redirect_stdout(None):
        params, result = rival.fit(problem, tuple(names))
    half = sysid.calculate_intervals([result.fun], result.jac, alpha=0.1)[1]
    spec, masses = problem.specs[0].copy(), []
    for i, name in enumerate(names):
        params[name].apply_modifier(spec)
        log_mass, by = params[name].value[0], half[6 * JOINTS + 10 * i]
        masses.append(np.exp(2 * np.array([log_mass - by, log_mass + by])))
    fitted = replace(
        problem.robot_with(params.as_vector()[: 6 * JOINTS]), links=links_of(spec.compile(), names)
    )
    return fitted, np.array(masses)


def play(seed: int, torque: bool) -> dict[str, Any]:
    """Identify one VIRTUAL arm in three ways; return errors, mrad, and what is known of the links."""
    wrong, loaded = seed % 2 == 1, seed // 2 % 2 == 1
    with tempfile.TemporaryDirectory() as folder:
        robot, hold = draw_arm(np.random.default_rng([seed, 1]), Path(folder) / "arm")
        physics, rng = (
            draw_physics(np.random.default_rng([seed, 2]), robot, hold, wrong),
            np.random.default_rng([seed, 3]),
        )
        heavy = round(0.1 * float(hold[-1]), 2)
        loads = [0.0, heavy] if loaded else [0.0]
        scale = (
            np.exp(0.05 * np.random.default_rng([seed, 4]).standard_normal(JOINTS))
            if torque
            else None
        )
        train, validation, test = (
            record(rng, robot, physics, name, [loads[i % len(loads)] for i in range(count)], scale)
            for name, count in (("train", TRAIN), ("validation", VALIDATION), ("test", TEST))
        )
        payload = record(rng, robot, physics, "payload", [2 * heavy] * TEST, scale)
        row: dict[str, Any] = {
            "seed": seed,
            "wrong": wrong,
            "payloads": len(loads),
            "test": {},
            "new payload": {},
            "s": {},
        }

        def judge(name: str, fitted: RobotSpec, seconds: float) -> None:
            for key, motions in (("test", test), ("new payload", payload)):
                row[key][name] = 1e3 * float(motion_errors(motions, fitted).mean())
            row["s"][name] = seconds

        judge("file", robot, 0.0)
        for name, masses in (("identify", False), ("identify --masses", True)):
            began = time.process_time()
            made = identify(
                train, robot, validation, options=IdentifyOptions(table=False, masses=masses)
            )
            judge(name, made.robot, time.process_time() - began)
        began = time.process_time()
        judge(
            "plain, masses",
            fit(MassProblem([*train, *validation], robot), 1),
            time.process_time() - began,
        )
        nominal = build_model(robot)
        mass = np.array(
            [nominal.body(f"link{i}").mass[0] * physics.mass_scale[i] for i in range(JOINTS)]
        )
        if importlib.util.find_spec("colorama"):  # of mujoco[sysid]
            began = time.process_time()
            fitted, low_high = mujoco_sysid([*train, *validation], robot)
            judge("mujoco.sysid", fitted, time.process_time() - began)
            row["mujoco.sysid masses inside"] = int(
                ((low_high[:, 0] < mass) & (mass < low_high[:, 1])).sum()
            )
            row["mujoco.sysid mass error"] = [
                fitted.links[f"link{i}"].mass / mass[i] - 1 for i in range(JOINTS)
            ]
        row["accepted"] = made.links is not None
        if made.links is not None:
            _, now, std, prior = (x[:, :4] for x in made.links.moments())
            row["mass error"] = (now[:, 0] / mass - 1).tolist()
            row["masses inside"] = int((np.abs(now[:, 0] - mass) < 1.645 * std[:, 0]).sum())
            true = np.stack([mass, physics.com_x, physics.com_y, physics.com_z], axis=1)
            known = std < KNOWN * prior
            row["inside"], row["known"] = (
                int((np.abs(now - true) < 1.645 * std)[known].sum()),
                int(known.sum()),
            )
    return row


def table(rows: list[Row]) -> None:
    """Print errors of both payloads, verdicts and intervals, by kind of file and payloads."""
    kinds = [(wrong, payloads) for wrong in (False, True) for payloads in (1, 2)]
    groups = [[r for r in rows if (r["wrong"], r["payloads"]) == kind] for kind in kinds]
    titles = [
        f"{'wrong' if wrong else 'right'} file, {payloads} payload(s)" for wrong, payloads in kinds
    ]
    for key in ("test", "new payload"):
        lines = [
            (n, *(plus_minus(r[key][n] for r in some) for some in groups)) for n in rows[0][key]
        ]
        print_table((f"mrad, {key}", *titles), lines)
    lines = [
        ("arms", *map(len, groups)),
        ("--masses accepted", *(sum(r["accepted"] for r in some) for some in groups)),
    ]
    fitted = {
        "masses inside": [[r for r in g if r["accepted"]] for g in groups],
        "mujoco.sysid masses inside": groups,
    }
    for name, some in fitted.items():
        lines.append(
            (
                f"{name} 90 %",
                *(f"{sum(r.get(name, 0) for r in g)} of {JOINTS * len(g)}" for g in some),
            )
        )
    sums = [[sum(r.get(k, 0) for r in some) for k in ("inside", "known")] for some in groups]
    print_table(
        ("number", *titles), [*lines, ("all values inside 90 %", *(f"{a} of {b}" for a, b in sums))]
    )
    seconds = {n: float(np.mean([r["s"][n] for r in rows])) for n in rows[0]["s"]}
    print("processor, s:", ", ".join(f"{n} {s:.1f}" for n, s in seconds.items()))


def main() -> None:
    """Play robots that are not in the file yet, then print the tables."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("out", type=Path)
    parser.add_argument("--robots", type=int, default=20)
    parser.add_argument("--first", type=int, default=100)
    parser.add_argument("--torque", action="store_true", help="record torque too")
    args = parser.parse_args()
    seeds = range(args.first, args.first + args.robots)
    table(measure_seeds(args.out, seeds, lambda seed: play(seed, args.torque)))


if __name__ == "__main__":
    main()
