"""Payloads that a simulator does not have."""

from dataclasses import replace

import numpy as np
import pytest
from arm import commands, record, write_arm
from runs import corrects_by

from gaponet_lab.study.played.unladen import _play, by_payload, estimated, follow


@pytest.fixture
def arm(tmp_path):
    return write_arm(tmp_path / "arm")


def recordings(arm, payload):
    return [record(arm, commands(200, seed), f"m{seed}", payload) for seed in (1, 2)]


@pytest.mark.parametrize("payload", [0.0, 0.2])
def test_the_mass_of_what_is_held_is_found_in_what_was_recorded(arm, payload):
    mass = estimated(recordings(arm, payload), arm, 0.4)
    assert mass.shape == (200, 2)
    np.testing.assert_allclose(mass[-1], payload, atol=0.05)


def test_a_laden_reference_takes_an_empty_simulator_along(arm):
    empty = replace(arm, carries_payload=False)
    sequences = [*recordings(arm, 0.2), *recordings(arm, 0.0)]
    alone, along = by_payload(sequences, empty, None), by_payload(sequences, empty, arm)
    assert alone[0.0] < 0.1  # mrad: it is the robot
    assert along[0.2] < 0.05 * alone[0.2]


def test_a_payload_that_comes_and_goes_takes_the_reference_along(arm):
    empty = replace(arm, carries_payload=False)
    twice, held = recordings(arm, 0.2), np.array([0.0, 0.2])
    masses, still = np.tile(held, (200, 1)), follow(twice, empty, arm, np.tile(held, (200, 1)), held)
    moved = follow(twice, empty, arm, masses, held, switched=[100])
    np.testing.assert_array_equal(still[:100], moved[:100])
    assert (np.abs(still[130] - moved[130]).max(axis=1) > 1e-3).all()


def test_what_a_model_is_told_reaches_it(arm, tmp_path):
    empty = replace(arm, carries_payload=False)
    model, sequences = corrects_by(0.1, empty, tmp_path / "run"), recordings(arm, 0.2)
    told = np.full((200, 2), 0.2)
    corrected, alone = (follow(sequences, empty, m, told, told[0]) for m in (model, None))
    assert np.abs((corrected - alone)[100:]).mean() == pytest.approx(0.1, rel=0.2)


def test_a_virtual_robot_feels_a_payload_come_and_go(make_study):
    study = make_study(payloads=(0.0, 0.2), units=("virtual-1",))
    twice = [s for s in study.data.sequences(study.data.entries) if s.meta.motion == "motion0"]
    runs = [_play(study, study.robot, twice, np.array([0.0, 0.2]), switched)[0] for switched in ([], [20])]
    still, moved = (np.stack(qpos) for qpos in runs)
    np.testing.assert_array_equal(still[:, :21], moved[:, :21])
    assert (np.abs(still[:, 35] - moved[:, 35]).max(axis=1) > 1e-3).all()
