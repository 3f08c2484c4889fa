"""Meshes of very many triangles are coarsened: fewer, closed, with the same hull."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import trimesh

pytest.importorskip("coal")
pytest.importorskip("mujoco")

import mujoco

from rtee.drivers.mujoco import objects as bodies
from rtee.hand import coarse, geometry
from rtee.hand.geometry import HandGeometry
from rtee.hand.load import load_model
from rtee.objects.shape import ObjectShape
from rtee.planning import objects
from rtee.planning.objects import read_object

URDF = """<robot name="fine"><link name="base"><collision><geometry><mesh filename="{}"/></geometry>
</collision></link><link name="tip"><collision><geometry><sphere radius="0.01"/></geometry>
</collision></link><joint name="j" type="revolute"><parent link="base"/><child link="tip"/>
<axis xyz="0 1 0"/><limit lower="0" upper="1" effort="1" velocity="1"/></joint></robot>"""


@pytest.mark.parametrize("form", ["stl", "obj"])
@pytest.mark.parametrize("round_", [False, True])
def test_a_fine_mesh_is_coarsened(
    form: str, round_: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(coarse, "MOST", 2000)
    monkeypatch.setattr(geometry, "MOST", 2000)
    mesh = trimesh.creation.icosphere(subdivisions=4, radius=0.02)
    if not round_:  # few corners are on the hull of a rough one
        size = np.random.default_rng(0).uniform(0.9, 1.0, (len(mesh.vertices), 1))
        mesh.vertices = mesh.vertices * size
    mesh.export(tmp_path / f"fine.{form}")
    (tmp_path / "fine.urdf").write_text(URDF.format(f"fine.{form}"))
    read = HandGeometry(load_model(tmp_path / "fine.urdf"))
    shape = read.shapes[0]
    vertices, faces = shape.triangles
    found = trimesh.Trimesh(vertices, faces)
    assert 1000 < len(faces) <= 2000
    # Where sheets meet, an edge may have more than two faces; a hole would leave one with one.
    edges = np.sort(faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)
    assert (np.unique(edges, axis=0, return_counts=True)[1] % 2 == 0).all()
    assert len(read.notes) == 1
    assert "has 5120 triangles; it is coarsened to " in read.notes[0]
    hull = mesh.convex_hull
    assert shape.convex.computeVolume() == pytest.approx(hull.volume, rel=1e-2 if round_ else 1e-5)
    assert found.volume == pytest.approx(mesh.volume, rel=5e-2)


def test_an_object_of_very_many_triangles_is_read_by_its_hull(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:

    mesh = trimesh.creation.box((0.04, 0.04, 0.1)).subdivide().subdivide()
    mesh.export(tmp_path / "fine.stl")
    obj = read_object(str(tmp_path / "fine.stl"), scale=0.5)
    monkeypatch.setattr(objects, "_MOST_TRIANGLES", 100)
    monkeypatch.setattr(bodies, "_MOST", 100)
    fine = read_object(str(tmp_path / "fine.stl"), scale=0.5)
    assert fine.notes == obj.notes == ()
    assert fine.extents == pytest.approx(obj.extents) == (0.02, 0.02, 0.05)
    spec = mujoco.MjSpec()
    shape = ObjectShape("mesh", path=tmp_path / "fine.stl")
    bodies.add_object(spec, shape, mass=0.1, pose=np.eye(4))
    model = spec.compile()
    assert np.ptp(model.mesh_vert, axis=0).max() == pytest.approx(0.1, rel=0.05)
    assert model.body("object").mass[0] == pytest.approx(0.1)
