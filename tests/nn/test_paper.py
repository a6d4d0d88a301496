"""The paper's network: its dimensions, the weights that its authors published, and what it is when
it ships.
"""

import copy
import itertools
from dataclasses import asdict, replace
from itertools import product
from pathlib import Path

import numpy as np
import pytest
import torch
from arm import recordings, write_arm, write_dataset

from gaponet.base.errors import ModelError, UsageError
from gaponet.cli.main import main
from gaponet.evaluation.evaluate import evaluate
from gaponet.nn.artifact import GapModel, make_card
from gaponet.nn.config import PAPER_ONLY, ModelConfig
from gaponet.nn.loop import DeltaCorrector, DeltaLoop
from gaponet.nn.networks import build_network
from gaponet.nn.onnx_export import MAX_DIFFERENCE_RAD, export, onnx_content, sample_inputs
from gaponet.nn.onnx_network import OnnxNetwork
from gaponet.nn.sensor import ProbeOracle
from gaponet.nn.training.config import (
    Budget,
    PPOConfig,
    PretrainingConfig,
    TrainConfig,
)
from gaponet.nn.training.env import DeltaEnv, EnvOptions
from gaponet.nn.training.ppo import PPO
from gaponet.nn.training.sensor_fit import fit_inputs, probe_states
from gaponet.nn.training.trainer import Trainer
from gaponet.sim.batch import Condition
from gaponet.sim.replay import replay

PAPER = ModelConfig(kind="paper", num_probes=4, history=2)
EQUATION_1 = replace(PAPER, predictor_inputs="equation_1")


def network(config=PAPER, n=2):
    """One whose trunk answers something."""
    torch.manual_seed(0)
    net = build_network(config, n)
    torch.nn.init.normal_(net.trunk[-1].weight, std=0.02)
    return net.eval()


@pytest.mark.parametrize(
    ("history", "payload", "trunk", "seen", "asked"),
    [
        (2, False, True, 80, 10),
        (4, False, True, 140, 10),
        (6, False, True, 200, 10),
        (8, False, True, 260, 10),
        (4, True, True, 141, 11),
        (4, True, False, 141, 10),
    ],
)
def test_inputs_have_the_dimensions_of_table_2(history, payload, trunk, seen, asked):
    net = build_network(
        ModelConfig(kind="paper", history=history, payload_input=payload, payload_trunk=trunk), 10
    )
    assert net.predictor.net[0].in_features == seen
    assert net.branch[0].in_features == 20 * 2 * 10
    assert net.trunk[0].in_features == asked
    assert net.branch[-2].out_features == net.trunk[-1].out_features == 16 * 10
    assert build_network(net.config, 10)(torch.randn(3, net.config.input_dim(10))).abs().max() == 0


@pytest.fixture
def benchmark(monkeypatch):
    monkeypatch.syspath_prepend(str(Path(__file__).parents[2] / "benchmarks"))
    import released_network

    return released_network


def test_the_published_weights_give_the_published_outputs(paper_network, benchmark):
    assert benchmark.difference(paper_network) < 1e-6
    assert np.abs(np.load(paper_network / "pairs.npz")["delta"]).max() > 0.1


def test_the_branch_sees_sensor_values_alone():
    net = network()
    x = torch.randn(5, net.config.input_dim(2))
    other = torch.cat([torch.randn(5, net.config.observation_dim(2) - 1), x[:, -3:]], dim=1)
    assert not torch.allclose(net(x), net(other))
    for p in net.predictor.net[-1].parameters():
        torch.nn.init.zeros_(p)
    assert torch.equal(net(x), net(other))


def test_sensors_are_sampled_in_training_and_the_mean_otherwise():
    net = network()
    x = torch.randn(1, PAPER.input_dim(2)).expand(4000, -1)
    with torch.inference_mode():
        z = net.sensor_inputs(x)
        mean = net.sensors(x, z)
        sample = net.train().sensors(x, z)
        _, log_var = net.predictor(z)
    assert torch.equal(mean[0], mean[1])
    assert torch.allclose(sample.mean(0), mean[0], atol=0.1)
    assert torch.allclose(sample.var(0), log_var[0].exp(), rtol=0.15)


def test_the_limit_changes_no_correction_within_it():
    net = network()
    x = torch.randn(50, PAPER.input_dim(2))
    with torch.inference_mode():
        prepared = net.prepare(x)
        raw = net.train().correct(prepared)
        small = network(replace(PAPER, delta_max=float(raw.abs().median())))
        limited = small.correct(prepared)
    within = raw.abs() < small.config.delta_max
    assert 0.3 < within.float().mean() < 0.7
    assert torch.equal(limited[within], raw[within])
    assert torch.allclose(limited[~within].abs(), torch.tensor(small.config.delta_max))


def loop(infer, **how):
    config = replace(PAPER, **how)
    return DeltaLoop(config, np.array([[-9.0, 9.0]] * 2), 2, infer)


def test_a_correction_is_held_for_its_duration_and_restarts_after_a_reset():
    count = iter(range(100))
    held = loop(lambda x: np.full((2, 2), next(count) / 100, np.float32), delta_hold=3)
    zero = np.zeros((2, 2))
    seen = []
    for t in range(8):
        if t == 4:
            held.reset(np.array([1]))
        seen.append(held.delta(zero, zero, zero, 0.0)[:, 0])
    answers = np.round(100 * np.array(seen).T)
    assert answers.tolist() == [[0, 0, 0, 3, 3, 3, 6, 6], [0, 0, 0, 3, 4, 4, 4, 7]]


def test_held_sensors_see_the_observation_of_the_last_refresh_and_the_trunk_the_present_action():
    inputs = []
    held = loop(lambda x: inputs.append(x.copy()) or np.zeros((2, 2), np.float32), sensor_hold=3)
    for t in range(6):
        held.delta(*np.full((3, 2, 2), float(t)), 0.0)
    inputs = np.array(inputs)[:, 0]
    at = held.network_input.layout
    assert inputs[:, at.q.start].tolist() == [0, 0, 0, 3, 3, 3]
    assert inputs[:, at.past.start].tolist() == [0, 0, 0, 2, 2, 2]
    assert inputs[:, at.action.start].tolist() == [0, 1, 2, 3, 4, 5]


def test_an_absolute_sensor_value_is_the_next_state(tmp_path):
    robot = write_arm(tmp_path)
    q = np.array([[0.2, -0.1]])
    v = np.array([[0.5, -0.3]])
    nominal = [Condition(0.0, "both", 0.02)]
    change = ProbeOracle(robot, replace(PAPER, sensor_target="delta"), nominal)(q, v)
    state = ProbeOracle(robot, replace(PAPER, sensor_target="absolute"), nominal)(q, v)
    np.testing.assert_allclose(
        state - change, np.tile(np.concatenate([q, 0.02 * v], 1), (1, 4, 1)), atol=1e-6
    )


def test_with_fixed_probes_the_branch_observes_the_simulator_and_control_loops_are_refused(
    tmp_path,
):
    config = replace(PAPER, sensor_source="fixed")
    robot = write_arm(tmp_path / "arm")
    net = network(config)
    assert config.input_dim(2) == PAPER.input_dim(2) + 4 * 2 * 2
    x = torch.randn(5, config.input_dim(2))
    assert torch.equal(net.prepare(x)[:, -16:], x[:, -16:])
    assert net.predictor is None
    export(net, tmp_path / "run", make_card(config, robot, dt=[0.02]), sample_inputs(net))
    model = GapModel.load(tmp_path / "run")
    with pytest.raises(ModelError, match="eval"):
        model.loop()
    (simulated,) = replay(recordings(robot, 1, rows=20), robot, model.corrector(robot), nthread=1)
    assert np.isfinite(simulated.qpos).all()


def test_learned_probes_start_at_the_fixed_ones_and_gradients_reach_them_alone():
    config = replace(PAPER, sensor_source="learned")
    net = network(config).train()
    x = torch.randn(9, config.input_dim(2))
    start = (config.probe_limit * net.probes.tanh()).detach()
    np.testing.assert_allclose(start, ProbeOracle.probe_offsets(config, 2), atol=1e-6)
    net.predictor.requires_grad_(False)
    prepared = net.prepare(x)
    assert not prepared.requires_grad
    assert torch.equal(net.correct(prepared), net.correct(prepared))  # one sample per state
    net.correct(prepared).sum().backward()
    assert (net.probes.grad.abs().sum(1) > 0).all()


def test_learned_sensors_are_the_predictor_s_answers_to_each_probe():
    config = replace(PAPER, sensor_source="learned")
    net = network(config)
    x = torch.randn(9, config.input_dim(2))
    z = net.sensor_inputs(x)
    each = [
        net.predictor.mean(torch.cat([z, probe.tanh().expand(9, 2)], dim=1)) for probe in net.probes
    ]
    assert torch.allclose(net.probed(net.sensors(x, z)), torch.cat(each, dim=1), atol=1e-5)


def test_the_predictor_answers_random_probes_and_ppo_trains_the_learned_ones(tmp_path, monkeypatch):
    monkeypatch.setattr("gaponet.nn.training.sensor_fit.FIT_STEPS", 200)
    config = replace(PAPER, sensor_source="learned")
    robot = write_arm(tmp_path)
    env = DeltaEnv(recordings(robot, 2, rows=60, kp=0.5), robot, config, EnvOptions(64, nthread=1))
    net = network(config)
    start = net.probes.clone()
    learner = PPO(env, net, TRAINING.ppo)
    assert fit_inputs(net, env, env.get_observations()["actor"], 256, 0, 1)["mean"] > 0.6
    fitted = copy.deepcopy(net.predictor.state_dict())
    learner.update()
    assert not torch.isclose(net.probes, start).any()
    assert all(torch.equal(x, fitted[name]) for name, x in net.predictor.state_dict().items())


def test_options_add_the_observation_to_the_branch_and_the_lag_to_the_trunk():
    net = network(replace(PAPER, branch_observation=True, relative_action=True))
    x = torch.randn(5, net.config.input_dim(2))
    relative = net.features(x)
    assert torch.equal(net.prepare(x)[:, :3], relative[:, -3:])  # payload and A − q
    assert torch.equal(
        net.prepare(x)[:, 3 : 3 + net.config.observation_dim(2)],
        relative[:, : net.features.layout.observation.stop],
    )
    assert net.branch[0].in_features == net.config.observation_dim(2) + 16


def test_without_sensors_the_branch_sees_what_the_predictor_would_see():
    net = network(replace(PAPER, sensor_source="none"))
    with_sensors = network()
    x = torch.randn(5, PAPER.input_dim(2))
    seen = net.prepare(x)[:, net.queries :]
    assert torch.equal(seen, with_sensors.sensor_inputs(x))
    assert net.predictor is None
    assert net.branch[0].in_features == PAPER.observation_dim(2)


def test_without_sensors_nothing_is_sampled():
    net = network(replace(PAPER, sensor_source="none"))
    x = torch.randn(5, PAPER.input_dim(2))
    assert torch.equal(net.train()(x), net(x))


def test_equation_1_has_all_inputs_of_the_paper():
    net = build_network(ModelConfig(kind="paper", predictor_inputs="equation_1"), 10)
    state_with_history_and_payload = 141
    target = 10
    recorded_state = 2 * 10 + 1
    joint_index = 10
    inputs = state_with_history_and_payload + target + recorded_state + joint_index
    assert net.predictor.net[0].in_features == inputs
    mean_and_variance_of_one_joint = 2 * (20 * 2)
    assert net.predictor.net[-1].out_features == mean_and_variance_of_one_joint


def test_in_equation_1_each_joint_s_sensor_values_are_one_network_s_answer_to_its_index():
    net = network(EQUATION_1)
    x = torch.randn(9, EQUATION_1.input_dim(2))
    z = net.sensor_inputs(x)
    mean, log_var = net.predictor(z)
    by_probe = mean.reshape(9, 4, 2, 2)  # (B, m, positions and velocities, n)
    for joint, index in enumerate(torch.eye(2)):
        answer = net.predictor.net(torch.cat([z, index.expand(9, 2)], dim=1))
        assert torch.allclose(by_probe[..., joint].flatten(1), answer[:, :8], atol=1e-5)
        spread = log_var.reshape(9, 8, 2)[..., joint]
        assert torch.allclose(spread, answer[:, 8:], atol=1e-5)
    assert torch.allclose(net.predictor.mean(z), mean, atol=1e-5)


@pytest.mark.parametrize("part", ["action", "payload", "real"])
def test_in_equation_1_the_sensor_values_depend_on_target_payload_and_recorded_state(part):
    net = network(EQUATION_1)
    x = torch.randn(5, EQUATION_1.input_dim(2))
    moved = x.clone()
    moved[:, getattr(net.features.layout, part)] += 1.0
    before, after = (net.prepare(inputs)[:, net.queries :] for inputs in (x, moved))
    assert not torch.allclose(before, after, atol=1e-4)


@pytest.mark.parametrize("config", [replace(PAPER, real_state=True), EQUATION_1])
def test_a_rollout_never_observes_the_recorded_state(tmp_path, config):
    robot = write_arm(tmp_path)
    seen = []

    def remember(x):
        seen.append(x.copy())
        return np.zeros((len(x), 2), np.float32)

    replay(recordings(robot, 1, rows=20), robot, DeltaCorrector(remember, config, robot), nthread=1)
    recorded_state = np.array(seen)[..., -5:]
    assert not recorded_state.any()


def test_on_a_robot_the_measured_state_reaches_the_predictor_of_equation_1(tmp_path):
    net = network(EQUATION_1)
    robot = write_arm(tmp_path / "arm")
    export(net, tmp_path / "run", make_card(EQUATION_1, robot, dt=[0.02]), sample_inputs(net))
    hidden, measured = (GapModel.load(tmp_path / "run").loop() for _ in range(2))
    measured.network_input.extra = lambda: np.array([[0.05, -0.05, 0.1, 0.1, 1.0]])
    state = np.full((3, 2), 0.1)
    assert np.abs(measured.delta(*state, 0.0) - hidden.delta(*state, 0.0)).max() > 1e-4


def test_the_fit_moves_a_simulated_state_away_from_its_recorded_state(tmp_path):
    robot = write_arm(tmp_path)
    motions = recordings(robot, 2, rows=60, kp=0.5)
    env = DeltaEnv(motions, robot, EQUATION_1, EnvOptions(64, nthread=1))
    net = build_network(EQUATION_1, 2)
    inputs, _ = probe_states(net, env, 64, 0, 1, False)
    *_, visible = inputs.T
    shown = inputs[visible == 1]
    simulated = shown[:, net.features.layout.v]
    recorded = simulated + 0.3 * shown[:, -3:-1]  # rad/s, in units of 0.3 rad/s
    measured = torch.from_numpy(np.concatenate([motion.qvel for motion in motions])).float()
    nearest = torch.cdist(recorded, measured).amin(1)
    assert len(shown) > 10
    assert nearest.max() < 1e-3  # the noise has 0.3 rad/s


def test_the_predictor_of_equation_1_is_fitted_and_ppo_does_not_train_it(tmp_path, monkeypatch):
    monkeypatch.setattr("gaponet.nn.training.sensor_fit.FIT_STEPS", 300)
    robot = write_arm(tmp_path)
    motions = recordings(robot, 2, rows=60, kp=0.5)
    env = DeltaEnv(motions, robot, EQUATION_1, EnvOptions(64, nthread=1))
    net = network(EQUATION_1)
    branch = net.branch[0].weight.clone()
    learner = PPO(env, net, TRAINING.ppo)
    assert fit_inputs(net, env, env.get_observations()["actor"], 256, 0, 1)["mean"] > 0.6
    fitted = copy.deepcopy(net.predictor.state_dict())
    learner.update()
    assert not torch.equal(net.branch[0].weight, branch)
    assert all(torch.equal(x, fitted[name]) for name, x in net.predictor.state_dict().items())


@pytest.mark.parametrize(
    ("how", "word"),
    [
        ({"sensor_source": "none", "sensor_hold": 3}, "hold"),
        ({"sensor_source": "none", "sensor_target": "absolute"}, "sensor"),
        ({"predictor_inputs": "equation_1", "sensor_hold": 3}, "held"),
        ({"predictor_inputs": "equation_1", "payload_input": False}, "payload_input"),
        ({"predictor_inputs": "equation_1", "sensor_source": "none"}, "predicted"),
        ({"predictor_inputs": "equation_1", "sensor_source": "fixed"}, "predicted"),
        ({"predictor_inputs": "equation_1", "sensor_source": "learned"}, "predicted"),
    ],
)
def test_switches_that_contradict_each_other_are_refused(how, word):
    with pytest.raises(UsageError, match=word):
        replace(PAPER, **how)


NETWORK_SWITCHES = {
    "sensor_source": ("predicted", "fixed", "learned", "none"),
    "predictor_inputs": ("observation", "equation_1"),
    "payload_input": (True, False),
    "payload_trunk": (True, False),
    "branch_observation": (True, False),
    "relative_action": (True, False),
    "real_state": (True, False),
}
OTHER_SWITCHES = {"delta_hold", "sensor_hold", "sensor_target"}  # they do not change the network


def test_every_switch_of_the_paper_is_among_the_combinations():
    assert NETWORK_SWITCHES.keys() | OTHER_SWITCHES == {*PAPER_ONLY, "payload_input"}


def combinations():
    """A quarter of all combinations of switches; any four have all their values together."""
    places = product(*(range(len(values)) for values in NETWORK_SWITCHES.values()))
    for place in places:
        if sum(place) % 4 == 0:
            options = zip(NETWORK_SWITCHES.values(), place, strict=True)
            yield tuple(values[i] for values, i in options)


def test_any_four_switches_have_all_their_values_together():
    tried = set(combinations())
    for four in itertools.combinations(range(len(NETWORK_SWITCHES)), 4):
        values = [list(NETWORK_SWITCHES.values())[i] for i in four]
        together = {tuple(combination[i] for i in four) for combination in tried}
        assert together == set(product(*values))


@pytest.mark.parametrize("values", list(combinations()), ids=str)
def test_combinations_of_switches_ship_or_are_refused(values):
    how = dict(zip(NETWORK_SWITCHES, values, strict=True))
    lacks_inputs = how["sensor_source"] != "predicted" or not how["payload_input"]
    if how["predictor_inputs"] == "equation_1" and lacks_inputs:
        with pytest.raises(UsageError, match="equation_1"):
            replace(PAPER, **how)
        return
    net = network(replace(PAPER, **how))
    x = torch.randn(5, net.config.input_dim(2))
    with torch.inference_mode():
        sampled = net.train()(x)
        expected = net.eval()(x).numpy()
    assert sampled.shape == (5, 2)
    assert torch.isfinite(sampled).all()
    assert np.abs(expected).max() > 1e-4
    shipped = OnnxNetwork(onnx_content(net))(x.numpy())
    np.testing.assert_allclose(shipped, expected, atol=MAX_DIFFERENCE_RAD)


def test_a_hidden_recorded_state_has_no_effect_and_a_visible_one_has():
    net = network(replace(PAPER, real_state=True))
    plain = network()
    state = net.state_dict()
    state["branch.0.weight"] = state["branch.0.weight"][:, 5:]
    plain.load_state_dict(state)
    x = torch.randn(5, PAPER.input_dim(2))
    hidden, known = (torch.cat([x, part], dim=1) for part in (torch.zeros(5, 5), torch.ones(5, 5)))
    assert torch.allclose(net(hidden), plain(x), atol=1e-6)
    assert not torch.allclose(net(known), net(hidden), atol=1e-4)


@pytest.mark.parametrize("config", [replace(PAPER, real_state=True), EQUATION_1])
def test_half_of_the_episodes_show_the_recorded_state(tmp_path, config):
    robot = write_arm(tmp_path)
    env = DeltaEnv(recordings(robot, 2, rows=30), robot, config, EnvOptions(200, nthread=1))
    env.sim.qpos[:] -= 0.1
    real = env.get_observations()["actor"][:, env.observations.network_input.layout.real]
    shown = real[:, 4] == 1
    assert 60 < shown.sum() < 140
    assert not real[~shown].any()
    assert torch.allclose(real[shown][:, :4], torch.tensor([0.1, 0.1, 0, 0]), atol=1e-6)
    env.reset()
    assert not torch.equal(env.get_observations()["actor"][:, -1] == 1, shown)


def test_missing_extra_inputs_are_zero():
    seen = []
    given = loop(
        lambda x: seen.append(x[0, -21:].copy()) or np.zeros((2, 2), np.float32),
        sensor_source="fixed",
        real_state=True,
    )
    for width in (0, 16, 21):  # nothing, the simulator's answers, these and the recorded state
        given.network_input.extra = (lambda: np.ones((2, width))) if width else None  # noqa: B023
        given.delta(*np.zeros((3, 2, 2)), 0.0)
    assert np.array(seen).tolist() == [[1] * width + [0] * (21 - width) for width in (0, 16, 21)]


def test_other_networks_refuse_the_paper_s_switches():
    for how in (
        {"delta_hold": 3},
        {"sensor_hold": 3},
        {"sensor_target": "absolute"},
        {"payload_trunk": False},
        {"sensor_source": "learned"},
        {"branch_observation": True},
        {"relative_action": True},
        {"real_state": True},
        {"predictor_inputs": "equation_1"},
    ):
        with pytest.raises(UsageError, match="--model"):
            build_network(ModelConfig(**how), 2)
    with pytest.raises(UsageError, match="hold"):
        replace(PAPER, delta_hold=3, sensor_hold=3)


TRAINING = TrainConfig(
    PAPER,
    pretraining=PretrainingConfig(
        rounds=1, num_envs=8, steps=30, gradient_steps=10, batch_size=64, sensor_states=64
    ),
    ppo=PPOConfig(
        num_envs=8,
        num_steps=8,
        mini_batches=2,
        epochs=1,
        critic_warmup=0,
        explained=-1e9,
        refit_sensors=2,
        critic_hidden=(16,),
    ),
    episode_s=0.5,
    validate_every=2,
    threads=1,
)


@pytest.fixture(autouse=True)
def few_gradient_steps(monkeypatch):
    monkeypatch.setattr("gaponet.nn.training.sensor_fit.FIT_STEPS", 20)


@pytest.fixture(scope="module")
def world(tmp_path_factory):
    place = tmp_path_factory.mktemp("world")
    robot = write_arm(place / "arm")
    data = write_dataset(place / "data", robot, recordings(robot, 8, rows=60, kp=0.5))
    return data, robot


@pytest.fixture(scope="module")
def shared():
    """Results of trainings that do not depend on the network, such as baselines."""
    return {}


@pytest.mark.parametrize(
    "how",
    [
        {"delta_hold": 3, "branch_observation": True, "real_state": True},
        {"sensor_source": "fixed", "sensor_hold": 3},
        {"sensor_source": "learned"},
        {"sensor_source": "none"},
        {"predictor_inputs": "equation_1"},
    ],
    ids=[
        "held correction and more inputs",
        "held fixed probes",
        "learned probes",
        "no sensors",
        "equation 1",
    ],
)
def test_it_trains_by_ppo_alone_and_a_resumed_run_equals_one_that_was_not_stopped(
    world, shared, tmp_path, how
):
    config = replace(TRAINING, model=replace(PAPER, **how)).paper_recipe()
    update = 8 * 8 * config.model.delta_hold
    run = tmp_path / "whole"
    model = Trainer(*world, run, config, Budget(steps=4 * update), shared=shared).run()
    assert (
        GapModel.how_trained(model.card)
        == "4 updates of PPO from the untrained network, no supervised pre-training"
    )
    assert model.card["steps"] == 4 * update
    parts = tmp_path / "parts"
    Trainer(*world, parts, config, Budget(steps=2 * update), shared=shared).run()
    Trainer(*world, parts, config, Budget(steps=4 * update), resume=True, shared=shared).run()
    whole = torch.load(run / "checkpoint.pt", weights_only=True)["net"]
    resumed = torch.load(parts / "checkpoint.pt", weights_only=True)["net"]
    assert all(torch.equal(x, resumed[name]) for name, x in whole.items())
    untrained = build_network(config.model, 2)
    assert whole.keys() == untrained.state_dict().keys()


def test_it_trains_by_labels_too_and_eval_says_how_many_corrections_are_at_the_limit(
    world, tmp_path, capsys
):
    run = tmp_path / "run"
    card = Trainer(*world, run, TRAINING, Budget(steps=8 * 30 + 2 * 64)).run().card
    assert GapModel.how_trained(card) == "supervised pre-training (1 rounds), 2 updates of PPO"
    result = evaluate([run], *world).result
    assert list(result["methods"]) == ["nominal", "delay_offset", "paper"]
    assert result["delta"]["paper"]["at_limit"] == 0
    net = network(replace(PAPER, delta_max=1e-3))
    export(net, run / "model", card | {"model": asdict(net.config)}, sample_inputs(net))
    assert evaluate([run], *world).result["delta"]["paper"]["at_limit"] > 0.5
    assert main(["eval", str(run), str(world[0].path)]) == 0
    assert "of the corrections are at the limit (--model.delta-max)" in capsys.readouterr().out


def test_a_refitted_predictor_keeps_the_scale_of_the_sensor_values(world, tmp_path):
    fitted = []
    for every in (0, 2):
        config = replace(TRAINING, ppo=replace(TRAINING.ppo, refit_sensors=every))
        config = replace(config, pretraining=replace(config.pretraining, rounds=0))
        trainer = Trainer(*world, tmp_path / f"run{every}", config, Budget(steps=2 * 64))
        trainer.run()
        fitted.append(trainer.net.predictor.state_dict())
    once, again = fitted
    assert not torch.equal(once["net.0.weight"], again["net.0.weight"])
    assert torch.equal(once["outputs.mean"], again["outputs.mean"])
    assert torch.equal(once["outputs.std"], again["outputs.std"])
