"""Servo model: terms beyond MuJoCo's position actuator and friction loss, set before every physics step.

The encoder counts in steps. A motor that turns at all has a least torque (minimum PWM). Its largest torque falls with
its speed to zero at the no-load speed (back-EMF). Friction is larger at rest (Stribeck) and grows with the torque that
the gear transmits (load-dependent as in BAM, Duclusaud et al. 2024). MuJoCo integrates: the model only changes the
actuator's bias, its torque limits and the limit of friction, so friction sticks as MuJoCo's does.
A gear with backlash parts the motor (armature, damping, friction) from the link while its gap is open.
The model stands here twice: of arrays for numpy and torch, and of one joint for numba and Warp (`requested_torque`,
`joint_friction`), which is faster. A MuJoCo model's actuator_user holds the parameters; without, nothing here runs.
"""

from __future__ import annotations

import functools
from importlib import import_module
from typing import Any

import mujoco
import numpy as np

from gaponet.base.arrays import Array, array_module
from gaponet.robot.servo_fields import SERVO_TERMS

ServoTerms = dict[
    str, Any
]  # name of SERVO_TERMS → values that broadcast to the simulations' joints, numpy or torch

SLOWEST = 1e-3  # rad/s: of stribeck_speed
FINEST = 1e-9  # rad: of encoder_step
PLAY = SERVO_TERMS.index("backlash")
OPENED = 1 - 1e-9  # of half the width: a gap that opens
# encoder steps: a motor with a least torque rests while it reads a smaller error
DEADBAND_STEPS = 0.5


def present(terms: ServoTerms) -> ServoTerms:
    """Return the terms that are not zero everywhere; others are not computed. No division by these speeds fails."""
    active = {name: x for name, x in terms.items() if x.any()}
    if "stribeck" in active and "stribeck_speed" in terms:
        active["stribeck_speed"] = terms["stribeck_speed"].clip(min=SLOWEST)
    if "no_load_speed" in active:
        x = active["no_load_speed"]
        active["no_load_speed"] = array_module(x).where(x > 0, x, float("inf"))
    return active


def torque_range(limit: Any, ratio: Any) -> Any:
    """Return the least and the largest torque of a motor, N·m, at a ratio of its speed to the no-load speed.

    The largest is limit · (1 − ratio), between −limit and limit: beyond the no-load speed the motor brakes. MuJoCo's
    <dcmotor> has this range at ± its largest voltage with forcerange as current limit; so have the DC motors of Isaac
    Lab and mjlab with saturation_effort = effort_limit.
    """
    inside = abs(ratio)
    return 0.5 * limit * (inside - abs(2.0 + ratio)), 0.5 * limit * (abs(2.0 - ratio) - inside)


def passing_friction(by_motor: Any, by_load: Any, torque: Any, load: Any) -> Any:
    """Return the friction by the torque that passes the gear, of the motor and of gravity, N·m."""
    return abs(by_motor * torque + by_load * load)


def exp(x: Any) -> Any:
    """Return the exponential by the array's library; numba and Warp put their own in its place."""
    return array_module(x).exp(x)


def resting_friction(stribeck: Any, speed: Any, qvel: Any) -> Any:
    """Return the Stribeck friction at a joint speed, rad/s, in N·m."""
    return stribeck * exp(-abs(qvel) / speed)


def friction_limit(terms: ServoTerms, frictionloss: Any, qvel: Any, torque: Any, load: Any) -> Any:
    """Return the limit of friction, N·m, at a speed, under the motor's torque and gravity's; terms as of `present`."""
    limit = frictionloss
    if "friction_motor" in terms or "friction_external" in terms:
        by_motor, by_load = terms.get("friction_motor", 0.0), terms.get("friction_external", 0.0)
        limit = limit + passing_friction(by_motor, by_load, torque, load)
    if "stribeck" in terms:
        limit = limit + resting_friction(
            terms["stribeck"], terms.get("stribeck_speed", SLOWEST), qvel
        )
    return limit


def servo_torque(terms: ServoTerms, kp: Any, aim: Any, qpos: Any) -> Any:
    """Return the torque that the servo requests, N·m, for an angle (rad) that it reads in its encoder's steps."""
    xp, read, deadband = array_module(qpos), qpos, 0.0
    if "encoder_step" in terms:
        step = terms["encoder_step"]
        fine, deadband = step.clip(min=FINEST), DEADBAND_STEPS * step * kp
        read = xp.where(step > 0, xp.round(qpos / fine) * fine, qpos)
    torque = kp * (aim - read)
    if "min_torque" not in terms:
        return torque
    return xp.where(
        abs(torque) > deadband,
        xp.copysign(xp.maximum(abs(torque), terms["min_torque"]), torque),
        0.0,
    )


def requested_torque(kp: Any, aim: Any, qpos: Any, least: Any, step: Any, deadband: Any) -> Any:
    """Return `servo_torque` of one joint, in N·m, for numba and Warp; deadband in encoder steps."""
    read = qpos
    if step > 0.0:
        read = np.rint(qpos / step) * step
    torque = kp * (aim - read)
    if abs(torque) > deadband * step * kp:
        return np.sign(torque) * max(abs(torque), least)
    return 0.0 * torque


def joint_friction(
    dry: Any,
    stribeck: Any,
    speed: Any,
    by_motor: Any,
    by_load: Any,
    qvel: Any,
    torque: Any,
    load: Any,
) -> Any:
    """Return `friction_limit` of one joint, in N·m, for numba and Warp."""
    limit = dry + passing_friction(by_motor, by_load, torque, load)
    if stribeck > 0.0:
        limit += resting_friction(stribeck, speed, qvel)
    return limit


def crossed(
    half: Any,
    gap: Any,
    rotor: Any,
    pressed: Any,
    link: Any,
    torque: Any,
    damping: Any,
    most: Any,
    mass: Any,
    h: Any,
) -> tuple[Any, Any]:
    """Return the gaps (motor ahead of link), rad, and the motors' speeds, rad/s, after a step of h s; numpy arrays.

    A motor that is not pressed against its link is a free rotor with dry friction of `most` N·m.
    """
    net = torque - damping * rotor
    net = net + np.clip(-mass / h * rotor - net, -most, most)
    rotor = np.where(pressed, link, rotor + h / (mass + h * damping) * net)
    return np.clip(gap + h * (rotor - link), -half, half), rotor


class Play:
    """Backlash of servos in MuJoCo, numpy arrays of one shape: parts motors from links where the gaps are open.

    Attributes:
        gap: Motor ahead of link, rad.
        rotor: Speed of the motor, rad/s. Where it differs in a closed gap, the next step transmits the impact.
        seen: Speed of the link after the last step, rad/s; a speed that was written since then moves the motor too.
    """

    def __init__(
        self, width: Any, armature: Any, damping: Any, kd: Any, load: Any, qvel: Any
    ) -> None:
        """Begin on the side that carries `load`, N·m; armature, damping and kd are the motor's."""
        self.half, self._own, self._kd = width / 2, (armature, damping), kd
        self.gap, self.rotor, self.seen = (
            np.where(load < 0, -self.half, self.half),
            qvel.copy(),
            qvel.copy(),
        )

    def before(self, limit: Any, kp: Any, qpos: Any, qvel: Any, h: Any) -> tuple[Any, ...]:
        """Return friction limit, armature, damping, applied torque and gear of the links for the next step of h s, and
        what an actuator without gear needs as bias: its torque does not reach the link then."""
        (armature, damping), closed = self._own, abs(self.gap) >= self.half
        self.rotor += qvel - self.seen
        self.seen[:] = qvel
        self._limit, self._qvel, self._impact = (
            limit.copy(),
            qvel.copy(),
            armature * (self.rotor - qvel) / h,
        )
        bias = np.where(closed, 0.0, -kp * qpos - self._kd * qvel)
        return (
            limit * closed,
            armature * closed,
            damping * closed,
            self._impact * closed,
            1.0 * closed,
            bias,
        )

    def after(
        self, qvel: Any, torque: Any, constraint: Any, h: Any, rows: Any = slice(None)
    ) -> None:
        """Advance the gaps of rows, from speeds, the servos' torques and the constraints' torques after a step."""
        (armature, damping), closed, change = (
            self._own,
            abs(self.gap) >= self.half,
            qvel - self._qvel,
        )
        # A contact counts as friction, up to the limit of friction: under contact the gap is only approximate.
        force = torque + self._impact - damping * qvel - (self._kd + armature / h) * change
        force = force + np.clip(constraint, -self._limit, self._limit)
        gap, rotor = crossed(
            self.half, self.gap, self.rotor, closed, qvel, torque, damping, self._limit, armature, h
        )
        gap = np.where(closed & (force * gap < 0), OPENED * gap, gap)
        self.gap[rows], self.rotor[rows], self.seen[rows] = gap[rows], rotor[rows], qvel[rows]


def cross_gap(
    half: float, gap: float, rotor: float, before: float, speed: float, inertia: float, load: float, torque: float,
    damping: float, most: float, mass: float, h: float,
) -> tuple[float, float, float]:  # fmt: skip
    """Return the speeds of link and motor and the gap of one joint after a step, as `crossed` does, for numba.

    Pressed, both move as one body, from `before` to `speed`, until the motor would have to pull the link. They meet
    without rebound.
    """
    if abs(gap) >= half and (inertia * (speed - before) / h + load) * gap >= 0.0:
        return speed, speed, gap
    link = before - h / inertia * load
    net = torque - damping * rotor
    rotor += h / (mass + h * damping) * (net + min(max(-mass / h * rotor - net, -most), most))
    gap += h * (rotor - link)
    if abs(gap) < half:
        return link, rotor, gap
    both = (inertia * link + mass * rotor) / (inertia + mass)
    return both, both, half if gap > 0.0 else -half


def set_joints(
    terms: Any, deadband: float, dry: Any, own_bias: Any, gain: Any, ctrl: Any, qpos: Any, qvel: Any, torque: Any,
    load: Any, bias: Any, limit: Any, effort: Any, force_range: Any,
) -> None:  # fmt: skip
    """Fill `bias`, `limit`, (nsim, nu), and `force_range` as ServoModel.before does; numba compiles it.

    Args:
        terms: In the order of SERVO_TERMS, (nsim, nu, terms).
    """
    for i in range(len(qpos)):
        for j in range(qpos.shape[1]):
            rest, speed, by_motor, by_load, least, step, no_load = terms[i, j, :7]
            limit[i, j] = joint_friction(
                dry[i, j], rest, speed, by_motor, by_load, qvel[i, j], torque[i, j], load[i, j]
            )
            if least > 0.0 or step > 0.0:
                kp, q = gain[i, j], qpos[i, j]
                aim = ctrl[i, j] + own_bias[i, j] / kp
                bias[i, j] = requested_torque(kp, aim, q, least, step, deadband) - kp * (
                    ctrl[i, j] - q
                )
            if no_load > 0.0:
                least, most = torque_range(effort[i, j], qvel[i, j] / no_load)
                force_range[i, j, 0], force_range[i, j, 1] = least, most


def advance(
    first: int, last: int, values: Any, has_terms: bool, tables: Any, ctrl: Any, qpos: Any, qvel: Any, touch: Any,
    lengths: Any, stiffer: Any, kd: Any, stops: Any, warm: Any, periods: Any, count: int, thin: int,
    out: Any,
) -> None:  # fmt: skip
    """Fill out[:, first:last] (k, n·windows, rows) with q_sim − q_real; arrays as JointRollouts keeps them.

    Candidates take each step side by side, so that none waits for its own last one. numba compiles this function. It
    stands in this file because numba compiles a function again only when its own file changes.
    """
    k, windows = len(values), qpos.shape[1]
    for item in range(first, last):
        j, p = item // windows, item % windows
        h = periods[p] / count
        v, rows = np.ascontiguousarray(values[:, j].T), lengths[p]
        kp, mass, offset, limit = v[0] * stiffer[p, j], v[3], v[4], v[6]
        damping, dry = warm[0, :, j, p], warm[1, :, j, p]
        rest, speed, by_motor, by_load, least, step = (
            v[7],
            np.maximum(v[8], SLOWEST),
            v[9],
            v[10],
            v[11],
            v[12],
        )
        deadband, no_load = DEADBAND_STEPS * (least > 0), np.where(v[13] > 0, v[13], np.inf)
        fades = np.isfinite(no_load).any()
        brake, own = np.maximum(kd[p, j] + np.minimum(damping, 0.0), 0.0), np.maximum(damping, 0.0)
        # A part of each command where it changes on the way.
        late = np.arange(count).reshape(-1, 1) / count - v[5] / periods[p]
        row = np.floor(late).astype(np.int64)
        share = np.maximum((late - row - 1) * count + 1, 0.0)
        q, w = np.full(k, float(qpos[j, p, 0])), np.full(k, float(qvel[j, p, 0]))
        half, rotor = v[7 + PLAY] / 2, w.copy()
        gap = np.where(tables[1, j, p, 0] + tables[3, j, p, 0] * q < 0, -half, half)
        for t in range(rows - 1):
            here = tables[:, j, p, t]  # inertia, weight, pull, slope
            for part in range(count):
                for c in range(k):
                    heavy, at = here[0] + mass[c], t + row[part, c]
                    aim = (1 - share[part, c]) * ctrl[j, p, min(max(at, 0), rows - 1)] + offset[c]
                    aim += share[part, c] * ctrl[j, p, min(max(at + 1, 0), rows - 1)]
                    load, low, high = here[3] * q[c] + here[1], -limit[c], limit[c]
                    if fades:
                        low, high = torque_range(limit[c], w[c] / no_load[c])
                    wanted, most = kp[c] * (aim - q[c]), dry[c]
                    if has_terms:
                        wanted = requested_torque(kp[c], aim, q[c], least[c], step[c], deadband[c])
                    wanted -= brake[c] * w[c]
                    torque = min(max(wanted, low), high)
                    if has_terms:
                        most = joint_friction(
                            dry[c], rest[c], speed[c], by_motor[c], by_load[c], w[c], torque, load
                        )
                    net = torque - load - here[2] - own[c] * w[c]
                    net += min(max(-heavy / h * w[c] - net, -most), most)
                    implicit = own[c] + brake[c] * (
                        torque == wanted
                    )  # as MuJoCo: not kd of a motor at its limit
                    both = w[c] + h / (heavy + h * implicit) * net
                    if half[c] > 0.0:
                        both, rotor[c], gap[c] = cross_gap(
                            half[c], gap[c], rotor[c], w[c], both, here[0], load + here[2], torque, own[c], most,
                            mass[c], h,
                        )  # fmt: skip
                    w[c] = both
                    q[c] += h * w[c]
                    if q[c] < stops[j, 0]:
                        q[c], w[c] = stops[j, 0], max(w[c], 0.0)
                    elif q[c] > stops[j, 1]:
                        q[c], w[c] = stops[j, 1], min(w[c], 0.0)
            if touch[p, t + 1]:  # goes on from the recording
                q[:], w[:], rotor[:] = qpos[j, p, t + 1], qvel[j, p, t + 1], qvel[j, p, t + 1]
            if (t + 1) % thin == 0:
                out[:, item, (t + 1) // thin] = q - qpos[j, p, t + 1]


@functools.cache
def compiled(function: Any) -> Any:
    """Return a function of this file compiled by numba; None without numba, which is an extra."""
    try:
        numba, extending = import_module("numba"), import_module("numba.extending")
    except ImportError:
        return None
    _extend(extending)
    try:
        return numba.njit(cache=True, nogil=True, error_model="numpy")(function)
    except RuntimeError:  # no folder for the cache is writable
        return numba.njit(nogil=True, error_model="numpy")(function)


@functools.cache
def _extend(extending: Any) -> None:
    """Make functions of this file known to numba."""
    extending.overload(exp)(lambda x: lambda x: np.exp(x))
    functions = (
        torque_range,
        passing_friction,
        resting_friction,
        requested_torque,
        joint_friction,
        cross_gap,
    )
    for function in functions:
        extending.register_jitable(function)


class ServoModel:
    """Servo models of all simulations in a batch, whose actuators are in the order of its joints.

    Attributes:
        values: Name of SERVO_TERMS → (nsim, nu); may be written.
        active: The terms that are present since the last reset.
        frictionloss, bias, effort, armature, damping: The MuJoCo model's own, without the servo model, (nsim, nu); may
            be written.
        play: Backlash; None where no servo has any.
        torque, load: Torque of the actuators in the last physics step, and of gravity and Coriolis forces, (nsim, nu)
            N·m. The next step follows from these and the batch's own state.
    """

    def __init__(self, batch: Any, model: mujoco.MjModel) -> None:
        """Take the MuJoCo model's parameters for all simulations of a Batch, or of an object with its methods."""
        self.batch, self.model = batch, model
        user = (
            model.actuator_user if model.nuser_actuator else np.zeros((model.nu, len(SERVO_TERMS)))
        )
        self._qpos, self._qvel, self._ctrl = (
            batch.bind("qpos"),
            batch.bind("qvel"),
            batch.bind("ctrl"),
        )
        self._force, self._passing = batch.bind("actuator_force"), batch.bind("qfrc_bias")
        self._gain, self._bias = batch.expand("actuator_gainprm"), batch.expand("actuator_biasprm")
        self._limit = batch.expand("dof_frictionloss")
        self.values: ServoTerms = {
            name: np.tile(user[:, i], (len(self._qpos), 1)) for i, name in enumerate(SERVO_TERMS)
        }
        self.frictionloss, self.bias = self._limit.copy(), self._bias[:, :, 0].copy()
        own = batch.expanded("actuator_forcerange")
        limits = model.actuator_forcerange if own is None else own
        self.effort = np.array(np.broadcast_to(limits[..., 1], self.bias.shape))
        self._range = np.zeros((0, 0, 2))  # of torques, expanded where a term changes it
        self.armature, self.damping = (
            np.zeros(self._force.shape) + x for x in (model.dof_armature, model.dof_damping)
        )
        self.play: Play | None = None
        self.torque, self.load = (np.zeros(self._force.shape) for _ in range(2))
        self._set_joints = compiled(set_joints)
        self._take_terms()
        bias, limit = self._bias.copy(), self._limit.copy()
        self.before()  # compiles now, since the first step may belong to a control loop
        self._bias[:], self._limit[:] = bias, limit
        if "backlash" in self.active:
            self._reset_play(np.arange(len(self._force)))

    def _take_terms(self) -> None:
        """Take the present values of the terms for the steps to come."""
        self.active = present(self.values)
        if "no_load_speed" in self.active or self._range.size:
            self._range = self.batch.expand("actuator_forcerange")
            self._range[..., 0], self._range[..., 1] = -self.effort, self.effort
        none = np.zeros(self._force.shape)
        self._packed = np.stack([self.active.get(name, none) for name in SERVO_TERMS], axis=-1)
        self._deadband = DEADBAND_STEPS * ("min_torque" in self.active)

    def reset(self, ids: Array, target: Array) -> None:
        """Begin again for simulations `ids`, which were put into a state, under position targets (k, nu) rad."""
        self._take_terms()
        requested = self._gain[ids][..., 0] * (target - self._qpos[ids]) + self.bias[ids]
        self.torque[ids] = requested.clip(-self.effort[ids], self.effort[ids])
        self.batch.forward(ids, stage=mujoco.mjtStage.mjSTAGE_VEL.value)
        self.load[ids] = self._passing[ids]
        if self.play is not None or "backlash" in self.active:
            self._reset_play(ids)

    def _reset_play(self, ids: Array) -> None:
        expand, bind, step = self.batch.expand, self.batch.bind, self.batch.expanded("opt.timestep")
        self._links = (
            expand("dof_armature"), expand("dof_damping"), bind("qfrc_applied"), expand("actuator_gear")[..., 0],
        )  # fmt: skip
        self._constraint = bind("qfrc_constraint")
        self._h = self.model.opt.timestep if step is None else np.array(step).reshape(-1, 1)
        play = Play(
            self.values["backlash"],
            self.armature,
            self.damping,
            -self._bias[..., 2],
            self.load,
            self._qvel,
        )
        if self.play is not None:
            others = np.delete(np.arange(len(play.gap)), ids)
            for mine, before in (
                (play.gap, self.play.gap),
                (play.rotor, self.play.rotor),
                (play.seen, self.play.seen),
            ):
                mine[others] = before[others]
        self.play = play

    def before(self) -> None:
        """Set bias, torque limits and friction for the next physics step.

        MuJoCo delays ctrl after this: the least torque of a late servo follows the target that is under way.
        """
        gain, bias, qpos = self._gain[:, :, 0], self._bias[:, :, 0], self._qpos
        state = (self._qvel, self.torque, self.load)
        if self.play is not None:
            bias[:] = self.bias
        if self._set_joints is not None:
            self._set_joints(
                self._packed, self._deadband, self.frictionloss, self.bias, gain, self._ctrl, qpos, *state, bias,
                self._limit, self.effort, self._range,
            )  # fmt: skip
        else:
            if "encoder_step" in self.active or "min_torque" in self.active:
                aim = self._ctrl + self.bias / gain
                bias[:] = servo_torque(self.active, gain, aim, qpos) - gain * (self._ctrl - qpos)
            if "no_load_speed" in self.active:
                limits = torque_range(self.effort, self._qvel / self.active["no_load_speed"])
                self._range[..., 0], self._range[..., 1] = limits
            self._limit[:] = friction_limit(self.active, self.frictionloss, *state)
        if self.play is not None:
            *values, more = self.play.before(self._limit, gain, qpos, self._qvel, self._h)
            bias += more
            for field, value in zip((self._limit, *self._links), values, strict=True):
                field[:] = value

    def after(self, ids: Any = None) -> None:
        """Store torque and load after a physics step of these simulations."""
        moved = slice(None) if ids is None else ids
        self.torque[moved], self.load[moved] = self._force[moved], self._passing[moved]
        if self.play is not None:
            self.play.after(self._qvel, self.torque, self._constraint, self._h, moved)
