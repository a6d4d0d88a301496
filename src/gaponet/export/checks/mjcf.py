"""Plays the motions of check.npz on the MJCF in plain MuJoCo and prints the error beside gaponet's: python check.py"""

from pathlib import Path

import mujoco
import numpy as np

from gaponet.export.mujoco_servos import motions, play, read

HERE = Path(__file__).parent
facts = read(HERE / "facts.json")
columns = [list(facts["joints"]).index(name) for name in facts["corrected"]]
for form, what in (("plain", "the MJCF alone"), ("joints", "the MJCF with servo_law.py")):
    errors = []
    for motion in motions(HERE / "check.npz"):
        model = mujoco.MjModel.from_xml_path(str(HERE / facts["file"]))
        played = play(model, facts, motion, facts["prefix"], form)
        errors.append(np.abs(played - motion["qpos"])[1:, columns].mean())
    print(f"{what}: {1e3 * np.mean(errors):.2f} mrad; in gaponet {facts['left_mrad'][form]:.2f}")
