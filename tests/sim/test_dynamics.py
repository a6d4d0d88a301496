"""Inverse dynamics: a motor that leads other joints carries them too."""

import mujoco
import numpy as np
import pytest
from arm import TOML, XML, write_arm

from gaponet.sim.dynamics import static_torque
from gaponet.sim.model import build_model

THIRD = """
        <body name="plate" pos="0.2 0 0">
          <joint name="wrist" axis="0 1 0" range="-3 3"/>
          <geom type="capsule" fromto="0 0 0 0.1 0 0" size="0.02" mass="0.4"
                contype="0" conaffinity="0"/>
        </body>
"""
ELBOW = '<joint joint1="elbow" joint2="shoulder" polycoef="0 -0.5 0 0 0"/>'
WRIST = '<joint joint1="wrist" joint2="elbow" polycoef="0 -1 0 0 0"/>'


def weight(model: mujoco.MjModel, qpos: np.ndarray) -> float:
    """Potential energy of all bodies, J."""
    data = mujoco.MjData(model)
    data.qpos[:] = qpos
    mujoco.mj_kinematics(model, data)
    mujoco.mj_comPos(model, data)
    return float(-model.body_mass @ data.xipos @ model.opt.gravity)


@pytest.mark.parametrize("couplings", [ELBOW + WRIST, WRIST + ELBOW], ids=["in order", "reversed"])
def test_a_motor_carries_the_joints_that_follow_it(tmp_path, couplings):
    xml = XML.replace("</body>\n    </body>", f"{THIRD}</body>\n    </body>")
    xml = xml.replace("</worldbody>", f"</worldbody><equality>{couplings}</equality>")
    toml = TOML + '[[joint]]\nname = "wrist"\nkp = 0.0\neffort_limit = 1.0\noperated = false\n'
    model = build_model(write_arm(tmp_path, toml, xml))
    qpos = np.array([0.4, -0.2, 0.2])
    motion = np.array([1.0, -0.5, 0.5])  # of all joints, with the shoulder's motor
    step = 1e-5
    slope = (weight(model, qpos + step * motion) - weight(model, qpos - step * motion)) / (2 * step)
    (torque,) = static_torque(model, qpos[None])
    np.testing.assert_allclose(torque, [slope, 0.0, 0.0], rtol=1e-6, atol=1e-9)
