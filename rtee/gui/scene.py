"""The 3D view: the measured hand, ghosts of reference and preview, contacts, effort, pressure."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
import viser

from rtee.gui.body import HandBody
from rtee.gui.bridge import Stage
from rtee.gui.colours import (
    CONTACT,
    PREVIEW,
    REFERENCE,
    link_colours,
    ramp,
)
from rtee.gui.shapes import link_triangles
from rtee.gui.simulated_object import ObjectView
from rtee.gui.taxels import TaxelView
from rtee.hand.frames import tip_pose_and_jacobian
from rtee.hand.model import Hand
from rtee.sample import FloatArray

Contact = tuple[tuple[float, float, float], tuple[float, float, float]]
"""A point [m] and a unit normal in the base frame."""

_WHOLE = 1.3
"""Width of a picture by its height below which the width decides how much of the hand is seen."""

_FARTHEST = 2.0
"""Farthest that the camera goes back for that, by the hand's size: beside panels that fold soon."""

_GHOST = 0.35
"""Opacity of a ghost, through which the hand stays visible."""


class HandScene:
    """The hand in the 3D view, with the object, the contact forces and the hand's taxels."""

    def __init__(self, stage: Stage, hand: Hand) -> None:
        """Add a hand to the scene and aim the camera at it."""
        self.hand = hand
        self._stage = stage
        scene = stage.scene
        self._triangles = link_triangles(hand)
        ghost = dict.fromkeys(hand.urdf.links, REFERENCE)
        preview = dict.fromkeys(hand.urdf.links, PREVIEW)
        scene.set_up_direction("+z")
        # Without a graphics card, shadows would cost most of the frame rate.
        scene.configure_default_lights(cast_shadow=False)
        self._body = HandBody(scene, "/hand", hand, self._triangles, link_colours(hand))
        self._reference = HandBody(
            scene, "/reference", hand, self._triangles, ghost, opacity=_GHOST, visible=False
        )
        self._preview = HandBody(
            scene, "/preview", hand, self._triangles, preview, opacity=_GHOST, visible=False
        )
        rest = hand.transmission.joints(hand.rest)
        for body in (self._body, self._reference, self._preview):
            body.set_joints(rest)
        self._contacts: list[viser.IcosphereHandle | viser.ArrowsHandle] = []
        self._pressures: dict[str, viser.IcosphereHandle] = {}
        self._labels: dict[str, viser.LabelHandle] = {}
        self._size = self._aim()
        self.seen = ObjectView(scene, self._size)
        self.taxels = TaxelView(scene, hand, self._body.frames, self._size)

    def _aim(self) -> float:
        """Aim the camera at the hand, and return the hand's size [m]."""
        points = []
        for name, link in self.hand.urdf.links.items():
            if link.collisions:
                pose, _ = tip_pose_and_jacobian(self.hand, name, self.hand.rest)
                points.append(self._triangles(name)[0] @ pose[:3, :3].T + pose[:3, 3])
        cloud = np.concatenate(points) if points else np.zeros((1, 3))
        low, high = cloud.min(axis=0), cloud.max(axis=0)
        size = max(float(np.linalg.norm(high - low)), 0.05)  # a model may have no shapes
        middle = 0.5 * (low + high)
        stage = self._stage
        window = isinstance(stage, viser.ClientHandle)
        camera = stage.camera if window else stage.initial_camera
        # A window that is higher than wide shows less to the sides.
        far = size * min(max(1.0, _WHOLE / stage.camera.aspect if window else 1.0), _FARTHEST)
        camera.position = tuple(middle + far * self._side(middle))
        camera.look_at = tuple(middle)
        # In proportion to the hand, so that a close look at a small one is not clipped.
        camera.near = 0.01 * size
        self._stage.scene.add_grid(
            "/floor",
            width=4.0 * size,
            height=4.0 * size,
            cell_size=0.02 if size < 1.0 else 0.2,
            section_size=0.1 if size < 1.0 else 1.0,
            cell_color=(190, 194, 200),  # to be seen on light and on dark pages
            section_color=(150, 156, 164),
            position=(float(middle[0]), float(middle[1]), float(low[2])),
            plane="xy",
        )
        return size

    def _side(self, middle: FloatArray) -> FloatArray:
        """Return the unit vector from the hand to where one sees what its fingers close on."""
        hand = self.hand
        tips = [finger.tip for finger in hand.fingers if finger.tip is not None]
        if len(tips) < 2:
            return np.array([0.68, 0.59, 0.43])
        reach = np.clip(
            [(a.lower, a.upper) for a in hand.actuators] - hand.rest[:, None], -1.5, 1.5
        )
        closed = hand.rest + np.where(-reach[:, 0] > reach[:, 1], *reach.T)
        at_rest, closing = (
            np.array([tip_pose_and_jacobian(hand, tip, where)[0][:3, 3] for tip in tips])
            for where in (hand.rest, closed)
        )
        centre = at_rest.mean(axis=0)
        # The finger farthest from all others closes against them: the thumb, where there is one.
        apart = at_rest[np.argmax(np.linalg.norm(at_rest - centre, axis=1))] - centre
        apart /= max(float(np.linalg.norm(apart)), 1e-6)
        side = np.cross(centre - middle, apart)
        side /= max(float(np.linalg.norm(side)), 1e-6)
        # Fingers bend to the palm; from there, rather than from the back or from below.
        bends = float(side @ (closing - at_rest).mean(axis=0))
        side *= np.sign(bends if abs(bends) > 1e-3 else side @ (0.1, 0.2, 1.0))
        view = side + 0.5 * apart + (0.0, 0.0, 0.35)
        view[2] = max(view[2], 0.25)
        unit: FloatArray = view / np.linalg.norm(view)
        return unit

    def show(self, position: FloatArray) -> None:
        """Show measured joint positions ``(m,)`` [rad | m]."""
        if self._body.moved(position):
            with self._stage.atomic():
                self._body.set_joints(position)

    def show_reference(self, actuators: FloatArray | None) -> None:
        """Show the reference, actuator positions ``(n,)``, as a ghost; ``None`` hides it."""
        self._ghost(self._reference, actuators)

    def show_preview(self, actuators: FloatArray | None) -> None:
        """Show the target of an action, actuator positions ``(n,)``; ``None`` hides it."""
        self._ghost(self._preview, actuators)

    def _ghost(self, body: HandBody, actuators: FloatArray | None) -> None:
        if actuators is None or not np.isfinite(actuators).all():
            body.visible = False
            return
        body.set_joints(self.hand.transmission.joints(actuators))
        body.visible = True

    def show_fingers(self, said: Mapping[str, str]) -> None:
        """Write something at the tips of fingers, by their names; at the others, nothing."""
        for number, finger in enumerate(self.hand.fingers):
            text, label = said.get(finger.name, ""), self._labels.get(finger.name)
            if label is None and text:
                # Below the link's frame, with which it moves.
                place = f"{self._body.frames[finger.tip or finger.body[-1]]}/label"
                # To the left and the right in turn, so that neighbours cover less of each other.
                label = self._stage.scene.add_label(
                    place,
                    text,
                    font_screen_scale=0.85,
                    anchor="bottom-left" if number % 2 else "bottom-right",
                )
                self._labels[finger.name] = label
            if label is not None and (label.text, label.visible) != (text, bool(text)):
                label.text, label.visible = text, bool(text)

    def show_contacts(self, contacts: Sequence[Contact]) -> None:
        """Mark contact points with their normals [m], in the hand's base frame."""
        for handle in self._contacts:
            handle.remove()
        self._contacts.clear()
        radius = 0.015 * self._size
        for index, (point, normal) in enumerate(contacts):
            where = np.array(point)
            reach = np.array(normal) * 0.12 * self._size
            self._contacts.append(
                self._stage.scene.add_icosphere(
                    f"/contacts/{index}/point", radius, CONTACT, position=tuple(where)
                )
            )
            self._contacts.append(
                self._stage.scene.add_arrows(
                    f"/contacts/{index}/normal",
                    np.array([[where - reach, where], [where + reach, where]], dtype=np.float32),
                    CONTACT,
                    shaft_radius=0.004 * self._size,
                    head_radius=0.012 * self._size,
                    head_length=0.03 * self._size,
                )
            )

    def show_pressure(self, share: Mapping[str, float]) -> None:
        """Show pressures by spheres at the tips, given by finger name as a share of the largest."""
        for finger in self.hand.fingers:
            handle = self._pressures.get(finger.name)
            if finger.tip is None or (handle is None and finger.name not in share):
                continue
            strength = min(max(share.get(finger.name, 0.0), 0.0), 1.0)
            if handle is None:
                handle = self._stage.scene.add_icosphere(
                    f"/pressure/{finger.name}", 0.04 * self._size, ramp(strength), opacity=0.6
                )
                self._pressures[finger.name] = handle
            handle.color = ramp(strength)
            handle.visible = strength > 0.01

    def place_pressures(self, actuators: FloatArray) -> None:
        """Move the pressure spheres to the tips at actuator positions ``(n,)``."""
        if not self._pressures or not np.isfinite(actuators).all():
            return
        for finger in self.hand.fingers:
            handle = self._pressures.get(finger.name)
            if handle is not None and finger.tip is not None:
                pose, _ = tip_pose_and_jacobian(self.hand, finger.tip, actuators)
                handle.position = tuple(pose[:3, 3])

    def remove(self) -> None:
        """Remove everything of this hand from the scene."""
        self.show_contacts(())
        self.seen.remove()
        self.taxels.remove()
        for handle in self._pressures.values():
            handle.remove()
        for body in (self._body, self._reference, self._preview):
            body.remove()
