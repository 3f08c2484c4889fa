"""Objects to grasp: a box, a cylinder, a sphere or a mesh."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path

import mujoco

from rtee.errors import ConfigError
from rtee.types import FloatArray

OBJECT = "object"
"""Name of the object's body, joint and geom."""

_FORMS = "box:WxDxH, cylinder:RADIUSxHEIGHT, sphere:RADIUS (in metres), or the path of a mesh"
_NUMBERS = {"box": 3, "cylinder": 2, "sphere": 1}
_LARGEST = 2.0
_MESHES = (".stl", ".obj")


@dataclass(frozen=True, slots=True)
class ObjectShape:
    """The shape of an object.

    Attributes:
        kind: ``box``, ``cylinder``, ``sphere`` or ``mesh``.
        size: Edge lengths, radius and height, or radius [m]; empty for a mesh.
        path: The mesh file.
    """

    kind: str
    size: tuple[float, ...] = ()
    path: Path | None = None

    @property
    def name(self) -> str:
        """A short name, such as ``sphere:0.03``."""
        if self.path is not None:
            return self.path.stem
        return f"{self.kind}:{'x'.join(f'{value:g}' for value in self.size)}"

    @property
    def half_height(self) -> float:
        """Half its height along its z axis [m]; 0 for a mesh, which is placed by its own origin."""
        match self.kind:
            case "box" | "cylinder":
                return 0.5 * self.size[-1]
            case "sphere":
                return self.size[0]
        return 0.0


def parse_object(text: str) -> ObjectShape:
    """Read an object as it is written on the command line.

    Raises:
        ConfigError: if it is none of the forms there are.
    """
    kind, _, numbers = text.partition(":")
    if kind in _NUMBERS and numbers:
        try:
            size = tuple(float(part) for part in numbers.split("x"))
        except ValueError:
            size = ()
        if len(size) != _NUMBERS[kind] or not all(
            math.isfinite(value) and 0.0 < value <= _LARGEST for value in size
        ):
            raise ConfigError(f"'{text}' is no object; write {_FORMS}, each number up to 2")
        return ObjectShape(kind, size)
    path = Path(text)
    if path.suffix.lower() not in _MESHES:
        raise ConfigError(f"'{text}' is no object; write {_FORMS} (.stl, .obj)")
    if not path.is_file():
        raise ConfigError("no such mesh", path=path)
    return ObjectShape("mesh", path=path)


def add_object(
    spec: mujoco.MjSpec,
    shape: ObjectShape,
    *,
    mass: float,
    position: FloatArray,
    friction: float = 0.8,
) -> mujoco.MjsBody:
    """Add a free object to a model.

    Args:
        spec: The model.
        shape: What it looks like.
        mass: Its mass [kg].
        position: Where its middle is ``(3,)`` [m], in the world's frame.
        friction: Its sliding friction.

    Returns:
        Its body.
    """
    body = spec.worldbody.add_body(name=OBJECT, pos=position)
    body.add_freejoint(name=OBJECT)
    geom = body.add_geom(name=OBJECT, mass=mass, friction=[friction, 0.01, 1e-3], condim=4)
    geom.rgba = [0.90, 0.62, 0.0, 1.0]
    match shape.kind:
        case "box":
            geom.type = mujoco.mjtGeom.mjGEOM_BOX
            geom.size = [0.5 * value for value in shape.size]
        case "cylinder":
            geom.type = mujoco.mjtGeom.mjGEOM_CYLINDER
            geom.size = [shape.size[0], 0.5 * shape.size[1], 0.0]
        case "sphere":
            geom.type = mujoco.mjtGeom.mjGEOM_SPHERE
            geom.size = [shape.size[0], 0.0, 0.0]
        case _:
            mesh = spec.add_mesh(name=OBJECT, file=str(shape.path))
            mesh.inertia = mujoco.mjtMeshInertia.mjMESH_INERTIA_CONVEX
            geom.type = mujoco.mjtGeom.mjGEOM_MESH
            geom.meshname = OBJECT
    return body
