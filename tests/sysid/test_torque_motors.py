"""gaponet identify: friction, inertia and delay of arms that are driven by torque or current."""

import json

import mujoco
import numpy as np
import pytest
from arm import commands, write_arm

from gaponet.cli.main import main
from gaponet.robot.spec import load_robot
from gaponet.sim.model import build_model

TRUE = {"armature": (0.05, 0.03), "damping": (0.8, 0.3), "frictionloss": (0.12, 0.06)}
DT = 0.005  # s
LATE = 0.01  # s
LOGS_TOML = """time_unit = "s"
position_unit = "rad"
ctrl = "q_{joint}"
qpos = "q_{joint}"
tau = "tau_{joint}"
"""


def drive(robot, seed, unit=1.0, rows=1200):
    """A VIRTUAL arm by plain MuJoCo whose controller tells torques: time, angles, torques in `unit`
    N·m, (rows, 5).
    """
    model = build_model(robot)
    model.actuator_gainprm[:] = model.actuator_biasprm[:] = 0
    for name, values in TRUE.items():
        getattr(model, f"dof_{name}").reshape(model.nv, -1)[:, 0] = values
    model.opt.timestep = DT / 2
    data = mujoco.MjData(model)
    wanted = 1.6 * commands(rows, seed, DT)
    rng = np.random.default_rng(seed)
    data.qpos[:] = wanted[0]
    pitch = rng.uniform(2.5, 3.5)
    told = []
    seen = []
    for t in range(rows):
        seen.append(data.qpos + rng.normal(0, 1e-4, 2))
        probe = 0.8 * np.sin(2 * np.pi * pitch * t * DT)
        told.append(12 * (wanted[t] - seen[-1]) - 0.6 * data.qvel + probe)
        data.qfrc_applied[:] = told[max(t - round(LATE / DT), 0)]
        mujoco.mj_step(model, data, 2)
    return np.concatenate([DT * np.arange(rows)[:, None], seen, np.array(told) / unit], axis=1)


def imported(folder, robot, logs, torque=True):
    (folder / "logs").mkdir(parents=True)
    head = "time,q_shoulder,q_elbow,tau_shoulder,tau_elbow"
    layout = LOGS_TOML
    columns = 5
    if not torque:
        head = "time,q_shoulder,q_elbow"
        layout = LOGS_TOML.replace('tau = "tau_{joint}"\n', "")
        columns = 3
    for name, table in logs.items():
        file = folder / "logs" / f"{name}.csv"
        np.savetxt(file, table[:, :columns], delimiter=",", header=head, comments="")
    (folder / "logs" / "logs.toml").write_text(layout)
    words = ["import", str(folder / "logs"), "--robot", str(robot.folder), "--unit-id", "a"]
    words += ["--payload-mass", "0", "--out", str(folder / "data")]
    assert main(words) == 0
    return str(folder / "data")


@pytest.fixture(scope="module")
def robot(tmp_path_factory):
    return write_arm(tmp_path_factory.mktemp("arm") / "arm")


def expected(joint, unit):
    """What identify says of a joint of this number: each field within its tolerance."""
    fields = {name: pytest.approx(values[joint], rel=0.06) for name, values in TRUE.items()}
    fields["constant"] = pytest.approx(unit, rel=0.03)
    fields["delay"] = pytest.approx(LATE, abs=0.003)
    return fields


@pytest.mark.parametrize(("unit", "words"), [(1.0, []), (0.08, ["--current"])])
def test_a_torque_driven_arm_is_identified(robot, tmp_path, capsys, unit, words):
    data = imported(tmp_path, robot, {f"m{k}": drive(robot, k, unit) for k in range(4)})
    capsys.readouterr()
    assert main(["identify", data, "--out", str(tmp_path / "found"), "--json", *words]) == 0
    said = json.loads(capsys.readouterr().out)
    for i, found in enumerate(said["joints"].values()):
        wanted = expected(i, unit)
        assert {field: found[field] for field in wanted} == wanted
    before, after = said["angle"]["0.5"]
    assert np.mean(after) < 0.05 * np.mean(before)
    again = load_robot(tmp_path / "found")
    assert again.servo.damping[0] == said["joints"]["shoulder"]["damping"]
    # Judged by what the robot itself answers.
    assert main(["export", str(tmp_path / "found"), "--to", "json"]) == 0


def test_a_push_by_hand_is_not_taken_for_friction(robot, tmp_path, capsys):
    logs = {f"m{k}": drive(robot, k) for k in range(3)}
    for table in logs.values():
        table[400:520, 3] += 5.0  # told, and held by somebody
    data = imported(tmp_path, robot, logs)
    capsys.readouterr()
    assert main(["identify", data, "--out", str(tmp_path / "found"), "--json"]) == 0
    said = json.loads(capsys.readouterr().out)["joints"]["shoulder"]
    assert said["frictionloss"] == pytest.approx(0.12, rel=0.2)
    assert said["armature"] == pytest.approx(0.05, rel=0.2)


def test_commands_that_need_positions_name_identify(robot, tmp_path, capsys):
    data = imported(tmp_path, robot, {"one": drive(robot, 0, rows=1800)})
    for words in (["gap", data], ["train", data, "--out", str(tmp_path / "y")]):
        capsys.readouterr()
        assert main(words) == 2, words
        assert "gaponet identify" in capsys.readouterr().err
    assert main(["doctor", data]) == 0
    assert main(["identify", data, "--out", str(tmp_path / "found"), "--terms", "load"]) == 2
    assert "leave out --like, --units, --holdout-units, --terms" in capsys.readouterr().err
    # Parts of a single recording fit and validate in turn.
    assert main(["identify", data, "--out", str(tmp_path / "found")]) == 0


def test_logs_without_torque_are_refused(robot, tmp_path, capsys):
    data = imported(tmp_path, robot, {"a": drive(robot, 0, rows=300)}, torque=False)
    assert main(["identify", data, "--out", str(tmp_path / "found")]) == 2
    assert "has no torque of every operated joint" in capsys.readouterr().err
    assert not (tmp_path / "found").exists()


def test_recordings_that_are_too_short_to_judge_by_are_refused(robot, tmp_path, capsys):
    logs = {f"m{k}": drive(robot, k, rows=180) for k in range(8)}
    data = imported(tmp_path, robot, logs)
    assert main(["identify", data, "--out", str(tmp_path / "found")]) == 2
    assert "longer" in capsys.readouterr().err
    assert not (tmp_path / "found").exists()
