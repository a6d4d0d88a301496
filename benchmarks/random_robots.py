"""Random robots for benchmarks: a vendor's file with errors, servos with random effects, and logs with noise.

A body is a public model of ../shared/robots/public (or GAPONET_DATA/../robots/public) if that folder exists, else an
arm, legs or a hand with random kinematics. Logs come from plain MuJoCo and `RandomRobot.play`; this module imports
nothing of gaponet. All of these robots are VIRTUAL.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path

import mujoco
import numpy as np

Array = np.ndarray

PUBLIC = {  # model → joints that are welded where it stands: slides, wheels, joints that a tendon moves
    "universal_robots_ur5e/ur5e.xml": (), "ufactory_xarm7/xarm7_nohand.xml": (), "unitree_go1/go1.xml": (),
    "boston_dynamics_spot/spot.xml": (), "wonik_allegro/right_hand.xml": (), "aloha/aloha.xml": ("finger",),
    "shadow_hand/right_hand.xml": ("FFJ1", "FFJ2", "MFJ1", "MFJ2", "RFJ1", "RFJ2", "LFJ1", "LFJ2"),
}  # fmt: skip
PACKAGED = Path(__file__).parents[1] / "src" / "gaponet" / "robot" / "robots"  # more names
RATES = (25, 30, 50, 60, 100, 125, 200, 240, 250, 500, 1000)  # Hz
# Not of the form that is fitted.
EFFECTS = ("stribeck", "load", "backlash", "dead_band", "speed", "saturation", "filter", "creep")
NUMBERS = 3e6  # of a log in all: at most so much is recorded
MOTIONS, SECONDS = 12, (120.0, 300.0)
SMALL, SLOW = 4, 60.0
STILL, FILE_ERRORS = 3, ("as drawn", "units", "damping", "armature", "still")
ARM = """<mujoco><compiler angle="radian" autolimits="true"/><option integrator="implicitfast"/>
<worldbody>{}</worldbody></mujoco>"""


@dataclass(frozen=True)
class Servo:
    """True servo parameters, (n) each: N·m/rad, N·m·s/rad, N·m, kg·m², rad, s; an effect with NaN or 0 is absent."""

    kp: Array
    kd: Array
    damping: Array
    friction: Array
    armature: Array
    offset: Array
    delay: Array
    limit: Array
    stribeck: Array
    stribeck_speed: Array
    load: Array
    backlash: Array
    dead_band: Array
    speed: Array
    filter: Array
    creeps: bool


@dataclass(frozen=True)
class LogNoise:
    """Errors of the logs: noise and encoder step, rad; fraction of dropped samples; sampling jitter, periods."""

    noise: float
    step: float
    dropped: float
    jitter: float
    velocity: bool
    torque: bool


@dataclass(frozen=True)
class Recording:
    """One log: time (k,) s; ctrl, qpos, qvel, tau (k, n); payload, kg."""

    motion: str
    payload: float
    time: Array
    ctrl: Array
    qpos: Array
    qvel: Array | None
    tau: Array | None

    def rows(self, keep: Array | slice) -> Recording:
        """Select rows."""
        columns = ("time", "ctrl", "qpos", "qvel", "tau")
        return replace(self, **{c: v[keep] for c in columns if (v := getattr(self, c)) is not None})

    def columns(self, joints: tuple[str, ...]) -> dict[str, Array]:
        """Return the log as columns of a table."""
        found = {"time": self.time}
        for name in ("ctrl", "qpos", "qvel", "tau"):
            if (values := getattr(self, name)) is not None:
                found |= {f"{name}.{joint}": values[:, j] for j, joint in enumerate(joints)}
        return found


@dataclass(frozen=True)
class RandomRobot:
    """Robot: body, true servos, the values of its file (`said`), rate and errors of its logs."""

    seed: int
    body: str
    spec: mujoco.MjSpec
    joints: tuple[str, ...]
    home: Array
    low: Array
    high: Array
    servo: Servo
    said: dict[str, Array]
    effects: tuple[str, ...]
    rate: float
    log_noise: LogNoise
    payload: float
    pace: float  # Hz, bandwidth of the slowest servo, which limits the motions
    bodies: tuple[str, ...] = field(default=())

    def model(self, payload: float = 0.0) -> mujoco.MjModel:
        """Compile the true robot with steps of 1 ms or a little less."""
        spec, servo = self.spec.copy(), self.servo
        period = 1 / self.rate
        spec.option.timestep = period / np.ceil(period / 1e-3)
        if payload:
            hand = spec.body(self.bodies[-1])
            hand.add_geom(
                type=mujoco.mjtGeom.mjGEOM_SPHERE,
                size=[0.02, 0, 0],
                mass=payload,
                contype=0,
                conaffinity=0,
            )
        for j, name in enumerate(self.joints):
            joint = spec.joint(name)
            joint.damping, joint.armature = (
                _like(joint.damping, servo.damping[j]),
                servo.armature[j],
            )
            joint.frictionloss = servo.friction[j]
            joint.solref_friction = [2.5 * spec.option.timestep, 1.0]
            # MuJoCo's own joints creep by milliradians a second where real ones stick
            if not servo.creeps:
                joint.solimp_friction = [0.9999, 0.9999, 0.001, 0.5, 2.0]
            _servo(spec, name, servo.kp[j], servo.kd[j], servo.limit[j])
        return spec.compile()

    def file(self) -> str:
        """Return the vendor's MJCF, whose gains differ from the true ones."""
        spec = self.spec.copy()
        for j, name in enumerate(self.joints):
            joint = spec.joint(name)
            joint.damping, joint.armature = (
                _like(joint.damping, self.said["damping"][j]),
                self.said["armature"][j],
            )
            _servo(spec, name, self.said["kp"][j], self.said["kd"][j], self.servo.limit[j])
        spec.compile()
        return spec.to_xml()

    def commands(self, number: int, seconds: float) -> Array:
        """Draw the commands of one motion, (T, n) rad: sines, moves between rests, steps, or a mixture."""
        rng, n = np.random.default_rng([self.seed, number, 1]), len(self.joints)
        t = np.arange(round(seconds * self.rate)) / self.rate
        room = np.minimum((self.high - self.low) / 2, 1.2)
        middle = np.clip(self.home, self.low + 0.55 * room, self.high - 0.55 * room)
        kind = ("sines", "ways", "steps", "mixed")[number % 4]
        found = np.tile(middle, (len(t), 1))
        if kind in ("sines", "mixed"):
            paces = self.pace * np.exp(rng.uniform(np.log(0.05), np.log(0.5), (3, n)))
            share = rng.dirichlet(np.ones(3), n).T * np.minimum(1, 0.25 * self.pace / paces)
            waves = np.sin(2 * np.pi * paces * t[:, None, None] + rng.uniform(0, 2 * np.pi, (3, n)))
            found += 0.5 * room * (share * waves).sum(axis=1) * np.minimum(1, t / 1.0)[:, None]
        if kind != "sines":
            together = kind != "mixed" and number % 8 < 6  # all joints rest at the same time
            times = rng.integers(1 << 30, size=n)
            for j in range(n):
                way = self._visits(
                    rng, np.random.default_rng(times[0 if together else j]), t, kind == "steps"
                )
                found[:, j] += (0.5 if kind == "ways" else 0.2) * room[j] * way
        return np.clip(found, self.low, self.high)

    def _visits(
        self, rng: np.random.Generator, clock: np.random.Generator, t: Array, jump: bool
    ) -> Array:
        """Draw moves between rests in −1 … 1; `rng` draws positions, `clock` times."""
        found, at, now = np.zeros(len(t)), 0.0, 0.0
        while now < t[-1]:
            rest, way = (
                clock.uniform(0.6, 2.5),
                0.0 if jump else clock.uniform(0.6, 2.0) * 2 / self.pace,
            )
            to = rng.uniform(-1, 1)
            s = np.clip((t - now - rest) / max(way, 1e-9), 0, 1)
            found = np.where(t >= now, at + (to - at) * (10 * s**3 - 15 * s**4 + 6 * s**5), found)
            at, now = to, now + rest + way
        return found

    def recordings(
        self, motions: int = MOTIONS, seconds: float | None = None
    ) -> Iterator[Recording]:
        """Yield the logs of all motions; every second one carries the payload, if there is one."""
        rng = np.random.default_rng([self.seed, 2])
        channels = 2 + self.log_noise.velocity + self.log_noise.torque
        most = min(NUMBERS / (self.rate * len(self.joints) * channels), rng.uniform(*SECONDS))
        each = max(most / MOTIONS, 5.0) if seconds is None else seconds / motions
        for number in range(motions):
            payload = self.payload if number % 2 else 0.0
            yield self.play(f"m{number:02}", self.commands(number, each), payload, number)

    def play(self, motion: str, ctrl: Array, payload: float, number: int) -> Recording:
        """Simulate a motion and log it."""
        model, servo, log_noise, n = (
            self.model(payload),
            self.servo,
            self.log_noise,
            len(self.joints),
        )
        data, h = mujoco.MjData(model), model.opt.timestep
        each = round(1 / self.rate / h)
        target = self._targets(ctrl, h, each)
        dof = np.array([model.joint(j).dofadr[0] for j in self.joints])
        at = np.array([model.joint(j).qposadr[0] for j in self.joints])
        data.qpos[at] = target[0]
        loses = servo.stribeck.any() or servo.load.any()
        states = np.zeros((len(target), 3, n), np.float32)
        for k, u in enumerate(target):
            q, v = data.qpos[at], data.qvel[dof]
            if servo.dead_band.any():
                e = u - q
                u = q + np.sign(e) * np.maximum(np.abs(e) - servo.dead_band, 0)
            if loses:
                more = servo.stribeck * np.exp(
                    -np.abs(v) / servo.stribeck_speed
                ) + servo.load * np.abs(data.actuator_force)
                model.dof_frictionloss[dof] = servo.friction + more
            states[k] = q, v, data.actuator_force
            data.ctrl[:] = u
            mujoco.mj_step(model, data)
        rng = np.random.default_rng([self.seed, number, 3])
        rows = np.arange(len(ctrl))
        jitter = (
            np.clip(
                rng.normal(0, log_noise.jitter / 2, len(rows)), -log_noise.jitter, log_noise.jitter
            )
            if log_noise.jitter
            else 0.0
        )
        sampled = np.clip(np.round((rows + jitter) * each).astype(int), 0, len(states) - 1)
        q, v, f = (states[sampled, i].astype(float) for i in range(3))
        q = q + log_noise.noise * rng.standard_normal(q.shape)
        if log_noise.step:
            q = np.round(q / log_noise.step) * log_noise.step
        v = v + 20 * log_noise.noise * rng.standard_normal(q.shape)
        f = f + 0.01 * np.abs(f).max(axis=0) * rng.standard_normal(q.shape)
        log = Recording(
            motion,
            payload,
            sampled * h,
            ctrl,
            q,
            v if log_noise.velocity else None,
            f if log_noise.torque else None,
        )
        keep = rng.random(len(rows)) >= log_noise.dropped
        keep[0] = True
        return log.rows(keep)

    def _targets(self, ctrl: Array, h: float, each: int) -> Array:
        """Return the goals of the servos in every physics step, (T · each, n)."""
        servo, steps = self.servo, np.arange(len(ctrl) * each)
        late = np.round(servo.delay / h).astype(int)
        rows = np.maximum(steps[:, None] - late, 0) // each
        target = np.take_along_axis(ctrl, rows, axis=0) + servo.offset
        for limit, moved in (
            (servo.speed * h, _ramp),
            (servo.backlash, _play),
            (h / np.maximum(servo.filter, h), _lag),
        ):
            if (limit != (1.0 if moved is _lag else 0.0)).any():
                target = moved(target, limit)
        return target


def _ramp(target: Array, most: Array) -> Array:
    """Limit the change of a target per step."""
    found, now, most = np.empty_like(target), target[0].copy(), np.where(most > 0, most, np.inf)
    for k, u in enumerate(target):
        now += np.clip(u - now, -most, most)
        found[k] = now
    return found


def _play(target: Array, gap: Array) -> Array:
    """Apply backlash: the output follows when the gap is closed."""
    found, now = np.empty_like(target), target[0].copy()
    for k, u in enumerate(target):
        now = np.clip(now, u - gap, u + gap)
        found[k] = now
    return found


def _lag(target: Array, share: Array) -> Array:
    """Filter the targets, first order."""
    found, now = np.empty_like(target), target[0].copy()
    for k, u in enumerate(target):
        now = now + share * (u - now)
        found[k] = now
    return found


def with_file_error(robot: RandomRobot, how: str) -> RandomRobot:
    """Add one error of FILE_ERRORS to the robot's file; with "still", its first joints do not move."""
    if how == "still":
        low, high = robot.low.copy(), robot.high.copy()
        low[:STILL] = high[:STILL] = robot.home[:STILL]
        return replace(robot, low=low, high=high)
    factor = {"units": {"kp": np.pi / 180, "kd": np.pi / 180}, "damping": {"kd": 12.0, "damping": 12.0},
              "armature": {"armature": 0.0}, "as drawn": {}}[how]  # fmt: skip
    return replace(robot, said={f: x * factor.get(f, 1.0) for f, x in robot.said.items()})


def draw_robot(
    seed: int, public: bool | None = None, small: bool = False, named: str = ""
) -> RandomRobot:
    """Draw the robot of a seed.

    Args:
        public: True for a public model, False for random kinematics; default: by chance.
        small: Random kinematics with at most SMALL joints, at no more than SLOW Hz.
        named: Part of the path of a public model, or a robot of gaponet.
    """
    if small:
        next(
            i
            for i in range(100)
            if len((found := draw_robot(seed + 10**6 * i, False)).joints) <= SMALL
        )
        return replace(found, rate=min(found.rate, SLOW))
    rng = np.random.default_rng([seed, 0])
    chance, place = rng.random() < 0.4, rng.integers(len(PUBLIC))
    spec, body = None, next((m for m in PUBLIC if named and named in m), list(PUBLIC)[place])
    if named and (PACKAGED / named / "robot.xml").is_file():
        body = f"{named}/robot.xml"
        spec = _public(PACKAGED / body, ())
    elif (bool(named) or (chance if public is None else public)) and (
        folder := _folder()
    ) is not None:
        spec = _public(folder / body, PUBLIC[body])
    if spec is None:
        body = ("arm", "legs", "hand")[rng.integers(3)]
        spec = mujoco.MjSpec.from_string({"arm": _arm, "legs": _legs, "hand": _hand}[body](rng))
    return _complete(seed, rng, spec, body)


def _folder() -> Path | None:
    data = Path(os.environ.get("GAPONET_DATA", Path(__file__).parents[2] / "shared" / "data"))
    folder = data.parent / "robots" / "public"
    return folder if folder.is_dir() else None


def _public(path: Path, welded: tuple[str, ...]) -> mujoco.MjSpec:
    """Read a public model without meshes, contacts and joints other than hinges; its base is fixed."""
    spec = mujoco.MjSpec.from_file(str(path))
    for kind in ("actuators", "sensors", "keys", "equalities", "tendons", "excludes", "pairs"):
        for element in list(getattr(spec, kind)):
            spec.delete(element)
    for geom in [g for g in spec.geoms if g.meshname]:
        spec.delete(geom)
    for mesh in list(spec.meshes):
        spec.delete(mesh)
    hinge = mujoco.mjtJoint.mjJNT_HINGE
    for joint in [j for j in spec.joints if j.type != hinge or any(w in j.name for w in welded)]:
        spec.delete(joint)
    spec.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    spec.compiler.boundmass, spec.compiler.boundinertia = (
        0.01,
        1e-6,
    )  # of bodies whose mass was their mesh's
    return mujoco.MjSpec.from_string(_plain(spec))


def _plain(spec: mujoco.MjSpec) -> str:
    spec.compile()
    return spec.to_xml()


def _link(
    rng: np.random.Generator,
    name: str,
    axis: str,
    length: float,
    mass: float,
    inside: str,
    limit: float,
) -> str:
    """Return a body with a hinge, a rod, and a child at its end."""
    to = np.roll([length, 0, 0], rng.integers(3)) * rng.choice([-1, 1])
    to = to if abs(to[1]) < 1e-9 else np.array([0, 0, -length])
    low = -limit * rng.uniform(0.6, 1)
    end = " ".join(f"{x:.5g}" for x in to)
    return (
        f'<joint name="{name}" axis="{axis}" range="{low:.4g} {limit * rng.uniform(0.6, 1):.4g}"/>'
        f'<geom type="capsule" size="{0.12 * length + 0.004:.4g}" fromto="0 0 0 {end}" mass="{mass:.5g}" '
        f'contype="0" conaffinity="0"/>'
        + (f'<body name="{name}_next" pos="{end}">{inside}</body>' if inside else "")
    )


def _chain(
    rng: np.random.Generator, prefix: str, n: int, length: float, mass: float, limit: float
) -> str:
    """Return n links, each shorter and lighter than its parent."""
    text = ""
    for i in reversed(range(n)):
        axis = ("1 0 0", "0 1 0", "0 0 1")[rng.integers(3)] if rng.random() < 0.8 else "0.6 0.8 0"
        size = 0.85**i * rng.uniform(0.7, 1.3)
        text = _link(rng, f"{prefix}{i}", axis, length * size, mass * size**2, text, limit)
    return text


def _arm(rng: np.random.Generator) -> str:
    n, length = int(rng.integers(3, 8)), np.exp(rng.uniform(np.log(0.06), np.log(0.45)))
    inside = _chain(
        rng, "arm_joint", n, length, 60 * length**2 * rng.uniform(0.3, 1.5), rng.uniform(1.2, 2.9)
    )
    return ARM.format(f'<body name="arm" pos="0 0 1">{inside}</body>')


def _legs(rng: np.random.Generator) -> str:
    count, length = int(rng.choice([1, 2, 4])), np.exp(rng.uniform(np.log(0.1), np.log(0.4)))
    mass = 50 * length**2 * rng.uniform(0.3, 1.5)
    one = lambda leg: _chain(rng, f"leg{leg}_joint", 3, length, mass, 1.2)  # noqa: E731
    bodies = (
        f'<body name="leg{leg}" pos="{leg * length} 0 1">{one(leg)}</body>' for leg in range(count)
    )
    return ARM.format("".join(bodies))


def _hand(rng: np.random.Generator) -> str:
    fingers, n, length = int(rng.integers(2, 5)), int(rng.integers(2, 5)), rng.uniform(0.025, 0.06)
    mass = 15 * length**2 * rng.uniform(0.5, 1.5)
    one = lambda f: _chain(rng, f"finger{f}_joint", n, length, mass, 1.4)  # noqa: E731
    bodies = (
        f'<body name="finger{f}" pos="{0.03 * f} 0 1">{one(f)}</body>' for f in range(fingers)
    )
    return ARM.format("".join(bodies))


def _complete(seed: int, rng: np.random.Generator, spec: mujoco.MjSpec, body: str) -> RandomRobot:
    """Draw servos, file errors and log errors for a body."""
    for geom in spec.geoms:
        geom.contype = geom.conaffinity = 0
    model = spec.compile()
    joints = tuple(model.joint(j).name for j in range(model.njnt))
    n, data = len(joints), mujoco.MjData(model)
    limited = model.jnt_limited.astype(bool)
    low, high = (
        np.where(limited, model.jnt_range[:, 0], -1.5),
        np.where(limited, model.jnt_range[:, 1], 1.5),
    )
    low, high = np.maximum(low, -2.5), np.minimum(high, 2.5)
    low, high = low + 0.05 * (high - low), high - 0.05 * (high - low)
    inertia, weight, full = np.zeros(n), np.zeros(n), np.zeros((n, n))
    for _ in range(40):
        data.qpos[:] = rng.uniform(low, high)
        mujoco.mj_forward(model, data)
        mujoco.mj_fullM(model, full, data.qM) if hasattr(data, "qM") else mujoco.mj_fullM(
            model, data, full
        )
        inertia = np.maximum(inertia, np.diag(full) / 2)
        weight = np.maximum(weight, np.abs(data.qfrc_bias))
    inertia = np.maximum(inertia, 0.02 * inertia.max())
    spread = lambda least, most, size=None: np.exp(rng.uniform(np.log(least), np.log(most), size))  # noqa: E731
    pace, motor = spread(1.5, 7.0), spread(0.1, 1.5)
    armature = inertia * motor * spread(0.7, 1.4, n)
    moved = inertia + armature
    kp = np.maximum(
        moved * (2 * np.pi * pace) ** 2 * spread(0.8, 1.25, n), weight / rng.uniform(0.03, 0.15)
    )
    total = 2 * rng.uniform(0.4, 1.2, n) * np.sqrt(kp * moved)
    share = rng.uniform(0.2, 1.0)
    none = np.zeros(n)
    effects = (
        ()
        if rng.random() < 0.5
        else tuple(map(str, rng.choice(EFFECTS, rng.integers(1, 4), replace=False)))
    )
    each = lambda name, least, most: spread(least, most, n) if name in effects else none  # noqa: E731
    limit = 3 * weight + 0.6 * kp
    servo = Servo(
        kp=kp, kd=share * total, damping=(1 - share) * total, friction=kp * spread(1e-3, 2e-2) * spread(0.6, 1.6, n),
        armature=armature, offset=rng.normal(0, 0.01, n) * (rng.random() < 0.7),
        delay=np.full(n, rng.uniform(0, 0.06)) + rng.uniform(0, 0.004, n),
        limit=np.maximum(1.25 * weight, 0.12 * kp * spread(0.7, 1.5, n)) if "saturation" in effects else limit,
        stribeck=kp * each("stribeck", 2e-3, 1e-2), stribeck_speed=spread(0.02, 0.2, n), load=each("load", 0.03, 0.25),
        backlash=each("backlash", 1e-3, 1e-2), dead_band=each("dead_band", 1e-3, 1e-2),
        speed=each("speed", 0.4, 2.0), filter=each("filter", 0.01, 0.06), creeps="creep" in effects,
    )  # fmt: skip
    said = {
        name: getattr(servo, name) * _wrong(rng, n, name != "kp")
        for name in ("kp", "kd", "damping", "armature")
    }
    log_noise = LogNoise(
        noise=float(rng.choice([0.0, spread(1e-5, 1e-3)])),
        step=float(rng.choice([0.0, 2 * np.pi / 4096, 2 * np.pi / 16384, 2 * np.pi / 131072])),
        dropped=float(rng.choice([0.0, rng.uniform(0.001, 0.02)])),
        jitter=float(rng.choice([0.0, rng.uniform(0, 0.3)])),
        velocity=bool(rng.random() < 0.6), torque=bool(rng.random() < 0.4),
    )  # fmt: skip
    heavy = (
        float(model.body_mass.sum()) * rng.uniform(0.05, 0.3)
        if body == "arm" and rng.random() < 0.5
        else 0.0
    )
    bodies = tuple(model.body(b).name for b in range(1, model.nbody))
    return RandomRobot(seed, body, spec, joints, np.clip(none, low, high), low, high, servo, said, effects,
                    float(rng.choice(RATES)), log_noise, round(heavy, 3), float(pace), bodies)  # fmt: skip


def _wrong(rng: np.random.Generator, n: int, may_lack: bool) -> Array:
    """Draw factors of a file's errors: up to two, mostly common to all joints, or 0."""
    factor = 2.0 ** np.clip(rng.uniform(-1, 1) + rng.uniform(-0.25, 0.25, n), -1, 1)
    return factor * (rng.random() > 0.2 or not may_lack)


def _like(like: object, value: float) -> object:
    """Return a number, or coefficients of a polynomial if the specification holds some."""
    return value if np.ndim(like) == 0 else [value, *np.zeros(len(like) - 1)]  # type: ignore[arg-type]


def _servo(spec: mujoco.MjSpec, joint: str, kp: float, kd: float, limit: float) -> None:
    servo = spec.add_actuator(name=joint, target=joint, trntype=mujoco.mjtTrn.mjTRN_JOINT)
    servo.set_to_position(kp=float(kp), kv=float(kd))
    servo.forcerange, servo.forcelimited = [-limit, limit], True
