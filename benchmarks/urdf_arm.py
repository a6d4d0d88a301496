"""A VIRTUAL arm from a URDF, whose servos are late and have a law: logs in csv, and the command that starts from them.

    python benchmarks/urdf_arm.py ARM.urdf LOGS

The servos are drawn by seed (benchmarks/strangers.py), friction larger at rest and growing with load; what is logged
comes from plain MuJoCo at 1 kHz. Nothing of gaponet is used.
"""

from __future__ import annotations

import xml.etree.ElementTree as ET
from dataclasses import replace
from pathlib import Path

import mujoco
import numpy as np
import strangers
import tyro

RATE, NOISE = 50.0, 1e-4  # Hz; rad


def arm(urdf: Path, seed: int) -> strangers.Stranger:
    """The arm without its meshes, with servos."""
    root = ET.parse(urdf).getroot()
    for link in root.iter("link"):
        for shape in link.findall("visual") + link.findall("collision"):
            link.remove(shape)
    spec = mujoco.MjSpec.from_string(ET.tostring(root, encoding="unicode"))
    spec.compiler.balanceinertia = True
    spec.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    rng = np.random.default_rng([seed, 0])
    made = strangers._dressed(seed, rng, spec, urdf.stem)
    law, n, none = made.law, len(made.joints), np.zeros(len(made.joints))
    law = replace(
        law, friction=law.kp * 5e-3 * rng.uniform(0.6, 1.6, n), stribeck=law.kp * 3e-3 * rng.uniform(0.6, 1.6, n),
        stribeck_speed=np.full(n, 0.08), load=rng.uniform(0.05, 0.15, n), delay=rng.uniform(0.012, 0.024, n),
        limit=np.maximum(law.limit, 0.6 * law.kp), backlash=none, dead_band=none, speed=none, filter=none,
    )  # fmt: skip
    wrong = {field: getattr(law, field) * rng.uniform(0.7, 1.4, n) for field in ("kp", "kd")}
    dirt = strangers.Dirt(NOISE, 0.0, 0.0, 0.0, True, False)
    return replace(made, law=law, said=made.said | wrong, laws=("stribeck", "load"), rate=RATE, dirt=dirt, payload=0.0)


def main(urdf: tyro.conf.Positional[Path], logs: tyro.conf.Positional[Path], motions: int = 12, seed: int = 0) -> None:
    """Write one csv for each motion of 14 s.

    Args:
        urdf: Of an arm; its meshes are not needed.
        logs: Folder to write to.
        motions: How many.
        seed: Of servos and motions.
    """
    robot = arm(urdf, seed)
    logs.mkdir(parents=True, exist_ok=True)
    for log in robot.recordings(motions, 14.0 * motions):
        columns = log.columns(robot.joints)
        np.savetxt(logs / f"{log.motion}.csv", np.column_stack([*columns.values()]), "%.6f", ",",
                   header=",".join(columns), comments="")  # fmt: skip
    told = {"kp": robot.said["kp"], "kd": robot.said["kd"], "effort-limit": robot.law.limit}
    words = (f"{j}={x:.4g}" for field in told for j, x in zip(robot.joints, told[field], strict=True))
    each = [" ".join(next(words) for _ in robot.joints) for _ in told]
    print(f"gaponet start {urdf} {logs} {' '.join(f'--{f} {w}' for f, w in zip(told, each, strict=True))} --to json")


if __name__ == "__main__":
    tyro.cli(main)
