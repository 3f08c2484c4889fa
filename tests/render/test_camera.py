from __future__ import annotations

from pathlib import Path

import numpy as np

from rtee.hand.geometry import HandGeometry
from rtee.render.camera import choose_view, fit_camera
from tests.render.models import claw


def test_the_camera_sees_all_points_and_no_more() -> None:
    points = np.random.default_rng(0).normal(size=(500, 3)) * [0.1, 0.02, 0.3] + [1.0, 2.0, 3.0]
    back = np.array([0.6, 0.64, 0.48])
    camera = fit_camera(points, back / np.linalg.norm(back), np.array([0.0, 0.0, 1.0]), (400, 300))
    spots = camera.project(points)
    assert (spots > 0).all()
    assert (spots < [400, 300]).all()
    margins = np.concatenate([spots.min(axis=0), [400, 300] - spots.max(axis=0)])
    assert margins.min() < 0.08 * 300
    rays = camera.rays(spots[:, 0], spots[:, 1])
    toward = points - camera.position
    toward /= np.linalg.norm(toward, axis=1, keepdims=True)
    np.testing.assert_allclose(rays, toward, atol=1e-12)


def test_fingers_that_close_towards_one_another_are_seen_from_the_side(tmp_path: Path) -> None:
    back, up = choose_view(HandGeometry(claw(tmp_path)))
    np.testing.assert_allclose(up, [0, 0, 1])
    assert abs(back[1]) > abs(back[0])
