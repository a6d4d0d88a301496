"""Friction by temperature is fitted to recordings at several temperatures, and is a cause of its
own.
"""

from dataclasses import replace

import numpy as np
import pytest
from arm import write_arm

from gaponet.data.sequence import Sequence, SequenceMeta
from gaponet.evaluation.gap import cause_steps
from gaponet.sim.replay import replay
from gaponet.sysid.axes import WARM, Bounds, identified_joints
from gaponet.sysid.joint_rollouts import JointRollouts
from gaponet.sysid.problem import JointFit
from gaponet.sysid.standard_errors import standard_errors

SERVO = {
    "kp": 3.0,
    "damping": 0.08,
    "frictionloss": 0.03,
    "armature": 2e-3,
    "offset": 0.0,
    "delay": 0.0,
}
TRUE = {"friction_per_kelvin": -0.02, "damping_per_kelvin": -1e-3, "friction_temperature": 30.0}
TOML = 'name = "disc"\ndt = 0.01\ntimestep = 0.005\n[[joint]]\nname = "turn"\nkp = 3.0\neffort_limit = 50.0\n'
XML = """<mujoco><compiler angle="radian"/><worldbody><body><joint name="turn" axis="0 0 1" armature="0.002"
  damping="0.08" frictionloss="0.03"/><geom type="capsule" fromto="0 0 0 0.2 0 0" size="0.01" mass="0.15"
  contype="0" conaffinity="0"/></body></worldbody></mujoco>"""


def recorded(robot, celsius):
    """Recordings of a VIRTUAL joint whose grease thins, one at each temperature."""
    rng, t, parts = np.random.default_rng(0), np.arange(200)[:, None] * 0.01, []
    for number, warm in enumerate(celsius):
        ctrl = sum(
            0.2 * np.sin(2 * np.pi * f * t + p) for f, p in rng.uniform((0.3, 0), (1.5, 6), (3, 2))
        )
        meta = SequenceMeta(robot.name, "a", f"m{number}", 0.0, virtual=True)
        command = Sequence(
            meta, robot.joint_names, 0.01, ctrl, 0 * ctrl, 0 * ctrl, temperature=0 * ctrl + warm
        )
        (moved,) = replay([command], robot.with_identified({"turn": SERVO | TRUE}))
        noisy = moved.qpos + 2e-4 * rng.standard_normal(moved.qpos.shape)
        parts.append(replace(command, qpos=noisy, qvel=moved.qvel))
    return parts


def test_friction_and_damping_by_temperature_are_fitted_with_their_errors(tmp_path):
    robot = write_arm(tmp_path / "disc", TOML, XML)
    parts = recorded(robot, (22.0, 28.0, 34.0, 40.0))
    fit = JointFit(JointRollouts(parts, robot, nthread=1), robot, Bounds(robot, parts))
    start = {f: np.full(1, v) for f, v in SERVO.items()} | {f: fit.bounds.guess[f] for f in WARM}
    assert start["friction_temperature"].tolist() == [31.0]
    values = fit.search(start)
    assert values["friction_per_kelvin"][0] == pytest.approx(-0.02, rel=0.2)
    assert values["damping_per_kelvin"][0] == pytest.approx(-1e-3, rel=0.2)
    std = standard_errors(fit, values).std["turn"]
    assert 0 < std["friction_per_kelvin"] < 0.004
    assert "friction_temperature" not in std  # it is stated, not fitted
    assert fit.bounds.visible(WARM[0], values) == values["friction_per_kelvin"]
    small = values | {"friction_per_kelvin": np.full(1, 9e-4)}
    assert fit.bounds.visible(WARM[0], small | {"damping_per_kelvin": np.full(1, 5e-5)}) == 0
    assert fit.bounds.visible(WARM[0], small) == 9e-4  # damping changes by more


def test_recordings_at_one_temperature_leave_the_term_at_zero(tmp_path):
    robot = write_arm(tmp_path / "disc", TOML, XML)
    parts = recorded(robot, (30.0, 30.5))
    bounds = Bounds(robot, parts)
    assert [bounds.limits[f][1][0] for f in WARM[:2]] == [0.0, 0.0]
    assert bounds.guess["friction_per_kelvin"][0] == 0
    low, high, _ = Bounds(robot.with_identified({"turn": SERVO | TRUE}), parts).limits[
        "friction_per_kelvin"
    ]
    assert low == high == -0.02  # a robot that has the term keeps it


def test_the_temperature_is_the_last_cause_of_the_joint_itself(tmp_path):
    robot = write_arm(tmp_path / "disc", TOML, XML).with_identified(
        {"turn": SERVO | {"frictionloss": 0.04} | TRUE}
    )
    steps = cause_steps(robot)
    assert [step.name for step in steps] == ["friction", "creep", "temperature"]
    assert steps[1].simulator.servo.friction_per_kelvin[0] == 0
    assert identified_joints(robot) == {"turn"}
