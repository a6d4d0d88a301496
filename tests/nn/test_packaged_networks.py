"""Networks of the package: found by name, complete, small, and equal to what was trained."""

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
from shipping import markdown_cards
from small_network import (
    NAME,
    SMALL,
    make_dataset,
    make_run,
    make_small_network,
    outputs,
    ship,
    use_package_folder,
)

import gaponet as gp
from gaponet.base.errors import ModelError, UsageError
from gaponet.cli.main import main
from gaponet.nn.config import ModelConfig
from gaponet.nn.network_card import (
    HEADINGS,
    NetworkCard,
    network_cards,
)
from gaponet.nn.packaged_networks import (
    MAX_TOTAL_BYTES,
    PACKAGE_FOLDER,
    named_folder,
    packaged_networks,
)
from gaponet.robot.card import folder_size
from gaponet.sim.model import model_hash

ROOT = Path(__file__).parents[2]
SHIPPED = packaged_networks()


@pytest.fixture(autouse=True, scope="session")
def _benchmarks_are_importable():
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(str(ROOT / "benchmarks"))
        yield


@pytest.fixture(scope="session")
def made(tmp_path_factory, _benchmarks_are_importable):
    return make_small_network(tmp_path_factory.mktemp("network"))


@pytest.fixture
def network(made, monkeypatch, tmp_path):
    """A network of the package, in a working directory that has nothing of its name."""
    use_package_folder(monkeypatch, made.folder.parent)
    monkeypatch.chdir(tmp_path)
    return made


# ---- names


def test_a_name_loads_the_network_of_the_run_bit_for_bit(network):
    assert np.array_equal(outputs(gp.GapModel.load(NAME)), outputs(gp.GapModel.load(network.run)))


def test_the_simulator_of_a_name_is_that_of_training(network):
    model = gp.GapModel.load(NAME)
    assert model_hash(model.simulator()) == model.card["simulator"]


def test_a_wrong_name_is_answered_with_the_names_and_the_nearest(network):
    with pytest.raises(ModelError, match="as its maker states it"):
        named_folder("so101")
    with pytest.raises(ModelError, match="nearest"):
        gp.GapModel.load("so101_smal")


def test_a_folder_of_the_same_name_here_is_refused_as_ambiguous(network, tmp_path):
    (tmp_path / NAME).mkdir()
    with pytest.raises(UsageError, match="folder"):
        gp.GapModel.load(NAME)


def test_an_absolute_path_means_the_folder_of_the_same_name(network, tmp_path):
    copy = tmp_path / NAME
    shutil.copytree(network.folder, copy)
    assert named_folder(copy) == copy


def test_a_folder_with_another_name_is_itself(network, tmp_path):
    (tmp_path / "run").mkdir()
    assert named_folder("run") == Path("run")


def test_a_simulator_that_the_package_has_no_longer_is_refused_with_the_version(
    network, tmp_path, monkeypatch
):
    package = tmp_path / "package"
    shutil.copytree(network.folder, package / NAME)
    (package / NAME / "packaged_robot.json").write_text('{"name": "so101", "gain_scale": 2.0}')
    use_package_folder(monkeypatch, package)
    with pytest.raises(ModelError, match=r"0\.1\.0"):
        gp.GapModel.load(NAME).simulator()


def test_the_simulator_has_the_gains_that_the_file_states(tmp_path, monkeypatch):
    small = make_small_network(tmp_path, gain_scale=3.0)
    use_package_folder(monkeypatch, small.folder.parent)
    simulator = gp.GapModel.load(NAME).simulator()
    joint = simulator.operated_index[0]
    assert simulator.servo.kp[joint] == pytest.approx(3 * gp.load_robot("so101").servo.kp[joint])


# ---- use


def test_evaluation_by_name_finds_the_test_motions_and_writes_nothing(network):
    before = sorted(file.name for file in network.folder.iterdir())
    result = gp.evaluate(NAME, network.data)
    assert result.unseen
    assert result.evaluation.result["motions"] == ["motion3", "motion4"]
    assert sorted(file.name for file in network.folder.iterdir()) == before


def test_the_card_has_the_errors_of_the_evaluation(network):
    measured = gp.evaluate(NAME, network.data).mpjae
    test = NetworkCard.read(network.folder).published.test
    assert test.nominal_mrad == pytest.approx(1e3 * measured["nominal"], abs=1e-3)
    assert test.model_mrad == pytest.approx(1e3 * measured["gaponet"], abs=1e-3)


def test_the_gap_by_cause_takes_a_name(network):
    assert "gaponet" in gp.gap(network.data, run=NAME).methods


def test_the_command_eval_takes_a_name(network, capsys):
    assert main(["eval", NAME, str(network.data.path), "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["unseen"]


def test_the_command_gap_takes_a_name(network, capsys):
    assert main(["gap", str(network.data.path), "--run", NAME, "--json"]) == 0
    assert "gaponet" in json.loads(capsys.readouterr().out)["methods"]


def test_the_command_robot_networks_lists_the_cards(network, capsys):
    assert main(["robot", "networks", "--json"]) == 0
    (card,) = json.loads(capsys.readouterr().out)["networks"]
    assert card["name"] == NAME


def test_an_aligned_simulator_takes_it(network):
    robot = gp.load_robot("so101")
    sim = gp.AlignedSim(robot, gp.GapModel.load(NAME))
    sim.step(robot.qpos_home + 0.05)
    assert np.isfinite(sim.qpos).all()


def test_a_scene_of_another_simulator_takes_it(network):
    from gaponet.sim.model import build_model

    weaker = gp.load_robot("so101").with_gain_scale(0.5)
    scene = build_model(weaker)
    align = gp.MujocoAligner(gp.GapModel.load(NAME), scene, dt=weaker.dt, payload_mass=0.0)
    assert align.transfer is not None


def test_a_compensator_takes_it(network):
    robot = gp.load_robot("so101")
    compensate = gp.Compensator(robot, gp.GapModel.load(NAME))
    compensate.reset(robot.qpos_home, payload_mass=0.0)
    assert np.isfinite(compensate.step(robot.qpos_home, robot.qpos_home)).all()


def test_its_copy_is_a_folder_with_robot_that_can_be_evaluated(network, tmp_path):
    gp.export_network(NAME, to="onnx", out=tmp_path / "copy")
    assert gp.evaluate(tmp_path / "copy", network.data).unseen
    assert (tmp_path / "copy" / "robot" / "robot.toml").is_file()


def test_its_torch_program_equals_the_artifact(network, tmp_path):
    parity = gp.export_network(NAME, to="torch", out=tmp_path / "torch").parity
    assert parity <= 1e-5


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["report", NAME], "a report lies beside"),
        (["adapt", NAME, "data"], "an adaptation needs a run folder"),
        (["export", NAME, "--to", "onnx"], "give a folder with --out"),
        (["export", NAME, "--to", "mjcf", "--out", "x"], "its simulator is a robot of the package"),
        (["export", NAME, "--to", "actuator-net", "--out", "x"], "train one"),
    ],
)
def test_what_needs_a_run_folder_says_so(network, capsys, words, message):
    assert main(words) == 2
    assert message in capsys.readouterr().err


# ---- how networks are shipped


@pytest.mark.parametrize("kind", ["mlp", "paper"])
def test_a_large_network_is_stored_in_less_space_within_1e_5_rad(tmp_path, kind):
    robot = gp.load_robot("so101")
    data = make_dataset(tmp_path / "data", robot)
    run = make_run(tmp_path / "run", robot, data, ModelConfig(kind=kind, history=4))
    folder = ship(run, data, tmp_path / "package")
    assert folder_size(folder) < 0.75 * (run / "model" / "model.onnx").stat().st_size
    assert 0 < NetworkCard.read(folder).published.largest_difference_rad <= 1e-5


def test_a_large_network_has_its_torch_program_too(tmp_path, monkeypatch):
    robot = gp.load_robot("so101")
    data = make_dataset(tmp_path / "data", robot)
    run = make_run(tmp_path / "run", robot, data, ModelConfig(kind="paper", history=4))
    use_package_folder(monkeypatch, ship(run, data, tmp_path / "package").parent)
    monkeypatch.chdir(tmp_path)
    assert gp.export_network(NAME, to="torch", out="torch").parity <= 1e-5


def test_a_network_of_an_identified_robot_is_not_shipped(tmp_path):
    robot = gp.load_robot("so101").with_identified({"elbow_flex": {"damping": 1.0}})
    data = make_dataset(tmp_path / "data", gp.load_robot("so101"))
    run = make_run(tmp_path / "run", robot, data)
    with pytest.raises(UsageError, match="nominal"):
        ship(run, data, tmp_path / "package")


def test_a_card_that_names_a_path_is_not_shipped(tmp_path):
    robot = gp.load_robot("so101")
    data = make_dataset(tmp_path / "data", robot)
    run = make_run(tmp_path / "run", robot, data, SMALL, source="/home/anna/logs")
    with pytest.raises(UsageError, match="home"):
        ship(run, data, tmp_path / "package")


def test_an_interrupted_training_is_not_shipped(tmp_path):
    robot = gp.load_robot("so101")
    data = make_dataset(tmp_path / "data", robot)
    run = make_run(tmp_path / "run", robot, data, SMALL, interrupted=True)
    with pytest.raises(UsageError, match="--resume"):
        ship(run, data, tmp_path / "package")


def test_names_of_recordings_are_not_shipped(network):
    ids = json.loads((network.run / "split.json").read_text())["train"]
    shipped = (network.folder / "split.json").read_text()
    assert not [name for name in ids if name in shipped]


# ---- what is shipped


@pytest.mark.parametrize("name", SHIPPED)
def test_a_shipped_network_loads_and_answers_with_finite_corrections(name):
    assert np.isfinite(outputs(gp.GapModel.load(PACKAGE_FOLDER / name))).all()


@pytest.mark.parametrize("name", SHIPPED)
def test_the_simulator_of_a_shipped_network_is_in_the_package(name):
    model = gp.GapModel.load(PACKAGE_FOLDER / name)
    assert model_hash(model.simulator()) == model.card["simulator"]


@pytest.mark.parametrize("name", SHIPPED)
def test_the_card_of_a_shipped_network_is_complete(name):
    card = NetworkCard.read(PACKAGE_FOLDER / name)
    assert all(card.row())


def test_all_shipped_networks_are_small_together():
    sizes = [card.size_bytes for card in network_cards()]
    assert sum(sizes) <= MAX_TOTAL_BYTES


def test_the_page_has_the_table_of_the_cards():
    page = (ROOT / "docs" / "network.md").read_text(encoding="utf-8")
    table = page.partition("<!-- networks -->\n\n")[2].partition("\n<!-- end of networks -->")[0]
    assert table == markdown_cards(network_cards(), HEADINGS)


def test_the_table_has_a_row_for_each_network_and_its_limits(network):
    table = markdown_cards(network_cards(), HEADINGS).splitlines()
    assert table[0].count("|") == table[2].count("|") == len(HEADINGS) + 1
    assert table[-1].startswith(f"- `{NAME}`: licence Apache-2.0, gaponet 0.1.0; ")
    assert table[-1].endswith("Made for tests.")
