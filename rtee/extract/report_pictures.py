"""Pictures of a hand in a posture, with the contact marked."""

from __future__ import annotations

import math
import threading
from collections.abc import Collection
from functools import cached_property
from typing import Final

import numpy as np

from rtee.extract.report_camera import Camera, fitted, view
from rtee.extract.report_image import (
    Contact,
    FileFormat,
    linear,
    picture_file,
    with_silhouette,
)
from rtee.extract.report_mesh import HandSurface, Surface
from rtee.extract.report_render import Look, Painter
from rtee.extract.report_trace import Tracer, check_pictures
from rtee.hand.colours import PALM, finger_colours, finger_of_link
from rtee.hand.geometry import HandGeometry
from rtee.hand.model import Hand
from rtee.types import FloatArray

SIZE: Final = (430, 400)
CLOSE_UP: Final = (230, 215)

CORNERS: Final = ("top right", "top left", "bottom right", "bottom left")

_FADED: Final = 0.82
_MARK: Final = 0.06
"""How far the mark of a contact reaches, as a part of the picture's size."""
_WANTED: Final = 4.0
"""How much more the surface of wanted fingers counts than that of others."""


def render(
    hand: Hand,
    u: FloatArray,
    size: tuple[int, int] = SIZE,
    *,
    highlight: Collection[str] | None = None,
    contacts: Collection[Contact] = (),
    ghost: bool = False,
    background: str | None = "#ffffff",
) -> bytes:
    """Render a hand.

    Args:
        hand: The hand.
        u: Actuator positions ``(n,)`` [rad | m].
        size: Width and height [pixels].
        highlight: Fingers in full colour, the others faded; ``None`` for all.
        contacts: Contacts to mark.
        ghost: Show the rest posture faintly behind.
        background: Colour behind the hand; ``None`` for transparent.

    Returns:
        A PNG file.

    Raises:
        MissingExtra: The extra ``plot`` is not installed.
        ModelError: A mesh cannot be read.
    """
    studio = Studio(hand, size, [u])
    return studio.picture(
        u, highlight=highlight, contacts=contacts, ghost=ghost, background=background
    )


class Studio:
    """Takes pictures of one hand, all from the same place; several threads may do so at once.

    Attributes:
        hand: The hand.
        size: Width and height of the pictures [pixels].
    """

    def __init__(
        self, hand: Hand, size: tuple[int, int] = SIZE, postures: Collection[FloatArray] = ()
    ) -> None:
        """Prepare the pictures.

        Args:
            hand: The hand.
            size: Width and height [pixels].
            postures: Postures that must fit into the picture, besides rest.

        Raises:
            MissingExtra: The extra ``plot`` is not installed.
            ModelError: A mesh cannot be read.
        """
        check_pictures()
        self.hand = hand
        self.size = size
        self._lock = threading.Lock()
        self._last: tuple[bytes, Tracer] | None = None
        self._surface = HandSurface(HandGeometry(hand, visual=True))
        self._back, self._up = view(self._surface.geometry)
        rest = self._corners(hand.rest)
        points = np.concatenate([rest, *(self._corners(u) for u in postures)])
        self._camera = fitted(points, self._back, self._up, size)
        self._extent = float(np.linalg.norm(np.ptp(rest, axis=0)))
        self._ground = float((points @ self._up).min())

    @cached_property
    def _silhouette(self) -> FloatArray:
        return Painter(
            self._traced(self.hand.rest), self._camera, self._look(self._camera, None)
        ).cover()

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
        """Return a picture file of the hand; see `render`."""
        picture = Painter(
            self._traced(u), self._camera, self._look(self._camera, highlight)
        ).paint()
        if ghost:
            picture = with_silhouette(picture, self._silhouette)
        return picture_file(picture, background, self._camera, contacts, file_format)

    def close_up(
        self,
        u: FloatArray,
        contact: Contact,
        tips: Collection[str],
        *,
        size: tuple[int, int] = CLOSE_UP,
        background: str | None = "#ffffff",
        file_format: FileFormat = "PNG",
    ) -> bytes:
        """Return a picture file of a contact, seen across its normal from where it is not hidden.

        Args:
            u: Actuator positions ``(n,)`` [rad | m].
            contact: The contact.
            tips: The links that touch.
            size: Width and height [pixels].
            background: Colour behind the hand; ``None`` for transparent.
            file_format: Format of the file.
        """
        tracer = self._traced(u)
        surface = tracer.surface
        point, normal = np.array(contact[0]), np.array(contact[1])
        chosen = np.isin(surface.links, [self._surface.links.index(tip) for tip in tips])
        others = surface.corners[~chosen]
        reach = 0.09 * self._extent
        back = self._free_side(point, normal, others)
        ring = _around(back) * reach
        camera = fitted(point + ring, back, self._up, size)
        look = self._look(camera, None, tips)
        picture = Painter(tracer, camera, _without_ground(look)).paint()
        return picture_file(picture, background, camera, [contact], file_format, large=True)

    def free_corner(
        self, u: FloatArray, contact: Contact, fingers: Collection[str], share: float
    ) -> str:
        """Return the corner of the picture in which least of the hand is seen.

        Args:
            u: Actuator positions ``(n,)`` [rad | m].
            contact: A contact that must not be covered.
            fingers: The fingers that should rather not be covered.
            share: How much of the picture's width and height is needed.

        Returns:
            ``top right``, ``top left``, ``bottom right`` or ``bottom left``.
        """
        surface = self._traced(u).surface
        owner = finger_of_link(self.hand)
        wanted = np.array([owner.get(link) in fingers for link in self._surface.links])
        a, b, c = np.moveaxis(surface.corners, 1, 0)
        weights = np.linalg.norm(np.cross(b - a, c - a), axis=1)
        weights = weights * np.where(wanted[surface.links], _WANTED, 1.0)
        points = np.concatenate([(a + b + c) / 3.0, [contact[0]]])
        spots = self._camera.project(points) / self.size
        spots[-1] += np.where(spots[-1] < 0.5, -_MARK, _MARK)
        weights = np.append(weights, np.inf)
        covered = {}
        for corner in CORNERS:
            across = spots[:, 0] > 1 - share if "right" in corner else spots[:, 0] < share
            down = spots[:, 1] > 1 - share if "bottom" in corner else spots[:, 1] < share
            covered[corner] = float(weights[across & down].sum())
        return min(CORNERS, key=covered.__getitem__)

    def _traced(self, u: FloatArray) -> Tracer:
        """Return the rays' surface at a posture; the last one is kept."""
        key = u.tobytes()
        last = self._last
        if last is None or last[0] != key:
            last = self._last = (key, Tracer(self._posed(u)))
        return last[1]

    def _posed(self, u: FloatArray) -> Surface:
        with self._lock:  # kinematics keeps what it computes
            return self._surface.at(u)

    def _corners(self, u: FloatArray) -> FloatArray:
        return self._posed(u).corners.reshape(-1, 3)

    def _look(
        self, camera: Camera, highlight: Collection[str] | None, links: Collection[str] = ()
    ) -> Look:
        colours = finger_colours(self.hand)
        owner = finger_of_link(self.hand)
        rows = []
        for link in self._surface.links:
            finger = owner.get(link)
            colour = linear(colours[finger] if finger else PALM)
            faded = finger is not None and highlight is not None and finger not in highlight
            if faded or (links and link not in links and finger is not None):
                colour = _FADED * linear("#c9ccd1") + (1 - _FADED) * colour
            rows.append(colour)
        light = -0.55 * camera.right + 0.75 * self._up - 0.62 * camera.forward
        return Look(
            colours=np.array(rows),
            light=light / np.linalg.norm(light),
            up=self._up,
            ground=self._ground,
            reach=0.45 * self._extent,
        )

    def _free_side(self, point: FloatArray, normal: FloatArray, others: FloatArray) -> FloatArray:
        """Return the direction across the normal in which the contact is seen best."""
        first = np.cross(normal, self._up)
        if float(np.linalg.norm(first)) < 0.2:
            first = np.cross(normal, self._back)
        first /= np.linalg.norm(first)
        second = np.cross(normal, first)
        turns = np.arange(24) * (2 * math.pi / 24)
        sides = np.cos(turns)[:, None] * first + np.sin(turns)[:, None] * second
        liking = sides @ self._back + 0.3 * (sides @ self._up)
        if len(others):
            blocked = _blocked_share(point, sides, others, 0.03 * self._extent)
            liking = liking - 3.0 * blocked
        side: FloatArray = sides[int(np.argmax(liking))]
        tilted = side + 0.25 * self._back
        tilted = tilted - 0.3 * (tilted @ normal) * normal
        return tilted / np.linalg.norm(tilted)


def _blocked_share(
    point: FloatArray, sides: FloatArray, corners: FloatArray, radius: float
) -> FloatArray:
    """Return how much of the surroundings of a point is hidden, seen from each side."""
    surface = Surface(corners, np.zeros_like(corners), np.zeros(len(corners), dtype=np.int64))
    tracer = Tracer(surface)
    share = []
    for side in sides:
        around = point + _around(side)[::2] * radius
        around = np.concatenate([point[None], around])
        toward = np.broadcast_to(side, around.shape)
        share.append(float(tracer.blocked(around + 0.1 * radius * side, toward, 10.0).mean()))
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


def _without_ground(look: Look) -> Look:
    return Look(look.colours, look.light, look.up, None, look.reach)
