"""Pictures of a recording: the hand, the grasped object, and the contact forces."""

from __future__ import annotations

from pathlib import Path
from typing import Final

import numpy as np

from rtee.errors import LogError
from rtee.hand.files import temporary_folder
from rtee.hand.frames import homogeneous, pose_in_hand, pose_matrix
from rtee.hand.geometry import HandGeometry
from rtee.hand.load import load_hand
from rtee.hand.model import Hand
from rtee.hand.tessellation import Triangles, cylinder, solid
from rtee.log.playback import write_hand
from rtee.log.recording import Recording, row_at
from rtee.objects.description import CONTACTS, ObjectPart, contact_rows, force_arrows
from rtee.render.camera import choose_view, fit_camera
from rtee.render.hand import link_colours
from rtee.render.image import encode, linear_rgb
from rtee.render.mesh import HandMesh, Mesh
from rtee.render.raycast import RayCaster, check_pictures
from rtee.render.renderer import Renderer, Shading
from rtee.render.strip import SIZE, write_strip
from rtee.sample import FloatArray

MOST: Final = 6
"""Pictures of one recording: a row of them fits across a page."""

_OBJECT: Final = "#bd9970"
_FORCE: Final = "#a3195b"
_THICK: Final = 0.006
"""Radius of an arrow's shaft, as a share of the hand's size."""


def write_pictures(recording: Recording, path: Path) -> bool:
    """Write a strip of pictures, before the first action and at the end of each.

    Returns:
        Whether there is an object to be seen; without one no file is written.

    Raises:
        MissingExtra: if the extra ``plot`` is not installed.
        ConfigError: if the file cannot be written.
        LogError: if the recording does not hold its hand.
    """
    if recording.object_description is None or not len(recording.actuator_states):
        return False
    with temporary_folder(recording.paths[0]) as folder:
        hand = load_hand(write_hand(recording, folder))
        strip = _Strip(recording, hand)
        write_strip(path, [(caption, strip.picture(at)) for caption, at in moments(recording)])
    return True


def moments(recording: Recording) -> list[tuple[str, float]]:
    """Return the moments to draw: captions and times since the recording's start [s]."""
    spans = recording.spans
    if not spans:
        return [("at the end", recording.duration)]
    found = [("before", spans[0].start)]
    found += [(f"{span.name}: {span.outcome}", span.end) for span in spans]
    if recording.duration > spans[-1].end + 0.5:  # what was done with the object afterwards
        found.append(("at the end", recording.duration))
    return found if len(found) <= MOST else [*found[: MOST - 1], found[-1]]


class _Strip:
    """Draws the states of one recording, always from the same place."""

    def __init__(self, recording: Recording, hand: Hand) -> None:
        check_pictures()
        self._recording = recording
        states = recording.actuator_states
        if set(states.names) != set(hand.actuator_names):
            raise LogError("does not contain its hand", path=recording.paths[0])
        # A recording may list the actuators in another order than the hand.
        self._order = [states.names.index(name) for name in hand.actuator_names]
        self._mesh = HandMesh(HandGeometry(hand, visual=True))
        obj = recording.object_description
        links = len(self._mesh.links)
        parts = [_triangles(part) for part in obj.parts] if obj is not None else []
        self._parts = [(Mesh.of(triangles, links), place) for triangles, place in parts]
        colours = [*link_colours(hand, self._mesh.links), linear_rgb(_OBJECT), linear_rgb(_FORCE)]
        self._force = links + 1
        back, up = choose_view(self._mesh.geometry)[:2]
        self._size = float(
            np.linalg.norm(np.ptp(self._hand_at(0.0).corners.reshape(-1, 3), axis=0))
        )
        seen = [self._at(at).corners.reshape(-1, 3) for _, at in moments(recording)[:2]]
        camera = fit_camera(np.concatenate(seen), back, up, SIZE)
        self._camera = camera
        self._shading = Shading.studio(np.array(colours), camera, up, self._size)

    def picture(self, at: float) -> bytes:
        """Return a PNG picture of the state at a time [s]."""
        caster = RayCaster(self._at(at))
        picture = Renderer(caster, self._camera, self._shading).render()
        return encode(picture, "#ffffff", self._camera, (), "PNG")

    def _hand_at(self, at: float) -> Mesh:
        states = self._recording.actuator_states
        return self._mesh.at(states.position[row_at(states.t, at), self._order])

    def _at(self, at: float) -> Mesh:
        meshes = [self._hand_at(at)]
        channels = {
            name.rpartition("/")[2]: channel.values[row_at(channel.t, at)]
            for name, channel in self._recording.channels.items()
        }
        pose = pose_in_hand(channels)
        if pose is not None:
            meshes += [part.placed(pose_matrix(pose) @ place) for part, place in self._parts]
        for row in contact_rows(channels.get(CONTACTS, np.zeros(0))):
            length = self._size * float(np.linalg.norm(force_arrows(row[3:6])))
            if length > 0.0:
                shaft = Mesh.of(cylinder(_THICK * self._size, length), self._force)
                meshes.append(shaft.placed(_along(row[:3], row[3:6], length)))
        return Mesh.joined(meshes)


def _along(point: FloatArray, force: FloatArray, length: float) -> FloatArray:
    """Return the pose of a shaft along z that ends at a point, where a force presses."""
    z = force / np.linalg.norm(force)
    # The base axis most across z, so that the product is never near 0.
    x = np.cross(z, np.eye(3)[int(np.argmin(np.abs(z)))])
    x /= np.linalg.norm(x)
    return homogeneous(np.stack([x, np.cross(z, x), z], axis=1), point - 0.5 * length * z)


def _triangles(part: ObjectPart) -> tuple[Triangles, FloatArray]:
    """Return the triangles of a part, and its pose ``(4, 4)`` in the object's frame."""
    pose = pose_matrix(part.pose)
    if part.kind != "mesh":
        return solid(part.kind, part.size), pose
    return (np.asarray(part.vertices, np.float64), np.asarray(part.faces, np.int64)), pose
