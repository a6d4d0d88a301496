"""Effects of the motors of virtual robots, on (N, n) arrays for N simulations at once.

Parameters are in Physics.

MuJoCo integrates the joints. The effects only change the gains and limits of its actuators and
friction constraints, once per effect period. So friction sticks as in MuJoCo, and with neutral
parameters the robot is the nominal simulator.
"""

from __future__ import annotations

import mujoco
import numpy as np

from gaponet.base.arrays import Array
from gaponet.sim.batch import Batch
from gaponet.virtual.physics import Physics

DERATING_TEMPERATURE = 40.0  # °C above which a drive reduces its gain
STUCK_SPEED = 1e-3  # rad/s below which a joint counts as stuck
KT_TEMPERATURE = 25.0  # °C at which kt_scale is stated
COPPER_COEFFICIENT = 0.00393  # 1/K, of the resistance, IEC 60028
# kg·m², of a motor that crosses its backlash; a model without armature states 0
MIN_ROTOR_INERTIA = 1e-9


def friction_limit(
    physics: Physics,
    nominal: Array,
    qvel: Array,
    torque: Array,
    push: Array,
    thinning: Array | float = 1.0,
) -> Array:
    """Return the largest torque of friction, (N, n), N·m.

    Coulomb friction with a Lorentzian Stribeck peak (Hess & Soom 1990, J. Tribology 112) differs by
    direction. A part grows with the transmitted torque: a gear of efficiency η loses (1 − η)|τ| if
    the motor drives the load, and (1/η − 1)|τ| if the load drives the motor. So a joint sags less
    than it was pushed.

    Args:
        physics: Stacked parameters.
        nominal: Friction of the nominal model, N·m.
        qvel: rad/s.
        torque: Motor torque at the joint, N·m.
        push: Torque that friction balanced in the last step, N·m; a stuck joint would move in its
            direction.
        thinning: Factor of friction in a warm joint; the gear's part does not have it.
    """
    stuck = np.abs(qvel) < STUCK_SPEED
    direction = np.sign(np.where(stuck, push, qvel))
    slip = qvel / physics.stribeck_speed
    dry = physics.friction * (
        1.0 + physics.friction_asymmetry * direction + physics.stribeck / (1.0 + slip * slip)
    )
    loss = 1.0 - physics.efficiency
    backdriven = torque * direction < 0
    result: Array = (nominal + dry) * thinning + loss * np.abs(torque) / np.where(
        backdriven, physics.efficiency, 1.0
    )
    return result


class Bristles:
    """Pre-sliding friction: bristles bend like a spring, and slip near the friction limit g.

    This is the LuGre model (Canudas de Wit, Olsson, Åström & Lischinsky 1995, IEEE Trans. Automatic
    Control 40) without damping. At a constant g it is Dahl's model (1968): Ḟ = σ·v − σ·|v|·F/g. The
    friction of an unloaded joint builds up over physics.presliding. If that is zero, MuJoCo's rigid
    friction is used.
    """

    def __init__(self, physics: Physics, nominal: Array) -> None:
        self.soft = physics.presliding > 0
        self.any = bool(self.soft.any())
        rest = nominal + physics.friction * (1.0 + physics.stribeck)
        self.stiffness = np.where(
            self.soft, rest / np.where(self.soft, physics.presliding, 1.0), 0.0
        )
        self.torque = np.zeros_like(rest)  # against the motion, N·m

    def reset(self, torque: Array, limit: Array) -> None:
        """Start at rest: the bristles hold a torque (N, n) N·m, up to the limit."""
        self.torque = np.where(self.soft, np.clip(torque, -limit, limit), 0.0)

    def step(self, limit: Array, qvel: Array, h: float) -> Array:
        """Advance by h s and return the torque, (N, n) N·m; exact for constant speed and limit."""
        end = np.copysign(limit, qvel)
        remaining = np.exp(-self.stiffness * np.abs(qvel) * h / np.maximum(limit, 1e-9))
        self.torque = np.where(self.soft, end + (self.torque - end) * remaining, 0.0)
        return self.torque


class Friction:
    """Friction of all joints, (N, n).

    Attributes:
        nominal: Friction of the nominal model, (n,) N·m.
        bristles: Pre-sliding friction, where a joint has it.
        push: Torque that friction balanced in the last physics step, N·m.
        thinning: Factor of friction in a warm joint.
    """

    def __init__(self, physics: Physics, nominal: Array) -> None:
        self._physics = physics
        self.nominal = nominal
        self.bristles = Bristles(physics, nominal)
        self.push = np.zeros_like(physics.friction)
        self.thinning: Array = np.ones((1, 1))

    def limit(self, drag: Array, qvel: Array, torque: Array) -> Array:
        """Return the friction limit, N·m, with the drag of cables, at a speed and motor torque."""
        nominal = self.nominal + drag
        return friction_limit(self._physics, nominal, qvel, torque, self.push, self.thinning)

    def note_constraint(self, torque: Array) -> None:
        """Note the torque of MuJoCo's constraints in the last physics step, N·m."""
        self.push = -torque
        if self.bristles.any:
            self.push = np.where(self.bristles.soft, self.bristles.torque, self.push)


def speed_factor(physics: Physics, speed: Array) -> Array:
    """Return the factor of the torque limit, 0 to 1, at a speed (N, n) rad/s in the direction of
    the torque.
    """
    result: Array = np.clip(
        (1.0 - speed / physics.no_load_speed) / (1.0 - physics.corner), 0.0, 1.0
    )
    return result


def cogging_torque(physics: Physics, qpos: Array) -> Array:
    """Return the torque ripple at joint angles (N, n) rad, N·m."""
    result: Array = physics.cogging * np.sin(physics.cogging_count * qpos + physics.cogging_phase)
    return result


class Couplings:
    """Effects between joints: cables, the supply of a kinematic chain, and the base.

    The joint before (for the first joint of a chain, the joint after) bends a cable bundle, which
    then adds friction. If the motors of a chain together need more torque than a budget, all of
    them lose gain. The weight of the moving links tilts the base with a first-order lag; a tilted
    base changes the direction of gravity.
    """

    def __init__(
        self, physics: Physics, model: mujoco.MjModel, batch: Batch, effort: Array
    ) -> None:
        """
        Args:
            batch: Simulations in which gravity changes its direction.
            effort: Torque limits, (n) N·m.
        """
        self.p = physics
        self.effort = effort
        parent = model.dof_parentid
        self.neighbour = np.where(parent >= 0, parent, _first_children(parent))
        chain = np.cumsum(parent != np.arange(model.nv) - 1) - 1  # a chain starts at each branch
        self.same_chain = (chain[:, None] == chain).astype(float)
        self.flexes = bool((physics.flex > 0).any())
        if self.flexes:
            self._gravity = batch.expand("opt.gravity")
            self._com = batch.bind("subtree_com")
            self._level_gravity = self._gravity.copy()
            self._weight = batch.expand("body_subtreemass")
            self._g = np.linalg.norm(self._level_gravity, axis=1, keepdims=True)
        self.tilt = np.zeros((len(physics.flex), 2))

    def reset(self) -> None:
        """Start with the tilt of a robot at rest."""
        if self.flexes:
            self.flex(np.inf)

    def drag(self, qpos: Array) -> Array:
        """Return the friction of the cables at joint angles (N, n) rad, N·m."""
        result: Array = (
            self.p.drag * 0.5 * (1.0 - np.cos(qpos[:, self.neighbour] - self.p.drag_angle))
        )
        return result

    def gain_factor(self, torque: Array) -> Array:
        """Return the factor of the gain that the supplies of the chains allow under motor torques,
        (N, n).
        """
        load = (np.abs(torque) / self.effort) @ self.same_chain
        result: Array = 1.0 / (1.0 + self.p.limb_loss * np.maximum(load - self.p.limb_budget, 0.0))
        return result

    def flex(self, h: float) -> None:
        """Advance the tilt of the base by h s."""
        moment = self._com[:, 0, :2] * self._weight[:, :1] * self._g
        progress = -np.expm1(-h / self.p.flex_time)
        self.tilt = self.tilt + progress * (self.p.flex * moment - self.tilt)
        self._gravity[:] = self._level_gravity
        self._gravity[:, :2] += self.tilt * self._g


def _first_children(parent: Array) -> list[int]:
    """Return the first child of each joint, or the joint itself if it has none.

    parent: Parent of each joint, (n,); -1 without one.
    """
    children = list(range(len(parent)))
    for joint in reversed(range(len(parent))):
        if parent[joint] >= 0:
            children[parent[joint]] = joint
    return children


class Firmware:
    """Firmware that rounds targets and smooths them; the filter is faster at a larger lag."""

    def __init__(self, physics: Physics) -> None:
        self.p = physics
        self.any = bool((physics.smoothing > 0).any() or (physics.target_step > 0).any())
        self.smoothed = np.zeros_like(physics.smoothing)

    def reset(self, target: Array) -> None:
        """Start at a target that has been in force for long, (N, n) rad."""
        self.smoothed = target.copy()

    def step(self, target: Array, h: float) -> Array:
        """Advance by h s and return the target of the servo, (N, n) rad."""
        lag = quantised(target, self.p.target_step) - self.smoothed
        rate = (1.0 + np.abs(lag) / self.p.smoothing_lag) / np.maximum(self.p.smoothing, 1e-9)
        self.smoothed = self.smoothed - lag * np.expm1(-h * rate)
        return self.smoothed


def quantised(values: Array, step: Array) -> Array:
    """Return values rounded to multiples of a step; a step of 0 changes nothing."""
    nonzero = np.where(step > 0, step, 1.0)
    return np.where(step > 0, np.round(values / nonzero) * nonzero, values)


def derating_factor(physics: Physics, winding: Array) -> Array:
    """Return the factor of the gain of a drive at winding temperatures (N, n) °C."""
    return 1.0 / (1.0 + physics.derating * np.maximum(winding - DERATING_TEMPERATURE, 0.0))


class Backlash:
    """Play between motor and link: if the torque changes its sign, the motor first crosses the gap.

    In the gap the link gets no torque. The motor is a free rotor with the joint's armature as
    inertia; under a constant torque it crosses in √(2·gap·J/τ). This is the dead zone of Nordin &
    Gutman (2002, Automatica 38) with a rigid, plastic contact.
    """

    def __init__(self, physics: Physics, armature: Array) -> None:
        self.half = physics.backlash / 2
        self.armature = np.broadcast_to(np.maximum(armature, MIN_ROTOR_INERTIA), self.half.shape)
        self.play = self.half > 0
        self.any = bool(self.play.any())
        self.gap = self.half.copy()  # motor ahead of link, rad
        self.speed = np.zeros_like(self.half)

    def reset(self, torque: Array) -> None:
        """Start at the side that carries the torque."""
        self.gap = np.where(torque < 0, -self.half, self.half)
        self.speed = np.zeros_like(self.half)

    def step(self, torque: Array, h: float) -> Array:
        """Advance by h s under the motor torque (N, n).

        Return 1 where it reaches the link, 0 in the gap.
        """
        pressed = (np.abs(self.gap) >= self.half) & (self.gap * torque >= 0)
        speed = np.where(pressed, 0.0, self.speed + torque / self.armature * h)
        gap = self.gap + speed * h
        self.gap = np.clip(gap, -self.half, self.half)
        arrived = np.abs(gap) >= self.half
        self.speed = np.where(arrived, 0.0, speed)
        return np.where(arrived | ~self.play, 1.0, 0.0)


class Thermal:
    """Thermal model with two nodes: current heats the winding, and the winding heats the housing.

    Torque and current are stated as motor torque at the rated torque constant. τ²/K_m² watts become
    heat, and more in warm copper. The structure is that of motor makers' data (e.g. maxon
    catalogue: two resistances, two time constants).
    """

    def __init__(self, physics: Physics) -> None:
        self.p = physics
        self.ambient = np.full_like(physics.kt_drift, KT_TEMPERATURE)
        self.winding = self.ambient.copy()
        self.housing = self.ambient.copy()

    def reset(self, temperature: Array) -> None:
        """Start with both nodes at a temperature, (N, n) °C, as after a pause."""
        self.winding = np.array(temperature, float)
        self.housing = self.winding.copy()

    def heat(self, torque_squared: Array) -> Array:
        """Return the copper loss, (N, n) W."""
        result: Array = (
            torque_squared
            / self.p.motor_constant**2
            * (1.0 + COPPER_COEFFICIENT * (self.winding - KT_TEMPERATURE))
        )
        return result

    def step(self, torque_squared: Array, dt: float) -> None:
        """Advance by dt s with a mean squared motor torque (N, n), (N·m)²."""
        inward = (self.winding - self.housing) / self.p.winding_resistance  # W
        outward = (self.housing - self.ambient) / self.p.housing_resistance
        winding_capacity = self.p.winding_time / self.p.winding_resistance  # J/K
        housing_capacity = self.p.housing_time / self.p.housing_resistance
        self.winding = self.winding + dt * (self.heat(torque_squared) - inward) / winding_capacity
        self.housing = self.housing + dt * (inward - outward) / housing_capacity

    def kt(self) -> Array:
        """Return the torque constant over that of the datasheet, (N, n)."""
        return self.p.kt_scale * (1.0 - self.p.kt_drift * (self.winding - KT_TEMPERATURE))

    def thinning_factor(self) -> Array:
        """Return the factor of friction and damping at the temperature of the housing, (N, n)."""
        return np.exp(-self.p.thinning * (self.housing - KT_TEMPERATURE))


def supply_factor(physics: Physics, power: Array) -> Array:
    """Return the battery voltage over the nominal one, (N, 1), for a power (N, 1) W: one
    resistance.
    """
    current = power / physics.supply_voltage
    result: Array = 1.0 - current * physics.supply_resistance / physics.supply_voltage
    return result


class CommandLink:
    """Delayed commands: each packet arrives after delay + jitter, or is lost.

    The newest arrived one is in force.
    """

    def __init__(self, physics: Physics, dt: float) -> None:
        """
        Args:
            dt: Time between two packets, s.
        """
        self.p = physics
        # Packets under way, one in force.
        self.slots = int(np.ceil((physics.delay + physics.jitter).max() / dt)) + 2
        count, n = physics.kp_scale.shape
        self.packets = np.zeros((count, self.slots, n))
        self.arrival = np.full((count, self.slots), -np.inf)
        self.sent = np.full(self.slots, -1)
        self.newest = np.full(count, -1)
        self.current = np.zeros((count, n))
        self.count = 0

    def reset(self, ctrl: Array) -> None:
        """Start as if all earlier packets had been ctrl, (N, n) rad."""
        self.packets[:] = ctrl[:, None]
        self.arrival[:] = -np.inf
        self.sent[:] = -1
        self.newest[:] = -1
        self.count = 0
        self.current = ctrl.copy()

    def send(self, ctrl: Array, time: float, chance: Array) -> None:
        """Send a packet at `time` s; chance (N, 2) is uniform in [0, 1): jitter, loss."""
        slot = self.count % self.slots
        self.packets[:, slot] = ctrl
        delay = self.p.delay[:, 0] + self.p.jitter[:, 0] * chance[:, 0]
        self.arrival[:, slot] = np.where(chance[:, 1] < self.p.drop[:, 0], np.inf, time + delay)
        self.sent[slot] = self.count
        self.count += 1

    def read(self, time: float) -> Array:
        """Return the command in force at `time` s, (N, n) rad."""
        arrived = np.where(self.arrival <= time + 1e-9, self.sent, -1)
        slot = arrived.argmax(axis=1)
        number = arrived[np.arange(len(slot)), slot]
        new = np.flatnonzero(number > self.newest)
        if len(new):
            self.current[new] = self.packets[new, slot[new]]
            self.newest[new] = number[new]
        return self.current
