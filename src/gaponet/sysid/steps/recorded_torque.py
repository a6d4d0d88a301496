"""A fit that begins with recorded torque, beside the fit to positions alone."""

from __future__ import annotations

from collections.abc import Sequence as ListOf
from dataclasses import replace

from gaponet.data.sequence import Sequence
from gaponet.robot.spec import RobotSpec
from gaponet.sim.metrics import Comparison, Run, metrics, runs
from gaponet.sim.replay import motion_errors, replay
from gaponet.sim.temperature import temperature_findings
from gaponet.sysid.acceptance import HeldOut, Identified, Split, held_out_errors
from gaponet.sysid.axes import CLASSIC, Bounds
from gaponet.sysid.joint_rollouts import JointRollouts
from gaponet.sysid.problem import JointFit
from gaponet.sysid.robot_rollouts import cut
from gaponet.sysid.standard_errors import StandardErrors, standard_errors
from gaponet.sysid.steps.torque_fit import MAX_WINDOWS, OPTIONS, TorqueFit, TorqueOptions


def with_torque(
    fitted: Identified,
    splits: ListOf[Split],
    given: RobotSpec,
    nthread: int,
) -> Identified:
    """Return the fit from torque if motions that were not fitted accept it, else `fitted`.

    An accepted fit is repeated with all recordings. Without cross-validation it is kept only if the
    validation motions are followed no worse. `given` is the robot that both fits start from.
    """
    torques = [TorqueFit(split.fitted, given) for split in splits]
    if not all(torque.known for torque in torques):
        return fitted
    options, folds = _best_options(torques, splits)
    comparison = Comparison(
        "torque",
        held_out_errors(fitted.held_out),
        held_out_errors(folds),
        equally_complex=not given.is_identified,
    )
    comparisons = (*fitted.comparisons, comparison)
    if not comparison.accepted:
        return replace(fitted, comparisons=comparisons)
    validation = splits[0].held_out
    every = [*splits[0].fitted, *validation]
    after = float(comparison.after.mean())
    robot = TorqueFit(every, given).fit(options)
    if len(splits) == 1 and motion_errors(validation, robot).mean() > after:
        robot = folds[0].robot
    errors = _standard_errors(robot, every, nthread)
    return replace(
        fitted,
        robot=robot,
        after=after,
        chosen="torque",
        std=errors.std,
        covariance=errors.covariance,
        warnings=errors.sentences,
        comparisons=comparisons,
        table_fit=None,
        by_joint=_before_and_after(fitted, folds, nthread),
        undetermined=errors.undetermined,
        held_out=folds,
        without_terms=None,
        links=None,
        findings=temperature_findings(every, robot, errors.std),
    )


def _best_options(
    torques: ListOf[TorqueFit], splits: ListOf[Split]
) -> tuple[TorqueOptions, tuple[HeldOut, ...]]:
    """Return the options with the least error on motions that were not fitted, and the robot of
    each fold.
    """
    has_payloads = all(torque.several_payloads for torque in torques)
    tried: dict[TorqueOptions, tuple[HeldOut, ...]] = {}
    for options in OPTIONS:
        if options.place and not has_payloads:
            continue
        folds = []
        for torque, split in zip(torques, splits, strict=True):
            folds.append(HeldOut(split.held_out, torque.fit(options)))
        tried[options] = tuple(folds)

    def error(options: TorqueOptions) -> float:
        return float(held_out_errors(tried[options]).mean())

    best = min(tried, key=error)
    return best, tried[best]


def _standard_errors(
    robot: RobotSpec,
    recordings: list[Sequence],
    nthread: int,
) -> StandardErrors:
    """Return the standard errors of a robot's classic fields, from positions."""
    bounds = Bounds(robot, recordings)
    rollouts = JointRollouts(cut(recordings, MAX_WINDOWS), robot, nthread=nthread)
    whole = JointFit(rollouts, robot, bounds).robot_fit(nthread)
    return standard_errors(whole, {field: bounds.first[field] for field in CLASSIC})


def _before_and_after(
    fitted: Identified,
    folds: ListOf[HeldOut],
    nthread: int,
) -> dict[str, tuple[float, float]]:
    """Return joint → mean |error| of the given robot, as `fitted` has it, and of the fit from
    torque, over recordings that were not fitted, rad.
    """
    played: list[Run] = []
    for sequences, robot in folds:
        replays = replay(sequences, robot, nthread=nthread, lock_idle=True)
        played += runs(sequences, [simulated.qpos for simulated in replays], robot)
    errors = {}
    for i, joint in enumerate(folds[0].robot.operated):
        before, _ = fitted.by_joint[joint]
        errors[joint] = (before, metrics(played, [i]).get("mpjae", 0.0))
    return errors
