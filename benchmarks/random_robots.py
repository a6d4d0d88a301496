"""Random robots for benchmarks: a vendor's file with errors, servos with effects, noisy logs.

A body is a public model of ../shared/robots/public (or GAPONET_DATA/../robots/public) if that
folder exists, else an arm, legs or a hand with random kinematics. Logs come from plain MuJoCo and
`RandomRobot.play`; this module imports nothing of gaponet. All of these robots are VIRTUAL.
"""

from __future__ import annotations

import itertools
import os
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path

import mujoco
import numpy as np
from draws import log_uniform, minimum_jerk

Array = np.ndarray

PUBLIC = {  # model → joints that are welded where it stands: slides, wheels, joints on a tendon
    "universal_robots_ur5e/ur5e.xml": (),
    "ufactory_xarm7/xarm7_nohand.xml": (),
    "unitree_go1/go1.xml": (),
    "boston_dynamics_spot/spot.xml": (),
    "wonik_allegro/right_hand.xml": (),
    "aloha/aloha.xml": ("finger",),
    "shadow_hand/right_hand.xml": ("FFJ1", "FFJ2", "MFJ1", "MFJ2", "RFJ1", "RFJ2", "LFJ1", "LFJ2"),
}
PACKAGED = Path(__file__).parents[1] / "src" / "gaponet" / "robot" / "robots"  # more names
PUBLIC_SHARE = 0.4  # of the robots
RATES = (25, 30, 50, 60, 100, 125, 200, 240, 250, 500, 1000)  # Hz
# Not of the form that is fitted.
EFFECTS = ("stribeck", "load", "backlash", "dead_band", "speed", "saturation", "filter", "creep")
MAX_NUMBERS = 3e6  # of a log in all
MOTIONS = 12
RECORDED_S = (120.0, 300.0)  # of all motions
MIN_MOTION_S = 5.0
MAX_SMALL_JOINTS = 4
MAX_SMALL_RATE = 60.0  # Hz
MAX_TIMESTEP = 1e-3  # s, of the true robot's physics
STILL_JOINTS = 3  # that do not move with the error "still"
UNIT_FACTOR = np.pi / 180
FILE_FACTORS: dict[str, dict[str, float]] = {  # error of a file → factors on its values
    "as drawn": {},
    "units": {"kp": UNIT_FACTOR, "kd": UNIT_FACTOR},
    "damping": {"kd": 12.0, "damping": 12.0},
    "armature": {"armature": 0.0},
}
FILE_ERRORS = (*FILE_FACTORS, "still")
ARM = """<mujoco><compiler angle="radian" autolimits="true"/><option integrator="implicitfast"/>
<worldbody>{}</worldbody></mujoco>"""


@dataclass(frozen=True)
class Servo:
    """True servo parameters, (n,) each; an effect of 0 is absent.

    Attributes:
        kp, kd, damping: N·m/rad, N·m·s/rad.
        friction, limit: N·m.
        armature: kg·m².
        offset, backlash, dead_band: rad.
        delay, filter: s.
        stribeck, stribeck_speed: More friction at rest, N·m, which falls over so many rad/s.
        load: More friction over the motor's torque.
        speed: Most that a target moves, rad/s.
        creeps: The joints creep where real ones stick.
    """

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
    """Errors of the logs.

    Attributes:
        noise, step: Of the encoder, rad.
        dropped: Fraction of the samples.
        jitter: Of the sampling, periods.
        velocity, torque: Whether they are recorded.
    """

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
        return replace(
            self,
            time=self.time[keep],
            ctrl=self.ctrl[keep],
            qpos=self.qpos[keep],
            qvel=None if self.qvel is None else self.qvel[keep],
            tau=None if self.tau is None else self.tau[keep],
        )

    def columns(self, joints: tuple[str, ...]) -> dict[str, Array]:
        """Return the log as columns of a table."""
        found = {"time": self.time}
        for name in ("ctrl", "qpos", "qvel", "tau"):
            values = getattr(self, name)
            if values is None:
                continue
            for j, joint in enumerate(joints):
                found[f"{name}.{joint}"] = values[:, j]
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
        """Compile the true robot with steps of 1 ms or a little less, and a payload in kg."""
        spec = self.spec.copy()
        servo = self.servo
        period = 1 / self.rate
        spec.option.timestep = period / np.ceil(period / MAX_TIMESTEP)
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
            joint.damping = _like(joint.damping, servo.damping[j])
            joint.armature = servo.armature[j]
            joint.frictionloss = servo.friction[j]
            joint.solref_friction = [2.5 * spec.option.timestep, 1.0]
            # MuJoCo's own joints creep by milliradians a second where real ones stick.
            if not servo.creeps:
                joint.solimp_friction = [0.9999, 0.9999, 0.001, 0.5, 2.0]
            _add_servo(spec, name, servo.kp[j], servo.kd[j], servo.limit[j])
        return spec.compile()

    def file(self) -> str:
        """Return the vendor's MJCF, whose gains differ from the true ones."""
        spec = self.spec.copy()
        said = self.said
        for j, name in enumerate(self.joints):
            joint = spec.joint(name)
            joint.damping = _like(joint.damping, said["damping"][j])
            joint.armature = said["armature"][j]
            _add_servo(spec, name, said["kp"][j], said["kd"][j], self.servo.limit[j])
        spec.compile()
        return spec.to_xml()

    def commands(self, number: int, seconds: float) -> Array:
        """Draw commands of one motion, (T, n) rad: sines, moves between rests, steps, or both."""
        rng = np.random.default_rng([self.seed, number, 1])
        n = len(self.joints)
        time = np.arange(round(seconds * self.rate)) / self.rate
        room = np.minimum((self.high - self.low) / 2, 1.2)
        middle = np.clip(self.home, self.low + 0.55 * room, self.high - 0.55 * room)
        kind = ("sines", "ways", "steps", "mixed")[number % 4]
        found = np.tile(middle, (len(time), 1))
        if kind in ("sines", "mixed"):
            found += 0.5 * room * self._sines(rng, time) * np.minimum(1, time / 1.0)[:, None]
        if kind == "sines":
            return np.clip(found, self.low, self.high)
        size = 0.5 if kind == "ways" else 0.2
        rest_together = kind != "mixed" and number % 8 < 6
        clock_seeds = rng.integers(1 << 30, size=n)
        if rest_together:
            clock_seeds[:] = clock_seeds[0]
        for j in range(n):
            clock = np.random.default_rng(clock_seeds[j])
            found[:, j] += size * room[j] * self._visits(rng, clock, time, kind == "steps")
        return np.clip(found, self.low, self.high)

    def _sines(self, rng: np.random.Generator, time: Array) -> Array:
        """Draw sums of three sines in −1 … 1, (T, n); fast ones are small, for slow servos."""
        n = len(self.joints)
        hertz = self.pace * log_uniform(rng, 0.05, 0.5, (3, n))
        size = rng.dirichlet(np.ones(3), n).T * np.minimum(1, 0.25 * self.pace / hertz)
        phases = rng.uniform(0, 2 * np.pi, (3, n))
        waves = np.sin(2 * np.pi * hertz * time[:, None, None] + phases)  # (T, 3, n)
        return (size * waves).sum(axis=1)

    def _visits(
        self, rng: np.random.Generator, clock: np.random.Generator, time: Array, jump: bool
    ) -> Array:
        """Draw moves between rests in −1 … 1, (T,); `rng` draws positions, `clock` times."""
        found = np.zeros(len(time))
        place = 0.0
        now = 0.0  # s
        while now < time[-1]:
            rest_s = clock.uniform(0.6, 2.5)
            way_s = 0.0
            if not jump:
                way_s = clock.uniform(0.6, 2.0) * 2 / self.pace
            goal = rng.uniform(-1, 1)
            progress = np.clip((time - now - rest_s) / max(way_s, 1e-9), 0, 1)
            way = place + (goal - place) * minimum_jerk(progress)
            found = np.where(time >= now, way, found)
            place = goal
            now = now + rest_s + way_s
        return found

    def recordings(
        self, motions: int = MOTIONS, seconds: float | None = None
    ) -> Iterator[Recording]:
        """Yield the logs of all motions; every second one carries the payload, if there is one.

        Args:
            seconds: Of all motions together; None: by chance.
        """
        rng = np.random.default_rng([self.seed, 2])
        channels = 2 + self.log_noise.velocity + self.log_noise.torque
        numbers_each_s = self.rate * len(self.joints) * channels
        most_s = min(MAX_NUMBERS / numbers_each_s, rng.uniform(*RECORDED_S))
        motion_s = max(most_s / MOTIONS, MIN_MOTION_S)
        if seconds is not None:
            motion_s = seconds / motions
        for number in range(motions):
            payload = self.payload if number % 2 else 0.0
            yield self.play(f"m{number:02}", self.commands(number, motion_s), payload, number)

    def play(self, motion: str, ctrl: Array, payload: float, number: int) -> Recording:
        """Simulate a motion (T, n) rad with a payload in kg and log it."""
        model = self.model(payload)
        steps = round(1 / self.rate / model.opt.timestep)
        states = self._simulate(model, self._targets(ctrl, model.opt.timestep, steps))
        rng = np.random.default_rng([self.seed, number, 3])
        log_noise = self.log_noise
        rows = np.arange(len(ctrl))
        sampled_at = rows.astype(float)
        if log_noise.jitter:
            late = rng.normal(0, log_noise.jitter / 2, len(rows))
            sampled_at = rows + np.clip(late, -log_noise.jitter, log_noise.jitter)
        sampled = np.clip(np.round(sampled_at * steps).astype(int), 0, len(states) - 1)
        qpos, qvel, tau = states[sampled].astype(float).transpose(1, 0, 2)
        qpos = qpos + log_noise.noise * rng.standard_normal(qpos.shape)
        if log_noise.step:
            qpos = np.round(qpos / log_noise.step) * log_noise.step
        qvel = qvel + 20 * log_noise.noise * rng.standard_normal(qpos.shape)
        tau = tau + 0.01 * np.abs(tau).max(axis=0) * rng.standard_normal(qpos.shape)
        log = Recording(
            motion=motion,
            payload=payload,
            time=sampled * model.opt.timestep,
            ctrl=ctrl,
            qpos=qpos,
            qvel=qvel if log_noise.velocity else None,
            tau=tau if log_noise.torque else None,
        )
        keep = rng.random(len(rows)) >= log_noise.dropped
        keep[0] = True
        return log.rows(keep)

    def _simulate(self, model: mujoco.MjModel, targets: Array) -> Array:
        """Return position, velocity and torque of each step, (steps, 3, n), under targets (steps,
        n).
        """
        servo = self.servo
        data = mujoco.MjData(model)
        dof = np.array([model.joint(j).dofadr[0] for j in self.joints])
        at = np.array([model.joint(j).qposadr[0] for j in self.joints])
        data.qpos[at] = targets[0]
        has_more_friction = servo.stribeck.any() or servo.load.any()
        states = np.zeros((len(targets), 3, len(self.joints)), np.float32)
        for k, target in enumerate(targets):
            qpos = data.qpos[at]
            qvel = data.qvel[dof]
            if servo.dead_band.any():
                error = target - qpos
                target = qpos + np.sign(error) * np.maximum(np.abs(error) - servo.dead_band, 0)
            if has_more_friction:
                at_rest = servo.stribeck * np.exp(-np.abs(qvel) / servo.stribeck_speed)
                by_load = servo.load * np.abs(data.actuator_force)
                model.dof_frictionloss[dof] = servo.friction + (at_rest + by_load)
            states[k, 0] = qpos
            states[k, 1] = qvel
            states[k, 2] = data.actuator_force
            data.ctrl[:] = target
            mujoco.mj_step(model, data)
        return states

    def _targets(self, ctrl: Array, timestep: float, steps: int) -> Array:
        """Return the goals of the servos in every physics step, (T · steps, n)."""
        servo = self.servo
        late = np.round(servo.delay / timestep).astype(int)
        rows = np.maximum(np.arange(len(ctrl) * steps)[:, None] - late, 0) // steps
        target = np.take_along_axis(ctrl, rows, axis=0) + servo.offset
        if servo.speed.any():
            target = _ramp(target, servo.speed * timestep)
        if servo.backlash.any():
            target = _play(target, servo.backlash)
        lag_share = timestep / np.maximum(servo.filter, timestep)
        if (lag_share != 1.0).any():
            target = _lag(target, lag_share)
        return target


def _ramp(target: Array, most: Array) -> Array:
    """Limit the change of a target per step, (n,) rad; 0 is no limit."""
    most = np.where(most > 0, most, np.inf)
    found = np.empty_like(target)
    now = target[0].copy()
    for k, goal in enumerate(target):
        now += np.clip(goal - now, -most, most)
        found[k] = now
    return found


def _play(target: Array, gap: Array) -> Array:
    """Apply backlash, (n,) rad: the output follows when the gap is closed."""
    found = np.empty_like(target)
    now = target[0].copy()
    for k, goal in enumerate(target):
        now = np.clip(now, goal - gap, goal + gap)
        found[k] = now
    return found


def _lag(target: Array, share: Array) -> Array:
    """Filter the targets, first order, by a share (n,) of the difference in each step."""
    found = np.empty_like(target)
    now = target[0].copy()
    for k, goal in enumerate(target):
        now = now + share * (goal - now)
        found[k] = now
    return found


def with_file_error(robot: RandomRobot, how: str) -> RandomRobot:
    """Add one error of FILE_ERRORS to the robot's file; "still" holds its first joints."""
    if how == "still":
        low = robot.low.copy()
        high = robot.high.copy()
        low[:STILL_JOINTS] = robot.home[:STILL_JOINTS]
        high[:STILL_JOINTS] = robot.home[:STILL_JOINTS]
        return replace(robot, low=low, high=high)
    factors = FILE_FACTORS[how]
    said = {name: values * factors.get(name, 1.0) for name, values in robot.said.items()}
    return replace(robot, said=said)


def draw_robot(
    seed: int, public: bool | None = None, small: bool = False, named: str = ""
) -> RandomRobot:
    """Draw the robot of a seed.

    Args:
        public: True for a public model, False for random kinematics; default: by chance.
        small: Random kinematics with few joints, at a low rate.
        named: Part of the path of a public model, or a robot of gaponet.
    """
    if small:
        return _draw_small(seed)
    rng = np.random.default_rng([seed, 0])
    by_chance = rng.random() < PUBLIC_SHARE
    body = list(PUBLIC)[rng.integers(len(PUBLIC))]
    if public is None:
        public = by_chance
    if named:
        packaged = PACKAGED / named / "robot.xml"
        if packaged.is_file():
            return _complete(seed, rng, _public(packaged, ()), f"{named}/robot.xml")
        matching = [model for model in PUBLIC if named in model]
        if matching:
            body = matching[0]
        public = True
    folder = _folder()
    if public and folder is not None:
        return _complete(seed, rng, _public(folder / body, PUBLIC[body]), body)
    body = ("arm", "legs", "hand")[rng.integers(3)]
    mjcf = {"arm": _arm, "legs": _legs, "hand": _hand}[body](rng)
    return _complete(seed, rng, mujoco.MjSpec.from_string(mjcf), body)


def _draw_small(seed: int) -> RandomRobot:
    """Return the first robot with few joints of a series of seeds."""
    for i in itertools.count():
        robot = draw_robot(seed + 10**6 * i, public=False)
        if len(robot.joints) <= MAX_SMALL_JOINTS:
            break
    return replace(robot, rate=min(robot.rate, MAX_SMALL_RATE))


def _folder() -> Path | None:
    data = Path(os.environ.get("GAPONET_DATA", Path(__file__).parents[2] / "shared" / "data"))
    folder = data.parent / "robots" / "public"
    return folder if folder.is_dir() else None


def _public(path: Path, welded: tuple[str, ...]) -> mujoco.MjSpec:
    """Read a public model on a fixed base, without meshes, contacts and joints but hinges."""
    spec = mujoco.MjSpec.from_file(str(path))
    for kind in ("actuators", "sensors", "keys", "equalities", "tendons", "excludes", "pairs"):
        for element in list(getattr(spec, kind)):
            spec.delete(element)
    for geom in list(spec.geoms):
        if geom.meshname:
            spec.delete(geom)
    for mesh in list(spec.meshes):
        spec.delete(mesh)
    for joint in list(spec.joints):
        is_hinge = joint.type == mujoco.mjtJoint.mjJNT_HINGE
        if not is_hinge or any(word in joint.name for word in welded):
            spec.delete(joint)
    spec.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    # Of bodies whose mass was their mesh's.
    spec.compiler.boundmass = 0.01
    spec.compiler.boundinertia = 1e-6
    spec.compile()
    return mujoco.MjSpec.from_string(spec.to_xml())


def _link(
    rng: np.random.Generator,
    name: str,
    axis: str,
    length: float,
    mass: float,
    inside: str,
    limit: float,
) -> str:
    """Return the inside of a body: a hinge, a rod, and a child at the rod's end."""
    to = np.roll([length, 0, 0], rng.integers(3)) * rng.choice([-1, 1])
    if abs(to[1]) >= 1e-9:
        to = np.array([0, 0, -length])
    low = -limit * rng.uniform(0.6, 1)
    high = limit * rng.uniform(0.6, 1)
    end = " ".join(f"{x:.5g}" for x in to)
    child = f'<body name="{name}_next" pos="{end}">{inside}</body>' if inside else ""
    return (
        f'<joint name="{name}" axis="{axis}" range="{low:.4g} {high:.4g}"/>'
        f'<geom type="capsule" size="{0.12 * length + 0.004:.4g}" fromto="0 0 0 {end}" '
        f'mass="{mass:.5g}" contype="0" conaffinity="0"/>{child}'
    )


def _chain(
    rng: np.random.Generator, prefix: str, n: int, length: float, mass: float, limit: float
) -> str:
    """Return n links, each shorter and lighter than its parent."""
    text = ""
    for i in reversed(range(n)):
        axis = "0.6 0.8 0"
        if rng.random() < 0.8:
            axis = ("1 0 0", "0 1 0", "0 0 1")[rng.integers(3)]
        size = 0.85**i * rng.uniform(0.7, 1.3)
        text = _link(rng, f"{prefix}{i}", axis, length * size, mass * size**2, text, limit)
    return text


def _arm(rng: np.random.Generator) -> str:
    n = int(rng.integers(3, 8))
    length = log_uniform(rng, 0.06, 0.45)
    mass = 60 * length**2 * rng.uniform(0.3, 1.5)
    inside = _chain(rng, "arm_joint", n, length, mass, rng.uniform(1.2, 2.9))
    return ARM.format(f'<body name="arm" pos="0 0 1">{inside}</body>')


def _legs(rng: np.random.Generator) -> str:
    count = int(rng.choice([1, 2, 4]))
    length = log_uniform(rng, 0.1, 0.4)
    mass = 50 * length**2 * rng.uniform(0.3, 1.5)
    bodies = ""
    for leg in range(count):
        inside = _chain(rng, f"leg{leg}_joint", 3, length, mass, 1.2)
        bodies += f'<body name="leg{leg}" pos="{leg * length} 0 1">{inside}</body>'
    return ARM.format(bodies)


def _hand(rng: np.random.Generator) -> str:
    fingers = int(rng.integers(2, 5))
    n = int(rng.integers(2, 5))
    length = rng.uniform(0.025, 0.06)
    mass = 15 * length**2 * rng.uniform(0.5, 1.5)
    bodies = ""
    for finger in range(fingers):
        inside = _chain(rng, f"finger{finger}_joint", n, length, mass, 1.4)
        bodies += f'<body name="finger{finger}" pos="{0.03 * finger} 0 1">{inside}</body>'
    return ARM.format(bodies)


def _complete(seed: int, rng: np.random.Generator, spec: mujoco.MjSpec, body: str) -> RandomRobot:
    """Draw servos, file errors and log errors for a body."""
    for geom in spec.geoms:
        geom.contype = geom.conaffinity = 0
    model = spec.compile()
    n = model.njnt
    low, high = _reachable(model)
    inertia, weight = _most_inertia_and_weight(rng, model, low, high)
    pace = log_uniform(rng, 1.5, 7.0)
    motor = log_uniform(rng, 0.1, 1.5)
    armature = inertia * motor * log_uniform(rng, 0.7, 1.4, n)
    moved = inertia + armature
    stiff = moved * (2 * np.pi * pace) ** 2 * log_uniform(rng, 0.8, 1.25, n)
    kp = np.maximum(stiff, weight / rng.uniform(0.03, 0.15))
    damping = 2 * rng.uniform(0.4, 1.2, n) * np.sqrt(kp * moved)
    servo, effects = _draw_servo(rng, kp, damping, armature, weight)
    said = {}
    for name in ("kp", "kd", "damping", "armature"):
        said[name] = getattr(servo, name) * _file_factors(rng, n, may_lack=name != "kp")
    log_noise = _draw_log_noise(rng)
    heavy = 0.0  # kg
    if body == "arm" and rng.random() < 0.5:
        heavy = float(model.body_mass.sum()) * rng.uniform(0.05, 0.3)
    return RandomRobot(
        seed=seed,
        body=body,
        spec=spec,
        joints=tuple(model.joint(j).name for j in range(n)),
        home=np.clip(np.zeros(n), low, high),
        low=low,
        high=high,
        servo=servo,
        said=said,
        effects=effects,
        rate=float(rng.choice(RATES)),
        log_noise=log_noise,
        payload=round(heavy, 3),
        pace=float(pace),
        bodies=tuple(model.body(b).name for b in range(1, model.nbody)),
    )


def _reachable(model: mujoco.MjModel) -> tuple[Array, Array]:
    """Return the range of motions of each joint, (n,) rad each: nine tenths of its own."""
    limited = model.jnt_limited.astype(bool)
    low = np.maximum(np.where(limited, model.jnt_range[:, 0], -1.5), -2.5)
    high = np.minimum(np.where(limited, model.jnt_range[:, 1], 1.5), 2.5)
    margin = 0.05 * (high - low)
    return low + margin, high - margin


def _most_inertia_and_weight(
    rng: np.random.Generator, model: mujoco.MjModel, low: Array, high: Array
) -> tuple[Array, Array]:
    """Return half the most inertia and the most weight over postures, (n,) kg·m² and N·m."""
    data = mujoco.MjData(model)
    n = model.njnt
    inertia = np.zeros(n)
    weight = np.zeros(n)
    full = np.zeros((n, n))
    for _ in range(40):
        data.qpos[:] = rng.uniform(low, high)
        mujoco.mj_forward(model, data)
        if hasattr(data, "qM"):  # MuJoCo 3
            mujoco.mj_fullM(model, full, data.qM)
        else:
            mujoco.mj_fullM(model, data, full)
        inertia = np.maximum(inertia, np.diag(full) / 2)
        weight = np.maximum(weight, np.abs(data.qfrc_bias))
    return np.maximum(inertia, 0.02 * inertia.max()), weight


def _draw_servo(
    rng: np.random.Generator, kp: Array, damping: Array, armature: Array, weight: Array
) -> tuple[Servo, tuple[str, ...]]:
    """Draw the servos' other parameters, and up to three effects; (n,) each."""
    n = len(kp)
    share = rng.uniform(0.2, 1.0)  # of the damping that the servo does
    effects: tuple[str, ...] = ()
    if rng.random() >= 0.5:
        count = rng.integers(1, 4)
        effects = tuple(map(str, rng.choice(EFFECTS, count, replace=False)))

    def effect(name: str, least: float, most: float) -> Array:
        if name not in effects:
            return np.zeros(n)
        drawn: Array = log_uniform(rng, least, most, n)
        return drawn

    friction = kp * log_uniform(rng, 1e-3, 2e-2) * log_uniform(rng, 0.6, 1.6, n)
    offset = rng.normal(0, 0.01, n)
    if rng.random() >= 0.7:
        offset = np.zeros(n)
    delay = np.full(n, rng.uniform(0, 0.06)) + rng.uniform(0, 0.004, n)
    limit = 3 * weight + 0.6 * kp
    if "saturation" in effects:
        limit = np.maximum(1.25 * weight, 0.12 * kp * log_uniform(rng, 0.7, 1.5, n))
    servo = Servo(
        kp=kp,
        kd=share * damping,
        damping=(1 - share) * damping,
        friction=friction,
        armature=armature,
        offset=offset,
        delay=delay,
        limit=limit,
        stribeck=kp * effect("stribeck", 2e-3, 1e-2),
        stribeck_speed=log_uniform(rng, 0.02, 0.2, n),
        load=effect("load", 0.03, 0.25),
        backlash=effect("backlash", 1e-3, 1e-2),
        dead_band=effect("dead_band", 1e-3, 1e-2),
        speed=effect("speed", 0.4, 2.0),
        filter=effect("filter", 0.01, 0.06),
        creeps="creep" in effects,
    )
    return servo, effects


def _draw_log_noise(rng: np.random.Generator) -> LogNoise:
    return LogNoise(
        noise=float(rng.choice([0.0, log_uniform(rng, 1e-5, 1e-3)])),
        step=float(rng.choice([0.0, 2 * np.pi / 4096, 2 * np.pi / 16384, 2 * np.pi / 131072])),
        dropped=float(rng.choice([0.0, rng.uniform(0.001, 0.02)])),
        jitter=float(rng.choice([0.0, rng.uniform(0, 0.3)])),
        velocity=bool(rng.random() < 0.6),
        torque=bool(rng.random() < 0.4),
    )


def _file_factors(rng: np.random.Generator, n: int, may_lack: bool) -> Array:
    """Draw factors of a file's errors, (n,): up to two, mostly common to all joints, or 0."""
    factors: Array = 2.0 ** np.clip(rng.uniform(-1, 1) + rng.uniform(-0.25, 0.25, n), -1, 1)
    lacks = rng.random() <= 0.2
    if lacks and may_lack:
        return np.zeros(n)
    return factors


def _like(like: float | Array, value: float) -> float | list[float]:
    """Return a number, or coefficients of a polynomial if the specification holds some."""
    if np.ndim(like) == 0:
        return value
    return [value, *np.zeros(np.size(like) - 1)]


def _add_servo(spec: mujoco.MjSpec, joint: str, kp: float, kd: float, limit: float) -> None:
    servo = spec.add_actuator(name=joint, target=joint, trntype=mujoco.mjtTrn.mjTRN_JOINT)
    servo.set_to_position(kp=float(kp), kv=float(kd))
    servo.forcerange = [-limit, limit]
    servo.forcelimited = True
