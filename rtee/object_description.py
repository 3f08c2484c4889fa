"""What an object that a simulated hand grasps looks like: for pictures, recordings and clients.

Where it is, and what presses on it, changes all the time and comes in channels of the device:
`OBJECT_POSE`, `BASE_POSE` and `CONTACTS`.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Final

import numpy as np
from numpy.typing import NDArray

from rtee.sample import FloatArray

OBJECT_POSE: Final = "object_pose"
"""Channel: position [m] and unit quaternion (w, x, y, z) of the object in the world ``(7,)``."""

BASE_POSE: Final = "base_pose"
"""Channel: the same of the hand's base frame, where something carries the hand; else they are one.
"""

CONTACTS: Final = "contacts"
"""Channel: a row of `CONTACT_COLUMNS` numbers for each contact of the hand, the strongest first."""

CONTACT_COLUMNS: Final = 7
"""A point [m] and the force [N] that the link exerts there, both in the hand's base frame, and the
link's place among the links of the URDF."""

MOST_CONTACTS: Final = 32
"""Contacts in the channel: more than a picture can show, and 1.8 kB."""

CONTACT_RATE: Final = 30.0
"""Contacts are renewed this often [Hz]: as often as the browser draws."""

KINDS: Final = {"box": 3, "cylinder": 2, "sphere": 1, "mesh": 0}
"""Kinds of parts with the number of their sizes."""

MOST_TRIANGLES: Final = 20_000
"""Triangles of a part: a message of 0.5 MB. A mesh that has more is described by its hull."""


def _none() -> NDArray[np.uint32]:
    return np.zeros((0, 3), np.uint32)


@dataclass(frozen=True, slots=True, eq=False)
class ObjectPart:
    """A rigid part of an object.

    Attributes:
        kind: ``box``, ``cylinder`` (along z), ``sphere`` or ``mesh``.
        size: Edge lengths; radius and height; or radius [m]; nothing for a mesh.
        pose: Position [m] and unit quaternion (w, x, y, z) in the object's frame ``(7,)``.
        vertices: Those of a mesh ``(v, 3)`` [m], in the part's frame.
        faces: Its triangles ``(f, 3)``.

    Raises:
        ValueError: if it cannot be drawn.
    """

    kind: str
    size: tuple[float, ...]
    pose: FloatArray
    vertices: NDArray[np.float32] = field(default_factory=lambda: np.zeros((0, 3), np.float32))
    faces: NDArray[np.uint32] = field(default_factory=_none)

    def __post_init__(self) -> None:
        """Check it: descriptions come over the network and from files."""
        if KINDS.get(self.kind) != len(self.size) or not all(0.0 < s < 1e3 for s in self.size):
            raise ValueError(f"'{self.kind[:20]}' with {len(self.size)} sizes is not a part")
        if self.pose.shape != (7,) or not np.isfinite(self.pose).all():
            raise ValueError("the pose of a part is seven finite numbers")
        if not np.isfinite(self.vertices).all():
            raise ValueError("a mesh has a vertex that is not finite")
        if len(self.faces) and int(self.faces.max()) >= len(self.vertices):
            raise ValueError("a mesh has a triangle without vertices")
        if len(self.faces) > MOST_TRIANGLES:
            raise ValueError(f"a mesh has more than {MOST_TRIANGLES} triangles")


@dataclass(frozen=True, slots=True, eq=False)
class ObjectDescription:
    """An object that a simulated hand grasps.

    Attributes:
        name: How it is written on the command line, such as ``sphere:0.03``; the name of a mesh's
            file.
        mass: Its mass [kg].
        parts: What it is made of.
    """

    name: str
    mass: float
    parts: tuple[ObjectPart, ...]


NO_OBJECT: Final = ObjectDescription("", 0.0, ())
"""Stands for none in a message."""


def contact_rows(values: FloatArray) -> FloatArray:
    """Return the channel `CONTACTS` as rows ``(k, 7)``; none if it cannot be read."""
    if len(values) % CONTACT_COLUMNS or not np.isfinite(values).all():
        return np.zeros((0, CONTACT_COLUMNS))
    return values.reshape(-1, CONTACT_COLUMNS)
