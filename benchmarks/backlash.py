"""Backlash on VIRTUAL robots: right verdicts, widths and errors, with and without a play hinge.

    python benchmarks/backlash.py OUT.jsonl --robots 12 --first 0     # resumes
    python benchmarks/backlash.py OUT.jsonl --robots 12 --hinge

The robots are plain MuJoCo models. Backlash is a hinge of its own with a range of ± b/2 between the motor (armature,
damping, friction) and the link, or a spring stands there. The encoder is on the link. One or two joints hang under
gravity, or turn without it. Ten motions of 4 s are fitted and validated, four test.

With --hinge, forms for plain MuJoCo are compared with gaponet's own simulation of the same gap instead: without a gap,
and with a play hinge. Its servo reads the motor (also with the best offset), or the link by code in every step.
"""

from __future__ import annotations

import argparse
import tempfile
from dataclasses import dataclass, replace
from pathlib import Path

import mujoco
import numpy as np
from by_seed import Row, measure_seeds, plus_minus, print_table

from gaponet.data.sequence import Sequence, SequenceMeta
from gaponet.robot.servo_fields import Term
from gaponet.robot.spec import RobotSpec, load_robot
from gaponet.sim.batch import Batch
from gaponet.sim.model import STIFF_MOBILITY, STIFF_SOLIMP, STIFF_SOLREF, build_model
from gaponet.sim.replay import motion_errors, replay
from gaponet.sysid.identify import identify
from gaponet.sysid.options import IdentifyOptions

DT, H = 0.01, 5e-4  # s: of the logs, of the true robot's physics
MOTIONS, FITTED, VALIDATED, SECONDS = 14, 6, 10, 4.0
COUNT_RAD, NOISE_RAD = 2 * np.pi / 4096, 2e-4


@dataclass(frozen=True)
class PlayRobot:
    """VIRTUAL robot of n joints; arrays (n,) in SI units."""

    seed: int
    gravity: bool
    mass: np.ndarray
    length: np.ndarray
    kp: np.ndarray
    damping: np.ndarray
    friction: np.ndarray
    stribeck: np.ndarray
    armature: np.ndarray
    delay: float
    backlash: np.ndarray
    grease: float = 0.0  # friction inside the gap, over the motor's
    spring: float = 0.0  # stiffness between motor and link instead of a gap, over kp
    motor_encoder: bool = False  # else the encoder is on the link

    @classmethod
    def draw(cls, seed: int, backlash: bool, joints: int | None = None) -> PlayRobot:
        """Draw the robot of a seed; the same robot with and without backlash."""
        rng = np.random.default_rng([seed, 77])
        n = joints or 1 + seed % 2
        mass, length = rng.uniform(0.05, 0.3, n), rng.uniform(0.1, 0.25, n)
        own = mass * length**2 / 3
        inertia = np.array(
            [
                (mass[i:] * length[i:] ** 2).sum() / 3 + 0.5 * mass[i + 1 :].sum() * length[i] ** 2
                for i in range(n)
            ]
        )
        armature = own * np.exp(rng.uniform(np.log(0.2), np.log(3.0), n))
        pace = rng.uniform(12, 35, n)
        kp = (inertia + armature) * pace**2
        return cls(
            seed, bool(seed // 2 % 2), mass, length, kp, 2 * rng.uniform(0.3, 1.0, n) * pace * (inertia + armature),
            kp * np.exp(rng.uniform(np.log(1e-3), np.log(1e-2), n)),
            (rng.random() < 0.5) * kp * rng.uniform(0, 5e-3, n),
            armature, float(rng.uniform(0, 0.02)),
            backlash * np.exp(rng.uniform(np.log(3e-3), np.log(2e-2), n)),
        )  # fmt: skip

    def xml(self, true: bool) -> str:
        """Return the MJCF, of the true robot with motors and play hinges, else of a vendor with wrong numbers."""
        axis = "0 1 0" if self.gravity else "0 0 1"
        along = "0 0 -{0}" if self.gravity else "{0} 0 0"
        text, ends, at = "", "", "0 0 0"
        for i in range(len(self.mass)):
            geom = (f'<geom type="capsule" fromto="0 0 0 {along.format(self.length[i])}" size="0.01" '
                    f'mass="{self.mass[i]}" contype="0" conaffinity="0"/>')  # fmt: skip
            if true and (self.backlash[i] > 0 or self.spring):
                half = self.backlash[i] / 2
                between = f'range="{-half} {half}" limited="true" frictionloss="{self.grease * self.friction[i]}"'
                if self.spring:  # damped to a fiftieth
                    stiffness = self.spring * self.kp[i]
                    wear = 0.04 * np.sqrt(stiffness * self.mass[i] / 3) * self.length[i]
                    between = f'stiffness="{stiffness}" damping="{wear}" limited="false"'
                text += (f'<body name="m{i}" pos="{at}">'
                         '<inertial pos="0 0 0" mass="1e-6" diaginertia="1e-9 1e-9 1e-9"/>'
                         f'<joint name="j{i}" axis="{axis}" armature="{self.armature[i]}" damping="{self.damping[i]}"/>'
                         f'<body name="b{i}"><joint name="p{i}" axis="{axis}" {between} '
                         f'solreflimit="{2 * H} 1" solimplimit="0.99 0.999 1e-4"/>{geom}')  # fmt: skip
                ends += "</body></body>"
            else:
                factor = 1.0 if true else 0.7
                text += (f'<body name="b{i}" pos="{at}"><joint name="j{i}" axis="{axis}" range="-1.6 1.6" '
                         f'armature="{factor * self.armature[i]}" '
                         f'damping="{factor * self.damping[i]}"/>{geom}')  # fmt: skip
                ends += "</body>"
            at = along.format(self.length[i])
        return (f'<mujoco><compiler angle="radian" autolimits="true"/><option integrator="implicitfast" '
                f'timestep="{H if true else DT / 5}"/><worldbody>{text}{ends}</worldbody></mujoco>')  # fmt: skip

    def spec(self) -> RobotSpec:
        """Return the vendor's robot folder as a robot."""
        folder = Path(tempfile.mkdtemp()) / f"play{self.seed}"
        folder.mkdir()
        (folder / "robot.xml").write_text(self.xml(False))
        joints = "".join(
            f'[[joint]]\nname = "j{i}"\nkp = {0.8 * self.kp[i]}\neffort_limit = {100 * self.kp[i]}\n'
            for i in range(len(self.kp))
        )
        (folder / "robot.toml").write_text(
            f'name = "play{self.seed}"\ndt = {DT}\ntimestep = {DT / 5}\n{joints}'
        )
        return load_robot(folder)

    def commands(self, number: int, seconds: float = SECONDS) -> np.ndarray:
        """Return targets of a motion, (T, n) rad: sines, slow ways with rests, steps, fast reversals."""
        rng, n = np.random.default_rng([self.seed, number, 5]), len(self.kp)
        t = np.arange(round(seconds / DT))[:, None] * DT
        kind = number % 4
        if kind in (0, 3):
            paces = rng.uniform(0.2, 0.8, (3, n)) * (1 if kind == 0 else 4)
            waves = np.sin(2 * np.pi * paces * t[:, None] + rng.uniform(0, 6, (3, n)))
            return (0.5 if kind == 0 else 0.12) * waves.mean(axis=1) + rng.uniform(-0.2, 0.2, n)
        knots = rng.uniform(-0.5, 0.5, (7, n))
        at = np.clip(t / seconds * 6, 0, 5.999)
        i, s = at.astype(int)[:, 0], at % 1
        s = np.clip(s / (0.6 if kind == 1 else 0.02), 0, 1)
        return knots[i] + (knots[i + 1] - knots[i]) * (10 * s**3 - 15 * s**4 + 6 * s**5) * (
            1.0 if kind == 1 else 0.4
        )

    def record(self, ctrl: np.ndarray, names: list[str]) -> list[Sequence]:
        """Simulate motions (m, T, n) rad and log them."""
        model, n = mujoco.MjModel.from_xml_string(self.xml(True)), len(self.kp)
        model.dof_solref[:] = [2.5 * H, 1.0]
        model.dof_solimp[:] = [0.9999, 0.9999, 0.001, 0.5, 2.0]
        batch = Batch(model, nsim=len(ctrl), nthread=1)
        qpos, qvel, applied = (batch.bind(name) for name in ("qpos", "qvel", "qfrc_applied"))
        friction = batch.expand("dof_frictionloss")
        motor = np.array([model.joint(f"j{i}").dofadr[0] for i in range(n)])
        gap = (self.backlash > 0) | bool(self.spring)  # the play hinge of a joint is the next one
        friction[:, motor + gap] = self.grease * self.friction
        qpos[:, motor], friction[:, motor] = ctrl[:, 0], self.friction
        each, late, rows = round(DT / H), round(self.delay / H), ctrl.shape[1]
        link, seen = np.zeros(ctrl.shape), gap & (not self.motor_encoder)
        for t in range(-50, rows):
            for part in range(each):
                q = qpos[:, motor] + seen * qpos[:, motor + gap]
                if t >= 0 and part == 0:
                    link[:, t] = q
                target = ctrl[:, min(max((t * each + part - late) // each, 0), rows - 1)]
                if self.stribeck.any():
                    friction[:, motor] = self.friction + self.stribeck / (
                        1 + (qvel[:, motor] / 0.05) ** 2
                    )
                applied[:, motor] = self.kp * (target - q)
                batch.step()
        return [
            self.log(c, q, name, i)
            for i, (c, q, name) in enumerate(zip(ctrl, link, names, strict=True))
        ]

    def log(self, ctrl: np.ndarray, qpos: np.ndarray, motion: str, number: int) -> Sequence:
        """Return the log of a motion, (T, n) rad each, with an encoder's noise and steps."""
        noise = np.random.default_rng([self.seed, number, 9]).standard_normal(qpos.shape)
        qpos = np.round((qpos + NOISE_RAD * noise) / COUNT_RAD) * COUNT_RAD
        meta = SequenceMeta(f"play{self.seed}", "a", motion, 0.0, virtual=True)
        names = tuple(f"j{i}" for i in range(len(self.kp)))
        return Sequence(meta, names, DT, ctrl, qpos, np.gradient(qpos, DT, axis=0))


def result(robot: PlayRobot, terms: tuple[Term, ...] | None = None) -> dict[str, object]:
    """Identify a robot from its logs; return widths, standard errors, the verdict and errors of new motions."""
    ctrl = np.stack([robot.commands(k) for k in range(MOTIONS)])
    logs, spec = robot.record(ctrl, [f"m{k:02}" for k in range(MOTIONS)]), robot.spec()
    fit = identify(
        logs[:FITTED],
        spec,
        logs[FITTED:VALIDATED],
        options=IdentifyOptions(terms=terms, table=False, folds=1),
    )
    return {
        "seed": robot.seed, "true_rad": robot.backlash.tolist(), "findings": fit.findings,
        "rad": fit.robot.servo.backlash[fit.robot.operated_index].tolist(),
        "std_rad": [fit.std[joint].get("backlash", 0.0) for joint in fit.robot.operated],
        "test_rad": motion_errors(logs[VALIDATED:], fit.robot).tolist(),
    }  # fmt: skip


def hinge_result(seed: int) -> dict[str, float]:
    """Return the error of each form of one joint with a gap, rad, from gaponet's simulation of it."""
    robot = replace(PlayRobot.draw(seed, True, joints=1), delay=0.0, stribeck=np.zeros(1))
    fields = ("kp", "damping", "armature", "backlash")
    servo = {f: float(getattr(robot, f)[0]) for f in fields} | {
        "frictionloss": float(robot.friction[0])
    }
    spec, none = robot.spec().with_identified({"j0": servo}), np.zeros(1)
    commands = [robot.commands(k) for k in range(MOTIONS - VALIDATED)]
    motions = [
        replace(robot.log(c, c, f"m{k}", k), qpos=0 * c + c[0], qvel=0 * c)
        for k, c in enumerate(commands)
    ]
    ours = np.array([one.qpos for one in replay(motions, spec)])
    plain = np.array([one.qpos for one in replay(motions, spec.with_servo(backlash=none))])
    model = build_model(spec)
    hinges = [
        np.array([play_hinge(robot, spec.timestep, m, model, link) for m in motions])
        for link in (False, True)
    ]
    forms = {"left out": plain, "motor read": hinges[0], "link read": hinges[1]}
    forms["motor read, best offset"] = hinges[0] - np.median(hinges[0] - ours)
    return {name: float(np.abs(path - ours)[:, 1:].mean()) for name, path in forms.items()}


def play_hinge(
    robot: PlayRobot, h: float, motion: Sequence, own: mujoco.MjModel, link: bool
) -> np.ndarray:
    """Play a motion with a play hinge in plain MuJoCo at a physics step of h s; return the link's path, (T, 1) rad."""
    model = mujoco.MjModel.from_xml_string(robot.xml(True))
    model.opt.timestep, model.opt.tolerance = h, own.opt.tolerance
    model.jnt_solref[1], model.dof_invweight0[:] = (2 * h, 1), STIFF_MOBILITY * model.dof_invweight0
    model.dof_solref[:], model.dof_solimp[:] = STIFF_SOLREF, STIFF_SOLIMP
    model.dof_frictionloss[:] = (robot.friction[0], 0.0)
    data, rest = mujoco.MjData(model), mujoco.MjData(own)
    rest.qpos[:] = motion.qpos[0]
    mujoco.mj_forward(own, rest)
    gap = np.copysign(robot.backlash[0] / 2, rest.qfrc_bias[0])
    data.qpos[:] = motion.qpos[0, 0] + gap, -gap
    path = np.array(motion.qpos, float)
    for t in range(len(path) - 1):
        for _ in range(round(DT / h)):
            data.qfrc_applied[0] = robot.kp[0] * (
                motion.ctrl[t, 0] - data.qpos[0] - link * data.qpos[1]
            )
            mujoco.mj_step(model, data)
        path[t + 1] = data.qpos.sum()
    return path


def verdicts(seed: int) -> Row:
    """Identify a robot with a gap, with and without the term, and the same robot without a gap."""
    gap, none = (PlayRobot.draw(seed, has) for has in (True, False))
    return {
        "with": result(gap),
        "left out": result(gap, ("stribeck", "load")),
        "no gap": result(none),
    }


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("out", type=Path)
    parser.add_argument("--robots", type=int, default=12)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--hinge", action="store_true")
    args = parser.parse_args()
    rows = measure_seeds(
        args.out,
        range(args.first, args.first + args.robots),
        hinge_result if args.hinge else verdicts,
    )
    lines: list[tuple[object, ...]] = []
    if args.hinge:
        for name in (n for n in rows[0] if n != "seed"):
            worse = sum(r[name] > r["left out"] for r in rows)
            lines.append((name, plus_minus(1e3 * r[name] for r in rows), f"{worse} of {len(rows)}"))
        print_table(("form in plain MuJoCo", "difference, mrad", "worse than left out"), lines)
        return
    for name in ("with", "left out", "no gap"):
        some = [r[name] for r in rows]
        joints, gaps = (
            sum(len(r["rad"]) for r in some),
            sum(bool(w) for r in some for w in r["rad"]),
        )
        inside = [abs(w - true) < 1.645 * std for r in some
                  for w, true, std in zip(r["rad"], r["true_rad"], r["std_rad"], strict=True) if w]  # fmt: skip
        error = plus_minus(1e3 * np.mean(r["test_rad"]) for r in some)
        lines.append((name, len(some), joints, gaps, f"{sum(inside)} of {len(inside)}", error))
    print_table(
        ("VIRTUAL robots", "robots", "joints", "gaps accepted", "inside 90 %", "error, mrad"), lines
    )


if __name__ == "__main__":
    main()
