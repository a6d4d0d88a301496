"""gaponet check --fleet: a night of many robots, those that drifted adapted, and who since when."""

import json
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import numpy as np
import pytest
from arm import commands, record, write_arm

from gaponet.cli.main import main
from gaponet.data.store import Dataset
from gaponet.fleet import changed_since, check_fleet, load_nights
from gaponet.robot.folder import save_robot
from gaponet.robot.spec import load_robot
from gaponet.sysid.evidence.evidence import estimate_uncertainty
from gaponet.sysid.uncertainty import ParameterUncertainty


def played(robot, unit, first, count, kp):
    noise = np.random.default_rng(first)
    made = [
        record(robot, commands(400, first + k), f"m{first + k}", kp=kp, delay=1, unit=unit)
        for k in range(count)
    ]
    return [
        replace(s, qpos=s.qpos + 4e-4 * noise.standard_normal(s.qpos.shape).astype(np.float32))
        for s in made
    ]


def logs(robot, place, unit, first, kp=0.8):
    data = Dataset.create(place / unit, robot)
    for one in played(robot, unit, first, 5, kp):
        data.append(one)


@pytest.fixture(scope="module")
def site(tmp_path_factory):
    """Two identified arms; the first is softer from the second night on, the second is silent that night."""
    place = tmp_path_factory.mktemp("site")
    robot = write_arm(place / "arm")
    for k, unit in enumerate(("a1", "a2")):
        save_robot(
            robot.with_servos({j: {"kp": 16.0, "delay": 0.02} for j in robot.operated}),
            place / "robots" / unit,
        )
        mine = load_robot(place / "robots" / unit)
        estimate_uncertainty(
            mine,
            played(robot, unit, 50 * k, 6, 0.8),
            played(robot, unit, 500 + k, 2, 0.8),
            nthread=1,
        ).save(mine.folder)
        logs(robot, place / "night1", unit, 1000 + 10 * k)
    logs(robot, place / "night2", "a1", 2000, 0.7)
    return place


def check(site, night):
    """Check all robots in this process: workers of their own only take longer."""
    with ThreadPoolExecutor(1) as pool:
        nights = check_fleet(site / "robots", site / night, site / "out", night, executor=pool)
        return {robot: result for robot, result, _ in nights}


def test_two_nights_of_two_arms(site, capsys):
    first = check(site, "night1")
    assert {r: n["verdict"] for r, n in first.items()} == {"a1": "same", "a2": "same"}
    second = check(site, "night2")
    assert {r: n["verdict"] for r, n in second.items()} == {"a1": "drifted", "a2": "not checked"}
    assert {tuple(number) for number in second["a1"]["numbers"]} == {
        ("shoulder", "kp"),
        ("elbow", "kp"),
    }
    before, after = second["a1"]["adapted"]
    assert after < 0.5 * before
    today = ParameterUncertainty.load(load_robot(site / "out" / "adapted" / "a1"))
    assert [s["made_by"] for s in today.sources][-1] == "adapt"
    assert changed_since(load_nights(site / "out" / "a1.json")) == "night2"
    page = (site / "out" / "fleet.html").read_text(encoding="utf-8")
    assert "2 robots: 1 drifted, 1 not checked" in page
    assert "shoulder, kp" in page

    # The same command goes on: a robot that was checked is not checked again, one that could not be read is.
    stored = (site / "out" / "a1.json").stat().st_mtime_ns
    logs(load_robot(site / "arm"), site / "night2", "a2", 2500)
    words = [
        site / "robots",
        site / "night2",
        "--out",
        site / "out",
        "--night",
        "night2",
        "--workers",
        "1",
        "--json",
    ]
    with pytest.raises(SystemExit, match="1"):
        main(["check", "--fleet", *map(str, words)])
    again = json.loads(capsys.readouterr().out)["robots"]
    assert {r: n["verdict"] for r, n in again.items()} == {"a1": "drifted", "a2": "same"}
    assert (site / "out" / "a1.json").stat().st_mtime_ns == stored
    assert [n["night"] for n in load_nights(site / "out" / "a2.json")] == ["night1", "night2"]


def test_it_drifted_since_the_first_night_in_a_row():
    nights = [
        {"night": str(k), "verdict": v}
        for k, v in enumerate(("drifted", "same", "drifted", "not checked", "drifted"))
    ]
    assert changed_since(nights) == "2"
    assert changed_since(nights[:2]) == ""


def test_a_folder_without_robots_is_refused(tmp_path, capsys):
    assert (
        main(["check", "--fleet", str(tmp_path), str(tmp_path), "--out", str(tmp_path / "out")])
        == 2
    )
    assert "holds no robot folders" in capsys.readouterr().err
