"""A simulator without the robot's payload: the mass estimated, identification and transfer beside it, and a payload
that is picked up and put down in mid-motion.
"""

from __future__ import annotations

from collections.abc import Mapping
from collections.abc import Sequence as ListOf
from dataclasses import dataclass, replace

import numpy as np

from gaponet.arrays import Array
from gaponet.data.sequence import Sequence
from gaponet.deploy.aligned_sim import AlignedSim
from gaponet.deploy.payload import PayloadEstimate
from gaponet.deploy.transfer import Reference
from gaponet.eval.candidate import choose
from gaponet.model.artifact import GapModel
from gaponet.robot import RobotSpec
from gaponet.sim.batch import MODEL_FIELDS, BatchSim, Condition
from gaponet.sim.model import idle_joints
from gaponet.spread import Spread
from gaponet_lab.study.compare import identified
from gaponet_lab.study.found import Found
from gaponet_lab.study.played.play import WARMTH
from gaponet_lab.study.played.simulators import Simulator, errors, free_run, recorded
from gaponet_lab.study.study import Study
from gaponet_robots.virtual.collect import fleet_of
from gaponet_robots.virtual.fleet import load_fleet
from gaponet_robots.virtual.unit import VirtualRobot

SWITCHES = (1 / 3, 2 / 3)  # of a motion: when hands that are empty are filled, and full ones emptied
HELD = 2.0  # kg
EMPTY = "identification of the simulator without payload"
LADEN, LADEN_FULL = "transfer of the laden nominal simulator", "transfer of the laden identified simulator"


def estimated(sequences: ListOf[Sequence], laden: RobotSpec, heaviest: float) -> Array:
    """What gravity says of the payload in each period of recordings, from what was known then, (T, k) kg.

    From positions, speeds and commands alone, by the nominal servo's law.
    """
    dt, op, locked = sequences[0].dt, laden.operated_index, idle_joints(laden, laden.operated)
    sim = BatchSim(laden, [Condition(m, "both", dt) for m in (0.0, heaviest)], 1, locked)
    at = np.array([sim.joint_names.index(name) for name in laden.operated])
    estimate, everyone = PayloadEstimate(sim, at, laden, 2, dt), np.ones(len(sequences), bool)
    estimate.reset(len(sequences))
    q, v, u = (_padded(sequences, name)[..., op] for name in ("qpos", "qvel", "ctrl"))
    out = np.zeros(u.shape[:2])
    for t in range(1, len(out)):
        out[t] = estimate.update(q[t], v[t], u[t - 1], None, everyone)
    return out


def follow(
    sequences: ListOf[Sequence],
    robot: RobotSpec,
    reference: Reference | None,
    masses: Array,
    payloads: Array,
    switched: ListOf[int] = (),
) -> Array:
    """Free runs of commands in the simulator, positions (T, k, n operated) rad at their rows.

    Args:
        sequences: Recordings of one rate, the longest first.
        robot: The simulator, which carries none of the payload.
        reference: What corrects it.
        masses: What a model is told in each period, (T, k) kg.
        payloads: What the reference's simulator carries at first, (k,) kg.
        switched: Periods at which the first half of the runs and the second exchange their payloads.
    """

    def carry(sim: AlignedSim, t: int) -> None:
        sim.payload_mass[:] = masses[t]
        if sim.transfer is not None:
            sim.transfer.payload_mass[:] = masses[t]
            if t in switched:
                _swap(list(sim.transfer.sim.fields.values()))

    return free_run(sequences, Simulator("", robot), reference, payload=payloads, before=carry)


def by_payload(
    sequences: ListOf[Sequence], robot: RobotSpec, reference: Reference | None, guessed: Array | None = None
) -> dict[float, float]:
    """Error at each payload, mrad; the mass is told, or guessed (T, k)."""
    payload = np.array([s.meta.payload_mass for s in sequences])
    told = np.tile(payload, (len(sequences[0]), 1)) if guessed is None else guessed
    error = np.array(errors(sequences, follow(sequences, robot, reference, told, payload), recorded(sequences, robot)))
    return {float(p): float(error[payload == p].mean()) for p in np.unique(payload)}


def in_mid_motion(
    study: Study,
    sequences: ListOf[Sequence],
    models: Mapping[str, GapModel],
    references: Mapping[str, RobotSpec],
) -> dict[str, list[float]]:
    """Error of each motion, mrad, of what corrects a simulator while HELD is taken up and put down by VIRTUAL robots.

    Args:
        study: In a simulator that carries nothing.
        sequences: Recordings whose commands are played, one per motion and unit, the longest first.
        models: Name → model, told the mass of the moment; "mass not told" is said by the model.
        references: Name → simulator that does know of it, transferred.
    """
    laden = replace(study.robot, carries_payload=True)
    twice = [*sequences, *sequences]
    half = len(sequences)
    rows = len(sequences[0])
    switched = [round(share * rows) for share in SWITCHES]
    held = np.repeat([0.0, HELD], half)
    now = np.stack([held if sum(t >= s for s in switched) % 2 == 0 else held[::-1] for t in range(rows)])
    played = [replace(s, qpos=q[: len(s)], qvel=v[: len(s)]) for s, q, v in
              zip(twice, *_play(study, laden, twice, held, switched), strict=True)]  # fmt: skip
    truth, guess = recorded(played, study.robot), estimated(played, laden, 3.0)
    out = {"uncorrected": errors(played, follow(played, study.robot, None, now, held), truth)}
    for name, model in models.items():
        out[name] = errors(played, follow(played, study.robot, model, now, held), truth)
        if model.config.payload_input:
            out[f"{name}, estimated"] = errors(played, follow(played, study.robot, model, guess, held), truth)
    for name, reference in references.items():
        out[name] = errors(played, follow(played, study.robot, reference, now, held, switched), truth)
    return out


def _play(
    study: Study, robot: RobotSpec, sequences: ListOf[Sequence], held: Array, switched: ListOf[int]
) -> tuple[ListOf[Array], ListOf[Array]]:
    """What the encoders of the units say, (T, n) each: rad, rad/s."""
    fleet = load_fleet(fleet_of(study.data), robot)
    units = [fleet.unit(s.meta.unit_id) for s in sequences]
    locked = idle_joints(robot, robot.operated)
    side, ctrl = sequences[0].meta.payload_side, _padded(sequences, "ctrl")
    robots = VirtualRobot(robot, units, [(float(m), side) for m in held], sequences[0].dt, locked=locked)
    robots.reset(ctrl[0], list(range(len(units))), np.full(len(units), WARMTH))
    batch, names = robots.batch, [name for name in sorted(MODEL_FIELDS) if name.startswith("body_")]
    bodies = [batch.expand(name) for name in names if batch.expanded(name) is not None]
    qpos, qvel = np.empty((2, *ctrl.shape))
    for t, target in enumerate(ctrl):
        if t in switched:
            _swap(bodies)
        reading = robots.read()
        qpos[t], qvel[t] = reading.qpos, reading.qvel
        robots.step(target)
    return list(np.moveaxis(qpos, 1, 0)), list(np.moveaxis(qvel, 1, 0))


def _swap(fields: ListOf[Array]) -> None:
    """The first half of the simulations and the second exchange what is theirs."""
    for field in fields:
        half = len(field) // 2
        field[:] = np.concatenate([field[half:], field[:half]])


def _padded(sequences: ListOf[Sequence], name: str) -> Array:
    """(T, k, n) of all, motions that end waiting where they end."""
    rows = np.arange(len(sequences[0]))
    return np.stack([getattr(s, name)[np.minimum(rows, len(s) - 1)] for s in sequences], axis=1)


@dataclass(frozen=True)
class Beside:
    """What stands beside trained models where the simulator has no payload.

    Attributes:
        rows: Name → payload → over seeds, mrad.
        moving: Name → error of each motion while a payload is taken up and put down, mrad; empty where no virtual robot
            can do so.
    """

    rows: dict[str, dict[float, Spread]]
    moving: dict[str, list[float]]


def beside(study: Study, found: Found, told: Mapping[str, str], blind: str) -> Beside:
    """Estimated masses, identification of the empty simulator, transfer from laden ones; known units.

    Args:
        study: In a simulator that carries nothing.
        found: Its cells.
        told: Models that are told the mass, word → name.
        blind: The word of the one that is not.
    """
    models = {w: [GapModel.load(c.folder) for c in found.cells.get((w, ""), [])] for w in (*told, blind)}
    first = next(c for part in found.cells.values() for c in part)
    every = study.data.sequences(choose([first.folder], study.data)[0])
    sequences = sorted((s for s in every if s.meta.unit_id not in study.holdout_units), key=lambda s: -len(s))
    laden = replace(study.robot, carries_payload=True)
    quiet = lambda done, total, note: None  # noqa: E731
    empty = identified(study, quiet).identified
    full = identified(replace(study, robot=laden, out=study.out / "laden"), quiet).identified
    assert empty is not None
    assert full is not None
    references = {LADEN: laden, LADEN_FULL: full}
    guess = estimated(sequences, laden, max(s.meta.payload_mass for s in sequences))
    rows = {
        f"{name}, mass estimated": _over_seeds([by_payload(sequences, study.robot, m, guess) for m in models[w]])
        for w, name in told.items()
    }
    rows[EMPTY] = _over_seeds([by_payload(sequences, empty, None)])
    rows |= {n: _over_seeds([by_payload(sequences, study.robot, r)]) for n, r in references.items()}
    if not all(s.meta.virtual for s in sequences):
        return Beside(rows, {})
    unique = {(s.meta.motion, s.meta.unit_id): s for s in sequences}
    one = {name: models[w][0] for w, name in told.items() if models[w]}
    if models[blind]:
        one["mass not told"] = models[blind][0]
    return Beside(rows, in_mid_motion(study, list(unique.values()), one, references))


def _over_seeds(found: ListOf[dict[float, float]]) -> dict[float, Spread]:
    return {p: Spread.of([f[p] for f in found]) for p in found[0]} if found else {}
