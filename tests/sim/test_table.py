"""A table: contact between tips and table alone, off by default, of the stiffness that it says."""

from dataclasses import replace

import mujoco
import numpy as np
import pytest
from arm import TOML, write_arm

from gaponet.base.errors import RobotError
from gaponet.robot.folder import save_robot
from gaponet.robot.spec import Table, load_robot
from gaponet.sim.batch import BatchSim
from gaponet.sim.model import build_model, model_hash, write_table

TIP = '[[tip]]\nbody = "fore"\npos = [0.2, 0.0, 0.0]\n'


@pytest.fixture
def arm(tmp_path):
    return write_arm(tmp_path / "arm", toml=TOML + TIP)


def test_nothing_touches_without_a_table(arm):
    assert build_model(arm).npair == 0
    assert build_model(arm).opt.disableflags == build_model(replace(arm, tips=())).opt.disableflags


def test_the_tip_presses_into_the_table_by_force_over_stiffness(arm):
    model = build_model(replace(arm, table=Table(-0.05, 0.3, 3000.0)), bare=True)
    model.dof_frictionloss[:] = 0.0
    data = mujoco.MjData(model)
    data.ctrl[:] = [0.3, 0.3]  # far below the table
    mujoco.mj_step(model, data, 2000)
    force = np.zeros(6)
    mujoco.mj_contactForce(model, data, 0, force)
    depth = -0.05 - (data.body("fore").xpos[2] + data.body("fore").xmat.reshape(3, 3)[2] @ [0.2, 0, 0] - 0.001)
    assert force[0] > 5
    assert force[0] / depth == pytest.approx(3000.0, rel=0.1)


def test_a_batch_has_tables_of_its_own(arm):
    sim = BatchSim(replace(arm, table=Table(-0.05, 0.3, 3000.0)), [(0.0, "both", 0.02)] * 3, 1)
    heights = np.array([-0.05, -0.03, -9.0])
    write_table(sim.batch, next(iter(sim.models.values())), heights, np.full(3, 0.3), np.full(3, 3000.0))
    sim.reset(slice(None), np.zeros((3, 2)), np.zeros((3, 2)))
    for _ in range(200):
        sim.step(np.full((3, 2), 0.3))
    tip = [-0.2 * (np.sin(q[0]) + np.sin(q[0] + q[1])) for q in sim.qpos]
    assert tip[0] == pytest.approx(-0.05, abs=0.006)
    assert tip[1] == pytest.approx(-0.03, abs=0.006)
    assert tip[2] < -0.12


def test_a_found_table_is_saved_and_changes_the_simulator(arm, tmp_path):
    found = replace(arm.with_servos({"elbow": {"stribeck": 0.1, "zero": 0.02}}), table=Table(-0.05, 0.3, 3000.0))
    save_robot(found, tmp_path / "found")
    again = load_robot(tmp_path / "found")
    assert again.table == found.table
    assert (again.stribeck[1], again.zero[1]) == (0.1, 0.02)
    assert again.nominal.table is None
    assert model_hash(again) == model_hash(found) != model_hash(arm)
    assert model_hash(replace(found, table=None)) != model_hash(found)


def test_a_table_that_nothing_may_touch_is_refused(tmp_path):
    with pytest.raises(RobotError, match=r"\[table\]: no \[\[tip\]\] can touch it"):
        write_arm(tmp_path / "arm", toml=TOML + "[table]\nheight = -0.05\n")
    stranger = write_arm(tmp_path / "b", toml=TOML + TIP.replace("fore", "jaw") + "[table]\nheight = -0.05\n")
    with pytest.raises(RobotError, match=r"a \[\[tip\]\] names body 'jaw', which is missing"):
        build_model(stranger)


def test_stops_narrower_than_the_mjcf(arm):
    narrow = arm.with_servos({"elbow": {"stop_low": -1.0}})
    assert narrow.qpos_range[1].tolist() == [-1.0, 1.5]
    assert build_model(narrow).jnt_range[1].tolist() == [-1.0, 1.5]
