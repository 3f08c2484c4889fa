"""Pictures side by side, each with its caption below."""

from __future__ import annotations

import io
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final

from rtee.hand.files import write_atomically

SIZE: Final = (360, 400)
"""Width and height of a picture [pixels]."""

_CAPTION: Final = 26
"""Height of a caption [pixels]: a line of text with some space."""


def write_strip(
    path: Path, pictures: Sequence[tuple[str, bytes]], columns: int | None = None
) -> None:
    """Write pictures side by side, each with its caption below, as one PNG file.

    Args:
        path: The file.
        pictures: Captions and PNG files of the same size.
        columns: Number of pictures per row; all in one row unless given.

    Raises:
        ConfigError: if the file cannot be written.
    """
    from PIL import Image, ImageDraw

    images = [Image.open(io.BytesIO(data)).convert("RGB") for _, data in pictures]
    width, height = images[0].size
    across = min(columns or len(images), len(images))
    down = -(-len(images) // across)  # rounded up
    size = (width * across, (height + _CAPTION) * down)
    strip: Any = Image.new("RGB", size, "#ffffff")
    draw = ImageDraw.Draw(strip)
    for index, ((caption, _), image) in enumerate(zip(pictures, images, strict=True)):
        x, y = width * (index % across), (height + _CAPTION) * (index // across)
        strip.paste(image, (x, y))
        draw.text((x + width // 2, y + height + 4), caption, fill="#222222", anchor="ma")
    out = io.BytesIO()
    strip.save(out, "PNG", optimize=True)
    write_atomically(path, out.getvalue())
