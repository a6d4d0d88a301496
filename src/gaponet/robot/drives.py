"""Gains, torque limit and home of each joint: from a model's actuators, or from the user, and which."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from fnmatch import fnmatchcase

import mujoco
import numpy as np

from gaponet.base.errors import UsageError
from gaponet.robot.finding import abbreviate

NO_LIMIT = 1e6  # N·m
ON_JOINT = [int(mujoco.mjtTrn.mjTRN_JOINT), int(mujoco.mjtTrn.mjTRN_JOINTINPARENT)]


@dataclass(frozen=True)
class Drive:
    """One joint's drive, N·m/rad, N·m·s/rad, N·m and rad; each with its source. actuator: the name of its own."""

    name: str
    actuator: str
    kp: float
    kp_source: str
    kd: float
    kd_source: str
    limit: float
    limit_source: str
    home: float


def drives(
    model: mujoco.MjModel,
    joints: list[str],
    pose: np.ndarray,
    given: dict[str, tuple[str, ...]],
    file: str,
) -> tuple[Drive, ...]:
    """Drives of these hinges; given: kp, kd and effort_limit as the user wrote them.

    Raises:
        UsageError: A word is no number or names no joint, or a joint's kp is said nowhere.
    """
    said = {name: _given(name, words, joints) for name, words in given.items()}
    found, without = [], []
    for name in joints:
        j = model.joint(name).id
        mine = np.flatnonzero(np.isin(model.actuator_trntype, ON_JOINT) & (model.actuator_trnid[:, 0] == j)).tolist()
        kp, kd = _gains(model, mine)
        sources = dict.fromkeys(("kp", "kd"), f"its actuator in {file}")
        if not kp and name not in said["kp"]:
            without.append(name)
        if not kd:
            sources["kd"] = f"its actuator in {file} has none" if mine else f"{file} has none"
        if name in said["kp"]:
            kp, kd, sources["kp"], sources["kd"] = said["kp"][name], 0.0, "--kp", "--kp was given without --kd"
        if name in said["kd"]:
            kd, sources["kd"] = said["kd"][name], "--kd"
        limits = [*_limits(model, j, mine, file), (NO_LIMIT, f"{file} has none: write the motor's")]
        limit, why = min(limits, key=lambda x: x[0])
        if name in said["effort_limit"]:
            limit, why = said["effort_limit"][name], "--effort-limit"
        actuator = model.actuator(mine[0]).name if len(mine) == 1 else ""
        home = float(pose[model.jnt_qposadr[j]])
        found.append(Drive(name, actuator, kp, sources["kp"], kd, sources["kd"], limit, why, home))
    if without:
        raise UsageError(
            f"{file} has no position gain for {abbreviate(without)}: give those of the controller that recorded the "
            "logs, "
            "--kp 100 '*wrist*=20' and --kd likewise (N·m/rad, N·m·s/rad); where nobody knows them a guess will do, "
            "gaponet identify finds them within a factor of 50"
        )
    return tuple(found)


def _gains(model: mujoco.MjModel, actuators: list[int]) -> tuple[float, float]:
    """kp and kd at the joint, of all actuators that pull it towards a position or brake it."""
    kp = kd = 0.0
    for a in actuators:
        if model.actuator_biastype[a] == mujoco.mjtBias.mjBIAS_AFFINE:
            gear = float(model.actuator_gear[a, 0]) ** 2
            kp -= gear * float(model.actuator_biasprm[a, 1])
            kd -= gear * float(model.actuator_biasprm[a, 2])
    return round(max(kp, 0.0), 9), round(max(kd, 0.0), 9)


def _limits(model: mujoco.MjModel, j: int, actuators: list[int], file: str) -> Iterator[tuple[float, str]]:
    """Every torque limit that the model has for a joint, the smaller of both directions."""
    if model.jnt_actfrclimited[j]:
        yield float(np.abs(model.jnt_actfrcrange[j]).min()), f"actuatorfrcrange (in a URDF, effort) in {file}"
    for a in actuators:
        gear = abs(model.actuator_gear[a, 0])
        if model.actuator_forcelimited[a]:
            yield float(gear * np.abs(model.actuator_forcerange[a]).min()), f"forcerange in {file}"
        if model.actuator_ctrllimited[a] and model.actuator_biastype[a] == mujoco.mjtBias.mjBIAS_NONE:
            most = np.abs(model.actuator_ctrlrange[a] * model.actuator_gainprm[a, 0]).min()
            yield float(gear * most), f"ctrlrange of its motor in {file}"


def _given(name: str, words: tuple[str, ...], joints: list[str]) -> dict[str, float]:
    """("100", "*wrist*=20") → joint → number; the later word wins."""
    found: dict[str, float] = {}
    for word in words:
        pattern, _, number = word.rpartition("=")
        hit = [j for j in joints if fnmatchcase(j, pattern or "*")]
        try:
            value = float(number)
        except ValueError:
            value = np.nan
        flag = f"--{name.replace('_', '-')} {word}"
        if not (np.isfinite(value) and 0 <= value <= NO_LIMIT):
            raise UsageError(f"{flag}: give a number from 0 to {NO_LIMIT:g}, or PATTERN=NUMBER")
        if not hit:
            raise UsageError(f"{flag}: no such joint; there are: {', '.join(joints)}")
        found |= dict.fromkeys(hit, value)
    return found
