"""Play the motions of check.npz in plain MuJoCo, and print the error beside gaponet's.

python check.py
"""

from pathlib import Path

import mujoco

from gaponet.export.shipped.mujoco_servos import Check, play

HERE = Path(__file__).parent
check = Check(HERE)
file = str(HERE / check.facts["file"])
for form, what in (("plain", "the MJCF alone"), ("joints", "the MJCF with mujoco_servos.py")):
    paths = []
    for motion in check.motions:
        model = mujoco.MjModel.from_xml_path(file)
        path = play(model, check.facts, motion, check.facts["prefix"], form)
        paths.append(path[1:])
    check.report_motions(what, paths, form)
