"""gaponet export --to lerobot, and the LeRobot plug-in on stand-ins for LeRobot 0.6; its own run is
make lerobot.
"""

import json

import numpy as np
import pytest
import torch
from arm import TOML, write_arm
from lerobot_plugin import plugin as plugin

from gaponet.api.files import attach_correction
from gaponet.base.errors import ModelError, UsageError
from gaponet.cli.main import main
from gaponet.robot.folder import save_robot

POLICY = {
    "name": "policy_postprocessor",
    "steps": [
        {"registry_name": "unnormalizer_processor", "config": {}, "state_file": "x"},
        {"registry_name": "device_processor", "config": {"device": "cpu"}},
    ],
}


@pytest.fixture
def known(tmp_path):
    robot = write_arm(tmp_path / "arm").with_identified(
        {"elbow": {"kp": 14.0, "delay": 0.03, "frictionloss": 0.2}}
    )
    save_robot(robot, tmp_path / "known")
    return tmp_path / "known"


def test_a_policy_is_corrected_by_what_was_attached_last_and_by_nothing_after_off(
    tmp_path, known, plugin, capsys
):
    policy = tmp_path / "policy"
    policy.mkdir()
    file = policy / "policy_postprocessor.json"
    file.write_text(json.dumps(POLICY))
    for mass in ("0.1", "0.2"):
        assert (
            main(
                [
                    "export",
                    str(known),
                    "--to",
                    "lerobot",
                    "--into",
                    str(policy),
                    "--payload-mass",
                    mass,
                ]
            )
            == 0
        )
    *before, step = json.loads(file.read_text())["steps"]
    assert before == POLICY["steps"]
    assert (step["registry_name"], step["config"]["payload_mass"]) == ("gaponet_correct", 0.2)
    attached = plugin.GaponetCorrect(**step["config"])
    assert attached.corrector.dt == pytest.approx(1 / 30), "LeRobot's, not the robot's 50 Hz"
    loaded = attached.get_config()
    assert loaded == {"model": "", "follow": False} | step["config"]
    assert main(["export", str(known), "--to", "lerobot", "--into", str(policy), "--remove"]) == 0
    assert json.loads(file.read_text()) == POLICY
    for into, holder, said in (
        ([], known, "with --into POLICY"),
        (["--into", str(tmp_path)], known, "has no policy_postprocessor.json"),
        (["--into", str(policy)], policy, "is neither a robot folder"),
    ):
        assert main(["export", str(holder), "--to", "lerobot", *into]) == 2
        assert said in capsys.readouterr().err


def test_a_step_that_is_not_told_a_rate_has_lerobots(known, plugin):
    assert plugin.GaponetCorrect(known=str(known)).corrector.dt == pytest.approx(1 / 30)


def test_a_network_of_another_rate_than_lerobots_is_refused_when_loaded(plugin):
    with pytest.raises(ModelError, match=r"loop has 30\.0 Hz"):
        plugin.GaponetCorrect(model="so101-sage")
    plugin.GaponetCorrect(model="so101-sage", fps=50.0)


def test_a_network_of_another_rate_than_lerobots_is_refused_when_attached(tmp_path):
    (tmp_path / "policy_postprocessor.json").write_text(json.dumps(POLICY))
    with pytest.raises(ModelError, match=r"loop has 30\.0 Hz"):
        attach_correction(tmp_path, "so101-sage")
    assert attach_correction(tmp_path, "so101-sage", fps=50.0).config["fps"] == 50.0


def test_a_payload_without_a_place_for_it_is_refused_when_attached_and_when_loaded(
    tmp_path, plugin, capsys
):
    no_hand = write_arm(tmp_path / "no_hand", toml=TOML.split("[[payload_mount]]")[0])
    (tmp_path / "policy_postprocessor.json").write_text(json.dumps(POLICY))
    words = ["export", str(no_hand.folder), "--to", "lerobot", "--into", str(tmp_path)]
    assert main([*words, "--payload-mass", "0.2"]) == 2
    assert "has no [[payload_mount]]" in capsys.readouterr().err
    with pytest.raises(UsageError, match="payload_mount"):
        plugin.GaponetCorrect(known=str(no_hand.folder), payload_mass=0.2)
    assert main(words) == 0


def test_a_chunk_is_corrected_as_its_rows_would_be_and_the_next_goes_on_where_it_overlaps(
    known, plugin
):
    time = 0.02 * np.arange(90)[:, None]
    rows = torch.from_numpy(
        np.degrees(0.3 * np.sin(2 * np.pi * np.array([0.4, 0.6]) * time))
    ).float()
    one = plugin.GaponetCorrect(known=str(known))
    many = plugin.GaponetCorrect(known=str(known))
    single = torch.stack([one({"action": row[None]})["action"][0] for row in rows])
    first = many({"action": rows[None, :50]})["action"]
    assert first.shape == (1, 50, 2)
    torch.testing.assert_close(first[0], single[:50])
    assert (first[0] - rows[:50]).abs().max() > 0.5  # degrees
    second = many({"action": rows[None, 40:]})["action"]  # ten rows of the first were not sent
    jump = ((second[0, 0] - rows[40]) - (first[0, 39] - rows[39])).abs().max()
    assert jump < 0.2
    with pytest.raises(ValueError, match="chunk"):
        many({"action": torch.zeros(2, 5, 2)})


def test_the_arms_calibration_is_found_by_the_id_it_was_calibrated_under(tmp_path, plugin):
    robot = plugin.GaponetSO101(plugin.GaponetSO101Config(id="mine", calibration_dir=tmp_path))
    assert "--calibration" not in robot.command("ipc://x")
    (tmp_path / "so_follower").mkdir()
    (tmp_path / "so_follower" / "mine.json").write_text("{}")
    words = robot.command("ipc://x")
    assert words[words.index("--calibration") + 1] == str(tmp_path / "so_follower" / "mine.json")
    with pytest.raises(NotImplementedError, match=r"--robot\.id=mine"):
        robot.calibrate()
