"""The object to be grasped: a shape, or the convex pieces of a drill or a mesh."""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Final

import coal
import numpy as np
from numpy.typing import NDArray

from rtee.errors import ConfigError, ModelError
from rtee.hand.coarse import welded
from rtee.hand.convex import convex_solids
from rtee.hand.files import read_bytes
from rtee.hand.geometry import hull_of, repaired, triangles_of
from rtee.hand.meshes import FORMATS, why_no_mesh
from rtee.hand.tessellation import stl_corners
from rtee.objects.shape import (
    DRILL,
    LARGEST,
    MOST_PARTS,
    NUMBERS,
    SMALLEST,
    check_thick,
    drill_parts,
    mesh_parts,
    open_mesh,
    parse_object,
    signed_volume,
)
from rtee.sample import FloatArray
from rtee.values import number

_MOST_TRIANGLES: Final = 300_000
"""Most triangles of a mesh that is not a binary STL file; more take longer to read than to plan
for."""

_AROUND: Final = 64
"""Corners of a circle; the polygon is 0.03 mm inside a circle of 25 mm."""

_SMALLER: Final = 0.95
"""A turned bounding box is used if its volume is below this share of the upright one's."""

_HOLLOW: Final = 0.8
"""A piece that fills less than this share of its convex hull gets a note."""


@dataclass(frozen=True)
class Piece:
    """A convex piece of an object.

    Attributes:
        kind: ``box``, ``cylinder``, ``sphere``, ``capsule`` or ``mesh``.
        size: Edge lengths; radius and length, a capsule's with its caps; or radius [m]; nothing for
            a mesh.
        shape: The piece for distances, in the object's frame.
        points: Points ``(k, 3)`` in the object's frame; the piece is their hull, thickened by
            ``radius``.
        radius: That thickness [m].
    """

    kind: str
    size: tuple[float, ...]
    shape: coal.ShapeBase
    points: FloatArray
    radius: float = 0.0

    def support(self, directions: FloatArray) -> FloatArray:
        """Return the extents along unit vectors ``(d, 3)`` of its frame ``(d,)`` [m]."""
        reach: FloatArray = (self.points @ directions.T).max(axis=0) + self.radius
        return reach


@dataclass(frozen=True)
class GraspObject:
    """An object to be grasped.

    Attributes:
        name: The object, as written on the command line.
        pieces: Its convex pieces.
        mass: Its mass [kg].
        notes: Assumptions about it, one sentence each.
    """

    name: str
    pieces: tuple[Piece, ...]
    mass: float
    notes: tuple[str, ...] = ()

    def support(self, directions: FloatArray) -> FloatArray:
        """Return the extents along unit vectors ``(d, 3)`` of its frame ``(d,)`` [m]."""
        farthest: FloatArray = np.max([p.support(directions) for p in self.pieces], axis=0)
        return farthest

    def scaled(self, factor: float) -> GraspObject:
        """Return the same object with all lengths times a factor, each piece by its hull."""
        pieces = []
        for piece in self.pieces:
            if piece.kind in NUMBERS:
                pieces.append(_primitive(piece.kind, tuple(factor * v for v in piece.size)))
                continue
            points = factor * piece.points
            pieces.append(Piece("mesh", (), hull_of(points), points, factor * piece.radius))
        return replace(self, pieces=tuple(pieces))

    @cached_property
    def centre(self) -> FloatArray:
        """Centre of mass ``(3,)`` [m], of uniform density; overlaps of pieces count twice."""
        volumes = np.array([piece.shape.computeVolume() for piece in self.pieces])
        centres = np.array([piece.shape.computeCOM() for piece in self.pieces])
        found: FloatArray = volumes @ centres / volumes.sum()
        return found

    @cached_property
    def frame(self) -> FloatArray:
        """Axes ``(3, 3)`` of its bounding box, as columns: its own, or those of its shape.

        Those of the shape (principal axes) where their box is clearly smaller, as for a mesh that
        is not modelled upright.
        """
        points = np.concatenate([piece.points for piece in self.pieces])
        _, axes = np.linalg.eigh(np.cov(points.T) if len(points) > 3 else np.eye(3))
        # Eigenvectors have no sign of their own: their largest components are made positive.
        axes = axes * np.where(np.abs(axes).max(axis=0) == axes.max(axis=0), 1.0, -1.0)
        # Right-handed, so that turning into this frame is a rotation and not a reflection.
        axes[:, 2] = np.cross(axes[:, 0], axes[:, 1])
        turned, upright = self._volume(axes), self._volume(np.eye(3))
        return axes if turned < _SMALLER * upright else np.eye(3)

    def _volume(self, axes: FloatArray) -> float:
        return float(np.prod(self.support(axes.T) + self.support(-axes.T)))

    @cached_property
    def box(self) -> tuple[FloatArray, FloatArray]:
        """Middle ``(3,)``, in the object's frame, and half extents ``(3,)`` of its box [m]."""
        axes = self.frame.T
        high, low = self.support(axes), -self.support(-axes)
        return self.frame @ (0.5 * (high + low)), 0.5 * (high - low)

    @cached_property
    def inside(self) -> FloatArray:
        """A point inside its box ``(3,)`` [m]: its origin, or the middle if that is outside.

        Meshes may be modelled far from their origin.
        """
        middle, half = self.box
        outside = bool((np.abs(self.frame.T @ middle) > half).any())
        return middle if outside else np.zeros(3)

    @property
    def extents(self) -> tuple[float, float, float]:
        """Extents of its bounding box, the smallest first [m]."""
        x, y, z = sorted(2.0 * float(half) for half in self.box[1])
        return x, y, z

    @cached_property
    def length(self) -> float:
        """Greatest distance of its surface from the centre of mass [m]; a scale of torques."""
        return max(
            float(np.linalg.norm(piece.points - self.centre, axis=1).max()) + piece.radius
            for piece in self.pieces
        )


def read_object(text: str, mass: float = 0.1, scale: float = 1.0) -> GraspObject:
    """Read an object as it is written on the command line.

    Args:
        text: ``box:WxDxH``, ``cylinder:RADIUSxHEIGHT``, ``sphere:RADIUS``,
            ``capsule:RADIUSxLENGTH`` (in metres; the length with its caps), ``drill``, or the path
            of a mesh.
        mass: Its mass [kg].
        scale: Brings a mesh to metres: 0.001 for one in millimetres.

    Raises:
        ConfigError: if it is none of these, or mass or scale is invalid.
        ModelError: if the mesh cannot be used.
    """
    for what, value, most, limit in (
        ("mass of an object", mass, 100.0, "above 0 and at most 100 kg"),
        ("scale of a mesh", scale, math.inf, "above 0"),
    ):
        plain = number(value)
        if plain is None or not (0.0 < plain <= most and plain < math.inf):
            raise ConfigError(f"the {what} must be {limit}, not {value!r:.100}")
    shape = parse_object(text, FORMATS)
    if shape.path is not None:
        pieces, notes = _mesh(shape.path, scale)
        return GraspObject(text, pieces, mass, notes)
    if shape.kind == DRILL:
        return GraspObject(text, tuple(hull_piece(points) for points in drill_parts()), mass)
    return GraspObject(text, (_primitive(shape.kind, shape.size),), mass)


def hull_piece(points: FloatArray) -> Piece:
    """Return the hull of points ``(k, 3)`` in an object's frame [m] as a piece of it."""
    return Piece("mesh", (), hull_of(points), points)


def _primitive(kind: str, size: tuple[float, ...]) -> Piece:
    match kind:
        case "box":
            corners = np.array(list(itertools.product((-0.5, 0.5), repeat=3))) * np.array(size)
            return Piece(kind, size, coal.Box(*size), corners)
        case "sphere":
            return Piece(kind, size, coal.Sphere(size[0]), np.zeros((1, 3)), size[0])
        case "capsule":
            radius, half = size[0], 0.5 * size[1] - size[0]
            ends = np.array([[0.0, 0.0, -half], [0.0, 0.0, half]])
            return Piece(kind, size, coal.Capsule(radius, 2.0 * half), ends, radius)
    radius, height = size
    # The points are for widths and outlines; distances use Coal's exact cylinder.
    turn = np.arange(_AROUND) * (2.0 * np.pi / _AROUND)
    ring = radius * np.stack([np.cos(turn), np.sin(turn), np.zeros(_AROUND)], axis=1)
    up = np.array([0.0, 0.0, 0.5 * height])
    return Piece(kind, size, coal.Cylinder(radius, height), np.concatenate([ring - up, ring + up]))


def _mesh(path: Path, scale: float) -> tuple[tuple[Piece, ...], tuple[str, ...]]:
    """Return the convex pieces of a mesh: the hulls of its solids; see `convex_solids`.

    Raises:
        ModelError: if it cannot be used.
    """
    corners, faces = _triangles(path, scale)
    extent = float(np.ptp(corners, axis=0).max())
    if not SMALLEST <= extent <= LARGEST:
        hint = (
            "is it in millimetres? Meshes are in metres (grasp-plan has --scale 0.001)"
            if extent > LARGEST
            else f"--scale brings it to metres, and {scale:g} is too small"
        )
        raise ModelError(
            f"the mesh is {extent:g} m in size, which no hand can grasp; {hint}", path=path
        )
    parts = mesh_parts(faces, len(corners))
    if len(parts) > MOST_PARTS:
        raise ModelError(
            f"the mesh has {len(parts)} separate parts; the planner takes at most {MOST_PARTS}",
            path=path,
        )
    check_thick(corners, parts, path)
    pieces, hollow = [], 0
    for points, sides in convex_solids(corners, parts):
        shape = hull_of(points)
        filled = abs(signed_volume(points[sides]))
        hollow += filled < _HOLLOW * shape.computeVolume()
        pieces.append(Piece("mesh", (), shape, np.array(shape.points())))
    notes = [note] if (note := open_mesh(corners, faces)) else []
    if hollow:
        notes.append(
            f"{hollow} of {len(pieces)} parts of the mesh "
            f"{'is' if hollow == 1 else 'are'} hollow or open; the convex hull counts"
        )
    return tuple(pieces), tuple(notes)


def _triangles(path: Path, scale: float) -> tuple[FloatArray, NDArray[np.int64]]:
    """Return the corners ``(v, 3)`` [m] and faces ``(f, 3)`` of a mesh file."""
    data = read_bytes(path, "mesh", ModelError)
    wrong = why_no_mesh(data, path.suffix.lower())
    if wrong:
        raise ModelError(f"the mesh cannot be read: {wrong}", path=path)
    stl = stl_corners(data) if path.suffix.lower() == ".stl" else None
    if stl is not None and len(stl) > 3 * _MOST_TRIANGLES and np.isfinite(stl).all():
        # Coal would take 1 kB a triangle, for bounding volumes that are not used.
        return welded(stl * scale)
    loader = coal.MeshLoader(coal.NODE_TYPE.BV_AABB)
    try:
        mesh = loader.load(str(path), np.full(3, scale))
    except (ValueError, RuntimeError) as error:
        # Coal names its own source file and line first, then the mesh; the next line is Assimp's.
        _, _, said = str(error).partition("Could not load resource")
        lines = said.splitlines()[1:] or [f"it is not a valid {path.suffix[1:].upper()} file"]
        raise ModelError(f"the mesh cannot be read: {lines[0].strip()}", path=path) from None
    if mesh.num_tris > _MOST_TRIANGLES:
        raise ModelError(
            f"the mesh has {mesh.num_tris} triangles; at most {_MOST_TRIANGLES} are read, except "
            "from a binary STL file; only its convex hull matters, so a simplified copy will do",
            path=path,
        )
    if path.suffix.lower() != ".stl":  # a single part
        mesh = repaired(mesh, loader)
    corners, faces = triangles_of(mesh)
    if not np.isfinite(corners).all():
        raise ModelError("the mesh has a vertex that is not finite", path=path)
    return corners, faces
