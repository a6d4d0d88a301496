"""Training runs, small: what is kept, what is refused, what survives an interruption."""

import json
from dataclasses import replace

import numpy as np
import pytest
from arm import recordings, write_arm, write_dataset

import gaponet.sim.batch
from gaponet.api.files import export_network
from gaponet.base.errors import ModelError, UsageError
from gaponet.data.split import split_entries, write_split
from gaponet.evaluation.evaluate import ORDER, evaluate
from gaponet.evaluation.methods import METHODS
from gaponet.evaluation.verdict import LEARNED
from gaponet.nn.artifact import GapModel
from gaponet.nn.config import ModelConfig
from gaponet.nn.training.config import Budget, PPOConfig, PretrainingConfig, TrainConfig
from gaponet.nn.training.trainer import Trainer
from gaponet.nn.training.validation import Validator

SMALL = TrainConfig(
    model=ModelConfig(
        history=2, num_probes=4, branch_hidden=(32,), trunk_hidden=(32,), sensor_hidden=(32,)
    ),
    pretraining=PretrainingConfig(
        rounds=3, num_envs=16, steps=60, gradient_steps=80, batch_size=256, sensor_states=512
    ),
    ppo=PPOConfig(num_envs=16, num_steps=16, epochs=1, critic_warmup=1, explained=-1e9),
    validate_every=4,
)
STEPS = Budget(steps=3 * 16 * 60 + 8 * 16 * 16)


def dataset(folder, robot, **how):
    return write_dataset(folder, robot, recordings(robot, 8, **how))


@pytest.fixture(scope="module", autouse=True)
def short_fits():
    """Sensor predictors are fitted in a third of the steps."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("gaponet.nn.training.sensor_fit.FIT_STEPS", 200)
        yield


@pytest.fixture(scope="module")
def robot(tmp_path_factory):
    return write_arm(tmp_path_factory.mktemp("arm"))


@pytest.fixture(scope="module")
def shared():
    """Results of trainings on `trained`'s recordings that do not depend on the network."""
    return {}


@pytest.fixture(scope="module")
def trained(robot, shared, tmp_path_factory):
    place = tmp_path_factory.mktemp("trained")
    data = dataset(place / "data", robot, kp=0.5, delay=2)
    run = place / "run"
    return data, run, Trainer(data, robot, run, SMALL, STEPS, shared=shared).run()


def test_a_trained_operator_beats_the_nominal_simulator_on_unseen_motions(trained, robot):
    data, run, _ = trained
    result = evaluate([run], data, robot).result
    assert result["unseen"]
    assert list(result["methods"]) == ["nominal", "delay_offset", "gaponet"]
    assert result["methods"]["gaponet"]["mpjae"] < 0.7 * result["methods"]["nominal"]["mpjae"]


def test_a_run_whose_budget_buys_no_step_fails_and_can_be_resumed(trained, robot, tmp_path):
    data, _, _ = trained
    with pytest.raises(
        ModelError,
        match="budget",
    ):
        Trainer(data, robot, tmp_path / "run", SMALL, Budget(seconds=1e-6)).run()
    assert not (tmp_path / "run/model").exists()
    card = (
        Trainer(data, robot, tmp_path / "run", SMALL, Budget(steps=16 * 60), resume=True).run().card
    )
    assert GapModel.how_trained(card) == "supervised pre-training (1 of 3 rounds), no PPO"


def test_a_run_takes_its_parts_from_a_split_file(trained, robot, tmp_path):
    data, _, _ = trained
    parts = split_entries(data)
    other = {"train": parts["train"], "val": parts["test"], "test": parts["val"]}
    path = write_split(data, other, "motion", ("swapped",))
    config = replace(SMALL, split=str(path))
    assert Trainer(data, robot, tmp_path / "run", config, STEPS).data.splits == other
    with pytest.raises(UsageError, match="--train-share"):
        Trainer(data, robot, tmp_path / "other", replace(config, train_share=0.5), STEPS)


def test_a_plain_network_trains_and_is_evaluated_beside_the_operator(
    trained, shared, robot, tmp_path
):
    data, run, _ = trained
    config = replace(SMALL, model=replace(SMALL.model, kind="mlp", mlp_hidden=(64,)))
    model = Trainer(data, robot, tmp_path / "run", config, STEPS, shared=shared).run()
    stages = {line["stage"] for line in progress(tmp_path / "run")}
    assert stages - {"gain"} == {"start", "pretraining", "ppo"}
    assert model.card["val_mpjae"]["model"] < 0.95 * model.card["val_mpjae"]["nominal"]
    result = evaluate([run, tmp_path / "run"], data, robot).result
    assert [m for m in result["methods"] if m in LEARNED] == ["mlp", "gaponet"]
    assert set(ORDER) | {"target", "recorded"} <= set(METHODS)


def test_trees_train_without_ppo_and_are_exported_like_networks(
    trained, shared, robot, tmp_path, monkeypatch
):
    pytest.importorskip("sklearn")
    monkeypatch.setattr("gaponet.nn.trees.TREES", 4)
    config = replace(SMALL, model=replace(SMALL.model, kind="trees"))
    model = Trainer(trained[0], robot, tmp_path / "run", config, STEPS, shared=shared).run()
    assert GapModel.how_trained(model.card) == "supervised pre-training (3 rounds), no PPO"
    assert model.card["val_mpjae"]["model"] < 0.95 * model.card["val_mpjae"]["nominal"]
    assert "trees" in evaluate([tmp_path / "run"], trained[0], robot).result["methods"]
    assert export_network(tmp_path / "run", to="torch").parity < 1e-5


def progress(run):
    """Validations of a run, in their order."""
    lines = (run / "progress.jsonl").read_text().splitlines()
    return [json.loads(line) for line in lines]


def test_the_best_network_of_all_stages_is_exported(trained):
    _, run, model = trained
    error = model.card["val_mpjae"]
    assert {line["stage"] for line in progress(run)} - {"gain"} == {"start", "pretraining", "ppo"}
    assert error["model"] == min(line["val_mpjae"] for line in progress(run))
    assert error["model"] < error["nominal"]


def test_progress_states_how_labels_were_fitted(trained):
    fitted = [line for line in progress(trained[1]) if line["stage"] == "pretraining"]
    assert all(0 < line["label_rmse"] < 0.1 for line in fitted)
    assert all(line["label_rmse_before"] > 0 for line in fitted)
    assert fitted[0]["label_rmse"] < fitted[0]["label_rmse_before"]


def test_the_card_states_what_a_network_was_trained_on(trained):
    card = trained[2].card
    assert card["joint_names"] == ["shoulder", "elbow"]
    assert card["payload_seen"] == [0.0, 0.2]
    assert card["virtual"] is True
    assert card["parity_rad"] <= 1e-5


def test_threads_reach_every_simulation(robot, tmp_path, monkeypatch):
    asked = set()
    batch = gaponet.sim.batch.Batch

    def note(*args, nthread, **rest):
        asked.add(nthread)
        return batch(*args, nthread=nthread, **rest)

    monkeypatch.setattr(gaponet.sim.batch, "Batch", note)
    data = dataset(tmp_path / "data", robot, rows=40)
    Trainer(
        data, robot, tmp_path / "run", replace(SMALL, threads=1), Budget(steps=16 * 60 + 16)
    ).run()
    assert asked == {1}


@pytest.mark.parametrize("sensors", ["predicted", "off"])
def test_ppo_alone_has_statistics_of_its_inputs_and_a_fitted_predictor(
    sensors, trained, shared, robot, tmp_path
):
    config = replace(
        SMALL,
        pretraining=replace(SMALL.pretraining, rounds=0),
        model=replace(SMALL.model, sensors=sensors),
    )
    budget = Budget(steps=16 * 16)
    trainer = Trainer(trained[0], robot, tmp_path / "run", config, budget, shared=shared)
    model = trainer.run()
    assert trainer.net.features.standardise.std.min() < 0.9
    assert (trainer.progress.state.sensor_r2 is None) == (sensors == "off")
    if sensors == "predicted":
        assert model.card["sensor_r2"]["mean"] > 0.3


def test_the_gain_is_halved_if_that_reduces_the_validation_error(
    tmp_path, robot, trained, shared, monkeypatch
):
    # Nominal 0.5; the fitted network 0.6 as it is and 0.4 at half.
    def error(validator, net, robot=None):
        fitted = net is not None and bool(net.trunk[-1].weight.any())
        mean = 0.4 + 0.4 * abs(net.bounded.gain.item() - 0.5) if fitted else 0.5
        return np.full(len(validator.sequences), mean)

    monkeypatch.setattr(Validator, "errors", error)
    model = Trainer(trained[0], robot, tmp_path / "run", SMALL, STEPS, shared=shared).run()
    assert model.card["gain"] == 0.5
    assert model.card["val_mpjae"]["model"] == pytest.approx(0.4)


def test_ppo_starts_untrained_if_pretraining_increases_the_error(
    tmp_path, robot, trained, shared, monkeypatch
):
    seen = []

    def error(validator, net, robot=None):
        seen.append((trainer.progress.stage, net is not None and bool(net.trunk[-1].weight.any())))
        return np.full(
            len(validator.sequences), 0.6 if trainer.progress.stage == "pretraining" else 0.5
        )

    monkeypatch.setattr(Validator, "errors", error)
    config = replace(
        SMALL,
        pretraining=replace(SMALL.pretraining, rounds=2),
        validate_every=1,
        ppo=replace(SMALL.ppo, critic_warmup=3),
    )
    trainer = Trainer(trained[0], robot, tmp_path / "run", config, STEPS, shared=shared)
    model = trainer.run()
    rounds = [s for s in seen if s[0] == "pretraining"]
    updates = [s for s in seen if s[0] == "ppo"]
    assert rounds == [("pretraining", True)] * 2
    # The critic alone, beside a network that corrects nothing.
    assert updates[:3] == [("ppo", False)] * 3
    assert updates[4:-1] == [("ppo", True)] * len(updates[4:-1])
    assert GapModel.how_trained(model.card) == (
        f"supervised pre-training (2 rounds), worse than no correction; {len(updates) - 1} "
        "updates of PPO from the untrained network"
    )


@pytest.mark.parametrize(
    ("step", "message"),
    [(1.0, "--mixed-gains"), (0.0, r"robot\.toml")],
)
def test_recordings_with_several_gains_or_with_others_than_the_robots_need_an_option(
    robot, tmp_path, step, message
):
    metas = [(5.0 + step * (i % 2), 5.0) for i in range(8)]
    sequences = [
        replace(s, meta=replace(s.meta, kp=kp, kd=(0.1, 0.1)))
        for s, kp in zip(recordings(robot, 8), metas, strict=True)
    ]
    data = write_dataset(tmp_path / "data", robot, sequences)
    with pytest.raises(UsageError, match=message):
        Trainer(data, robot, tmp_path / "run", SMALL, STEPS)
    Trainer(data, robot, tmp_path / "run", replace(SMALL, mixed_gains=True), STEPS)


def test_a_training_that_uses_shared_results_equals_the_one_that_made_them(
    trained, robot, tmp_path, monkeypatch
):
    data = trained[0]
    budget = Budget(steps=16 * 60)
    shared = {}
    first = Trainer(data, robot, tmp_path / "first", SMALL, budget, shared=shared).run()
    monkeypatch.setattr("gaponet.nn.training.trainer.trajectory_labels", None)
    second = Trainer(data, robot, tmp_path / "second", SMALL, budget, shared=shared).run()
    assert second.card["val_mpjae"] == first.card["val_mpjae"]
