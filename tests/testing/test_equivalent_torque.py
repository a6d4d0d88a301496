"""The torque that a nominal model would have needed."""

import numpy as np

from gaponet.sim.dynamics import static_torque
from gaponet.sim.model import build_model
from gaponet.testing.play import equivalent_torque


def test_a_still_recording_needs_its_static_torque(arm):
    model = build_model(arm, 0.2)
    qpos = np.repeat(np.array([[0.4, -0.2]]), 80, axis=0)
    tau, qacc = equivalent_torque(model, qpos, 0.02)
    assert np.allclose(tau, static_torque(model, qpos), atol=1e-6)
    assert np.abs(qacc).max() < 1e-6
