"""Small models that tests change."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from rtee.hand.meshes import check_mesh
from rtee.hand.urdf import Urdf

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


FINGER_OF_FRANKA = """
  <link name="{name}">
    <collision>
      <origin xyz="0 0.0105 0.045"/><geometry><box size="0.02 0.021 0.018"/></geometry>
    </collision>
    <collision>
      <origin xyz="0 0.0068 0.022"/><geometry><box size="0.022 0.0136 0.028"/></geometry>
    </collision>
  </link>
"""

FRANKA = f"""<?xml version="1.0"?>
<robot name="franka_hand">
  <link name="panda_hand">
    <collision><origin xyz="0 0 0.02"/><geometry><box size="0.06 0.2 0.07"/></geometry></collision>
  </link>
  {FINGER_OF_FRANKA.format(name="panda_leftfinger")}
  {FINGER_OF_FRANKA.format(name="panda_rightfinger")}
  <joint name="panda_finger_joint1" type="prismatic">
    <parent link="panda_hand"/><child link="panda_leftfinger"/>
    <origin xyz="0 0 0.0584"/><axis xyz="0 1 0"/>
    <limit lower="0" upper="0.04" velocity="0.2" effort="20"/>
  </joint>
  <joint name="panda_finger_joint2" type="prismatic">
    <parent link="panda_hand"/><child link="panda_rightfinger"/>
    <origin xyz="0 0 0.0584" rpy="0 0 3.14159265359"/><axis xyz="0 1 0"/>
    <limit lower="0" upper="0.04" velocity="0.2" effort="20"/>
    <mimic joint="panda_finger_joint1"/>
  </joint>
</robot>
"""
"""A gripper whose zero is closed: its pads touch there."""


def anthropomorphic(*, coupled: bool = False) -> str:
    """Return a hand in the style of the Shadow Hand.

    Two joints of a wrist stand before the palm. Each finger swings sideways at its knuckle and
    bends about three parallel axes; the little one has a joint in the palm besides. The thumb turns
    at its base, and bends about two pairs of axes.

    Args:
        coupled: The last two joints of a finger share a motor.
    """
    links = [_solid("rh_forearm", (0.08, 0.06, 0.2), -0.1), '<link name="rh_wrist"/>']
    links.append(_solid("rh_palm", (0.084, 0.022, 0.09), 0.045))
    joints = [
        _bend("rh_WRJ2", "rh_forearm", "rh_wrist", (0, 0, 0), "0 1 0", (-0.52, 0.17)),
        _bend("rh_WRJ1", "rh_wrist", "rh_palm", (0, 0, 0.034), "1 0 0", (-0.7, 0.49)),
    ]
    for letter, x in (("F", 0.033), ("M", 0.011), ("R", -0.011), ("L", -0.033)):
        small, palm = f"rh_{letter.lower()}f", "rh_palm"
        if letter == "L":
            links.append('<link name="rh_lfmetacarpal"/>')
            joints.append(_bend("rh_LFJ5", palm, "rh_lfmetacarpal", (0, 0, 0), "1 0 0", (0, 0.79)))
            palm = "rh_lfmetacarpal"
        names = [f"{small}{part}" for part in ("knuckle", "proximal", "middle", "distal")]
        links += [f'<link name="{names[0]}"/>', _solid(names[1], (0.016, 0.016, 0.044), 0.022)]
        links += [_solid(name, (0.016, 0.016, 0.024), 0.012) for name in names[2:]]
        big = f"rh_{letter}F"
        mimic = f'<mimic joint="{big}J2"/>' if coupled else ""
        joints += [
            _bend(f"{big}J4", palm, names[0], (x, 0, 0.095), "0 -1 0", (-0.35, 0.35)),
            _bend(f"{big}J3", names[0], names[1], (0, 0, 0), "1 0 0", (-0.26, 1.57)),
            _bend(f"{big}J2", names[1], names[2], (0, 0, 0.045), "1 0 0", (0, 1.57)),
            _bend(f"{big}J1", names[2], names[3], (0, 0, 0.025), "1 0 0", (0, 1.57), mimic),
        ]
    thumb = ["rh_thbase", "rh_thproximal", "rh_thhub", "rh_thmiddle", "rh_thdistal"]
    links += [f'<link name="{thumb[0]}"/>', _solid(thumb[1], (0.018, 0.018, 0.036), 0.018)]
    links += [f'<link name="{thumb[2]}"/>', _solid(thumb[3], (0.018, 0.018, 0.03), 0.015)]
    links.append(_solid(thumb[4], (0.018, 0.018, 0.026), 0.013))
    joints += [
        _bend("rh_THJ5", "rh_palm", thumb[0], (0.045, -0.035, 0.029), "0 0 -1", (-1.05, 1.05)),
        _bend("rh_THJ4", thumb[0], thumb[1], (0, 0, 0), "1 0 0", (0, 1.22)),
        _bend("rh_THJ3", thumb[1], thumb[2], (0, 0, 0.038), "1 0 0", (-0.21, 0.21)),
        _bend("rh_THJ2", thumb[2], thumb[3], (0, 0, 0), "0 -1 0", (-0.7, 0.7)),
        _bend("rh_THJ1", thumb[3], thumb[4], (0, 0, 0.032), "0 -1 0", (-0.26, 1.57)),
    ]
    return f'<?xml version="1.0"?>\n<robot name="hand">{"".join(links + joints)}</robot>\n'


def _solid(name: str, size: tuple[float, float, float], z: float) -> str:
    shape = f'<geometry><box size="{size[0]} {size[1]} {size[2]}"/></geometry>'
    return f'<link name="{name}"><collision><origin xyz="0 0 {z}"/>{shape}</collision></link>\n'


def _bend(
    name: str,
    parent: str,
    child: str,
    xyz: tuple[float, float, float],
    axis: str,
    limits: tuple[float, float],
    mimic: str = "",
) -> str:
    return (
        f'<joint name="{name}" type="revolute"><parent link="{parent}"/><child link="{child}"/>'
        f'<origin xyz="{xyz[0]} {xyz[1]} {xyz[2]}"/><axis xyz="{axis}"/>'
        f'<limit lower="{limits[0]}" upper="{limits[1]}" velocity="2" effort="2"/>{mimic}</joint>\n'
    )


def check_meshes(urdf: Urdf, package_dirs: Sequence[Path | str] = ()) -> None:
    """Check every mesh that is collision geometry."""
    shapes = (shape for link in urdf.links.values() for shape in link.collisions)
    for shape in {shape.mesh: shape for shape in shapes if shape.kind == "mesh"}.values():
        check_mesh(shape, urdf, package_dirs)
