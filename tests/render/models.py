"""A small hand to be rendered."""

from __future__ import annotations

from pathlib import Path

from rtee.hand.load import load_model
from rtee.hand.model import Hand

URDF = """<robot name="claw">
  <link name="palm"><collision><geometry><box size="0.08 0.03 0.02"/></geometry></collision></link>
  {links}
</robot>"""
JAW = """
  <link name="{name}"><collision><origin xyz="0 0 0.03"/>
    <geometry><box size="0.01 0.02 0.06"/></geometry></collision></link>
  <joint name="{name}_joint" type="revolute"><parent link="palm"/><child link="{name}"/>
    <origin xyz="{x} 0 0.01"/><axis xyz="0 {axis} 0"/>
    <limit lower="0" upper="0.8" velocity="2" effort="5"/></joint>"""


def claw(folder: Path) -> Hand:
    """Write a hand of two jaws that close towards each other, and load it."""
    links = JAW.format(name="left", x=-0.035, axis=1) + JAW.format(name="right", x=0.035, axis=-1)
    (folder / "claw.urdf").write_text(URDF.format(links=links))
    return load_model(folder / "claw.urdf")
