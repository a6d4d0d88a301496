"""Many simulations of one robot, one control period per step; sim/warp.py does the same on a
GPU.
"""

from __future__ import annotations

import copy
import os
from collections.abc import Callable
from typing import TYPE_CHECKING, Any, NamedTuple

import mujoco
import numpy as np

from gaponet.base.arrays import Array
from gaponet.base.errors import UsageError
from gaponet.data.sequence import Sequence
from gaponet.robot.servo_fields import SERVO_TERMS, STOP_FIELDS
from gaponet.robot.servo_parameters import ratio_to
from gaponet.robot.simulator_change import SimulatorChange
from gaponet.robot.spec import RobotSpec
from gaponet.sim.changed_model import changed_model
from gaponet.sim.commands import CommandHistory, Commands, ControlPeriods
from gaponet.sim.model import build_model, qpos_range
from gaponet.sim.servo_model import ServoModel


class OneByOne:
    """Replacement of mujoco.batch.Batch before MuJoCo 3.17: one simulation after another, slower.

    Bound fields are live (nsim, …) arrays as there. All simulations share one MjData: every bound
    field is written to it before a call and read from it after.
    """

    STATE = ("time", "qpos", "qvel", "history", "qacc_warmstart", "ctrl", "qfrc_applied")

    def __init__(self, model: mujoco.MjModel, nsim: int, nthread: int = 0) -> None:
        self.nsim = nsim
        self._model = copy.copy(model)
        self._data = mujoco.MjData(model)
        self._bound: dict[str, Array] = {}
        self._expanded: dict[str, Array] = {}
        for name in self.STATE:
            self.bind(name)

    def bind(self, name: str) -> Array:
        """Return a field of MjData as a live array, (nsim, …)."""
        if name not in self._bound:
            self._bound[name] = np.array([getattr(self._data, name)] * self.nsim)
        return self._bound[name]

    def expand(self, name: str) -> Array:
        """Return a field of MjModel, or opt.NAME of its options, with a value for each simulation,
        (nsim, …).
        """
        if name not in self._expanded:
            self._expanded[name] = np.array([_field(self._model, name)] * self.nsim)
        return self._expanded[name]

    def expanded(self, name: str) -> Array | None:
        """Return an expanded field; None if it was not expanded."""
        return self._expanded.get(name)

    def step(self, ids: Array | None = None, nstep: int = 1) -> None:
        """Advance by nstep physics steps."""
        self._call(ids, lambda model, data: mujoco.mj_step(model, data, nstep))

    def forward(self, ids: Array | None = None, stage: int = 0) -> None:
        """Compute the quantities that follow from positions and velocities; the only stage that is
        supported.
        """
        self._call(ids, mujoco.mj_step1)

    def get_data(self, i: int) -> mujoco.MjData:
        """Return a copy of one simulation, with the quantities that follow from its positions and
        velocities.
        """
        self._call(np.array([i]), mujoco.mj_step1)
        return copy.copy(self._data)

    def _call(
        self, ids: Array | None, function: Callable[[mujoco.MjModel, mujoco.MjData], None]
    ) -> None:
        model = self._model
        data = self._data
        for i in np.arange(self.nsim)[slice(None) if ids is None else ids]:
            for name, values in self._expanded.items():
                if name.startswith("opt."):
                    setattr(model.opt, name.removeprefix("opt."), values[i])
                else:
                    setattr(model, name, values[i])
            for name, values in self._bound.items():
                setattr(data, name, values[i])
            function(model, data)
            for name, values in self._bound.items():
                values[i] = getattr(data, name)


if TYPE_CHECKING:
    from mujoco.batch import MODEL_FIELDS
    from mujoco.batch import Batch as Batch
else:
    try:
        from mujoco.batch import MODEL_FIELDS, Batch
    except ImportError:  # before MuJoCo 3.17
        Batch = OneByOne
        MODEL_FIELDS = {n for n in dir(mujoco.MjModel) if n[0] != "_"} | {
            f"opt.{n}" for n in dir(mujoco.MjOption)
        }


class Condition(NamedTuple):
    """Condition of a recording: payload, control period, and gains (n) where they are not the
    robot's own.

    Also the mean temperature of each joint (n), °C, if it was recorded and changes the robot's
    friction, and how the simulator differs from the robot's own.
    """

    payload_mass: float
    payload_side: str
    dt: float
    kp: tuple[float, ...] | None = None
    kd: tuple[float, ...] | None = None
    temperature: tuple[float, ...] | None = None
    simulator: SimulatorChange | None = None

    @classmethod
    def of(cls, sequence: Sequence, robot: RobotSpec) -> Condition:
        """Return the condition of a recording of this robot."""
        meta = sequence.meta
        kp, kd = meta.recorded_gains
        if robot.with_gains(kp, kd) is robot:  # they are the robot's own
            kp = None
            kd = None
        temperature = None
        if any(robot.servo.friction_per_kelvin) or any(robot.servo.damping_per_kelvin):
            temperature = sequence.temperatures
        return cls(
            payload_mass=meta.payload_mass,
            payload_side=meta.payload_side,
            dt=sequence.dt,
            kp=kp,
            kd=kd,
            temperature=temperature,
            simulator=sequence.simulator,
        )

    @property
    def without_change(self) -> Condition:
        """The same condition in the robot's own simulator."""
        return self._replace(simulator=None)


class BatchSim:
    """num_envs simulations of a robot; each may have its own payload, control period and gains.

    `qpos` and `qvel` are live (num_envs, n) views: a write is the state at the next step. Results
    are bit-identical to a loop of mj_step over one MjData each, at any number of threads.
    """

    def __init__(
        self,
        robot: RobotSpec,
        conditions: list[Condition],
        nthread: int = 0,
        locked: tuple[str, ...] = (),
        servo_model: bool = False,
    ) -> None:
        """Make a simulation for each of `conditions`.

        Args:
            nthread: Threads, 0 for all cores.
            locked: Joints clamped at home; all arrays have the n others.
            servo_model: Simulate servo terms also if the robot has none, so that `set_servos` can
                give them.
        """
        self.robot = robot
        self.joint_names = tuple(name for name in robot.joint_names if name not in locked)
        conditions = [Condition(*condition) for condition in conditions]
        robots = _under_conditions(robot, conditions)  # one of each condition
        self.models = _compiled(robots, self.joint_names, locked, _largest_added_delay(conditions))
        models = [self.models[condition] for condition in conditions]  # one of each simulation
        first = models[0]  # its names and sizes are those of all
        self._gains = _recorded_gains(robot, [robots[condition] for condition in conditions])
        self.batch = Batch(first, nsim=len(models), nthread=nthread or _useful_threads(len(models)))
        expand_differences(self.batch, models)
        bind: Callable[[str], Array] = self.batch.bind
        self.qpos = bind("qpos")
        self.qvel = bind("qvel")
        self.torque = bind("actuator_force")
        self._warmstart = bind("qacc_warmstart")
        self.servo_model: ServoModel | None = None
        if robot.servo.has_terms or servo_model:  # after the fields above, which it reads
            self.servo_model = ServoModel(self.batch, first)
        nstep = np.array([robot.steps_per(condition.dt) for condition in conditions])
        timestep = np.array([model.opt.timestep for model in models])
        self.periods = ControlPeriods(nstep, timestep)
        history = None
        if first.nhistory:
            history = CommandHistory(bind("history"), bind("time"), first)
        self.commands = Commands(bind("ctrl"), qpos_range(first), self.periods, history)
        speed = robot.servo.target_speed[robot.index(self.joint_names)]
        if speed.any():
            self.commands.limit_speed(speed)

    @property
    def num_envs(self) -> int:
        """Number of simulations."""
        return len(self.qpos)

    @property
    def n(self) -> int:
        """Number of joints that are not locked."""
        return len(self.joint_names)

    def array(self, values: Any) -> Array:
        """Return values as an array of this simulator: numpy here, torch in sim/warp.py."""
        return np.asarray(values)

    def reset(
        self, ids: Array | slice, qpos: Array, qvel: Array, past: Array | None = None
    ) -> None:
        """Put simulations `ids` into a state, (k, n) rad and rad/s.

        `past` are the targets of the control periods before, newest first, (k, depth, n) rad, for
        servos with a delay (robot.servo.delay). The oldest counts for all before it.
        """
        self.qpos[ids] = qpos
        self.qvel[ids] = qvel
        self._warmstart[ids] = 0.0
        self.commands.reset(ids, self.qpos[ids], past)
        if self.servo_model is not None:
            rows = np.arange(self.num_envs)[ids]
            self.servo_model.reset(rows, self.qpos[rows] if past is None else past[:, 0])

    def step(self, ctrl: Array, ids: Array | None = None) -> None:
        """Hold position targets for one control period.

        Args:
            ctrl: Targets, (num_envs, n), rad; clipped to the joint range, as a servo would.
            ids: Only these simulations move, (k,) sorted; default all.
        """
        self.commands.send(ctrl, ids)
        for count, moving in self.periods.by_nstep(ids):
            self._advance(moving, count)

    def _advance(self, ids: Array | None, count: int) -> None:
        if self.servo_model is None:
            self.batch.step(ids, nstep=count)
            return
        for _ in range(count):
            self.servo_model.before()
            self.batch.step(ids, nstep=1)
            self.servo_model.after(ids)

    def set_servos(self, joints: tuple[str, ...], values: dict[str, Array]) -> None:
        """Give every simulation servos of its own.

        Args:
            joints: k names.
            values: kp at the robot's own gains, damping, frictionloss, armature, offset, and any of
                kd, effort_limit, zero, target_speed, delay (up to the robot's) and SERVO_TERMS,
                each (num_envs, k). A damping below zero is taken from the servo's own kd, in the
                same ratio at other gains.

        Raises:
            UsageError: A value that these simulations cannot take, such as a delay where the robot
                has none.
        """
        self._require_settable(values)
        model = next(iter(self.models.values()))
        batch = self.batch
        # Number of each joint's actuator: of the joint and of its degree of freedom too.
        at = np.array([model.actuator(j).id for j in joints])
        own = self.robot.index(joints)
        gain = batch.expand("actuator_gainprm")
        bias = batch.expand("actuator_biasprm")
        kp = values["kp"] * self._gains.kp_ratio[:, own]
        kd = values.get("kd", self._gains.kd[:, own])
        gain[:, at, 0] = kp
        bias[:, at, 0] = kp * values["offset"]
        bias[:, at, 1] = -kp
        kd_ratio = self._gains.kd_ratio[:, own]
        bias[:, at, 2] = -np.maximum(kd + kd_ratio * np.minimum(values["damping"], 0.0), 0.0)
        batch.expand("dof_damping")[:, at] = np.maximum(values["damping"], 0.0)
        batch.expand("dof_frictionloss")[:, at] = values["frictionloss"]
        batch.expand("dof_armature")[:, at] = values["armature"]
        if "effort_limit" in values:
            limit = values["effort_limit"]
            batch.expand("actuator_forcerange")[:, at] = np.stack([-limit, limit], axis=-1)
        if "delay" in values and model.nhistory:
            batch.expand("actuator_delay")[:, at] = values["delay"]
        if "zero" in values:
            batch.expand("qpos0")[:, at] = (
                model.qpos0[at] + self.robot.servo.zero[own] - values["zero"]
            )
        if "target_speed" in values:
            speed = self.robot.servo.target_speed[self.robot.index(self.joint_names)]
            each = np.tile(speed, (self.num_envs, 1))
            each[:, at] = values["target_speed"]
            self.commands.limit_speed(each)
        if self.servo_model is not None:
            self.servo_model.state.bias[:, at] = bias[:, at, 0]
            self.servo_model.servos.set(at, values)

    def _require_settable(self, values: dict[str, Array]) -> None:
        """Raise UsageError if values hold what these simulations cannot take."""
        fixed: list[str] = list(STOP_FIELDS)
        if not next(iter(self.models.values())).nhistory:
            fixed.append("delay")
        if self.servo_model is None:
            fixed += SERVO_TERMS
        refused = [field for field in fixed if field in values and np.any(values[field])]
        if refused:
            raise UsageError(
                f"{', '.join(refused)} cannot differ between simulations of {self.robot.name}: "
                "give them to the robot (with_identified) that BatchSim is made with"
            )

    def state(self) -> dict[str, Array]:
        """Return copies of the complete state."""
        return {name: values.copy() for name, values in self._state().items()}

    def set_state(self, state: dict[str, Array]) -> None:
        """Restore a `state`; entries of other names are ignored."""
        for name, values in self._state().items():
            values[:] = state[name]

    def _state(self) -> dict[str, Array]:
        state = {"qpos": self.qpos, "qvel": self.qvel, "warmstart": self._warmstart}
        state |= self.commands.memory()
        if self.servo_model is not None:
            state |= self.servo_model.memory()
        return state


def _under_conditions(robot: RobotSpec, conditions: list[Condition]) -> dict[Condition, RobotSpec]:
    """Return the robot with the gains and at the temperature of each condition."""
    robots = {}
    for condition in dict.fromkeys(conditions):
        # First the temperature: damping below zero is taken from kd, in one ratio at any gains.
        warm = robot.at_temperature(condition.temperature)
        robots[condition] = warm.with_gains(condition.kp, condition.kd)
    return robots


def longest_delay(robot: RobotSpec, conditions: list[Condition]) -> float:
    """Return the longest delay of a servo under these conditions, s."""
    return float(robot.servo.delay.max()) + _largest_added_delay(conditions)


def _largest_added_delay(conditions: list[Condition]) -> float:
    """Return the largest delay that a changed simulator adds, s."""
    changes = [condition.simulator for condition in conditions]
    return max((change.delay for change in changes if change), default=0.0)


class _RecordedGains(NamedTuple):
    """Gains of each simulation's condition, of all joints of the robot, (num_envs, joints)."""

    kp_ratio: Array  # to the robot's own kp
    kd_ratio: Array  # to the robot's own kd
    kd: Array  # N·m·s/rad


def _recorded_gains(robot: RobotSpec, robots: list[RobotSpec]) -> _RecordedGains:
    """Return the gains of the robot in each simulation."""
    kp = np.array([one.servo.kp for one in robots])
    kd = np.array([one.servo.kd for one in robots])
    kp_ratio = kp / np.where(robot.servo.kp > 0, robot.servo.kp, 1.0)
    return _RecordedGains(kp_ratio, ratio_to(kd, robot.servo.kd), kd)


def _useful_threads(num_envs: int) -> int:
    """Return a number of threads; those with fewer than 16 simulations mostly wait."""
    return max(1, min(os.cpu_count() or 1, num_envs // 16))


def _compiled(
    robots: dict[Condition, RobotSpec],
    joint_names: tuple[str, ...],
    locked: tuple[str, ...],
    added_delay: float,
) -> dict[Condition, mujoco.MjModel]:
    """Return the model of each condition.

    Conditions that differ in their simulator alone share one compilation.

    Args:
        robots: Condition → robot with its gains, at its temperature.
        joint_names: Joints that are not locked.
        added_delay: Largest delay that a changed simulator adds, s. Every model then gets buffers
            for servos that are so late.

    Raises:
        UsageError: A changed simulator of a robot with a servo model, whose terms are not changed
            with it.
    """
    # Models of one batch have buffers of one length.
    shortest = min(c.dt / robot.steps_per(c.dt) for c, robot in robots.items())
    unchanged: dict[Condition, mujoco.MjModel] = {}
    models: dict[Condition, mujoco.MjModel] = {}
    for condition, robot in robots.items():
        own = condition.without_change
        if own not in unchanged:
            buffered = robot
            if added_delay:
                longest = float(robot.servo.delay.max()) + added_delay
                buffered = robot.with_servo(delay=np.full(len(robot.joint_names), longest))
            model = build_model(
                buffered,
                condition.payload_mass,
                condition.payload_side,
                condition.dt,
                locked,
                physics_only=True,
                shortest_step=shortest,
            )
            model.actuator_delay[:] = robot.servo.delay[robot.index(joint_names)]
            unchanged[own] = model
        models[condition] = unchanged[own]
        if condition.simulator is None:
            continue
        if robot.servo.has_terms:
            raise UsageError(
                f"{robot.name} has a servo model (friction at rest or by load, backlash, …), "
                "which other simulators do not have: train in many simulators with the robot "
                "before identification"
            )
        models[condition] = changed_model(unchanged[own], robot, joint_names, condition.simulator)
    return models


def expand_differences(batch: Batch, models: list[mujoco.MjModel]) -> None:
    """Expand every model field that differs between simulations, (nsim) models: a row may be
    copied over another's.
    """
    unique: list[mujoco.MjModel] = []
    place: dict[int, int] = {}  # id of a model → its place among the unique ones
    rows = []
    for model in models:
        if id(model) not in place:
            place[id(model)] = len(unique)
            unique.append(model)
        rows.append(place[id(model)])
    for name, values in differing_fields(unique).items():
        batch.expand(name)[:] = values[rows]


def differing_fields(models: list[mujoco.MjModel]) -> dict[str, Array]:
    """Return the values of every field in which models differ, (models, …) each."""
    fields: dict[str, Array] = {}
    if len(models) == 1:
        return fields
    for name in sorted(MODEL_FIELDS):
        values = [_field(model, name) for model in models]
        if values[0] is None:
            continue
        if any(not np.array_equal(value, values[0]) for value in values[1:]):
            fields[name] = np.stack(values)
    return fields


def _field(model: mujoco.MjModel, name: str) -> Any:
    """Return a model or option field as an array; None if it is none."""
    if name.startswith("opt."):
        value = getattr(model.opt, name[4:], None)
        return None if value is None or callable(value) else np.asarray(value)
    value = getattr(model, name, None)
    return value if isinstance(value, np.ndarray) else None
