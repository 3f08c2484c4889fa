"""The collision geometry of a hand with Coal: the shapes of the URDF and their convex hulls."""

from __future__ import annotations

import hashlib
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from functools import cached_property
from itertools import combinations, product
from pathlib import Path
from tempfile import NamedTemporaryFile
from typing import Final

import coal
import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from rtee.errors import ModelError
from rtee.hand.coarse import MOST, coarsened, welded
from rtee.hand.halton import halton
from rtee.hand.kinematics import Kinematics, pose
from rtee.hand.linalg import norm
from rtee.hand.meshes import check_mesh, unit_of
from rtee.hand.model import DisabledPair, Hand
from rtee.hand.tessellation import Triangles, binary_stl, joined, solid, stl_corners
from rtee.hand.urdf import UrdfGeometry, UrdfLink
from rtee.hand.urdfread import FARTHEST
from rtee.sample import FloatArray

_FEWEST: Final = 3
"""Least number of vertices of a part: those of one triangle."""

_MOST: Final = 12
"""Largest number of possible beginnings of parts; with more, the search would take too long."""

_LOST: Final = 8
"""Largest number of unused vertices, since the loader drops degenerate triangles."""

Faces = NDArray[np.int64]


def repaired(mesh: coal.BVHModelBase, loader: coal.MeshLoader) -> coal.BVHModelBase:
    """Return a mesh with correct triangles in all parts; the same object if it is correct already.

    Args:
        mesh: A mesh from Coal's loader.
        loader: A loader, which determines the kind of bounding volumes of the result.
    """
    corners, faces = triangles_of(mesh)
    if len(faces) == 0 or len(corners) - (int(faces.max()) + 1) < _FEWEST:
        return mesh
    apart = split_parts(faces, len(corners))
    return mesh if apart is None else _with_volumes(corners[apart], loader)


def triangles_of(mesh: coal.BVHModelBase) -> Triangles:
    """Return the corners ``(v, 3)`` and faces ``(f, 3)`` of a mesh from Coal's loader."""
    corners = (mesh.tri_indices(i) for i in range(mesh.num_tris))
    faces = [(c[0], c[1], c[2]) for c in corners]
    return np.array(mesh.vertices()), np.array(faces, dtype=np.int64).reshape(-1, 3)


def _with_volumes(corners: FloatArray, loader: coal.MeshLoader) -> coal.BVHModelBase:
    """Return a mesh of the corners of triangles ``(f, 3, 3)`` with the loader's bounding volumes.

    Through a file, since Coal's Python bindings make these only when they load a mesh.
    """
    with NamedTemporaryFile(suffix=".stl") as file:
        file.write(binary_stl(corners))
        file.flush()
        return loader.load(file.name, np.ones(3))


def split_parts(faces: Faces, corners: int) -> Faces | None:
    """Return triangles ``(f, 3)`` with indices into all vertices; ``None`` for a single part.

    Args:
        faces: The triangles ``(f, 3)`` with indices from 0 in every part.
        corners: Number of vertices of all parts.
    """
    first = np.flatnonzero((np.sort(faces, axis=1) == (0, 1, 2)).all(axis=1))
    places = [int(i) for i in first if i > 0]
    if not places or len(places) > _MOST:
        return None
    best: tuple[int, Faces] | None = None
    # Many parts first, since with fewer ones, vertices of different parts would be connected.
    for count in range(len(places), 0, -1):
        for cuts in combinations(places, count):
            parts = np.split(faces, cuts)
            sizes = [int(part.max()) + 1 for part in parts]
            lost = corners - sum(sizes)
            if 0 <= lost <= _LOST and (best is None or lost < best[0]):
                begins = np.concatenate([[0], np.cumsum(sizes)[:-1]])
                best = lost, np.concatenate([p + b for p, b in zip(parts, begins, strict=True)])
    return None if best is None else best[1]


_FLAT: Final = 1e-4
"""Ratio of thickness to extent below which a mesh has no proper convex hull and is thickened."""

Sides = tuple[Sequence[int], Sequence[int]]
"""Two sets of shapes, by their indices."""

_THICKNESS: Final = 1e-5
"""Half the thickness given to a flat mesh [m]: far below the accuracy of models."""

_OUTERMOST: Final = (2000, 1000, 500, 250)
"""Numbers of directions in which the outermost vertices make a hull, the first that Coal takes: a
vertex may have 255 neighbours, which 250 vertices cannot exceed."""


def _settle_boxes() -> None:
    """Make Coal's first query about a box one in a direction without zeros.

    The direction of the first query decides whether Coal enlarges boxes by 1e-10 for the rest of
    the process; otherwise, results would depend on earlier queries.
    """
    askew = coal.Transform3s(pin.rpy.rpyToMatrix(0.3, 0.5, 0.7), np.array([3.0, 1.0, 2.0]))
    here, request, result = coal.Transform3s(), coal.DistanceRequest(), coal.DistanceResult()
    coal.distance(coal.Cylinder(1.0, 1.0), here, coal.Box(1.0, 1.0, 1.0), askew, request, result)


_settle_boxes()


class Shape:
    """One collision shape of a link.

    Attributes:
        link: The link's name.
        body: Index of the joint that carries it, 0 for the base.
        of_link: Pose of the link in that joint's frame.
        placement: Pose of the shape in that joint's frame.
        in_link: Pose of the shape in the link's frame.
        exact: The shape as given: a solid primitive, or the triangles of a mesh.
        source: Its definition in the URDF.
    """

    def __init__(
        self,
        link: str,
        body: int,
        of_link: pin.SE3,
        exact: coal.CollisionGeometry,
        source: UrdfGeometry,
    ) -> None:
        self.link = link
        self.body = body
        self.of_link = of_link
        self.in_link = pose(source.xyz, source.rpy)
        self.placement = of_link * self.in_link
        self.exact = exact
        # Coal does not compute the bounding boxes of primitives by itself.
        self.exact.computeLocalAABB()
        self.source = source

    @property
    def is_mesh(self) -> bool:
        """Whether the shape is a mesh and not a solid primitive."""
        return self.source.kind == "mesh"

    def at(self, link_pose: FloatArray) -> coal.Transform3s:
        """Return the pose of the shape in the frame in which its link has a pose ``(4, 4)``."""
        pose = pin.SE3(link_pose) * self.in_link
        return coal.Transform3s(pose.rotation, pose.translation)

    @cached_property
    def convex(self) -> coal.ShapeBase:
        """The convex part: the primitive itself, or the convex hull of the mesh."""
        return _hull(self.exact) if self.is_mesh else self.exact

    @cached_property
    def faces(self) -> tuple[FloatArray, FloatArray]:
        """Outward normals ``(f, 3)`` of a mesh's convex hull and the offsets of its faces ``(f,)``.

        In the shape's frame. The offsets are distances from the origin along the normals [m].
        """
        return np.array(self.convex.normals()), -np.array(self.convex.offsets())

    @cached_property
    def triangles(self) -> Triangles:
        """Vertices ``(v, 3)`` [m] in the shape's frame, and faces as vertex indices ``(f, 3)``."""
        if self.is_mesh:
            return triangles_of(self.exact)
        return solid(self.source.kind, self.source.dimensions)

    @cached_property
    def box(self) -> tuple[FloatArray, FloatArray]:
        """Lowest and highest corner of the bounding box in the shape's frame ``(3,)`` [m]."""
        bounds = self.exact.aabb_local
        return np.array(bounds.min_), np.array(bounds.max_)

    @cached_property
    def ball(self) -> tuple[FloatArray, float]:
        """Centre ``(3,)`` and radius of the sphere around the bounding box [m]."""
        low, high = self.box
        return (low + high) / 2.0, norm(high - low) / 2.0

    @cached_property
    def points(self) -> FloatArray:
        """Points ``(k, 3)`` [m] in the shape's frame whose convex hull contains the shape."""
        kind, source = self.source.kind, self.source
        if kind == "mesh":
            return np.array(self.convex.points())
        half = {
            "box": np.array(source.size) / 2,
            "sphere": np.full(3, source.radius),
            "cylinder": np.array([source.radius, source.radius, source.length / 2]),
        }[kind]
        signs = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)])
        corners: FloatArray = signs * half
        return corners


class HandGeometry:
    """The collision geometry of all links of a hand.

    Attributes:
        kinematics: The hand's kinematics.
        shapes: All collision shapes, link by link in the order of the URDF's tree.
        notes: Changes to meshes, one sentence each.
    """

    def __init__(
        self, hand: Hand, kinematics: Kinematics | None = None, *, visual: bool = False
    ) -> None:
        """Read the shapes.

        Args:
            hand: The hand.
            kinematics: Its kinematics, if they exist already.
            visual: Whether to read the visual shapes instead, for pictures. Links without visual
                shapes, or whose visual meshes cannot be read, get their collision shapes.

        Raises:
            ModelError: if a mesh is missing or cannot be read.
        """
        self.hand = hand
        self.kinematics = kinematics or Kinematics(hand)
        loader = _Meshes(hand)
        self.shapes = tuple(
            Shape(link, body, placement, exact, source)
            for link, (body, placement) in self.kinematics.bodies.items()
            for source, exact in _of_link(hand.urdf.links[link], loader, visual=visual)
        )
        self.notes = tuple(loader.notes)

    def of_links(self, *links: str) -> tuple[int, ...]:
        """Return the indices of the shapes of some links."""
        return tuple(i for i, shape in enumerate(self.shapes) if shape.link in links)

    def closest(
        self, sides: Sides, poses: Mapping[str, FloatArray], *, convex: bool
    ) -> tuple[float, FloatArray]:
        """Return the distance between two sets of shapes and the midpoint of their closest points.

        Args:
            sides: Indices of the shapes of both sides.
            poses: The pose ``(4, 4)`` of every link.
            convex: Whether to measure between the convex hulls, with negative distances if they
                overlap, instead of the shapes of the URDF.

        Returns:
            The distance [m], and a point ``(3,)`` [m] in the frame of the poses.
        """
        request = coal.DistanceRequest()
        # Overlapping parts have a negative distance, the penetration depth.
        request.enable_signed_distance = True
        best, middle = np.inf, np.zeros(3)
        for first, second in self._couples(sides):
            bodies = [shape.convex if convex else shape.exact for shape in (first, second)]
            places = [shape.at(poses[shape.link]) for shape in (first, second)]
            result = coal.DistanceResult()
            distance = coal.distance(bodies[0], places[0], bodies[1], places[1], request, result)
            if distance < best:
                points = result.getNearestPoint1(), result.getNearestPoint2()
                best, middle = distance, (np.array(points[0]) + np.array(points[1])) / 2.0
        return float(best), middle

    def touching(self, sides: Sides, poses: Mapping[str, FloatArray]) -> bool:
        """Return whether two sets of shapes touch; see `closest`."""
        request = coal.CollisionRequest()
        return any(
            coal.collide(
                first.exact,
                first.at(poses[first.link]),
                second.exact,
                second.at(poses[second.link]),
                request,
                coal.CollisionResult(),
            )
            for first, second in self._couples(sides)
        )

    def _couples(self, sides: Sides) -> Iterator[tuple[Shape, Shape]]:
        """Yield every shape of the first side with every shape of the second one."""
        first, second = ([self.shapes[i] for i in side] for side in sides)
        return product(first, second)

    def triangles(self, link: str) -> Triangles:
        """Return the geometry of a link as triangles, for pictures.

        Returns:
            Vertices ``(v, 3)`` [m] in the link's frame, and faces as vertex indices ``(f, 3)``:
            counter-clockwise seen from outside, if they are so in the source.
        """
        shapes = (self.shapes[i] for i in self.of_links(link))
        return joined((shape.triangles, shape.in_link.homogeneous) for shape in shapes)


class _Meshes:
    """Loads meshes; equal meshes are loaded once."""

    def __init__(self, hand: Hand) -> None:
        self._hand = hand
        self._loader = coal.MeshLoader(coal.NODE_TYPE.BV_kIOS)
        self._draft = coal.MeshLoader(coal.NODE_TYPE.BV_AABB)  # fastest bounding volumes
        self._known: dict[tuple[object, ...], coal.BVHModelBase] = {}
        self.notes: list[str] = []

    def load(self, source: UrdfGeometry) -> coal.BVHModelBase:
        path = check_mesh(source, self._hand.urdf, self._hand.package_dirs)
        # With the scale, since the loader multiplies the vertices by it.
        key = (_identity(path), source.scale)
        if key not in self._known:
            self._known[key] = self._read(path, source)
        return self._known[key]

    def _read(self, path: Path, source: UrdfGeometry) -> coal.BVHModelBase:
        scale = unit_of(path) * np.array(source.scale)
        # The tree of boxes is built by Eigen, which prints to the error output about numbers that
        # are not finite; so they are checked before that, in files of text after a fast draft.
        corners = stl_corners(path.read_bytes()) if path.suffix.lower() == ".stl" else None
        if corners is not None:
            with np.errstate(over="ignore", invalid="ignore"):  # what overflows is refused, too
                corners = corners * scale
                self._check(corners, source)
            if len(corners) > 3 * MOST:
                return self._coarse(*welded(corners), source)
            return self._loaded(self._loader, path, scale, source)
        draft = self._loaded(self._draft, path, scale, source)
        self._check(draft.vertices(), source)
        if path.suffix.lower() != ".stl":
            # Files of other formats may have several parts, which the loader mixes up (see
            # `mesh_repair`).
            mesh = repaired(draft, self._loader if draft.num_tris <= MOST else self._draft)
            if draft.num_tris > MOST:
                return self._coarse(*triangles_of(mesh), source)
            if mesh is not draft:
                return mesh
        return self._loaded(self._loader, path, scale, source)

    def _coarse(
        self, points: FloatArray, faces: NDArray[np.int64], source: UrdfGeometry
    ) -> coal.BVHModelBase:
        """Return a mesh of corners ``(v, 3)`` [m] with fewer faces, but the same convex hull."""
        hull = hull_of(points)
        corners = coarsened(points, faces, np.array(hull.points()))
        self.notes.append(
            f"mesh '{source.mesh}' has {len(faces)} triangles; it is coarsened to {len(corners)}"
        )
        return _with_volumes(corners, self._loader)

    def _loaded(
        self, loader: coal.MeshLoader, path: Path, scale: FloatArray, source: UrdfGeometry
    ) -> coal.BVHModelBase:
        try:
            mesh = loader.load(str(path), scale)
        except (ValueError, RuntimeError) as error:
            lines = str(error).splitlines()
            why = next((s for s in lines if not s.startswith(_COAL_PREFIXES)), "unknown reason")
            raise self._refusal(source, f"cannot be read: {why}") from None
        if mesh.num_tris == 0:
            raise self._refusal(source, "has no triangles")
        return mesh

    def _check(self, vertices: FloatArray, source: UrdfGeometry) -> None:
        """Refuse vertices ``(v, 3)`` [m] that are not finite or too far away."""
        if not np.isfinite(vertices).all():
            raise self._refusal(source, "has a vertex that is not finite")
        if np.abs(vertices).max() > FARTHEST:
            raise self._refusal(source, "is larger than 1 km; its scale should bring it to metres")

    def _refusal(self, source: UrdfGeometry, why: str) -> ModelError:
        return self._hand.urdf.error(f"mesh '{source.mesh}' {why}", source.line)


_COAL_PREFIXES: Final = ("From file", "in function", "at line", "message", "Hint")


def _identity(path: Path) -> object:
    """Return a key of a mesh: the hash of an STL file; the path of others, which may have parts."""
    if path.suffix.lower() == ".stl":
        return hashlib.blake2b(path.read_bytes(), digest_size=16).digest()
    return path


def _of_link(
    link: UrdfLink, meshes: _Meshes, *, visual: bool
) -> list[tuple[UrdfGeometry, coal.CollisionGeometry]]:
    # A picture with collision shapes is better than none; an extraction needs its own shapes.
    if visual and link.visuals:
        try:
            return [(source, _exact(source, meshes)) for source in link.visuals]
        except ModelError:
            pass
    return [(source, _exact(source, meshes)) for source in link.collisions]


def _exact(source: UrdfGeometry, meshes: _Meshes) -> coal.CollisionGeometry:
    if source.kind == "mesh":
        return meshes.load(source)
    solids = {"box": coal.Box, "sphere": coal.Sphere, "cylinder": coal.Cylinder}
    return solids[source.kind](*source.dimensions)


def hull_of(points: FloatArray) -> coal.ConvexBase:
    """Return the convex hull of points ``(k, 3)`` [m]; flat sets are thickened by 10 µm first.

    Coal cannot take the exact hull of a round body with too many corners. The outermost of its
    vertices make one that lies inside it, by up to 30 µm in discs, cones and bars with round ends
    of 60 mm diameter.
    """
    if _is_flat(points):
        # Each point becomes a tiny cube, whose hull is never flat.
        corners = np.array(np.meshgrid(*[(-_THICKNESS, _THICKNESS)] * 3)).T.reshape(-1, 1, 3)
        points = (corners + points).reshape(-1, 3)
    for count in _OUTERMOST:
        try:
            return _exact_hull(points)
        except RuntimeError as error:
            # A vertex of a fan or of a cone's tip has more neighbours than Coal can count (255).
            if "Too many neighbors" not in str(error):
                raise
        points = _outermost(points, count)
    return _exact_hull(points)


def _exact_hull(points: FloatArray) -> coal.ConvexBase:
    # "Qt" makes Qhull split the faces into triangles, which Coal keeps (True).
    return coal.Convex.convexHull(_vector(points), True, "Qt")


def _outermost(points: FloatArray, count: int) -> FloatArray:
    """Return the points that lie farthest out in evenly spread directions ``(<= count, 3)``."""
    x, y, z = points.T
    kept = set[int]()
    for height, turn in (2.0 * halton(2, count) - 1.0).tolist():
        flat, angle = math.sqrt(1.0 - height**2), math.pi * turn
        # Rounded, so that all mathematical libraries give the same directions.
        a, b, c = (round(t, 9) for t in (flat * math.cos(angle), flat * math.sin(angle), height))
        kept.add(int(np.argmax(x * a + y * b + z * c)))
    return points[sorted(kept)]


def _hull(mesh: coal.BVHModelBase) -> coal.ConvexBase:
    if mesh.convex is not None:  # shapes of the same mesh share it
        return mesh.convex
    vertices = mesh.vertices()
    if not _is_flat(vertices):
        with suppress(RuntimeError):  # see `hull_of`
            mesh.buildConvexHull(True, "Qt")
            return mesh.convex
    return hull_of(vertices)


def _is_flat(points: FloatArray) -> bool:
    if len(points) < 4:
        return True
    # The variances along the principal axes; that along the normal of a plane is 0.
    spread = np.linalg.eigvalsh(np.cov(points.T))
    return bool(spread[0] <= _FLAT**2 * spread[-1])


def _vector(points: FloatArray) -> coal.StdVec_Vec3s:
    vector = coal.StdVec_Vec3s()
    for point in points:
        vector.append(point)
    return vector


ADJACENT: Final = "adjacent"
LINKAGE: Final = "of one linkage"
ALWAYS: Final = "touching at every configuration"
AT_REST: Final = "touching at rest"

_CONFIGURATIONS: Final = 64
"""Number of postures at which two links must touch to count as always touching: links that separate
at all do so in a large part of their range."""


def allowed_collisions(hand: Hand) -> tuple[DisabledPair, ...]:
    """Find the pairs of links that may touch without being in collision.

    Adjacent links are connected by one moving joint. The links of a finger's linkage are joined in
    loops that the tree does not have, and made to move past each other. Other pairs are checked
    with the exact geometry at rest and, if they touch there, at postures spread evenly over the
    actuators' limits. Two fingertips are such a pair only if they are adjacent; otherwise their
    contact is a pinch.

    Raises:
        ModelError: if a mesh cannot be read.
    """
    geometry = HandGeometry(hand)
    kinematics = geometry.kinematics
    parents, tips = kinematics.model.parents, hand.tip_links
    at_rest, spread = kinematics.placements(hand.rest), _spread(hand)
    # Without the links in front of all fingers, which are no part of a linkage.
    bodies = [{*finger.body} - {finger.base} for finger in hand.fingers]
    linkages = [
        {link for link in body if sum(link in other for other in bodies) == 1}
        for finger, body in zip(hand.fingers, bodies, strict=True)
        if finger.bars
    ]
    pairs = []
    for links in combinations(dict.fromkeys(shape.link for shape in geometry.shapes), 2):
        first, second = (kinematics.body(link) for link in links)
        # Links of the same rigid body do not move relative to each other.
        if first == second:
            continue
        if parents[first] == second or parents[second] == first:
            pairs.append(DisabledPair(*links, ADJACENT))
            continue
        if links[0] in tips and links[1] in tips:
            continue
        if any(linkage.issuperset(links) for linkage in linkages):
            pairs.append(DisabledPair(*links, LINKAGE))
            continue
        sides = geometry.of_links(links[0]), geometry.of_links(links[1])
        if geometry.touching(sides, at_rest):
            # Only pairs that touch at rest are checked at other postures, since each check of
            # meshes is expensive.
            always = all(geometry.touching(sides, kinematics.placements(u)) for u in spread)
            pairs.append(DisabledPair(*links, ALWAYS if always else AT_REST))
    return tuple(pairs)


def touch_at_rest(hand: Hand) -> Callable[[str, str], bool]:
    """Return a function that checks whether two links touch at rest, with the exact geometry.

    Raises:
        ModelError: if a mesh cannot be read.
    """
    geometry = HandGeometry(hand)
    poses = geometry.kinematics.placements(hand.rest)
    of_links = geometry.of_links
    return lambda link1, link2: geometry.touching((of_links(link1), of_links(link2)), poses)


def _spread(hand: Hand) -> list[FloatArray]:
    """Return postures within the limits: the lower and the upper ones, then a Halton sequence."""
    # One turn covers all postures of a joint without limits.
    lower = np.where(np.isfinite(hand.lower), hand.lower, -np.pi)
    upper = np.where(np.isfinite(hand.upper), hand.upper, np.pi)
    corners = np.array([np.zeros_like(lower), np.ones_like(lower)])
    fractions = np.vstack([corners, halton(len(lower), _CONFIGURATIONS - len(corners))])
    return list(lower + fractions * (upper - lower))
