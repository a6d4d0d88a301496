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
TOML = """name = "disc"
dt = 0.01
timestep = 0.005
[[joint]]
name = "turn"
kp = 3.0
effort_limit = 50.0
"""
XML = """<mujoco><compiler angle="radian"/><worldbody><body>
  <joint name="turn" axis="0 0 1" armature="0.002" damping="0.08" frictionloss="0.03"/>
  <geom type="capsule" fromto="0 0 0 0.2 0 0" size="0.01" mass="0.15" contype="0" conaffinity="0"/>
</body></worldbody></mujoco>"""


def recorded(robot, celsius):
    """Recordings of a VIRTUAL joint whose grease thins, one at each temperature."""
    rng = np.random.default_rng(0)
    t = np.arange(200)[:, None] * 0.01
    parts = []
    for number, warm in enumerate(celsius):
        ctrl = 0.0
        for hertz, phase in rng.uniform((0.3, 0), (1.5, 6), (3, 2)):
            ctrl = ctrl + 0.2 * np.sin(2 * np.pi * hertz * t + phase)
        meta = SequenceMeta(robot.name, "a", f"m{number}", 0.0, virtual=True)
        still = 0 * ctrl
        command = Sequence(
            meta, robot.joint_names, 0.01, ctrl, still, still, temperature=still + warm
        )
        (moved,) = replay([command], robot.with_identified({"turn": SERVO | TRUE}))
        noisy = moved.qpos + 2e-4 * rng.standard_normal(moved.qpos.shape)
        parts.append(replace(command, qpos=noisy, qvel=moved.qvel))
    return parts


@pytest.fixture(scope="module")
def fit(tmp_path_factory):
    """Of recordings at 22 to 40 °C."""
    robot = write_arm(tmp_path_factory.mktemp("warm") / "disc", TOML, XML)
    parts = recorded(robot, (22.0, 28.0, 34.0, 40.0))
    return JointFit(JointRollouts(parts, robot, nthread=1), robot, Bounds(robot, parts))


@pytest.fixture(scope="module")
def values(fit):
    """What the fit finds."""
    start = {field: np.full(1, value) for field, value in SERVO.items()}
    for field in WARM:
        start[field] = fit.bounds.guess[field]
    return fit.search(start)


def test_the_stated_temperature_is_the_mean_of_the_recordings(fit):
    assert fit.bounds.guess["friction_temperature"].tolist() == [31.0]


def test_friction_and_damping_by_temperature_are_fitted(values):
    assert values["friction_per_kelvin"][0] == pytest.approx(-0.02, rel=0.2)
    assert values["damping_per_kelvin"][0] == pytest.approx(-1e-3, rel=0.2)


def test_a_change_per_kelvin_has_a_standard_error(fit, values):
    std = standard_errors(fit, values).std["turn"]
    assert 0 < std["friction_per_kelvin"] < 0.004
    assert "friction_temperature" not in std  # it is stated, not fitted


def test_a_change_per_kelvin_is_visible_unless_friction_and_damping_change_little(fit, values):
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
    thinning = Bounds(robot.with_identified({"turn": SERVO | TRUE}), parts)
    low, high, _ = thinning.limits["friction_per_kelvin"]
    assert low == high == -0.02  # a robot that has the term keeps it


def test_the_temperature_is_the_last_cause_of_the_joint_itself(tmp_path):
    disc = write_arm(tmp_path / "disc", TOML, XML)
    robot = disc.with_identified({"turn": SERVO | {"frictionloss": 0.04} | TRUE})
    steps = cause_steps(robot)
    assert [step.name for step in steps] == ["friction", "creep", "temperature"]
    assert steps[1].simulator.servo.friction_per_kelvin[0] == 0
    assert identified_joints(robot) == {"turn"}
