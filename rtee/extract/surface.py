"""Test whether one shape lies inside another shape's surface."""

from __future__ import annotations

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from rtee.hand.geometry import Shape
from rtee.hand.linalg import matvec, norms
from rtee.sample import FloatArray

_sum = np.add.reduce


def encloses(outer: Shape, inner: Shape, inner_in_outer: pin.SE3) -> bool:
    """Return whether a mesh encloses a shape that does not intersect its surface.

    Testing one point of the inner shape suffices, since all of it is on one side of the surface.

    Args:
        outer: The enclosing shape; a primitive is solid, so it always collides with what it
            contains, and the result is ``False``.
        inner: The enclosed shape.
        inner_in_outer: Pose of the inner shape in the outer one's frame.
    """
    if not outer.is_mesh:
        return False
    start = inner.exact.vertices()[0] if inner.is_mesh else np.zeros(3)
    point = inner_in_outer.act(np.asarray(start))
    low, high = outer.box
    # The cheap tests first: the box, the faces of the hull, and then the exact winding number.
    if (point < low).any() or (point > high).any():
        return False
    normals, levels = outer.faces
    if (matvec(normals, point) > levels).any():
        return False
    return winding_number(point, *outer.triangles) > 0.5


def winding_number(point: FloatArray, vertices: FloatArray, faces: NDArray[np.int64]) -> float:
    """Return the winding number of a surface around a point: 1 inside a closed one, 0 outside.

    Sums solid angles (Van Oosterom and Strackee, 1983) as in Jacobson et al. (2013), which gives
    sensible results for surfaces with holes, too.

    Args:
        point: The point ``(3,)`` [m].
        vertices: Vertices ``(v, 3)`` [m].
        faces: Indices ``(f, 3)``.
    """
    a, b, c = np.moveaxis((vertices - point)[faces], 1, 0)
    la, lb, lc = (norms(v) for v in (a, b, c))
    numerator = _sum(a * np.cross(b, c), axis=1)
    denominator = (
        la * lb * lc
        + _sum(a * b, axis=1) * lc
        + _sum(b * c, axis=1) * la
        + _sum(c * a, axis=1) * lb
    )
    return abs(float(np.arctan2(numerator, denominator).sum())) / (2.0 * np.pi)
