from __future__ import annotations

import tracemalloc

import numpy as np

from rtee.hand.tessellation import box, sphere
from rtee.render.mesh import smooth_normals


def test_normals_are_smooth_on_a_sphere_and_sharp_on_a_box() -> None:
    vertices, faces = sphere(2.0)
    radial = vertices[faces] / 2.0
    cosine = np.einsum("fij,fij->fi", smooth_normals(vertices, faces), radial)
    assert cosine.min() > 0.99
    vertices, faces = box((1.0, 2.0, 3.0))
    # As triangles without shared vertices, as in an STL file.
    loose = vertices[faces].reshape(-1, 3)
    normals = smooth_normals(loose, np.arange(len(loose)).reshape(-1, 3))
    np.testing.assert_allclose(np.abs(normals).max(axis=2), 1.0)
    assert smooth_normals(vertices, np.zeros((0, 3), dtype=np.int64)).shape == (0, 3, 3)


def test_a_disc_of_many_triangles_takes_little_memory() -> None:
    count = 1500
    turns = np.linspace(0.0, 2.0 * np.pi, count, endpoint=False)
    ring = np.stack([np.cos(turns), np.sin(turns), np.zeros(count)], axis=1)
    number = np.arange(count)
    faces = np.stack([np.zeros(count, np.int64), 1 + number, 1 + (number + 1) % count], axis=1)
    tracemalloc.start()
    try:
        normals = smooth_normals(np.vstack([np.zeros(3), ring]), faces)
        most = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    np.testing.assert_allclose(normals, np.broadcast_to((0.0, 0.0, 1.0), normals.shape), atol=1e-9)
    assert most < 20e6, "not the square of the number of triangles"
