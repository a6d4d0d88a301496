"""Play the motions of check.npz with the MJCF in plain MuJoCo, and print the error beside gaponet's: python check.py"""

from pathlib import Path

import mujoco
import numpy as np

from gaponet.export.shipped.mujoco_servos import Check, play

HERE = Path(__file__).parent
check = Check(HERE)
columns = [check.names.index(name) for name in check.facts["corrected"]]
for form, what in (("plain", "the MJCF alone"), ("joints", "the MJCF with servo_law.py")):
    errors = []
    for motion in check.motions:
        model = mujoco.MjModel.from_xml_path(str(HERE / check.facts["file"]))
        path = play(model, check.facts, motion, check.facts["prefix"], form)
        errors.append(np.abs(path - motion["qpos"])[1:, columns].mean())
    print(f"{what}: {1e3 * np.mean(errors):.2f} mrad; in gaponet {check.facts['error_mrad'][form]:.2f}")
