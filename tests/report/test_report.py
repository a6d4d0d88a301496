"""The report is one offline page that says what a visitor needs to know."""

import json
import re
import shutil

import numpy as np
import pytest
from arm import write_arm
from reports import amend, evaluated_run

import gaponet as gp
from gaponet.base.errors import ModelError, UsageError
from gaponet.cli.main import main
from gaponet.data.store import Dataset
from gaponet.evaluation.run_files import read_gap
from gaponet.nn.artifact import GapModel
from gaponet.report.figures import evaluation as figures
from gaponet.report.report import warnings, write_report
from gaponet.robot.folder import save_robot
from gaponet.robot.spec import load_robot


@pytest.fixture(scope="module")
def evaluated(tmp_path_factory):
    """An evaluated run whose model corrects an identified simulator."""
    folder = tmp_path_factory.mktemp("report")
    arm = write_arm(folder / "arm")
    fitted = arm.with_identified({"elbow": {"kp": 11.0}})
    return evaluated_run(arm, Dataset.create(folder / "data", arm), folder / "run", fitted)


@pytest.fixture
def run(evaluated, tmp_path):
    """A copy that a test may change."""
    shutil.copytree(evaluated, tmp_path / "run")
    return tmp_path / "run"


def draw(robot, meta, dt, qpos):
    """Draw a motion of 160 rows in all its forms, as a picture of three bytes."""
    assert list(qpos) == ["command", "nominal", "identified+gaponet", "recorded"]
    assert all(q.shape == (160, 2) for q in qpos.values())
    return b"PNG"


def blind(*_):
    raise UsageError("no OpenGL here <b>")


def test_the_page_is_one_offline_file_that_names_the_method_everywhere(evaluated):
    gp.gap(evaluated.parent / "data", run=evaluated)
    assert list(read_gap(evaluated)["left"]) == ["nominal", "gain", "identified+gaponet"]
    page = write_report(evaluated, picture=draw).read_text()  # figures are SVG with their words
    assert '<img src="data:image/png;base64,UE5H">' in page
    assert not re.findall(r'(?:src|href)="(?!data:|#)[^"]*', page)
    for text in (
        "Undertrained: the budget ended after 3 of 10 rounds",
        "supervised pre-training (3 of 10 rounds), no PPO",
        "none: stands still",
        "elbow</td>",
        "°)",
        "Pearson",
        "median error",
        "gaponet train data --out run",
        f"gaponet eval {evaluated} {evaluated.parent / 'data'}",
        json.loads((evaluated / "metrics.json").read_text())["date"],
        "prefers-color-scheme: dark",
        "width=device-width",
        "command",
        "Where the gap comes from",
        "reduces the error of identification by 0.00 ± 0.00 mrad: leave the network out",
    ):
        assert text in page, text
    assert "train longer" not in page
    assert page.count("identification + GAPONet") > 10
    assert not re.findall(r"(?<!identification \+ )GAPONet", page)


@pytest.mark.parametrize("command", ["report", "eval"])
def test_a_table_in_the_terminal_names_the_method(evaluated, command, capsys):
    where = {
        "report": [evaluated.parent, "--list"],
        "eval": [evaluated, evaluated.parent / "data"],
    }[command]
    assert main([command, *map(str, where)]) == 0
    said = " ".join(capsys.readouterr().out.split())
    assert "GAPONet" in said
    assert not re.findall(r"(?<!identification \+ )GAPONet", said)


def test_a_trained_run_is_not_called_undertrained(run):
    amend(run, stages={"pretraining_rounds": [10, 10], "ppo_updates": 40})
    card = GapModel.load(run).card
    said = warnings(card, "identified+gaponet", json.loads((run / "metrics.json").read_text()))
    assert not any("Undertrained" in text for text in said)
    assert GapModel.how_trained(card) == "supervised pre-training (10 rounds), 40 updates of PPO"


@pytest.mark.parametrize("absent", ["date", "command", "moves", "shown"])
def test_an_incomplete_evaluation_is_refused_with_what_to_do(run, absent):
    metrics = json.loads((run / "metrics.json").read_text())
    (run / "metrics.json").write_text(json.dumps({k: v for k, v in metrics.items() if k != absent}))
    with pytest.raises(
        ModelError,
        match="missing",
    ):
        write_report(run)


@pytest.fixture(scope="module")
def trajectories():
    """Figures of two motions, in which a hardly moves, b swings, c stands, and d goes and stops."""
    n = 1500
    dt = 0.02
    time = np.arange(n) * dt
    command = np.stack(
        [0.01 * np.sin(time), np.sin(time), np.full(n, 0.3), np.minimum(time / 5, 2.0)], axis=1
    )
    arrays = {
        "0/command": command,
        "0/recorded": command,
        "0/nominal": command + np.array([0.9, 0.01, 0.5, 0.02]),
    }
    arrays |= {f"1/{k[2:]}": v if k != "0/nominal" else command + 0.2 for k, v in arrays.items()}
    return figures.trajectories(arrays, [{"dt": dt}] * 2, ("a", "b", "c", "d"), ["nominal"])


@pytest.fixture
def axes(trajectories):
    return [ax for fig in trajectories.values() for ax in fig.axes]


def test_trajectories_show_moving_joints_and_a_resting_one_that_errs_most(trajectories):
    titles = [ax.get_title("left") for ax in trajectories[0].axes]
    assert [title for title in titles if title] == ["a (stands still)", "b", "d"]


def test_the_errors_of_a_motion_are_shown_on_one_scale(axes):
    tops = np.array([ax.get_ylim()[1] for ax in axes[6:9] + axes[15:18]]).reshape(2, 3)
    assert np.ptp(tops, axis=1).max() < 1e-6
    assert tops[0, 0] > 900 > 300 > tops[1, 0]


def test_trajectories_show_the_command_and_where_it_stops_in_detail(axes):
    assert "command" in [line.get_label() for line in axes[1].lines]
    zoom = axes[5].lines[0].get_xdata()
    assert zoom[0] < 10.0 < zoom[-1]  # where the command of d stops


def test_a_joint_that_hardly_moves_is_not_blown_up(axes):
    assert np.ptp(axes[0].get_ylim()) >= 0.06


def test_an_identified_robot_has_a_page_without_training(evaluated, tmp_path):
    arm = load_robot(evaluated.parent / "arm")
    save_robot(arm.with_identified({"elbow": {"kp": 11.0}}), tmp_path / "fitted")
    page = write_report(tmp_path / "fitted", evaluated.parent / "data", picture=blind).read_text()
    assert "no OpenGL here &lt;b&gt;" in page
    assert "After identification the error is" in page
    assert "not a test result" in page  # the folder does not say what it was identified from
    assert "GAPONet" not in page
    assert "<h2>Training</h2>" not in page
