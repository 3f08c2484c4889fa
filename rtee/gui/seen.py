"""The object that a simulated hand grasps, and contact forces, in the browser's scene."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any, Final

import numpy as np
import viser

from rtee.gui.colours import FORCE, OBJECT, Colour
from rtee.hand.frames import pose_in_hand
from rtee.object_description import (
    CONTACTS,
    ObjectDescription,
    ObjectPart,
    contact_rows,
)
from rtee.sample import FloatArray

_UNSEEN: Final = 1e-4
"""Motion of the object that cannot be seen on the screen [m, or parts of a turn]."""

_LONGEST: Final = 0.35
"""Length of the longest arrow, as a share of the hand's size."""

_HALF: Final = 10.0
"""Force of an arrow of half that length [N]: light touches are seen, and crushing ones fit."""

_CLEAR: Final = 0.6
"""Opacity of the object: the arrows of the forces on it are inside."""

_SHARP: Final = 0.25
"""Change of forces that is drawn at least [N], or of points [mm]: others would flicker."""


class ObjectView:
    """Draws the object where the channels of the states put it, relative to the hand.

    Args:
        scene: The browser's scene.
        size: Size of the hand [m].
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
        """What is drawn."""
        return self._described

    def describe(self, thing: ObjectDescription | None) -> None:
        """Draw another object from now on, or none; it appears with the next channels."""
        if thing is self._described:
            return
        if self._frame is not None:
            self._frame.remove()
            self._frame = None
        self._described = thing
        self._pose = np.full(7, np.nan)
        if thing is not None:
            self._frame = self._scene.add_frame("/object", show_axes=False, visible=False)
            for index, part in enumerate(thing.parts):
                _add(self._scene, f"/object/{index}", part, OBJECT)

    def show(self, channels: Mapping[str, FloatArray], *, forces: bool) -> None:
        """Put the object where it is, and draw the contact forces.

        Args:
            channels: The further channels of a state.
            forces: Whether forces are drawn.
        """
        found = {name.rpartition("/")[2]: values for name, values in channels.items()}
        pose = pose_in_hand(found)
        if self._frame is not None:
            self._place(self._frame, pose)
        rows = contact_rows(found.get(CONTACTS, np.zeros(0))) if forces else self._drawn[:0]
        self._draw_forces(rows)

    def _place(self, frame: viser.FrameHandle, pose: FloatArray | None) -> None:
        if frame.visible != (pose is not None):
            frame.visible = pose is not None
        # At first the pose drawn is NaN, which compares as false: the object is placed.
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

    def said(self, links: Sequence[str]) -> str:
        """Return the strongest contacts that are drawn, in words; see `strongest`."""
        return strongest(self._drawn, links)

    def remove(self) -> None:
        """Remove it from the scene."""
        self.describe(None)
        self._draw_forces(self._drawn[:0])


def arrows_of(rows: FloatArray, size: float) -> FloatArray:
    """Return arrows ``(k, 2, 3)`` that begin at the contact points [m].

    An arrow's length grows with its force, less and less.

    Args:
        rows: The contacts; see `rtee.object_description.CONTACTS`.
        size: Size of the hand [m].
    """
    points, forces = rows[:, :3], rows[:, 3:6]
    strength = np.linalg.norm(forces, axis=1, keepdims=True)
    length = _LONGEST * size * strength / (strength + _HALF)
    # A contact without force has no direction either: 0/0 would be NaN.
    ways = forces / np.maximum(strength, math.ulp(1.0)) * length
    return np.stack([points, points + ways], axis=1)


def strongest(rows: FloatArray, links: Sequence[str], most: int = 3) -> str:
    """Return the strongest contacts in words: ``index_tip 3.2 N, thumb_tip 3.1 N``.

    Args:
        rows: The contacts; see `rtee.object_description.CONTACTS`.
        links: Names of the links, in the order of the URDF.
        most: How many links are named.
    """
    totals: dict[str, FloatArray] = {}
    for row in rows:
        index = int(row[6])
        if 0 <= index < len(links):
            totals[links[index]] = totals.get(links[index], np.zeros(3)) + row[3:6]
    forces = {name: float(np.linalg.norm(force)) for name, force in totals.items()}
    chosen = sorted(forces, key=lambda name: -forces[name])[:most]
    return ", ".join(f"{name} {forces[name]:.1f} N" for name in chosen)


def _add(scene: viser.SceneApi, name: str, part: ObjectPart, colour: Colour) -> None:
    at: dict[str, Any] = {"wxyz": part.pose[3:], "position": part.pose[:3], "opacity": _CLEAR}
    match part.kind:
        case "box":
            w, d, h = part.size
            scene.add_box(name, color=colour, dimensions=(w, d, h), **at)
        case "cylinder":
            scene.add_cylinder(name, part.size[0], part.size[1], colour, **at)
        case "sphere":
            scene.add_icosphere(name, part.size[0], colour, **at)
        case _:
            scene.add_mesh_simple(
                name,
                part.vertices,
                part.faces,
                color=colour,
                flat_shading=True,
                side="double",
                **at,
            )
