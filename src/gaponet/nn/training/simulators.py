"""The simulators of a training: which piece of a recording is replayed in which of them.

Recordings are cut into pieces, and each piece starts at its recorded state. Whole recordings are
worse for two reasons. With few of them a simulator has one or two, so that the network can tell the
motion by the simulator. And a simulation that starts at the recorded state shows what brings it
back there. docs/simulators.md has the measurement.
"""

from __future__ import annotations

from collections.abc import Sequence as ListOf
from dataclasses import replace

import numpy as np

from gaponet.data.sequence import Sequence, whole_rate
from gaponet.nn.training.config import TrainConfig
from gaponet.robot.simulator_change import SimulatorChange
from gaponet.robot.spec import RobotSpec

# Validation has other simulators than training, and tests have others again.
VALIDATION_SEED_STEP = 1_000_003
VALIDATION_SIMULATORS = 24
# Long against the lag of a servo, and short enough for several simulators a recording.
PIECE_S = 5.0


def in_many_simulators(
    sequences: ListOf[Sequence], robot: RobotSpec, config: TrainConfig
) -> list[Sequence]:
    """Return the pieces of each training recording, once for each of its simulators.

    One of the simulators is the robot's own. Recordings with different payloads or rates share no
    simulator: there are then as few groups of equal simulations as possible, and each simulator has
    one payload.

    Without --simulators, the result is the recordings as they are.
    """
    if not config.simulators:
        return list(sequences)
    ranges = config.simulator_ranges
    drawn = ranges.draw(len(robot.joint_names), config.simulators - 1, config.seed)
    simulators: list[SimulatorChange | None] = [None, *drawn]
    conditions = list(dict.fromkeys(_condition(s) for s in sequences))
    rng = np.random.default_rng(config.seed)
    paired = []
    for sequence in sequences:
        place = conditions.index(_condition(sequence))
        own = simulators[place :: len(conditions)] or simulators
        count = min(config.simulators_per_piece, len(own))
        for piece in pieces(sequence):
            for i in rng.permutation(len(own))[:count]:
                paired.append(replace(piece, simulator=own[i]))
    return paired


def pieces(sequence: Sequence) -> list[Sequence]:
    """Cut a recording into pieces of PIECE_S; the last one is longer by what remains."""
    rows = round(PIECE_S / sequence.dt)
    count = max(len(sequence) // rows, 1)
    starts = [i * rows for i in range(count)]
    ends = [*starts[1:], len(sequence)]
    return [sequence.rows(slice(start, end)) for start, end in zip(starts, ends, strict=True)]


def in_validation_simulators(
    sequences: ListOf[Sequence], robot: RobotSpec, config: TrainConfig
) -> list[Sequence]:
    """Return about VALIDATION_SIMULATORS validation recordings in as many simulators.

    A recording can be in several.

    No training recording has these simulators, but for the first one, the robot's own.
    """
    if not config.simulators:
        return list(sequences)
    ranges = config.simulator_ranges
    seed = config.seed + VALIDATION_SEED_STEP
    drawn = ranges.draw(len(robot.joint_names), VALIDATION_SIMULATORS - 1, seed)
    simulators: list[SimulatorChange | None] = [None, *drawn]
    paired = []
    for i in range(max(len(sequences), len(simulators))):
        sequence = sequences[i % len(sequences)]
        paired.append(replace(sequence, simulator=simulators[i % len(simulators)]))
    return paired


def _condition(sequence: Sequence) -> tuple[float, str, int]:
    meta = sequence.meta
    return meta.payload_mass, meta.payload_side, whole_rate(sequence.dt)
