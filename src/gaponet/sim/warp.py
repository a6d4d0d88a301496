"""Simulations of a BatchSim by mujoco_warp, thousands at once on a GPU; on the CPU for tests.

Arrays are float32 torch tensors on the device. They serve training; scores and identification use C
MuJoCo, from which these simulations deviate by about 1e-6 rad in a second.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from types import FunctionType
from typing import Any, NamedTuple

import mujoco
import mujoco_warp
import numpy as np
import torch
import warp
from mujoco.batch import MODEL_FIELDS
from torch import Tensor

from gaponet.base.errors import UsageError
from gaponet.sim import servo
from gaponet.sim.batch import BatchSim
from gaponet.sim.commands import CommandHistory, Commands, ControlPeriods
from gaponet.sim.servo_model import ServoModel

# of a simulation whose links collide
MAX_CONTACTS = 48
CONSTRAINTS_PER_CONTACT = 4
# field of Data → name in BatchSim.state
STATE = {"qpos": "qpos", "qvel": "qvel", "qacc_warmstart": "warmstart"}
SERVO = {"actuator_force": "servo_torque", "qfrc_bias": "servo_load"}
HISTORY = ("history", "time")

_Floats: Any = warp.array2d(dtype=float)
_Pairs: Any = warp.array2d(dtype=warp.vec2)
_Parameters: Any = warp.array2d(dtype=warp.types.vector(10, float))  # of an actuator's gain or bias


def _servo_struct() -> Any:
    """Return SERVO_RECORD of sim/servo.py as a Warp struct of float32."""
    fields = dict.fromkeys(servo.SERVO_RECORD.names or (), float)
    return warp.struct(type("Servo", (), {"__annotations__": fields, "__module__": __name__}))


_Servo = _servo_struct()
_Servos: Any = warp.array2d(dtype=_Servo)


def _warp_function(function: Any, **others: Any) -> Any:
    """Return a function of sim/servo.py for kernels, with Warp's functions in place of NumPy's."""
    names = vars(servo) | {"np": warp, "exp": warp.exp} | others
    copied = FunctionType(function.__code__, names, function.__name__)
    copied.__annotations__ = function.__annotations__
    return warp.func(copied)


_torque = _warp_function(servo.requested_torque)
_limits = _warp_function(servo.motor_limits, torque_range=_warp_function(servo.torque_range))
_friction = _warp_function(
    servo.joint_friction,
    passing_friction=_warp_function(servo.passing_friction),
    resting_friction=_warp_function(servo.resting_friction),
)


@warp.kernel(enable_backward=False)  # type: ignore[untyped-decorator]
def _set_servos(
    servos: _Servos,
    offset: _Floats,
    gain: _Parameters,
    ctrl: _Floats,
    qpos: _Floats,
    qvel: _Floats,
    torque: _Floats,
    load: _Floats,
    bias: _Parameters,
    friction: _Floats,
    force: _Pairs,
) -> None:
    """Set bias, torque limits and friction of servo j of world i for the next physics step, as
    servo.set_servos does.

    Where a servo has a no-load speed, every world has its own torque limits `force`.
    """
    i, j = warp.tid()
    one = servos[i, j]
    friction[i, j] = _friction(one, qvel[i, j], torque[i, j], load[i, j])
    if one.min_torque > 0.0 or one.encoder_step > 0.0:
        kp = gain[i, j][0]
        aim = ctrl[i, j] + offset[i, j] / kp
        wanted = _torque(one, kp, aim, qpos[i, j])
        bias[i, j][0] = wanted - kp * (ctrl[i, j] - qpos[i, j])
    if one.no_load_speed > 0.0:
        low, high = _limits(one, qvel[i, j])
        force[i, j] = warp.vec2(low, high)


def _own_fields(sim: BatchSim, rows: np.ndarray) -> dict[str, np.ndarray]:
    """Return the fields of mujoco_warp's model that differ between simulations, (rows, …) each.

    MuJoCo's other fields are precomputed values or have no effect on motion.
    """
    own = {}
    for name in sorted(MODEL_FIELDS):
        values = sim.batch.expanded(name)
        if values is not None and name in mujoco_warp.Model.__dataclass_fields__:
            own[name] = values[rows]
    return own


class _Worlds:
    """Simulations of one control period: mujoco_warp steps all of its worlds, equally often."""

    def __init__(self, sim: BatchSim, rows: np.ndarray, device: str) -> None:
        self.device = warp.get_device(device)
        self.nstep = int(sim.periods.nstep[rows[0]])
        self._graphs = dict[Any, Any]()
        model = next(iter(sim.models.values()))
        timestep = sim.batch.expanded("opt.timestep")
        if timestep is None:
            timestep = np.full(sim.num_envs, model.opt.timestep)
        own = _own_fields(sim, rows)
        contacts = MAX_CONTACTS
        if model.opt.disableflags & mujoco.mjtDisableBit.mjDSBL_CONTACT:
            contacts = 0
        constraints = max(64, 2 * model.nv + CONSTRAINTS_PER_CONTACT * contacts)
        with warp.ScopedDevice(self.device):
            try:
                self.model = mujoco_warp.put_model(model, batch_sizes=dict.fromkeys(own, len(rows)))
            except (NotImplementedError, ValueError) as error:
                raise UsageError(
                    f"{sim.robot.name}: mujoco_warp does not support its model ({error}); use "
                    "--device cpu"
                ) from None
            self.data = mujoco_warp.put_data(
                model, mujoco.MjData(model), len(rows), contacts or None, njmax=constraints
            )
            self.model.opt.timestep = warp.array(timestep[rows], dtype=float)
            # put_model's is 1e-6 at least
            self.model.opt.tolerance = warp.array([model.opt.tolerance], dtype=float)
            # float32 seldom reaches that tolerance: no message each time, as in C MuJoCo.
            self.model.opt.warn_overflow &= ~mujoco_warp.OverflowType.ITERATIONS
            self._servo_inputs: list[Any] | None = None
            if sim.servo_model is not None:
                self._servo_inputs = self._inputs(sim.servo_model, rows)
        for name, values in own.items():
            view = warp.to_torch(getattr(self.model, name))
            view.copy_(torch.tensor(values).reshape(view.shape))

    def _inputs(self, servo_model: ServoModel, rows: np.ndarray) -> list[Any]:
        """Return the arguments of _set_servos."""
        data = self.data
        single = servo_model.servos.latest_records()[rows].astype(_Servo.numpy_dtype())
        return [
            warp.array(single, dtype=_Servo),
            warp.array(servo_model.state.bias[rows], dtype=float),
            self.model.actuator_gainprm,
            data.ctrl,
            data.qpos,
            data.qvel,
            data.actuator_force,
            data.qfrc_bias,
            self.model.actuator_biasprm,
            self.model.dof_frictionloss,
            self.model.actuator_forcerange,
        ]

    def bind(self, name: str) -> Tensor:
        """Return a live view of a field of all worlds, (nworld, …)."""
        result: Tensor = warp.to_torch(getattr(self.data, name))
        return result

    def bind_all(self, names: list[str]) -> dict[str, Tensor]:
        """Return live views by name."""
        return {name: self.bind(name) for name in names}

    def period(self) -> None:
        """Advance by a control period."""
        for _ in range(self.nstep):
            if self._servo_inputs is not None:
                warp.launch(_set_servos, self.data.ctrl.shape, self._servo_inputs)
            mujoco_warp.step(self.model, self.data)

    def bias_forces(self) -> None:
        """Compute gravity's and Coriolis forces from positions and velocities: a small part of a
        physics step.
        """
        for part in (mujoco_warp.fwd_kinematics, mujoco_warp.com_vel, mujoco_warp.rne):
            part(self.model, self.data)

    def launch(self, kernels: Callable[[], None]) -> None:
        """Launch the kernels of `period` or `bias_forces`; on a GPU as one CUDA graph, on torch's
        stream.
        """
        with warp.ScopedDevice(self.device):
            if self.device.is_cuda:
                if kernels not in self._graphs:
                    self._graphs[kernels] = self._captured(kernels)
                stream = warp.stream_from_torch(torch.cuda.current_stream())
                warp.capture_launch(self._graphs[kernels], stream)
            else:
                kernels()

    def _captured(self, kernels: Callable[[], None]) -> Any:
        """Return the kernels as a CUDA graph; they are compiled by a launch that is undone."""
        moved = []
        for name in (*STATE, *HISTORY, *SERVO):
            if getattr(self.data, name).size:
                moved.append(self.bind(name))
        before = [view.clone() for view in moved]
        torch.cuda.synchronize()
        kernels()
        warp.synchronize_device(self.device)
        for view, old in zip(moved, before, strict=True):
            view.copy_(old)
        torch.cuda.synchronize()
        with warp.ScopedCapture(self.device) as capture:
            kernels()
        return capture.graph


def _warp_device(device: str) -> str:
    """Return Warp's name of a device, "cuda" or "warp-cpu", and refuse one that is not there."""
    on_gpu = device == "cuda"
    warp.config.log_level = warp.LOG_WARNING if on_gpu else warp.LOG_ERROR
    name = f"cuda:{torch.cuda.current_device()}" if on_gpu else "cpu"
    try:
        warp.get_device(name)
    except (ValueError, RuntimeError) as error:
        raise UsageError(f"device {name}: Warp has no such device ({error}); use cpu") from None
    return name


class _AllWorlds:
    """Worlds of all control periods, and their fields for all simulations together.

    Attributes:
        of_rates: Worlds of each control period.
        fields: Field of Data → values of all simulations, (num_envs, …); live.
    """

    def __init__(self, sim: BatchSim, device: str, names: list[str]) -> None:
        """names: Fields that are seen together."""
        self.of_rates: list[_Worlds] = []
        self._views: list[dict[str, Tensor]] = []
        self._rows: list[Tensor] = []  # of each one's simulations
        nstep = sim.periods.nstep
        for n in np.unique(nstep):
            rows = np.flatnonzero(nstep == n)
            worlds = _Worlds(sim, rows, device)
            views = worlds.bind_all(names)
            self.of_rates.append(worlds)
            self._views.append(views)
            self._rows.append(torch.as_tensor(rows).to(views["qpos"].device))
        self.fields = self._views[0]
        if len(self.of_rates) > 1:
            self.fields = {}
            for name, view in self._views[0].items():
                self.fields[name] = view.new_zeros(sim.num_envs, *view.shape[1:])

    def model_field(self, name: str) -> Tensor:
        """Return a copy of a field that differs between simulations, (num_envs, …)."""
        parts = [warp.to_torch(getattr(worlds.model, name)) for worlds in self.of_rates]
        order = torch.argsort(torch.cat(self._rows))
        return torch.cat(parts)[order]

    def each_rate(self) -> Iterator[_Worlds]:
        """Yield the worlds of each control period with their simulations' state, and copy it
        back.
        """
        if len(self.of_rates) == 1:
            yield self.of_rates[0]
            return
        for worlds, views, rows in zip(self.of_rates, self._views, self._rows, strict=True):
            for name, view in views.items():
                view.copy_(self.fields[name][rows])
            yield worlds
            for name, view in views.items():
                self.fields[name][rows] = view


class _Motors(NamedTuple):
    """Motors of the servo model, (num_envs, n) each, that ask for gain · (target − q) + bias."""

    gain: Tensor  # N·m/rad
    bias: Tensor  # N·m
    most: Tensor  # largest torque, N·m

    def torque(self, ids: Any, ahead: Any) -> Tensor:
        """Return the torque of simulations whose targets are `ahead` of q, (k, n) rad, in N·m."""
        most = self.most[ids]
        return torch.clamp(self.gain[ids] * ahead + self.bias[ids], -most, most)


class WarpSim:
    """Copy of a BatchSim on a device, with its payloads, control periods, servos and state.

    `qpos`, `qvel` and `torque` are live (num_envs, n) float32 tensors on the device: a write is the
    state at the next step.
    """

    def __init__(self, sim: BatchSim, device: str = "cuda") -> None:
        """device: "cuda", torch's present GPU (of several processes each has its own), or
        "warp-cpu", Warp's CPU.

        Raises:
            UsageError: No such device, or servos with backlash.
        """
        if sim.servo_model is not None and sim.servo_model.servos.terms["backlash"].any():
            raise UsageError(
                f"{sim.robot.name}: no GPU simulates its backlash; use --device cpu, or backlash "
                "= 0"
            )
        model = next(iter(sim.models.values()))
        names = [*STATE, "ctrl", "actuator_force"]
        if model.nhistory:
            names += HISTORY
        if sim.servo_model is not None:
            names.append("qfrc_bias")
        self._worlds = _AllWorlds(sim, _warp_device(device), names)
        fields = self._worlds.fields
        self.qpos = fields["qpos"]
        self.qvel = fields["qvel"]
        self.torque = fields["actuator_force"]
        periods = ControlPeriods(self.array(sim.periods.nstep), self.array(sim.periods.timestep))
        history = None
        if model.nhistory:
            history = CommandHistory(fields["history"], fields["time"], model)
        joint_range = self.array(sim.commands.range)
        self.commands = Commands(fields["ctrl"], joint_range, periods, history)
        if sim.commands.max_change is not None:
            self.commands.max_change = self.array(sim.commands.max_change)
        self._motors: _Motors | None = None  # without the servo model
        if sim.servo_model is not None:
            gain = self.array(sim.batch.expand("actuator_gainprm")[..., 0])
            bias = self.array(sim.servo_model.state.bias)
            most = self.array(sim.servo_model.servos.records["effort_limit"])
            self._motors = _Motors(gain, bias, most)
        self.set_state(sim.state())

    @property
    def num_envs(self) -> int:
        """Number of simulations."""
        return len(self.qpos)

    def model_field(self, name: str) -> Tensor:
        """Return a copy of a field of the model that differs between simulations, (num_envs, …).

        Bias, friction and torque limits of a servo model are those of the last physics step.
        """
        return self._worlds.model_field(name)

    def array(self, values: Any) -> Tensor:
        """Copy values to the device, floats as float32, without waiting."""
        values = torch.as_tensor(values)
        result: Tensor = values.to(
            self.qpos.device,
            torch.float32 if values.is_floating_point() else None,
            non_blocking=True,
        )
        return result

    def reset(self, ids: Any, qpos: Any, qvel: Any, past: Any = None) -> None:
        """Reset as BatchSim.reset does; arrays of any kind."""
        ids = ids if isinstance(ids, slice) else self.array(ids)
        past = None if past is None else self.array(past)
        self.qpos[ids] = self.array(qpos)
        self.qvel[ids] = self.array(qvel)
        self._worlds.fields["qacc_warmstart"][ids] = 0.0
        self.commands.reset(ids, self.qpos[ids], past)
        if self._motors is None:
            return
        ahead = 0.0 if past is None else past[:, 0] - self.qpos[ids]
        self.torque[ids] = self._motors.torque(ids, ahead)
        load = self._worlds.fields["qfrc_bias"]
        before = load.clone()
        for worlds in self._worlds.each_rate():
            worlds.launch(worlds.bias_forces)
        before[ids] = load[ids]
        load.copy_(before)

    def step(self, ctrl: Any, ids: Any = None) -> None:
        """Step as BatchSim.step does: all are stepped, and the others are restored."""
        before = {} if ids is None else self.state()
        self.commands.send(self.array(ctrl))
        for worlds in self._worlds.each_rate():
            worlds.launch(worlds.period)
        history = self.commands.history
        if history is not None:
            # a float32 tells physics steps apart for minutes only, so the clock starts again
            history.times -= history.time[:, None, None]
            history.time.zero_()
        if ids is not None:
            moved = self.array(ids)
            for name, values in self._state().items():
                values.copy_(before[name].index_copy(0, moved, values[moved]))

    def state(self) -> dict[str, Tensor]:
        """Return copies of the complete state, as BatchSim.state does."""
        return {name: values.clone() for name, values in self._state().items()}

    def set_state(self, state: dict[str, Any]) -> None:
        """Restore a `state` of this object or of a BatchSim."""
        for name, values in self._state().items():
            values.copy_(self.array(state[name]))

    def _state(self) -> dict[str, Tensor]:
        fields = self._worlds.fields
        state = {name: fields[field] for field, name in STATE.items()}
        state |= self.commands.memory()
        if self._motors is not None:
            state |= {name: fields[field] for field, name in SERVO.items()}
        return state
