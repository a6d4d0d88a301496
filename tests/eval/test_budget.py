"""The gap budget: steps and floor."""

import numpy as np
import pytest
from arm import recordings, write_arm

from gaponet.eval.budget import encoder_step, floor
from gaponet.eval.budget_figure import waterfall
from gaponet.eval.evaluate import LEARNED


def test_the_encoder_step_is_read_off_the_recordings():
    rng = np.random.default_rng(0)
    angle = np.cumsum(rng.normal(0, 0.01, 4000))
    step = 2 * np.pi / 4096
    assert encoder_step([(np.round(angle / step) * step).astype(np.float32)]) == pytest.approx(step, rel=1e-3)
    assert encoder_step([angle.astype(np.float32)]) == 0.0


def test_the_floor_is_what_two_repetitions_differ_by(tmp_path):
    from dataclasses import replace

    robot = write_arm(tmp_path / "arm")
    first = recordings(robot, 1, rows=400)[0]
    noise = np.random.default_rng(1).normal(0, 0.002, (2, *first.qpos.shape))
    same = [replace(first, qpos=(first.qpos + n).astype(np.float32)) for n in noise]
    for joint in floor(same, robot).values():
        assert joint["repeatability"] == pytest.approx(0.002 * np.sqrt(2 / np.pi), rel=0.1)
        assert joint["both"] == joint["repeatability"]
    assert all(f["repeatability"] is None for f in floor(same[:1], robot).values())


@pytest.mark.parametrize("kind", LEARNED)
def test_every_kind_of_model_has_its_bar(kind):
    steps = {"nominal": 0.01, "delay": 0.008, "offset": 0.007, "identified": 0.004, kind: 0.002}
    floor = {"encoder": 0.0005, "repeatability": None, "both": 0.0005}
    found = {"left": steps, "floor": floor, "by_joint": {"elbow_joint": {"left": steps, "floor": floor}},
             "virtual": True, "robot": "arm", "sequences": 3, "unseen": True}  # fmt: skip
    ax = waterfall(found).axes[0]
    ticks = [t.get_text() for t in waterfall(found).axes[1].get_xticklabels()]
    assert ticks[0] == "nominal"
    assert ticks[-1] == "left"
    assert ax.patches[4].get_height() == pytest.approx(2.0)  # what the model removes, mrad
