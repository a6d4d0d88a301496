"""Simulators that no model was trained in, and what is said of runs in them."""

import numpy as np
import pytest
from arm import recordings, write_arm

from gaponet.sim.model import build_model, model_hash
from gaponet_lab.study.played.simulators import (
    CHANGES,
    EULER,
    FAR,
    Simulator,
    errors,
    free_run,
    microseconds,
    recorded,
    simulators_of,
)
from gaponet_lab.study.simulators import share


@pytest.fixture(scope="module")
def robot(tmp_path_factory):
    return write_arm(tmp_path_factory.mktemp("arm"))


def test_every_one_of_them_is_another_simulator(robot, tmp_path):
    found = list(simulators_of(robot, False, tmp_path / "euler"))
    changed = [model_hash(s.robot) for s in found if s.name in (*CHANGES, *FAR, EULER)]
    assert len({*changed, model_hash(robot)}) == len(CHANGES) + len(FAR) + 2
    assert [s.name for s in found if s.payload] == ["payload wrong"]
    stiff = next(s for s in found if s.name == "mixture, stiff")
    np.testing.assert_allclose(stiff.robot.kp, 1.5 * robot.kp)
    np.testing.assert_allclose(stiff.robot.armature, 0.5 * build_model(robot).dof_armature)


def test_the_reference_alone_has_no_error_on_its_own_recordings_and_transfer_next_to_none(robot):
    motions = sorted(recordings(robot, 4, rows=60)[::2], key=lambda s: -len(s))  # empty-handed
    real, soft = recorded(motions, robot), next(s for s in simulators_of(robot, False, robot.folder / "euler"))
    home = errors(motions, free_run(motions, Simulator("", robot)), real)
    alone, given = (errors(motions, free_run(motions, soft, like), real) for like in (None, robot))
    assert max(home) < 1e-3 < max(given) < 0.02 * min(alone)


@pytest.mark.parametrize("disturbed", ["plane", "push"])
def test_planes_and_pushes_make_a_difference(robot, disturbed):
    motions = recordings(robot, 1, rows=130)
    free, other = (free_run(motions, Simulator("", robot), disturbed=what) for what in ("", disturbed))
    assert errors(motions, other, free)[0] > 1.0


def test_every_way_is_timed(robot):
    motion = next(s for s in recordings(robot, 1, rows=30) if not s.meta.payload_mass)
    took = microseconds(motion, Simulator("", robot), [(None, "closed"), (robot, "closed"), (robot, "probes")])
    assert len(took) == 3
    assert min(took) > 0.0


def test_a_share_is_of_means_and_its_error_paired():
    found = share([1.0, 2.0, 3.0], [2.0, 4.0, 6.0])
    assert (found.mean, found.std, found.count) == (0.5, pytest.approx(0.0), 3)
    assert share([1.0, 3.0], [2.0, 2.0]).std == pytest.approx(0.5)
