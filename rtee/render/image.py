"""Encoding of pictures in linear light as files, with contacts marked."""

from __future__ import annotations

import io
import math
from collections.abc import Collection
from typing import TYPE_CHECKING, Any, Final, Literal

import numpy as np

from rtee.render.camera import Camera
from rtee.sample import FloatArray

if TYPE_CHECKING:
    from PIL import ImageDraw

FileFormat = Literal["PNG", "WEBP"]
Point = tuple[float, float, float]
Contact = tuple[Point, Point]
"""Point [m] and unit normal of a contact, in the hand's base frame."""

_RING: Final = {False: 0.020, True: 0.030}
"""Radius of a contact's ring, as a share of the picture's height; larger in close-ups."""
_FINE: Final = 3
"""Supersampling factor of marks, for smooth edges."""
_GHOST: Final = 0.16
"""Coverage of a silhouette: too faint to be mistaken for the hand."""


def with_silhouette(picture: FloatArray, silhouette: FloatArray) -> FloatArray:
    """Return a picture with a silhouette behind it, given by the silhouette's coverage."""
    result = picture.copy()
    coverage = (1 - picture[..., 3:]) * (_GHOST * silhouette)[..., None]
    result[..., :3] += coverage * linear_rgb("#7d8590")
    result[..., 3:] += coverage
    return result


def linear_rgb(colour: str) -> FloatArray:
    """Return an sRGB colour ``#rrggbb`` as linear light, 0 to 1 (IEC 61966-2-1)."""
    shown = np.array([int(colour[i : i + 2], 16) / 255 for i in (1, 3, 5)])
    return np.where(shown <= 0.04045, shown / 12.92, ((shown + 0.055) / 1.055) ** 2.4)


def _srgb(light: FloatArray) -> FloatArray:
    """Return linear light, converted to sRGB, 0 to 1 (IEC 61966-2-1)."""
    light = np.clip(light, 0, 1)
    return np.where(light <= 0.0031308, 12.92 * light, 1.055 * light ** (1 / 2.4) - 0.055)


def encode(
    picture: FloatArray,
    background: str | None,
    camera: Camera,
    contacts: Collection[Contact],
    file_format: FileFormat,
    *,
    large: bool = False,
) -> bytes:
    """Return a picture file.

    Args:
        picture: Linear colours times coverage, and the coverage ``(height, width, 4)``.
        background: Colour behind the mesh; ``None`` for transparent.
        camera: Camera of the picture.
        contacts: Contacts to mark.
        file_format: Format of the file.
        large: Use large marks, for close-ups.
    """
    from PIL import Image

    coverage = np.clip(picture[..., 3:], 0, 1)
    if background is None:
        # Files hold straight colours, which are not multiplied by the coverage.
        colour = np.where(coverage > 1e-6, picture[..., :3] / np.maximum(coverage, 1e-6), 0.0)
        data = np.concatenate([_srgb(colour), coverage], axis=2)
    else:
        data = _srgb(picture[..., :3] + (1 - coverage) * linear_rgb(background))
    image = Image.fromarray(np.round(data * 255).astype(np.uint8))
    for contact in contacts:
        image = _marked(image, camera, contact, large=large)
    out = io.BytesIO()
    image.save(out, file_format, quality=90)
    return out.getvalue()


def _marked(image: Any, camera: Camera, contact: Contact, *, large: bool) -> Any:
    """Return the picture with a ring around a contact and arrows along its normal."""
    from PIL import Image, ImageDraw

    fine = _FINE
    radius = _RING[large] * image.height * fine
    pen = max(1.6 * fine, radius / 6)  # no thinner than 1.6 pixels
    point, normal = np.array(contact[0]), np.array(contact[1])
    at = camera.project(point[None])[0]
    side = camera.project((point + 1e-3 * normal)[None])[0] - at
    length = float(np.hypot(*side))
    # Draw only the surroundings, as arrows end three radii from the contact (`_arrow`).
    half = math.ceil((3.2 * radius + 4 * pen) / fine)
    corner = np.floor(at).astype(int) - half
    layer = Image.new("RGBA", (2 * half * fine, 2 * half * fine), (255, 255, 255, 0))
    draw = ImageDraw.Draw(layer)
    x, y = (at - corner) * fine
    # Dark on a wider white line, which is visible on any background.
    for colour, width in (((255, 255, 255, 235), pen * 2.2), ((17, 17, 17, 255), pen)):
        grown = (width - pen) / 2
        box = [x - radius - grown, y - radius - grown, x + radius + grown, y + radius + grown]
        draw.ellipse(box, outline=colour, width=round(width))
        if length > 1e-9:
            for sign in (-1.0, 1.0):
                _arrow(draw, np.array([x, y]), sign * side / length, radius, width, grown, colour)
    small = layer.resize((2 * half, 2 * half), Image.Resampling.LANCZOS)
    whole = Image.new("RGBA", image.size, (255, 255, 255, 0))
    whole.paste(small, (int(corner[0]), int(corner[1])))
    return Image.alpha_composite(image.convert("RGBA"), whole).convert(image.mode)


def _arrow(
    draw: ImageDraw.ImageDraw,
    centre: FloatArray,
    side: FloatArray,
    radius: float,
    width: float,
    grown: float,
    colour: tuple[int, int, int, int],
) -> None:
    """Draw an arrow to the ring from three radii away, wider by ``grown`` [pixels] on all sides."""
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
