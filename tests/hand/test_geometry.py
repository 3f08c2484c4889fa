from __future__ import annotations

import math
import struct
from pathlib import Path

import coal
import numpy as np
import pytest
from extract.models import Model, box, mesh, sphere

from rtee.errors import ModelError
from rtee.hand.geometry import HandGeometry, hull_of
from rtee.hand.model import Hand
from rtee.hand.tessellation import binary_stl


def write_stl(path: Path, triangles: np.ndarray) -> Path:
    records = [struct.pack("<12fH", 0, 0, 1, *triangle.ravel(), 0) for triangle in triangles]
    path.write_bytes(b"\0" * 80 + struct.pack("<I", len(records)) + b"".join(records))
    return path


def hand_with(folder: Path, *shapes: str) -> Hand:
    model = Model().link("part", *shapes).joint("turn", "base", "part")
    return model.finger("finger", "part").load(folder)


def volume(vertices: np.ndarray, faces: np.ndarray) -> float:
    a, b, c = np.moveaxis(vertices[faces], 1, 0)
    return float(np.einsum("ij,ij->i", a, np.cross(b, c)).sum() / 6)


def test_triangles_close_around_the_shapes_in_the_links_frame(tmp_path: Path) -> None:
    hand = hand_with(tmp_path, box((0.1, 0.2, 0.3), (1, 0, 0)), sphere(0.1, (-1, 0, 0)))
    vertices, faces = HandGeometry(hand).triangles("part")
    ball = 4 / 3 * np.pi * 0.1**3
    assert volume(vertices, faces) == pytest.approx(0.006 + ball, rel=0.02)
    assert vertices[:, 0].max() == pytest.approx(1.05)
    assert vertices[:, 0].min() == pytest.approx(-1.1)


def test_a_cylinder_stands_along_z(tmp_path: Path) -> None:
    shape = '<geometry><cylinder radius="0.1" length="0.4"/></geometry>'
    vertices, faces = HandGeometry(hand_with(tmp_path, shape)).triangles("part")
    assert volume(vertices, faces) == pytest.approx(np.pi * 0.1**2 * 0.4, rel=0.02)
    assert np.ptp(vertices[:, 2]) == pytest.approx(0.4)


def test_a_link_without_geometry_has_no_triangles(tmp_path: Path) -> None:
    vertices, faces = HandGeometry(hand_with(tmp_path, sphere(0.1))).triangles("base")
    assert vertices.shape == (0, 3)
    assert faces.shape == (0, 3)


def test_a_flat_mesh_gets_a_convex_part(tmp_path: Path) -> None:
    square = np.array([[[0, 0, 0], [1, 0, 0], [1, 1, 0]], [[0, 0, 0], [1, 1, 0], [0, 1, 0]]])
    path = write_stl(tmp_path / "flat.stl", square * 0.1)
    shape = HandGeometry(hand_with(tmp_path, mesh(path))).shapes[0]
    extent = np.ptp(np.array(shape.convex.points()), axis=0)
    np.testing.assert_allclose(extent, [0.1, 0.1, 0.0], atol=3e-5)


@pytest.mark.samples("0.0-256", "0.05-300")
@pytest.mark.parametrize("corners", [256, 300, 2000])
@pytest.mark.parametrize("tip", [0.0, 0.05])
def test_a_round_body_of_many_corners_gets_a_hull(corners: int, tip: float, tmp_path: Path) -> None:
    # Coal counts no more than 255 neighbours: of a corner of a disc's face, or of a cone's tip.
    turns = 2.0 * math.pi * np.arange(corners) / corners
    ring = np.column_stack([0.03 * np.cos(turns), 0.03 * np.sin(turns), np.zeros(corners)])
    far = np.array([[0.0, 0.0, tip]]) if tip else ring + np.array([0.0, 0.0, 0.02])
    points = np.vstack([ring, far])
    vector = coal.StdVec_Vec3s()
    vector.extend(points)
    with pytest.raises(RuntimeError, match="Too many neighbors"):
        coal.Convex.convexHull(vector, True, "Qt")
    hull = hull_of(points)
    kept, normals = np.array(hull.points()), np.array(hull.normals())
    beyond = (points @ normals.T).max(axis=0) - (kept @ normals.T).max(axis=0)
    assert beyond.max() < 2e-5
    # The same from a file, twice in one link.
    across = [(0, k, k + 1) for k in range(1, corners - 1)]
    sides = [(k, (k + 1) % corners, corners + (0 if tip else k)) for k in range(corners)]
    path = write_stl(tmp_path / "round.stl", points[[*across, *sides]])
    for shape in HandGeometry(hand_with(tmp_path, mesh(path), mesh(path))).shapes:
        beyond = (points @ normals.T).max(axis=0) - (
            np.array(shape.convex.points()) @ normals.T
        ).max(axis=0)
        assert np.abs(beyond).max() < 2e-5


def test_a_mesh_is_scaled_and_mirrored(tmp_path: Path) -> None:
    corner = np.array([[[0, 0, 0], [1, 0, 0], [0, 1, 0]], [[0, 0, 0], [0, 1, 0], [0, 0, 1]]])
    path = write_stl(tmp_path / "corner.stl", corner)
    shape = f'<geometry><mesh filename="{path}" scale="-0.1 0.2 0.3"/></geometry>'
    vertices, _ = HandGeometry(hand_with(tmp_path, shape)).triangles("part")
    np.testing.assert_allclose(vertices.min(axis=0), [-0.1, 0, 0], atol=1e-7)
    np.testing.assert_allclose(vertices.max(axis=0), [0, 0.2, 0.3], atol=1e-7)


def test_a_mesh_with_a_vertex_that_is_not_finite_is_refused(tmp_path: Path) -> None:
    triangle = np.array([[[0, 0, 0], [1, 0, 0], [0, 1, np.nan]], [[0, 0, 0], [0, 1, 0], [0, 0, 1]]])
    path = write_stl(tmp_path / "broken.stl", triangle)
    with pytest.raises(ModelError, match=r"broken\.stl.*not finite"):
        HandGeometry(hand_with(tmp_path, mesh(path)))


def test_a_mesh_that_cannot_be_read_is_refused_with_its_line(tmp_path: Path) -> None:
    path = tmp_path / "broken.stl"
    path.write_text("solid part\n facet normal 0 0 1\n outer loop\n vertex 0 0 x\n")
    with pytest.raises(ModelError, match=r"broken\.stl' cannot be read") as refusal:
        HandGeometry(hand_with(tmp_path, mesh(path)))
    assert refusal.value.line == 1


def test_every_shape_of_a_real_hand_lies_in_its_convex_part(real_hand: Hand) -> None:
    at = coal.Transform3s.Identity()
    for shape in HandGeometry(real_hand).shapes:
        vertices, _ = shape.triangles
        low, high = shape.box
        assert (vertices >= low - 1e-9).all()
        assert (vertices <= high + 1e-9).all()
        for vertex in vertices[:: max(1, len(vertices) // 20)]:
            point = coal.Transform3s(np.eye(3), vertex)
            result = coal.DistanceResult()
            request = coal.DistanceRequest()
            coal.distance(shape.convex, at, coal.Sphere(1e-6), point, request, result)
            assert result.min_distance < 1e-6


def test_a_mesh_that_is_not_in_metres_at_all_is_refused(tmp_path: Path) -> None:
    far = np.array([[[0, 0, 0], [2000, 0, 0], [0, 1, 1]]])
    path = write_stl(tmp_path / "far.stl", far)
    with pytest.raises(ModelError, match=r"far\.stl' is larger than 1 km"):
        HandGeometry(hand_with(tmp_path, mesh(path)))


TEXT_STL = """solid part
facet normal 0 0 1
outer loop
vertex 0 0 0
vertex 1 0 0
vertex 0 {} 0
endloop
endfacet
endsolid
"""

UNREADABLE = {
    "nan.stl": TEXT_STL.format("nan").encode(),
    "far.stl": TEXT_STL.format("1e38").encode(),
    "cut.stl": TEXT_STL[:60].encode(),
    "binary.stl": binary_stl(np.full((1, 3, 3), np.nan)),
    "infinite.stl": binary_stl(np.array([[[0, 0, 0], [1, 0, 0], [0, np.inf, 0]]])),
    "words.obj": b"hello\nfoo bar\n",
    "lost.obj": b"mtllib none.mtl\nusemtl x\nv 0 0 0\nv 1 0 0\nf 1 2 9\n",
    "cut.dae": b"<COLLADA><asset>",
    "cut.ply": b"ply\nformat ascii 1.0\nelement vertex 3\nproperty float x\nend_header\n1\n",
    "cut.gltf": b'{"asset":1',
    "cut.glb": b"glTF\x02\0\0\0aaaaa",
    "cut.off": b"OFF\n3 1 0\n0 0\n",
    "cut.3ds": b"MM\x01\0\0\0",
    "cut.fbx": b"Kaydara FBX Binary  \0\x1a\0aaaaaaaa",
}


@pytest.mark.parametrize("name", UNREADABLE)
def test_libraries_print_nothing_about_unreadable_meshes(
    tmp_path: Path, name: str, capfd: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / name
    path.write_bytes(UNREADABLE[name])
    with pytest.raises(
        ModelError, match=rf"{name}' (cannot be read: \S|has |is larger)"
    ) as refusal:
        HandGeometry(hand_with(tmp_path, mesh(path)))
    assert "\n" not in str(refusal.value)
    # Eigen and Assimp would write to the descriptors themselves.
    assert capfd.readouterr() == ("", "")


def test_a_text_stl_is_read_like_a_binary_one(tmp_path: Path) -> None:
    path = tmp_path / "text.stl"
    path.write_text(TEXT_STL.format("0.5"))
    vertices, faces = HandGeometry(hand_with(tmp_path, mesh(path))).triangles("part")
    assert len(faces) == 1
    np.testing.assert_allclose(vertices.max(axis=0), [1, 0.5, 0], atol=1e-7)
