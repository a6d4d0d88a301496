"""A unit that differs from those trained on in gain and delay, and a model that corrects
nothing.
"""

import json
from dataclasses import replace

import numpy as np
import pytest
from arm import commands, record, write_arm, write_dataset

from gaponet import api
from gaponet.base.errors import ModelError, NoGainError, UsageError
from gaponet.data.store import Dataset
from gaponet.nn.adaptation import Adaptation
from gaponet.nn.artifact import GapModel, make_card
from gaponet.nn.config import ModelConfig
from gaponet.nn.networks import build_network
from gaponet.nn.onnx_export import export
from gaponet.robot.spec import load_robot
from gaponet.sim.replay import replay
from gaponet.sysid.adapt import adapt


@pytest.fixture(scope="module")
def robot(tmp_path_factory):
    return write_arm(tmp_path_factory.mktemp("robots") / "arm")


@pytest.fixture(scope="module")
def model(robot, tmp_path_factory):
    config = ModelConfig(history=2, num_probes=2)
    folder = tmp_path_factory.mktemp("run") / "model"
    net = build_network(config, 2).eval()
    export(
        net,
        folder,
        make_card(config, robot, dt=[0.02]),
        np.zeros((4, net.features.dim), np.float32),
    )
    return GapModel.load(folder)


@pytest.fixture(scope="module")
def logs(robot):
    return [record(robot, commands(300, seed), f"m{seed}", kp=0.6, delay=2) for seed in range(3)]


@pytest.fixture(scope="module")
def found(model, robot, logs):
    return Adaptation.fit(model, robot, logs[:2], seconds=16.0)


def test_gain_and_delay_of_the_unit_are_estimated(found, robot):
    for i, joint in enumerate(robot.operated):
        assert found.servos[joint]["kp"] == pytest.approx(0.6 * robot.servo.kp[i], rel=0.2)
        assert found.servos[joint]["delay"] == pytest.approx(0.04, abs=0.008)
        assert abs(found.servos[joint]["offset"]) < 0.01
    assert found.after < 0.1 * found.before


def test_a_motion_that_was_not_used_is_followed_better(found, model, robot, logs):
    def error(simulator):
        simulated = replay(logs[2:], simulator, model.corrector(robot))[0]
        return np.abs(simulated.qpos - logs[2].qpos).mean()

    assert error(found.robot(robot)) < 0.2 * error(robot)


def test_an_adaptation_is_read_as_it_was_written(found, tmp_path):
    odd = replace(found, unit_id="lab/arm 2")
    assert odd.save(tmp_path).name == "lab_arm_2.json"
    assert Adaptation.load(tmp_path, found.weights) == {"lab/arm 2": odd}
    with pytest.raises(ModelError, match="another"):
        Adaptation.load(tmp_path, "0123456789ab")


def test_an_adaptation_for_an_earlier_model_is_replaced(found, tmp_path):
    replace(found, weights="0123456789ab").save(tmp_path)
    found.save(tmp_path)
    assert Adaptation.load(tmp_path, found.weights) == {found.unit_id: found}


def test_recordings_of_two_units_are_refused(model, robot, logs):
    other = replace(logs[0], meta=replace(logs[0].meta, unit_id="other"))
    with pytest.raises(UsageError, match="unit"):
        Adaptation.fit(model, robot, [logs[1], other])


@pytest.mark.parametrize(
    ("changed", "said"),
    [
        ({"servos": {"elbow": {"kp": float("nan")}}}, r"servos\.elbow\.kp:"),
        ({"servos": {"elbow": {"mass": 1.0}}}, "servos.elbow.mass"),
        ({"servos": []}, "servos:"),
        ({"logs": "abc"}, "logs:"),
        ({"payload_mass": -1}, "payload_mass: "),
    ],
)
def test_a_damaged_adaptation_is_refused_with_file_and_field(found, tmp_path, changed, said):
    file = found.save(tmp_path)
    file.write_text(json.dumps(json.loads(file.read_text()) | changed))
    with pytest.raises(ModelError, match=said):
        Adaptation.load(tmp_path, found.weights)


def test_a_robot_folder_is_adapted_without_a_model_or_not_at_all(robot, logs, tmp_path):
    data = write_dataset(tmp_path / "data", robot, logs)
    found = api.adapt_robot(robot, data, out=tmp_path / "today", seconds=16.0)
    assert found.after < 0.2 * found.before
    written = load_robot(tmp_path / "today")
    np.testing.assert_allclose(written.servo.kp, 0.6 * robot.servo.kp, rtol=0.2)
    np.testing.assert_array_equal(written.nominal.servo.kp, robot.servo.kp)
    same = Dataset.create(tmp_path / "same", robot)
    same.append(record(robot, commands(300, 0), "m0"))
    with pytest.raises(NoGainError, match="nothing"):
        api.adapt_robot(robot, same, out=tmp_path / "again", seconds=8.0)
    assert not (tmp_path / "again" / "robot.toml").exists()


def test_one_short_command_adapts_nothing(robot, tmp_path):
    data = Dataset.create(tmp_path / "data", robot)
    for payload in (0.0, 0.1):
        data.append(record(robot, commands(60, 0), "m0", payload))
    with pytest.raises(NoGainError, match="motion"):
        api.adapt_robot(robot, data, out=tmp_path / "one")


def test_each_motion_is_judged_by_the_fit_to_the_others(robot):
    several = [record(robot, commands(150, seed), f"m{seed}", kp=0.7) for seed in range(3)]
    found = adapt(several, robot, judge=True)
    assert found.accepted
    assert len(found.judged[0]) == 3
    assert (found.judged[1] < 0.5 * found.judged[0]).all()
