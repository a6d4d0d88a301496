"""mujoco.sysid as a rival of gaponet identify, on the windows, start and bounds of plain_fit.py.

    pip install "mujoco[sysid]"
    gaponet experiment real --method benchmarks/mujoco_sysid.py:mujoco_sysid

Parameters, changes of the model, rollouts and the optimizer are those of mujoco.sysid. Some defaults are replaced:

- States are compared. The position sensors of a rollout are one physics step older than their time.
- Residuals are errors in rad. The default divides each window by the norm of its own signal.
- A rollout function delays the commands. An actuator with a delay starts from a history of zeros.
- scipy's least squares with soft_l1 loss, as in plain_fit.py.
"""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
from mujoco import sysid

from gaponet.experiments.real.methods import FittedSim
from gaponet.experiments.real.questions import Question
from gaponet.sim.model import stiffen_friction

sys.path.insert(0, str(Path(__file__).parent))
from plain_fit import EVALUATIONS, LOSS, STEP, equal_problem

FIELDS = "kp", "damping", "friction", "armature", "delay", "offset"  # in the order of Problem.start


def mujoco_sysid(question: Question) -> FittedSim:
    """Fit kp, damping, friction, armature, delay and offset of each operated joint with mujoco.sysid."""
    problem = equal_problem(question)
    robot, windows, window_of = problem.robot, [], {}
    for w, (spec, state) in enumerate(zip(problem.specs, problem.states, strict=True)):
        commands = problem.controls(np.zeros(len(problem.op)), w)
        times = np.arange(len(commands) + 1) * spec.option.timestep
        control = sysid.TimeSeries(times, np.append(commands, commands[-1:], axis=0))  # the last one is not applied
        recorded = sysid.TimeSeries(times, np.zeros((len(times), 0)))  # positions are in the problem
        window_of |= {id(spec): w, id(control): w, id(recorded): w}
        windows.append(sysid.ModelSequences(str(w), spec, str(w), state, control, recorded, True))

    def build(params: sysid.ParameterDict, spec: mujoco.MjSpec) -> mujoco.MjModel:
        servos = problem.servos(params.as_vector(), window_of[id(spec)])
        for i, name in enumerate(robot.operated):
            v = {field: float(x[i]) for field, x in servos.items()}
            actuator, joint = spec.actuator(name), spec.joint(name)
            sysid.apply_pdgain(spec, name, np.array([v["kp"], v["kd"]]))
            actuator.biasprm[0], joint.damping[0] = v["kp"] * v["offset"], v["damping"]
            joint.frictionloss, joint.armature = v["frictionloss"], v["armature"]
        model = spec.compile()
        stiffen_friction(model)
        return model

    def rollout(control_signal: list[Any], param_dicts: list[Any], **rest: Any) -> Any:
        late = []
        for control, params in zip(control_signal, param_dicts, strict=True):  # one window, many candidates
            w = window_of[id(control)]
            delay = problem.servos(params.as_vector(), w)["delay"]
            late.append(replace(control, data=np.append(problem.controls(delay, w), control.data[-1:], axis=0)))
        return sysid.sysid_rollout(control_signal=late, **rest)

    def residual(params: Any, simulated: Any, recorded: Any, model: Any, every: bool, state: np.ndarray) -> Any:
        return problem.errors(state, window_of[id(recorded)]), recorded, recorded

    residuals = sysid.build_residual_fn(
        models_sequences=windows, build_model=build, custom_rollout=rollout, modify_residual=residual,
        resample_true=False,
    )  # fmt: skip
    params, bounds = sysid.ParameterDict(), (problem.start, problem.low, problem.high)
    for field, start, low, high in zip(FIELDS, *(np.split(x, len(FIELDS)) for x in bounds), strict=True):
        params.add(sysid.Parameter(field, start, low, high))
    fitted, _ = sysid.optimize(params, residuals, "scipy_parallel_fd", max_iters=EVALUATIONS, diff_step=STEP, **LOSS)
    return FittedSim(problem.robot_with(fitted.as_vector()))
