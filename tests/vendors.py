"""Models as vendors write them, for tests: a floating torso with an arm and a gripper, and an arm
as URDF.
"""

from __future__ import annotations

from pathlib import Path

MJCF = """<mujoco model="vendor">
  <compiler angle="degree" meshdir="assets" autolimits="true" eulerseq="zyx"/>
  <option timestep="0.004"/>
  <default>
    <joint damping="0.4" armature="0.03" frictionloss="0.1"/>
    <default class="look">
      <geom type="mesh" mesh="link" contype="0" conaffinity="0" mass="0"/>
    </default>
    <default class="servo"><position kp="60" dampratio="1" forcerange="-9 9"/></default>
  </default>
  <asset><mesh name="link" file="link.obj"/></asset>
  <worldbody>
    <geom type="plane" size="1 1 0.1"/>
    <body name="torso" pos="0 0 1" euler="20 10 5">
      <freejoint name="base"/>
      <geom type="box" size="0.1 0.1 0.2" mass="8"/>
      <body name="upper" pos="0 0.2 0.1" euler="0 0 30">
        <joint name="shoulder" axis="0 1 0.2" range="-100 100"/>
        <geom class="look"/>
        <geom type="capsule" fromto="0 0 0 0.25 0 0" size="0.03" mass="1.2"/>
        <body name="fore" pos="0.25 0 0">
          <joint name="elbow" axis="0 1 0" range="10 140" actuatorfrcrange="-6 7"/>
          <geom type="capsule" fromto="0 0 0 0.2 0 0" size="0.03" mass="0.8"/>
          <body name="wrist" pos="0.2 0 0">
            <joint name="roll" axis="1 0 0" range="-170 170"/>
            <geom type="box" size="0.02 0.05 0.02" pos="0.02 0.01 0" mass="0.3"/>
            <site name="tcp" pos="0.12 0 0.01"/>
            <body name="left_finger" pos="0.06 0.01 0" euler="40 0 0">
              <joint name="left_slide" type="slide" axis="0 1 0" range="0 0.04"/>
              <geom type="box" size="0.03 0.005 0.01" mass="0.05"/>
            </body>
            <body name="right_finger" pos="0.06 -0.01 0">
              <joint name="right_slide" type="slide" axis="0 -1 0" range="0 0.04"/>
              <geom type="box" size="0.03 0.005 0.01" mass="0.05"/>
            </body>
          </body>
        </body>
      </body>
      <body name="leg" pos="0 0 -0.2" euler="0 15 0">
        <joint name="hip" axis="0 1 0" pos="0.01 0 0.02" range="-90 90"/>
        <geom type="capsule" fromto="0 0 0 0 0 -0.4" size="0.04" mass="2"/>
      </body>
    </body>
  </worldbody>
  <tendon>
    <fixed name="grip">
      <joint joint="left_slide" coef="0.5"/><joint joint="right_slide" coef="0.5"/>
    </fixed>
  </tendon>
  <equality><joint joint1="left_slide" joint2="right_slide"/></equality>
  <actuator>
    <position class="servo" name="shoulder_servo" joint="shoulder"/>
    <general name="elbow_servo" joint="elbow" gear="2" gainprm="10"
             biastype="affine" biasprm="0 -10 -0.5" forcerange="-4 4"/>
    <motor name="roll_motor" joint="roll" ctrlrange="-3 3" gear="0.5"/>
    <motor name="hip_motor" joint="hip" ctrlrange="-80 80"/>
    <position name="gripper" tendon="grip" kp="100"/>
  </actuator>
  <sensor><jointpos joint="left_slide"/><actuatorfrc actuator="gripper"/></sensor>
  <keyframe>
    <key name="home" qpos="0 0 1 1 0 0 0  0.3 1.2 0.5 0.03 0.03 -0.4" ctrl="0 0 0 0 0"/>
    <key name="low" qpos="0 0 1 1 0 0 0  0 0.5 0 0 0 0" ctrl="0 0 0 0 0"/>
  </keyframe>
</mujoco>
"""
BOX = "".join(
    f"v {x} {y} {z}\n" for x in (0.0, 0.25) for y in (-0.03, 0.03) for z in (-0.03, 0.03)
) + "".join(
    f"f {f}\n"
    for f in (
        "1 2 4",
        "1 4 3",
        "5 8 6",
        "5 7 8",
        "1 6 2",
        "1 5 6",
        "3 4 8",
        "3 8 7",
        "1 3 7",
        "1 7 5",
        "2 6 8",
        "2 8 4",
    )
)
URDF = """<robot name="bar">
  <link name="base"/>
  <link name="upper">
    <inertial><origin xyz="0.1 0 0"/><mass value="1.5"/>
      <inertia ixx="0.004" ixy="0" ixz="0" iyy="0.012" iyz="0" izz="0.012"/></inertial>
    <visual><geometry>
      <mesh filename="package://bar_description/meshes/link.obj"/></geometry></visual>
    <collision><geometry>
      <mesh filename="package://bar_description/meshes/link.dae"/></geometry></collision>
  </link>
  <link name="fore">
    <inertial><origin xyz="0.1 0 0"/><mass value="0.7"/>
      <inertia ixx="0.002" ixy="0" ixz="0" iyy="0.006" iyz="0" izz="0.006"/></inertial>
  </link>
  <link name="tool0"/>
  <joint name="lift" type="revolute">
    <parent link="base"/><child link="upper"/><origin xyz="0 0 0.3" rpy="0 0.4 0"/>
    <axis xyz="0 1 0"/><limit lower="-2" upper="2" effort="30" velocity="2"/>
    <dynamics damping="0.3" friction="0.2"/></joint>
  <joint name="bend" type="continuous">
    <parent link="upper"/><child link="fore"/><origin xyz="0.25 0 0"/>
    <axis xyz="0 1 0"/><limit effort="12" velocity="2"/></joint>
  <joint name="flange" type="fixed">
    <parent link="fore"/><child link="tool0"/><origin xyz="0.2 0 0"/></joint>
  <transmission name="t"><type>simple</type></transmission>
</robot>
"""


def write_mjcf(folder: Path, text: str = MJCF, mesh: bool = True) -> Path:
    """The floating robot as a file beside its mesh."""
    (folder / "assets").mkdir(parents=True, exist_ok=True)
    if mesh:
        (folder / "assets" / "link.obj").write_text(BOX)
    (folder / "vendor.xml").write_text(text)
    return folder / "vendor.xml"


def write_urdf(folder: Path, text: str = URDF) -> Path:
    """The arm in a ROS package."""
    for inner in ("urdf", "meshes"):
        (folder / "bar_description" / inner).mkdir(parents=True)
    (folder / "bar_description" / "meshes" / "link.obj").write_text(BOX)
    file = folder / "bar_description" / "urdf" / "bar.urdf"
    file.write_text(text)
    return file
