"""A hand as a tree of frames in the browser's scene, so that a moving joint sends one frame."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import viser

from rtee.gui.colours import Colour
from rtee.gui.shapes import LinkTriangles
from rtee.hand.frames import quaternion, turn
from rtee.hand.model import Hand
from rtee.hand.urdf import Urdf, UrdfGeometry, UrdfJoint
from rtee.sample import FloatArray

_UNSEEN = 1e-4
"""Largest motion of a joint that is not sent [rad | m]: it would not show on the screen."""


class HandBody:
    """One appearance of a hand in the scene, the measured one or a ghost, by names of frames."""

    def __init__(
        self,
        scene: viser.SceneApi,
        root: str,
        hand: Hand,
        triangles: LinkTriangles,
        colours: Mapping[str, Colour],
        *,
        opacity: float | None = None,
        visible: bool = True,
    ) -> None:
        """Build the tree of frames below a root frame; a body without an opacity is solid."""
        self.root = root
        self._scene = scene
        self._opacity = opacity
        self._frame = scene.add_frame(root, show_axes=False, visible=visible)
        self._moving: list[tuple[viser.FrameHandle, FloatArray, bool]] = []
        self._last = np.full(len(hand.joints), np.nan)
        self.frames: dict[str, str] = {}
        self._build(hand, triangles, colours)

    def _build(self, hand: Hand, triangles: LinkTriangles, colours: Mapping[str, Colour]) -> None:
        urdf = hand.urdf
        below: dict[str, list[UrdfJoint]] = {}
        for joint in urdf.joints.values():
            below.setdefault(joint.parent, []).append(joint)
        frames: dict[str, tuple[viser.FrameHandle, FloatArray, bool]] = {}
        pending = [(urdf.root, self.root)]
        while pending:
            link, path = pending.pop()
            self.frames[link] = path
            self._add_shapes(urdf, link, path, triangles, colours[link])
            for joint in below.get(link, ()):
                place = f"{path}/{joint.name}"
                self._scene.add_frame(
                    place, show_axes=False, wxyz=quaternion(joint.rpy), position=joint.xyz
                )
                if joint.moving:
                    place = f"{place}/q"  # the frame that moves, below the fixed one of the joint
                    frame = self._scene.add_frame(place, show_axes=False)
                    frames[joint.name] = (frame, np.array(joint.axis), joint.kind == "prismatic")
                pending.append((joint.child, place))
        self._moving = [frames[name] for name in hand.joint_names]

    def _add_shapes(
        self, urdf: Urdf, link: str, path: str, triangles: LinkTriangles, colour: Colour
    ) -> None:
        shapes = urdf.links[link].collisions
        # The browser draws simple shapes from their sizes; only meshes are sent as triangles.
        if not any(shape.kind == "mesh" for shape in shapes):
            for index, shape in enumerate(shapes):
                self._add_shape(f"{path}/shape{index}", shape, colour)
        else:
            vertices, faces = triangles(link)
            self._scene.add_mesh_simple(
                f"{path}/mesh",
                np.asarray(vertices, dtype=np.float32),
                np.asarray(faces, dtype=np.uint32),
                color=colour,
                opacity=self._opacity,
                flat_shading=True,
                side="double",
                cast_shadow=self._opacity is None,
            )

    def _add_shape(self, name: str, shape: UrdfGeometry, colour: Colour) -> None:
        at: dict[str, Any] = {
            "wxyz": quaternion(shape.rpy),
            "position": shape.xyz,
            "opacity": self._opacity,
            "cast_shadow": self._opacity is None,
        }
        if shape.kind == "box":
            self._scene.add_box(name, color=colour, dimensions=shape.size, **at)
        elif shape.kind == "sphere":
            self._scene.add_icosphere(name, shape.radius, colour, **at)
        else:
            self._scene.add_cylinder(name, shape.radius, shape.length, colour, **at)

    @property
    def visible(self) -> bool:
        """Whether the body is visible."""
        return bool(self._frame.visible)

    @visible.setter
    def visible(self, shown: bool) -> None:
        # viser sends each assignment to every window.
        if shown != self._frame.visible:
            self._frame.visible = shown

    def moved(self, position: FloatArray) -> list[int]:
        """Return the indices of joints that would visibly move to positions ``(m,)`` [rad | m]."""
        # "Not less", so that NaN, before the first drawing, counts as a motion.
        seen = np.isfinite(position) & ~(np.abs(position - self._last) < _UNSEEN)
        indices: list[int] = np.flatnonzero(seen).tolist()
        return indices

    def set_joints(self, position: FloatArray) -> None:
        """Move to joint positions ``(m,)`` [rad | m]; send only joints that visibly move."""
        for index in self.moved(position):
            frame, axis, slides = self._moving[index]
            # The last position sent, not measured: a slow motion adds up until it shows.
            value = self._last[index] = float(position[index])
            if slides:
                frame.position = value * axis
            else:
                frame.wxyz = turn(axis, value)

    def remove(self) -> None:
        """Remove the body from the scene."""
        self._frame.remove()
