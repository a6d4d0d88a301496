"""A two-joint arm as robots come from vendors: includes, meshes that give inertia, frames,
degrees.
"""

from __future__ import annotations

from pathlib import Path

from arm import TOML

from gaponet.robot.spec import RobotSpec, load_robot

COMMON = """<mujocoinclude>
  <default>
    <joint damping="0.51234567891" armature="0.02" frictionloss="0.05"/>
    <default class="look">
      <geom contype="0" conaffinity="0" group="2" type="mesh" mesh="link" mass="0"/>
    </default>
  </default>
</mujocoinclude>
"""
XML = """<mujoco model="vendor">
  <compiler angle="degree" eulerseq="zyx" meshdir="meshes" autolimits="true"/>
  <include file="common.xml"/>
  <option integrator="implicitfast" gravity="0 0.1 -9.80665"><flag contact="CONTACT"/></option>
  <asset>
    <mesh name="link" file="link.obj" scale="1 1.1 1"/>
    <material name="grey" rgba="0.5 0.5 0.5 1"/>
  </asset>
  <worldbody>
    <light pos="0 0 1"/>
    <geom type="plane" size="1 1 0.1" pos="0 0 -0.05"/>
    <frame pos="0 0 0.21234567" euler="0 20 30">
      <body name="upper" euler="5 0 0">
        <joint name="shoulder" axis="0 1 0.1" range="-80 85" ref="3"/>
        <geom type="mesh" mesh="link" density="1500" contype="0" conaffinity="0"
              material="grey" euler="1 2 3"/>
        <body name="fore" pos="0.2 0 0">
          <joint name="elbow" axis="0 1 0" range="-80 80" stiffness="0.3" springref="4"/>
          <geom class="look"/>
          <geom type="capsule" fromto="0 0 0 0.2 0 0" size="0.02" mass="0.2"/>
          <body name="tool" pos="0.2 0 0" quat="1 0.1 0.2 0.3">
            <geom type="mesh" mesh="link" mass="0.05"/>
          </body>
        </body>
      </body>
    </frame>
  </worldbody>
  <contact><exclude body1="upper" body2="fore"/></contact>
  <sensor><jointpos joint="elbow"/></sensor>
</mujoco>
"""
CORNERS = [(x, y + 0.01 * z, z) for x in (0.0, 0.2) for y in (0.0, 0.05) for z in (0.0, 0.031)]
FACES = [
    (1, 2, 4), (1, 4, 3), (5, 8, 6), (5, 7, 8), (1, 6, 2), (1, 5, 6),
    (3, 4, 8), (3, 8, 7), (1, 3, 7), (1, 7, 5), (2, 6, 8), (2, 8, 4),
]  # fmt: skip


def write_files_arm(
    folder: Path, contacts: bool = False, scale: float = 1.0, **parts: str
) -> RobotSpec:
    """The arm in a folder of its own; parts: other text of toml, xml or common."""
    (folder / "meshes").mkdir(parents=True, exist_ok=True)
    xml = parts.get("xml", XML).replace("CONTACT", "enable" if contacts else "disable")
    (folder / "robot.xml").write_text(xml)
    (folder / "common.xml").write_text(parts.get("common", COMMON))
    toml = parts.get("toml", TOML)
    (folder / "robot.toml").write_text("contacts = true\n" + toml if contacts else toml)
    lines = [f"v {scale * x!r} {scale * y!r} {scale * z!r}" for x, y, z in CORNERS]
    lines += [f"f {a} {b} {c}" for a, b, c in FACES]
    (folder / "meshes" / "link.obj").write_text("\n".join(lines) + "\n")
    return load_robot(folder)
