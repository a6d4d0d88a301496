"""The front door: public names, and logs to an evaluated model by calls alone."""

import subprocess
import sys

import numpy as np
import pytest
from arm import recordings, write_arm, write_dataset

import gaponet as gp
from gaponet.base.errors import UsageError
from gaponet.data.store import Dataset
from gaponet.nn.config import ModelConfig
from gaponet.nn.training.config import PretrainingConfig, TrainConfig


def test_public_names_are_there_and_what_is_not_says_what_is():
    assert {"import_logs", "train", "evaluate", "GapModel"} <= set(dir(gp))
    for name in dir(gp):
        assert getattr(gp, name) is not None
    with pytest.raises(AttributeError, match="'fit'"):
        gp.fit  # noqa: B018


def test_no_public_name_hides_behind_a_module_of_the_same_name():
    code = (
        "import gaponet as gp, pkgutil, importlib\n"
        "mods = [m.name for m in pkgutil.iter_modules(gp.__path__)]\n"
        "print(sorted(set(mods) & set(dir(gp))))"
    )
    out = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True
    ).stdout
    assert out.strip() == "[]"


def test_from_a_dataset_to_an_evaluated_model(tmp_path, capsys):
    robot = write_arm(tmp_path)
    data = Dataset.create(tmp_path / "data", robot)
    for sequence in recordings(robot, 8, kp=0.5, delay=2):
        data.append(sequence)
    assert gp.pair(data, robot=robot).simulated == 8
    nominal = gp.gap(data, robot=robot).mpjae["nominal"]
    assert gp.doctor(data, robot=robot).verdict
    small = TrainConfig(
        ModelConfig(
            history=2, num_probes=4, branch_hidden=(16,), trunk_hidden=(16,), sensor_hidden=(16,)
        ),
        pretraining=PretrainingConfig(
            rounds=2, num_envs=16, steps=60, gradient_steps=60, batch_size=256
        ),
    )
    model = gp.train(
        data, out=tmp_path / "run", budget=str(2 * 16 * 60), config=small, robot=robot
    ).model
    found = gp.evaluate(model, data, robot=robot)
    assert found.unseen
    assert found.mpjae["gaponet"] < 0.8 * nominal
    loop = model.loop()
    assert np.isfinite(loop.delta(np.zeros(2), np.zeros(2), np.ones(2), 0.0)).all()


@pytest.mark.parametrize(
    "call",
    [
        lambda arm, out: gp.export_robot(arm.folder, to="foo", out=out),
        lambda arm, out: gp.export_network("so101-sage", to="foo", out=out),
        lambda arm, out: gp.randomization(arm.folder, engine="foo", out=out),
        lambda arm, out: gp.randomization(arm.folder, scope="foo", out=out),
        lambda arm, out: gp.excite(arm, out=out, options=gp.ExciteOptions(format="foo")),
        lambda arm, out: gp.IdentifyOptions(terms=("foo",)).searches(),
    ],
)
def test_a_word_that_is_no_choice_is_refused_with_the_choices(arm, tmp_path, call):
    with pytest.raises(UsageError, match="is 'foo'; choose "):
        call(arm, tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_a_payload_is_not_exported_with_a_network_that_takes_it_as_an_input(tmp_path):
    with pytest.raises(UsageError, match="payload_mass"):
        gp.export_network("so101-sage", to="onnx", out=tmp_path / "out", payload_mass=0.1)
    assert not (tmp_path / "out").exists()


def test_a_payload_that_a_dataset_states_already_is_not_given_again(arm, tmp_path):
    data = write_dataset(tmp_path / "data", arm, recordings(arm, count=1))
    with pytest.raises(UsageError, match="--payload-mass"):
        gp.adapt_robot(arm, data.path, out=tmp_path / "out", payload_mass=3.0)
