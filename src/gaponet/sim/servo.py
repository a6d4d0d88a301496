"""Servo model: terms beyond MuJoCo's position actuator and friction loss, set before every physics
step.

The encoder counts in steps. A motor that turns at all has a least torque (minimum PWM). Its largest
torque falls with its speed to zero at the no-load speed (back-EMF). Friction is larger at rest
(Stribeck) and grows with the torque that the gear transmits (load-dependent as in BAM, Duclusaud et
al. 2024). MuJoCo integrates: the model only changes the actuator's bias, its torque limits and the
limit of friction, so friction sticks as MuJoCo's does. A gear with backlash parts the motor
(armature, damping, friction) from the link while its gap is open.

The model stands here twice. `servo_torque`, `friction_limit` and `overcome_friction` take arrays,
for exports and inverses. `requested_torque`, `motor_limits` and `joint_friction` take one servo
with fields by name, for numba and Warp, which are faster. Simulations (`set_servos`, called by
sim/servo_model.py) and the fit of single joints (`simulate_joints`) share the latter. A MuJoCo
model's actuator_user holds the parameters, in the order of SERVO_TERMS; without, nothing here runs.

A new term is a field of robot/servo_fields.py and a line in both forms of the model. If it is a
function of its own, `_register_functions` names it for numba, sim/warp.py for Warp and
export/helper_file.py for exports.
"""

from __future__ import annotations

import functools
from importlib import import_module
from typing import Any, NamedTuple

import numpy as np

from gaponet.base.arrays import Array, array_module
from gaponet.robot.servo_fields import SERVO_TERMS as SERVO_TERMS

# name of SERVO_TERMS → values that broadcast to the simulations' joints, numpy or torch
ServoTerms = dict[str, Any]

SLOWEST = 1e-3  # rad/s: of stribeck_speed
FINEST = 1e-9  # rad: of encoder_step
MAX_LOAD_FRICTION = 0.9  # of the motor's torque: with 1, no torque would overcome it
OPENED = 1 - 1e-9  # of half the width: a gap that opens
# encoder steps: a motor with a least torque rests while it reads a smaller error
DEADBAND_STEPS = 0.5


def present(terms: ServoTerms) -> ServoTerms:
    """Return the terms that are not zero everywhere; others are not computed.

    No division by these speeds fails.
    """
    active = {name: x for name, x in terms.items() if x.any()}
    if "stribeck" in active and "stribeck_speed" in terms:
        active["stribeck_speed"] = terms["stribeck_speed"].clip(min=SLOWEST)
    if "no_load_speed" in active:
        x = active["no_load_speed"]
        active["no_load_speed"] = array_module(x).where(x > 0, x, float("inf"))
    return active


def torque_range(limit: Any, ratio: Any) -> Any:
    """Return the least and the largest torque of a motor, N·m, at a ratio of its speed to the
    no-load speed.

    The largest is limit · (1 − ratio), between −limit and limit: beyond the no-load speed the motor
    brakes. MuJoCo's <dcmotor> has this range at ± its largest voltage with forcerange as current
    limit; so have the DC motors of Isaac Lab and mjlab with saturation_effort = effort_limit.
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
    """Return the limit of friction, N·m, at a speed, under the motor's torque and gravity's; terms
    as of `present`.
    """
    limit = frictionloss
    if "friction_motor" in terms or "friction_external" in terms:
        by_motor = terms.get("friction_motor", 0.0)
        by_load = terms.get("friction_external", 0.0)
        limit = limit + passing_friction(by_motor, by_load, torque, load)
    if "stribeck" in terms:
        limit = limit + resting_friction(
            terms["stribeck"], terms.get("stribeck_speed", SLOWEST), qvel
        )
    return limit


def overcome_friction(
    terms: ServoTerms,
    frictionloss: Array,
    qvel: Array,
    share: Array,
    torque: Array,
    load: Array | float,
) -> Array:
    """Return the friction that a motor overcomes beside a torque, N·m; arrays of one shape.

    Friction that grows with the motor's torque is part of this torque: the limit L solves
    L = rest + |by_motor (torque + share L) + by_load load|.

    Args:
        terms: As of `present`.
        frictionloss: Friction that does not depend on speed and torque, N·m.
        qvel: Speeds, rad/s.
        share: Friction over its limit, in [−1, 1].
        torque: What the motor gives beside friction, N·m.
        load: Gravity's torque, N·m.
    """
    rest = friction_limit(terms, frictionloss, qvel, 0.0, 0.0)
    by_motor = terms.get("friction_motor", 0.0)
    passing = by_motor * torque + terms.get("friction_external", 0.0) * load
    grows = np.minimum(by_motor, MAX_LOAD_FRICTION) * share
    limit = np.where(
        passing + grows * rest >= 0, (rest + passing) / (1 - grows), (rest - passing) / (1 + grows)
    )
    return np.asarray(share * limit)


def servo_torque(terms: ServoTerms, kp: Any, aim: Any, qpos: Any) -> Any:
    """Return the torque that the servo requests, N·m, for an angle (rad) that it reads in its
    encoder's steps.
    """
    xp = array_module(qpos)
    read = qpos
    deadband = 0.0
    if "encoder_step" in terms:
        step = terms["encoder_step"]
        fine = step.clip(min=FINEST)
        read = xp.where(step > 0, xp.round(qpos / fine) * fine, qpos)
        deadband = DEADBAND_STEPS * step * kp
    torque = kp * (aim - read)
    if "min_torque" not in terms:
        return torque
    least = terms["min_torque"]
    pushed = xp.copysign(xp.maximum(abs(torque), least), torque)
    return xp.where((least > 0) & (abs(torque) <= deadband), 0.0, pushed)


def servo_bias(terms: ServoTerms, kp: Any, bias: Any, ctrl: Any, qpos: Any) -> Any:
    """Return the bias, N·m, with which an actuator of gain kp and its own bias requests
    `servo_torque`. Without a gain it requests nothing: the bias stays as it is.
    """
    if "encoder_step" not in terms and "min_torque" not in terms:
        return bias
    xp = array_module(qpos)
    gain = xp.where(kp > 0, kp, 1.0)  # by which can be divided
    requested = servo_torque(terms, gain, ctrl + bias / gain, qpos) - gain * (ctrl - qpos)
    return xp.where(kp > 0, requested, bias)


# A servo as numba and Warp read it: a record whose fields are those of SERVO_FIELDS that the model
# computes.
SERVO_RECORD = np.dtype([(f, np.float64) for f in ("frictionloss", "effort_limit", *SERVO_TERMS)])
# A joint by itself: its servo, and what MuJoCo computes elsewhere. kd is the servo's, damping the
# joint's.
JOINT_FIELDS = ("kp", "kd", "damping", "armature", "offset", "delay")
JOINT_RECORD = np.dtype([*SERVO_RECORD.descr, *((f, np.float64) for f in JOINT_FIELDS)])


def requested_torque(servo: Any, kp: Any, aim: Any, qpos: Any) -> Any:
    """Return `servo_torque` of a servo with the fields of SERVO_RECORD, in N·m, for numba and
    Warp.
    """
    step = servo.encoder_step
    least = servo.min_torque
    read = qpos
    if step > 0.0:
        read = np.rint(qpos / step) * step
    torque = kp * (aim - read)
    if least > 0.0:
        if abs(torque) > DEADBAND_STEPS * step * kp:
            return np.sign(torque) * max(abs(torque), least)
        return 0.0 * torque
    return torque


def motor_limits(servo: Any, qvel: Any) -> Any:
    """Return the least and the largest torque of a servo at a joint speed, rad/s, in N·m, for
    numba and Warp.
    """
    least = -servo.effort_limit
    most = servo.effort_limit
    if servo.no_load_speed > 0.0:
        least, most = torque_range(servo.effort_limit, qvel / servo.no_load_speed)
    return least, most


def joint_friction(servo: Any, qvel: Any, torque: Any, load: Any) -> Any:
    """Return `friction_limit` of a servo, in N·m, for numba and Warp."""
    by_torque = passing_friction(servo.friction_motor, servo.friction_external, torque, load)
    limit = servo.frictionloss + by_torque
    if servo.stribeck > 0.0:
        speed = max(servo.stribeck_speed, SLOWEST)
        limit += resting_friction(servo.stribeck, speed, qvel)
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
    """Return the gaps (motor ahead of link), rad, and the motors' speeds, rad/s, after a step of h
    s; numpy arrays.

    A motor that is not pressed against its link is a free rotor with dry friction of `most` N·m.
    """
    net = torque - damping * rotor
    net = net + np.clip(-mass / h * rotor - net, -most, most)
    rotor = np.where(pressed, link, rotor + h / (mass + h * damping) * net)
    return np.clip(gap + h * (rotor - link), -half, half), rotor


class Play:
    """Backlash of servos in MuJoCo, numpy arrays of one shape: parts motors from links where the
    gaps are open.

    Attributes:
        gap: Motor ahead of link, rad.
        rotor: Speed of the motor, rad/s. Where it differs in a closed gap, the next step transmits
            the impact.
        seen: Speed of the link after the last step, rad/s; a speed that was written since then
            moves the motor too.
    """

    def __init__(
        self, width: Any, armature: Any, damping: Any, kd: Any, load: Any, qvel: Any
    ) -> None:
        """Begin on the side that carries `load`, N·m; armature, damping and kd are the motor's."""
        self.half = width / 2
        self._own = (armature, damping)
        self._kd = kd
        self.gap = np.where(load < 0, -self.half, self.half)
        self.rotor = qvel.copy()
        self.seen = qvel.copy()
        # of the present step, from `before` to `after`
        self._limit = np.zeros_like(self.half)
        self._qvel = np.zeros_like(self.half)
        self._impact = np.zeros_like(self.half)

    def before(self, limit: Any, kp: Any, qpos: Any, qvel: Any, h: Any) -> tuple[Any, ...]:
        """Return friction limit, armature, damping, applied torque and gear of the links for the
        next step of h s, and what an actuator without gear needs as bias: its torque does not reach
        the link then.
        """
        armature, damping = self._own
        closed = abs(self.gap) >= self.half
        self.rotor += qvel - self.seen
        self.seen[:] = qvel
        self._limit = limit.copy()
        self._qvel = qvel.copy()
        self._impact = armature * (self.rotor - qvel) / h
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
        """Advance the gaps of rows, from speeds, the servos' torques and the constraints' torques
        after a step.
        """
        armature, damping = self._own
        closed = abs(self.gap) >= self.half
        change = qvel - self._qvel
        # A contact counts as friction, up to the limit of friction: under contact the gap is only
        # approximate.
        force = torque + self._impact - damping * qvel - (self._kd + armature / h) * change
        force = force + np.clip(constraint, -self._limit, self._limit)
        gap, rotor = crossed(
            self.half, self.gap, self.rotor, closed, qvel, torque, damping, self._limit, armature, h
        )
        gap = np.where(closed & (force * gap < 0), OPENED * gap, gap)
        self.gap[rows] = gap[rows]
        self.rotor[rows] = rotor[rows]
        self.seen[rows] = qvel[rows]


def cross_gap(
    half: float,
    gap: float,
    rotor: float,
    before: float,
    speed: float,
    inertia: float,
    load: float,
    torque: float,
    damping: float,
    most: float,
    mass: float,
    h: float,
) -> tuple[float, float, float]:
    """Return the speeds of link and motor and the gap of one joint after a step, as `crossed`
    does, for numba.

    Pressed, both move as one body, from `before` to `speed`, until the motor would have to pull the
    link. They meet without rebound.
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


class ActuatorState(NamedTuple):
    """What a simulation's actuators do before a physics step, (nsim, nu); live arrays."""

    gain: Any  # MuJoCo's actuator_gainprm, (nsim, nu, 10)
    bias: Any  # torque of the zero offset, N·m
    ctrl: Any  # rad
    qpos: Any  # rad
    qvel: Any  # rad/s
    torque: Any  # of the last physics step, N·m
    load: Any  # torque of gravity and Coriolis forces, N·m


def set_servos(servos: Any, state: Any, biasprm: Any, friction: Any, force_range: Any) -> None:
    """Set servos for the next physics step; numba compiles it.

    Args:
        servos: SERVO_RECORD, (nsim, nu).
        state: ActuatorState.
        biasprm: MuJoCo's actuator_biasprm, (nsim, nu, 10), whose first number is set where a term
            changes the torque.
        friction: MuJoCo's dof_frictionloss, (nsim, nu) N·m.
        force_range: MuJoCo's actuator_forcerange, (nsim, nu, 2) N·m, set where a servo has a
            no-load speed.
    """
    simulations, actuators = state.qpos.shape
    for i in range(simulations):
        for j in range(actuators):
            servo = servos[i, j]
            qpos = state.qpos[i, j]
            qvel = state.qvel[i, j]
            friction[i, j] = joint_friction(servo, qvel, state.torque[i, j], state.load[i, j])
            if servo.min_torque > 0.0 or servo.encoder_step > 0.0:
                kp = state.gain[i, j, 0]
                ctrl = state.ctrl[i, j]
                aim = ctrl + state.bias[i, j] / kp
                biasprm[i, j, 0] = requested_torque(servo, kp, aim, qpos) - kp * (ctrl - qpos)
            if servo.no_load_speed > 0.0:
                least, most = motor_limits(servo, qvel)
                force_range[i, j, 0] = least
                force_range[i, j, 1] = most


class Windows(NamedTuple):
    """Windows of recordings beside which n joints move by themselves.

    Attributes:
        loads: Inertia without armature, kg·m²; gravity's torque at an angle of zero, N·m; torque of
            the other joints' accelerations, N·m; slope of gravity's torque, N·m/rad: (4, n,
            windows, rows).
        ctrl, qpos, qvel: Commands and states, (n, windows, rows) rad and rad/s.
        touch: Rows from which a rollout goes on from the recording, (windows, rows).
        lengths: Rows of each window, (windows,).
        stops: Ends of each joint's range, (n, 2) rad.
        periods: Control period of each window, (windows,) s.
        steps: Physics steps in a period.
        thin: Rows from one error to the next.
    """

    loads: Any
    ctrl: Any
    qpos: Any
    qvel: Any
    touch: Any
    lengths: Any
    stops: Any
    periods: Any
    steps: int
    thin: int


def step_joint(
    joint: Any, aim: Any, q: Any, w: Any, inertia: Any, load: Any, pull: Any, h: Any
) -> Any:
    """Return the speed, rad/s, of a joint without backlash after a step of h s, the servo's torque
    and the limit of friction, N·m; as MuJoCo steps it.

    Args:
        joint: With the fields of JOINT_RECORD.
        aim: Command and offset, rad.
        q, w: Angle and speed before the step, rad and rad/s.
        inertia: Without armature, kg·m².
        load, pull: Torques of gravity and of the other joints' accelerations, N·m.
    """
    least, most = motor_limits(joint, w)
    wanted = requested_torque(joint, joint.kp, aim, q) - joint.kd * w
    torque = min(max(wanted, least), most)
    friction = joint_friction(joint, w, torque, load)
    heavy = inertia + joint.armature
    net = torque - load - pull - joint.damping * w
    net += min(max(-heavy / h * w - net, -friction), friction)
    implicit = joint.damping
    if torque == wanted:  # not kd of a motor at its limit
        implicit += joint.kd
    return w + h / (heavy + h * implicit) * net, torque, friction


def command_rows(joints: Any, period: Any, steps: Any) -> Any:
    """Return the row, from that of the period, whose command is in force in each physics step of a
    period, and the share of the next row's, where it changes on the way: (steps, candidates) each.

    MuJoCo keeps a sample of the command for each physics step, and interpolates between samples. So
    a command changes to the next row's within the last physics step of its period.
    """
    rows = np.empty((steps, len(joints)), np.int64)
    shares = np.empty((steps, len(joints)))
    for step in range(steps):
        for c in range(len(joints)):
            sent_at = step / steps - joints[c].delay / period  # periods after this one's start
            rows[step, c] = np.floor(sent_at)
            shares[step, c] = max((sent_at - rows[step, c] - 1) * steps + 1, 0.0)
    return rows, shares


def simulate_joints(first: int, last: int, joints: Any, windows: Any, out: Any) -> None:
    """Fill out[:, first:last], (candidates, joints · windows, rows), with q_sim − q_real, rad;
    numba compiles it. The first row, the common start, is left as it is.

    Candidates take each step side by side, so that none waits for its own last one. The function
    stands in this file because numba compiles it again only when its own file changes.

    Args:
        first, last: Joints · windows that are simulated; the window varies fastest.
        joints: JOINT_RECORD, (joints · windows, candidates), with the gains of the window's
            recording.
        windows: Windows.
    """
    steps = windows.steps
    count = joints.shape[1]
    for i in range(first, last):
        candidates = joints[i]
        j = i // len(windows.lengths)
        window = i % len(windows.lengths)
        h = windows.periods[window] / steps
        ctrl = windows.ctrl[j, window]
        real = windows.qpos[j, window]
        real_speed = windows.qvel[j, window]
        inertias = windows.loads[0, j, window]
        weights = windows.loads[1, j, window]  # gravity's torques at an angle of zero
        pulls = windows.loads[2, j, window]
        slopes = windows.loads[3, j, window]  # of gravity's torques
        low = windows.stops[j, 0]
        high = windows.stops[j, 1]
        end = windows.lengths[window] - 1
        rows, shares = command_rows(candidates, windows.periods[window], steps)
        q = np.full(count, real[0])
        w = np.full(count, real_speed[0])
        rotor = w.copy()
        half = 0.5 * candidates["backlash"]
        gap = np.where(weights[0] + slopes[0] * q < 0, -half, half)
        for t in range(end):
            inertia = inertias[t]
            pull = pulls[t]
            for step in range(steps):
                for c in range(count):
                    joint = candidates[c]
                    row = t + rows[step, c]
                    share = shares[step, c]
                    aim = (1 - share) * ctrl[min(max(row, 0), end)] + joint.offset
                    aim += share * ctrl[min(max(row + 1, 0), end)]
                    load = slopes[t] * q[c] + weights[t]
                    speed, torque, friction = step_joint(
                        joint, aim, q[c], w[c], inertia, load, pull, h
                    )
                    if half[c] > 0.0:
                        speed, rotor[c], gap[c] = cross_gap(
                            half[c],
                            gap[c],
                            rotor[c],
                            w[c],
                            speed,
                            inertia,
                            load + pull,
                            torque,
                            joint.damping,
                            friction,
                            joint.armature,
                            h,
                        )
                    w[c] = speed
                    q[c] += h * w[c]
                    if q[c] < low:
                        q[c] = low
                        w[c] = max(w[c], 0.0)
                    elif q[c] > high:
                        q[c] = high
                        w[c] = min(w[c], 0.0)
            if windows.touch[window, t + 1]:  # goes on from the recording
                q[:] = real[t + 1]
                w[:] = real_speed[t + 1]
                rotor[:] = real_speed[t + 1]
            if (t + 1) % windows.thin == 0:
                out[:, i, (t + 1) // windows.thin] = q - real[t + 1]


@functools.cache
def compiled(function: Any) -> Any:
    """Return a function of this file compiled by numba, which is imported at the first call."""
    numba = import_module("numba")
    _register_functions()
    try:
        return numba.njit(cache=True, nogil=True, error_model="numpy")(function)
    except RuntimeError:  # no folder for the cache is writable
        return numba.njit(nogil=True, error_model="numpy")(function)


@functools.cache
def _register_functions() -> None:
    """Make the functions of this file that compiled ones call known to numba."""
    extending = import_module("numba.extending")
    extending.overload(exp)(lambda x: lambda x: np.exp(x))
    functions = (
        torque_range,
        passing_friction,
        resting_friction,
        requested_torque,
        motor_limits,
        joint_friction,
        cross_gap,
        step_joint,
        command_rows,
    )
    for function in functions:
        extending.register_jitable(function)
