"""Backlash is told from friction where the load changes its sign, and is not searched where it
cannot be seen.
"""

from dataclasses import replace

import numpy as np
import pytest
from arm import write_arm

from gaponet.data.sequence import Sequence, SequenceMeta
from gaponet.sim.replay import replay
from gaponet.sysid.axes import Bounds
from gaponet.sysid.joint_rollouts import JointRollouts
from gaponet.sysid.problem import JointFit
from gaponet.sysid.steps import backlash

WIDTH = 0.008
SERVO = {
    "kp": 3.0,
    "damping": 0.08,
    "frictionloss": 0.015,
    "armature": 2e-3,
    "offset": 0.0,
    "delay": 0.0,
}
TOML = """name = "disc"
dt = 0.01
timestep = 0.0025
[[joint]]
name = "turn"
kp = 3.0
effort_limit = 50.0
"""
XML = """<mujoco><compiler angle="radian"/><worldbody><body>
  <joint name="turn" axis="0 0 1" armature="0.002" damping="0.08" frictionloss="0.015"/>
  <geom type="capsule" fromto="0 0 0 0.2 0 0" size="0.01" mass="0.15" contype="0" conaffinity="0"/>
</body></worldbody></mujoco>"""


def fitted(folder, width):
    """The fit of a VIRTUAL joint with this gap, and values without a gap and with it, of the same
    search.
    """
    robot = write_arm(folder, TOML, XML)
    t = np.arange(200)[:, None] * 0.01
    meta = SequenceMeta(robot.name, "a", "m", 0.0, virtual=True)
    rng = np.random.default_rng(0)
    parts = []
    for number in range(3):
        ctrl = 0.0
        for hertz, phase in rng.uniform((0.3, 0), (2.0, 6), (3, 2)):
            ctrl = ctrl + 0.12 * np.sin(2 * np.pi * hertz * t + phase)
        here = replace(meta, motion=f"m{number}")
        asked = Sequence(here, robot.joint_names, 0.01, ctrl, ctrl, 0.0 * ctrl)
        (moved,) = replay([asked], robot.with_identified({"turn": SERVO | {"backlash": width}}))
        noisy = moved.qpos + 2e-4 * rng.standard_normal(moved.qpos.shape)
        parts.append(replace(asked, qpos=noisy, qvel=moved.qvel))
    fit = JointFit(JointRollouts(parts, robot, nthread=1), robot, Bounds(robot, parts))
    without = fit.search({f: np.full(1, v) for f, v in SERVO.items()})
    fit.prior.update_correlation_time(fit.rollouts, without)
    values = fit.search(without | {"backlash": fit.bounds.guess["backlash"]})
    return fit, without, values


def test_a_gap_is_found_and_probable(tmp_path):
    fit, without, values = fitted(tmp_path / "disc", WIDTH)
    assert backlash.worth_a_search(fit, without)
    assert values["backlash"] == pytest.approx(WIDTH, rel=0.2)
    chance = backlash.probability(fit, without, values)
    assert chance > 0.99
    (sentence,) = backlash.findings(
        ("turn",), values["backlash"], chance, {"turn": {"backlash": 5e-4}}
    )
    assert sentence.startswith("turn: backlash ")
    assert sentence.endswith("mrad (probability above 0.99)")


def test_friction_alone_is_no_gap(tmp_path):
    fit, without, values = fitted(tmp_path / "disc", 0.0)
    assert not backlash.worth_a_search(fit, without)
    chance = backlash.probability(fit, without, values)
    assert chance < 0.5
    (mixed,) = backlash.only_probable([without], [values], chance)
    assert mixed["backlash"] == 0
    assert mixed["kp"] == without["kp"]
    (sentence,) = backlash.findings(("turn",), np.array([0.002]), chance, {"turn": {}})
    assert "not distinguishable from static friction" in sentence
