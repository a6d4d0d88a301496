"""identify, train, adapt and start stop at recordings in which the doctor finds an error, unless a
person insists.
"""

import json
from dataclasses import replace

import numpy as np
import pytest
from arm import TOML, commands, record, recordings, write_arm, write_dataset
from runs import corrects_by

from gaponet import api
from gaponet.api.options import IdentifyOptions, TrainOptions
from gaponet.base.errors import DatasetError, UsageError
from gaponet.cli.main import main
from gaponet.nn.artifact import GapModel

pytest.importorskip("torch")

QUICK = IdentifyOptions(windows=2, terms=(), table=False, threads=1, budget="1s")
STOPPED = "stopped at what the doctor calls an error, sign: shoulder moves against its command"


@pytest.fixture(scope="module")
def robot(tmp_path_factory):
    return write_arm(tmp_path_factory.mktemp("robots") / "arm")


def with_opposite_sign(sequence):
    """The same recording from encoders that count the other way."""
    return replace(sequence, qpos=-sequence.qpos, qvel=-sequence.qvel)


@pytest.fixture(scope="module")
def mirrored(robot, tmp_path_factory):
    """A dataset of eight motions whose states have the opposite sign of their commands."""
    logs = [with_opposite_sign(s) for s in recordings(robot, 8, rows=400, kp=0.7)]
    return write_dataset(tmp_path_factory.mktemp("data") / "mirrored", robot, logs)


def test_identify_writes_nothing(mirrored, tmp_path):
    with pytest.raises(DatasetError, match=STOPPED):
        api.identify(mirrored, out=tmp_path / "out", options=QUICK)
    assert not (tmp_path / "out").exists()


def test_a_joint_without_a_gain_is_named(tmp_path):
    robot = write_arm(tmp_path / "arm", TOML.replace("kp = 20.0", "kp = 0.0", 1))
    data = write_dataset(tmp_path / "data", robot, recordings(robot, 5, rows=80))
    with pytest.raises(UsageError, match=r"kp of shoulder is 0, .* write the controller's kp"):
        api.identify(data, out=tmp_path / "out", options=QUICK)


def test_the_command_says_it_in_one_line(mirrored, tmp_path, capsys):
    words = ["identify", str(mirrored.path), "--out", str(tmp_path / "out"), "--no-table"]
    assert main(words) == 2
    assert STOPPED in capsys.readouterr().err.splitlines()[-1]


def test_a_person_may_insist_and_the_robot_folder_says_so(robot, tmp_path):
    logs = recordings(robot, 5, rows=80, kp=0.6, delay=2)
    twice = replace(logs[0], meta=replace(logs[0].meta, payload_mass=0.1))
    data = write_dataset(tmp_path / "data", robot, [*logs, twice])
    with pytest.raises(DatasetError, match="labels"):
        api.identify(data, out=tmp_path / "out")
    made = api.identify(data, out=tmp_path / "out", options=replace(QUICK, despite_errors=True))
    origin = json.loads((tmp_path / "out" / "identified.json").read_text())
    for doctor in (made.to_dict()["doctor"], origin["doctor"]):
        assert doctor["despite_errors"][0].startswith("labels: same samples")


def test_train_writes_no_run(mirrored, tmp_path):
    with pytest.raises(DatasetError, match=STOPPED):
        api.train(mirrored, out=tmp_path / "run", budget="1000")
    assert not (tmp_path / "run").exists()


def test_a_robot_is_not_adapted_to_them(mirrored, robot, tmp_path):
    with pytest.raises(DatasetError, match=STOPPED):
        api.adapt_robot(robot, mirrored, out=tmp_path / "today")
    assert not (tmp_path / "today").exists()


def test_a_run_is_not_adapted_to_them(mirrored, robot, tmp_path):
    run = corrects_by(0.0, robot, tmp_path / "run")
    before = sorted((tmp_path / "run").rglob("*"))
    with pytest.raises(DatasetError, match=STOPPED):
        api.adapt_model(run, mirrored)
    assert sorted((tmp_path / "run").rglob("*")) == before


def test_logs_are_named_as_they_were_given(robot, tmp_path):
    (tmp_path / "today").mkdir()
    for seed in range(3):
        s = with_opposite_sign(record(robot, commands(400, seed), f"m{seed}"))
        time = s.dt * np.arange(400)[:, None]
        head = "time,ctrl.shoulder,ctrl.elbow,qpos.shoulder,qpos.elbow"
        rows = np.concatenate([time, s.ctrl, s.qpos], axis=1)
        np.savetxt(
            tmp_path / "today" / f"m{seed}.csv", rows, delimiter=",", header=head, comments=""
        )
    (tmp_path / "today" / "logs.toml").write_text('position_unit = "rad"\ntime_unit = "s"\n')
    with pytest.raises(DatasetError) as refusal:
        api.adapt_robot(
            robot, tmp_path / "today", out=tmp_path / "out", unit="lab", payload_mass=0.0
        )
    assert str(refusal.value).startswith(f"{tmp_path / 'today'}: stopped at")


@pytest.mark.slow
def test_the_card_of_a_run_says_that_a_person_insisted(mirrored, tmp_path):
    options = TrainOptions(model="shared_mlp", despite_errors=True)
    api.train(mirrored, out=tmp_path / "run", budget="3000", options=options)
    card = GapModel.load(tmp_path / "run").card
    assert card["doctor"]["despite_errors"][0].startswith("sign: shoulder moves against")
    assert (
        "--despite-errors" in json.loads((tmp_path / "run" / "config.json").read_text())["command"]
    )
