"""The simulators of a training."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from arm import record

from gaponet.base.errors import UsageError
from gaponet.data.sequence import Sequence
from gaponet.nn.config import ModelConfig
from gaponet.nn.training.config import (
    MANY_SIMULATORS_MODEL,
    MANY_SIMULATORS_PRETRAINING,
    PretrainingConfig,
    TrainConfig,
)
from gaponet.nn.training.simulators import in_many_simulators, in_validation_simulators, pieces
from gaponet.robot.spec import load_robot

ROBOT = load_robot("so101")
ROWS = 620  # 12.4 s
MANY = TrainConfig(simulators=20, simulators_per_piece=3)


def recording(payload_kg: float = 0.0) -> Sequence:
    """Return a recording of the arm at rest."""
    sequence = record(ROBOT, np.tile(ROBOT.qpos_home, (ROWS, 1)), "rest", kp=0.7)
    return replace(sequence, meta=replace(sequence.meta, payload_mass=payload_kg))


def test_pieces_are_the_whole_recording_in_order() -> None:
    whole = recording()

    cut = pieces(whole)

    assert [len(piece) for piece in cut] == [250, 370]
    assert np.array_equal(np.concatenate([piece.qpos for piece in cut]), whole.qpos)


def test_each_piece_is_in_several_simulators_and_one_simulator_is_the_robots_own() -> None:
    config = replace(MANY, simulators_per_piece=20)

    paired = in_many_simulators([recording()], ROBOT, config)

    assert len(paired) == 2 * 20
    assert len({sequence.simulator for sequence in paired}) == 20
    assert None in {sequence.simulator for sequence in paired}


def test_recordings_with_other_payloads_are_in_other_simulators() -> None:
    paired = in_many_simulators([recording(0.0), recording(0.2)], ROBOT, MANY)

    simulators: dict[float, set[object]] = {0.0: set(), 0.2: set()}
    for sequence in paired:
        simulators[sequence.meta.payload_mass].add(sequence.simulator)
    assert not simulators[0.0] & simulators[0.2]


def test_validation_shares_no_simulator_with_training_but_the_robots_own() -> None:
    trained = {
        sequence.simulator for sequence in in_many_simulators([recording()] * 9, ROBOT, MANY)
    }

    validated = {s.simulator for s in in_validation_simulators([recording()], ROBOT, MANY)}

    assert len(validated) > 1
    assert trained & validated <= {None}


def test_with_one_simulator_recordings_stay_as_they_are() -> None:
    whole = recording()

    assert in_many_simulators([whole], ROBOT, TrainConfig()) == [whole]


def test_the_network_is_told_its_simulator_where_there_are_many() -> None:
    assert TrainConfig(simulators=5).sized().model.context
    assert not TrainConfig(simulators=5, without_context=True).sized().model.context
    assert not TrainConfig(simulators=5, model=ModelConfig(kind="mlp")).sized().model.context
    assert not TrainConfig().sized().model.context


def test_ranges_in_the_wrong_order_are_refused() -> None:
    with pytest.raises(UsageError, match="smaller"):
        replace(MANY.simulator_ranges, kp=(2.0, 0.5))


def test_what_somebody_changes_stays_in_the_recipe_for_many_simulators() -> None:
    chosen = PretrainingConfig(gradient_steps=77)

    recipe = TrainConfig(simulators=5, pretraining=chosen).sized()

    assert recipe.pretraining.gradient_steps == 77
    assert recipe.pretraining.noise == MANY_SIMULATORS_PRETRAINING.noise
    assert recipe.model.branch_hidden == MANY_SIMULATORS_MODEL.branch_hidden


def test_many_simulators_on_a_gpu_are_refused() -> None:
    with pytest.raises(UsageError, match="--device"):
        TrainConfig(simulators=5, device="cuda").sized()
