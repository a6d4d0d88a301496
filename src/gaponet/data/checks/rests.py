"""What rests say against gravity and the stated gains: offsets, scales, gains, payload labels, robots taken for one.

At rest a servo stands off its command by what it carries: qpos − ctrl = offset + (scale − 1)·ctrl − softness·G(qpos)/kp
− stiction·approach, G the gravity of the nominal model with the payload of the label. These four numbers of a joint are
fitted to all rests and, for their standard errors (jackknife) and to judge a sequence by the others, to all but some.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import permutations

import numpy as np

from gaponet.base.arrays import Array
from gaponet.data.offsets import Gravity
from gaponet.data.survey import Survey
from gaponet.robot.finding import Finding, abbreviate
from gaponet.robot.spec import RobotSpec

FEW = 12  # rests of a joint that say nothing
FOLDS = 20  # of the sequences, at most
SURE = 4.0  # standard errors
OFFSET, FAR = 0.015, 0.05  # rad: named, and a warning
SCALE = 0.1
SOFTNESS = (0.5, 1.8)
LOAD = 0.01  # rad of nominal sag (rms), below which softness says nothing
APART = 0.03  # rad between sequences of one robot
MASS, SHARE = 0.25, 0.5  # of the heaviest label, or kg; of a sequence's misfit that another mass must explain
FELT = 1e-3  # rad by which a joint rests elsewhere with another label
EVIDENCE = 10.0  # of other labels: rests times the logarithm by which their scatter falls
UNITS, CLEAR = 0.006, 6.0  # rad between two groups of recordings, and times the scatter inside them
PLAIN = np.array([0.0, 0.0, 1.0, 0.0])  # offset, scale − 1, softness, stiction of a motor as stated
USUAL = np.array([0.5, 0.5, 1.0, 0.1])  # how far they may be from it, where rests do not say
ODD = 10  # sequences that are told apart


@dataclass(frozen=True)
class _Rests:
    """Fresh rests (k), by sequence: it and joint, error (rad), columns of the four numbers, and G of 1 kg over kp."""

    sequence: Array
    joint: Array
    error: Array
    columns: Array
    per_kg: Array

    def only(self, keep: Array | slice) -> _Rests:
        """The rests of a mask (k)."""
        return _Rests(*(values[keep] for values in vars(self).values()))

    def of(self, number: int) -> slice:
        return slice(*np.searchsorted(self.sequence, [number, number + 1]))


@dataclass(frozen=True)
class _Fit:
    """A joint's four numbers, their standard errors, scatter (rad), and the numbers without each fold."""

    x: Array
    deviation: Array
    scatter: float
    without: dict[int, Array]


def rests(surveys: list[Survey], robot: RobotSpec, model: Gravity) -> Iterator[Finding]:
    """Do offsets, scales, gains and payload labels agree with where the joints rest?"""
    found = _collect(surveys, robot, model)
    judged = [j for j in robot.operated_index.tolist() if (found.joint == j).sum() >= FEW]
    if not judged:
        yield Finding("ok", "rests", "too few rests: offsets, scales, gains and payloads cannot be told; add holds")
        return
    wrong = _relabelled(surveys, found, judged)
    if not wrong:
        wrong = _two_units(surveys, robot, found, judged)
    if wrong:
        yield from wrong
        return
    while len(wrong) < ODD and (odd := _odd_one(surveys, robot, found, judged)) is not None:
        wrong.append(odd[1])
        found = found.only(found.sequence != odd[0])
    wrong = wrong or _two_units(surveys, robot, found, judged, 1, 3)
    judged = [j for j in judged if (found.joint == j).sum() >= FEW]
    soft = {}
    for j in judged:
        name, fit = robot.joint_names[j], _fit(found.only(found.joint == j))
        wrong += _joint(name, fit)
        sag = float(np.sqrt(np.mean(found.columns[found.joint == j, 2] ** 2)))
        if sag > LOAD and fit.x[2] > 0 and _sure(fit)[2] and not SOFTNESS[0] < fit.x[2] < SOFTNESS[1]:
            soft[name] = float(fit.x[2])
    if soft:
        softness = float(np.median(list(soft.values())))
        text = (
            f"{abbreviate(list(soft))} sag {softness:.2f} times as far as the stated kp says: were these logs "
            "recorded at "
            "other gains, or with another payload than their label? Import again with --kp or --payload-mass"
        )
        wrong.append(Finding("warning", "gains", text, tuple(soft), {"softness": soft}))
    yield from wrong or [Finding("ok", "rests", "rests agree with gravity, gains and payload labels")]


def _collect(surveys: list[Survey], robot: RobotSpec, model: Gravity) -> _Rests:
    parts = [(np.zeros(0, int), np.zeros(0, int), np.zeros(0), np.zeros((0, 4)), np.zeros(0))]
    for number, s in enumerate(surveys):
        meta, holds = s.entry.meta, s.holds
        if not len(holds):
            continue
        kp = np.where(robot.kp > 0, robot.with_gains(*meta.known_gains).kp, np.inf)
        load = model(holds.qpos, meta.payload_mass, meta.payload_side) / kp
        heavier = np.zeros_like(load)
        if robot.payload_mounts:
            heavier = model(holds.qpos, meta.payload_mass + 1.0, meta.payload_side) / kp - load
        nth, hold = np.nonzero((holds.fresh & (holds.approach != 0))[:, robot.operated_index].T)
        at = hold, (j := robot.operated_index[nth])
        columns = np.column_stack([np.ones(len(j)), holds.ctrl[at], -load[at], -holds.approach[at]])
        parts.append((np.full(len(j), number), j, holds.qpos[at] - holds.ctrl[at], columns, -heavier[at]))
    return _Rests(*(np.concatenate(column) for column in zip(*parts, strict=True)))


def _fit(mine: _Rests) -> _Fit:
    """The four numbers of the one joint of these rests."""
    x, formal, scatter = _solve(mine.columns, mine.error)
    numbers, place = np.unique(mine.sequence, return_inverse=True)
    fold = place % FOLDS
    without = {g: _solve(mine.columns[fold != g], mine.error[fold != g])[0] for g in range(min(len(numbers), FOLDS))}
    every = np.array(list(without.values()))
    jackknife = np.sqrt((len(every) - 1) / len(every) * ((every - every.mean(axis=0)) ** 2).sum(axis=0))
    deviation = np.maximum(formal, jackknife) if len(every) > 2 else 3 * formal
    return _Fit(x, deviation, scatter, {s: without[i % FOLDS] for i, s in enumerate(numbers.tolist())})


def _solve(columns: Array, error: Array) -> tuple[Array, Array, float]:
    """Least squares with far-off rests held back: numbers, formal standard errors, scatter."""
    x, scatter, weight, prior = PLAIN, 0.01, np.ones(len(error)), np.diag(1 / USUAL)
    a = prior
    for _ in range(12):
        a = np.concatenate([columns * (weight / scatter)[:, None], prior])
        x = np.linalg.lstsq(a, np.concatenate([error * weight / scatter, prior @ PLAIN]), rcond=None)[0]
        left = np.abs(error - columns @ x)
        scatter = max(1.48 * float(np.median(left)), 5e-4) if len(left) else scatter
        weight = np.sqrt(1 / np.maximum(1, left / (3 * scatter)))
    return x, np.sqrt(np.diag(np.linalg.inv(a.T @ a))), scatter


def _sure(fit: _Fit) -> Array:
    return np.abs(fit.x - PLAIN) > SURE * fit.deviation


def _joint(name: str, fit: _Fit) -> Iterator[Finding]:
    offset, scale = float(fit.x[0]), float(1 + fit.x[1])
    if _sure(fit)[1] and abs(scale - 1) > SCALE:
        text = (
            f"{name} goes {scale:.2f} rad where its command goes 1 rad, sag taken off: another gear ratio, range or "
            "ticks a turn in one of them; import again with the right scale"
        )
        yield Finding("warning", "scale", text, (name,), {"scale": scale})
    elif _sure(fit)[0] and abs(offset) > OFFSET:
        far = abs(offset) > FAR
        how = "more than assembly leaves: a wrong zero or a missed homing" if far else "as assembly leaves it"
        text = (
            f"{name} rests {offset * 1e3:+.0f} ± {fit.deviation[0] * 1e3:.0f} mrad off its command, sag and stiction "
            f"taken off: a constant offset, {how}; gaponet identify finds it, or take it off at import"
        )
        yield Finding("warning" if far else "note", "offset", text, (name,), {"offset": offset})


def _relabelled(surveys: list[Survey], found: _Rests, judged: list[int]) -> list[Finding]:
    """Would the labels' masses in another order explain the rests better?"""
    mass = np.array([s.entry.meta.payload_mass for s in surveys])[found.sequence]
    labels = sorted(set(mass.tolist()))
    if not 1 < len(labels) <= 3:
        return []
    best = (0.0, labels)
    for order in [list(p) for p in permutations(labels)][1:]:
        other = np.array(order)[np.searchsorted(labels, mass)]
        columns = found.columns + np.outer((other - mass) * found.per_kg, np.eye(4)[2])
        evidence = 0.0
        for j in judged:
            mine = found.joint == j
            fits = [_solve(c[mine], found.error[mine])[2] for c in (found.columns, columns)]
            evidence += float(mine.sum() * np.log(fits[0] / fits[1]))
        best = max(best, (evidence, order))
    felt = np.abs(found.per_kg) * (labels[-1] - labels[0]) > FELT
    if best[0] < max(EVIDENCE, 0.1 * felt.sum()):
        return []
    told = ", ".join(f"{a:g} kg rests as {b:g} kg" for a, b in zip(labels, best[1], strict=True) if a != b)
    text = f"what is labelled {told}: payload labels in each other's place? Import again with the right --payload-mass"
    return [Finding("warning", "payload", text, (), {"labels": labels, "rests_as": best[1]})]


def _two_units(
    surveys: list[Survey], robot: RobotSpec, found: _Rests, judged: list[int], least: int = 2, joints: int = 2
) -> list[Finding]:
    """Do the recordings fall into two groups, of so many at least, that rest apart in so many joints?"""
    middle = np.full((len(surveys), len(judged)), np.nan)
    for column, j in enumerate(judged):
        mine = found.only(found.joint == j)
        left = mine.error - mine.columns @ _solve(mine.columns, mine.error)[0]
        for number in set(mine.sequence.tolist()):
            if len(own := left[mine.of(number)]) > 1:
                middle[number, column] = np.median(own)
    told = np.flatnonzero(np.isfinite(middle).all(axis=1))
    best: tuple[int, float, list[str], Array] = (joints - 1, 0.0, [], told[:0])
    for column in range(len(judged)) if len(told) > 2 else ():
        order = told[np.argsort(middle[told, column])]
        cuts = np.arange(least, len(order) + 1 - least)
        rest = middle[order] - middle[order].mean(axis=0)  # their sum is zero, (N, judged)
        sums, per = rest.cumsum(axis=0)[cuts - 1], (1 / cuts + 1 / (len(order) - cuts))[:, None]
        within = np.sqrt(np.maximum((rest**2).sum(axis=0) - sums**2 * per, 0) / (len(order) - 2))
        gaps = np.abs(sums) * per
        far = (gaps > UNITS) & (gaps > CLEAR * np.maximum(within, 5e-4))
        for cut, gap, apart in zip(cuts.tolist(), gaps.max(axis=1).tolist(), far, strict=True):
            if (int(apart.sum()), gap) > best[:2]:
                names = [robot.joint_names[j] for j, yes in zip(judged, apart, strict=True) if yes]
                best = (len(names), gap, names, order[:cut])
    if best[0] < joints:
        return []
    motions = [[surveys[i].motion for i in told if (i in best[3]) == side] for side in (True, False)]
    text = (
        f"{abbreviate(motions[0])} rest up to {best[1] * 1e3:.0f} mrad from where {abbreviate(motions[1])} do "
        f"({abbreviate(best[2])}): "
        "two robots under one name, or zeros set in between? Import one part with another --unit-id"
    )
    return [Finding("warning", "unit_id", text, tuple(best[2]), {"apart": best[1], "motions": motions[0]})]


def _odd_one(surveys: list[Survey], robot: RobotSpec, found: _Rests, judged: list[int]) -> tuple[int, Finding] | None:
    """The sequence that rests furthest from where the others say, if any is far."""
    by_joint = {j: found.only(found.joint == j) for j in judged}
    fits = {j: _fit(mine) for j, mine in by_joint.items() if len(mine.error) >= FEW}
    heaviest = max(s.entry.meta.payload_mass for s in surveys) or 1.0
    odd: tuple[float, int, Finding] | None = None
    for number in sorted(set(found.sequence.tolist())):
        left, per_kg, apart = [], [], {}
        for j, fit in fits.items():
            own = by_joint[j].only(by_joint[j].of(number))
            if len(own.error) < 3 or len(by_joint[j].error) - len(own.error) < FEW:
                continue
            x = fit.without[number]
            rest = own.error - own.columns @ x
            left.append(rest / fit.scatter)
            per_kg.append(x[2] * own.per_kg / fit.scatter)
            middle = float(np.median(rest))
            spread = max(fit.scatter, 1.48 * float(np.median(np.abs(rest - middle))))
            if abs(middle) > max(APART, SURE * spread / np.sqrt(len(rest))):
                apart[robot.joint_names[j]] = middle
        told = _told(surveys[number], heaviest, left, per_kg, apart)
        if told is not None and (odd is None or told[0] > odd[0]):
            odd = (told[0], number, told[1])
    return odd and odd[1:]


def _told(
    s: Survey, heaviest: float, left: list[Array], per_kg: list[Array], apart: dict[str, float]
) -> tuple[float, Finding] | None:
    """How far a sequence's rests are off, in scatters, and what that is."""
    if not left:
        return None
    r, slope, meta = np.concatenate(left), np.concatenate(per_kg), s.entry.meta
    far = float(r @ r) / len(r)
    power = float(slope @ slope)
    more = float(slope @ r) / power if power > 0 else 0.0
    sure = more**2 * power > max(SHARE * float(r @ r), SURE**2 * max(1.0, far - more**2 * power / len(r)))
    if sure and abs(more) > MASS * heaviest:
        text = (
            f"{meta.motion} rests as with {max(meta.payload_mass + more, 0.0):.2g} kg, its label says "
            f"{meta.payload_mass:g} kg: a wrong payload label? Import it again with --payload-mass"
        )
        return far, Finding("warning", "payload", text, (), {"motion": meta.motion, "mass": meta.payload_mass + more})
    if apart:
        worst = max(apart, key=lambda name: abs(apart[name]))
        text = (
            f"{meta.motion} rests {apart[worst] * 1e3:+.0f} mrad from where the other recordings of unit "
            f"{meta.unit_id} say ({abbreviate(list(apart))}): another robot, or zeros set in between? Import it with "
            "another "
            "--unit-id"
        )
        return far, Finding("warning", "unit_id", text, tuple(apart), {"motion": meta.motion, "apart": apart})
    return None
