"""Does the command alone hold the robot up, or a torque beside it: gravity compensation, inverse dynamics?

A PD controller's torque is kp (command − position) at rest; with a feed-forward torque it is that and a share of the
weight, and the joint sags less than kp says. Recorded torque at rest is fitted to both. Behind backlash, or in a sensor
behind the gears, the torque seems to be the weight alone, but the joint sags as kp says.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from gaponet.base.arrays import Array
from gaponet.data.checks.completeness import unsigned_torque
from gaponet.data.checks.static_checks import MAX_FOLDS, SIGNIFICANCE, solve
from gaponet.data.checks.survey import Survey
from gaponet.data.offsets import Gravity
from gaponet.robot.finding import Finding, abbreviate
from gaponet.robot.spec import RobotSpec

MIN_HOLDS, MIN_RECORDINGS = 12, 3  # of a joint
MIN_LOAD = 0.01  # of the torque limit, by which the weight on a joint changes
MIN_SHARE = 0.3  # of the weight that the command does not hold
MIN_UNEXPLAINED, MIN_IMPROVEMENT = 0.02, 8.0  # share of the torque that PD does not explain; times as much as with it
MAX_SAG = (0.25, 2.5)  # of the sag that kp and the weight give: at a share of 1, and more per share below
MIN_JOINTS_SHARE = 1 / 3  # of the joints that are judged


def feedforward(surveys: list[Survey], robot: RobotSpec, model: Gravity) -> Iterator[Finding]:
    """Is a torque fed forward beside the position command?"""
    recorded = [(s, s.torque) for s in surveys if s.torque is not None]
    if not recorded or unsigned_torque(recorded, robot):
        return
    shares = {name: x for j, name in enumerate(robot.joint_names) if (x := _shares(surveys, robot, model, j))}
    fed = {name: x for name, x in shares.items() if x[0] > 0}
    if not shares or len(fed) < MIN_JOINTS_SHARE * len(shares):
        what = "no torque beside the commands is seen at rest" if shares else "too few rests with torque to tell"
        yield Finding("ok", "feed-forward", what)
        return
    share, alone, both = np.clip(np.median(list(fed.values()), axis=0), 0, 1)
    text = (
        f"at rest the commands of {abbreviate(list(fed))} hold only {1 - share:.0%} of the weight: kp times their "
        f"distance explains {alone:.0%} of the torque, with the rest of the weight {both:.0%} (recordings not "
        "fitted). A torque is fed forward beside the command, such as gravity compensation, or an integral term holds "
        "the joint. Name its column in logs.toml (feedforward_torque); without it, gaponet identify takes the missing "
        "sag for stiffer motors, and a simulator needs the same torque"
    )
    yield Finding("warning", "feed-forward", text, tuple(fed), {name: x[0] for name, x in fed.items()})


def _shares(surveys: list[Survey], robot: RobotSpec, model: Gravity, joint: int) -> tuple[float, float, float] | None:
    """Return the share of a joint's weight that is fed forward (0 if it may be none), and the shares of its torque that
    PD alone and both explain; None with too few holds, or without a weight that changes."""
    parts = [np.zeros((0, 5))]
    for number, s in enumerate(surveys):
        own = s.holds[s.holds[:, 0] == joint] if s.holds is not None else ()
        if len(own):
            meta, kp = s.entry.meta, max(float(robot.with_gains(*s.entry.meta.recorded_gains).kp[joint]), 1e-9)
            weight = model(own[:, 3:], meta.payload_mass, meta.payload_side)[:, joint]
            columns = (np.full(len(own), number), own[:, 2] / kp, weight / kp, own[:, 1], own[:, 3 + joint])
            parts.append(np.stack(columns, axis=1))
    recording, torque, weight, error, qpos = np.concatenate(parts).T  # (k,); torques over kp, rad
    numbers, fold = np.unique(recording, return_inverse=True)
    least = MIN_LOAD * robot.effort_limit[joint] / max(robot.kp[joint], 1e-9)
    if len(torque) < MIN_HOLDS or len(numbers) < MIN_RECORDINGS or np.std(weight) < least:
        return None
    fold = fold % MAX_FOLDS
    sag, _, _ = _explained(error, fold, weight)
    _, _, alone = _explained(torque, fold, error, qpos)  # qpos: command and state may differ in scale
    share, std, both = _explained(torque, fold, weight, error, qpos)
    significant = share > max(MIN_SHARE, SIGNIFICANCE * std) and sag < MAX_SAG[0] + MAX_SAG[1] * max(1 - share, 0.0)
    better = 1 - alone > max(MIN_UNEXPLAINED, MIN_IMPROVEMENT * (1 - both))
    return (share if significant and better else 0.0), alone, both


def _explained(values: Array, fold: Array, *columns: Array) -> tuple[float, float, float]:
    """Return the robust coefficient of the first column, its standard error, and the share of the variance of the
    values that fits to the other folds explain."""
    x = np.stack([*columns, np.ones_like(values)], axis=1)
    start, free = np.zeros(x.shape[1]), np.full(x.shape[1], 1e3)
    folds = np.unique(fold)
    each = np.array([solve(x[fold != f], values[fold != f], start, free)[0] for f in folds])
    left = values - np.einsum("kc,kc->k", x, each[np.searchsorted(folds, fold)])
    std = np.sqrt((len(each) - 1) * each[:, 0].var())
    share = 1 - float(np.mean(left**2)) / max(float(np.var(values)), 1e-12)
    return float(solve(x, values, start, free)[0][0]), float(std), share
