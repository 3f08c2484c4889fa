"""Pictures of a hand in a posture, with contacts marked."""

from __future__ import annotations

import math
import threading
from collections.abc import Collection, Iterable
from functools import cached_property
from typing import Final

import numpy as np

from rtee.hand.colours import PALM, finger_colours, finger_of_link
from rtee.hand.geometry import HandGeometry
from rtee.hand.model import Hand
from rtee.render.camera import Camera, choose_view, fit_camera
from rtee.render.image import Contact, FileFormat, encode, linear_rgb, with_silhouette
from rtee.render.mesh import HandMesh, Mesh
from rtee.render.raycast import RayCaster, check_pictures
from rtee.render.renderer import Renderer, Shading
from rtee.sample import FloatArray

SIZE: Final = (430, 400)
"""Width and height of a picture of a hand [pixels]."""
CLOSE_UP: Final = (230, 215)
"""Width and height of a picture of a contact [pixels]."""

CORNERS: Final = ("top right", "top left", "bottom right", "bottom left")

_FADED: Final = 0.82
"""Share of grey in the colours of links that are not highlighted."""
_GREY: Final = "#c9ccd1"
_MARK: Final = 0.06
"""Radius of a contact's mark, as a share of the picture's size."""
_NEAR: Final = 0.09
"""Radius around a contact shown in a close-up, as a share of the hand's diagonal: a fingertip's."""
_BLOCKING: Final = 0.03
"""Radius around a contact that must be visible in a close-up, as a share of the hand's diagonal."""
_FAR: Final = 10.0
"""A distance larger than any hand [m]."""
_WANTED: Final = 4.0
"""Weight of the surface of the action's fingers relative to other fingers, chosen by eye."""


def link_colours(hand: Hand, links: Iterable[str]) -> FloatArray:
    """Return the linear colour of each link ``(l, 3)``: that of its finger, or of the palm."""
    colours, owner = finger_colours(hand), finger_of_link(hand)
    return np.array(
        [linear_rgb(colours[owner[link]] if owner.get(link) else PALM) for link in links]
    )


class HandRenderer:
    """Renders pictures of one hand from a fixed camera; may be used by several threads.

    Attributes:
        hand: The hand.
        size: Width and height of the pictures [pixels].
    """

    def __init__(
        self, hand: Hand, size: tuple[int, int] = SIZE, postures: Collection[FloatArray] = ()
    ) -> None:
        """Choose the camera.

        Args:
            hand: The hand.
            size: Width and height [pixels].
            postures: Postures that must fit into the picture, besides rest.

        Raises:
            MissingExtra: if the extra ``plot`` is not installed.
            ModelError: if a mesh cannot be read, or the hand has no shapes at all.
        """
        check_pictures()
        self.hand = hand
        self.size = size
        self._lock = threading.Lock()
        self._last: tuple[bytes, RayCaster] | None = None
        self._mesh = HandMesh(HandGeometry(hand, visual=True))
        if not self._mesh.links:
            raise hand.urdf.error(
                "no link has visual or collision geometry, so a picture would be empty"
            )
        self._back, self._up = choose_view(self._mesh.geometry)
        rest = self._corners(hand.rest)
        points = np.concatenate([rest, *(self._corners(u) for u in postures)])
        self._camera = fit_camera(points, self._back, self._up, size)
        self._extent = float(np.linalg.norm(np.ptp(rest, axis=0)))
        self._ground = float((points @ self._up).min())

    @cached_property
    def _silhouette(self) -> FloatArray:
        """Coverage of the hand at rest."""
        shading = self._shading(self._camera, ground=self._ground)
        return Renderer(self._caster(self.hand.rest), self._camera, shading).coverage()

    def picture(
        self,
        u: FloatArray,
        *,
        highlight: Collection[str] | None = None,
        contacts: Collection[Contact] = (),
        ghost: bool = False,
        background: str | None = "#ffffff",
        file_format: FileFormat = "PNG",
    ) -> bytes:
        """Return a picture file of the hand.

        Args:
            u: Actuator positions ``(n,)`` [rad | m].
            highlight: Fingers in full colour, the others faded; ``None`` for all.
            contacts: Contacts to mark.
            ghost: Show the rest posture faintly behind.
            background: Colour behind the hand; ``None`` for transparent.
            file_format: Format of the file.
        """
        shading = self._shading(self._camera, highlight, ground=self._ground)
        picture = Renderer(self._caster(u), self._camera, shading).render()
        if ghost:
            picture = with_silhouette(picture, self._silhouette)
        return encode(picture, background, self._camera, contacts, file_format)

    def close_up(
        self,
        u: FloatArray,
        contact: Contact,
        tips: Collection[str],
        *,
        file_format: FileFormat = "PNG",
    ) -> bytes:
        """Return a picture file of a contact, seen across its normal from an unobstructed side.

        Args:
            u: Actuator positions ``(n,)`` [rad | m].
            contact: The contact.
            tips: The links that touch.
            file_format: Format of the file.
        """
        caster = self._caster(u)
        mesh = caster.mesh
        point, normal = np.array(contact[0]), np.array(contact[1])
        chosen = np.isin(mesh.links, [self._mesh.links.index(tip) for tip in tips])
        others = mesh.corners[~chosen]
        reach = _NEAR * self._extent
        back = self._free_side(point, normal, others)
        ring = _around(back) * reach
        camera = fit_camera(point + ring, back, self._up, CLOSE_UP)
        picture = Renderer(caster, camera, self._shading(camera, links=tips)).render()
        return encode(picture, "#ffffff", camera, [contact], file_format, large=True)

    def free_corner(
        self, u: FloatArray, contact: Contact, fingers: Collection[str], share: float
    ) -> str:
        """Return the corner of the picture that shows the least of the hand.

        Args:
            u: Actuator positions ``(n,)`` [rad | m].
            contact: A contact that must stay visible.
            fingers: The fingers that should stay visible.
            share: Size of the corner, as a share of the picture's width and height.

        Returns:
            ``top right``, ``top left``, ``bottom right`` or ``bottom left``.
        """
        mesh = self._caster(u).mesh
        owner = finger_of_link(self.hand)
        wanted = np.array([owner.get(link) in fingers for link in self._mesh.links])
        a, b, c = np.moveaxis(mesh.corners, 1, 0)
        weights = np.linalg.norm(np.cross(b - a, c - a), axis=1)
        weights = weights * np.where(wanted[mesh.links], _WANTED, 1.0)
        points = np.concatenate([(a + b + c) / 3.0, [contact[0]]])
        spots = self._camera.project(points) / self.size
        spots[-1] += np.where(spots[-1] < 0.5, -_MARK, _MARK)
        # An infinite weight keeps the contact itself visible.
        weights = np.append(weights, np.inf)
        covered = {}
        for corner in CORNERS:
            across = spots[:, 0] > 1 - share if "right" in corner else spots[:, 0] < share
            down = spots[:, 1] > 1 - share if "bottom" in corner else spots[:, 1] < share
            covered[corner] = float(weights[across & down].sum())
        return min(CORNERS, key=covered.__getitem__)

    def _caster(self, u: FloatArray) -> RayCaster:
        """Return the ray caster of the hand at a posture; the last one is cached."""
        key = u.tobytes()
        # Read once, since another thread may replace it in between.
        last = self._last
        if last is None or last[0] != key:
            last = self._last = (key, RayCaster(self._posed(u)))
        return last[1]

    def _posed(self, u: FloatArray) -> Mesh:
        with self._lock:  # the kinematics stores intermediate results
            return self._mesh.at(u)

    def _corners(self, u: FloatArray) -> FloatArray:
        return self._posed(u).corners.reshape(-1, 3)

    def _shading(
        self,
        camera: Camera,
        highlight: Collection[str] | None = None,
        *,
        links: Collection[str] = (),
        ground: float | None = None,
    ) -> Shading:
        """Return colours and light, with fingers outside ``highlight`` or ``links`` faded.

        By default, all links have full colour, and there is no ground.
        """
        owner = finger_of_link(self.hand)
        colours = link_colours(self.hand, self._mesh.links)
        for row, link in enumerate(self._mesh.links):
            finger = owner.get(link)
            if finger is not None and (
                (highlight is not None and finger not in highlight) or (links and link not in links)
            ):
                colours[row] = _FADED * linear_rgb(_GREY) + (1 - _FADED) * colours[row]
        return Shading.studio(colours, camera, self._up, self._extent, ground)

    def _free_side(self, point: FloatArray, normal: FloatArray, others: FloatArray) -> FloatArray:
        """Return the direction, across the normal, from which the contact is best visible."""
        first = np.cross(normal, self._up)
        if float(np.linalg.norm(first)) < 0.2:  # the normal points within 12° of up or down
            first = np.cross(normal, self._back)
        first /= np.linalg.norm(first)
        second = np.cross(normal, first)
        # Directions every 15°: neighbouring ones see nearly the same.
        turns = np.arange(24) * (2 * math.pi / 24)
        sides = np.cos(turns)[:, None] * first + np.sin(turns)[:, None] * second
        # Prefer directions near the camera of the other pictures and above, but visibility of the
        # contact counts more than both. The weights are chosen by eye.
        score = sides @ self._back + 0.3 * (sides @ self._up)
        if len(others):
            occluded = _occluded_share(point, sides, others, _BLOCKING * self._extent)
            score = score - 3.0 * occluded
        side: FloatArray = sides[int(np.argmax(score))]
        tilted = side + 0.25 * self._back  # a little depth, without looking along the normal
        tilted = tilted - 0.3 * (tilted @ normal) * normal
        return tilted / np.linalg.norm(tilted)


def _occluded_share(
    point: FloatArray, sides: FloatArray, corners: FloatArray, radius: float
) -> FloatArray:
    """Return, for each viewing direction, the hidden share of a point's surroundings."""
    mesh = Mesh(corners, np.zeros_like(corners), np.zeros(len(corners), dtype=np.int64))
    caster = RayCaster(mesh)
    share = []
    for side in sides:
        around = point + _around(side)[::2] * radius
        around = np.concatenate([point[None], around])
        toward = np.broadcast_to(side, around.shape)
        share.append(float(caster.occluded(around + 0.1 * radius * side, toward, _FAR).mean()))
    return np.array(share)


def _around(axis: FloatArray) -> FloatArray:
    """Return twelve unit vectors around an axis, perpendicular to it."""
    other = np.eye(3)[int(np.argmin(np.abs(axis)))]
    first = np.cross(axis, other)
    first /= np.linalg.norm(first)
    second = np.cross(axis, first)
    turns = np.arange(12) * (math.pi / 6)
    ring: FloatArray = np.cos(turns)[:, None] * first + np.sin(turns)[:, None] * second
    return ring
