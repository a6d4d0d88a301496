"""The paper's claims, and what each method reaches here.

A network is credited with what it adds: to the nominal simulator, to targets as they are, or to the
feed-forward. So an untrained network, whose correction is zero, has 0 % in every row but those that
compare with the MLP.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import compress

import numpy as np

from gaponet.base.arrays import Array
from gaponet.base.result_table import ResultTable
from gaponet.experiments.paper.commands import REFERENCE_WAY, WAY_TITLES
from gaponet.experiments.paper.options import Block
from gaponet.experiments.paper.printed import (
    AXES,
    CLAIM_ALL_PAYLOADS,
    CLAIM_BY_AXIS,
    CLAIM_HEAVIEST_PAYLOAD,
)
from gaponet.experiments.paper.results import Results
from gaponet.experiments.paper.statistics import Reduction, reduction
from gaponet.experiments.paper.trainings import METHOD_BLOCKS

JUDGED = "GAPONet"
# Way without a network → what it is called in a claim.
WITHOUT_NETWORK = {
    "raw": "targets as they are",
    "feedforward": "feed-forward alone",
    "integral": "feed-forward and integral alone",
}


@dataclass(frozen=True)
class Claim:
    """One claim, measured for every method of a block.

    Attributes:
        text: What is reduced, against what.
        printed: The paper's claim, %; None where the paper claims nothing.
        reductions: Method → reduction.
    """

    block: Block
    text: str
    printed: float | None
    reductions: dict[str, Reduction]

    @property
    def verdict(self) -> str:
        """Verdict on our GAPONet."""
        if self.printed is None or JUDGED not in self.reductions:
            return ""
        return self.reductions[JUDGED].verdict(self.printed)


def claims(results: Results) -> list[Claim]:
    """Return all claims for both blocks, in the order of the page."""
    found = []
    for block in METHOD_BLOCKS:
        if not results.networks(block):
            continue
        found += _alignment_claims(results, block)
        if results.study.virtual:
            found += _command_claims(results, block)
        if results.study.delivers:
            found += _delivery_claims(results, block)
    return found


def _alignment_claims(results: Results, block: Block) -> list[Claim]:
    nominal = results.over_joints(results.baseline_q_dis("nominal"))
    heaviest = results.masses[-1]
    found = []
    rows: list[tuple[str, float, float | None]] = [("all payloads", CLAIM_ALL_PAYLOADS, None)]
    if len(results.masses) > 1:
        rows.append((f"{heaviest:g} kg", CLAIM_HEAVIEST_PAYLOAD, heaviest))
    for label, printed, payload in rows:
        kept = _with_payload(results, payload)
        reductions = {}
        for name, title in results.simulators.items():
            if name != "nominal":
                error = results.over_joints(results.baseline_q_dis(name))
                reductions[title] = _reduction(results, [error], nominal, kept)
        for name in results.networks(block):
            errors = _over_joints(results, results.q_dis(block, name))
            reductions[name] = _reduction(results, errors, nominal, kept)
        text = f"simulator + Δa to robot, {label}: less Q_dis than the nominal simulator"
        found.append(Claim(block, text, printed, reductions))
    if "MLP" in results.networks(block):
        found.append(_less_than_mlp(results, block))
    return found


def _less_than_mlp(results: Results, block: Block) -> Claim:
    """Return how much nearer to the robot each network brings the simulator than the MLP does."""
    errors = {}
    for name in results.networks(block):
        errors[name] = _over_joints(results, results.q_dis(block, name))
    reductions = {}
    for name, (own, mlp) in _beside_mlp(results, block, errors).items():
        reductions[name] = reduction(own, mlp, results.motions)
    text = "simulator + Δa to robot, all payloads: less Q_dis than the MLP"
    return Claim(block, text, None, reductions)


def _beside_mlp(
    results: Results, block: Block, errors: dict[str, list[Array]]
) -> dict[str, tuple[list[Array], list[Array]]]:
    """Return network → its errors and those of the MLP, one array for each seed.

    Seeds are left out of which only one of the two was trained: a training may have failed.

    Args:
        errors: Network, the MLP among them → its errors for each of its seeds.
    """
    of_mlp = dict(zip(results.seeds(block, "MLP"), errors["MLP"], strict=True))
    found = {}
    for name, by_seed in errors.items():
        own = []
        mlp = []
        for seed, error in zip(results.seeds(block, name), by_seed, strict=True):
            if seed in of_mlp:
                own.append(error)
                mlp.append(of_mlp[seed])
        if name != "MLP" and own:
            found[name] = (own, mlp)
    return found


def _over_joints(results: Results, by_seed: list[Array]) -> list[Array]:
    """Return Q_dis of each recording for each seed, (recordings,) rad·s each."""
    return [results.over_joints(q_dis) for q_dis in by_seed]


def _command_claims(results: Results, block: Block) -> list[Claim]:
    heaviest = results.masses[-1]
    found = []
    for way, reference in REFERENCE_WAY.items():
        baseline = results.over_joints(results.plain_command_q_dis(reference))
        for label, payload in (("all payloads", None), (f"{heaviest:g} kg", heaviest)):
            kept = _with_payload(results, payload)
            reductions = {}
            for name in results.networks(block):
                measured = results.command_q_dis(block, name, way)
                errors = _over_joints(results, measured)
                reductions[name] = _reduction(results, errors, baseline, kept)
            printed = None
            if way == "delta":
                printed = CLAIM_ALL_PAYLOADS if payload is None else CLAIM_HEAVIEST_PAYLOAD
            text = (
                f"robot to target, {WAY_TITLES[way]}, {label}: less Q_dis than "
                f"{WITHOUT_NETWORK[reference]}"
            )
            found.append(Claim(block, text, printed, reductions))
    return found


def _delivery_claims(results: Results, block: Block) -> list[Claim]:
    """Offsets at the heaviest payload, against the MLP as the paper has it, and against what needs
    no network.
    """
    found = []
    heaviest = f"{results.masses[-1]:g} kg"
    for way in ("delta", "both"):
        reference = REFERENCE_WAY[way]
        plain = [results.plain_offsets(reference)[-1]]  # (goals, 3) m
        offsets = {}
        for name in results.networks(block):
            offsets[name] = [seed[-1] for seed in results.offsets(block, name, way)]
        for axis, letter in enumerate(AXES):
            reductions = {}
            for name, seeds in offsets.items():
                reductions[name] = _offset_reduction(seeds, plain, axis)
            text = (
                f"hand to goal along {letter}, {WAY_TITLES[way]}, {heaviest}: less than "
                f"{WITHOUT_NETWORK[reference]}"
            )
            found.append(Claim(block, text, None, reductions))
        if "MLP" not in offsets:
            continue
        beside_mlp = _beside_mlp(results, block, offsets)
        for axis, letter in enumerate(AXES):
            reductions = {}
            for name, (own, mlp) in beside_mlp.items():
                reductions[name] = _offset_reduction(own, mlp, axis)
            text = f"hand to goal along {letter}, {WAY_TITLES[way]}, {heaviest}: less than the MLP"
            printed = CLAIM_BY_AXIS[letter] if way == "delta" else None
            found.append(Claim(block, text, printed, reductions))
    return found


def _offset_reduction(seeds: list[Array], baselines: list[Array], axis: int) -> Reduction:
    """Return the reduction along an axis; goals are independent of each other.

    Args:
        seeds: (goals, 3) m for each seed.
        baselines: (goals, 3) m, one array, or one for each seed.
    """
    goals = [str(goal) for goal in range(len(baselines[0]))]
    errors = [offsets[:, axis] for offsets in seeds]
    return reduction(errors, [offsets[:, axis] for offsets in baselines], goals)


def _with_payload(results: Results, payload: float | None) -> Array:
    """Return the mask of the recordings with a payload, kg; None: all."""
    if payload is None:
        return np.ones(len(results.payloads), bool)
    return np.asarray(results.payloads == payload)


def _reduction(results: Results, errors: list[Array], baseline: Array, kept: Array) -> Reduction:
    """Return the reduction on some recordings.

    Args:
        errors: (recordings,) rad·s for each seed.
        baseline: (recordings,) rad·s.
        kept: Mask of the recordings that count, (recordings,).
    """
    motions = list(compress(results.motions, kept))
    return reduction([error[kept] for error in errors], [baseline[kept]], motions)


def claim_table(found: list[Claim], block: Block, trained_by: str) -> ResultTable:
    """Return the claims of a block as a table; one column for each method.

    Args:
        trained_by: How its networks were trained, in words.
    """
    of_block = [claim for claim in found if claim.block == block]
    methods: dict[str, None] = {}
    for claim in of_block:
        methods |= dict.fromkeys(claim.reductions)
    rows = []
    for claim in of_block:
        cells = [str(claim.reductions.get(name, "")) for name in methods]
        printed = "" if claim.printed is None else f"{claim.printed:g}"
        rows.append((claim.text, printed, *cells, claim.verdict))
    seeds = 0
    for claim in of_block:
        for reduction_of_method in claim.reductions.values():
            seeds = max(seeds, reduction_of_method.seeds)
    over = f"over {seeds} seeds and over motions or goals"
    if seeds == 1:
        over = "over motions or goals; of one seed the spread over seeds is not known"
    caption = (
        f"Trained by {trained_by}. Per cent less, ± the standard error {over} (paired, "
        "jackknife). The verdict is on GAPONet: reached or not by two standard errors. An "
        "untrained network has 0 in every row that does not compare with the MLP."
    )
    columns = ("claim", "the paper", *methods, "verdict")
    return ResultTable(f"claims_{block}", columns, tuple(rows), caption, 0)
