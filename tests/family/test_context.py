"""How a model knows which simulator it is in."""

from dataclasses import replace

import numpy as np
import pytest
from arm import recordings, write_arm

import gaponet as gp
from gaponet.data.store import Dataset
from gaponet.deploy.aligned_sim import AlignedSim
from gaponet.deploy.compensator import Compensator
from gaponet.errors import ModelError, UsageError
from gaponet.family.context import context, fingerprint, loaded_posture
from gaponet.family.draw import Family, Members
from gaponet.model.config import ModelConfig
from gaponet.sim.batch import Condition
from gaponet.training.config import TrainConfig, WarmStartConfig

HAND = [Condition(0.0, "both", 0.02)]


@pytest.fixture
def arm(tmp_path):
    return write_arm(tmp_path / "arm")


def stiffer(arm, kp=2.0):
    return replace(arm, kp=kp * arm.kp, nominal=arm)


def test_fingerprints_of_equal_simulators_are_equal_and_others_differ(arm, tmp_path):
    posture = loaded_posture(arm)
    own = fingerprint(arm, HAND, posture)
    again = write_arm(tmp_path / "again")
    np.testing.assert_array_equal(own, fingerprint(again, HAND, posture))
    assert own.shape == (1, 72)
    for other in (stiffer(arm), replace(arm, frictionloss=np.full(2, 0.15), nominal=arm)):
        apart = np.abs(fingerprint(other, HAND, posture) - own)
        assert apart.max() > 1e-4  # rad: friction × 3 and kp × 2
    laden = fingerprint(arm, [Condition(0.2, "both", 0.02)], posture)
    assert np.abs(laden - own).max() > 1e-5


def test_a_member_has_the_context_of_the_same_simulator_compiled(arm):
    family = Family(kp=(2.0, 2.0))
    for kind in ("parameters", "fingerprint"):
        drawn = context(kind, arm, arm, HAND, Members.draw(family, 1, 2, 0))
        np.testing.assert_allclose(drawn, context(kind, arm, stiffer(arm), HAND), atol=1e-6)
        assert np.abs(drawn - context(kind, arm, arm, HAND)).max() > 1e-3


@pytest.fixture(scope="module")
def runs(tmp_path_factory):
    folder = tmp_path_factory.mktemp("family")
    arm = write_arm(folder / "arm")
    (folder / "stiff.toml").write_text("kp = [0.5, 2.5]\nunladen = 0.3\n")
    data = Dataset.create(folder / "data", arm)
    for s in recordings(arm, 8, rows=60, kp=0.7):
        data.append(s)
    out = {}
    for kind in ("fingerprint", "parameters", "none"):
        config = TrainConfig(
            model=ModelConfig(history=2, num_probes=2, sensors="off", context=kind), family=str(folder / "stiff.toml"),
            warm_start=WarmStartConfig(rounds=1, num_envs=16, steps=20, gradient_steps=30, batch_size=64), threads=1,
        )  # fmt: skip
        out[kind] = gp.train(data, folder / kind, budget="320", config=config)
    return arm, data, out


def test_the_same_step_in_another_member_is_corrected_otherwise(runs):
    arm, _, models = runs
    deltas = {}
    for kind, model in models.items():
        for name, robot in (("own", arm), ("stiffer", stiffer(arm))):
            sim = AlignedSim(robot, model, 0.0)
            assert sim.transfer is None  # in its family it is asked itself
            sim.step(np.array([0.3, 0.2]))
            deltas[kind, name] = sim.delta
    for kind, differs in (("fingerprint", True), ("parameters", True), ("none", False)):
        assert (np.abs(deltas[kind, "own"] - deltas[kind, "stiffer"]).max() > 1e-5) == differs, kind


def test_what_is_no_member_is_refused_with_the_joint_and_the_range(runs):
    arm, _, models = runs
    for model in models.values():
        with pytest.raises(
            ModelError, match=r"joint 'shoulder': kp is 3 of the nominal one's, the family has 0\.5 to 2\.5"
        ):
            model.require(stiffer(arm, 3.0))
        with pytest.raises(ModelError, match="frictionloss is 2"):
            model.require(replace(arm, frictionloss=np.full(2, 0.1), nominal=arm))
        with pytest.raises(ModelError, match=r"10\.0 ms later"):
            model.require(replace(arm, delay=np.full(2, 0.01), nominal=arm))
        model.require(stiffer(arm, 2.0))
        assert AlignedSim(stiffer(arm, 3.0), model, 0.0).transfer is not None


def test_a_payload_that_the_simulator_lacks_is_known_where_the_family_has_such(runs):
    arm, _, models = runs
    for kind in ("fingerprint", "parameters"):
        sim = AlignedSim(arm, models[kind], 0.2, simulator_payload=0.0)
        assert sim.transfer is None
        sim.step(np.zeros(2))
        laden = AlignedSim(arm, models[kind], 0.2)
        laden.step(np.zeros(2))
        assert np.abs(sim.delta - laden.delta).max() > 1e-6


def test_a_model_that_is_told_needs_a_simulator(runs):
    arm, _, models = runs
    with pytest.raises(ModelError, match="which simulator it is in"):
        models["fingerprint"].loop()
    with pytest.raises(ModelError, match="which simulator it is in"):
        Compensator(arm, models["parameters"])
    models["none"].loop()


def test_eval_in_another_member_shows_the_model_there_and_transferred(runs, tmp_path):
    from gaponet.robot_folder import save_robot

    arm, data, models = runs
    save_robot(stiffer(arm), tmp_path / "stiffer")
    found = gp.evaluate(models["parameters"], data, robot=tmp_path / "stiffer").result["methods"]
    assert {"uncorrected", "member", "transfer"} <= set(found)


def test_a_context_without_a_family_and_a_family_with_probes_are_refused():
    with pytest.raises(UsageError, match="give --family"):
        _ = TrainConfig(model=ModelConfig(context="parameters")).drawn
    with pytest.raises(UsageError, match=r"does not go with --model\.sensors oracle"):
        _ = TrainConfig(model=ModelConfig(sensors="oracle"), family="wide").drawn
    with pytest.raises(UsageError, match="one joint at a time"):
        ModelConfig(kind="mlp", context="parameters")
