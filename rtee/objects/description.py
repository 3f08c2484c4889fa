"""The shape of an object that a simulated hand grasps, for pictures, recordings and clients.

The object's pose and the contacts change all the time; they are channels of the simulated device:
`OBJECT_POSE`, `BASE_POSE` and `CONTACTS`.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Final

import numpy as np
from numpy.typing import NDArray

from rtee.sample import FloatArray
from rtee.values import Value

OBJECT_POSE: Final = "object_pose"
"""Channel: position [m] and unit quaternion (w, x, y, z) of the object in the world ``(7,)``."""

BASE_POSE: Final = "base_pose"
"""Channel: pose of the hand's base frame in the world, if an arm carries the hand; otherwise, the
base frame is the world."""

CONTACTS: Final = "contacts"
"""Channel: one row of `CONTACT_COLUMNS` numbers per contact of the hand, the strongest first."""

CONTACT_COLUMNS: Final = 7
"""Numbers of a contact: a point [m] and the force [N] that the link exerts there, both in the
hand's base frame, and the link's index among the links of the URDF."""

MOST_CONTACTS: Final = 32
"""Maximum number of contacts in the channel: more than a picture can show, and 1.8 kB."""

CONTACT_RATE: Final = 30.0
"""Rate at which contacts are updated [Hz]: the frame rate of the browser."""

KINDS: Final = {"box": 3, "cylinder": 2, "sphere": 1, "mesh": 0}
"""Number of sizes of each kind of part."""

MOST_TRIANGLES: Final = 20_000
"""Maximum number of triangles of a part: a message of 0.5 MB. The hull replaces a larger mesh."""


_LONGEST: Final = 0.35
"""Length that arrows approach at large forces, as a share of the hand's size."""

_HALF: Final = 10.0
"""Force whose arrow has half that length [N]: shows light touches, and fits crushing forces."""


@dataclass(frozen=True, slots=True)
class ObjectPart(Value):
    """A rigid part of an object.

    Attributes:
        kind: ``box``, ``cylinder`` (along z), ``sphere`` or ``mesh``.
        size: Edge lengths; radius and height; or radius [m]; empty for a mesh.
        pose: Position [m] and unit quaternion (w, x, y, z) in the object's frame ``(7,)``.
        vertices: Vertices of a mesh in the part's frame ``(v, 3)`` [m].
        faces: Triangles of a mesh, as indices of vertices ``(f, 3)``.

    Raises:
        ValueError: if the part cannot be drawn.
    """

    kind: str
    size: tuple[float, ...]
    pose: FloatArray
    vertices: NDArray[np.float32] = field(default_factory=lambda: np.zeros((0, 3), np.float32))
    faces: NDArray[np.uint32] = field(default_factory=lambda: np.zeros((0, 3), np.uint32))

    def __post_init__(self) -> None:
        """Check the part, since descriptions arrive over the network and from files."""
        # Comparisons, since NaN fails them; no object in a hand measures a kilometre.
        if KINDS.get(self.kind) != len(self.size) or not all(0.0 < s < 1e3 for s in self.size):
            raise ValueError(f"'{self.kind[:20]}' with {len(self.size)} sizes is not a part")
        if self.pose.shape != (7,) or not np.isfinite(self.pose).all():
            raise ValueError("the pose of a part must be seven finite numbers")
        if not np.isfinite(self.vertices).all():
            raise ValueError("a mesh has a vertex that is not finite")
        if len(self.faces) and int(self.faces.max()) >= len(self.vertices):
            raise ValueError("a mesh has a triangle without vertices")
        if len(self.faces) > MOST_TRIANGLES:
            raise ValueError(f"a mesh has more than {MOST_TRIANGLES} triangles")


@dataclass(frozen=True, slots=True)
class ObjectDescription(Value):
    """An object that a simulated hand grasps.

    Attributes:
        name: The object as written on the command line, such as ``sphere:0.03``; for a mesh, the
            name of its file.
        mass: Mass of the object [kg].
        parts: Rigid parts of the object.
    """

    name: str
    mass: float
    parts: tuple[ObjectPart, ...]


NO_OBJECT: Final = ObjectDescription("", 0.0, ())
"""Represents "no object" in a message."""


def contact_rows(values: FloatArray) -> FloatArray:
    """Return the channel `CONTACTS` as rows ``(k, 7)``; no rows if the values are malformed."""
    if len(values) % CONTACT_COLUMNS or not np.isfinite(values).all():
        return np.zeros((0, CONTACT_COLUMNS))
    return values.reshape(-1, CONTACT_COLUMNS)


def force_arrows(forces: FloatArray) -> FloatArray:
    """Return the arrows ``(..., 3)`` that stand for forces ``(..., 3)`` [N] in pictures.

    Their lengths are shares of the hand's size, and saturate, so that a hard contact's arrow stays
    in the picture.
    """
    strength = np.linalg.norm(forces, axis=-1, keepdims=True)
    arrows: FloatArray = _LONGEST * forces / (strength + _HALF)
    return arrows
