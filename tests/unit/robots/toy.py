"""A small arm of capsules with a parallel gripper, which needs no file of the Menagerie."""

import mujoco

from egosim_jax.robots.arms import Arm, Gripper
from egosim_jax.robots.models import RobotModel, make_model

XML = """
<mujoco>
  <compiler angle="radian"/>
  <default>
    <joint range="-2.8 2.8"/>
    <geom type="capsule" size="0.02" rgba="0.8 0.2 0.2 1"/>
  </default>
  <worldbody>
    <body name="base">
      <geom type="cylinder" size="0.05 0.05" pos="0 0 0.05"/>
      <body pos="0 0 0.12">
        <joint name="yaw" axis="0 0 1"/>
        <geom fromto="0 0 0 0 0 0.05"/>
        <body pos="0 0 0.1">
          <joint name="shoulder" axis="0 1 0"/>
          <geom fromto="0 0 0.03 0 0 0.27"/>
          <body pos="0 0 0.3">
            <joint name="elbow" axis="0 1 0"/>
            <geom fromto="0 0 0.03 0 0 0.17"/>
            <body pos="0 0 0.2">
              <joint name="roll" axis="0 0 1"/>
              <geom type="sphere" size="0.02"/>
              <body pos="0 0 0.08">
                <joint name="wrist" axis="0 1 0"/>
                <geom type="sphere" size="0.02"/>
                <body name="palm" pos="0 0 0.05">
                  <joint name="turn" axis="0 0 1"/>
                  <geom type="box" size="0.02 0.05 0.015"/>
                  <body name="left" pos="0 0 0.05">
                    <joint name="drive" type="slide" axis="0 1 0" range="0 0.04"/>
                    <geom type="box" size="0.008 0.004 0.03" pos="0 0.004 0"/>
                  </body>
                  <body name="right" pos="0 0 0.05">
                    <joint name="follow" type="slide" axis="0 -1 0" range="0 0.04"/>
                    <geom type="box" size="0.008 0.004 0.03" pos="0 -0.004 0"/>
                  </body>
                </body>
              </body>
            </body>
          </body>
        </body>
      </body>
    </body>
  </worldbody>
  <equality><joint joint1="drive" joint2="follow"/></equality>
</mujoco>
"""
TIP = (0.0, 0.0, 0.025)
TOY = Arm(
    name="toy",
    title="Toy arm",
    suits="tests",
    model=("toy", "toy"),
    joints=("yaw", "shoulder", "elbow", "roll", "wrist", "turn"),
    home=(0.0, 0.3, 1.4, 0.0, 1.2, 0.0),
    speeds=(3.0,) * 6,
    reach_m=0.6,
    gripper=Gripper(
        body="palm",
        approach=(0.0, 0.0, 1.0),
        tips=(("right", TIP), ("left", TIP)),
        driver="drive",
        open=0.04,
        closed=0.0,
        speed_m_s=0.2,
    ),
)


def make_toy() -> RobotModel:
    return make_model(TOY, mujoco.MjSpec.from_string(XML))
