"""Meshes of several parts."""

from __future__ import annotations

from pathlib import Path

import coal
import numpy as np
import pytest

from rtee.hand.geometry import repaired, split_parts

COLLADA = """<?xml version="1.0" encoding="utf-8"?>
<COLLADA xmlns="http://www.collada.org/2005/11/COLLADASchema" version="1.4.1">
  <asset><unit name="meter" meter="1"/><up_axis>Z_UP</up_axis></asset>
  <library_geometries><geometry id="g"><mesh>
    <source id="p"><float_array id="a" count="24">{corners}</float_array>
      <technique_common><accessor source="#a" count="8" stride="3">
        <param name="X" type="float"/><param name="Y" type="float"/><param name="Z" type="float"/>
      </accessor></technique_common></source>
    <vertices id="v"><input semantic="POSITION" source="#p"/></vertices>
    {parts}
  </mesh></geometry></library_geometries>
  <library_visual_scenes><visual_scene id="s"><node><instance_geometry url="#g"/></node>
  </visual_scene></library_visual_scenes>
  <scene><instance_visual_scene url="#s"/></scene>
</COLLADA>
"""
TETRAHEDRON = ((0, 1, 2), (0, 1, 3), (0, 2, 3), (1, 2, 3))


def two_tetrahedra(path: Path, *, materials: int) -> Path:
    """Write two tetrahedra 1 m apart, as one part or as two of different materials."""
    one = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]], dtype=float) * 0.1
    corners = np.concatenate([one, one + np.array([1.0, 0.0, 0.0])])
    sets = [TETRAHEDRON, [tuple(i + 4 for i in face) for face in TETRAHEDRON]]
    if materials == 1:
        sets = [[*sets[0], *sets[1]]]
    parts = "".join(
        f'<triangles count="{len(faces)}" material="m{k}">'
        '<input semantic="VERTEX" source="#v" offset="0"/>'
        f"<p>{' '.join(str(i) for face in faces for i in face)}</p></triangles>"
        for k, faces in enumerate(sets)
    )
    text = COLLADA.format(corners=" ".join(f"{x:g}" for x in corners.ravel()), parts=parts)
    path.write_text(text, encoding="utf-8")
    return path


def load(path: Path) -> coal.BVHModelBase:
    loader = coal.MeshLoader(coal.NODE_TYPE.BV_kIOS)
    return repaired(loader.load(str(path), np.ones(3)), loader)


def distance(mesh: coal.BVHModelBase, x: float) -> float:
    ball, result = coal.Sphere(0.01), coal.DistanceResult()
    there = coal.Transform3s(np.eye(3), np.array([x, 0.02, 0.02]))
    return float(
        coal.distance(
            mesh, coal.Transform3s.Identity(), ball, there, coal.DistanceRequest(), result
        )
    )


@pytest.mark.parametrize("materials", [1, 2])
def test_every_part_is_where_it_belongs(materials: int, tmp_path: Path) -> None:
    mesh = load(two_tetrahedra(tmp_path / "two.dae", materials=materials))
    assert mesh.num_tris == 8
    assert distance(mesh, -0.11) == pytest.approx(0.1, abs=1e-4)
    assert distance(mesh, 0.89) == pytest.approx(0.1, abs=1e-4)
    assert distance(mesh, 0.5) > 0.3  # nothing joins the parts


@pytest.mark.parametrize("axis", ["X_UP", "Y_UP", "Z_UP"])
@pytest.mark.parametrize("metre", ["1", "0.001"])
def test_coordinates_of_a_collada_file_count_as_they_are(
    axis: str, metre: str, tmp_path: Path
) -> None:
    """Neither the file's axis that points up nor its unit changes them: the URDF places a mesh."""
    path = two_tetrahedra(tmp_path / "two.dae", materials=1)
    text = path.read_text().replace("Z_UP", axis).replace('meter="1"', f'meter="{metre}"')
    path.write_text(text)
    corners = np.array(load(path).vertices())
    assert corners.min(axis=0).tolist() == [0.0, 0.0, 0.0]
    assert corners.max(axis=0) == pytest.approx([1.1, 0.1, 0.1])


def test_triangles_are_numbered_through() -> None:
    faces = np.array([*TETRAHEDRON, *TETRAHEDRON, *TETRAHEDRON])
    apart = split_parts(faces, 12)
    assert apart is not None
    assert apart.tolist() == np.concatenate([faces[:4] + 4 * k for k in range(3)]).tolist()


def test_what_does_not_add_up_is_left_alone() -> None:
    assert split_parts(np.array([*TETRAHEDRON, *TETRAHEDRON]), 40) is None
    assert split_parts(np.array([[1, 2, 3], [0, 2, 3]]), 8) is None


def test_a_mesh_of_real_parts_is_whole(shared: Path) -> None:
    mesh = load(shared / "hands" / "schunk" / "meshes" / "f13.dae")
    used = {mesh.tri_indices(i)[k] for i in range(mesh.num_tris) for k in range(3)}
    assert len(used) == mesh.num_vertices
