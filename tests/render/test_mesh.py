from __future__ import annotations

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
