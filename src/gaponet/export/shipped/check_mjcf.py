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
    models = [mujoco.MjModel.from_xml_path(file) for _ in check.motions]
    paths = [
        play(m, check.facts, x, check.facts["prefix"], form)
        for m, x in zip(models, check.motions, strict=True)
    ]
    check.report_motions(what, [path[1:] for path in paths], form)
