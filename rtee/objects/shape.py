"""Objects as users write them: a box, cylinder, sphere or capsule, a drill, or a mesh file.

The planner and the simulation both read objects here, so that both accept the same ones.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from rtee.errors import ConfigError, ModelError
from rtee.sample import FloatArray
from rtee.values import number

SHAPES: Final = (
    "box:WxDxH, cylinder:RADIUSxHEIGHT, sphere:RADIUS, capsule:RADIUSxLENGTH (in metres) or drill"
)
"""Syntax of objects other than meshes, for messages."""

NUMBERS: Final = {"box": 3, "cylinder": 2, "sphere": 1, "capsule": 2}
"""Number of sizes of each kind of shape."""

DRILL: Final = "drill"
"""Text for a pistol-like body with a trigger."""

LARGEST: Final = 2.0
"""Largest extent of an object [m]; a larger one uses another unit, or is not for a hand."""

SMALLEST: Final = 1e-4
"""Smallest extent of an object [m]: thinner things have no sides to grasp."""

HANDLE: Final = (0.044, 0.048, 0.130)
"""Width, depth and length of a drill's handle [m]; its back and its front are round."""

MOTOR: Final = (0.050, 0.140, 0.050)
"""Width, length and height of the housing above the handle, flush with its back [m]."""

PLATE: Final = (0.022, 0.008, 0.034)
"""Width, thickness and height of a drill's trigger [m]."""

TRIGGER_TRAVEL: Final = 0.010
"""Travel of a drill's trigger [m]."""

_BELOW: Final = 0.002
"""Gap between a drill's housing and its trigger, so that they never touch [m]."""

_AROUND: Final = 24
"""Number of points around the round sides of a drill's handle: up to 0.2 mm inside them."""


@dataclass(frozen=True, slots=True)
class ObjectShape:
    """The shape of an object.

    Attributes:
        kind: ``box``, ``cylinder``, ``sphere``, ``capsule``, ``drill`` or ``mesh``.
        size: Edge lengths; radius and height, or radius and length with the caps; or radius [m];
            empty for a drill and a mesh.
        path: The mesh file.
        scale: Factor on all lengths of a drill or a mesh.
    """

    kind: str
    size: tuple[float, ...] = ()
    path: Path | None = None
    scale: float = 1.0

    def scaled(self, factor: float) -> ObjectShape:
        """Return the same shape with all lengths times a factor."""
        if self.size:
            return replace(self, size=tuple(factor * value for value in self.size))
        return replace(self, scale=factor * self.scale)

    @property
    def name(self) -> str:
        """Name on the command line, such as ``sphere:0.03``."""
        if self.path is not None:
            return str(self.path)
        if not self.size:
            return self.kind
        return f"{self.kind}:{'x'.join(f'{value:g}' for value in self.size)}"

    def lowest(self, pose: FloatArray) -> float:
        """Return the height of the object's lowest point [m] at a pose ``(4, 4)`` in the world.

        For a mesh, the origin counts as the lowest point.
        """
        down = pose[:3, :3].T @ np.array([0.0, 0.0, -1.0])
        match self.kind:
            case "box":
                reach = float(np.abs(down) @ np.array(self.size)) / 2.0
            case "cylinder":
                radius, height = self.size
                reach = radius * math.hypot(down[0], down[1]) + 0.5 * height * abs(down[2])
            case "sphere":
                reach = self.size[0]
            case "capsule":
                radius, length = self.size
                reach = radius + (0.5 * length - radius) * abs(float(down[2]))
            case "drill":
                reach = 0.5 * HANDLE[2] * self.scale
            case _:
                reach = 0.0
        return float(pose[2, 3]) - reach


def is_shape(text: str) -> bool:
    """Return whether a text means a shape with its sizes, or a drill, and not a file."""
    kind, colon, _ = text.partition(":")
    # A mesh file may be called "box": only with sizes is it a shape.
    return text == DRILL or (bool(colon) and kind in NUMBERS)


def parse_object(text: str, formats: Sequence[str]) -> ObjectShape:
    """Parse an object as written on the command line.

    Args:
        text: The text.
        formats: Suffixes of the mesh files that can be used, such as ``.stl``.

    Raises:
        ConfigError: if the text has none of the known forms, or the mesh does not exist.
    """
    if not isinstance(text, str):
        raise ConfigError(f"an object is a shape, such as sphere:0.03, not {text!r:.100}")
    if text == DRILL:
        return ObjectShape(DRILL)
    if is_shape(text):
        kind, _, numbers = text.partition(":")
        return ObjectShape(kind, _sizes(text, kind, numbers))
    path = Path(text)
    if path.suffix.lower() not in formats:
        raise ConfigError(f"{_no_object(text)}, or the path of a mesh ({', '.join(formats)})")
    if not path.is_file():
        raise ConfigError("no such mesh", path=path)
    return ObjectShape("mesh", path=path)


MOST_PARTS: Final = 64
"""Maximum number of parts of a mesh; more are probably loose triangles."""


def mesh_parts(faces: NDArray[np.int64], count: int) -> list[NDArray[np.int64]]:
    """Return the faces ``(f, 3)`` of each part of a mesh that is connected by shared corners.

    The planner and the simulation use the convex hull of each part as a solid. Each corner takes
    the least label of its faces, repeatedly, until no label changes.
    """
    label = np.arange(count)
    while True:
        least = label[faces].min(axis=1)
        spread = label.copy()
        np.minimum.at(spread, faces.ravel(), np.repeat(least, 3))
        spread = spread[spread]  # labels are corners: jump to their labels
        if (spread == label).all():
            break
        label = spread
    of_face = label[faces[:, 0]]
    return [faces[of_face == one] for one in np.unique(of_face)]


def check_thick(
    corners: NDArray[np.floating], parts: Sequence[NDArray[np.int64]], path: Path
) -> None:
    """Check that no part of a mesh is thinner than the thinnest shape may be.

    Args:
        corners: Corners of the mesh ``(v, 3)`` [m].
        parts: The triangles of each of its parts, as indices of corners ``(t, 3)``.
        path: Its file, for the message.

    Raises:
        ModelError: if one is thinner.
    """
    if flat := sum(_thickness(corners[np.unique(part)]) < SMALLEST for part in parts):
        which = f"{flat} of {len(parts)} parts of the mesh are" if parts[1:] else "the mesh is"
        raise ModelError(
            f"{which} flat; only what is at least {SMALLEST:g} m thick has sides to grasp",
            path=path,
        )


def _thickness(points: NDArray[np.floating]) -> float:
    """Return the least extent of points ``(k, 3)`` along their principal axes [m]."""
    if len(points) < 4:
        return 0.0
    middled = np.asarray(points, dtype=np.float64) - points.mean(axis=0)
    _, axes = np.linalg.eigh(middled.T @ middled)
    return float(np.ptp(middled @ axes, axis=0).min())


def signed_volume(triangles: FloatArray) -> float:
    """Return the volume that closed triangles ``(t, 3, 3)`` enclose [m³]."""
    a, b, c = triangles[:, 0], triangles[:, 1], triangles[:, 2]
    return float((a * np.cross(b, c)).sum() / 6.0)


_LOOKED_AT: Final = 1000
"""Approximate number of faces, and of corners, of a mesh to check for hollows."""

_HOLLOW: Final = 0.05
"""Share of the mesh's size: a face with corners on both sides, both farther away than this, belongs
to a hollow. The roughness of a scan is less."""


def hollow_mesh(corners: NDArray[np.floating], faces: NDArray[np.integer]) -> str:
    """Return a sentence about a mesh with hollows, handles or holes; empty if it is convex.

    Args:
        corners: Its corners ``(v, 3)`` [m].
        faces: Its triangles, as indices of corners ``(f, 3)``.
    """
    # A sample of faces and corners suffices; a scan may have a hundred thousand.
    some = faces[:: max(len(faces) // _LOOKED_AT, 1)]
    points = np.asarray(corners[:: max(len(corners) // _LOOKED_AT, 1)], dtype=np.float64)
    first, second, third = (np.asarray(corners[some[:, k]], dtype=np.float64) for k in range(3))
    normals = np.cross(second - first, third - first)
    sizes = np.linalg.norm(normals, axis=1)
    solid = sizes > 0.0
    normals, first = normals[solid] / sizes[solid, None], first[solid]
    beyond = points @ normals.T - np.sum(normals * first, axis=1)
    size = float(np.ptp(points, axis=0).max()) if len(points) else 0.0
    # A face of a convex body has all corners on one side.
    depth = np.minimum(beyond.max(axis=0, initial=0.0), -beyond.min(axis=0, initial=0.0))
    if not float(depth.max(initial=0.0)) > _HOLLOW * size:
        return ""
    return (
        "the mesh counts as its convex hull: hollows, handles and holes are filled, and fingers do "
        "not reach into them (rtee[planning] divides it into convex parts)"
    )


def open_mesh(corners: NDArray[np.floating], faces: NDArray[np.integer]) -> str:
    """Return a sentence about a mesh that is not closed; empty if it is closed.

    Args:
        corners: Its corners ``(v, 3)``; coincident corners count as one.
        faces: Its triangles, as indices of corners ``(f, 3)``.
    """
    order = np.lexsort(corners.T)
    new = (corners[order[1:]] != corners[order[:-1]]).any(axis=1)
    place = np.zeros(len(corners), dtype=np.int64)
    place[order[1:]] = np.cumsum(new)
    found = place[np.asarray(faces, dtype=np.int64)]
    # A triangle with two equal corners is a line, which does not close a mesh.
    found = found[(found != np.roll(found, 1, axis=1)).all(axis=1)]
    ends = np.sort(np.concatenate([found[:, [0, 1]], found[:, [1, 2]], found[:, [2, 0]]]), axis=1)
    # Sorting edges as single numbers is many times faster than as pairs.
    _, shared = np.unique(ends[:, 0] * len(corners) + ends[:, 1], return_counts=True)
    single = int((shared == 1).sum())
    if not single:
        return ""
    return (
        f"the mesh is open, {single} of its edges have only one face; convex hulls count as solid: "
        "nothing reaches into them, and they determine the centre of mass"
    )


def _sizes(text: str, kind: str, numbers: str) -> tuple[float, ...]:
    try:
        size = tuple(float(part) for part in numbers.split("x"))
    except ValueError:
        size = ()
    if len(size) != NUMBERS[kind] or not all(
        math.isfinite(value) and SMALLEST <= value <= LARGEST for value in size
    ):
        raise ConfigError(f"{_no_object(text)}, each number from {SMALLEST:g} to {LARGEST:g}")
    if kind == "capsule" and size[1] < 2.0 * size[0]:
        raise ConfigError(
            f"'{text}' is not an object: a capsule's length is at least its diameter, "
            f"{2 * size[0]:g} m"
        )
    return size


def refuse_paths(text: str) -> None:
    """Refuse all texts but shapes in requests from outside, whose files must not be opened.

    Raises:
        ConfigError: if the text is not a shape.
    """
    if not is_shape(text):
        raise ConfigError(_no_object(text))


def _no_object(text: str) -> str:
    # A text from outside may be as long as a message.
    return f"'{text[:200]}' is not an object; write {SHAPES}"


def trigger_place(scale: float = 1.0) -> tuple[float, float, float]:
    """Return the centre of a drill's released trigger in the drill's frame [m].

    The trigger's travel, and its gap to the housing, are the same at any scale.
    """
    front = 0.5 * (scale * HANDLE[1]) + TRIGGER_TRAVEL + 0.5 * (scale * PLATE[1])
    return 0.0, front, 0.5 * (scale * HANDLE[2]) - 0.5 * (scale * PLATE[2]) - _BELOW


def motor_place(scale: float = 1.0) -> tuple[float, float, float]:
    """Return the centre of a drill's housing in the drill's frame [m]."""
    back = 0.5 * (scale * MOTOR[1] - scale * HANDLE[1])
    return 0.0, back, 0.5 * (scale * HANDLE[2] + scale * MOTOR[2])


def drill_parts() -> tuple[FloatArray, ...]:
    """Return points ``(k, 3)`` [m] whose hulls are a drill's handle, motor and trigger.

    The centre of the handle is the origin; the trigger is released.
    """
    radius, flat = 0.5 * HANDLE[0], 0.5 * (HANDLE[1] - HANDLE[0])
    turn = np.arange(_AROUND) * (2.0 * np.pi / _AROUND)
    ring = radius * np.stack([np.cos(turn), np.sin(turn), 0.0 * turn], axis=1)
    ends = np.array([[0.0, y, 0.5 * z * HANDLE[2]] for y in (-flat, flat) for z in (-1, 1)])
    corners = np.array(list(itertools.product((-0.5, 0.5), repeat=3)))
    return (
        (ends[:, None] + ring).reshape(-1, 3),
        corners * MOTOR + np.array(motor_place()),
        corners * PLATE + np.array(trigger_place()),
    )


GRAVITY: Final = "gravity"
"""Text for a table at right angles to the weight."""

TABLE: Final = f"X,Y,Z or X,Y,Z,HEIGHT [m], its upward normal in the object's frame, or '{GRAVITY}'"
"""Syntax of a table, for messages."""


@dataclass(frozen=True, slots=True)
class Table:
    """The table under an object, in the object's frame.

    Attributes:
        up: Upward normal of the table ``(3,)``; opposite to the weight unless given.
        height: Height of the table's top above the object's origin, along the normal [m]; that of
            the object's lowest point unless given.

    Raises:
        ConfigError: if a number is not finite, or the normal is 0.
    """

    up: tuple[float, float, float] | None = None
    height: float | None = None

    def __post_init__(self) -> None:
        if self.up is not None and not any(vector(self.up, "a table's normal")):
            raise ConfigError("a table's normal must be three finite numbers, not all of them 0")
        height = 0.0 if self.height is None else number(self.height)
        if height is None or not math.isfinite(height):
            raise ConfigError(f"a table's height must be a finite number, not {self.height!r:.100}")


def vector(values: object, what: str) -> tuple[float, ...]:
    """Return three finite numbers; raises `ConfigError` for anything else."""
    try:
        found = np.array(values, dtype=np.float64)
    except (TypeError, ValueError):
        found = np.empty(0)
    if found.shape != (3,) or not np.isfinite(found).all():
        raise ConfigError(f"{what} must be three finite numbers, not {values!r:.100}")
    return tuple(found.tolist())


def parse_table(text: str) -> Table:
    """Parse a table: ``gravity``, ``X,Y,Z`` (its upward normal) or ``X,Y,Z,HEIGHT`` [m].

    Raises:
        ConfigError: if the text is none of these.
    """
    if text == GRAVITY:
        return Table()
    try:
        x, y, z, *height = (float(part) for part in text.split(","))
    except ValueError:
        x, height = math.nan, [0.0, 0.0]
    if len(height) > 1:
        raise ConfigError(f"a table must be {TABLE}, not '{text}'")
    return Table((x, y, z), height[0] if height else None)
