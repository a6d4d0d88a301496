"""A simulator without the robot's payload."""

from dataclasses import replace

import numpy as np
import pytest
from arm import commands, record, write_arm

from gaponet.robot.folder import save_robot
from gaponet.robot.spec import load_robot
from gaponet.sim.model import build_model, model_hash
from gaponet.sim.replay import replay


@pytest.fixture
def arm(tmp_path):
    return write_arm(tmp_path / "arm")


def test_it_moves_as_the_empty_one_whatever_the_recording_carries(arm):
    empty, laden = (record(arm, commands(60, 1), "m", payload=p) for p in (0.0, 0.2))
    bare = replace(arm, carries_payload=False)
    own, told = (replay([laden], r)[0].qpos for r in (bare, arm))
    assert np.abs(own - told).max() > 1e-3
    same = replace(laden, meta=empty.meta, qpos=laden.qpos, qvel=laden.qvel)
    np.testing.assert_array_equal(own, replay([same], arm)[0].qpos)


def test_it_has_another_hash_and_survives_its_folder(arm, tmp_path):
    bare = replace(arm, carries_payload=False)
    assert model_hash(bare) != model_hash(arm)
    save_robot(bare, tmp_path / "bare")
    again = load_robot(tmp_path / "bare")
    assert not again.carries_payload
    assert model_hash(again) == model_hash(bare)
    assert build_model(again, 0.2).body_mass.sum() == build_model(arm).body_mass.sum()
