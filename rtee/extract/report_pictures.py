"""Pictures of a hand in a posture, with the contact marked."""

from __future__ import annotations

import io
import math
import threading
from collections.abc import Collection
from functools import cached_property
from typing import TYPE_CHECKING, Any, Final, Literal

import numpy as np

from rtee.extract.report_camera import Camera, fitted, view
from rtee.extract.report_mesh import HandSurface, Surface
from rtee.extract.report_render import Look, Painter, Tracer
from rtee.hand.colours import PALM, finger_colours, finger_of_link
from rtee.hand.geometry import HandGeometry
from rtee.hand.model import Hand
from rtee.types import FloatArray

if TYPE_CHECKING:
    from PIL import ImageDraw

SIZE: Final = (430, 400)
CLOSE_UP: Final = (230, 215)

FileFormat = Literal["PNG", "WEBP"]
Point = tuple[float, float, float]
Contact = tuple[Point, Point]
"""Point [m] and unit normal of a contact, in the hand's base frame."""

_GHOST: Final = 0.16
_FADED: Final = 0.82


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
        ConfigError: The extra ``plot`` is not installed.
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
            ModelError: A mesh cannot be read.
        """
        self.hand = hand
        self.size = size
        self._lock = threading.Lock()
        self._surface = HandSurface(HandGeometry(hand, visual=True))
        self._back, self._up = view(hand, self._surface.geometry.kinematics)
        rest = self._corners(hand.rest)
        points = np.concatenate([rest, *(self._corners(u) for u in postures)])
        self._camera = fitted(points, self._back, self._up, size)
        self._extent = float(np.linalg.norm(np.ptp(rest, axis=0)))
        self._ground = float((points @ self._up).min())

    @cached_property
    def _silhouette(self) -> FloatArray:
        rest = Tracer(self._posed(self.hand.rest))
        return Painter(rest, self._camera, self._look(self._camera, None)).cover()

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
        tracer = Tracer(self._posed(u))
        picture = Painter(tracer, self._camera, self._look(self._camera, highlight)).paint()
        if ghost:
            picture = _with_ghost(picture, self._silhouette)
        return _file(picture, background, self._camera, contacts, file_format)

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
        surface = self._posed(u)
        point, normal = np.array(contact[0]), np.array(contact[1])
        chosen = np.isin(surface.links, [self._surface.links.index(tip) for tip in tips])
        others = surface.corners[~chosen]
        reach = 0.09 * self._extent
        back = self._free_side(point, normal, others)
        ring = _around(back) * reach
        camera = fitted(point + ring, back, self._up, size)
        look = self._look(camera, None, tips)
        picture = Painter(Tracer(surface), camera, _without_ground(look)).paint()
        return _file(picture, background, camera, [contact], file_format, large=True)

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
            colour = _linear(colours[finger] if finger else PALM)
            faded = finger is not None and highlight is not None and finger not in highlight
            if faded or (links and link not in links and finger is not None):
                colour = _FADED * _linear("#c9ccd1") + (1 - _FADED) * colour
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


def _with_ghost(picture: FloatArray, behind: FloatArray) -> FloatArray:
    """Return a picture with a silhouette behind it."""
    result = picture.copy()
    cover = (1 - picture[..., 3:]) * (_GHOST * behind)[..., None]
    result[..., :3] += cover * _linear("#7d8590")
    result[..., 3:] += cover
    return result


def _linear(colour: str) -> FloatArray:
    """Return a colour ``#rrggbb`` as linear light (IEC 61966-2-1)."""
    shown = np.array([int(colour[i : i + 2], 16) / 255 for i in (1, 3, 5)])
    return np.where(shown <= 0.04045, shown / 12.92, ((shown + 0.055) / 1.055) ** 2.4)


def _shown(light: FloatArray) -> FloatArray:
    """Return linear light as it is stored in a picture (IEC 61966-2-1)."""
    light = np.clip(light, 0, 1)
    return np.where(light <= 0.0031308, 12.92 * light, 1.055 * light ** (1 / 2.4) - 0.055)


def _file(
    picture: FloatArray,
    background: str | None,
    camera: Camera,
    contacts: Collection[Contact],
    file_format: FileFormat,
    *,
    large: bool = False,
) -> bytes:
    from PIL import Image

    cover = np.clip(picture[..., 3:], 0, 1)
    if background is None:
        colour = np.where(cover > 1e-6, picture[..., :3] / np.maximum(cover, 1e-6), 0.0)
        data = np.concatenate([_shown(colour), cover], axis=2)
    else:
        data = _shown(picture[..., :3] + (1 - cover) * _linear(background))
    image = Image.fromarray(np.round(data * 255).astype(np.uint8))
    for contact in contacts:
        image = _marked(image, camera, contact, large=large)
    out = io.BytesIO()
    image.save(out, file_format, quality=90)
    return out.getvalue()


def _marked(image: Any, camera: Camera, contact: Contact, *, large: bool) -> Any:
    """Return the picture with a ring around a contact and arrows along its normal."""
    from PIL import Image, ImageDraw

    fine = 3
    layer = Image.new("RGBA", (image.width * fine, image.height * fine), (255, 255, 255, 0))
    draw = ImageDraw.Draw(layer)
    point, normal = np.array(contact[0]), np.array(contact[1])
    x, y = camera.project(point[None])[0] * fine
    tip = camera.project((point + 1e-3 * normal)[None])[0] * fine - np.array([x, y])
    length = float(np.hypot(*tip))
    radius = (0.030 if large else 0.020) * image.height * fine
    pen = max(1.6 * fine, radius / 6)
    for colour, width in (((255, 255, 255, 235), pen * 2.2), ((17, 17, 17, 255), pen)):
        grown = (width - pen) / 2
        box = [x - radius - grown, y - radius - grown, x + radius + grown, y + radius + grown]
        draw.ellipse(box, outline=colour, width=round(width))
        if length > 1e-9:
            for sign in (-1.0, 1.0):
                _arrow(draw, np.array([x, y]), sign * tip / length, radius, width, grown, colour)
    small = layer.resize(image.size, Image.Resampling.LANCZOS)
    return Image.alpha_composite(image.convert("RGBA"), small).convert(image.mode)


def _arrow(
    draw: ImageDraw.ImageDraw,
    centre: FloatArray,
    side: FloatArray,
    radius: float,
    width: float,
    grown: float,
    colour: tuple[int, int, int, int],
) -> None:
    """Draw an arrow from outside to the ring."""
    across = np.array([-side[1], side[0]])
    head = centre + side * (1.35 * radius - grown)
    neck = centre + side * 2.1 * radius
    tail = centre + side * (3.0 * radius + grown)
    spread = 0.48 * radius + 1.4 * grown
    draw.line([tuple(neck), tuple(tail)], fill=colour, width=round(width))
    draw.polygon(
        [
            tuple(head),
            tuple(neck + across * spread + side * grown),
            tuple(neck - across * spread + side * grown),
        ],
        fill=colour,
    )
