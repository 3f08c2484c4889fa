"""Which links are near each other at all, by spheres around them."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from rtee.extract.pairs import LinkPair
from rtee.extract.scene import Scene
from rtee.hand.linalg import norms, rotated
from rtee.types import FloatArray

_sum = np.add.reduce


class Spheres:
    """Lower bounds on the distances of pairs of links, all at once.

    Every link lies in a sphere that moves with it.
    """

    def __init__(self, scene: Scene, pairs: Sequence[LinkPair]) -> None:
        """Put spheres around the links of some pairs."""
        self._scene = scene
        links = list(dict.fromkeys(shapes for pair in pairs for shapes in pair.shapes))
        spheres = [_sphere(scene, shapes) for shapes in links]
        self._bodies = [scene.shapes[shapes[0]].body for shapes in links]
        self._centres = np.array([centre for centre, _ in spheres]).reshape(-1, 3)
        radii = np.array([radius for _, radius in spheres])
        self._first = np.array([links.index(pair.shapes[0]) for pair in pairs], dtype=np.intp)
        self._second = np.array([links.index(pair.shapes[1]) for pair in pairs], dtype=np.intp)
        self._radii = radii[self._first] + radii[self._second] if pairs else np.zeros(0)

    def gaps(self) -> FloatArray:
        """Return the least distance of every pair at the posture of the scene ``(p,)`` [m]."""
        rotations, translations = self._scene.bodies()
        there = _sum(rotations[self._bodies] * self._centres[:, None, :], axis=2)
        there += translations[self._bodies]
        between = there[self._second] - there[self._first]
        result: FloatArray = norms(between) - self._radii
        return result


def _sphere(scene: Scene, shapes: tuple[int, ...]) -> tuple[FloatArray, float]:
    """Return a sphere around shapes of one body, in the body's frame: centre and radius [m]."""
    corners = []
    for i in shapes:
        shape = scene.shapes[i]
        corners.append(
            rotated(shape.points, shape.placement.rotation) + shape.placement.translation
        )
    points = np.concatenate(corners)
    centre: FloatArray = (points.min(axis=0) + points.max(axis=0)) / 2.0
    return centre, float(norms(points - centre).max())
