"""What the GUI draws is what the extraction computes with, though trimesh reads it and not Coal."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest
import trimesh

from rtee.errors import MissingExtra, ModelError
from rtee.gui.scene import link_triangles
from rtee.hand.catalog import hand_names
from rtee.hand.geometry import HandGeometry
from rtee.hand.load import load_hand, load_model
from rtee.hand.model import Hand
from rtee.sample import FloatArray

URDF = """<robot name="claw">
  <link name="palm"><collision><geometry><box size="0.1 0.1 0.1"/></geometry></collision></link>
  <link name="jaw">
    <collision><origin xyz="0.1 0 0.02" rpy="0.3 0.5 0.7"/>
      <geometry><mesh filename="{mesh}" scale="0.01 0.02 -0.03"/></geometry></collision>
    <collision><geometry><sphere radius="0.01"/></geometry></collision>
  </link>
  <joint name="jaw_joint" type="revolute"><parent link="palm"/><child link="jaw"/>
    <axis xyz="0 1 0"/><limit lower="0" upper="1" velocity="1" effort="1"/></joint>
</robot>
"""


def claw(folder: Path, mesh: str) -> Hand:
    (folder / "claw.urdf").write_text(URDF.format(mesh=mesh))
    return load_model(folder / "claw.urdf")


def corners(triangles: tuple[FloatArray, np.ndarray]) -> FloatArray:
    """Return the corners of all triangles ``(f, 9)`` in an order that does not depend on theirs."""
    vertices, faces = triangles
    rows = np.round(vertices[faces].reshape(-1, 9), 6)
    return rows[np.lexsort(rows.T)]


def same(hand: Hand) -> None:
    drawn, geometry = link_triangles(hand), HandGeometry(hand)
    for link in hand.urdf.links:
        np.testing.assert_allclose(
            corners(drawn(link)), corners(geometry.triangles(link)), atol=2e-6, err_msg=link
        )


@pytest.mark.parametrize("name", hand_names())
def test_the_shapes_of_a_hand_are_those_of_the_extraction(name: str) -> None:
    same(load_hand(name))


@pytest.mark.parametrize("suffix", ["stl", "ply", "off", "obj", "glb", "dae"])
def test_every_format_that_trimesh_reads(suffix: str, tmp_path: Path) -> None:
    if suffix == "dae":
        pytest.importorskip("collada")
    body = trimesh.creation.box((1.0, 2.0, 3.0))
    body.apply_translation((0.3, 0.4, 0.5))
    tip = trimesh.creation.icosphere(subdivisions=1, radius=0.7)
    tip.apply_translation((-2.0, 0.1, 0.9))
    parts = trimesh.Scene([body, tip])
    if suffix in ("obj", "glb"):
        parts.export(tmp_path / f"jaw.{suffix}")
    else:
        parts.to_mesh().export(tmp_path / f"jaw.{suffix}")
    same(claw(tmp_path, f"jaw.{suffix}"))


def test_a_format_of_coal_alone_says_which_extra_it_needs(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "jaw.3ds").write_bytes(b"MM")
    hand = claw(tmp_path, "jaw.3ds")
    monkeypatch.delitem(sys.modules, "rtee.hand.geometry")
    monkeypatch.setitem(sys.modules, "coal", None)
    with pytest.raises(MissingExtra, match=r"in the format \.3ds needs the extra 'extract'"):
        link_triangles(hand)


@pytest.mark.parametrize("text", ["v 0 0 0\n", "v nan 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n"])
def test_a_mesh_without_triangles_or_numbers_is_refused(text: str, tmp_path: Path) -> None:
    (tmp_path / "jaw.obj").write_text(text)
    with pytest.raises(ModelError, match=r"claw\.urdf:5: mesh 'jaw\.obj'"):
        link_triangles(claw(tmp_path, "jaw.obj"))("jaw")
