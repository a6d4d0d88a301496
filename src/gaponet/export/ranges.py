"""What to randomise in training: units drawn from what is known of a robot, and how far each number goes by itself.

Today: the errors of this robot's values. Any day: what sessions on several days found besides. Any robot of its type:
what several units differ by. Days and units are drawn whole, so what goes together in all joints (a cold day) stays
together; drawing each number alone from its range trains on robots that do not exist. What motions show are torques
over kp: a unit whose kp errs has its torque limit err with it, or it could not move its own friction.
"""

from __future__ import annotations

import inspect
from collections.abc import Sequence as ListOf
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np

from gaponet.base.arrays import Array
from gaponet.base.errors import UsageError
from gaponet.base.files import lock_folder, write_json, write_text
from gaponet.export import unit_of_mujoco
from gaponet.robot.spec import RobotSpec, load_robot
from gaponet.sysid.uncertainty import ParameterUncertainty, from_axes, prior_std, to_axes

Scope = Literal["today", "any-day", "any-robot"]
Engine = Literal["json", "mujoco", "mjlab", "isaaclab"]

KIND = "engine"
FILE = "randomization.json"
DRAWN, RANGE = 4096, (5, 95)  # for the ranges, per cent
LOST = 0.8  # of what is believed before any log: an error as large says that no log knows the number
SIGNED = ("offset",)
FEWEST = 3  # robots of a type


@dataclass(frozen=True)
class Ranges:
    """Units of a robot: field → (samples, n) in SI; joint → field → low, value, high; numbers that nobody knows."""

    robot: str
    scope: Scope
    units: dict[str, Array]
    ranges: dict[str, dict[str, tuple[float, float, float]]]
    unknown: tuple[str, ...]
    notes: tuple[str, ...]


def ranges(
    robot: RobotSpec | Path, scope: Scope = "today", others: ListOf[Path] = (), samples: int = 256, seed: int = 0
) -> Ranges:
    """Draw units.

    Args:
        robot: Robot folder that gaponet identify or gaponet adapt wrote.
        scope: today: this robot as it was last fitted. any-day: as sessions on different days found it. any-robot: as
            robots of its type differ.
        others: Robot folders of the type, each identified from its own logs.
        samples: How many units.
        seed: What the drawing starts from.

    Raises:
        UsageError: What the scope needs is not there; the message says what is missing.
    """
    spec = robot if isinstance(robot, RobotSpec) else load_robot(robot)
    known = ParameterUncertainty.require(spec)
    fields, joints = known.fields, spec.operated
    now = np.stack([known.array(j, "values") for j in joints])
    covariance = np.stack([known.array(j, "covariance") for j in joints])
    middle, apart, notes = now, np.zeros((0, *now.shape)), list[str]()
    if scope != "today":
        each = _days(known, joints) if scope == "any-day" else _robots(spec, fields, others)
        middle = each.mean(axis=0)
        apart = (each - middle) * np.sqrt((1 + 1 / len(each)) / (len(each) - 1))
        what = "days" if scope == "any-day" else "robots"
        notes.append(f"from {len(each)} {what}: how far they differ is known to a factor of {_factor(len(each)):.1f}")
    lost = np.sqrt(np.einsum("njj->nj", covariance)) > LOST * prior_std(fields, now)
    rng, count, alone = np.random.default_rng(seed), max(DRAWN, samples), _alone(apart)
    x = middle + np.sqrt(1 - alone) * np.einsum("sd,dnp->snp", rng.standard_normal((count, len(apart))), apart)
    x = x + np.sqrt(alone * np.square(apart).sum(axis=0)) * rng.standard_normal(x.shape)
    limit = np.repeat(spec.effort_limit[spec.operated_index][None], count, axis=0)
    for i in range(len(joints)):
        error = rng.multivariate_normal(np.zeros(len(fields)), covariance[i], count, method="eigh")
        x[:, i] += error
        limit[:, i] *= np.exp(error[:, fields.index("kp")])
    bounded = [f not in SIGNED and f not in ("kp", "stribeck_speed") for f in fields]
    x = np.where(bounded, np.maximum(x, 0.0), x)
    drawn, value = from_axes(fields, x), from_axes(fields, middle)
    found = {
        j: {
            f: (float(low), float(value[f][i]), float(high))
            for f in fields
            for low, high in [np.percentile(drawn[f][:, i], RANGE)]
        }
        for i, j in enumerate(joints)
    }
    unknown = tuple(f"{j}: {f}" for i, j in enumerate(joints) for k, f in enumerate(fields) if lost[i, k])
    units = {f: v[:samples] for f, v in (drawn | {"effort_limit": limit}).items()}
    return Ranges(spec.name, scope, units, found, unknown, tuple(notes))


def _days(known: ParameterUncertainty, joints: tuple[str, ...]) -> Array:
    """What each session found, (days, n, P); the last of those that name the same day."""
    units = {s["unit"] for s in known.sources}
    if len(units) > 1:
        raise UsageError(
            f"any-day: these sessions are of units {', '.join(sorted(units))}; days of one unit are needed, or --scope "
            "any-robot with --units"
        )
    days = {s["days"] or (f"session {i}",): s for i, s in enumerate(known.sources)}
    if len(days) < 2:
        raise UsageError(
            "any-day: this robot is known from one day; adapt it with logs of another one (gaponet adapt ROBOT "
            "LOGS --out ROBOT_2) and export that"
        )
    return np.array([[s["values"][j] for j in joints] for s in days.values()])


def _robots(spec: RobotSpec, fields: tuple[str, ...], others: ListOf[Path]) -> Array:
    """Values of this robot and of others, (robots, n, P)."""
    found = [spec, *(load_robot(folder) for folder in others)]
    if len(found) < FEWEST:
        raise UsageError(
            f"any-robot: how robots of this type differ cannot be told from {len(found)}; give --units with at least "
            f"{FEWEST - 1} more robot folders, each identified from its own logs"
        )
    for one in found:
        if one.operated != spec.operated:
            raise UsageError(f"{one.folder}: operates {', '.join(one.operated)}; this robot {', '.join(spec.operated)}")
    return np.stack([np.stack(list(to_axes(one, fields).values())) for one in found])


def _alone(apart: Array) -> float:
    """Share of the variance between few days or robots (k, n, P) that is drawn number by number: what goes together in
    k of them may do so by chance (Schäfer and Strimmer 2005, shrinkage of correlations)."""
    if len(apart) < FEWEST:
        return 0.0
    flat = apart.reshape(len(apart), -1)
    flat = flat[:, np.square(flat).sum(axis=0) > 0]
    r = np.corrcoef(flat.T)[np.triu_indices(flat.shape[1], 1)]
    return float(min(1.0, ((1 - r**2) ** 2).sum() / (len(flat) - 1) / np.square(r).sum()))


def _factor(count: int) -> float:
    """How far a standard deviation of so many may be off, 9 of 10 times."""
    from scipy.stats import chi2

    return float(np.sqrt((count - 1) / chi2.ppf(0.1, count - 1)))


def write_ranges(made: Ranges, engine: Engine, folder: Path) -> Path:
    """The file of an engine, beside the units and ranges as JSON."""
    text = {"mujoco": _mujoco, "mjlab": _mjlab, "isaaclab": _isaaclab}.get(engine)
    with lock_folder(folder, KIND):
        write_json(folder / FILE, {
            "robot": made.robot, "scope": made.scope, "joints": list(made.ranges),
            "ranges": {j: {f: dict(zip(("low", "value", "high"), r, strict=True)) for f, r in by.items()}
                       for j, by in made.ranges.items()},
            "units": {f: np.round(v, 9) for f, v in made.units.items()}, "unknown": made.unknown, "notes": made.notes,
        })  # fmt: skip
        if text is not None:
            write_text(folder / f"{engine}_randomization.py", text(made))
    return folder / (FILE if text is None else f"{engine}_randomization.py")


def _mujoco(made: Ranges) -> str:
    return inspect.getsource(unit_of_mujoco)


def _two(made: Ranges, joint: str, field: str) -> tuple[float, float]:
    low, _, high = made.ranges[joint].get(field, (0.0, 0.0, 0.0))
    return float(f"{low:.6g}"), float(f"{high:.6g}")


def _mjlab(made: Ranges) -> str:
    """Event terms of mjlab 1.6, one per joint and number."""
    terms = ""
    for joint in made.ranges:
        for field in ("damping", "frictionloss", "armature"):
            terms += (
                f'    "{joint}_{field}": EventTermCfg(mode="startup", func=dr.dof_{field}, params={{"ranges": '
                f'{_two(made, joint, field)!r},\n        "operation": "abs", '
                f'"asset_cfg": SceneEntityCfg("robot", joint_names=("{joint}",))}}),\n'
            )
        low, high = (x / made.ranges[joint]["kp"][1] for x in _two(made, joint, "kp"))
        terms += (
            f'    "{joint}_kp": EventTermCfg(mode="startup", func=dr.pd_gains, params={{"kp_range": '
            f'({low:.5f}, {high:.5f}), "kd_range": (1.0, 1.0),\n        "asset_cfg": SceneEntityCfg("robot", '
            f'actuator_names=("{joint}",))}}),\n'
        )
    return (
        f"{_head(made, 'mjlab 1.6')}from mjlab.envs.mdp import dr\nfrom mjlab.managers import EventTermCfg, "
        f"SceneEntityCfg\n\nEVENTS = {{  # of ManagerBasedRlEnvCfg(events=…)\n{terms}}}\n{_late(made)}"
    )


def _isaaclab(made: Ranges) -> str:
    """Event terms of Isaac Lab 2 and 3."""
    terms = ""
    for joint in made.ranges:
        asset = f'"asset_cfg": SceneEntityCfg("robot", joint_names=["{joint}"]), "operation": "abs"'
        terms += (
            f'    "{joint}_gains": EventTermCfg(mode="startup", func=mdp.randomize_actuator_gains, '
            f"params={{{asset},\n"
            f'        "stiffness_distribution_params": {_two(made, joint, "kp")!r}}}),\n'
            f'    "{joint}_joint": EventTermCfg(mode="startup", func=mdp.randomize_joint_parameters, '
            f"params={{{asset},\n"
            f'        "friction_distribution_params": {_two(made, joint, "frictionloss")!r},\n'
            f'        "armature_distribution_params": {_two(made, joint, "armature")!r}}}),\n'
        )
    damping = {joint: _two(made, joint, "damping") for joint in made.ranges}
    return (
        f"{_head(made, 'Isaac Lab')}import isaaclab.envs.mdp as mdp\nfrom isaaclab.managers import EventTermCfg, "
        f"SceneEntityCfg\n\nEVENTS = {{  # attributes of your EventCfg\n{terms}}}\n"
        f"# N·m·s/rad, viscous: no term of Isaac Lab's randomises it alone\nDAMPING = {damping!r}\n{_late(made)}"
    )


def _head(made: Ranges, engine: str) -> str:
    return (
        f'"""Ranges of {made.robot} ({made.scope}) for {engine}, 9 of 10 units inside. Drawn one by one they are wider '
        f'than\nthe robot: whole units, with what goes together, are in {FILE}."""\n\n'
    )


def _late(made: Ranges) -> str:
    delays = {joint: _two(made, joint, "delay") for joint in made.ranges}
    offsets = {joint: _two(made, joint, "offset") for joint in made.ranges}
    return (
        f"# s: the actuators' lags; rad: what a servo adds to its target\nDELAYS = {delays!r}\nOFFSETS = {offsets!r}\n"
    )


def as_rows(made: Ranges, scales: dict[str, tuple[str, float]]) -> tuple[list[str], list[list[str]]]:
    """Headings and rows: joint, low … high of each number that is there. scales: field → heading, factor from SI."""
    fields = [f for f in next(iter(made.ranges.values())) if any(by[f][2] for by in made.ranges.values())]
    rows: list[list[Any]] = [
        [j, *(f"{by[f][0] * scales[f][1]:.3g} … {by[f][2] * scales[f][1]:.3g}" for f in fields)]
        for j, by in made.ranges.items()
    ]
    return ["joint", *(scales[f][0] for f in fields)], rows
