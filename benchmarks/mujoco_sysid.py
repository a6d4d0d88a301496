"""mujoco.sysid as a rival of gaponet identify, on the windows, start and bounds of plain_fit.py.

    pip install "mujoco[sysid]"
    python benchmarks/compare_methods.py --method benchmarks/mujoco_sysid.py:mujoco_sysid

Parameters, changes of the model, rollouts and the optimizer are those of mujoco.sysid. Some
defaults are replaced:

- States are compared. The position sensors of a rollout are one physics step older than their time.
- Residuals are errors in rad. The default divides each window by the norm of its own signal.
- A rollout function delays the commands. An actuator with a delay starts from a history of zeros.
- scipy's least squares with soft_l1 loss, as in plain_fit.py.
- A pseudo-inertia is written by `write_inertia`. That of MuJoCo 4.0.0 compiles the model between
  two bodies, and fails.
"""

from __future__ import annotations

import sys
from contextlib import redirect_stdout
from dataclasses import replace
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
from mujoco import sysid
from real_robots.methods import FittedSim
from real_robots.questions import Question

from gaponet.sim.model import stiffen_friction

sys.path.insert(0, str(Path(__file__).parent))
from plain_fit import EVALUATIONS, LOSS, STEP, Problem, equal_problem

FIELDS = "kp", "damping", "friction", "armature", "delay", "offset"  # in the order of Problem.start


def mujoco_sysid(question: Question) -> FittedSim:
    """Fit the parameters of each operated joint with mujoco.sysid."""
    problem = equal_problem(question)
    params, _ = fit(problem)
    return FittedSim(problem.robot_with(params.as_vector()))


def fit(problem: Problem, links: tuple[str, ...] = ()) -> tuple[sysid.ParameterDict, Any]:
    """Fit servos, and the pseudo-inertia of links; return parameters and the optimizer's result."""
    robot = problem.robot
    windows = []
    window_of: dict[int, int] = {}  # identity of an object of a window → its number
    for w, (spec, state) in enumerate(zip(problem.specs, problem.states, strict=True)):
        commands = problem.controls(np.zeros(len(problem.op)), w)
        times = np.arange(len(commands) + 1) * spec.option.timestep
        # The last command is not applied; recorded positions are in the problem.
        control = sysid.TimeSeries(times, np.append(commands, commands[-1:], axis=0))
        recorded = sysid.TimeSeries(times, np.zeros((len(times), 0)))
        window_of |= {id(spec): w, id(control): w, id(recorded): w}
        windows.append(sysid.ModelSequences(str(w), spec, str(w), state, control, recorded, True))

    def vector(params: sysid.ParameterDict) -> np.ndarray:
        return np.concatenate([params[field].value for field in FIELDS])

    def build(params: sysid.ParameterDict, spec: mujoco.MjSpec) -> mujoco.MjModel:
        servos = problem.servos(vector(params), window_of[id(spec)])
        for i, name in enumerate(robot.operated):
            values = {field: float(x[i]) for field, x in servos.items()}
            joint = spec.joint(name)
            sysid.apply_pdgain(spec, name, np.array([values["kp"], values["kd"]]))
            spec.actuator(name).biasprm[0] = values["kp"] * values["offset"]
            joint.damping[0] = values["damping"]
            joint.frictionloss = values["frictionloss"]
            joint.armature = values["armature"]
        for name in links:
            params[name].apply_modifier(spec)
        model = spec.compile()
        stiffen_friction(model)
        return model

    def rollout(control_signal: list[Any], param_dicts: list[Any], **rest: Any) -> Any:
        late = []
        # One window, many candidates.
        for control, params in zip(control_signal, param_dicts, strict=True):
            w = window_of[id(control)]
            delay = problem.servos(vector(params), w)["delay"]
            commands = np.append(problem.controls(delay, w), control.data[-1:], axis=0)
            late.append(replace(control, data=commands))
        return sysid.sysid_rollout(control_signal=late, **rest)

    def residual(
        params: Any, simulated: Any, recorded: Any, model: Any, every: bool, state: np.ndarray
    ) -> Any:
        return problem.errors(state, window_of[id(recorded)]), recorded, recorded

    residuals = sysid.build_residual_fn(
        models_sequences=windows,
        build_model=build,
        custom_rollout=rollout,
        modify_residual=residual,
        resample_true=False,
    )
    params = sysid.ParameterDict()
    starts = np.split(problem.start, len(FIELDS))
    lows = np.split(problem.low, len(FIELDS))
    highs = np.split(problem.high, len(FIELDS))
    for i, field in enumerate(FIELDS):
        params.add(sysid.Parameter(field, starts[i], lows[i], highs[i]))
    for name in links:
        spec = problem.specs[0].copy()  # the parameter changes it
        inertia = sysid.body_inertia_param(
            spec,
            spec.compile(),
            name,
            sysid.InertiaType.Pseudo,
            param_name=name,
            modifier=write_inertia,
            mass_bound_mult=np.array([0.3, 3.0]),
            ipos_bound_off=np.array([-0.1, 0.1]),
        )
        params.add(inertia)
    with redirect_stdout(sys.stderr):  # it prints each iteration
        fitted, result = sysid.optimize(
            params, residuals, "scipy_parallel_fd", max_iters=EVALUATIONS, diff_step=STEP, **LOSS
        )
    return fitted, result


def write_inertia(spec: mujoco.MjSpec, param: sysid.Parameter) -> None:
    """Write mass, centre and inertia of the body that a pseudo-inertia is named after."""
    pi = sysid.model_modifier.pi_from_theta(param.value)  # mass, mass · centre, inertia
    mass = pi[0]
    body = spec.body(param.name)
    body.explicitinertial = True
    body.mass = mass
    body.ipos = pi[1:4] / mass
    cross = sysid.model_modifier.skew(body.ipos)
    inertia = pi[4:].reshape(3, 3) + mass * cross @ cross
    body.iquat = [1, 0, 0, 0]
    body.inertia = [0, 0, 0]
    body.fullinertia = inertia[[0, 1, 2, 0, 0, 1], [0, 1, 2, 1, 2, 2]]
