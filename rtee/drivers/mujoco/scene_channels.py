"""Visible parts of a running simulation besides the hand: the object, and contact forces."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Final

import mujoco
import numpy as np
from numpy.typing import NDArray

from rtee.drivers.mujoco.objects import MESHES, OBJECT
from rtee.drivers.mujoco.options import SimOptions
from rtee.drivers.mujoco.pairs import LINK
from rtee.drivers.mujoco.solids import solid_of, turn_of
from rtee.drivers.mujoco.surroundings import Surroundings, pose_vector
from rtee.hand.model import Hand
from rtee.objects.description import (
    BASE_POSE,
    CONTACT_COLUMNS,
    CONTACT_RATE,
    CONTACTS,
    MOST_CONTACTS,
    MOST_TRIANGLES,
    OBJECT_POSE,
    ObjectDescription,
    ObjectPart,
)
from rtee.objects.shape import parse_object
from rtee.sample import FloatArray

_LEAST_FORCE: Final = 1e-3
"""Weaker contacts are left out [N]: they cannot be seen, and touching links have many."""


class SceneChannels:
    """Reads the poses of the object and of the carried hand, and the contact forces.

    Args:
        model: The compiled model.
        data: Its state.
        hand: The hand in it.
        around: The hand's surroundings.
        options: How it is simulated.
    """

    def __init__(
        self,
        model: mujoco.MjModel,
        data: mujoco.MjData,
        hand: Hand,
        around: Surroundings,
        options: SimOptions,
    ) -> None:
        self._data, self._around = data, around
        self._carried = options.carrier != "fixed"
        place = {link: index for index, link in enumerate(hand.urdf.links)}
        names = [model.body(int(body)).name.removeprefix(LINK) for body in model.geom_bodyid]
        of_hand = [model.body(int(body)).name.startswith(LINK) for body in model.geom_bodyid]
        self._link = np.array(
            [place.get(name, -1) if own else -1 for name, own in zip(names, of_hand, strict=True)]
        )
        self._renewed = -math.inf
        self._contacts: FloatArray = np.zeros(0)

    def read(self) -> dict[str, FloatArray]:
        """Return the channels; see `rtee.objects.description`. Contacts come at `CONTACT_RATE`."""
        found: dict[str, FloatArray] = {}
        if self._around.has_object:
            found[OBJECT_POSE] = self._around.pose
        if self._carried:
            found[BASE_POSE] = pose_vector(self._around.base_pose)
        # Contacts are also computed again after a reset, which sets the time back to 0.
        if not 0.0 <= self._data.time - self._renewed < 1.0 / CONTACT_RATE - 1e-9:
            self._renewed = self._data.time
            self._contacts = self._forces()
        return {**found, CONTACTS: self._contacts}

    def _forces(self) -> FloatArray:
        """Return the strongest contacts of the hand, row after row."""
        contact = self._data.contact
        first = contact.efc_address
        links = self._link[contact.geom].reshape(-1, 2)
        # A contact that is only within the margin has no rows in the solver, and no force.
        seen = np.flatnonzero((first >= 0) & (links >= 0).any(axis=1))
        if not len(seen):
            return np.zeros(0)
        links = links[seen]
        # The first three rows of an elliptic contact are its force in its own frame.
        own = self._data.efc_force[first[seen, None] + np.arange(3)]
        force = np.einsum("kij,ki->kj", contact.frame[seen].reshape(-1, 3, 3), own)
        second = links[:, 0] < 0  # the hand's link is the second one: it exerts the opposite
        force[second] *= -1.0
        link = np.where(second, links[:, 1], links[:, 0])
        strength = np.linalg.norm(force, axis=1)
        # Stable, so that equal forces keep their order and two runs give equal recordings.
        order = np.argsort(-strength, kind="stable")[:MOST_CONTACTS]
        order = order[strength[order] >= _LEAST_FORCE]
        base = self._around.base_pose
        rows = np.empty((len(order), CONTACT_COLUMNS))
        rows[:, :3] = (contact.pos[seen[order]] - base[:3, 3]) @ base[:3, :3]
        rows[:, 3:6] = force[order] @ base[:3, :3]
        rows[:, 6] = link[order]
        return rows.ravel()


def describe(
    model: mujoco.MjModel, data: mujoco.MjData, options: SimOptions
) -> ObjectDescription | None:
    """Return the appearance of a model's object; ``None`` if it has none.

    Moving parts, such as a drill's trigger, have their present poses in ``data``, which must have
    been computed.
    """
    body = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_BODY, OBJECT)
    if body < 0:
        return None
    turn, at = data.xmat[body].reshape(3, 3), data.xpos[body]
    parts = []
    for geom in np.flatnonzero(model.body_rootid[model.geom_bodyid] == body):
        pose = np.eye(4)
        pose[:3, :3] = turn.T @ data.geom_xmat[geom].reshape(3, 3)
        pose[:3, 3] = turn.T @ (data.geom_xpos[geom] - at)
        parts += _parts(model, int(geom), pose)
    return ObjectDescription(_name(options), float(model.body_subtreemass[body]), tuple(parts))


def _name(options: SimOptions) -> str:
    """Return the object's name; for a mesh only the file's name, since clients see it."""
    if not options.object:
        return OBJECT
    shape = parse_object(options.object, MESHES).scaled(options.object_scale)
    return shape.name if shape.path is None else Path(shape.path).name


def _parts(model: mujoco.MjModel, geom: int, pose: FloatArray) -> list[ObjectPart]:
    """Return the appearance of a geom at a pose ``(4, 4)`` in the object's frame."""
    # The shape is smaller than the object by its skin.
    at, skin = pose_vector(pose), float(model.geom_margin[geom])
    kind, size = solid_of(model, geom, skin)
    if kind == "capsule":
        # Clients know no capsules: a cylinder and a sphere at each end.
        radius, length = size
        tube = [ObjectPart("cylinder", size, at)] if length > 0.0 else []
        ends = (pose @ _raised(0.5 * z) for z in (-length, length))
        return tube + [ObjectPart("sphere", (radius,), pose_vector(end)) for end in ends]
    if kind:
        return [ObjectPart(kind, size, at)]
    return [ObjectPart("mesh", (), at, *_mesh(model, int(model.geom_dataid[geom]), skin))]


def _raised(z: float) -> FloatArray:
    pose = np.eye(4)
    pose[2, 3] = z
    return pose


def _mesh(
    model: mujoco.MjModel, mesh: int, skin: float
) -> tuple[NDArray[np.float32], NDArray[np.uint32]]:
    """Return the vertices and triangles of a mesh, or of its hull if it has too many.

    The mesh is enlarged, along its file's axes, by the skin [m] by which it was shrunk.
    """
    first, count = model.mesh_vertadr[mesh], model.mesh_vertnum[mesh]
    turn = turn_of(model.mesh_quat[mesh])
    inside = model.mesh_vert[first : first + count] @ turn.T
    least, most = inside.min(axis=0), inside.max(axis=0)
    middle, half = 0.5 * (least + most), 0.5 * (most - least)
    outside = middle + (inside - middle) * (1.0 + skin / half)
    vertices = np.array(outside @ turn, dtype=np.float32)
    first, count = model.mesh_faceadr[mesh], model.mesh_facenum[mesh]
    faces = np.array(model.mesh_face[first : first + count], dtype=np.uint32)
    if len(faces) > MOST_TRIANGLES:
        faces = _hull(model, mesh)[:MOST_TRIANGLES]
    used, corners = np.unique(faces, return_inverse=True)
    return vertices[used], corners.reshape(-1, 3).astype(np.uint32)


def _hull(model: mujoco.MjModel, mesh: int) -> NDArray[np.uint32]:
    """Return the triangles of a mesh's convex hull, the shape used for contacts.

    They are the last part of MuJoCo's graph of the hull, after two counts, three numbers for each
    vertex and three for each triangle.
    """
    graph = model.mesh_graph[model.mesh_graphadr[mesh] :]
    vertices, triangles = int(graph[0]), int(graph[1])
    begin = 2 + 3 * vertices + 3 * triangles
    return np.array(graph[begin : begin + 3 * triangles], dtype=np.uint32).reshape(-1, 3)
