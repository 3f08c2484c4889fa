"""The object in a simulated hand, and the contact forces, in the browser's scene."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any, Final

import numpy as np
import viser

from rtee.gui.colours import FORCE, OBJECT
from rtee.hand.frames import pose_in_hand
from rtee.objects.description import (
    CONTACTS,
    ObjectDescription,
    ObjectPart,
    contact_rows,
)
from rtee.sample import FloatArray

_UNSEEN: Final = 1e-4
"""Largest motion of the object that is not drawn [m, and per component of the quaternion]."""

_LONGEST: Final = 0.35
"""Length that arrows approach at large forces, as a share of the hand's size."""

_HALF: Final = 10.0
"""Force of an arrow of half that length [N]: light touches show, and crushing ones fit."""

_CLEAR: Final = 0.6
"""Opacity of the object, which lets the arrows of the forces inside it show."""

_SHARP: Final = 0.25
"""Least change of forces [N] or points [mm] that is drawn: smaller ones would only flicker."""


class ObjectView:
    """The object at its pose relative to the hand, both taken from the channels of the states.

    ``size`` is that of the hand [m].
    """

    def __init__(self, scene: viser.SceneApi, size: float) -> None:
        self._scene, self._size = scene, size
        self._described: ObjectDescription | None = None
        self._frame: viser.FrameHandle | None = None
        self._pose = np.full(7, np.nan)
        self._arrows: viser.ArrowsHandle | None = None
        self._drawn: FloatArray = np.zeros((0, 7))

    @property
    def described(self) -> ObjectDescription | None:
        """The object that is drawn."""
        return self._described

    def describe(self, description: ObjectDescription | None) -> None:
        """Draw another object, or none; it appears with the next channels."""
        if description is self._described:
            return
        if self._frame is not None:
            self._frame.remove()
            self._frame = None
        self._described = description
        self._pose = np.full(7, np.nan)
        if description is not None:
            self._frame = self._scene.add_frame("/object", show_axes=False, visible=False)
            for index, part in enumerate(description.parts):
                _add(self._scene, f"/object/{index}", part)

    def show(self, channels: Mapping[str, FloatArray], *, forces: bool) -> None:
        """Move the object to its pose in the channels of a state, and draw the contact forces."""
        by_kind = {name.rpartition("/")[2]: values for name, values in channels.items()}
        pose = pose_in_hand(by_kind)
        if self._frame is not None:
            self._place(self._frame, pose)
        rows = contact_rows(by_kind.get(CONTACTS, np.zeros(0))) if forces else self._drawn[:0]
        self._draw_forces(rows)

    def _place(self, frame: viser.FrameHandle, pose: FloatArray | None) -> None:
        if frame.visible != (pose is not None):
            frame.visible = pose is not None
        # The pose drawn is NaN at first, for which the comparison is false.
        if pose is None or np.abs(pose - self._pose).max() < _UNSEEN:
            return
        self._pose = pose
        frame.position, frame.wxyz = pose[:3], pose[3:]

    def _draw_forces(self, rows: FloatArray) -> None:
        drawn = self._drawn
        if rows.shape == drawn.shape:
            moved = np.abs(rows[:, :3] - drawn[:, :3]).max(initial=0.0) * 1e3
            if max(moved, np.abs(rows[:, 3:6] - drawn[:, 3:6]).max(initial=0.0)) < _SHARP:
                return
        self._drawn = rows
        if self._arrows is not None:
            self._arrows.remove()
            self._arrows = None
        if len(rows):
            self._arrows = self._scene.add_arrows(
                "/forces",
                arrows_of(rows, self._size).astype(np.float32),
                FORCE,
                shaft_radius=0.008 * self._size,
                head_radius=0.02 * self._size,
                head_length=0.045 * self._size,
            )

    def summary(self, links: Sequence[str]) -> str:
        """Return the strongest drawn contacts as text; see `strongest`."""
        return strongest(self._drawn, links)

    def remove(self) -> None:
        """Remove object and forces from the scene."""
        self.describe(None)
        self._draw_forces(self._drawn[:0])


def arrows_of(rows: FloatArray, size: float) -> FloatArray:
    """Return arrows ``(k, 2, 3)`` from the contact points along the forces [m].

    The length of an arrow grows with the force F as F / (F + 10 N), and with the size of the hand
    [m]. The contacts are rows of `rtee.objects.description.CONTACTS`.
    """
    points, forces = rows[:, :3], rows[:, 3:6]
    strength = np.linalg.norm(forces, axis=1, keepdims=True)
    length = _LONGEST * size * strength / (strength + _HALF)
    # The least divisor keeps 0/0 from becoming NaN for a contact without force.
    shafts = forces / np.maximum(strength, math.ulp(1.0)) * length
    return np.stack([points, points + shafts], axis=1)


def strongest(rows: FloatArray, links: Sequence[str], most: int = 3) -> str:
    """Return the strongest contacts as text: ``index_tip 3.2 N, thumb_tip 3.1 N``.

    The contacts are rows of `rtee.objects.description.CONTACTS`, the links in the order of the
    URDF; at most so many are named.
    """
    totals: dict[str, FloatArray] = {}
    for row in rows:
        index = int(row[6])
        if 0 <= index < len(links):
            totals[links[index]] = totals.get(links[index], np.zeros(3)) + row[3:6]
    forces = {name: float(np.linalg.norm(force)) for name, force in totals.items()}
    chosen = sorted(forces, key=lambda name: -forces[name])[:most]
    return ", ".join(f"{name} {forces[name]:.1f} N" for name in chosen)


def _add(scene: viser.SceneApi, name: str, part: ObjectPart) -> None:
    at: dict[str, Any] = {"wxyz": part.pose[3:], "position": part.pose[:3], "opacity": _CLEAR}
    match part.kind:
        case "box":
            w, d, h = part.size
            scene.add_box(name, color=OBJECT, dimensions=(w, d, h), **at)
        case "cylinder":
            scene.add_cylinder(name, part.size[0], part.size[1], OBJECT, **at)
        case "sphere":
            scene.add_icosphere(name, part.size[0], OBJECT, **at)
        case _:
            scene.add_mesh_simple(
                name,
                part.vertices,
                part.faces,
                color=OBJECT,
                flat_shading=True,
                side="double",
                **at,
            )
