"""Small models that tests change."""

from __future__ import annotations

GRIPPER = """<?xml version="1.0"?>
<robot name="gripper">
  <link name="palm">
    <collision><geometry><box size="0.1 0.1 0.02"/></geometry></collision>
  </link>
  <link name="left_jaw">
    <collision><origin xyz="0 0 0.03"/><geometry><box size="0.01 0.02 0.06"/></geometry></collision>
  </link>
  <link name="right_jaw">
    <collision><origin xyz="0 0 0.03"/><geometry><box size="0.01 0.02 0.06"/></geometry></collision>
  </link>
  <joint name="left" type="revolute">
    <parent link="palm"/><child link="left_jaw"/>
    <origin xyz="-0.04 0 0.01"/><axis xyz="0 1 0"/>
    <limit lower="0" upper="0.8" velocity="2" effort="5"/>
  </joint>
  <joint name="right" type="revolute">
    <parent link="palm"/><child link="right_jaw"/>
    <origin xyz="0.04 0 0.01"/><axis xyz="0 -1 0"/>
    <limit lower="0" upper="0.8" velocity="2" effort="5"/>
  </joint>
</robot>
"""

SRDF = """<?xml version="1.0"?>
<robot name="gripper">
  <group name="left_finger">
    <chain base_link="palm" tip_link="left_jaw"/>
  </group>
  <group name="right_finger">
    <chain base_link="palm" tip_link="right_jaw"/>
  </group>
  <group name="fingers">
    <group name="left_finger"/>
    <group name="right_finger"/>
  </group>
</robot>
"""

YAML = """name: gripper
title: A gripper
urdf: gripper.urdf
srdf: gripper.srdf
rest: {left: 0.1}
limits:
  defaults: {acceleration: 20.0, jerk: 400.0}
  right: {velocity: 1.0, effort: 2.0, upper: 0.7}
devices:
  both: {driver: kinematic, actuators: all, options: {speed: 1}}
"""


def line_of(text: str, part: str) -> int:
    """Return the line in which a part of a text begins."""
    assert text.count(part) == 1, f"{part!r} stands {text.count(part)} times"
    return text[: text.index(part)].count("\n") + 1
