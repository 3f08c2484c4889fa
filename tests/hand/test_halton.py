from __future__ import annotations

import numpy as np

from rtee.hand.halton import halton


def test_halton_points_fill_the_cube_evenly() -> None:
    points = halton(8, 512)
    assert points.shape == (512, 8)
    assert len(np.unique(points, axis=0)) == 512
    for i in range(8):
        for j in range(i):
            counts, *_ = np.histogram2d(points[:, i], points[:, j], bins=4, range=[[0, 1]] * 2)
            assert counts.min() >= 16
            assert counts.max() <= 52


def test_no_two_of_many_coordinates_are_the_same() -> None:
    assert np.unique(halton(30, 62), axis=1).shape == (62, 30)
