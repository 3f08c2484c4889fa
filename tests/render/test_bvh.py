from __future__ import annotations

import numpy as np

from rtee.render.bvh import NumpyScene


def test_rays_hit_the_nearest_of_all_triangles() -> None:
    rng = np.random.default_rng(7)
    corners = rng.normal(size=(300, 1, 3)) + 0.2 * rng.normal(size=(300, 3, 3))
    directions = rng.normal(size=(200, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    directions[:3] = np.eye(3)  # along the axes, where a box has no slope
    origins = 0.3 * rng.normal(size=(200, 3))
    # Every ray against every triangle, as a system of linear equations.
    a, b, c = np.moveaxis(corners, 1, 0)
    sides = np.stack([b - a, c - a], axis=2)[None].repeat(200, axis=0)
    system = np.concatenate([sides, -directions[:, None, :, None].repeat(300, axis=1)], axis=3)
    u, v, depth = np.moveaxis(np.linalg.solve(system, (origins[:, None] - a)[..., None]), 2, 0)[
        ..., 0
    ]
    depth[(u < 0) | (v < 0) | (u + v > 1) | (depth < 0)] = np.inf
    # A triangle is a little larger than it is: leave out rays that pass this near to a side.
    near = ((np.abs(np.stack([u, v, 1 - u - v])) < 1e-3).any(axis=0)).any(axis=1)
    depth, origins, directions = depth[~near], origins[~near], directions[~near]
    scene = NumpyScene(corners)
    found = scene.closest(origins, directions)
    hit = np.isfinite(depth).any(axis=1)
    assert 20 < hit.sum() < len(hit)
    np.testing.assert_array_equal(found.face, np.where(hit, depth.argmin(axis=1), -1))
    np.testing.assert_allclose(found.depth[hit], depth.min(axis=1)[hit], rtol=1e-4)
    np.testing.assert_array_equal(scene.occluded(origins, directions, 0.8), depth.min(axis=1) < 0.8)
