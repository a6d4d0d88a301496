"""What the report says, and that it is one page that needs nothing else."""

import json
import re

import numpy as np
import pytest
from reports import amend, evaluated_run

import gaponet as gp
from gaponet.base.errors import ModelError, UsageError
from gaponet.cli.main import main
from gaponet.data.store import Dataset
from gaponet.report.figures import evaluation as figures
from gaponet.report.figures.gap_figure import waterfall
from gaponet.report.report import _r2, write_report
from gaponet.report.run_files import read_gap
from gaponet.robot.folder import save_robot


@pytest.fixture
def run(arm, tmp_path):
    return evaluated_run(arm, Dataset.create(tmp_path / "data", arm), tmp_path / "run")


def test_the_page_is_one_offline_file_that_says_what_a_visitor_asks(run):
    page = write_report(run).read_text()
    assert not re.findall(r'(?:src|href)="(?!data:|#)[^"]*', page)
    for text in (
        "Undertrained: the budget ended after 3 of 10 rounds", "3 of 10 rounds of the supervised start, no PPO",
        "none: stands still", "elbow</td>", "°)", "Pearson", "median error", "gaponet train data --out run",
        f"gaponet eval {run} {run.parent / 'data'}", json.loads((run / "metrics.json").read_text())["date"],
        "prefers-color-scheme: dark", "width=device-width", "command",
    ):  # fmt: skip
        assert text in page, text


def test_a_model_that_corrects_an_identified_simulator_is_called_so_in_every_table_and_figure(arm, tmp_path, capsys):
    data, fitted = Dataset.create(tmp_path / "data", arm), arm.with_servos({"elbow": {"kp": 11.0}})
    run = evaluated_run(arm, data, tmp_path / "run", fitted)
    page = write_report(run).read_text()  # the figures are SVG with their words in it
    assert page.count("identification + GAPONet") > 10
    assert not re.findall(r"(?<!identification \+ )GAPONet", page)
    assert list(gp.gap(data, arm, run=run)["left"]) == ["nominal", "delay", "offset", "gain", "identified+gaponet"]
    assert waterfall(read_gap(run)).axes[0].get_yticklabels()[4].get_text() == "identification + GAPONet"
    assert "Where the gap comes from" in write_report(run).read_text()
    for words in (["runs", str(tmp_path)], ["eval", str(run), str(data.path)]):
        assert main(words) == 0
        said = " ".join(capsys.readouterr().out.split())
        assert "GAPONet" in said
        assert not re.findall(r"(?<!identification \+ )GAPONet", said)


def test_a_trained_run_is_not_called_undertrained(run):
    amend(run, stages={"warm_start_rounds": [10, 10], "ppo_updates": 40})
    page = write_report(run).read_text()
    assert "Undertrained" not in page
    assert "supervised start (10 rounds), 40 updates of PPO" in page


def test_the_robot_is_pictured_or_a_sentence_says_why_not(run):
    seen = []

    def draw(robot, meta, dt, qpos):
        seen.append((robot.name, meta.motion, dt, list(qpos)))
        assert all(q.shape == (160, 2) for q in qpos.values())
        return b"PNG"

    def blind(*_):
        raise UsageError("no OpenGL here <b>")

    assert '<img src="data:image/png;base64,UE5H">' in write_report(run, picture=draw).read_text()
    assert seen[0][3] == ["command", "nominal", "gaponet", "recorded"]
    assert "No picture of the robot: no OpenGL here &lt;b&gt;" in write_report(run, picture=blind).read_text()


@pytest.mark.parametrize("absent", ["date", "command", "moves", "shown"])
def test_an_evaluation_of_before_is_refused_with_what_to_do(run, absent):
    metrics = json.loads((run / "metrics.json").read_text())
    (run / "metrics.json").write_text(json.dumps({k: v for k, v in metrics.items() if k != absent}))
    with pytest.raises(ModelError, match=r"evaluation of GAPONet is missing; .* or evaluate again"):
        write_report(run)


def test_trajectories_show_the_command_and_errors_of_a_motion_on_one_scale_moving_joints_first():
    n, dt = 1500, 0.02
    time = np.arange(n) * dt
    command = np.stack([0.01 * np.sin(time), np.sin(time), np.full(n, 0.3), np.minimum(time / 5, 2.0)], axis=1)
    arrays = {"0/command": command, "0/recorded": command, "0/nominal": command + np.array([0.9, 0.01, 0.5, 0.02])}
    arrays |= {f"1/{k[2:]}": v if k != "0/nominal" else command + 0.2 for k, v in arrays.items()}
    drawn = figures.trajectories(arrays, [{"dt": dt}] * 2, ("a", "b", "c", "d"), ["nominal"])
    axes = [ax for fig in drawn.values() for ax in fig.axes]
    titles = [ax.get_title("left") for ax in drawn[0].axes if ax.get_title("left")]
    assert titles == ["a (stands still)", "b", "d"]
    tops = np.array([ax.get_ylim()[1] for ax in axes[6:9] + axes[15:18]]).reshape(2, 3)
    assert np.ptp(tops, axis=1).max() < 1e-6
    assert tops[0, 0] > 900 > 300 > tops[1, 0]
    assert "command" in [line.get_label() for line in axes[1].lines]
    zoom = axes[5].lines[0].get_xdata()
    assert zoom[0] < 10.0 < zoom[-1]  # where the command of d stops
    assert np.ptp(axes[0].get_ylim()) >= 0.06


def test_the_sensor_predictor_is_said_by_joint():
    assert _r2(None) == "–"
    said = "0.900 on held-out states (elbow 0.80, wrist 1.00)"
    assert _r2({"mean": 0.9, "by_joint": {"elbow": 0.8, "wrist": 1.0}}) == said


def test_an_identified_robot_has_a_page_without_any_training(arm, tmp_path):
    data, run = Dataset.create(tmp_path / "data", arm), tmp_path / "run"
    evaluated_run(arm, data, run)
    fitted = tmp_path / "fitted"
    save_robot(arm.with_servos({"elbow": {"kp": 11.0}}), fitted)
    page = write_report(fitted, data.path).read_text()
    assert "Identification leaves" in page
    assert "not a held-out result" in page  # it does not say what it was identified from
    assert "GAPONet" not in page
    assert "<h2>Training</h2>" not in page


def test_a_network_that_adds_nothing_to_identification_is_said_to(arm, tmp_path):
    fitted = arm.with_servos({"elbow": {"kp": 11.0}})
    page = write_report(
        evaluated_run(arm, Dataset.create(tmp_path / "data", arm), tmp_path / "run", fitted)
    ).read_text()
    assert "its network adds 0.00 ± 0.00 mrad to identification: leave it out" in page
    assert "train longer" not in page
