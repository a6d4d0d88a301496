"""The hidden laws, each on (N, n) arrays for N simulations at once; parameters come from Physics.

MuJoCo integrates the joints: these laws only set, every law period, what its actuators and friction constraints are
allowed to do. So friction sticks as MuJoCo's does, and with neutral parameters nothing differs from the nominal
simulator.
"""

from __future__ import annotations

import mujoco
import numpy as np

from gaponet.sim.batch import Batch
from gaponet.testing.physics import Physics

Array = np.ndarray

DERATED = 40.0  # °C from which a drive takes gain back
STILL = 1e-3  # rad/s: below this a joint counts as stuck
KT_TEMPERATURE = 25.0  # °C at which kt_scale holds
COPPER = 0.00393  # 1/K: resistance of copper, IEC 60028


def friction_limit(
    physics: Physics, nominal: Array, qvel: Array, torque: Array, push: Array, thinned: Array | float = 1.0
) -> Array:
    """The largest torque that friction can take, (N, n), N·m.

    Coulomb friction with a Lorentzian Stribeck peak (Hess & Soom 1990, J. Tribology 112), more of it in one direction,
    and a part that grows with the transmitted torque: a gear of efficiency η loses (1 − η)|τ| when the motor drives the
    load and (1/η − 1)|τ| when the load drives the motor, so a joint sags less than it was pushed.

    Args:
        physics: Stacked parameters.
        nominal: The nominal model's friction, N·m.
        qvel: rad/s.
        torque: Motor torque at the joint, N·m.
        push: Torque that friction held back in the last step, N·m: the way a stuck joint would go.
        thinned: What warmth leaves of friction, apart from the gear's part.
    """
    still = np.abs(qvel) < STILL
    way = np.sign(np.where(still, push, qvel))
    slip = qvel / physics.stribeck_speed
    dry = physics.friction * (1.0 + physics.friction_asymmetry * way + physics.stribeck / (1.0 + slip * slip))
    loss = 1.0 - physics.efficiency
    backdriven = torque * way < 0
    return (nominal + dry) * thinned + loss * np.abs(torque) / np.where(backdriven, physics.efficiency, 1.0)


class Bristles:
    """Pre-sliding: friction is a spring of bristles that bend, and slip as they near its limit g.

    The model of LuGre (Canudas de Wit, Olsson, Åström & Lischinsky 1995, IEEE Trans. Automatic Control 40) without
    damping of its own; at a constant g Dahl's (1968): Ḟ = σ·v − σ·|v|·F/g. σ lets the friction of an unloaded joint
    build up over physics.presliding. Where that is zero, MuJoCo's rigid friction stays.
    """

    def __init__(self, physics: Physics, nominal: Array) -> None:
        self.soft = physics.presliding > 0
        self.any = bool(self.soft.any())
        rest = nominal + physics.friction * (1.0 + physics.stribeck)
        self.stiffness = np.where(self.soft, rest / np.where(self.soft, physics.presliding, 1.0), 0.0)
        self.torque = np.zeros_like(rest)  # against the motion, N·m

    def reset(self, held: Array, limit: Array) -> None:
        """A joint at rest: its bristles hold this torque (N, n) N·m, as far as they can."""
        self.torque = np.where(self.soft, np.clip(held, -limit, limit), 0.0)

    def step(self, limit: Array, qvel: Array, h: float) -> Array:
        """Advance h s at a speed and a limit; returns the torque, (N, n) N·m. Exact where both are constant."""
        end = np.copysign(limit, qvel)
        slipped = np.exp(-self.stiffness * np.abs(qvel) * h / np.maximum(limit, 1e-9))
        self.torque = np.where(self.soft, end + (self.torque - end) * slipped, 0.0)
        return self.torque


def torque_share(physics: Physics, speed: Array) -> Array:
    """What the voltage leaves of the torque limit at a speed (N, n) rad/s in the torque's direction, 0 to 1."""
    return np.clip((1.0 - speed / physics.no_load_speed) / (1.0 - physics.corner), 0.0, 1.0)


def cogging_torque(physics: Physics, qpos: Array) -> Array:
    """Torque ripple at joint angles (N, n) rad, N·m."""
    return physics.cogging * np.sin(physics.cogging_count * qpos + physics.cogging_phase)


class Couplings:
    """What one joint does to another, through cables, a limb's supply and the base.

    A cable bundle bent by the joint before (of a limb's first, after) presses on the joint and drags. What the motors
    of a limb ask for together beyond a budget costs all of them gain. The moving links' weight makes the base lean,
    after a first-order lag, and what a leaning base feels is gravity from elsewhere.
    """

    def __init__(self, physics: Physics, model: mujoco.MjModel, batch: Batch, effort: Array) -> None:
        """batch: Whose gravity is turned; effort: (n) torque limits, N·m."""
        self.p, self.effort = physics, effort
        parent = model.dof_parentid
        after = [next((i for i in range(model.nv) if parent[i] == j), j) for j in range(model.nv)]
        self.neighbour = np.where(parent >= 0, parent, after)
        limb = np.cumsum(parent != np.arange(model.nv) - 1) - 1  # a limb begins where a chain branches off
        self.together = (limb[:, None] == limb).astype(float)
        self.drags, self.limits = bool((physics.drag > 0).any()), bool((physics.limb_loss > 0).any())
        self.flexes = bool((physics.flex > 0).any())
        if self.flexes:
            self._gravity, self._com = batch.expand("opt.gravity"), batch.bind("subtree_com")
            self._level, self._weight = self._gravity.copy(), batch.expand("body_subtreemass")
            self._pull = np.linalg.norm(self._level, axis=1, keepdims=True)
        self.lean = np.zeros((len(physics.flex), 2))

    def reset(self) -> None:
        """Stand as the weight at rest leaves it."""
        if self.flexes:
            self.flex(np.inf)

    def drag(self, qpos: Array) -> Array:
        """Friction added at joint angles (N, n) rad, N·m."""
        return self.p.drag * 0.5 * (1.0 - np.cos(qpos[:, self.neighbour] - self.p.drag_angle))

    def share(self, torque: Array) -> Array:
        """What the limbs' supplies leave of the gain under motor torques, (N, n)."""
        asked = (np.abs(torque) / self.effort) @ self.together
        return 1.0 / (1.0 + self.p.limb_loss * np.maximum(asked - self.p.limb_budget, 0.0))

    def flex(self, h: float) -> None:
        """Lean on for h s."""
        moment = self._com[:, 0, :2] * self._weight[:, :1] * self._pull
        caught_up = -np.expm1(-h / self.p.flex_time)
        self.lean = self.lean + caught_up * (self.p.flex * moment - self.lean)
        self._gravity[:] = self._level
        self._gravity[:, :2] += self.lean * self._pull


class Firmware:
    """Targets in steps, smoothed by a first-order filter that hurries when it has fallen behind."""

    def __init__(self, physics: Physics) -> None:
        self.p, self.any = physics, bool((physics.smoothing > 0).any() or (physics.target_step > 0).any())

    def reset(self, target: Array) -> None:
        """Has long been at a target, (N, n) rad."""
        self.at = target.copy()

    def step(self, target: Array, h: float) -> Array:
        """The target that the servo follows h s later, (N, n) rad."""
        step = np.where(self.p.target_step > 0, self.p.target_step, 1.0)
        lag = np.where(self.p.target_step > 0, np.round(target / step) * step, target) - self.at
        rate = (1.0 + np.abs(lag) / self.p.smoothing_lag) / np.maximum(self.p.smoothing, 1e-9)
        self.at = self.at - lag * np.expm1(-h * rate)
        return self.at


def derated(physics: Physics, winding: Array) -> Array:
    """What a hot drive leaves of the gain at winding temperatures (N, n) °C."""
    return 1.0 / (1.0 + physics.derating * np.maximum(winding - DERATED, 0.0))


class Backlash:
    """Play between motor and link: when the torque changes sign the motor first has to cross the gap.

    While it crosses, the link feels no torque. The motor is a free rotor there: its inertia is the joint's armature,
    and it arrives after √(2·gap·J/τ) under a constant torque (the dead zone of Nordin & Gutman 2002, Automatica 38,
    with a rigid, plastic contact).
    """

    def __init__(self, physics: Physics, armature: Array) -> None:
        self.half = physics.backlash / 2
        self.armature = np.broadcast_to(armature, self.half.shape)
        self.play = self.half > 0
        self.any = bool(self.play.any())
        self.gap = self.half.copy()  # motor ahead of link, rad
        self.speed = np.zeros_like(self.half)

    def reset(self, torque: Array) -> None:
        """Lie against the side that carries the torque."""
        self.gap = np.where(torque < 0, -self.half, self.half)
        self.speed = np.zeros_like(self.half)

    def step(self, torque: Array, h: float) -> Array:
        """Advance h s under the motor torque (N, n); returns 1 where it reaches the link, 0 in the gap."""
        at_side = np.abs(self.gap) >= self.half
        held = at_side & (self.gap * torque >= 0)
        speed = np.where(held, 0.0, self.speed + torque / self.armature * h)
        gap = self.gap + speed * h
        self.gap = np.clip(gap, -self.half, self.half)
        arrived = np.abs(gap) >= self.half
        self.speed = np.where(arrived, 0.0, speed)
        return np.where(arrived | ~self.play, 1.0, 0.0)


class Thermal:
    """Two nodes, winding and housing; the winding is heated by current, the housing by the winding.

    Torque and current are measured in motor torque at the rated torque constant; τ²/K_m² watts become heat, more as
    copper warms. Structure and parameters as motor makers publish them (e.g. maxon catalogue: two resistances, two time
    constants).
    """

    def __init__(self, physics: Physics) -> None:
        self.p = physics
        self.winding = np.full_like(physics.kt_drift, KT_TEMPERATURE)
        self.housing = self.winding.copy()

    def reset(self, temperature: Array) -> None:
        """Both nodes at a temperature, (N, n) °C: a robot that has been standing."""
        self.winding = np.array(temperature, float)
        self.housing = self.winding.copy()
        self.ambient = np.full_like(self.winding, KT_TEMPERATURE)

    def heat(self, torque_squared: Array) -> Array:
        """Copper loss, (N, n) W."""
        return torque_squared / self.p.motor_constant**2 * (1.0 + COPPER * (self.winding - KT_TEMPERATURE))

    def step(self, torque_squared: Array, dt: float) -> None:
        """Advance dt s with a mean squared motor torque (N, n), (N·m)²."""
        inward = (self.winding - self.housing) / self.p.winding_resistance  # W
        outward = (self.housing - self.ambient) / self.p.housing_resistance
        winding_capacity = self.p.winding_time / self.p.winding_resistance  # J/K
        housing_capacity = self.p.housing_time / self.p.housing_resistance
        self.winding = self.winding + dt * (self.heat(torque_squared) - inward) / winding_capacity
        self.housing = self.housing + dt * (inward - outward) / housing_capacity

    def kt(self) -> Array:
        """Torque per rated current over the datasheet's, (N, n)."""
        return self.p.kt_scale * (1.0 - self.p.kt_drift * (self.winding - KT_TEMPERATURE))

    def thinned(self) -> Array:
        """What the housing's warmth leaves of friction and damping, (N, n)."""
        return np.exp(-self.p.thinning * (self.housing - KT_TEMPERATURE))


def supply_share(physics: Physics, power: Array) -> Array:
    """Battery voltage over nominal, (N, 1), when the unit draws `power` (N, 1) W: Ohm's law, one resistance."""
    current = power / physics.supply_voltage
    return 1.0 - current * physics.supply_resistance / physics.supply_voltage


class CommandLink:
    """Commands travel: each packet arrives after delay + jitter, or never; the newest arrived one is in force."""

    def __init__(self, physics: Physics, dt: float) -> None:
        """Packets are sent every dt s; as many are kept as can be on the way at once, and the one in force."""
        self.p = physics
        self.slots = int(np.ceil((physics.delay + physics.jitter).max() / dt)) + 2

    def reset(self, ctrl: Array) -> None:
        """Begin as if all packets so far had asked for ctrl, (N, n) rad."""
        count = len(ctrl)
        self.packets = np.repeat(ctrl[:, None], self.slots, axis=1)
        self.arrival = np.full((count, self.slots), -np.inf)
        self.sent = np.full(self.slots, -1)
        self.count = 0
        self.newest = np.full(count, -1)
        self.current = ctrl.copy()

    def send(self, ctrl: Array, time: float, chance: Array) -> None:
        """Put a packet on the way at `time` s; chance (N, 2) is uniform in [0, 1): jitter, loss."""
        slot = self.count % self.slots
        self.packets[:, slot] = ctrl
        late = self.p.delay[:, 0] + self.p.jitter[:, 0] * chance[:, 0]
        self.arrival[:, slot] = np.where(chance[:, 1] < self.p.drop[:, 0], np.inf, time + late)
        self.sent[slot] = self.count
        self.count += 1

    def read(self, time: float) -> Array:
        """The command in force at `time` s, (N, n) rad."""
        arrived = np.where(self.arrival <= time + 1e-9, self.sent, -1)
        slot = arrived.argmax(axis=1)
        number = arrived[np.arange(len(slot)), slot]
        new = np.flatnonzero(number > self.newest)
        if len(new):
            self.current[new] = self.packets[new, slot[new]]
            self.newest[new] = number[new]
        return self.current
